"""CSV and NumPy: what is written is read back, and no header is believed."""

from __future__ import annotations

import io
import math
import random
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from anchorscan import LogError, Pose2D, Record, open_log

numbers = st.floats(-100, 100, width=32)
readings = st.one_of(st.floats(0, 79, width=32), st.just(math.nan), st.just(math.inf))
tables = st.tuples(st.integers(1, 4), st.sampled_from([181, 361])).flatmap(
    lambda shape: st.tuples(
        hnp.arrays(np.float32, shape, elements=readings),
        hnp.arrays(np.float64, (shape[0], 3), elements=numbers),
        hnp.arrays(np.float64, (shape[0], 3), elements=numbers),
        hnp.arrays(np.float64, shape[0], elements=st.floats(0.5, 2e9)),
    )
)


def compare(
    records: list[Record],
    ranges: np.ndarray,
    poses: np.ndarray,
    odometry: np.ndarray,
    stamps: np.ndarray,
) -> None:
    assert len(records) == len(ranges)
    for record, row, pose, odom, stamp in zip(
        records, ranges, poses, odometry, stamps, strict=True
    ):
        assert record.scan is not None
        codes = (row > 32.7585) & (row < 32.7675)
        np.testing.assert_array_equal(record.scan.ranges[~codes], row[~codes])
        assert record.pose == Pose2D(*pose)
        assert record.odometry == Pose2D(*odom)
        assert record.stamp == pytest.approx(stamp, rel=1e-15)


@settings(max_examples=30, deadline=None)
@given(
    table=tables,
    style=st.sampled_from(["r{}", "range{}", "ranges[{}]", "field.ranges{}", "/scan/ranges[{}]"]),
    delimiter=st.sampled_from([",", ";", "\t", " "]),
    order=st.randoms(use_true_random=False),
)
def test_a_csv_is_read_back_whatever_the_columns_are_called(
    tmp_path_factory: pytest.TempPathFactory,
    table: tuple[np.ndarray, ...],
    style: str,
    delimiter: str,
    order: random.Random,
) -> None:
    ranges, poses, odometry, stamps = table
    names = ["stamp", "x", "y", "theta", "odom_x", "odom_y", "odom_theta", "seq"]
    names += [style.format(i) for i in range(ranges.shape[1])]
    columns = [stamps, *poses.T, *odometry.T, np.arange(len(stamps)), *ranges.T.astype(float)]
    shuffled = list(range(len(names)))
    order.shuffle(shuffled)
    rows = [[names[i] for i in shuffled]]
    rows += [[repr(float(columns[i][k])) for i in shuffled] for k in range(len(stamps))]
    path = tmp_path_factory.mktemp("table") / "a.csv"
    path.write_text("# made by hand\n" + "\n".join(delimiter.join(row) for row in rows) + "\n")
    log = open_log(path)
    assert log.format == "CSV"
    compare(list(log), ranges, poses, odometry, stamps)
    assert log.problems == ()


@settings(max_examples=30, deadline=None)
@given(table=tables, fortran=st.booleans(), compressed=st.booleans())
def test_an_npz_is_read_back(
    tmp_path_factory: pytest.TempPathFactory,
    table: tuple[np.ndarray, ...],
    fortran: bool,
    compressed: bool,
) -> None:
    ranges, poses, odometry, stamps = table
    path = tmp_path_factory.mktemp("table") / "a.npz"
    save = np.savez_compressed if compressed else np.savez
    save(
        path,
        ranges=np.asfortranarray(ranges) if fortran else ranges,
        poses=poses,
        odometry=odometry,
        stamps=stamps,
        T_base_laser=[0.1, 0.0, 1.0],
    )
    log = open_log(path)
    assert log.format == "NumPy"
    assert log.count == len(ranges)
    records = list(log)
    compare(records, ranges, poses, odometry, stamps)
    assert {record.T_base_laser for record in records} == {Pose2D(0.1, 0.0, 1.0)}


def test_an_array_alone_is_scans_alone(tmp_path: Path) -> None:
    ranges = np.arange(3 * 541, dtype=np.float32).reshape(3, 541) % 60
    np.save(tmp_path / "a.npy", ranges)
    records = list(open_log(tmp_path / "a.npy"))
    for record, row in zip(records, ranges, strict=True):
        assert record.scan is not None
        np.testing.assert_array_equal(record.scan.ranges, row)
        assert math.degrees(record.scan.angle_min) == pytest.approx(-135)
        assert (record.pose, record.odometry, record.stamp) == (None, None, None)
    np.save(tmp_path / "one.npy", ranges[1])
    (record,) = open_log(tmp_path / "one.npy")
    assert record.scan is not None
    np.testing.assert_array_equal(record.scan.ranges, ranges[1])


def test_angles_and_limits_are_those_of_the_table(tmp_path: Path) -> None:
    np.savez(
        tmp_path / "a.npz",
        ranges=np.full((2, 7), 5.0),
        angle_min=[-1.0, -2.0],
        angle_increment=0.25,
        range_min=0.2,
        range_max=[4.0, 6.0],
        poses=[[1, 2, 3], [math.nan, 0, 0]],
    )
    first, second = open_log(tmp_path / "a.npz")
    assert first.scan is not None
    assert second.scan is not None
    assert (first.scan.angle_min, second.scan.angle_min) == (-1, -2)
    assert first.scan.angle_increment == 0.25
    assert first.scan.range_min == 0.2
    assert (first.scan.is_free.all(), second.scan.is_return.all()) == (True, True)
    assert (first.pose, second.pose) == (Pose2D(1, 2, 3), None)
    (tmp_path / "a.csv").write_text("angle_min,angle_increment,range_max,r0,r1\n-1,.5,4,5,3\n")
    (record,) = open_log(tmp_path / "a.csv")
    assert record.scan is not None
    assert (record.scan.angle_min, record.scan.angle_increment) == (-1, 0.5)
    assert record.scan.is_free.tolist() == [True, False]


@pytest.mark.parametrize("name", ["a.npy", "a.csv"])
def test_angles_that_were_guessed_are_told(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "a.npy":
        np.save(path, np.ones((2, 360)))
    else:
        path.write_text(("\n" + ",".join(["1.0"] * 360)) * 2)
    (note,) = open_log(path).notes
    assert note.startswith(
        "360 readings from -90 to 89.5 degrees, up to 80 m; guessed from their number"
    )
    assert "--field-of-view" in note
    (note,) = open_log(path, field_of_view=2.0 * math.pi).notes
    assert note == "360 readings from -180 to 179 degrees, up to 80 m"


@pytest.mark.parametrize("kind", ["npz", "csv"])
@pytest.mark.parametrize(
    "told",
    [
        {"angle_min": -0.5, "angle_max": 0.5},
        {"angle_max": 0.5, "angle_increment": 0.25},
        {"angle_min": -0.5, "angle_increment": 0.25, "angle_max": 7.0},
    ],
    ids=",".join,
)
def test_two_of_three_angles_are_enough(tmp_path: Path, kind: str, told: dict[str, float]) -> None:
    log = open_log(write_table(tmp_path / f"a.{kind}", told))
    (record,) = log
    assert record.scan is not None
    np.testing.assert_allclose(record.scan.angles, [-0.5, -0.25, 0.0, 0.25, 0.5])
    assert "guessed" not in log.notes[0]


@pytest.mark.parametrize("kind", ["npz", "csv"])
@pytest.mark.parametrize("name", ["angle_min", "angle_max", "angle_increment"])
def test_one_angle_alone_is_refused(tmp_path: Path, kind: str, name: str) -> None:
    path = write_table(tmp_path / f"a.{kind}", {name: 0.5}, count=181)
    with pytest.raises(LogError, match=f"{name} alone does not say"):
        open_log(path)
    assert len(list(open_log(path, field_of_view=math.pi))) == 1


def write_table(path: Path, told: dict[str, float], count: int = 5) -> Path:
    """Write one scan with some angles."""
    if path.suffix == ".npz":
        np.savez(path, ranges=np.ones((1, count)), **told)
        return path
    names = [*told, *(f"r{number}" for number in range(count))]
    cells = [*told.values(), *[1.0] * count]
    path.write_text(",".join(names) + "\n" + ",".join(map(str, cells)) + "\n")
    return path


def test_readings_with_a_gap_in_their_numbers_are_not_closed_up(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("angle_min,angle_increment,r1,r2,r4\n0,0.1,1,2,4\n")
    with pytest.raises(LogError, match=r"a\.csv:1: has no column of reading 3:"):
        open_log(path)
    path.write_text("angle_min,angle_increment,r1,r2,r3,r4\n0,0.1,1,2,,4\n")
    (record,) = open_log(path)
    assert record.scan is not None
    np.testing.assert_array_equal(record.scan.ranges, [1, 2, math.nan, 4])


def test_a_cell_that_is_no_number_is_the_one_that_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "frame,angle_min,angle_increment,r0,r1\nlaser,0,1,2,3\nlaser,0,1,2,oops\nlaser,no,1,2,3\n"
    )
    log = open_log(tmp_path / "a.csv")
    reasons = ["", "not a number: 'oops'", "not a number: 'no'"]
    assert [record.problem for record in log] == reasons


def test_a_mounting_that_would_change_nothing_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y,theta," + ",".join(f"r{i}" for i in range(181)))
    with (tmp_path / "a.csv").open("a") as stream:
        stream.write("\n" + ",".join(["1.0"] * 184))
    np.save(tmp_path / "a.npy", np.ones((2, 181)))
    tail = f"181 {' '.join(['1'] * 181)} 0 1 2 3 1 2 3 0 0 0 0 0 5 h 5"
    (tmp_path / "a.g2o").write_text(
        f"VERTEX_SE2 0 1 2 3\nROBOTLASER1 0 -1.5 3 0.017 80 0.1 0 {tail}\n"
    )
    for name in ("a.csv", "a.npy", "a.g2o"):
        assert list(open_log(tmp_path / name))
        with pytest.raises(LogError, match=r"are the laser's, .*T_base_laser, --laser.*--poses"):
            open_log(tmp_path / name, T_base_laser=Pose2D(0.2))


def test_rostopic_writes_a_table_that_is_read(tmp_path: Path) -> None:
    names = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id"]
    names += ["field.angle_min", "field.angle_max", "field.angle_increment", "field.range_min"]
    names += ["field.range_max", *(f"field.ranges{i}" for i in range(3)), "field.intensities0"]
    cells = ["1305032500000000000", 7, "1305032500000000000", "laser", -0.5, 0.5, 0.5, 0.1]
    cells += [10.0, 1.0, "inf", "", 99]
    text = ",".join(names) + "\n" + ",".join(map(str, cells)) + "\n"
    (tmp_path / "scan.txt").write_text(text)
    (record,) = open_log(tmp_path / "scan.txt")
    assert record.scan is not None
    assert record.stamp == pytest.approx(1305032500.0)
    assert record.scan.is_return.tolist() == [True, False, False]
    assert record.scan.is_free.tolist() == [False, True, False]
    assert record.scan.range_max == 10


def test_a_malformed_row_is_counted(tmp_path: Path) -> None:
    rows = [",".join(["1.0"] * 181)] * 4
    rows[1] = rows[1].replace("1.0", "one", 1)
    rows[2] = rows[2][:-4]
    (tmp_path / "a.csv").write_text("\n".join(rows))
    log = open_log(tmp_path / "a.csv")
    assert [record.scan is None for record in log] == [False, True, True, False]
    assert [problem.line for problem in log.problems] == [2, 3]
    assert "'one'" in log.problems[0].reason
    assert "180 cells instead of 181" in log.problems[1].reason


def header(shape: tuple[int, ...], dtype: str = "<f4") -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"shape": shape, "fortran_order": False, "descr": dtype}
    )
    return stream.getvalue()


@pytest.mark.parametrize("shape", [(10**9, 361), (1, 10**12), (10**15,), (3, 181)])
def test_no_array_is_set_aside_because_a_header_promises_it(
    tmp_path: Path, shape: tuple[int, ...]
) -> None:
    row = np.ones(181, dtype="<f4").tobytes()
    (tmp_path / "a.npy").write_bytes(header(shape) + row)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("ranges.npy", header(shape) + row)
        archive.writestr("stamps.npy", header(shape[:1], "<f8"))
    tracemalloc.start()
    for name in ("a.npy", "a.npz"):
        try:
            list(open_log(tmp_path / name))
        except LogError as error:
            assert "\n" not in str(error)  # noqa: PT017 - either outcome is right
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6


def test_an_array_that_is_cut_off_keeps_its_first_rows(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.ones((10, 181), dtype=np.float32))
    path.write_bytes(path.read_bytes()[:-1000])
    log = open_log(path)
    assert len(list(log)) == 8
    assert "ends here instead of after 10 scans" in log.problems[0].reason


BAD_ARRAYS = {
    "no ranges": {"scans": np.ones((2, 181))},
    "text": {"ranges": np.array([["a", "b"]])},
    "objects": {"ranges": np.array([[None, 1]], dtype=object)},
    "three dimensions": {"ranges": np.ones((2, 3, 4))},
    "no scans": {"ranges": np.ones((0, 181))},
    "no readings": {"ranges": np.ones((2, 0))},
    "an unknown number of readings": {"ranges": np.ones((2, 777))},
    "too few poses": {"ranges": np.ones((2, 181)), "poses": np.ones((1, 3))},
    "degrees": {"ranges": np.ones((2, 400)), "angle_min": -90, "angle_increment": 0.5},
}


@pytest.mark.parametrize("what", BAD_ARRAYS)
def test_a_file_without_scans_is_one_clear_line(tmp_path: Path, what: str) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, **BAD_ARRAYS[what])
    with pytest.raises(LogError) as raised:
        open_log(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("keep", [3, 8, 60, 300])
@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
def test_a_damaged_file_is_one_clear_line(tmp_path: Path, name: str, keep: int) -> None:
    path = tmp_path / name
    if name == "a.npy":
        np.save(path, np.ones((1, 181)))
    else:
        np.savez(path, ranges=np.ones((1, 181)))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(LogError) as raised:
        open_log(path)
    assert "\n" not in str(raised.value)
