"""The command line as a user meets it: what goes in, what comes out, and where."""

from __future__ import annotations

import gzip
import json
import math
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import typer

from anchorscan import (
    LaserScan,
    Pose2D,
    Record,
    Settings,
    __version__,
    drive,
    random_building,
    write_tum,
)
from anchorscan.cli import main
from anchorscan.reference_set import ReferenceSet

HYPOTHESIS_KEYS = {
    *("reference", "x", "y", "theta", "covariance", "evaluation", "quality", "probability"),
}


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str

    @property
    def lines(self) -> list[dict[str, Any]]:
        return [json.loads(line, parse_constant=_no_constant) for line in self.out.splitlines()]

    @property
    def messages(self) -> list[str]:
        """What was said besides what was guessed about the log."""
        return [line for line in self.err.splitlines() if not line.startswith("note: ")]


def _no_constant(name: str) -> float:
    raise AssertionError(f"{name} is no JSON")


Run = Callable[..., Outcome]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command line in this process and give exit code, stdout and stderr."""

    def run_it(*words: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["anchorscan", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capsys.readouterr()
        return Outcome(int(ended.value.code or 0), out, err)

    return run_it


def command(*words: object) -> list[str]:
    start = "from anchorscan.cli import main; main()"
    return [sys.executable, "-c", start, *map(str, words)]


def flaser(record: Record) -> str:
    """Write a record as a line of a CARMEN log."""
    assert record.scan is not None
    ranges = [f"{value:.3f}" if math.isfinite(value) else "90" for value in record.scan.ranges]
    pose = "0 0 0" if record.pose is None else " ".join(map(str, record.pose.to_array()))
    stamp = record.stamp or 0.0
    return f"FLASER {len(ranges)} {' '.join(ranges)} {pose} {pose} {stamp} robot {stamp}\n"


def write_log(path: Path, records: Iterable[Record]) -> Path:
    path.write_text("".join(flaser(record) for record in records), encoding="ascii")
    return path


@pytest.fixture(scope="module")
def records() -> list[Record]:
    return drive(random_building(3), seed=4, length=25.0, step=0.5)


@pytest.fixture(scope="module")
def log(records: list[Record], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("logs") / "drive.log", records)


@pytest.fixture(scope="module")
def places(records: list[Record], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sets") / "drive.apr"
    ReferenceSet.build(records, keep_all=True, path=path).close()
    return path


# What is promised


def test_a_log_becomes_a_set_and_its_scans_find_their_places(
    run: Run, log: Path, records: list[Record], tmp_path: Path
) -> None:
    built = run("build", log, "-o", tmp_path / "places.apr", "--all")
    assert (built.code, built.out) == (0, "")
    assert f"{len(records)} references" in built.err

    located = run("locate", tmp_path / "places.apr", log, "--candidates", "all")
    assert located.code == 0
    assert [line["scan"] for line in located.lines] == list(range(len(records)))
    right = 0
    for line, record in zip(located.lines, records, strict=True):
        assert record.pose is not None
        assert {"scan", "stamp", "seconds", "accepted", "state", "hypotheses"} <= line.keys()
        assert line["stamp"] == pytest.approx(record.stamp)
        assert 0.0 < line["seconds"] < 60.0
        assert all(each.keys() >= HYPOTHESIS_KEYS for each in line["hypotheses"])
        assert line["state"] == ("located" if line["accepted"] else "unknown")
        best = line["hypotheses"][0]
        assert all(0.0 <= best[name] <= 1.0 for name in ("evaluation", "probability"))
        covariance = best["covariance"]
        assert [len(row) for row in covariance] == [3, 3, 3]
        found = Pose2D(best["x"], best["y"], best["theta"])
        right += found.distance(record.pose) < 0.5 and found.turn(record.pose) < math.radians(10)
    assert right >= 0.95 * len(records)


def test_results_go_to_a_file_as_they_go_to_stdout(
    run: Run, log: Path, places: Path, tmp_path: Path
) -> None:
    printed = run("locate", places, log)
    written = run("locate", places, log, "-o", tmp_path / "out.jsonl")
    assert (written.code, written.out) == (0, "")
    file = Outcome(0, (tmp_path / "out.jsonl").read_text(encoding="utf-8"), "")
    assert without_time(file.lines) == without_time(printed.lines)
    assert [path.name for path in tmp_path.iterdir()] == ["out.jsonl"]


def test_a_drive_is_tracked_from_nothing(
    run: Run, log: Path, places: Path, records: list[Record], tmp_path: Path
) -> None:
    output, tum = tmp_path / "track.jsonl", tmp_path / "track.tum"
    done = run("track", places, log, "-o", output, "--tum", tum)
    assert done.code == 0
    lines = [json.loads(line) for line in output.read_text(encoding="utf-8").splitlines()]
    assert [line["scan"] for line in lines] == [record.index for record in records]
    last, truth = lines[-1], records[-1].pose
    assert last["accepted"]
    assert truth is not None
    assert math.hypot(last["x"] - truth.x, last["y"] - truth.y) < 0.5
    assert [len(row) for row in last["covariance"]] == [3, 3, 3]
    assert 0.9 < last["probability"] <= 1.0
    # A line for every confident pose, and for no other: seconds, metres, a quaternion about z.
    poses = [[float(value) for value in line.split()] for line in tum.read_text().splitlines()]
    sure = [line for line in lines if line["accepted"]]
    assert 0 < len(sure) == len(poses)
    assert f"{len(sure)} poses" in done.err
    for line, (stamp, x, y, z, qx, qy, qz, qw) in zip(sure, poses, strict=True):
        assert stamp == pytest.approx(line["stamp"])
        assert (x, y) == pytest.approx((line["x"], line["y"]))
        assert (z, qx, qy) == (0.0, 0.0, 0.0)
        assert Pose2D(0.0, 0.0, 2.0 * math.atan2(qz, qw)).turn(Pose2D(theta=line["theta"])) < 1e-6


def test_what_a_robot_cannot_be_followed_in_is_refused_with_what_to_do(
    run: Run, log: Path, places: Path, records: list[Record], tmp_path: Path
) -> None:
    done = run("track", places, log, "--preset", "paper")
    assert (done.code, done.out) == (1, "")
    assert "use those of the preset default" in done.err.splitlines()[-1]
    with ReferenceSet(path=tmp_path / "poseless.apr") as poseless:
        for record in records[:2]:
            assert record.scan is not None
            poseless.add(record.scan)
    done = run("track", tmp_path / "poseless.apr", log)
    assert (done.code, done.out) == (1, "")
    assert "poseless.apr has no poses" in done.err.splitlines()[-1]


def test_a_window_of_scans_tracks_as_well(
    run: Run, log: Path, places: Path, records: list[Record]
) -> None:
    lines = run("track", places, log, "--window", "4").lines
    assert len(lines) == len(records)
    assert lines[-1]["accepted"]
    assert all(
        Pose2D(line["x"], line["y"]).distance(Pose2D(record.pose.x, record.pose.y)) < 0.5
        for line, record in zip(lines, records, strict=True)
        if line["accepted"] and record.pose is not None
    )


def test_processes_share_the_work_and_change_nothing(log: Path, places: Path) -> None:
    # In processes of their own: pytest's captured streams do not survive a spawn.
    outcomes = []
    for count in ("1", "all"):
        done = subprocess.run(
            command("locate", places, log, "--processes", count),
            capture_output=True,
            text=True,
            check=True,
        )
        outcomes.append(without_time(Outcome(0, done.stdout, "").lines))
    assert outcomes[0] == outcomes[1]


def without_time(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{**line, "seconds": 0.0} for line in lines]


def test_candidates_say_how_many_references_are_aligned(run: Run, log: Path, places: Path) -> None:
    for line in run("locate", places, log, "--preset", "paper", "--candidates", "1").lines:
        assert len({each["reference"] for each in line["hypotheses"]}) <= 1


def test_spacing_and_heading_thin_the_references(run: Run, log: Path, tmp_path: Path) -> None:
    run("build", log, "-o", tmp_path / "wide.apr", "--spacing", "5", "--heading", "180")
    run("build", log, "-o", tmp_path / "tight.apr", "--spacing", "1", "--heading", "20")
    wide, tight = (ReferenceSet.open(tmp_path / name) for name in ("wide.apr", "tight.apr"))
    assert 1 <= len(wide) < len(tight)
    poses = [reference.pose for reference in wide.references]
    for number, pose in enumerate(poses):
        assert pose is not None
        assert all(other and pose.distance(other) > 5.0 for other in poses[:number])


def test_several_logs_make_one_set(run: Run, records: list[Record], tmp_path: Path) -> None:
    half = len(records) // 2
    first = write_log(tmp_path / "1.log", records[:half])
    second = write_log(tmp_path / "2.log", records[half:])
    assert run("build", first, second, "-o", tmp_path / "both.apr", "--all").code == 0
    assert len(ReferenceSet.open(tmp_path / "both.apr")) == len(records)


def test_each_of_several_logs_is_doubted(run: Run, records: list[Record], tmp_path: Path) -> None:
    far = [
        replace(each, pose=None if each.pose is None else replace(each.pose, x=1e3 * each.pose.x))
        for each in records
    ]
    logs = [write_log(tmp_path / "a.log", records), write_log(tmp_path / "b.log", far)]
    built = run("build", *logs, "-o", tmp_path / "ab.apr")
    (warning,) = [line for line in built.messages if line.startswith("warning: ")]
    assert warning.startswith(f"warning: {logs[1]}: poses jump by ")


def test_a_later_log_is_added_and_references_are_removed(run: Run, tmp_path: Path) -> None:
    building = random_building(5, length=24.0, depth=14.0)
    first = write_log(tmp_path / "1.log", drive(building, seed=3, length=20.0))
    later = drive(building, seed=2, length=20.0)
    second, places = write_log(tmp_path / "2.log", later), tmp_path / "a.apr"
    assert run("build", first, "-o", places, "--spacing", 1).code == 0
    before = len(ReferenceSet.open(places))
    done = run("add", places, second)
    assert done.code == 0
    after = len(ReferenceSet.open(places))
    assert f"{after - before} references added from {len(later)} scans" in done.err
    assert after > before
    assert "0 references added" in run("add", places, second).err

    missing = run("remove", places, 2, 9999, 3)
    assert missing.code == 1
    assert "has no reference 9999" in missing.err
    assert len(ReferenceSet.open(places)) == after
    assert run("remove", places, 2, 3, 2).code == 0
    left = ReferenceSet.open(places)
    assert len(left) == after - 2
    assert 2 not in left


@pytest.mark.parametrize("moved", [Pose2D(0.0, 0.0, math.pi / 2.0), Pose2D(3.0, -2.0, 0.0)])
def test_a_log_of_another_frame_is_not_added(run: Run, tmp_path: Path, moved: Pose2D) -> None:
    building = random_building(5, length=24.0, depth=14.0)
    places = tmp_path / "a.apr"
    ReferenceSet.build(drive(building, seed=3, length=60.0), path=places).close()
    before = places.read_bytes()
    later = [
        replace(record, pose=moved @ record.pose)
        for record in drive(building, seed=2, length=10.0)
        if record.pose is not None
    ]
    refused = run("add", places, write_log(tmp_path / "turned.log", later))
    assert refused.code == 1
    assert "its poses are in another frame" in refused.err
    assert "Traceback" not in refused.err
    assert places.read_bytes() == before


def test_info_says_what_a_set_holds(run: Run, places: Path, records: list[Record]) -> None:
    facts = json.loads(run("info", places, "--json").out)
    assert facts["references"] == facts["with_pose"] == len(records)
    assert facts["sensors"][0]["readings"] == 181
    x = [record.pose.x for record in records if record.pose]
    assert facts["bounds"][0] == pytest.approx(min(x))
    words = run("info", places)
    assert words.code == 0
    assert f"references:  {len(records)}\n" in words.out
    assert "181 readings over 180 degrees" in words.out


def test_an_index_is_written_when_asked_for_and_info_says_how_it_is(
    run: Run, records: list[Record], tmp_path: Path
) -> None:
    log, places = write_log(tmp_path / "drive.log", records), tmp_path / "indexed.apr"
    assert run("build", log, "-o", places).code == 0
    assert not (tmp_path / "indexed.apr.index").exists()  # a small set has none by itself
    assert json.loads(run("info", places, "--json").out)["index"] is None
    before = [line["hypotheses"] for line in run("locate", places, log).lines]
    assert "indexed.apr.index: " in run("build", log, "-o", places, "--index").err
    assert json.loads(run("info", places, "--json").out)["index"]["state"] == "current"
    assert [line["hypotheses"] for line in run("locate", places, log).lines] == before
    (tmp_path / "indexed.apr.index").write_bytes(b"something else")
    assert "outdated or damaged, not used" in run("info", places).out
    assert [line["hypotheses"] for line in run("locate", places, log).lines] == before
    assert run("index", places).code == 0
    assert "current" in run("info", places).out


def test_field_of_view_and_range_max_reach_the_scans(
    run: Run, records: list[Record], tmp_path: Path
) -> None:
    log = write_log(tmp_path / "drive.log", records)
    places = tmp_path / "narrow.apr"
    run("build", log, "-o", places, "--field-of-view", "90", "--range-max", "4")
    scan = ReferenceSet.open(places).references[0].scan
    assert math.degrees(scan.field_of_view) == pytest.approx(90.0)
    assert scan.range_max == pytest.approx(4.0)
    assert scan.is_free.any()


def test_poses_can_come_from_a_file_beside_the_log(
    run: Run, records: list[Record], tmp_path: Path
) -> None:
    raw = write_log(tmp_path / "raw.log", [replace(record, pose=None) for record in records])
    poses = tmp_path / "poses.txt"
    T_base_laser = Pose2D(0.2, 0.0, math.pi)
    write_tum(
        poses,
        [
            (record.stamp, record.pose @ T_base_laser.inverse())
            for record in records
            if record.pose is not None and record.stamp is not None
        ],
    )
    words = ("--poses", poses, "--laser", "0.2,0,180", "--all")
    assert run("build", raw, "-o", tmp_path / "posed.apr", *words).code == 0
    references = ReferenceSet.open(tmp_path / "posed.apr").references
    assert len(references) == len(records)
    for reference, record in zip(references, records, strict=True):
        assert reference.pose is not None
        assert record.pose is not None
        assert reference.pose.distance(record.pose) < 1e-3
        assert reference.pose.turn(record.pose) < 1e-3


def test_settings_come_from_a_preset_or_a_file(
    run: Run, log: Path, places: Path, tmp_path: Path
) -> None:
    file = tmp_path / "settings.json"
    one = Settings.preset("paper").changed({"database": {"candidates": 1}})
    file.write_text(one.to_json(), encoding="utf-8")
    for line in run("locate", places, log, "--settings", file).lines:
        assert len({each["reference"] for each in line["hypotheses"]}) <= 1
    paper = run("locate", places, log, "--preset", "paper")
    assert (paper.code, len(paper.lines)) == (0, len(run("locate", places, log).lines))
    run("build", log, "-o", tmp_path / "own.apr", "--settings", file)
    assert ReferenceSet.open(tmp_path / "own.apr").settings == one


def test_the_package_runs_as_a_module() -> None:
    words = [sys.executable, "-m", "anchorscan", "--version"]
    said = subprocess.run(words, capture_output=True, text=True, check=True)
    assert said.stdout == f"anchorscan {__version__}\n"


def test_version_and_help(run: Run) -> None:
    assert run("--version").out == f"anchorscan {__version__}\n"
    text = run("--help").out
    for name in ("build", "locate", "track", "explain", "info", "index", "bench", "check-map"):
        assert f"\n  {name} " in text
        assert run(name, "--help").code == 0


# Unusable scans: counted, given a reason, never a pose


@pytest.mark.parametrize(
    "ranges",
    [["nan"] * 181, ["inf"] * 181, ["0"] * 181, ["-1"] * 181, ["1e999"] * 181],
    ids=["nan", "inf", "zero", "negative", "overflow"],
)
def test_a_scan_without_any_return_gets_a_reason_and_no_pose(
    run: Run, places: Path, records: list[Record], tmp_path: Path, ranges: list[str]
) -> None:
    log = tmp_path / "mixed.log"
    broken = f"FLASER {len(ranges)} {' '.join(ranges)} 0 0 0 0 0 0 1 robot 1\n"
    log.write_text(flaser(records[0]) + broken + flaser(records[1]), encoding="ascii")
    located = run("locate", places, log)
    assert located.code == 0
    assert [line["scan"] for line in located.lines] == [0, 1, 2]
    assert [bool(line["hypotheses"]) for line in located.lines] == [True, False, True]
    assert located.lines[1]["accepted"] is False
    assert located.lines[1]["reason"]
    assert "1 unusable" in located.err


def test_a_scan_of_one_reading_gets_no_confident_pose(
    run: Run, places: Path, records: list[Record], tmp_path: Path
) -> None:
    log = tmp_path / "one.log"
    log.write_text(flaser(records[0]) + "FLASER 1 2.5 0 0 0 0 0 0 1 robot 1\n", encoding="ascii")
    located = run("locate", places, log)
    assert located.code == 0
    assert [line["scan"] for line in located.lines] == [0, 1]
    assert located.lines[1]["accepted"] is False
    assert "Traceback" not in located.err


def test_malformed_lines_are_summed_up_with_their_numbers(
    run: Run, places: Path, records: list[Record], tmp_path: Path
) -> None:
    log = tmp_path / "torn.log"
    good = [flaser(record) for record in records[:3]]
    torn = good[1][: len(good[1]) // 2] + "\n"
    log.write_text(good[0] + torn + good[1] + "FLASER many 1 2 3\n" + good[2], encoding="ascii")
    located = run("locate", places, log)
    assert located.code == 0
    assert len([line for line in located.lines if line["hypotheses"]]) == 3
    warning = next(line for line in located.err.splitlines() if line.startswith("warning: "))
    assert str(log) in warning
    assert "(2, 4)" in warning


# What cannot work: one line, exit code 1


def assert_one_line_error(outcome: Outcome, *words: object) -> None:
    assert outcome.code == 1, outcome
    assert outcome.out == ""
    (message,) = outcome.messages
    assert message.startswith("error: ")
    for word in words:
        assert str(word) in message


def bad_logs(folder: Path, good: str) -> dict[str, Path]:
    logs = {name: folder / f"{name}.log" for name in ("missing", "empty", "blank", "prose", "zip")}
    logs["empty"].touch()
    logs["blank"].write_text("\n" * 100, encoding="ascii")
    logs["prose"].write_text("It was a dark and stormy night.\n" * 50, encoding="ascii")
    logs["zip"].write_bytes(b"PK\x03\x04" + bytes(200))
    logs["directory"] = folder / "directory"
    logs["directory"].mkdir()
    logs["truncated"] = folder / "truncated.log.gz"
    logs["truncated"].write_bytes(gzip.compress(good.encode())[:15])
    logs["not gzip"] = folder / "noise.log.gz"
    logs["not gzip"].write_bytes(b"\x1f\x8b" + bytes(range(256)))
    logs["binary"] = folder / "binary.log"
    logs["binary"].write_bytes(bytes(range(256)) * 64)
    return logs


@pytest.mark.parametrize(
    "kind",
    [
        *("missing", "empty", "blank", "prose", "zip"),
        *("directory", "truncated", "not gzip", "binary"),
    ],
)
def test_an_unreadable_log_is_one_clear_line(
    run: Run, places: Path, records: list[Record], tmp_path: Path, kind: str
) -> None:
    log = bad_logs(tmp_path, flaser(records[0]))[kind]
    assert_one_line_error(run("locate", places, log), log)
    assert_one_line_error(run("build", log, "-o", tmp_path / "new.apr"), log)
    assert not (tmp_path / "new.apr").exists()


def test_a_truncated_log_gives_what_it_holds_and_says_so(
    run: Run, log: Path, places: Path, tmp_path: Path
) -> None:
    text = log.read_bytes() * 20
    whole = gzip.compress(text)
    cut = tmp_path / "cut.log.gz"
    cut.write_bytes(whole[: len(whole) // 2])
    located = run("locate", places, cut)
    assert located.code == 0
    assert 0 < len(located.lines) < text.count(b"\n")
    assert f"warning: {cut}: 1 malformed line" in located.err


def test_a_log_without_poses_makes_no_set(run: Run, records: list[Record], tmp_path: Path) -> None:
    log = tmp_path / "raw.log"
    nowhere = "nan nan nan"
    scans = "".join(
        flaser(Record(0, record.scan)).replace(" 0 0 0 0 0 0 ", f" {nowhere} {nowhere} ")
        for record in records[:5]
    )
    log.write_text(scans, encoding="ascii")
    outcome = run("build", log, "-o", tmp_path / "new.apr")
    assert_one_line_error(outcome, "pose")
    assert not (tmp_path / "new.apr").exists()


def bad_sets(folder: Path) -> dict[str, Path]:
    sets = {name: folder / f"{name}.apr" for name in ("missing", "empty", "text", "other")}
    sets["empty"].touch()
    sets["text"].write_text("not a set\n" * 100, encoding="ascii")
    with sqlite3.connect(sets["other"]) as connection:
        connection.execute("CREATE TABLE t (a)")
    connection.close()
    sets["directory"] = folder / "directory.apr"
    sets["directory"].mkdir()
    return sets


@pytest.mark.parametrize("kind", ["missing", "empty", "text", "other", "directory"])
def test_what_is_no_set_is_one_clear_line(run: Run, log: Path, tmp_path: Path, kind: str) -> None:
    path = bad_sets(tmp_path)[kind]
    assert_one_line_error(run("locate", path, log), path)
    assert_one_line_error(run("info", path), path)


def test_a_set_from_a_newer_version_is_left_alone(
    run: Run, log: Path, places: Path, tmp_path: Path
) -> None:
    newer = tmp_path / "newer.apr"
    newer.write_bytes(places.read_bytes())
    connection = sqlite3.connect(newer)
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    before = newer.read_bytes()
    for words in (("info", newer), ("locate", newer, log), ("build", log, "-o", newer)):
        assert_one_line_error(run(*words), newer, "newer", "upgrade")
    assert newer.read_bytes() == before


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b'{"database": {"candidate": 1}}', "candidates"),
        (b"not json", "JSON"),
        (b"\xff\xfe\x00", "JSON"),
        (None, "o such file"),
    ],
    ids=["unknown key", "prose", "binary", "missing"],
)
def test_settings_that_cannot_be_are_one_clear_line(
    run: Run, log: Path, places: Path, tmp_path: Path, content: bytes | None, word: str
) -> None:
    file = tmp_path / "settings.json"
    if content is not None:
        file.write_bytes(content)
    assert_one_line_error(run("locate", places, log, "--settings", file), file, word)


def test_what_was_meant_is_said(run: Run, log: Path, places: Path, tmp_path: Path) -> None:
    swapped = run("locate", log, places)
    assert_one_line_error(swapped, places, "is a reference set, not a log")
    image = tmp_path / "map.pgm"
    image.write_bytes(b"P5\n1 1\n255\n\0")
    assert_one_line_error(
        run("build", image, "-o", tmp_path / "a.apr"), image, "give the YAML file"
    )
    assert_one_line_error(run("check-map", image, log), image, "give the YAML file")
    assert_one_line_error(run("bench", log, "--protocol", "P9"), "P1, P2, P3, P4, P5")
    narrow = run("locate", places, log, "--field-of-view", "3.14")
    assert "--field-of-view 3.14 is very narrow" in narrow.messages[0]
    assert "3.14 radians are 180 degrees" in narrow.messages[0]
    followed = run("track", places, log)
    assert followed.messages[-1].startswith(f"{log}: located at ")


def test_an_output_that_cannot_be_written_is_one_clear_line(
    run: Run, log: Path, places: Path, tmp_path: Path
) -> None:
    target = tmp_path / "no" / "folder" / "out.jsonl"
    assert_one_line_error(run("locate", places, log, "-o", target), target)
    assert_one_line_error(run("build", log, "-o", tmp_path / "no" / "set.apr"), "folder")
    assert_one_line_error(run("locate", places, log, "-o", tmp_path), tmp_path)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("way", ["file", "stdout"])
def test_a_full_disk_is_one_clear_line(log: Path, places: Path, way: str) -> None:
    words = ("-o", "/dev/full") if way == "file" else ()
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command("locate", places, log, *words),
            stdout=full if way == "stdout" else subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert_one_line_error(Outcome(done.returncode, "", done.stderr), "No space left")


@pytest.mark.parametrize(
    "words",
    [
        ("locate", "SET", "LOG", "-o", "LOG"),
        ("locate", "SET", "LOG", "-o", "SET"),
        ("locate", "SET", "LOG", "-o", "LINK"),
        ("locate", "SET", "LOG", "--settings", "FILE", "-o", "FILE"),
        ("which", "SET", "LOG", "-o", "LOG"),
        ("which", "FOLDER", "LOG", "-o", "SET"),
        ("track", "SET", "LOG", "-o", "LOG"),
        ("track", "SET", "LOG", "--tum", "SET"),
        ("track", "SET", "LOG", "-o", "NEW", "--tum", "NEW"),
        ("build", "LOG", "-o", "LOG"),
        ("build", "LOG", "--poses", "FILE", "-o", "FILE"),
        ("report", "FILE", "-o", "FILE"),
        ("report", "FILE", "--set", "SET", "-o", "SET"),
        ("report", "FILE", "--log", "LOG", "-o", "LOG"),
        ("view", "SET", "LOG", "-o", "SET"),
    ],
    ids=" ".join,
)
def test_no_command_writes_over_what_it_reads(
    run: Run, log: Path, places: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    names = {"SET": "sets/a.apr", "LOG": "a.log", "LINK": "b.log", "FILE": "f", "NEW": "new"}
    files = {word: tmp_path / name for word, name in names.items()} | {"FOLDER": tmp_path / "sets"}
    files["FOLDER"].mkdir()
    files["SET"].write_bytes(places.read_bytes())
    files["LOG"].write_bytes(log.read_bytes())
    files["LINK"].symlink_to(files["LOG"])
    files["FILE"].write_text("{}")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    said = [files.get(word, word) for word in words]
    assert_one_line_error(run(*said), said[-1], "name another")
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


@pytest.mark.skipif(sys.platform == "win32", reason="closes streams as a POSIX shell does")
def test_a_stream_that_was_closed_is_no_mistake_of_ours(log: Path, places: Path) -> None:
    def closed(number: int, *words: object) -> Outcome:
        shell = ("sh", "-c", f'exec "$@" {number}>&-', "sh")
        done = subprocess.run(
            [*shell, *command(*words)], capture_output=True, text=True, check=False
        )
        return Outcome(done.returncode, done.stdout, done.stderr)

    assert_one_line_error(closed(1, "info", places), "Bad file descriptor")
    told = closed(2, "locate", places, log)
    assert (told.code, told.err) == (0, "")
    assert len(told.lines) == len(log.read_text(encoding="ascii").splitlines())
    assert closed(1, "locate", places, log, "-o", log.parent / "closed.jsonl").code == 0
    assert closed(0, "info", places).code == 0


@pytest.mark.skipif(not Path("/dev/stdout").exists(), reason="there is no /dev/stdout here")
def test_what_goes_to_stdout_by_name_is_appended_where_that_stands(
    log: Path, places: Path, tmp_path: Path
) -> None:
    kept = tmp_path / "kept.jsonl"
    kept.write_text("before\n")
    words = command("locate", places, log, "-o", "/dev/stdout")
    with kept.open("a") as stream:
        subprocess.run(words, stdout=stream, stderr=subprocess.DEVNULL, check=True)
        subprocess.run(["echo", "after"], stdout=stream, check=True)
    first, *lines, last = kept.read_text().splitlines()
    assert (first, last) == ("before", "after")
    assert len(lines) == len(log.read_text(encoding="ascii").splitlines())


# Commands that make no sense: exit code 2, nothing done


@pytest.mark.parametrize(
    "words",
    [
        ("locate", "SET", "LOG", "--candidates", "0"),
        ("locate", "SET", "LOG", "--candidates", "many"),
        ("locate", "SET", "LOG", "--processes", "0"),
        ("locate", "SET", "LOG", "--preset", "best"),
        ("locate", "SET", "LOG", "--preset", "paper", "--settings", "FILE"),
        ("locate", "SET"),
        ("build", "LOG"),
        ("build", "-o", "SET"),
        ("build", "LOG", "-o", "SET", "--spacing", "-1"),
        ("build", "LOG", "-o", "SET", "--heading", "far"),
        ("build", "LOG", "-o", "SET", "--laser", "1,2"),
        ("build", "LOG", "-o", "SET", "--poses-of", "cat"),
        ("fly",),
        ("info", "--loud", "SET"),
    ],
    ids=" ".join,
)
def test_a_command_that_makes_no_sense_has_exit_code_2(
    run: Run, log: Path, places: Path, words: tuple[str, ...]
) -> None:
    outcome = run(*[{"SET": places, "LOG": log}.get(word, word) for word in words])
    assert outcome.code == 2
    assert outcome.out == ""
    assert "Error" in outcome.err


# Interrupted


def test_an_interrupted_run_leaves_no_half_file(
    run: Run, log: Path, places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "out.jsonl"
    target.write_text("from an earlier run\n", encoding="ascii")
    locate, calls = ReferenceSet.locate, iter(range(3))

    def interrupted(self: ReferenceSet, scan: LaserScan, candidates: Any = None) -> Any:
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return locate(self, scan, candidates)

    monkeypatch.setattr(ReferenceSet, "locate", interrupted)
    outcome = run("locate", places, log, "-o", target)
    assert (outcome.code, outcome.out, outcome.messages) == (130, "", [])
    assert target.read_text(encoding="ascii") == "from an earlier run\n"
    assert [path.name for path in tmp_path.iterdir()] == ["out.jsonl"]


@pytest.mark.skipif(sys.platform == "win32", reason="signals are those of POSIX")
@pytest.mark.parametrize("processes", ["1", "2"])
def test_ctrl_c_ends_a_run_quietly(
    log: Path, places: Path, processes: str, request: pytest.FixtureRequest
) -> None:
    # Whoever starts the tests in the background lets them, and all they start, ignore it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    endless = log.parent / f"endless-{processes}.log"
    endless.write_text(log.read_text(encoding="ascii") * 200, encoding="ascii")
    words = ("locate", places, endless, "--processes", processes)
    with subprocess.Popen(
        command(*words),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        os.killpg(process.pid, signal.SIGINT)  # the terminal tells every process of the group
        _, err = process.communicate(timeout=300)
    assert (process.returncode, Outcome(130, "", err).messages) == (130, [])


@pytest.mark.skipif(sys.platform == "win32", reason="signals are those of POSIX")
def test_a_reader_that_has_seen_enough_is_no_error(log: Path, places: Path) -> None:
    with subprocess.Popen(
        command("locate", places, log), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["scan"] == 0
        process.stdout.close()
        assert process.stderr is not None
        err = process.stderr.read()
    assert (process.returncode, Outcome(141, "", err).messages) == (141, [])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes here")
def test_a_pipe_is_written_to_and_not_replaced(log: Path, places: Path, tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with subprocess.Popen(command("locate", places, log, "-o", pipe), stderr=subprocess.DEVNULL):
        lines = pipe.read_text(encoding="utf-8").splitlines()
    assert json.loads(lines[0])["scan"] == 0
    assert pipe.is_fifo()


def test_ctrl_c_while_a_kernel_is_loaded_is_no_error_of_ours() -> None:
    """Code in C that does not look for exceptions makes a SystemError of it."""
    from anchorscan.commands.console import guarded

    def interrupted() -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise SystemError("returned a result with an exception set") from error

    def broken() -> None:
        raise SystemError("something else")

    with pytest.raises(typer.Exit) as ended:
        guarded(interrupted)()
    assert ended.value.exit_code == 130
    with pytest.raises(SystemError, match="something else"):
        guarded(broken)()
