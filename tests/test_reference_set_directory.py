"""The plain directory: what is exported comes back, and what is malformed is named."""

from __future__ import annotations

import csv
import io
import json
import math
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from anchorscan import LaserScan, Pose2D, ReferenceSet, ReferenceSetError, Settings


@pytest.fixture
def places() -> ReferenceSet:
    made = ReferenceSet(name="büro", settings=Settings().changed({"database": {"candidates": 3}}))
    rng = np.random.default_rng(0)
    ranges = rng.uniform(0, 9, (4, 60)).astype(np.float32)
    ranges[0, :3] = math.inf, -math.inf, math.nan
    made.add(LaserScan(ranges[0], -0.1, 0.05), Pose2D(1 / 3, -2e-17, 3.0), 'a "quoted", name')
    made.add(LaserScan(ranges[1], 0.1, -0.05, 0.05, math.inf), None, "two\nlines\r\n")
    made.add(LaserScan(ranges[2], -0.1, 0.05), Pose2D(1e300, 0, 0))
    made.add(LaserScan(np.empty(0), 0.0, 0.0))
    made.add(LaserScan(ranges[3], -0.1, 0.05))
    made.remove(1 + 1)
    made.remove(4)
    return made


@pytest.fixture
def directory(places: ReferenceSet, tmp_path: Path) -> Path:
    places.export_directory(tmp_path / "plain")
    return tmp_path / "plain"


def test_anybody_can_read_it_with_csv_and_numpy_alone(
    places: ReferenceSet, directory: Path
) -> None:
    with (directory / "references.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["identifier"]) for row in rows] == [0, 1, 3]
    assert [row["name"] for row in rows] == [r.name for r in places.references]
    first = places[0]
    assert first.pose is not None
    assert [float(rows[0][key]) for key in ("x", "y", "theta")] == first.pose.to_array().tolist()
    assert rows[1]["x"] == rows[1]["y"] == rows[1]["theta"] == ""
    for row in rows:
        ranges = np.load(directory / "scans" / f"{int(row['identifier']):06d}.npy")
        assert ranges.dtype == np.float32
        np.testing.assert_array_equal(ranges, places[int(row["identifier"])].scan.ranges)


def test_it_comes_back_as_it_was(places: ReferenceSet, directory: Path) -> None:
    back = ReferenceSet.import_directory(directory)
    assert (back.name, back.settings) == (places.name, places.settings)
    assert back.info() == places.info()
    for one, other in zip(back.references, places.references, strict=True):
        assert one.scan.ranges.tobytes() == other.scan.ranges.tobytes()
        assert (one.identifier, one.pose, one.name) == (other.identifier, other.pose, other.name)
    assert back.add(places[0].scan) == 5  # 4 was removed, and is never used again


def test_other_settings_take_the_place_of_those_in_it(directory: Path, tmp_path: Path) -> None:
    ReferenceSet.import_directory(directory, settings=Settings(), path=tmp_path / "a.apr").close()
    assert ReferenceSet.open(tmp_path / "a.apr").settings == Settings()


def test_one_made_by_hand_needs_only_the_table_and_the_scans(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    np.save(tmp_path / "scans" / "000007.npy", np.array([1, 2, 3]))
    (tmp_path / "references.csv").write_text(
        "name,identifier,x,y,theta,angle_min,angle_increment,range_min,range_max,remark\n"
        "desk,7,1,2,0,-1.5,0.5,0,30,mine\n"
    )
    places = ReferenceSet.import_directory(tmp_path)
    assert places[7].pose == Pose2D(1, 2, 0)
    assert places[7].name == "desk"
    assert places[7].scan.ranges.tolist() == [1, 2, 3]
    assert places.settings == Settings.preset("default")


def test_what_is_there_already_stays(places: ReferenceSet, directory: Path) -> None:
    before = sorted(path.name for path in directory.rglob("*"))
    with pytest.raises(ReferenceSetError, match="exists already"):
        places.export_directory(directory)
    with pytest.raises(ReferenceSetError, match="exists already"):
        places.export_directory(directory / "set.json")
    with pytest.raises(ReferenceSetError, match="cannot be written"):
        places.export_directory(directory / "no" / "where")
    assert sorted(path.name for path in directory.rglob("*")) == before


def test_an_empty_directory_is_filled(places: ReferenceSet, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    places.export_directory(tmp_path / "empty")
    assert len(ReferenceSet.import_directory(tmp_path / "empty")) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(directory: Path) -> None:
        text = (directory / name).read_text(encoding="utf-8")
        assert old in text
        (directory / name).write_text(text.replace(old, new, 1), encoding="utf-8")

    return change


def scan_file(content: bytes | np.ndarray) -> Callable[[Path], None]:
    def change(directory: Path) -> None:
        path = directory / "scans" / "000000.npy"
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            np.save(path, content)

    return change


def claims(shape: str) -> bytes:
    """A ``.npy`` file that says it holds more than it does."""
    file = io.BytesIO()
    np.save(file, np.zeros(10, np.float32))
    return file.getvalue().replace(
        b"(10,), }" + b" " * len(shape), f"{shape}, }}".encode() + b" " * 5
    )


TABLE, DESCRIPTION = "references.csv", "set.json"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (edit(TABLE, "identifier,x,", "number,x,"), r"csv:1: there is no column identifier"),
        (edit(TABLE, "0,0.3333", "zero,0.3333"), r"csv:2: 'zero' is not an identifier"),
        (edit(TABLE, "0,0.3333", "../../x,0.3333"), r"csv:2: '../../x' is not an identifier"),
        (edit(TABLE, "0,0.3333", "-1,0.3333"), r"csv:2: '-1' is not an identifier"),
        (edit(TABLE, "0,0.3333", "17,0.3333"), r"csv:2: there is no .*000017\.npy"),
        (edit(TABLE, "0,0.3333", "3,0.3333"), r"two references have the identifier 3"),
        (edit(TABLE, "0,0.3333", "0,north"), r"csv:2: could not convert .*'north"),
        (edit(TABLE, "0,0.3333", "0,nan,0.3333"), r"csv:2: "),
        (edit(TABLE, "0,0.3333", "0,inf"), r"csv:2: .*not"),
        (edit(TABLE, "-2e-17,3.0", ","), r"csv:2: "),
        (edit(TABLE, "0.05", "0"), r"csv:2: angle_increment must not be zero"),
        (lambda d: (d / TABLE).write_bytes(b"\xff\xfe\x00\x01"), r"plain: .*decode"),
        (lambda d: (d / TABLE).write_text(""), r"csv:1: there is no column"),
        (lambda d: (d / TABLE).unlink(), r"No such file .*references\.csv"),
        (lambda d: (d / DESCRIPTION).write_text("{"), r"set\.json: is not JSON"),
        (lambda d: (d / DESCRIPTION).write_text("[" * 100_000), r"set\.json: is not JSON"),
        (lambda d: (d / DESCRIPTION).write_text("[]"), r"set\.json: must hold a JSON object"),
        (lambda d: (d / DESCRIPTION).write_text('{"name": 1}'), r"set\.json: the name"),
        (lambda d: (d / DESCRIPTION).write_text('{"settings": 1}'), r"set\.json: the settings"),
        (lambda d: (d / DESCRIPTION).write_text('{"next_identifier": -1}'), r"next_identifier"),
        (edit(DESCRIPTION, "büro", "b" * 5000), r"set\.json: a name has at most"),
        (scan_file(b""), r"csv:2: .*000000\.npy cannot be read"),
        (scan_file(b"PK\x03\x04" + bytes(100)), r"csv:2: .*000000\.npy cannot be read"),
        (scan_file(pickle.dumps([1, 2])), r"csv:2: .*000000\.npy cannot be read"),
        (scan_file(np.array([None, 1], dtype=object)), r"csv:2: .*000000\.npy cannot be read"),
        (scan_file(np.array(["a"])), r"csv:2: .*does not hold ranges"),
        (scan_file(claims("(10000000000000,").replace(b"}", b"(")), r"csv:2: .*cannot be read"),
        (scan_file(np.zeros((2, 2))), r"csv:2: .*does not hold ranges"),
        (scan_file(np.zeros(3, complex)), r"csv:2: .*does not hold ranges"),
        (scan_file(np.zeros((1 << 20) + 1, np.float32)), r"csv:2: .*more than 1048576 readings"),
        (scan_file(claims("(10000000000000,)")), r"csv:2: .*000000\.npy cannot be read"),
    ],
)
def test_what_is_malformed_is_named_in_one_line(
    change: Callable[[Path], None], words: str, directory: Path
) -> None:
    change(directory)
    with pytest.raises(ReferenceSetError, match=words) as error:
        ReferenceSet.import_directory(directory)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(str(directory))


def test_what_is_no_directory_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "nothing"):
        with pytest.raises(ReferenceSetError, match="is not a directory"):
            ReferenceSet.import_directory(path)


def test_settings_stay_readable(directory: Path) -> None:
    stored = json.loads((directory / "set.json").read_text(encoding="utf-8"))
    assert stored["settings"]["database"]["candidates"] == 3
    assert (stored["name"], stored["next_identifier"]) == ("büro", 5)
