"""The benchmark with methods whose answers are known, and on simulated buildings."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from anchorscan import benchmark
from anchorscan.benchmark import (
    Drive,
    Estimate,
    Method,
    default_logs,
    measure,
    preset_methods,
    read_drives,
    run,
    tasks,
)
from anchorscan.building import random_building
from anchorscan.errors import AnchorscanError, MissingExtraError
from anchorscan.pose import Pose2D
from anchorscan.protocol import Answer
from anchorscan.record import Record
from anchorscan.scan import LaserScan
from anchorscan.scoreboard import POOLED, Score, Scoreboard, compared, pooled
from anchorscan.sensor import SensorModel
from anchorscan.settings import Settings
from anchorscan.simulator import simulate

SENSOR = SensorModel(resolution=math.radians(2.0))


def drive(name, *, laps=2, offset=0.0, building=None, recording=None, length=14.0):
    """There and back along a line, so that every way back revisits; scans that tell the place."""
    way = np.arange(0.0, length, 0.5)
    poses = []
    for lap in range(laps):
        poses += [Pose2D(x + offset, 0.0, 0.0) for x in (way if lap % 2 == 0 else way[::-1])]
    records = tuple(
        Record(i, LaserScan(np.full(5, 1.0 + pose.x), 0.0, 0.1), pose)
        for i, pose in enumerate(poses)
    )
    return Drive(name, records, building or name, recording or name)


def telling(answer):
    """A method that knows the place by the ranges, and lets ``answer`` make of it what it will."""

    def prepare(references):
        return lambda scan: answer(Pose2D(float(scan.ranges[0]) - 1.0, 0.0, 0.0))

    return prepare


RIGHT = Method("right", telling(lambda pose: [Estimate(pose, 0.9, accepted=True)]))
SILENT = Method("silent", telling(lambda pose: []))
FAR = Method(
    "far", telling(lambda pose: [Estimate(Pose2D(pose.x + 3.0), 0.9)]), calibrated=False, queries=4
)


def test_measure_asks_every_method_every_query_it_takes_part_in():
    task = next(task for task in tasks([drive("a")]) if task.protocol == "P1")
    absent = replace(RIGHT, name="absent", protocols=("P4",))
    right, silent, far = measure(task, [RIGHT, SILENT, absent, FAR])
    assert [answer.query for answer in right.answers] == list(task.split.queries)
    assert right.figures.top_1 == 1.0
    assert silent.figures.silent == len(task.split.queries)
    assert len(far.answers) == 4
    assert {a.query for a in far.answers} <= {a.query for a in right.answers}
    assert far.figures.top_1 == 0.0
    assert math.isnan(far.figures.calibration_error)


def test_fewer_queries_are_a_part_of_all_and_the_same_for_the_same_seed():
    task = tasks([drive("a", laps=6)])[0]
    asked = [
        tuple(a.query for a in measure(task, [RIGHT], 7, seed)[0].answers) for seed in (0, 0, 3)
    ]
    assert len(asked[0]) == 7
    assert asked[0] == asked[1]
    assert set(asked[0]) | set(asked[2]) <= set(task.split.queries)


def test_every_query_gets_a_fresh_scan():
    seen = []

    def prepare(references):
        def locate(scan):
            seen.append("points" in vars(scan))
            return [Estimate(Pose2D(), float(len(scan.points)))]

        return locate

    task = tasks([drive("a")])[0]
    measure(task, [Method("first", prepare), Method("second", prepare)])
    assert not any(seen)


def test_unknown_places_have_no_truth():
    task = next(t for t in tasks([drive("a"), drive("b")]) if t.protocol == "P4")
    (score,) = measure(task, [RIGHT])
    assert score.figures.correct == 0
    assert score.figures.wrong == len(task.asked.records)


def places_of(made):
    return {(task.protocol, task.place) for task in made}


def test_two_sessions_are_measured_against_each_other_only():
    drives = [drive("a"), drive("w1", building="w"), drive("w2", building="w")]
    assert places_of(tasks(drives)) == {
        ("P1", "a"),
        ("P2", "a"),
        ("P3", "w1 -> w2"),
        ("P4", "a -> w1"),
        ("P4", "w1 -> a"),
    }


def test_one_recording_published_twice_is_no_second_session():
    drives = [drive("x"), drive("x-dense", building="x", recording="x")]
    assert places_of(tasks(drives, ["P3", "P4"])) == set()
    assert places_of(tasks(drives, ["P1"])) == {("P1", "x"), ("P1", "x-dense")}


def test_splits_without_a_query_are_left_out():
    assert tasks([drive("once", laps=1)], ["P1", "P2"]) == []


def test_a_number_of_candidates_that_is_the_presets_own_is_measured_once():
    settings = Settings.preset("paper")
    own = settings.database.candidates
    methods = preset_methods({"paper": settings}, [None, 1, own, "all", 7])
    assert [method.name for method in methods] == [
        "paper",
        "paper, 1 candidate",
        "paper, all",
        "paper, 7 candidates",
    ]
    named = preset_methods({"paper": settings}, [own])
    assert [method.name for method in named] == [f"paper, {own} candidates"]


def answer(query, x, probability=0.9, seconds=0.001):
    return Answer(query, Pose2D(x), Pose2D(), probability, True, seconds)


def test_comparison_counts_the_same_queries_only():
    ours = Score("P1", "a", "ours", 3, tuple(answer(q, x) for q, x in ((1, 0), (2, 9), (3, 0))))
    theirs = Score(
        "P1",
        "a",
        "theirs",
        3,
        tuple(answer(q, x, seconds=0.1) for q, x in ((2, 0), (3, 0), (4, 0))),
        calibrated=False,
    )
    elsewhere = replace(ours, place="b")
    one, total = compared([ours, theirs, elsewhere], "theirs")
    assert (one.queries, one.baseline_correct, one.share) == (2, 2, 0.5)
    assert one.time_ratio == pytest.approx(100.0)
    assert (total.place, total.share) == ("all of these", 0.5)


def test_pooling_sums_queries_under_one_threshold():
    first = Score("P1", "a", "m", 3, (answer(1, 0, 0.9), answer(2, 9, 0.8)))
    second = Score("P3", "b", "m", 4, (answer(1, 0, 0.7), answer(2, 0, 0.85)))
    (both,) = pooled([first, second])
    assert (both.protocol, both.references) == (POOLED, 7)
    assert both.figures.queries == 4
    # One threshold: the wrong answer at 0.8 withholds the right one at 0.7.
    assert both.figures.recall_at_full_precision == 0.5


def board():
    drives = [drive("a"), drive("b")]
    scores = [score for task in tasks(drives) for score in measure(task, [RIGHT, SILENT, FAR], 12)]
    alone = [score for score in scores if score.protocol == "P1"]
    return Scoreboard(
        (*scores, *pooled(alone)),
        tuple(compared(alone, "far")),
        (),
        {"anchorscan": "1", "arguments": {"seed": 0}},
        {"default": '{"database": {}}'},
    )


def test_tables_hold_every_method_and_log():
    text = "\n".join(board().lines())
    for word in ("right", "silent", "far", "P1 revisit", "P2 sparse", "P4 unknown", POOLED):
        assert word in text
    assert "…" not in text


def test_files_can_be_read_back_and_agree(tmp_path):
    kept = board()
    files = kept.write(tmp_path / "new" / "folder")
    assert sorted(path.name for path in files) == [
        "answers.csv",
        "figures.csv",
        "results.json",
        "settings-default.json",
    ]
    folder = files[0].parent
    results = json.loads((folder / "results.json").read_text())
    assert results["arguments"] == {"seed": 0}
    assert len(results["scores"]) == len(kept.scores)
    with (folder / "figures.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    for row, score in zip(rows, kept.scores, strict=True):
        assert int(row["queries"]) == len(score.answers)
        assert float(row["top_1"]) == pytest.approx(score.figures.top_1, rel=1e-5)
        assert (row["correct"] == "") == (not score.calibrated)
    with (folder / "answers.csv").open() as stream:
        answers = list(csv.DictReader(stream))
    assert len(answers) == sum(len(s.answers) for s in kept.scores if s.place != POOLED)
    silent = next(row for row in answers if row["method"] == "silent")
    assert silent["x"] == silent["probability"] == ""
    assert json.loads((folder / "settings-default.json").read_text()) == {"database": {}}


def test_pictures_are_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    files = board().draw(tmp_path)
    assert {path.name for path in files} == {
        "precision-recall-P1.png",
        "precision-recall-P2.png",
        "precision-recall-pooled.png",
        "reliability.png",
        "trade-off-P2.png",
    }
    for path in files:
        assert path.read_bytes().startswith(b"\x89PNG")


def carmen_log(path: Path, seed: int, laps: int = 2) -> Path:
    """A simulated drive there and back, as a CARMEN log."""
    world = random_building(seed)
    rng = np.random.default_rng(seed)
    y = float(np.mean(world.segments[:, [1, 3]]))
    way = np.arange(8.0, 24.0, 0.4)
    lines = ["PARAM laser_front_laser_resolution 1 nohost 0"]
    for lap in range(laps):
        for x in way if lap % 2 == 0 else way[::-1]:
            pose = Pose2D(x, y, 0.2)
            scan = simulate(world, pose, SensorModel(), rng)
            ranges = " ".join(f"{r:.2f}" for r in np.nan_to_num(scan.ranges, posinf=81.0))
            numbers = f"{x:.3f} {y:.3f} {pose.theta}"
            lines.append(f"FLASER {len(scan)} {ranges} {numbers} {numbers} {x} host {x}")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_run_measures_presets_and_baselines_on_logs(tmp_path):
    logs = [carmen_log(tmp_path / f"{name}.log", seed) for name, seed in (("a", 3), ("b", 4))]
    said: list[str] = []
    seen: list[str] = []

    def progress(items, what, total=None):
        seen.append(what)
        return items

    found = run(
        logs,
        presets=["paper"],
        protocols=["P1", "P4"],
        candidates=["all"],
        output_folder=tmp_path / "out",
        queries=8,
        baselines=["exhaustive"],
        baseline_queries=3,
        say=said.append,
        progress=progress,
    )
    methods = {(score.protocol, score.method) for score in found.scores}
    assert methods == {
        ("P1", "paper, all"),
        ("P1", "exhaustive"),
        ("P1", "exhaustive, margin"),
        ("P4", "paper, all"),
        (POOLED, "paper, all"),
        (POOLED, "exhaustive"),
        (POOLED, "exhaustive, margin"),
    }
    exhaustive = next(s for s in found.scores if s.place == POOLED and s.method == "exhaustive")
    assert exhaustive.figures.queries == 6
    assert exhaustive.figures.top_1 > 0.8
    assert "P1 a: paper, all" in seen
    assert any("P1 revisit" in line for line in said)
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["arguments"]["queries"] == 8
    assert [log["name"] for log in results["logs"]] == ["a", "b"]
    assert all(len(log["sha256"]) == 64 for log in results["logs"])
    preset = Settings.from_json((tmp_path / "out" / "settings-paper.json").read_text())
    assert preset == Settings.preset("paper")
    for one in found.stages:
        assert one.stages["extraction"] > 0.0
        assert one.stages["rest"] >= 0.0


def test_answers_are_the_same_for_the_same_seed(tmp_path):
    log = carmen_log(tmp_path / "a.log", 3)

    def poses():
        found = run([log], ["paper"], ["P1"], [5], queries=5, seed=2, baselines=["exhaustive"])
        return [(s.method, a.query, a.pose, a.probability) for s in found.scores for a in s.answers]

    assert poses() == poses()


def test_run_refuses_what_it_does_not_know(tmp_path):
    log = carmen_log(tmp_path / "a.log", 3, laps=1)
    with pytest.raises(AnchorscanError, match="unknown protocol 'P9'"):
        run([log], protocols=["P9"])
    with pytest.raises(AnchorscanError, match="unknown baseline 'amcl'"):
        run([log], baselines=["amcl"])
    with pytest.raises(AnchorscanError, match="no split has a query"):
        run([log], protocols=["P1"], baselines=[])
    with pytest.raises(AnchorscanError, match="no such file"):
        run([tmp_path / "b.log"], baselines=[])


def test_karto_is_left_out_with_a_word_where_it_is_not_installed(monkeypatch):
    def missing(candidates):
        raise MissingExtraError("the Karto matcher", "bench")

    monkeypatch.setattr(benchmark, "KartoMatcher", missing)
    said: list[str] = []
    methods = benchmark._baseline_methods(["karto"], None, said.append)
    assert methods == []
    assert "anchorscan[bench]" in said[0]


def test_drives_can_be_read_as_a_laser_saw_them_that_sees_less_far(tmp_path):
    log = carmen_log(tmp_path / "lab.log", 3)
    (far,), (near,) = read_drives([log]), read_drives([log], 2.5)
    for record, shorter in zip(far.records, near.records, strict=True):
        ranges = record.scan.ranges
        seen = ranges[record.scan.is_return & (ranges < 2.5)]
        assert np.array_equal(shorter.scan.ranges[shorter.scan.is_return], seen)
    assert any(np.any(record.scan.ranges >= 2.5) for record in far.records)


def test_logs_are_named_without_their_endings(tmp_path):
    log = carmen_log(tmp_path / "lab.log", 3)
    other = carmen_log(tmp_path / "hall.log", 4)
    first, second = read_drives([log, f"lab={other}"])
    assert (first.name, first.building) == ("lab", "lab")
    assert (second.name, second.building) == ("hall", "lab")
    with pytest.raises(AnchorscanError, match="two logs are called lab"):
        read_drives([log, log])


def test_the_data_folder_is_searched_by_default(tmp_path, monkeypatch):
    for name in ("wean-3.log.gz", "intel-dense.log.gz", "orebro.log.gz", "README.md", "a.g2o"):
        (tmp_path / name).touch()
    monkeypatch.setenv("ANCHORSCAN_DATA", str(tmp_path))
    said: list[str] = []
    names = [path.name for path in default_logs(said.append)]
    assert names[:2] == ["a.g2o", "wean-3.log.gz"]
    assert set(names[2:]) <= {"killian.g2o.zip"}
    assert any("intel-dense is left out" in line for line in said)
    assert any("orebro is left out" in line for line in said)
    monkeypatch.setenv("ANCHORSCAN_DATA", str(tmp_path / "missing"))
    monkeypatch.setattr(benchmark.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(AnchorscanError, match="ANCHORSCAN_DATA"):
        default_logs()
