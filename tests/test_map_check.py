"""Located in a map: through the command line, in simulated buildings and in a real map."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from anchorscan import (
    LaserScan,
    Pose2D,
    Record,
    ReferenceSet,
    SensorModel,
    drive,
    load_map,
    random_building,
    stitch,
    write_map,
)
from anchorscan.cli import main
from anchorscan.map_check import check, draw, rigid_track, table
from anchorscan.plausibility import ScaleCheck, scale_check
from anchorscan.simulator import move_furniture, noisy_odometry, random_poses, turn_doors

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command as a user types it; give exit code, stdout and stderr."""

    def command(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["anchorscan", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        written = capsys.readouterr()
        return int(ended.value.code or 0), written.out, written.err

    return command


@pytest.fixture(scope="module")
def office(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Record]]:
    """A map drawn by one robot, and the drive of another after people have moved things."""
    pytest.importorskip("yaml", reason="maps need the extra 'maps'")
    building = random_building(8, length=30.0, depth=18.0)
    lidar = SensorModel(2.0 * math.pi, math.radians(0.5), range_max=12.0, noise=0.015)
    mapping = drive(building, lidar, seed=3, length=220.0, step=0.5)
    path = tmp_path_factory.mktemp("map") / "office.yaml"
    write_map(stitch(mapping, 0.05), path)
    changed = turn_doors(move_furniture(building, 5, share=0.3), 6, share=0.2)
    other = SensorModel(
        math.radians(270.0), math.radians(1.0), mounting=Pose2D(0.2, 0.05, math.radians(90.0))
    )
    return path, drive(changed, other, seed=4, length=40.0, step=0.8, odometry_noise=0.01)


def test_a_set_is_built_from_a_map_and_real_scans_are_found_in_it(
    run: Run, office: tuple[Path, list[Record]], tmp_path: Path
) -> None:
    map_file, records = office
    code, out, err = run("build", map_file, "-o", tmp_path / "office.apr")
    assert (code, out) == (0, "")
    assert "references" in err
    right = wrong = 0
    with ReferenceSet.open(tmp_path / "office.apr") as places:
        for record in records:
            assert record.scan is not None
            assert record.pose is not None
            best = places.locate(record.scan)[0]
            assert best.pose is not None
            is_right = _is_right(best.pose, record.pose)
            right += is_right
            wrong += best.accepted and not is_right
    assert right >= 0.9 * len(records)
    assert wrong == 0


def test_the_sensor_of_a_map_is_told_by_options(
    run: Run, office: tuple[Path, list[Record]], tmp_path: Path
) -> None:
    map_file, _ = office
    target = tmp_path / "half.apr"
    options = ("--field-of-view", 180, "--range-max", 8, "--spacing", 3, "--heading", 120)
    assert run("build", map_file, "-o", target, *options)[0] == 0
    with ReferenceSet.open(target) as places:
        scans = [reference.scan for reference in places.references]
        poses = [reference.pose for reference in places.references]
    assert {(len(scan), scan.range_max) for scan in scans} == {(361, 8.0)}
    assert np.allclose([scan.field_of_view for scan in scans], math.pi)
    # Three headings at every place, and places at least the spacing apart.
    headings = {round(math.degrees(pose.theta)) for pose in poses if pose is not None}
    assert headings == {0, 120, -120}
    spots = np.unique([(p.x, p.y) for p in poses if p is not None], axis=0)
    assert len(spots) * 3 == len(poses)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("other.yaml",), "a map is built from alone"),
        (("--topic", "scan"), "a map is built from alone"),
        (("--poses", "truth.tum"), "a map is built from alone"),
        (("--spacing", 0), "must be positive"),
        (("--field-of-view", 400), "field of view"),
        (("--range-max", 0), "range limits"),
    ],
)
def test_what_a_map_cannot_have_is_refused(
    run: Run,
    office: tuple[Path, list[Record]],
    tmp_path: Path,
    words: tuple[object, ...],
    reason: str,
) -> None:
    code, _, err = run("build", office[0], *words, "-o", tmp_path / "office.apr")
    assert code in {1, 2}
    assert reason in " ".join(err.split())
    assert not (tmp_path / "office.apr").exists()


def test_a_map_check_counts_what_moves_as_the_odometry(
    run: Run, office: tuple[Path, list[Record]], tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib", reason="pictures need the extra 'plot'")
    map_file, records = office
    from anchorscan import load_map

    outcome = check(load_map(map_file), records)
    truly = [
        located.best is not None
        and located.best.pose is not None
        and record.pose is not None
        and _is_right(located.best.pose, record.pose)
        for located, record in zip(outcome.located, records, strict=True)
    ]
    _, on_track = outcome.track
    # Without truth it says nearly the same as with it; odometry drifts by a percent here.
    assert np.mean(on_track == np.array(truly)) >= 0.9
    assert f"{100.0 * outcome.consistent:.1f} %" in "\n".join(table(outcome))
    draw(outcome).savefig(tmp_path / "check.png")
    assert (tmp_path / "check.png").stat().st_size > 10_000


def test_the_track_is_the_transform_that_most_answers_agree_with() -> None:
    rng = np.random.default_rng(1)
    T_map_odom = Pose2D(3.0, -7.0, 2.0)
    poses = random_poses(random_building(1), 60, 2)
    odometry: list[Pose2D | None] = list(noisy_odometry(poses[:40], 0.0, rng))
    right: list[Pose2D | None] = [T_map_odom @ at for at in odometry if at is not None]
    # Twenty wrong answers, one silent, one without odometry.
    odometry += noisy_odometry(poses[40:], 0.0, rng)
    wrong = [Pose2D(*rng.uniform(-50.0, 50.0, 2), rng.uniform(-3.0, 3.0)) for _ in range(20)]
    answers = [*right, *wrong]
    answers[3] = None
    odometry[5] = None
    found, agrees = rigid_track(answers, odometry)
    assert found is not None
    assert found.distance(T_map_odom) < 1e-9
    assert found.turn(T_map_odom) < 1e-9
    expected = np.arange(60) < 40
    expected[[3, 5]] = False
    assert (agrees == expected).all()


def test_without_odometry_there_is_no_track() -> None:
    found, agrees = rigid_track([Pose2D(), None], [None, Pose2D()])
    assert found is None
    assert not agrees.any()


def test_a_real_drive_is_located_in_a_real_map(
    run: Run, data_file: Callable[[str], Path], tmp_path: Path
) -> None:
    """Through the command line: a college floor, mapped by others on another day."""
    pytest.importorskip("yaml", reason="maps need the extra 'maps'")
    pytest.importorskip("rosbags", reason="recordings need the extra 'bags'")
    folder = data_file("olin")
    target, answers = tmp_path / "olin.apr", tmp_path / "answers.jsonl"
    assert run("build", folder / "mac_1st_floor_final.yaml", "-o", target)[0] == 0
    assert run("locate", target, folder, "-o", answers)[0] == 0
    lines = [json.loads(line) for line in answers.read_text(encoding="utf-8").splitlines()]
    from anchorscan import open_log

    odometry = [record.odometry for record in open_log(folder)]
    poses = [_best(line) for line in lines]
    known = np.array([at is not None for at in odometry])
    assert known.sum() >= 350
    _, agrees = rigid_track(poses, odometry)
    assert agrees[known].mean() >= 0.95
    accepted = np.array([line["accepted"] for line in lines])
    assert not (accepted & known & ~agrees).any()


def _best(line: dict[str, object]) -> Pose2D | None:
    hypotheses = line["hypotheses"]
    assert isinstance(hypotheses, list)
    if not hypotheses:
        return None
    return Pose2D(*(hypotheses[0][name] for name in ("x", "y", "theta")))


def _is_right(pose: Pose2D, truth: Pose2D) -> bool:
    return pose.distance(truth) <= 0.5 and pose.turn(truth) <= math.radians(10.0)


def test_a_scan_elsewhere_is_not_located_in_a_map(office: tuple[Path, list[Record]]) -> None:
    from anchorscan import load_map

    elsewhere = drive(random_building(99, length=30.0, depth=18.0), seed=5, length=12.0, step=1.0)
    outcome = check(load_map(office[0]), elsewhere)
    assert outcome.accepted.mean() <= 0.1
    assert isinstance(outcome.located[0].scan, LaserScan)


@pytest.mark.parametrize("scale", [0.8, 0.97, 1.03, 1.07])
def test_a_map_of_the_wrong_scale_is_named(
    office: tuple[Path, list[Record]], tmp_path: Path, scale: float
) -> None:
    """The resolution in its YAML is not that of the cells: nothing else tells."""
    grid = load_map(office[0])
    write_map(replace(grid, resolution=scale * grid.resolution), tmp_path / "other.yaml")
    found = check(load_map(tmp_path / "other.yaml"), office[1][::3]).scale
    assert found.is_scaled
    assert found.scale == pytest.approx(scale, abs=0.01)


def test_the_scale_is_said_where_it_is_wrong_and_only_there(
    office: tuple[Path, list[Record]],
) -> None:
    right = check(load_map(office[0]), office[1][::3])
    assert not any(line.startswith("scale:") for line in table(right))
    told = replace(right, scale=ScaleCheck(24, 1, 1.2, 20))
    (line,) = [line for line in table(told) if line.startswith("scale:")]
    assert "20 % too large" in line
    assert "is its resolution 0.0417 m, not 0.05 m?" in line


def test_a_drive_elsewhere_is_of_no_other_scale(office: tuple[Path, list[Record]]) -> None:
    """Each of many scales gives wrong answers a chance."""
    lidar = SensorModel(2.0 * math.pi, math.radians(1.0), range_max=12.0, noise=0.015)
    places = ReferenceSet.build(office[1], keep_all=True)
    elsewhere = drive(random_building(31, length=30.0, depth=18.0), lidar, length=40.0, step=1.5)
    found = scale_check(places, [each.scan for each in elsewhere if each.scan is not None])
    assert found.asked >= 20
    assert not found.is_scaled
