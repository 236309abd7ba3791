"""The belief over places: a Bayes filter whose sums are right, and robots that are found."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anchorscan import LaserScan, Matcher, Reference, TopologicalLocalizer, drive, random_building
from anchorscan.protocol import choose_references
from anchorscan.topological_localizer import PlaceBeliefSettings, left, told

SETTINGS = PlaceBeliefSettings()
BLIND = LaserScan(np.full(181, np.inf), -math.pi / 2, math.pi / 180)
seeds = st.integers(0, 2**32 - 1)


def some_belief(rng, count):
    belief = rng.uniform(0.0, 1.0, count + 1)
    return belief / belief.sum()


def some_pairs(rng, count):
    pairs = {tuple(sorted(rng.choice(count, 2, replace=False).tolist())) for _ in range(count)}
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


@given(seed=seeds, driven=st.floats(0.0, 10.0))
def test_driving_on_is_the_transition_written_out_place_by_place(seed, driven):
    rng = np.random.default_rng(seed)
    belief, pairs = some_belief(rng, 6), some_pairs(rng, 6)
    wanted = np.zeros(7)
    away, back = (min(r * driven, 0.5) for r in (SETTINGS.carried_away, SETTINGS.back))
    for k in range(6):
        beside = [b if a == k else a for a, b in pairs.tolist() if k in (a, b)]
        leaves = (1.0 - math.exp(-driven / SETTINGS.spacing)) if beside else 0.0
        wanted[k] += (1.0 - away) * (1.0 - leaves) * belief[k] + back * belief[-1] / 6
        for other in beside:
            wanted[other] += (1.0 - away) * leaves * belief[k] / len(beside)
        wanted[-1] += away * belief[k]
    wanted[-1] += (1.0 - back) * belief[-1]
    after = left(belief, pairs, driven, SETTINGS)
    assert np.allclose(after, wanted)
    assert after.sum() == pytest.approx(1.0)


@given(seed=seeds, share=st.floats(0.0, 1.0))
def test_a_scan_weighs_by_bayes_rule_and_says_nothing_without_a_share(seed, share):
    rng = np.random.default_rng(seed)
    belief, fits = some_belief(rng, 5), rng.uniform(0.0, 1.0, 5)
    after = told(belief, fits, share, SETTINGS)
    assert after.sum() == pytest.approx(1.0)
    better = int(np.argmax(fits))
    assert after[better] / after[:-1].sum() >= belief[better] / belief[:-1].sum() - 1e-9
    assert np.allclose(told(belief, fits, 0.0, SETTINGS), belief)


@pytest.fixture(scope="module")
def world():
    """References without poses, their poses kept apart, and an independent drive."""
    known = drive(random_building(5), seed=1, length=60.0)
    asked = drive(random_building(5), seed=2, length=12.0, odometry_noise=0.05)[::2]
    chosen = choose_references(known)
    where = {n: known[position].pose for n, position in enumerate(chosen)}
    places = Matcher(Reference(n, known[p].scan) for n, p in enumerate(chosen))
    return places, where, asked


def test_places_without_poses_are_told_apart_on_the_move(world):
    places, where, asked = world
    pairs = [(a, b) for a in where for b in where if a < b and where[a].distance(where[b]) < 3.0]
    localizer = TopologicalLocalizer(places, pairs)
    right, sure = [], []
    for record in asked:
        mapped = any(
            p.distance(record.pose) < 2.0 and p.turn(record.pose) < 0.8 for p in where.values()
        )
        belief = localizer.update(record.scan, record.odometry, record.stamp)
        assert belief.probabilities.sum() + belief.elsewhere == pytest.approx(1.0)
        if mapped:
            near = where[belief.reference].distance(record.pose) < 3.0
            right.append(near)
            if belief.accepted:
                sure.append(near)
    assert np.mean(right[2:]) > 0.7
    assert np.mean(sure) > 0.9


def test_the_same_scans_give_the_same_belief_and_a_reset_forgets(world):
    places, _, asked = world
    localizer = TopologicalLocalizer(places)
    first = [localizer.update(r.scan, r.odometry, r.stamp).probabilities for r in asked[:4]]
    localizer.reset()
    again = [localizer.update(r.scan, r.odometry, r.stamp).probabilities for r in asked[:4]]
    assert all(np.array_equal(one, other) for one, other in zip(first, again, strict=True))


def test_nothing_to_see_and_nowhere_to_be(world):
    places, _, asked = world
    blind = TopologicalLocalizer(places).update(BLIND)
    assert not blind.accepted
    assert blind.elsewhere == pytest.approx(0.5, abs=0.1)
    nowhere = TopologicalLocalizer(Matcher()).update(asked[0].scan)
    assert (nowhere.reference, nowhere.elsewhere, nowhere.accepted) == (None, 1.0, False)


def test_a_neighbour_that_is_no_reference_is_named(world):
    with pytest.raises(ValueError, match="neighbour 999 is not among"):
        TopologicalLocalizer(world[0], [(0, 999)])
