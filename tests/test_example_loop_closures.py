"""The example of loop closures: a drifting drive becomes a map."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from as_a_user import write_log

from anchorscan import Pose2D, Record, drive, random_building

pytest.importorskip("gtsam", reason="the pose graph is in the extra 'slam'")
pytest.importorskip("matplotlib", reason="pictures are in the extra 'plot'")

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "loop_closures.py"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("loop_closures", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    import sys

    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def records() -> list[Record]:
    building = random_building(5, length=24.0, depth=14.0)
    return drive(building, seed=3, length=70.0, odometry_noise=0.08)


def test_the_map_is_far_better_than_the_odometry(
    example: ModuleType,
    records: list[Record],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = write_log(tmp_path / "drive.log", records)
    assert example.main([str(log), "-o", str(tmp_path / "new")]) == 0
    out = capsys.readouterr().out
    figures = {
        line[:27].strip(): [float(word) for word in line[28:].split()]
        for line in out.splitlines()
        if line.startswith(("raw odometry", "matched with", "with loop"))
    }
    raw, closed = figures["raw odometry"], figures["with loop closures"]
    assert raw[0] > 0.5
    assert closed[0] < 0.1
    assert closed[0] < figures["matched with the one before"][0]
    closures, right = (int(word) for word in out.split(" keyframes, ")[1].split() if word.isdigit())
    assert closures > 20
    assert right >= 0.97 * closures
    assert (tmp_path / "new" / "loop-closures.png").read_bytes().startswith(b"\x89PNG")


def test_errors_do_not_depend_on_where_the_drive_began(
    example: ModuleType, records: list[Record]
) -> None:
    frames = example.keyframes(records)
    moved = [Pose2D(3.0, -7.0, 2.0) @ frame.pose for frame in frames]
    assert example.errors(moved, frames).max() < 1e-9
    bent = [Pose2D(p.x, p.y + 0.1 * math.sin(n), p.theta) for n, p in enumerate(moved)]
    assert 0.05 < np.sqrt(np.mean(example.errors(bent, frames) ** 2)) < 0.1


def test_the_deviations_are_those_along_the_scan_itself(example: ModuleType) -> None:
    from anchorscan import Hypothesis

    # A corridor along the map's y axis, the robot looks along it: x of the scan is uncertain.
    covariance = np.diag([0.0004, 4.0, 0.0001])
    pose = Pose2D(1.0, 2.0, math.pi / 2)
    along, across, _ = example.deviations(
        Hypothesis(0, pose, pose, covariance, 0.9, 0.5, 0.9, 0.9, True)
    )
    assert along == pytest.approx(2.0, rel=0.01)
    assert across < 0.05


def test_a_log_without_odometry_is_refused_in_one_line(
    example: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    still = [
        record
        for record in drive(random_building(5, length=24.0, depth=14.0), seed=3, length=1.0)[:1]
    ]
    log = write_log(tmp_path / "still.log", still)
    assert example.main([str(log), "-o", str(tmp_path)]) == 1
    assert "no odometry" in capsys.readouterr().err
