"""The sieves between proposals and fits against plain twins, and what they must find."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scans import FULL_TURN, WIDE, building, seeds, small_room

from anchorscan import Pose2D, Settings, simulate
from anchorscan.angle_function import AngleFunctionSettings, angle_function
from anchorscan.field import LikelihoodField
from anchorscan.proposal import on_large, spread
from anchorscan.rays import passed_through
from anchorscan.refinement import refined
from anchorscan.score import field_scores
from anchorscan.segments import is_small
from anchorscan.tiles import cell_code, room_for
from anchorscan.verification import (
    FEATURES,
    Fits,
    VerificationSettings,
    readings,
    verify,
    worth,
)
from anchorscan.verification import _distinct as distinct

FIELD = Settings.preset("default").field
WEIGHTS = FIELD.weights()
LIMITS = VerificationSettings()
SMALL = VerificationSettings(third_poses=6, fits=4, iterations=2, follow_iterations=2, rays=8)
EVERY = VerificationSettings(fit_margin=9.0)
SCORE, THROUGH = FEATURES.index("score"), FEATURES.index("through")
NOBODY = np.empty((0, 3))


@pytest.fixture(scope="module")
def mapped():
    """The map of a building, and scans of it with their poses."""
    world, at = building(2)
    rng = np.random.default_rng(0)
    known = [(simulate(world, pose, FULL_TURN, rng), pose) for pose in at]
    asked = [
        (simulate(world, there, WIDE, rng), there)
        for there in (pose @ Pose2D(0.2, -0.1, 0.4) for pose in at)
    ]
    return LikelihoodField(FIELD, known).tiles, asked


def around(pose, rng, count):
    """Poses near and far of one."""
    size = np.repeat([0.1, 0.4, 3.0], -(-count // 3))[:count, np.newaxis]
    return pose.to_array() + size * rng.normal(0.0, (1.0, 1.0, 0.3), (count, 3))


def mixed(scan):
    """The readings of a scan, every fifth as if on a small thing."""
    points = scan.points
    return np.column_stack((points, np.arange(len(points)) % 5 == 0))


# The twins.


def plain_codes(pose, points, tiles):
    cells = np.floor(Pose2D(*pose).apply(points) / tiles.resolution).astype(int)
    return [int(cell_code(tiles, cx - tiles.column, cy - tiles.row)) for cx, cy in cells.tolist()]


def plain_score(pose, readings, tiles):
    """The better of the world as it was, and of one in which small things are new, for a price."""
    codes = plain_codes(pose, readings[:, :2], tiles)
    scores = WEIGHTS.scores[codes]
    is_new = (readings[:, 2] > 0.0) & WEIGHTS.is_new[codes]
    if not is_new.any():
        return float(scores.mean())
    believed = scores[~is_new].sum() / np.where(is_new, WEIGHTS.share, 1.0).sum()
    return max(float(scores.mean()), 1.0 - WEIGHTS.price * (1.0 - believed))


def plain_features(pose, readings, tiles):
    """Shares by the names of ``FEATURES``, but for the rays."""
    codes = np.array(plain_codes(pose, readings[:, :2], tiles))
    distance = (codes & 63) / 63 * tiles.reach
    is_free = (codes & 64) > 0
    is_far = (codes & 63) == 63
    shares = {
        "score": [plain_score(pose, readings, tiles)],
        "near": distance <= 0.1,
        "close": distance <= 0.2,
        "free": is_far & is_free,
        "unknown": is_far & ~is_free,
        "through": [math.nan],
        "off": ~is_far & is_free & (distance > 0.2),
    }
    return [float(np.mean(shares[name])) for name in FEATURES]


def plain_worth(score, through):
    """What is unexplained counts by its logarithm, and what is seen through by its root."""
    return math.log(1.0 / max(1.0 - score, 0.005)) - through**0.5


def plain_distinct(poses, distance, turn, most):
    chosen = []
    for k, pose in enumerate(poses):
        ours = Pose2D(*pose)
        others = [Pose2D(*poses[j]) for j in chosen]
        if len(chosen) < most and all(
            ours.distance(other) >= distance or ours.turn(other) >= turn for other in others
        ):
            chosen.append(k)
    return chosen


def plain_best(poses, points, most, tiles):
    """Poses by their score with so many readings, best first, equals as they came."""
    few = spread(points, most)
    return sorted(poses.tolist(), key=lambda pose: -plain_score(pose, few, tiles))


def plain_verify(poses, points, tiles, limits):
    best = plain_best(poses, points, limits.second_readings, tiles)[: limits.third_poses]
    best = plain_best(np.array(best), points, limits.third_readings, tiles)
    apart = plain_distinct(best, limits.distinct_distance, limits.distinct_turn, limits.fits)
    scores = [plain_score(pose, spread(points, limits.third_readings), tiles) for pose in best]
    fits = []
    for nth, k in enumerate(apart):
        if nth >= 2 and scores[k] < scores[0] - limits.fit_margin:
            continue
        pose = refined(
            np.array(best[k]),
            room_for(spread(points, limits.fit_readings)),
            tiles,
            limits.iterations,
        )
        numbers = plain_features(pose, spread(points, limits.last_readings), tiles)
        rays = spread(points, limits.rays)
        numbers[THROUGH] = passed_through(pose, rays, tiles, limits.through_margin)
        fits.append((pose, numbers))
    fits.sort(key=lambda fit: -plain_worth(fit[1][SCORE], fit[1][THROUGH]))
    places = plain_distinct(
        [pose for pose, _ in fits], limits.place_distance, limits.place_turn, len(fits)
    )
    return [fits[k] for k in places]


def check_against_twin(poses, points, tiles, limits):
    fits = verify(poses, points, tiles, WEIGHTS, limits)
    expected = plain_verify(poses, points, tiles, limits)
    assert len(fits) == len(fits.hessians) == len(fits.residuals) == len(expected)
    for ours, (pose, _) in zip(fits.poses, expected, strict=True):
        np.testing.assert_allclose(ours[:2], pose[:2], atol=1e-9)
        assert Pose2D(*ours).turn(Pose2D(*pose)) < 1e-9
    np.testing.assert_allclose(fits.features, [numbers for _, numbers in expected], atol=1e-6)
    assert fits.readings == min(len(points), limits.last_readings)


@pytest.mark.interpreted
def test_a_few_poses_go_through_the_sieves_as_the_twins_say():
    scan, tiles = small_room(FIELD)
    poses = around(Pose2D(), np.random.default_rng(3), 9)
    check_against_twin(poses, mixed(scan), tiles, SMALL)


@given(seeds, st.sampled_from([LIMITS, SMALL, EVERY]), st.integers(1, 80))
@settings(max_examples=25)
def test_poses_go_through_the_sieves_as_the_twins_say(mapped, seed, limits, count):
    tiles, asked = mapped
    scan, pose = asked[seed % len(asked)]
    check_against_twin(around(pose, np.random.default_rng(seed), count), mixed(scan), tiles, limits)


def test_poses_far_behind_the_best_are_no_rivals_but_for_one(mapped):
    tiles, asked = mapped
    scan, pose = asked[0]
    off = np.array([[0.05, 0.0, 0.0], [2.0, 0.0, 0.5], [0.0, 2.0, -0.5], [-2.0, 0.0, 0.5]])
    poses = pose.to_array() + off
    best = [len(verify(poses, mixed(scan), tiles, WEIGHTS, limits)) for limits in (LIMITS, EVERY)]
    assert best == [2, 4]


@given(seeds, st.floats(0.0, 30.0))
def test_readings_are_on_small_things_unless_hardly_any_are_not(mapped, seed, extent):
    scan, _ = mapped[1][seed % len(mapped[1])]
    angles = angle_function(scan, AngleFunctionSettings())
    small = is_small(angles.runs, angles.way, extent)
    large = int(np.sum(~small))
    if large < 20 or large < 0.25 * len(small):
        small = np.zeros(len(small))
    told = readings(angles, VerificationSettings(small_extent=extent))
    np.testing.assert_array_equal(told, np.column_stack((angles.points, small)))
    np.testing.assert_array_equal(on_large(told), told[told[:, 2] == 0.0])


@given(seeds, st.integers(0, 30), st.integers(1, 8))
def test_distinct_poses_are_the_twins(seed, count, most):
    poses = np.random.default_rng(seed).normal(0.0, (0.5, 0.5, 2.0), (count, 3))
    found = distinct(poses, 0.4, 0.5, most)
    assert found.tolist() == plain_distinct(poses.tolist(), 0.4, 0.5, most)


@given(st.integers(0, 400), st.integers(1, 200))
def test_readings_are_chosen_evenly(count, most):
    points = np.column_stack((np.arange(count), np.zeros(count))).astype(float)
    chosen = spread(points, most)[:, 0]
    assert len(chosen) == min(count, most)
    steps = np.diff(chosen)
    assert np.all(steps >= 1)
    assert np.ptp(steps) <= 1 if len(steps) else True
    if len(chosen):  # as many are left out before the first as behind the last
        assert abs(chosen[0] - (count - 1 - chosen[-1])) <= 1


@given(st.floats(-1.0, 1.0), st.floats(0.0, 1.0))
def test_the_worth_of_a_fit_is_the_twins(score, through):
    assert worth(score, through) == pytest.approx(plain_worth(score, through))
    # Nothing makes up for what the map contradicts, and nothing is lost by explaining more.
    assert worth(score, through) <= worth(score, 0.0) <= worth(min(score + 0.1, 1.0), 0.0)


# What they must find.


def test_the_truth_comes_out_on_top(mapped):
    tiles, asked = mapped
    rng = np.random.default_rng(1)
    errors = []
    for scan, pose in asked:
        wrong = [around(other, rng, 12) for _, other in asked]
        near = pose @ Pose2D(0.15, -0.1, 0.05)
        poses = np.concatenate([*wrong, near.to_array()[np.newaxis]])
        fits = verify(poses, mixed(scan), tiles, WEIGHTS, LIMITS)
        best = Pose2D(*fits.poses[0])
        errors.append((best.distance(pose), best.turn(pose)))
    # Here and there a place is seen from one side only and holds a pose less well.
    assert np.all(np.max(errors, axis=0) < (0.25, math.radians(3.0)))
    assert np.all(np.median(errors, axis=0) < (0.03, math.radians(0.5)))


def test_fits_are_in_order_and_apart(mapped):
    tiles, asked = mapped
    rng = np.random.default_rng(2)
    for scan, pose in asked[:6]:
        poses = np.concatenate(
            [around(other, rng, 12) for _, other in asked] + [around(pose, rng, 40)]
        )
        fits = verify(poses, mixed(scan), tiles, WEIGHTS, LIMITS)
        assert 1 <= len(fits) <= LIMITS.fits
        worths = [worth(*pair) for pair in fits.features[:, [SCORE, THROUGH]].tolist()]
        assert np.all(np.diff(worths) <= 0.0)
        for a, b in itertools.combinations([Pose2D(*row) for row in fits.poses], 2):
            apart = a.distance(b) >= LIMITS.place_distance
            assert apart or a.turn(b) >= LIMITS.place_turn
        shares = np.delete(fits.features, SCORE, axis=1)
        assert np.all((shares >= 0.0) & (shares <= 1.0))
        np.testing.assert_array_equal(fits.hessians, fits.hessians.transpose(0, 2, 1))
        assert np.all(np.linalg.eigvalsh(fits.hessians) > -1e-9)


@given(seeds)
@settings(max_examples=20)
def test_the_order_of_the_proposals_does_not_matter(mapped, seed):
    tiles, asked = mapped
    rng = np.random.default_rng(seed)
    scan, pose = asked[seed % len(asked)]
    poses = around(pose, rng, 30)
    ours = verify(poses, mixed(scan), tiles, WEIGHTS, LIMITS)
    theirs = verify(rng.permutation(poses), mixed(scan), tiles, WEIGHTS, LIMITS)
    # Poses that explain equally little stay in the order in which they came.
    np.testing.assert_array_equal(ours.poses[0], theirs.poses[0])
    np.testing.assert_array_equal(ours.features[0], theirs.features[0])


def test_more_effort_finds_no_worse_a_fit(mapped):
    tiles, asked = mapped
    thorough = Settings.preset("thorough").verification
    rng = np.random.default_rng(5)
    for scan, pose in asked[:6]:
        poses = around(pose, rng, 60)
        ours = verify(poses, mixed(scan), tiles, WEIGHTS, LIMITS)
        theirs = verify(poses, mixed(scan), tiles, WEIGHTS, thorough)
        few = spread(mixed(scan), 120)
        scores = field_scores(np.stack([ours.poses[0], theirs.poses[0]]), few, tiles, WEIGHTS)
        assert scores[1] > scores[0] - 0.03


# Bad input is normal input.


@pytest.mark.interpreted
def test_no_poses_have_no_fits():
    scan, tiles = small_room(FIELD)
    fits = verify(np.empty((0, 3)), mixed(scan), tiles, WEIGHTS, LIMITS)
    assert len(fits) == 0
    assert fits.poses.shape == (0, 3)
    assert fits.features.shape == (0, len(FEATURES))


@pytest.mark.parametrize(
    "points", [NOBODY, np.array([[1.0, 0.5, 0.0]]), np.full((5, 3), (1e6, 1e6, 1.0))]
)
def test_a_scan_of_little_has_a_fit_that_tells_little(mapped, points):
    poses = mapped[1][0][1].to_array()[np.newaxis]
    fits = verify(poses, points, mapped[0], WEIGHTS, LIMITS)
    assert len(fits) == 1
    assert np.all(np.isfinite(fits.features))
    assert np.all(np.isfinite(fits.poses))
    assert fits.readings == len(points)


def test_a_map_of_nothing_explains_nothing(mapped):
    nothing = LikelihoodField(FIELD).tiles
    scan, pose = mapped[1][0]
    fits = verify(pose.to_array()[np.newaxis], mixed(scan), nothing, WEIGHTS, LIMITS)
    assert fits.features[0, FEATURES.index("unknown")] == 1.0
    assert fits.features[0, SCORE] == pytest.approx(FIELD.unknown_score)
    np.testing.assert_allclose(fits.poses[0], pose.to_array())


def test_some_of_the_fits():
    rows = np.arange(12.0).reshape(4, 3)
    fits = Fits(rows, np.zeros((4, 7)), np.zeros((4, 3, 3)), np.arange(4.0), 90)
    some = fits[1:3]
    assert len(some) == 2
    np.testing.assert_array_equal(some.poses, rows[1:3])
    assert some.residuals.tolist() == [1.0, 2.0]
    assert some.readings == 90
