"""The examples that look into protocol P5 and at windows, run as a user would."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from as_a_user import write_log

from anchorscan import Pose2D, Record, drive, random_building

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
FIRST_PASS = 55.0


def lines(name: str, *words: object) -> list[str]:
    """What an example prints."""
    told = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *map(str, words)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert told.returncode == 0, told.stderr
    return told.stdout.splitlines()


def two_passes(apart: Pose2D) -> list[Record]:
    """Two drives through one building as one log, the poses of the second carried off."""
    building = random_building(5, length=24.0, depth=14.0)
    first = drive(building, seed=1, length=FIRST_PASS)
    second = drive(building, seed=2, length=25.0)
    moved = [
        replace(r, pose=apart @ r.pose, odometry=apart @ r.pose, stamp=(r.stamp or 0.0) + 1e4)
        for r in second
    ]
    return [*first, *moved]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "drive.log", two_passes(Pose2D()))


def test_where_a_log_disagrees_with_itself_is_told(tmp_path: Path) -> None:
    torn = write_log(tmp_path / "torn.log", two_passes(Pose2D(1.2, 0.0, 0.0)))
    told = lines("why_wrong.py", torn, "--condition", "noise", "--starts", 7)
    wrong = [line.split() for line in told[2:-1]]
    assert wrong
    for _, _, _, off, share, odds, share_beside, odds_beside in wrong:
        assert 0.9 < float(off) < 1.5
        assert float(share_beside) > float(share)
        assert float(odds_beside) > float(odds)


def test_nothing_is_told_of_journeys_that_were_right(log: Path) -> None:
    told = lines("why_wrong.py", log, "--condition", "noise", "--starts", 7)
    assert len(told) == 3
    assert int(told[2].split()[0]) >= 2


def test_places_that_have_neighbours_are_named_and_confident_ones_are_right(log: Path) -> None:
    (line,) = lines("places_without_poses.py", log, "--starts", 9, "--longest", 15)
    figures = re.match(
        r"(\d+) journeys, (\d+) steps: right ([\d.]+), single scans ([\d.]+); "
        r"confident (\d+), of them right ([\d.]+),",
        line,
    )
    assert figures is not None, line
    journeys, steps, right, alone, confident, of_them = (float(one) for one in figures.groups())
    assert journeys >= 2
    assert steps > 50
    assert min(right, alone) > 0.8
    assert confident > 0.3 * steps
    assert of_them > 0.95


def test_a_wider_view_is_asked_in_all_four_ways(log: Path) -> None:
    told = [line.split() for line in lines("wider_view.py", log)[1:]]
    assert [line[0] for line in told] == ["P1"] * 4 + ["halves"] * 4
    for line in told:
        number, top, accepted, wrong = (int(word) for word in line[-5:-1])
        assert number > 10
        assert top >= 0.8 * number
        assert wrong <= 0.05 * accepted


def test_where_a_building_stands_twice_hardly_anything_is_answered(log: Path) -> None:
    told = [line.split() for line in lines("equal_places.py", log, "--queries", 20)[1:]]
    rows = {float(width): list(map(int, counts)) for width, *counts, _ in told}
    assert list(rows) == [0.0, 0.005, 0.012, 0.018]
    loosest, shipped = rows[0.0], rows[0.012]
    asked, alone, doubled, ambiguous, both = shipped
    assert asked >= 15
    assert alone >= 10
    assert doubled <= 0.2 * loosest[1]
    assert doubled < loosest[2]
    assert ambiguous >= 0.8 * loosest[1]
    assert both >= 0.9 * ambiguous
    assert 0.0 < float(told[2][-1]) < 0.05
