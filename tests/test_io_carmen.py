"""CARMEN logs: what is written is read back, and what is not there is not made up."""

from __future__ import annotations

import gzip
import math
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from anchorscan import LogError, Pose2D, Record, open_log

NUMBERS = {180: (180, 1), 181: (180, 1), 360: (180, 0.5), 361: (180, 0.5), 401: (100, 0.25)}
NUMBERS |= {400: (100, 0.25), 540: (270, 0.5), 541: (270, 0.5), 1081: (270, 0.25)}


def flaser(
    ranges: Sequence[object],
    pose: Sequence[float] = (1.0, 2.0, 0.3),
    odometry: Sequence[float] = (0.9, 2.1, 0.2),
    stamp: float = 5.5,
    kind: str = "FLASER",
) -> str:
    words = [kind, len(ranges), *ranges, *pose, *odometry, stamp, "host", stamp]
    return " ".join(map(str, words)) + "\n"


def drive(count: int = 6, **columns: Callable[[int], Sequence[float]]) -> str:
    """A log whose laser drives ahead, both columns filled in unless said otherwise."""
    lines = []
    for i in range(count):
        ranges = [round(2.0 + 0.01 * k + 0.5 * i, 3) for k in range(181)]
        pose = columns.get("pose", lambda i: (1.0 * i, 0.0, 0.0))(i)
        odometry = columns.get("odometry", lambda i: (1.1 * i, 0.1, 0.0))(i)
        lines.append(flaser(ranges, pose, odometry, stamp=float(i)))
    return "".join(lines)


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def to(content: str | bytes, name: str = "a.log") -> Path:
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return to


def read(path: Path, **options: object) -> list[Record]:
    return list(open_log(path, **options))  # type: ignore[arg-type]


poses = st.tuples(st.floats(-500, 500), st.floats(-500, 500), st.floats(-math.pi + 1e-9, math.pi))


@settings(max_examples=40, deadline=None)
@given(
    scans=st.lists(
        st.sampled_from(sorted(NUMBERS)).flatmap(
            lambda n: hnp.arrays(np.float32, n, elements=st.floats(0, 79, width=32))
        ),
        min_size=1,
        max_size=3,
    ),
    columns=st.lists(st.tuples(poses, poses, st.floats(0.001, 2e9)), min_size=3, max_size=3),
    ending=st.sampled_from(["\n", "\r\n", "\n\n", " \n"]),
    packing=st.sampled_from(["plain", "gzip", "zip"]),
)
def test_what_is_written_is_read_back(
    tmp_path_factory: pytest.TempPathFactory,
    scans: list[np.ndarray],
    columns: list[tuple[tuple[float, ...], tuple[float, ...], float]],
    ending: str,
    packing: str,
) -> None:
    lines = [
        flaser(list(map(float, ranges)), pose, odometry, stamp)
        for ranges, (pose, odometry, stamp) in zip(scans, columns, strict=False)
    ]
    text = "# a comment\nODOM 1 2 3 0 0 0 0 host 0\n" + "".join(lines)
    data = text.replace("\n", ending).encode()
    path = tmp_path_factory.mktemp("log") / "log"
    if packing == "zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("folder/a.log", data)
    else:
        path.write_bytes(gzip.compress(data) if packing == "gzip" else data)
    log = open_log(path)
    records = list(log)
    assert log.problems == ()
    assert log.count == len(records) == len(scans)
    for index, (record, ranges) in enumerate(zip(records, scans, strict=True)):
        pose, odometry, stamp = columns[index]
        assert record.index == index
        assert record.scan is not None
        codes = (ranges > 32.7585) & (ranges < 32.7675)
        np.testing.assert_array_equal(record.scan.ranges[~codes], ranges[~codes])
        field_of_view, step = NUMBERS[len(ranges)]
        assert record.scan.angle_min == pytest.approx(-math.radians(field_of_view / 2))
        assert record.scan.angle_increment == pytest.approx(math.radians(step))
        assert record.stamp == stamp
        if record.pose is not None:
            assert record.pose == Pose2D(*pose)
        if record.odometry is not None:
            assert record.odometry == Pose2D(*odometry)
    together = [Pose2D(*odometry).inverse() @ Pose2D(*pose) for pose, odometry, _ in columns]
    apart = max(together[0].distance(one) for one in together[: len(scans)])
    if apart > 0.1 and len({c[0] for c in columns[: len(scans)]}) > 1:
        assert all(record.pose is not None for record in records)


@settings(max_examples=30, deadline=None)
@given(
    ranges=hnp.arrays(np.float32, st.integers(2, 300), elements=st.floats(0, 20, width=32)),
    start=st.floats(-3, 0),
    step=st.floats(0.001, 0.02),
    limit=st.floats(5, 30),
    remissions=st.integers(0, 3),
)
def test_a_robotlaser_line_carries_its_own_geometry(
    tmp_path_factory: pytest.TempPathFactory,
    ranges: np.ndarray,
    start: float,
    step: float,
    limit: float,
    remissions: int,
) -> None:
    header = ["ROBOTLASER1", 0, start, step * len(ranges), step, limit, 0.1, 0, len(ranges)]
    tail = [1.3, 2.0, 0.0, 1.0, 2.0, 0.0, 0, 0, 0, 0, 0, 77.5, "host", 1.5]
    words = [*header, *map(float, ranges), remissions, *[0.5] * remissions, *tail]
    path = tmp_path_factory.mktemp("log") / "log"
    path.write_text(" ".join(map(str, words)))
    (record,) = read(path)
    assert record.scan is not None
    expected = np.where(ranges.astype(float) >= limit, np.float32(np.inf), ranges)
    np.testing.assert_array_equal(record.scan.ranges, expected)
    assert (record.scan.angle_min, record.scan.angle_increment) == (start, step)
    assert record.stamp == 77.5
    assert record.T_base_laser is not None
    assert record.T_base_laser.distance(Pose2D(0.3)) < 1e-12


def test_readings_at_the_limit_are_free_space(write: Callable[..., Path]) -> None:
    ranges: list[object] = [1.0] * 181
    ranges[:8] = [79.99, 80.0, 81.83, 1e9, "inf", "nan", 0.0, "-inf"]
    (record,) = read(write(flaser(ranges)))
    assert record.scan is not None
    assert record.scan.is_free[:8].tolist() == [False, True, True, True, True, *[False] * 3]
    assert record.scan.is_return[:8].tolist() == [True, *[False] * 7]
    (record,) = read(write(flaser(ranges)), range_max=0.5)
    assert record.scan is not None
    assert record.scan.is_return.sum() == 0


def test_millimetre_codes_are_free_space_but_a_wall_is_not(write: Callable[..., Path]) -> None:
    ranges: list[object] = [1.0] * 181
    ranges[:4] = [32.767, 32.763, 32.759, 32.76]
    (record,) = read(write(flaser(ranges)))
    assert record.scan is not None
    assert record.scan.is_free[:4].tolist() == [True, True, True, False]


def test_parameters_tell_what_the_number_of_readings_does_not(write: Callable[..., Path]) -> None:
    text = flaser([1.0] * 720)
    with pytest.raises(LogError, match=r"a\.log:1: .*field of view of 720 readings.*give it"):
        open_log(write(text))
    (record,) = read(write(text), field_of_view=2 * math.pi)
    assert record.scan is not None
    assert record.scan.is_full_turn
    assert math.degrees(record.scan.angle_increment) == pytest.approx(0.5)
    header = "PARAM laser_front_laser_resolution 0.25 host 0\nPARAM robot_front_laser_max 30 h 0\n"
    (record,) = read(write(header + text))
    assert record.scan is not None
    assert math.degrees(record.scan.angle_min) == pytest.approx(-90)
    assert record.scan.range_max == 30
    # One parameter alone does not stand against a number that means one sensor.
    (record,) = read(write(header + flaser([1.0] * 361)))
    assert record.scan is not None
    assert math.degrees(record.scan.angle_increment) == pytest.approx(0.5)
    header += "PARAM laser_front_laser_fov 90 host 0\n"
    (record,) = read(write(header + flaser([1.0] * 361)))
    assert record.scan is not None
    assert math.degrees(record.scan.angle_increment) == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("count", "degrees", "start", "step"),
    [
        (180, 180, -90, 1),
        (181, 180, -90, 1),
        (541, 270, -135, 0.5),
        (640, 240, -120, 0.375),
        (360, 360, -180, 1),
        (11, 100, -50, 10),
    ],
)
def test_a_field_of_view_is_spread_as_sensors_have_it(
    write: Callable[..., Path], count: int, degrees: float, start: float, step: float
) -> None:
    (record,) = read(write(flaser([1.0] * count)), field_of_view=math.radians(degrees))
    assert record.scan is not None
    assert math.degrees(record.scan.angle_min) == pytest.approx(start)
    assert math.degrees(record.scan.angle_increment) == pytest.approx(step)


@pytest.mark.parametrize("wrong", [180.0, 0.0, -1.0, math.nan])
def test_a_field_of_view_in_degrees_is_refused(write: Callable[..., Path], wrong: float) -> None:
    with pytest.raises(LogError, match="radians"):
        open_log(write(drive()), field_of_view=wrong)


def test_odometry_of_the_robot_becomes_that_of_the_laser(write: Callable[..., Path]) -> None:
    records = read(write(drive(odometry=lambda i: (1.1 * i, 0, math.pi / 2))))
    assert records[2].odometry == Pose2D(2.2, 0, math.pi / 2)
    assert records[2].T_base_laser is None
    header = "PARAM robot_frontlaser_offset 0.3 host 0\n"
    records = read(write(header + drive(odometry=lambda i: (1.1 * i, 0, math.pi / 2))))
    assert records[2].odometry is not None
    assert records[2].odometry.distance(Pose2D(2.2, 0.3)) < 1e-9
    assert records[2].pose == Pose2D(2.0)
    assert records[2].T_base_laser == Pose2D(0.3)


def test_a_rear_laser_looks_backwards(write: Callable[..., Path]) -> None:
    header = "PARAM robot_rearlaser_offset -0.2 host 0\n"
    text = "".join(
        flaser([2.0 + i] * 181, (i, 0, math.pi), (1.5 * i, 0, 0), i, "RLASER") for i in range(3)
    )
    records = read(write(header + text))
    assert records[1].odometry is not None
    assert records[1].odometry.distance(Pose2D(1.3)) < 1e-9
    assert records[1].odometry.turn(Pose2D(theta=math.pi)) < 1e-9


def test_a_trajectory_written_twice_is_poses_and_no_odometry(write: Callable[..., Path]) -> None:
    path = write(drive(odometry=lambda i: (1.0 * i, 0.0, 0.0)))
    records = read(path)
    assert [record.pose for record in records] == [Pose2D(i) for i in range(6)]
    assert all(record.odometry is None for record in records)
    raw = read(path, pose_columns="odometry")
    assert [record.odometry for record in raw] == [Pose2D(i) for i in range(6)]
    assert all(record.pose is None for record in raw)


@pytest.mark.parametrize("damaged", [0, 99])
def test_one_damaged_number_does_not_make_odometry(
    write: Callable[..., Path], damaged: int
) -> None:
    path = write(drive(200, odometry=lambda i: (i + 5.0 * (i == damaged), 0.0, 0.0)))
    assert all(record.odometry is None for record in read(path))
    path = write(drive(200, odometry=lambda i: (i - 0.3 + 5.0 * (i == damaged), 0.0, 0.0)))
    (mounting,) = {record.T_base_laser for record in read(path)}
    assert mounting is not None
    assert mounting.distance(Pose2D(0.3)) < 1e-9


def test_columns_that_nobody_filled_in_are_not_poses(write: Callable[..., Path]) -> None:
    zero = read(write(drive(pose=lambda _: (0, 0, 0))))
    assert all(record.pose is None and record.odometry is not None for record in zero)
    stuck = read(write(drive(pose=lambda _: (3, 4, 1))))
    assert all(record.pose is None and record.odometry is not None for record in stuck)
    nothing = read(write(drive(pose=lambda _: (3, 4, 1), odometry=lambda _: (3, 4, 1))))
    assert all(record.pose is None and record.odometry is None for record in nothing)


def test_a_robot_that_stands_still_has_a_pose(write: Callable[..., Path]) -> None:
    text = flaser([2.0] * 181, (3, 4, 1), (0, 0, 0)) * 5
    assert [record.pose for record in read(write(text))] == [Pose2D(3, 4, 1)] * 5


def test_times_that_are_all_zero_are_no_times(write: Callable[..., Path]) -> None:
    assert [r.stamp for r in read(write(flaser([1.0] * 181, stamp=0) * 2))] == [None, None]


def test_a_pose_that_is_no_number_is_no_pose_but_the_scan_counts(
    write: Callable[..., Path],
) -> None:
    log = open_log(write(drive(pose=lambda i: (math.nan if i == 1 else i, 0, 0))))
    records = list(log)
    assert records[1].pose is None
    assert records[1].scan is not None
    assert records[2].pose == Pose2D(2)
    assert [problem.line for problem in log.problems] == [2]


MALFORMED = {
    "promises more readings": "FLASER 181 1.0 2.0",
    "promises a billion readings": "FLASER 1000000000 1.0 2.0",
    "promises more digits than a number has": "FLASER " + "9" * 10000 + " 1.0",
    "counts one reading too many": flaser([1.0] * 181).replace("181", "182", 1),
    "counts one reading too few": flaser([1.0] * 181).replace("181", "180", 1),
    "a word among the readings": flaser(["abc", *[1.0] * 180]),
    "thousands with a separator": flaser(["1_0", *[1.0] * 180]),
    "a word among the poses": flaser([1.0] * 181).replace("0.9", "x"),
    "no number": "FLASER",
    "a negative number": "FLASER -5 1 2 3",
    "an underscore": "FLASER 1_0 1 2 3",
    "no readings": flaser([]),
    "one reading": flaser([1.0]),
    "an unknown number of readings": flaser([1.0] * 777),
    "a tail without host": flaser([1.0] * 181).rsplit(maxsplit=2)[0],
    "an empty robotlaser": "ROBOTLASER1",
    "a robotlaser that promises remissions": "ROBOTLASER1 0 0 1 0.1 80 0 0 2 1 1 99 1 2 3",
}
# A log all of whose lines end with the time is read.
GOOD_ALONE = {"a tail without host"}


@pytest.mark.parametrize("what", MALFORMED)
def test_a_malformed_scan_line_is_counted_and_the_others_stay(
    write: Callable[..., Path], what: str
) -> None:
    line = MALFORMED[what].strip() + "\n"
    text = drive(2) + line + drive(2)
    log = open_log(write(text))
    records = list(log)
    assert [record.index for record in records] == [0, 1, 2, 3, 4]
    assert [record.scan is None for record in records] == [False, False, True, False, False]
    assert records[2].problem
    assert "\n" not in records[2].problem
    assert len(records[2].problem) < 150
    assert [problem.line for problem in log.problems] == [3]
    assert log.problem_count == 1
    if what in GOOD_ALONE:
        return
    # Alone it leaves nothing, which is an error that names the line.
    with pytest.raises(LogError, match=r"a\.log:1: no readable laser scan: ") as raised:
        open_log(write(line))
    assert raised.value.line == 1


def test_a_short_first_line_does_not_spoil_the_others(write: Callable[..., Path]) -> None:
    lines = drive(5).splitlines(keepends=True)
    lines[0] = lines[0].rsplit(maxsplit=3)[0] + "\n"
    log = open_log(write("".join(lines)))
    assert [record.scan is None for record in log] == [True, *[False] * 4]


def test_other_lines_are_skipped_and_garbage_is_reported(write: Callable[..., Path]) -> None:
    noise = "SYNC start\nNEFF 30\nODOM 1\nPARAM\nPARAM a\n# no\nfoo bar\nWHATEVER 1\nWHATEVER 2\n"
    log = open_log(write(b"# caf\xe9\n" + drive(1).encode() + noise.encode() + b"\x00\xff\xfe\n"))
    assert len(list(log)) == 1
    assert [problem.line for problem in log.problems] == [9, 10, 12]
    assert "WHATEVER" in str(log.problems[1])


def test_a_line_without_end_is_not_kept_in_memory(write: Callable[..., Path]) -> None:
    log = open_log(write(drive(1) + "FLASER 181 " + "1.0 " * 3_000_000 + "\n" + drive(1)))
    records = list(log)
    assert len(records) == 2
    assert log.problems[0].line == 2
    assert "too long" in log.problems[0].reason


def test_problems_beyond_a_thousand_are_counted_but_not_kept(write: Callable[..., Path]) -> None:
    log = open_log(write(drive(1) + "FLASER 7\n" * 1500))
    assert len(list(log)) == 1501
    assert len(log.problems) == 1000
    assert log.problem_count == 1500


def test_every_iteration_starts_anew(write: Callable[..., Path]) -> None:
    log = open_log(write(drive(3) + "FLASER 7\n"))
    first, second = iter(log), iter(log)
    assert next(first).index == next(second).index == 0
    assert [record.index for record in log] == [0, 1, 2, 3]
    assert log.problem_count == 1
    assert next(first).index == 1


def test_a_gzip_that_is_cut_off_keeps_what_came_before(write: Callable[..., Path]) -> None:
    text = "".join(
        flaser(np.random.default_rng(i).uniform(1, 9, 181).round(2), (i, 0, 0)) for i in range(300)
    )
    data = gzip.compress(text.encode())
    log = open_log(write(data[: len(data) // 2], "a.log.gz"))
    records = list(log)
    assert 50 < len(records) < 250
    assert all(record.scan is not None for record in records)
    assert len(log.problems) == 1
    assert log.problems[0].line == len(records) + 1
    assert "cut off" in log.problems[0].reason


def test_a_plain_log_that_is_cut_off_loses_the_last_scan_only(write: Callable[..., Path]) -> None:
    text = drive(4)
    end = len(text) - 1
    # Wherever the last line is cut before its time is complete, its scan does not count.
    for cut in (900, 700, 60, 30, 17, 14, 12):
        records = read(write(text[: end - cut]))
        assert [record.scan is None for record in records] == [False] * 3 + [True], cut


UNREADABLE = {
    "an empty file": (b"", "empty"),
    "blank lines": (b"\n \r\n", "empty"),
    "an empty gzip": (gzip.compress(b""), "empty"),
    "binary garbage": (bytes(np.random.default_rng(0).integers(0, 256, 50_000, np.uint8)), ""),
    "prose": (b"Dear diary,\ntoday I drove.\n", "not a recording"),
    "the beginning of a gzip": (gzip.compress(drive().encode())[:12], "cannot be read"),
    "a gzip in name only": (b"\x1f\x8b" + b"xyz" * 50, "cannot be read"),
    "a zip in name only": (b"PK\x03\x04" + b"xyz" * 50, "cannot be read"),
    "comments": (b"# nothing\n# here\n", "not a recording"),
    "no scans": (b"ODOM 1 2 3 0 0 0 0 host 0\nPARAM a b c 0\n", "no laser scan"),
}


@pytest.mark.parametrize("what", UNREADABLE)
def test_a_file_without_scans_is_one_clear_line(write: Callable[..., Path], what: str) -> None:
    data, words = UNREADABLE[what]
    path = write(data)
    with pytest.raises(LogError) as raised:
        open_log(path)
    message = str(raised.value)
    assert message.startswith(str(path))
    assert words in message
    assert "\n" not in message
    assert len(message) < len(str(path)) + 200


def test_missing_files_folders_and_crowded_archives_are_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such file"):
        open_log(tmp_path / "none.log")
    with pytest.raises(LogError, match="folder without a recording"):
        open_log(tmp_path)
    with pytest.raises(LogError, match="cannot be read"):
        open_log("a\0b")
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as archive:
        archive.writestr("a.log", drive())
        archive.writestr("b.log", drive())
        archive.writestr("__MACOSX/._a.log", b"")
    with pytest.raises(LogError, match=r"holds several files \(a.log, b.log\)"):
        open_log(tmp_path / "two.zip")


def test_a_byte_order_mark_does_not_hide_the_first_line(write: Callable[..., Path]) -> None:
    log = open_log(write(b"\xef\xbb\xbf" + drive(2).encode()))
    assert len(list(log)) == 2
    assert log.problems == ()
