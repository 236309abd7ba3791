"""Grids: kernels against plain twins, ray casting against exact worlds, covering, stitching."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from heapq import heappop, heappush
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from anchorscan import occupancy, simulator
from anchorscan.errors import LogError
from anchorscan.map_file import load_map
from anchorscan.occupancy import (
    OccupancyGrid,
    cast_rays,
    reference_poses,
    reference_scans,
    stitch,
)
from anchorscan.pose import Pose2D
from anchorscan.record import Record
from anchorscan.scan import LaserScan
from anchorscan.sensor import SensorModel
from anchorscan.simulator import World, drive, random_building, random_poses, rasterise

SEEDS = st.integers(0, 2**31 - 1)


def random_grid(seed: int, *, share: tuple[float, float] = (0.1, 0.1)) -> OccupancyGrid:
    """Cells without order, with walls drawn through some of them, in a turned frame."""
    rng = np.random.default_rng(seed)
    shape = rng.integers(3, 40, 2)
    draw = rng.random(shape)
    data = np.where(draw < share[0], 100, np.where(draw < sum(share), -1, 0))
    if rng.random() < 0.7:
        data[rng.integers(shape[0])] = 100
        data[:, rng.integers(shape[1])] = 100
    origin = Pose2D(*rng.uniform(-20.0, 20.0, 2), rng.uniform(-3.0, 3.0))
    return OccupancyGrid(data, float(rng.choice([0.03, 0.05, 0.1])), origin)


# --- Twins -----------------------------------------------------------------------------


@given(SEEDS)
@settings(max_examples=60, deadline=None)
def test_squared_distances_agree_with_all_pairs(seed: int) -> None:
    occupied = random_grid(seed, share=(0.03, 0.0)).is_occupied
    cells = np.argwhere(occupied)
    every = np.argwhere(np.ones_like(occupied))
    expected = np.full(len(every), math.inf)
    if len(cells) > 0:
        expected = ((every[:, None] - cells[None]) ** 2).sum(axis=2).min(axis=1)
    result = occupancy._squared_distances(occupied)
    np.testing.assert_array_equal(result.ravel(), expected)


def regions_twin(mask: NDArray[np.bool_]) -> list[set[tuple[int, int]]]:
    todo = {(int(i), int(j)) for i, j in np.argwhere(mask)}
    regions = []
    while todo:
        queue = deque([todo.pop()])
        region = set(queue)
        while queue:
            i, j = queue.popleft()
            near = {(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)} & todo
            todo -= near
            region |= near
            queue.extend(near)
        regions.append(region)
    return regions


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_regions_agree_with_flooding(seed: int) -> None:
    grid = random_grid(seed, share=(0.35, 0.05))
    labels = grid.regions()
    assert ((labels > 0) == grid.is_free).all()
    expected = regions_twin(grid.is_free)
    assert labels.max(initial=0) == len(expected)
    for region in expected:
        assert len({labels[cell] for cell in region}) == 1


def fit_twin(grid: OccupancyGrid, row: int, column: int) -> tuple[float, ...] | None:
    """Line nx, ny, c through the surface cells around one, by the eigenvectors of scatter."""
    free = np.pad(grid.is_free, 1)
    rows, columns = grid.data.shape
    touches = [free[i : i + rows, j : j + columns] for i in range(3) for j in range(3)]
    surface = np.argwhere(grid.is_occupied & np.any(touches, axis=0))
    if not (surface == (row, column)).all(axis=1).any():
        return None
    offsets = surface - (row, column)
    near = surface[(offsets**2).sum(axis=1) <= 5]
    near = near[(np.abs(near - (row, column)) <= 2).all(axis=1)][:, ::-1] + 0.5
    if len(near) < 3:
        return None
    values, vectors = np.linalg.eigh(np.cov(near.T, bias=True))
    # At the limit and with equal spreads, rounding decides.
    if values[0] > 0.2 - 1e-9 or values[1] - values[0] < 1e-9:
        return None
    nx, ny = vectors[:, 0]
    return float(nx), float(ny), float(vectors[:, 0] @ near.mean(axis=0))


@given(SEEDS)
@settings(max_examples=25, deadline=None)
def test_fitted_lines_agree_with_eigenvectors(seed: int) -> None:
    grid = random_grid(seed, share=(0.15, 0.1))
    kinds, lines = grid._surface
    assert ((kinds >= 0) <= grid.is_occupied).all()
    assert ((kinds == -1) == grid.is_free).all()
    for row, column in np.argwhere(grid.is_occupied):
        expected = fit_twin(grid, row, column)
        if expected is not None:
            assert kinds[row, column] >= 0
            line = lines[kinds[row, column]]
            assert np.allclose(line, expected) or np.allclose(-line, expected)


def crossings(x: float, y: float, dx: float, dy: float, length: float) -> list[float]:
    """Distances at which a ray crosses lines of the grid, ends included, in order."""
    result = {0.0, length}
    for start, step in ((x, dx), (y, dy)):
        if step != 0.0:
            last = start + step * length
            lines = range(math.ceil(min(start, last)), math.floor(max(start, last)) + 1)
            result |= {(line - start) / step for line in lines}
    return sorted(r for r in result if 0.0 <= r <= length)


def cast_twin(grid: OccupancyGrid, pose: Pose2D, angle: float, reach: float) -> float:
    """One ray, by all crossings with the lines of the grid."""
    local = grid.origin.inverse() @ pose
    x, y = local.x / grid.resolution, local.y / grid.resolution
    dx, dy = math.cos(local.theta + angle), math.sin(local.theta + angle)
    kinds, lines = grid._surface
    rows, columns = kinds.shape
    stops = crossings(x, y, dx, dy, 2.0 * (rows + columns))
    unknown = 0.0
    for enter, leave in pairwise(stops):
        middle = 0.5 * (enter + leave)
        row, column = math.floor(y + middle * dy), math.floor(x + middle * dx)
        if not (0 <= row < rows and 0 <= column < columns) or unknown > 3.0:
            return math.nan
        if enter > reach / grid.resolution:
            return math.inf
        kind = kinds[row, column]
        if kind == -3 or kind >= 0:
            distance = middle + 0.25
            if kind >= 0:
                nx, ny, c = lines[kind]
                with np.errstate(all="ignore"):
                    at_line = (c - nx * x - ny * y) / (nx * dx + ny * dy)
                if abs(at_line - middle) <= 1.5:
                    distance = max(at_line, 0.0)
            return distance * grid.resolution
        unknown = unknown + leave - enter if kind == -2 else 0.0
    return math.nan


@given(SEEDS, st.floats(0.1, 20.0))
@settings(max_examples=40, deadline=None)
def test_ray_caster_agrees_with_its_plain_twin(seed: int, reach: float) -> None:
    grid = random_grid(seed, share=(0.05, 0.08))
    rng = np.random.default_rng(seed)
    place = rng.uniform(0.2, 0.8, 2) * np.array(grid.data.shape[::-1]) * grid.resolution
    pose = grid.origin @ Pose2D(*place, rng.uniform(-3.0, 3.0))
    distances = cast_rays(grid, pose, -3.0, 0.1, 60, reach=reach)
    expected = [cast_twin(grid, pose, -3.0 + 0.1 * i, reach) for i in range(60)]
    np.testing.assert_allclose(distances, expected, rtol=1e-7)


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_traced_readings_agree_with_their_plain_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(3, 30)), int(rng.integers(3, 30)))
    x, y = rng.uniform(0.0, (shape[1], shape[0]))
    ends = rng.uniform((0.0, 0.0), (shape[1], shape[0]), (12, 2))
    is_hit = rng.random(12) < 0.7
    expected = np.zeros((*shape, 2), dtype=np.int32)
    for (u, v), hit in zip(ends, is_hit, strict=True):
        length = math.hypot(u - x, v - y)
        stops = crossings(x, y, (u - x) / length, (v - y) / length, length)
        for enter, leave in pairwise(stops):
            at = 0.5 * (enter + leave) / length
            expected[math.floor(y + at * (v - y)), math.floor(x + at * (u - x)), 1] += 1
        expected[math.floor(v), math.floor(u), 1] -= 1
        expected[math.floor(v), math.floor(u), 0 if hit else 1] += 1
    counts = np.zeros_like(expected)
    occupancy._trace(counts, x, y, ends, is_hit)
    np.testing.assert_array_equal(counts, expected)


def driven_distances(passable: NDArray[np.bool_], starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Cells of driving from every cell to the nearest start, by Dijkstra's algorithm."""
    total = np.full(passable.shape, math.inf)
    queue = [(0.0, int(i), int(j)) for i, j in starts]
    while queue:
        way, i, j = heappop(queue)
        if way >= total[i, j]:
            continue
        total[i, j] = way
        for di, dj in np.ndindex(3, 3):
            k, m = i + di - 1, j + dj - 1
            inside = 0 <= k < passable.shape[0] and 0 <= m < passable.shape[1]
            if inside and passable[k, m]:
                heappush(queue, (way + math.hypot(di - 1, dj - 1), k, m))
    return total


@given(SEEDS, st.floats(0.1, 1.5))
@settings(max_examples=25, deadline=None)
def test_reference_poses_cover_all_that_is_reachable_and_keep_apart(
    seed: int, spacing: float
) -> None:
    grid = random_grid(seed, share=(0.05, 0.02))
    passable = grid.reachable(0.5 * grid.resolution)
    if not passable.any():
        return
    places = reference_poses(grid, spacing=spacing, radius=0.5 * grid.resolution)
    cells = grid.cells(places)
    assert passable[cells[:, 0], cells[:, 1]].all()
    limit = spacing / grid.resolution
    assert driven_distances(passable, cells)[passable].max() <= limit + 1e-6
    for index in range(len(cells)):
        others = np.delete(cells, index, axis=0)
        assert driven_distances(passable, others)[tuple(cells[index])] > limit - 1e-6


# --- Values ----------------------------------------------------------------------------


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_cells_and_centres_are_inverse(seed: int) -> None:
    grid = random_grid(seed)
    cells = np.argwhere(np.ones_like(grid.data))
    np.testing.assert_array_equal(grid.cells(grid.centres(cells)), cells)


def test_message_fields_become_the_grid() -> None:
    data = [0, 100, -1, 50, 101, 65]
    grid = OccupancyGrid.from_message(data, 3, 2, 0.1, Pose2D(1.0, 2.0, math.pi / 2))
    assert grid.data.tolist() == [[0, 100, -1], [50, -1, 65]]
    assert grid.is_occupied.tolist() == [[False, True, False], [False, False, True]]
    assert grid.is_free.tolist() == [[True, False, False], [False, False, False]]
    # Cell (0, 1) lies along the grid's x axis, which points along the map's y axis.
    np.testing.assert_allclose(grid.centres([[0, 1]]), [[0.95, 2.15]])
    as_bytes = np.array(data, dtype=np.int8).tobytes()
    same = OccupancyGrid.from_message(as_bytes, 3, 2, 0.1, Pose2D())
    np.testing.assert_array_equal(same.data, grid.data)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 4}, "a map of 4 x 2 cells with 6 values"),
        ({"width": 0}, "a map of 0 x 2"),
        ({"width": -3, "height": -2}, "a map of -3 x -2"),
        ({"resolution": 0.0}, "resolution must be positive"),
        ({"resolution": math.nan}, "resolution must be positive"),
        ({"resolution": 1e300}, "resolution must be positive metres up to 1000, not 1e"),
        ({"origin": Pose2D(math.inf)}, "origin of the map must be finite"),
    ],
)
def test_impossible_message_is_refused(change: dict[str, object], message: str) -> None:
    fields = {"data": [0] * 6, "width": 3, "height": 2, "resolution": 0.1, "origin": Pose2D()}
    with pytest.raises(LogError, match=message):
        OccupancyGrid.from_message(**(fields | change))


def test_values_that_are_no_cells_are_refused() -> None:
    for value in (300, 101, -2, math.nan):
        with pytest.raises(LogError, match="cells must be -1 or 0 to 100, not from"):
            OccupancyGrid(np.full((3, 3), value), 0.05)
    for data in ([[0, 100], [0]], [["free"]], [[None]]):
        with pytest.raises(LogError, match="a map needs rows and columns"):
            OccupancyGrid(data, 0.05)  # type: ignore[arg-type]


def test_robot_keeps_away_from_unknown_space_but_not_from_specks() -> None:
    data = np.zeros((60, 60), dtype=np.int8)
    data[30, 30] = -1
    data[:, 50:] = -1
    grid = OccupancyGrid(data, 0.05)
    reachable = grid.reachable(0.22)
    assert reachable[30, 31]
    assert not reachable[30, 46:].any()
    assert reachable[30, 45]


def test_reachable_is_the_largest_region_that_the_robot_fits_into() -> None:
    data = np.zeros((40, 40), dtype=np.int8)
    data[:, 15] = 100
    data[18:22, 15] = 0
    narrow = OccupancyGrid(data, 0.1)
    assert not narrow.reachable(0.3)[20, 7]
    assert narrow.reachable(0.3)[20, 30]
    assert narrow.reachable(0.1)[20, 7]
    assert not narrow.reachable(5.0).any()
    with pytest.raises(LogError, match="no free place for a robot of radius 5"):
        reference_poses(narrow, radius=5.0)


# --- Ray casting against the truth -----------------------------------------------------


def distance_to_surfaces(world: World, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Metres from every point to the nearest surface."""
    a, b = world.segments[:, :2], world.segments[:, 2:]
    e, d = b - a, points[:, None] - a
    share = np.clip((d * e).sum(axis=2) / np.maximum((e**2).sum(axis=1), 1e-12), 0.0, 1.0)
    straight = np.linalg.norm(d - share[:, :, None] * e, axis=2).min(axis=1)
    c = world.circles
    round_ = np.abs(np.linalg.norm(points[:, None] - c[:, :2], axis=2) - c[:, 2])
    return np.minimum(straight, round_.min(axis=1, initial=math.inf))


@pytest.mark.parametrize("style", ["office", "hall"])
@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_grid_agrees_with_the_world_it_was_drawn_from(style: str, turn: float) -> None:
    world = random_building(3, style=style, length=24.0, depth=20.0).moved(Pose2D(1, 2, turn))
    resolution = 0.05
    grid = rasterise(world, resolution)
    sensor = SensorModel(2.0 * math.pi, math.radians(1.0), range_max=80.0)
    errors, strays = [], []
    for pose in random_poses(world, 25, 4):
        scan = occupancy.simulate(grid, pose, sensor)
        assert scan.is_return.all()
        errors.append(scan.ranges - simulator.simulate(world, pose, sensor).ranges)
        strays.append(distance_to_surfaces(world, pose.apply(scan.points)))
    error, stray = np.concatenate(errors), np.concatenate(strays)
    # Every reading lies on a surface, to within the diagonal of a cell.
    assert np.quantile(stray, 0.99) < math.sqrt(2.0) * resolution
    assert stray.max() < 2.0 * resolution
    # No surface is seen through; but where a ray passes close by one, cells may stop it.
    assert (error < 1.5 * resolution).mean() > 0.98
    assert (np.abs(error) < resolution).mean() > 0.85
    assert abs(np.median(error)) < 0.2 * resolution


@given(SEEDS)
@settings(max_examples=20, deadline=None)
def test_map_with_another_origin_gives_the_same_scan(seed: int) -> None:
    grid = random_grid(seed, share=(0.05, 0.05))
    T_new_map = Pose2D(*np.random.default_rng(seed).uniform(-5.0, 5.0, 3))
    moved = replace(grid, origin=T_new_map @ grid.origin)
    cells = np.argwhere(grid.is_free)
    x, y = grid.centres(cells[len(cells) // 2 :][:1])[0]
    pose = Pose2D(x, y, 0.3)
    one = cast_rays(grid, pose, 0.0, 0.1, 60)
    other = cast_rays(moved, T_new_map @ pose, 0.0, 0.1, 60)
    assert (np.isclose(one, other, rtol=1e-6, equal_nan=True)).mean() > 0.95


def test_what_the_map_does_not_know_is_nan_and_what_is_free_is_beyond_reach() -> None:
    data = np.zeros((100, 100), dtype=np.int8)
    data[:, 80:] = -1
    data[90:] = 100
    data[50:53, 20:23] = -1
    grid = OccupancyGrid(data, 0.1)
    pose = Pose2D(5.05, 5.05, 0.0)
    east, north, west, south = cast_rays(grid, pose, 0.0, math.pi / 2, 4)
    assert math.isnan(east)
    assert north == pytest.approx(9.0 + 0.05 - 5.05, abs=0.06)
    assert math.isnan(west)  # out of the map, through a gap of three unknown cells
    assert math.isnan(south)
    short = cast_rays(grid, pose, 0.0, math.pi / 2, 4, reach=2.0)
    assert short.tolist() == [math.inf] * 4


def test_surface_of_a_map_stitched_from_noisy_drives_is_unbiased() -> None:
    # Oblique to the grid: a wall along it lies at one place in all its cells.
    world = random_building(3, length=22.0, depth=14.0).moved(Pose2D(0.0, 0.0, 0.3))
    sensor = SensorModel(math.pi, math.radians(0.5), noise=0.01)
    rng = np.random.default_rng(0)
    records = drive(world, sensor, seed=1, length=50.0)
    noisy = [
        replace(r, pose=r.pose @ Pose2D(*(rng.standard_normal(3) * (0.01, 0.01, 0.003))))
        for r in records
    ]
    for resolution in (0.03, 0.05):
        grid = stitch(noisy, resolution)
        errors = []
        for record in records[::10]:
            exact = simulator.cast_rays(world, record.pose, -1.5, 0.01, 300)
            errors.append(cast_rays(grid, record.pose, -1.5, 0.01, 300) - exact)
        error = np.concatenate(errors)
        error = error[np.isfinite(error)]
        assert abs(np.median(error)) < 0.006
        assert (np.abs(error) < 0.05).mean() > 0.85


# --- Reference scans -------------------------------------------------------------------


def test_reference_scans_are_what_the_sensor_would_see() -> None:
    world = random_building(5, length=22.0, depth=14.0)
    grid = rasterise(world, 0.05)
    records = list(reference_scans(grid, spacing=2.0))
    assert [r.index for r in records] == list(range(len(records)))
    for record in records[::5]:
        assert len(record.scan) == 720
        assert record.scan.is_return.all()
        stray = distance_to_surfaces(world, record.pose.apply(record.scan.points))
        assert np.quantile(stray, 0.98) < 0.05
        assert stray.max() < 0.1


def test_sensor_with_a_limited_view_looks_into_all_headings() -> None:
    grid = rasterise(random_building(5, length=22.0, depth=14.0), 0.05)
    all_round = list(reference_scans(grid, spacing=2.0))
    sensor = SensorModel(math.pi, math.radians(1.0))
    records = list(reference_scans(grid, sensor, spacing=2.0, heading=math.radians(90.0)))
    assert len(records) == 4 * len(all_round)
    headings = [round(math.degrees(r.pose.theta)) % 360 for r in records[:4]]
    assert headings == [0, 90, 180, 270]
    assert len({(r.pose.x, r.pose.y) for r in records}) == len(all_round)
    assert all(len(r.scan) == 181 for r in records)


def test_impossible_spacings_are_refused() -> None:
    grid = OccupancyGrid(np.zeros((9, 9)), 0.5)
    for wrong in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(LogError, match="must be positive"):
            reference_scans(grid, spacing=wrong)
        with pytest.raises(LogError, match="must be positive"):
            reference_scans(grid, heading=wrong)


def test_map_of_a_real_building_is_covered(data_file: Callable[[str], Path]) -> None:
    grid = load_map(data_file("olin/mac_1st_floor_final.yaml"))
    assert grid.data.shape == (1706, 903)
    # The file's own free_thresh would make its 1.2 million unknown cells free.
    assert np.bincount(grid.data.ravel() + 1)[0] == 1220114
    records = list(reference_scans(grid, spacing=1.5))
    cells = grid.cells([[r.pose.x, r.pose.y] for r in records])
    passable = grid.reachable(0.2)
    assert passable[cells[:, 0], cells[:, 1]].all()
    far = driven_distances(passable[::2, ::2], cells // 2)[passable[::2, ::2]]
    assert np.isfinite(far).mean() > 0.99
    # A coarser grid drives small detours.
    assert np.quantile(far[np.isfinite(far)], 0.999) * 0.06 < 1.6
    assert np.median([r.scan.is_return.mean() for r in records]) > 0.7


# --- Stitching -------------------------------------------------------------------------


def test_stitched_map_is_that_of_the_world() -> None:
    world = random_building(2, length=22.0, depth=14.0)
    sensor = SensorModel(2 * math.pi, math.radians(0.5), noise=0.0)
    records = drive(world, sensor, seed=1, length=40.0)
    grid = stitch(records, 0.05)
    truth = rasterise(world, 0.05)
    # Occupied cells lie on surfaces, and where scans were taken it is free.
    near = truth.cells(grid.centres(np.argwhere(grid.is_occupied)))
    assert (truth.clearance[near[:, 0], near[:, 1]] < 0.08).mean() > 0.99
    stood = grid.cells([[r.pose.x, r.pose.y] for r in records])
    assert grid.is_free[stood[:, 0], stood[:, 1]].all()
    # What is free in it is free in the world, but for surfaces that rays graze.
    free = truth.cells(grid.centres(np.argwhere(grid.is_free)))
    assert truth.is_occupied[free[:, 0], free[:, 1]].mean() < 0.02


def test_readings_beyond_reach_clear_but_do_not_fill() -> None:
    scan = LaserScan(np.array([2.0, 5.0, math.inf, math.nan]), 0.0, math.pi / 2)
    record = Record(0, scan, Pose2D(0.01, 0.02, 0.0))
    whole, cut = stitch([record], 0.1), stitch([record], 0.1, reach=3.0)
    assert whole.is_occupied.sum() == 2
    assert cut.is_occupied.sum() == 1
    assert cut.is_free.sum() < whole.is_free.sum()
    row, column = cut.cells([[0.01, 2.5]])[0]
    assert cut.is_free[row, column]


def test_nothing_to_stitch_is_refused() -> None:
    scan = LaserScan(np.ones(3), 0.0, 0.1)
    useless = [Record(0, None, Pose2D()), Record(1, scan, None), Record(2, scan, Pose2D(math.nan))]
    with pytest.raises(LogError, match="no scan with a pose"):
        stitch(useless)
    far = [Record(0, scan, Pose2D()), Record(1, scan, Pose2D(1e7, 1e7))]
    with pytest.raises(LogError, match="too large to stitch"):
        stitch(far)
    with pytest.raises(LogError, match="resolution must be positive"):
        stitch([Record(0, scan, Pose2D())], 0.0)
