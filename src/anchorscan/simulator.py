"""Scans and drives with exact truth in a world.

`simulate` gives the scan at a pose and `drive` a log of scans along a path through free space.
Everything is a function of its arguments and its seed.  The names of `world` and `building`
are at hand here too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .building import random_building
from .errors import AnchorscanError
from .occupancy import OccupancyGrid
from .pose import Pose2D, wrap_angle
from .record import Record
from .scan import LaserScan
from .sensor import SensorModel
from .world import (
    Door,
    Furniture,
    Seed,
    World,
    cast_rays,
    move_furniture,
    remove_walls,
    scatter_people,
    turn_doors,
)

__all__ = [
    "Door",
    "Furniture",
    "SensorModel",
    "World",
    "cast_rays",
    "drive",
    "move_furniture",
    "noisy_odometry",
    "occlude",
    "random_building",
    "random_poses",
    "rasterise",
    "remove_walls",
    "scatter_people",
    "simulate",
    "turn_doors",
]


def simulate(
    world: World, pose: Pose2D, sensor: SensorModel, rng: np.random.Generator | None = None
) -> LaserScan:
    """Take a scan.

    Args:
        world: What can be seen.
        pose: ``T_world_laser`` (of the laser, not of the robot).
        sensor: The laser scanner.
        rng: Source of noise and dropouts; None leaves both out.
    """
    first_angle, increment = sensor.sweep
    # Beyond the range limit by more than the noise, surfaces cannot matter.
    reach = sensor.range_max * (1.0 + 8.0 * sensor.relative_noise) + 8.0 * sensor.noise
    distances = cast_rays(world, pose, first_angle, increment, sensor.count, reach=reach)
    return sensor.measure(distances, rng)


# Where people stand before a laser, metres, the breadth of one, and how much a reading of one errs.
_PEOPLE_NEAREST, _PEOPLE_FARTHEST = 0.6, 5.0
_PERSON_RADIUS = 0.22
_PERSON_NOISE = 0.01
# Of the occluded readings, those that meet something small: a leg, a bag, dust.
_SCATTERED = 0.2
# A crowd is tried to be made this often for every reading; in a narrow place it may not fit.
_TRIALS = 4


def occlude(scan: LaserScan, share: float, seed: Seed) -> LaserScan:
    """Put people between the laser and what it saw.

    Four fifths of the readings that are to be occluded meet people: discs of 0.44 m, 0.6 to 5 m
    away and nearer than the reading.  The rest is scattered over single readings, each at
    a random distance nearer than before.  In a place too narrow for so many people more is
    scattered.

    Args:
        scan: The scan.
        share: Of all readings, in [0, 1], that are to be occluded; people are whole, so that it
            may become a little more.
        seed: Seed or generator.
    """
    rng = np.random.default_rng(seed)
    wanted = share * len(scan)
    ranges = scan.ranges.astype(np.float64)
    seen = np.where(scan.is_return, ranges, np.where(scan.is_free, scan.range_max, 0.0))
    is_hit = np.zeros(len(scan), dtype=bool)
    geometry = (scan.angle_min, scan.angle_increment, len(scan))
    angles = scan.angles
    for _ in range(_TRIALS * len(scan)):
        if is_hit.sum() >= (1.0 - _SCATTERED) * wanted:
            break
        reading = int(rng.integers(len(scan)))
        low = _PEOPLE_NEAREST + _PERSON_RADIUS
        high = min(seen[reading], _PEOPLE_FARTHEST) - _PERSON_RADIUS
        if high <= low:
            continue
        distance, angle = rng.uniform(low, high), angles[reading]
        person = (distance * math.cos(angle), distance * math.sin(angle), _PERSON_RADIUS)
        met = cast_rays(World(people=np.array([person])), Pose2D(), *geometry)
        seen, is_hit = np.minimum(seen, met), is_hit | (met < seen)
    left = np.flatnonzero(~is_hit & (seen > scan.range_min))
    count = min(max(round(wanted - is_hit.sum()), 0), len(left))
    single = rng.choice(left, count, replace=False)
    seen[single] = rng.uniform(scan.range_min, np.minimum(seen[single], _PEOPLE_FARTHEST))
    is_hit[single] = True
    seen += _PERSON_NOISE * rng.standard_normal(len(scan))
    occluded = np.where(is_hit, np.maximum(seen, scan.range_min), ranges)
    return replace(scan, ranges=occluded.astype(np.float32))


def rasterise(world: World, resolution: float = 0.05) -> OccupancyGrid:
    """Draw the world into a grid: occupied where a surface passes, unknown outside.

    Outside is what is connected to the border of the map without crossing a surface; where
    that leaves nothing free, the world has no inside and all of it is free.
    """
    margin = 5.0 * resolution
    x1, y1, x2, y2 = world.bounds
    columns = math.ceil((x2 - x1 + 2.0 * margin) / resolution)
    rows = math.ceil((y2 - y1 + 2.0 * margin) / resolution)
    origin = Pose2D(x1 - margin, y1 - margin)
    data = np.zeros((rows, columns), dtype=np.int8)
    empty = OccupancyGrid(data, resolution, origin)
    cells = empty.cells(_samples(world, 0.2 * resolution))
    data[cells[:, 0], cells[:, 1]] = 100
    inside = OccupancyGrid(data, resolution, origin).regions()
    border = np.concatenate((inside[0], inside[-1], inside[:, 0], inside[:, -1]))
    is_outside = np.isin(inside, border[border > 0])
    if (data[~is_outside] == 0).any():
        data[is_outside] = -1
    return OccupancyGrid(data, resolution, origin)


def _samples(world: World, step: float) -> NDArray[np.float64]:
    """(N, 2) points on all surfaces, at most ``step`` metres apart along each."""
    points = [np.empty((0, 2))]
    for x1, y1, x2, y2 in world.segments.tolist():
        share = np.linspace(0.0, 1.0, 2 + int(math.hypot(x2 - x1, y2 - y1) / step))[:, None]
        points.append((x1, y1) + share * (x2 - x1, y2 - y1))
    for x, y, radius in world.circles.tolist():
        angle = np.linspace(0.0, 2.0 * math.pi, 4 + int(2.0 * math.pi * radius / step))
        points.append(np.column_stack((x + radius * np.cos(angle), y + radius * np.sin(angle))))
    return np.concatenate(points)


def random_poses(world: World, count: int, seed: Seed, *, radius: float = 0.3) -> list[Pose2D]:
    """Draw poses in the largest space that a round robot can reach, in all headings.

    Args:
        world: Where to stand.
        count: Number of poses.
        seed: Seed or generator.
        radius: Distance to keep from all surfaces, metres.

    Raises:
        AnchorscanError: The robot fits nowhere.
    """
    rng = np.random.default_rng(seed)
    grid = rasterise(world, _PLAN_RESOLUTION)
    # Centres stand for their whole cells, so half a diagonal is kept in addition.
    cells = np.argwhere(grid.reachable(radius + _PLAN_RESOLUTION))
    if len(cells) == 0:
        raise AnchorscanError(f"a robot of radius {radius} m fits nowhere in this world")
    points = grid.centres(cells[rng.integers(len(cells), size=count)])
    points += rng.uniform(-0.5, 0.5, points.shape) * grid.resolution
    headings = rng.uniform(-math.pi, math.pi, count)
    return [Pose2D(x, y, h) for (x, y), h in zip(points.tolist(), headings, strict=True)]


_PLAN_RESOLUTION = 0.1
# Nearer to surfaces than this, metres, a path costs more, so that drives keep to the middle.
_COMFORT = 0.7
_SMOOTHING = 9
_SPEED = 0.5
_TURN_SPEED = 0.8


def drive(
    world: World,
    sensor: SensorModel | None = None,
    *,
    seed: Seed = 0,
    length: float = 100.0,
    step: float = 0.25,
    turn: float = math.radians(15.0),
    radius: float = 0.25,
    odometry_noise: float = 0.02,
) -> list[Record]:
    """Drive from one random goal to the next and take scans on the way.

    The path keeps away from surfaces where it can, bends smoothly, and turns on the spot at
    a goal.  Path, sensor noise and odometry noise have random streams of their own: another
    sensor sees the same drive.

    Args:
        world: Where to drive.
        sensor: The laser scanner; 180 degrees by default.
        seed: Seed or generator.
        length: Metres to drive.
        step: Metres between scans at most.
        turn: Turn between scans at most, radians.
        radius: Robot radius, metres.
        odometry_noise: As for `noisy_odometry`.

    Returns:
        Records with exact poses of the laser (``T_world_laser``), odometry of the laser that
        starts at the identity of the robot, and stamps at a walking robot's speed.

    Raises:
        AnchorscanError: The robot fits nowhere.
    """
    sensor = sensor or SensorModel()
    path_rng, sensor_rng, odometry_rng = np.random.default_rng(seed).spawn(3)
    poses = _poses_along(_path(world, length, radius, path_rng), step, turn)
    odometry = noisy_odometry(poses, odometry_noise, odometry_rng)
    records = []
    stamp = 0.0
    for index, (pose, odom) in enumerate(zip(poses, odometry, strict=True)):
        if index > 0:
            before = poses[index - 1]
            stamp += before.distance(pose) / _SPEED + before.turn(pose) / _TURN_SPEED
        T_world_laser = pose @ sensor.mounting
        records.append(
            Record(
                index,
                simulate(world, T_world_laser, sensor, sensor_rng),
                T_world_laser,
                odom @ sensor.mounting,
                stamp,
                f"simulated scan {index}",
            )
        )
    return records


def noisy_odometry(poses: Iterable[Pose2D], noise: float, rng: np.random.Generator) -> list[Pose2D]:
    """Odometry of a drive: starts at the identity and drifts.

    Distances and turns are wrong by a factor that is constant over the drive (wheels of the
    wrong size) and by one that is new at every step; both have the standard deviation
    ``noise``.  In addition the heading drifts by ``0.1 * noise`` radians a metre.

    Args:
        poses: True poses of the robot, in any frame.
        noise: Relative standard deviation: 0.05 is 5 percent.
        rng: Source of the noise.
    """
    result: list[Pose2D] = []
    before: Pose2D | None = None
    constant = 1.0 + noise * rng.standard_normal(2)
    for pose in poses:
        if before is None:
            result.append(Pose2D())
        else:
            move = before.inverse() @ pose
            far, round_ = constant + noise * rng.standard_normal(2)
            drift = 0.1 * noise * math.hypot(move.x, move.y) * rng.standard_normal()
            result.append(
                result[-1] @ Pose2D(far * move.x, far * move.y, round_ * move.theta + drift)
            )
        before = pose
    return result


def _path(
    world: World, length: float, radius: float, rng: np.random.Generator
) -> list[NDArray[np.float64]]:
    """Legs of a path, each (N, 2) metres, from goal to goal, ``length`` metres together."""
    grid = rasterise(world, _PLAN_RESOLUTION)
    passable = grid.reachable(radius)
    cells = np.argwhere(passable)
    if len(cells) == 0:
        raise AnchorscanError(f"a robot of radius {radius} m fits nowhere in this world")
    cost = 1.0 + 4.0 * np.clip(1.0 - grid.clearance / _COMFORT, 0.0, 1.0)
    cost = np.where(passable, cost, math.inf)
    legs: list[NDArray[np.float64]] = []
    here = cells[rng.integers(len(cells))]
    driven = 0.0
    while driven < length and len(cells) > 1:
        goal = cells[rng.integers(len(cells))]
        way = _cheapest_way(cost, here[0], here[1], goal[0], goal[1])
        if len(way) > 1:
            leg = _smooth(grid.centres(way))
            legs.append(leg)
            driven += float(np.hypot(*np.diff(leg, axis=0).T).sum())
            here = goal
    return legs or [grid.centres(here[None])]


def _smooth(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Moving average along a path that keeps its ends."""
    half = _SMOOTHING // 2
    padded = np.concatenate(
        (np.repeat(points[:1], half, 0), points, np.repeat(points[-1:], half, 0))
    )
    sums = np.cumsum(np.concatenate((np.zeros((1, 2)), padded)), axis=0)
    smooth = (sums[_SMOOTHING:] - sums[:-_SMOOTHING]) / _SMOOTHING
    smooth[[0, -1]] = points[[0, -1]]
    return np.asarray(smooth)


def _poses_along(legs: list[NDArray[np.float64]], step: float, turn: float) -> list[Pose2D]:
    """Poses that look along the path, ``step`` apart, turning by at most ``turn`` each."""
    poses: list[Pose2D] = []
    for leg in legs:
        along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(leg, axis=0).T))))
        at = np.arange(0.0, max(along[-1], 1.0e-9), step)
        x, y = np.interp(at, along, leg[:, 0]), np.interp(at, along, leg[:, 1])
        # The heading is that of a short piece of path ahead, as a robot steers.
        ahead = np.minimum(at + 0.3, along[-1])
        behind = ahead - 0.35
        u = np.interp(ahead, along, leg[:, 0]) - np.interp(behind, along, leg[:, 0])
        v = np.interp(ahead, along, leg[:, 1]) - np.interp(behind, along, leg[:, 1])
        for pose in map(Pose2D, x, y, np.arctan2(v, u)):
            if poses:
                poses.extend(_turns_between(poses[-1], pose, turn))
            poses.append(pose)
    return poses


def _turns_between(before: Pose2D, after: Pose2D, turn: float) -> Iterator[Pose2D]:
    """Poses of a turn on the spot, where the next heading is too far from this one."""
    angle = wrap_angle(after.theta - before.theta)
    parts = math.ceil(abs(angle) / turn)
    for part in range(1, parts):
        yield Pose2D(before.x, before.y, before.theta + angle * part / parts)


@kernel
def _cheapest_way(
    cost: NDArray[np.float64], row: int, column: int, goal_row: int, goal_column: int
) -> NDArray[np.int64]:
    """(N, 2) cells from start to goal by Dijkstra's algorithm; empty when there is no way."""
    rows, columns = cost.shape
    total = np.full((rows, columns), np.inf)
    parent = np.full((rows, columns), -1, dtype=np.int64)
    start, goal = row * columns + column, goal_row * columns + goal_column
    total[row, column] = 0.0
    queue = [(0.0, start)]
    while len(queue) > 0:
        so_far, cell = heappop(queue)
        i, j = cell // columns, cell % columns
        if cell == goal:
            break
        if so_far > total[i, j]:
            continue
        for di in range(-1, 2):
            for dj in range(-1, 2):
                k, m = i + di, j + dj
                if (di == 0 and dj == 0) or not (0 <= k < rows and 0 <= m < columns):
                    continue
                reached = so_far + math.hypot(di, dj) * cost[k, m]
                if reached < total[k, m]:
                    total[k, m] = reached
                    parent[k, m] = cell
                    heappush(queue, (reached, k * columns + m))
    length = 0
    cell = goal
    while cell >= 0 and np.isfinite(total[cell // columns, cell % columns]):
        length += 1
        cell = parent[cell // columns, cell % columns]
    way = np.empty((length, 2), dtype=np.int64)
    cell = goal
    for step in range(length - 1, -1, -1):
        way[step, 0], way[step, 1] = cell // columns, cell % columns
        cell = parent[cell // columns, cell % columns]
    return way
