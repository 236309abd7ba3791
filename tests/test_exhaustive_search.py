"""Exhaustive search against brute force over the same cells, and against simulated truth."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchorscan.exhaustive_search import ExhaustiveSearch, likelihood_grid, pyramid
from anchorscan.pose import Pose2D
from anchorscan.reference import Reference
from anchorscan.scan import LaserScan
from anchorscan.sensor import SensorModel
from anchorscan.simulator import random_building, random_poses, simulate

SENSOR = SensorModel(field_of_view=math.radians(180.0), resolution=math.radians(2.0))


def building(seed, count=12):
    world = random_building(seed)
    poses, rng = random_poses(world, count, seed), np.random.default_rng(seed)
    return world, [
        Reference(i, simulate(world, pose, SENSOR, rng), pose) for i, pose in enumerate(poses)
    ]


def brute_force(search, scan, places):
    """Score every pose cell and every heading, one by one, on the unpooled grid."""
    points = search._sample(scan)
    headings = search._headings(points)
    offsets = search._offsets(points, headings)
    pad = (1 << (len(search._grids) - 1)) - 1
    grid = search._grids[0][pad:, pad:].astype(np.int64)
    columns, rows = search._shape
    height, width = grid.shape
    sums = np.zeros((len(headings), rows, columns), dtype=np.int64)
    ys, xs = np.mgrid[0:rows, 0:columns]
    for a in range(len(headings)):
        for dx, dy in offsets[a]:
            x, y = xs + search._shift[0] + dx, ys + search._shift[1] + dy
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            sums[a][inside] += grid[y[inside], x[inside]]
    best = []
    turn = 2.0 * math.pi / len(headings)
    for _ in range(places):
        a, row, column = np.unravel_index(np.argmax(sums), sums.shape)
        best.append(int(sums[a, row, column]))
        steps = np.abs(np.arange(len(headings)) - a)
        steps = np.minimum(steps, len(headings) - steps)
        same_heading = steps * turn < math.radians(20.0) - 1e-9
        apart = ((ys - row) ** 2 + (xs - column) ** 2) * 0.3**2
        sums[np.ix_(same_heading)] = np.where(apart < 0.5**2 - 1e-9, -1, sums[np.ix_(same_heading)])
    return best, len(points)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_agrees_with_brute_force_over_the_same_cells(seed):
    world, references = building(seed, 5)
    pose = random_poses(world, 1, seed + 100)[0]
    scan = simulate(world, pose, SENSOR, np.random.default_rng(seed + 100))
    search = ExhaustiveSearch(references, resolution=0.3, deviation=0.3, readings=30, levels=4)
    found = search.locate(scan, places=3)
    sums, points = brute_force(search, scan, 3)
    grid_scores = sorted((place.grid_score for place in found), reverse=True)
    assert grid_scores == pytest.approx([total / (255.0 * points) for total in sums], abs=1e-12)


@pytest.mark.parametrize("levels", [1, 2, 5, 8])
def test_the_number_of_levels_changes_nothing(levels):
    world, references = building(7, 6)
    scan = simulate(world, random_poses(world, 1, 70)[0], SENSOR, np.random.default_rng(70))
    expected = ExhaustiveSearch(references, resolution=0.2, levels=3).locate(scan)
    found = ExhaustiveSearch(references, resolution=0.2, levels=levels).locate(scan)
    assert [p.grid_score for p in found] == [p.grid_score for p in expected]


def test_finds_the_simulated_truth():
    world, references = building(11, 60)
    search = ExhaustiveSearch(references)
    for reference in references[::12]:
        near = reference.pose @ Pose2D(0.2, 0.1, 0.3)
        best, other = search.locate(simulate(world, near, SENSOR, np.random.default_rng(5)))
        assert best.pose.distance(near) < 0.15
        assert best.pose.turn(near) < math.radians(2.0)
        assert best.score > other.score


def test_places_are_apart():
    world, references = building(13, 20)
    search = ExhaustiveSearch(references)
    scan = simulate(world, references[3].pose, SENSOR, np.random.default_rng(0))
    places = search.locate(scan, places=4)
    assert len(places) == 4
    for place, other in combinations(places, 2):
        # Half a metre or 20 degrees, less a cell or two degrees that each may climb.
        apart = place.pose.distance(other.pose), place.pose.turn(other.pose)
        assert apart[0] > 0.5 - 2.0 * math.hypot(0.1, 0.1) or apart[1] > math.radians(16.0)
    assert [place.score for place in places] == sorted((p.score for p in places), reverse=True)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31 - 1), st.integers(1, 5))
def test_pyramid_holds_the_largest_of_every_block(seed, levels):
    generator = np.random.default_rng(seed)
    grid = generator.integers(0, 256, generator.integers(1, 14, 2), dtype=np.uint8)
    grids = pyramid(grid, levels)
    pad = (1 << (levels - 1)) - 1
    padded = np.pad(grid, ((pad, 40), (pad, 40)))
    for level in range(levels):
        side = 1 << level
        for y in range(grids.shape[1]):
            for x in range(grids.shape[2]):
                assert grids[level, y, x] == padded[y : y + side, x : x + side].max()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31 - 1))
def test_likelihood_is_that_of_the_nearest_point(seed):
    generator = np.random.default_rng(seed)
    points = generator.uniform(0.0, 3.0, (generator.integers(1, 20), 2))
    grid = likelihood_grid(points, np.array([-0.5, -0.5]), np.array([4.0, 4.0]), 0.25, 0.2)
    ys, xs = np.mgrid[0 : grid.shape[0], 0 : grid.shape[1]]
    centres = np.stack((xs, ys), axis=-1) * 0.25 - 0.5 + 0.125
    distance = np.linalg.norm(centres[:, :, None] - points, axis=-1).min(axis=-1)
    expected = 255.0 * np.exp(-0.5 * (distance / 0.2) ** 2)
    assert np.abs(grid - expected).max() <= 0.51


def test_a_scan_without_returns_has_no_place():
    _, references = building(1, 3)
    search = ExhaustiveSearch(references, resolution=0.3)
    assert search.locate(LaserScan(np.full(10, np.inf), 0.0, 0.1)) == []
    assert search.locate(LaserScan(np.full(10, np.nan), 0.0, 0.1)) == []


def test_a_map_without_a_point_has_no_place():
    empty = LaserScan(np.full(10, np.inf), 0.0, 0.1)
    search = ExhaustiveSearch([Reference(0, empty, Pose2D())])
    assert search.locate(LaserScan(np.ones(10), 0.0, 0.1)) == []


def test_refuses_what_it_cannot_search():
    scan = LaserScan(np.ones(10), 0.0, 0.1)
    with pytest.raises(ValueError, match="with poses"):
        ExhaustiveSearch([Reference(0, scan)])
    far = [Reference(0, scan, Pose2D()), Reference(1, scan, Pose2D(5000.0, 0.0, 0.0))]
    with pytest.raises(ValueError, match="cells on a side"):
        ExhaustiveSearch(far)
    with pytest.raises(ValueError, match="levels"):
        ExhaustiveSearch(far[:1], levels=9)
