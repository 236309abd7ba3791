"""P5 as a command measures it, and Monte Carlo localization against plain twins."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scans import FULL_TURN, building

from anchorscan import AnchorscanError, Pose2D, Record, Reference, drive, random_building, simulate
from anchorscan.journey import Journey, independent, journeys, odometry
from anchorscan.lost_robot import Course, courses, run
from anchorscan.monte_carlo import MonteCarlo, _enough, _likelihood

seeds = st.integers(0, 2**32 - 1)


@dataclass(frozen=True)
class Driven:
    name: str
    records: tuple[Record, ...]
    building: str
    recording: str


def driven(name, seed, house=5, length=20.0, start=0.0, odometry=True):
    records = drive(random_building(house), seed=seed, length=length)
    if not odometry:
        records = [Record(r.index, r.scan, r.pose, None, r.stamp) for r in records]
    return Driven(name, tuple(records), str(house), name)


def test_drives_of_one_building_make_one_course_and_others_their_own():
    short = [driven(n, s, h, 1.0) for n, s, h in (("a", 1, 5), ("b", 2, 5), ("c", 3, 6))]
    made = courses(short)
    assert [(c.place, c.known.name, c.asked.name) for c in made] == [
        ("a -> b", "a", "b"),
        ("c", "c", "c"),
    ]


def test_a_journey_through_its_own_map_meets_no_scan_of_its_own_stretch():
    one = driven("a", 1, length=120.0)
    journey = journeys(one.records, longest=15.0)[3]
    apart = independent(one.records, journey, 20.0)
    along = dict(zip((r.index for r in one.records), metres(one.records), strict=True))
    first, last = (along[journey.positions[k]] for k in (0, -1))
    assert 0 < len(apart) < len(one.records)
    assert all(not first - 20.0 < along[r.index] < last + 20.0 for r in apart)
    references = Course("a", one, one).references(journey)
    assert {r.identifier for r in references} <= {r.index for r in apart}


def metres(records):
    steps = [a.pose.distance(b.pose) for a, b in pairwise(records)]
    return np.concatenate([[0.0], np.cumsum(steps)])


def test_a_journey_ends_after_its_metres():
    records = driven("a", 1, length=30.0).records
    journey = journeys(records, longest=5.0)[0]
    along = metres(records)
    assert along[journey.positions[-1]] <= 5.0 < along[journey.positions[-1] + 1]


def test_noise_is_the_same_for_a_seed_and_as_large_as_asked():
    records = driven("a", 1, length=60.0).records
    journey = Journey(tuple(range(len(records))))
    plain, noisy, again, other = (
        odometry(records, journey, noise, seed)
        for noise, seed in ((0.0, 0), (0.05, 0), (0.05, 0), (0.05, 1))
    )
    assert noisy == again != other
    length, longer = (
        sum(math.hypot(s.x, s.y) for s in (a.inverse() @ b for a, b in pairwise(told)))
        for told in (plain, noisy)
    )
    assert 0.002 < abs(longer / length - 1.0) < 0.2


def test_a_lost_robot_is_found_by_the_command_and_the_table_is_kept(tmp_path):
    said = []
    outcomes = run(
        [driven("known", 1, length=90.0), driven("asked", 2, length=25.0)],
        ("anchorscan",),
        starts=2,
        longest=20.0,
        output_folder=tmp_path,
        say=said.append,
    )
    by_condition = {one.condition: one.figures for one in outcomes}
    assert set(by_condition) >= {"recorded", "noise", "leaving"}
    assert by_condition["noise"].found == 1.0
    assert by_condition["noise"].was_wrong == 0.0
    assert "known -> asked" in "\n".join(said)
    # A robot that is sure is right: the last bin of the table of all steps.
    steps = [line for line in said if line.startswith("known -> asked") and " noise " in line][-1]
    reliability = next(one.reliability for one in outcomes if one.condition == "noise")
    assert steps.split()[-2:] == [str(reliability.counts[-1]), f"{reliability.accuracy[-1]:.2f}"]
    assert reliability.accuracy[-1] > 0.99
    kept = json.loads((tmp_path / "lost-robot.json").read_text())
    assert len(kept) == len(outcomes)
    assert kept[0]["reliability"]["counts"] == outcomes[0].reliability.counts.tolist()


def test_windows_are_measured_beside_single_scans():
    drives = [driven("known", 1, length=90.0), driven("asked", 2, length=25.0)]
    outcomes = run(drives, ("anchorscan", "window"), starts=2, longest=20.0)
    by_follower = {(one.follower, one.condition): one for one in outcomes}
    for name in ("anchorscan", "window"):
        one = by_follower[name, "recorded"]
        assert one.figures.found == 1.0
        assert one.figures.was_wrong == 0.0
    single, window = (by_follower[name, "recorded"] for name in ("anchorscan", "window"))
    assert window.reliability.error != single.reliability.error


def test_a_place_that_is_visited_once_has_no_course():
    with pytest.raises(AnchorscanError, match="no journey starts within a map"):
        run([driven("a", 1, length=5.0)], ("anchorscan",))
    with pytest.raises(AnchorscanError, match="unknown method 'ekf'"):
        run([], ("ekf",))


# Monte Carlo localization


@given(seed=seeds)
def test_likelihood_is_one_and_the_cubes_of_all_beams(seed):
    rng = np.random.default_rng(seed)
    field = rng.uniform(0.0, 0.5, (8, 9)).astype(np.float32)
    poses = np.column_stack([rng.uniform(-1, 3, (5, 2)), rng.uniform(-3, 3, 5)])
    beams, frame = rng.uniform(-2, 2, (6, 2)), np.array([-0.3, 0.2, 0.25])
    wanted = []
    for pose in poses:
        total = 1.0
        for x, y in (Pose2D(*pose).apply(beams) - frame[:2]) / frame[2]:
            inside = 0.0 <= x < 8 and 0.0 <= y < 7
            total += (float(field[int(y), int(x)] if inside else field[7, 8]) + 0.5 / 80.0) ** 3
        wanted.append(total)
    assert np.allclose(_likelihood(poses, beams, field, frame), wanted)


@given(seed=seeds, size=st.floats(0.05, 20.0))
def test_as_many_particles_are_taken_as_their_cells_ask_for(seed, size):
    rng = np.random.default_rng(seed)
    poses = rng.normal(0.0, size, (2000, 3))
    cells = np.array([0.5, 0.5, 0.2])
    count = _enough(poses, cells, 0.05, 2.33, 50)
    turned = poses.copy()
    turned[:, 2] %= 2.0 * math.pi

    def need(taken):
        bins = len({tuple(cell) for cell in np.floor(turned[:taken] / cells).astype(int).tolist()})
        if bins < 2:
            return 50
        a = 2.0 / (9.0 * (bins - 1))
        return max(50, math.ceil((bins - 1) / 0.1 * (1.0 - a + math.sqrt(a) * 2.33) ** 3))

    assert count == 2000 or count >= need(count)
    assert count == 50 or count - 1 < need(count - 1)


def test_particles_spread_everywhere_agree_in_the_end_on_the_right_place():
    world, at = building(1)
    rng = np.random.default_rng(0)
    references = [Reference(k, simulate(world, p, FULL_TURN, rng), p) for k, p in enumerate(at)]
    records = drive(world, seed=4, length=30.0)
    amcl = MonteCarlo(references, particles=6000)
    reports = [amcl.update(r.scan, r.odometry) for r in records]
    assert not reports[0].accepted
    assert reports[-1].pose.distance(records[-1].pose) < 1.0
    amcl.reset()
    assert [amcl.update(r.scan, r.odometry).pose for r in records[:5]] == [
        b.pose for b in reports[:5]
    ]
