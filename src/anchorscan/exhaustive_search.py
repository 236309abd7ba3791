"""Exhaustive search: the ceiling of what one scan tells, at the price of looking everywhere.

A baseline of the benchmark, not a part of the pipeline.  The map is stitched from the points of
**all** references; each cell of a likelihood grid holds ``exp(-d^2 / (2 sigma^2))`` of the
distance ``d`` from its centre to the nearest point.  The score of a pose is the mean likelihood
under the end points of the scan's returns, and the pose of the highest score over every cell and
every heading is found exactly, by branch and bound over max-pooled copies of the grid, best node
first (Olson, "Real-time correlative scan matching", 2009; Hess et al., "Real-time loop closure in
2D LIDAR SLAM", 2016).  Scores are sums of 8-bit cells, so that equal means equal.

The search goes on until the best *other* place is proved too: best of all poses at least 0.5 m
or 20 degrees away.  The margin between the two is what tells look-alikes from the one true place.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .pose import Pose2D
from .reference import Reference
from .scan import LaserScan

__all__ = ["ExhaustiveSearch", "Place"]

# How far from a place a pose must be to count as another one.
_OTHER_POSITION = 0.5
_OTHER_HEADING = math.radians(20.0)

# Bits of a node in the queue: column, row (the same), heading, depth; the sum lies above them.
_CELL_BITS = 14
_HEADING_BITS = 12
_DEPTH_BITS = 3

# What the search must know of the poses, by its index in one array: the grid cell of the first
# pose cell, the numbers of pose cells and of headings, and the steps in heading and the squared
# distance in cells from which on a pose is another place.
_LEFT, _LOW, _COLUMNS, _ROWS, _HEADINGS, _OTHER_TURN, _OTHER_CELLS = range(7)


@dataclass(frozen=True)
class Place:
    """A pose that no better-scoring pose lies near.

    Args:
        pose: ``T_set_laser`` after refinement.
        score: Mean likelihood of the returns at that pose on the fine grid, in [0, 1].
        grid_score: Mean likelihood of the best cell and heading on the search grid, in [0, 1].
    """

    pose: Pose2D
    score: float
    grid_score: float


class ExhaustiveSearch:
    """Find the best pose of a scan on the map stitched from all references.

    Args:
        references: Those with a pose make the map; the others are passed over.
        resolution: Side of a cell of the search grid, metres.
        deviation: Sigma of the likelihood, metres.
        margin: How far outside the box around the references' poses a pose may lie, metres.
        readings: At most so many returns are used, at equal steps through the scan.
        levels: Number of max-pooled grids; the coarsest node is ``2 ** (levels - 1)`` cells wide.

    Raises:
        ValueError: No reference has a pose, the area has too many cells to number, or there are
            more than eight levels.
    """

    def __init__(
        self,
        references: Iterable[Reference],
        *,
        resolution: float = 0.1,
        deviation: float = 0.15,
        margin: float = 3.0,
        readings: int = 180,
        levels: int = 7,
    ) -> None:
        if not 1 <= levels <= 1 << _DEPTH_BITS:
            raise ValueError(f"1 to {1 << _DEPTH_BITS} levels are possible, not {levels}")
        posed = [r for r in references if r.pose is not None and r.pose.is_finite()]
        if not posed:
            raise ValueError("exhaustive search needs references with poses")
        self._resolution = resolution
        self._readings = readings
        poses = np.array([r.pose.to_array()[:2] for r in posed if r.pose is not None])
        points = np.concatenate([r.pose.apply(r.scan.points) for r in posed if r.pose is not None])
        self._low = poses.min(axis=0) - margin
        self._shape = np.ceil((poses.max(axis=0) + margin - self._low) / resolution).astype(int) + 1
        if self._shape.max() >= 1 << _CELL_BITS:
            raise ValueError(f"{self._shape.max()} cells on a side are more than can be searched")
        # Pose cells are counted from the box of poses, grid cells from the corner of the points.
        reach = 4.0 * deviation
        self._corner = points.min(axis=0) - reach if len(points) else self._low
        extent = (points.max(axis=0) - self._corner + reach) if len(points) else np.zeros(2)
        self._grids = pyramid(
            likelihood_grid(points, self._corner, extent, resolution, deviation), levels
        )
        self._shift = np.floor((self._low - self._corner) / resolution).astype(np.int64)
        self._fine_resolution = 0.5 * resolution
        self._fine = likelihood_grid(
            points, self._corner, extent, self._fine_resolution, 0.5 * deviation
        )

    def locate(self, scan: LaserScan, places: int = 2) -> list[Place]:
        """Find the best poses that are different places, highest score first.

        Args:
            scan: The query.
            places: How many to prove; fewer are returned when fewer score above zero.
        """
        points = self._sample(scan)
        if not len(points):
            return []
        headings = self._headings(points)
        offsets = self._offsets(points, headings)
        found = _search(self._grids, offsets, self._box(len(headings)), places)
        return sorted(
            (self._refine(points, row, headings) for row in found),
            key=lambda place: -place.score,
        )

    def _box(self, headings: int) -> NDArray[np.int64]:
        """Return (7,) numbers of the search, by their index."""
        box = np.empty(7, dtype=np.int64)
        box[[_LEFT, _LOW]] = self._shift + (1 << (len(self._grids) - 1)) - 1
        box[[_COLUMNS, _ROWS]] = self._shape
        box[_HEADINGS] = headings
        box[_OTHER_TURN] = math.ceil(_OTHER_HEADING * headings / (2.0 * math.pi))
        box[_OTHER_CELLS] = math.ceil((_OTHER_POSITION / self._resolution) ** 2 - 1e-9)
        return box

    def _sample(self, scan: LaserScan) -> NDArray[np.float64]:
        points = scan.points
        kept = np.linspace(0, len(points) - 1, min(self._readings, len(points))).astype(np.int64)
        return points[kept]

    def _headings(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Step so that nine tenths of the points move by no more than a cell."""
        reach = float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 90))
        step = min(max(self._resolution / max(reach, 1e-6), math.radians(0.5)), math.radians(2.0))
        count = math.ceil(2.0 * math.pi / step)
        return np.linspace(0.0, 2.0 * math.pi, count, endpoint=False)

    def _offsets(
        self, points: NDArray[np.float64], headings: NDArray[np.float64]
    ) -> NDArray[np.int32]:
        """Return (A, N, 2) cells from the pose's cell to each point, for every heading."""
        c, s = np.cos(headings)[:, None], np.sin(headings)[:, None]
        x, y = points[:, 0], points[:, 1]
        rotated = np.stack((c * x - s * y, s * x + c * y), axis=-1)
        return np.floor(rotated / self._resolution + 0.5).astype(np.int32)

    def _refine(
        self,
        points: NDArray[np.float64],
        row: NDArray[np.int64],
        headings: NDArray[np.float64],
    ) -> Place:
        """Climb on the fine grid, no farther than to the next cell and heading.

        Without that limit the best other place, which often lies at the foot of the best one,
        would climb up to it.
        """
        x, y, heading, total = row
        position = self._corner + (self._shift + (x, y) + 0.5) * self._resolution
        start = np.array([*position, headings[heading]])
        origin = np.array([*self._corner, self._fine_resolution])
        reach = np.array([self._resolution, self._resolution, headings[1] - headings[0]])
        best, score = _climb(self._fine, origin, points, start, reach)
        return Place(Pose2D.from_array(best), float(score), float(total) / (255.0 * len(points)))


def likelihood_grid(
    points: NDArray[np.float64],
    corner: NDArray[np.float64],
    extent: NDArray[np.float64],
    resolution: float,
    deviation: float,
) -> NDArray[np.uint8]:
    """Return (H, W) likelihood of each cell, 255 for 1, zero beyond four deviations.

    Args:
        points: (N, 2) metres.
        corner: (2,) lower corner of cell (0, 0), metres.
        extent: (2,) width and height, metres.
        resolution: Side of a cell, metres.
        deviation: Sigma, metres.
    """
    width, height = (np.ceil(extent / resolution)).astype(int) + 1
    grid = np.zeros((height, width), dtype=np.uint8)
    _splat(grid, points, corner, resolution, deviation)
    return grid


def pyramid(grid: NDArray[np.uint8], levels: int) -> NDArray[np.uint8]:
    """Return (levels, H + P, W + P) grids, ``P = 2 ** (levels - 1) - 1`` cells of padding before.

    Cell ``(P + y, P + x)`` of level ``k`` holds the largest of the ``2 ** k`` by ``2 ** k`` cells
    that begin at ``(y, x)``.
    """
    pad = (1 << (levels - 1)) - 1
    grids = np.zeros((levels, grid.shape[0] + pad, grid.shape[1] + pad), dtype=np.uint8)
    grids[0, pad:, pad:] = grid
    for level in range(1, levels):
        half = 1 << (level - 1)
        below, above = grids[level - 1], grids[level]
        above[:] = below
        above[:, :-half] = np.maximum(above[:, :-half], below[:, half:])
        rows = above.copy()
        above[:-half] = np.maximum(rows[:-half], rows[half:])
    return grids


@kernel
def _splat(
    grid: NDArray[np.uint8],
    points: NDArray[np.float64],
    corner: NDArray[np.float64],
    resolution: float,
    deviation: float,
) -> None:
    """Raise every cell near a point to the likelihood of its distance."""
    height, width = grid.shape
    radius = int(math.ceil(4.0 * deviation / resolution))
    for i in range(len(points)):
        u = (points[i, 0] - corner[0]) / resolution
        v = (points[i, 1] - corner[1]) / resolution
        column, row = int(math.floor(u)), int(math.floor(v))
        for y in range(max(row - radius, 0), min(row + radius + 1, height)):
            for x in range(max(column - radius, 0), min(column + radius + 1, width)):
                d = ((x + 0.5 - u) ** 2 + (y + 0.5 - v) ** 2) * (resolution / deviation) ** 2
                if d <= 16.0:
                    value = np.uint8(math.floor(255.0 * math.exp(-0.5 * d) + 0.5))
                    grid[y, x] = max(grid[y, x], value)


@kernel
def _sum(grid: NDArray[np.uint8], offsets: NDArray[np.int32], column: int, row: int) -> int:
    """Sum the cells under the points of one heading, with the pose in (column, row)."""
    height, width = grid.shape
    total = 0
    for i in range(len(offsets)):
        x = column + offsets[i, 0]
        y = row + offsets[i, 1]
        if 0 <= x < width and 0 <= y < height:
            total += grid[y, x]
    return total


@kernel
def _packed(total: int, depth: int, heading: int, row: int, column: int) -> int:
    """Make one number of a node that sorts by its sum, and among equal sums by its depth."""
    node = (total << _DEPTH_BITS) | depth
    node = (node << _HEADING_BITS) | heading
    return (((node << _CELL_BITS) | row) << _CELL_BITS) | column


@kernel
def _unpacked(node: int) -> tuple[int, int, int, int, int]:
    """Return sum, depth, heading, row and column of a node."""
    column = node & ((1 << _CELL_BITS) - 1)
    node >>= _CELL_BITS
    row = node & ((1 << _CELL_BITS) - 1)
    node >>= _CELL_BITS
    heading = node & ((1 << _HEADING_BITS) - 1)
    node >>= _HEADING_BITS
    return node >> _DEPTH_BITS, node & ((1 << _DEPTH_BITS) - 1), heading, row, column


@kernel
def _push(queue: NDArray[np.int64], count: int, node: int) -> NDArray[np.int64]:
    """Add a node to a binary heap of ``count``, largest first; return the heap, grown if full."""
    if count == len(queue):
        queue = np.concatenate((queue, np.empty_like(queue)))
    i = count
    while i > 0 and queue[(i - 1) >> 1] < node:
        queue[i] = queue[(i - 1) >> 1]
        i = (i - 1) >> 1
    queue[i] = node
    return queue


@kernel
def _pop(queue: NDArray[np.int64], count: int) -> int:
    """Take the largest node out of a binary heap of ``count``, which then holds one less."""
    top, last = queue[0], queue[count - 1]
    i, child = 0, 1
    while child < count - 1:
        if child + 1 < count - 1 and queue[child + 1] > queue[child]:
            child += 1
        if queue[child] <= last:
            break
        queue[i] = queue[child]
        i, child = child, 2 * child + 1
    queue[i] = last
    return int(top)


@kernel
def _is_known(
    found: NDArray[np.int64], column: int, row: int, heading: int, side: int, box: NDArray[np.int64]
) -> bool:
    """Tell whether all cells of a node belong to one of the places already found."""
    for i in range(len(found)):
        turn = abs(found[i, 2] - heading)
        turn = min(turn, box[_HEADINGS] - turn)
        x = max(abs(column - found[i, 0]), abs(column + side - 1 - found[i, 0]))
        y = max(abs(row - found[i, 1]), abs(row + side - 1 - found[i, 1]))
        if turn < box[_OTHER_TURN] and x * x + y * y < box[_OTHER_CELLS]:
            return True
    return False


@kernel
def _roots(
    grids: NDArray[np.uint8], offsets: NDArray[np.int32], box: NDArray[np.int64]
) -> tuple[NDArray[np.int64], int]:
    """Bound the widest nodes of every heading, as a heap and its count."""
    side = 1 << (len(grids) - 1)
    queue, count = np.empty(1 << 16, dtype=np.int64), 0
    for heading in range(len(offsets)):
        for row in range(0, box[_ROWS], side):
            for column in range(0, box[_COLUMNS], side):
                total = _sum(grids[-1], offsets[heading], box[_LEFT] + column, box[_LOW] + row)
                queue = _push(queue, count, _packed(total, 0, heading, row, column))
                count += 1
    return queue, count


@kernel
def _search(
    grids: NDArray[np.uint8], offsets: NDArray[np.int32], box: NDArray[np.int64], places: int
) -> NDArray[np.int64]:
    """Find the best cells and headings that are different places.

    Args:
        grids: (L, H, W) max-pooled likelihoods, as ``pyramid`` makes them.
        offsets: (A, N, 2) cells from the pose to each point, for every heading.
        box: (7,) where poses may be and what makes another place, in cells and headings.
        places: How many to find.

    Returns:
        (P, 4) column, row, heading and sum of each place, largest sum first.
    """
    found = np.empty((places, 4), dtype=np.int64)
    known = 0
    queue, count = _roots(grids, offsets, box)
    while count > 0 and known < places:
        total, depth, heading, row, column = _unpacked(_pop(queue, count))
        count -= 1
        level = len(grids) - 1 - depth
        if total == 0:
            break
        if _is_known(found[:known], column, row, heading, 1 << level, box):
            continue
        if level == 0:
            found[known] = (column, row, heading, total)
            known += 1
            continue
        half = 1 << (level - 1)
        for y in range(row, min(row + 2 * half, box[_ROWS]), half):
            for x in range(column, min(column + 2 * half, box[_COLUMNS]), half):
                total = _sum(grids[level - 1], offsets[heading], box[_LEFT] + x, box[_LOW] + y)
                queue = _push(queue, count, _packed(total, depth + 1, heading, y, x))
                count += 1
    return found[:known]


@kernel
def _mean(
    grid: NDArray[np.uint8],
    origin: NDArray[np.float64],
    points: NDArray[np.float64],
    pose: NDArray[np.float64],
) -> float:
    """Mean likelihood under the points at a pose, interpolated between cell centres."""
    height, width = grid.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    total = 0.0
    for i in range(len(points)):
        u = (pose[0] + c * points[i, 0] - s * points[i, 1] - origin[0]) / origin[2] - 0.5
        v = (pose[1] + s * points[i, 0] + c * points[i, 1] - origin[1]) / origin[2] - 0.5
        x, y = int(math.floor(u)), int(math.floor(v))
        if 0 <= x < width - 1 and 0 <= y < height - 1:
            a, b = u - x, v - y
            total += (1.0 - b) * ((1.0 - a) * grid[y, x] + a * grid[y, x + 1])
            total += b * ((1.0 - a) * grid[y + 1, x] + a * grid[y + 1, x + 1])
    return total / (255.0 * len(points))


@kernel
def _climb(
    grid: NDArray[np.uint8],
    origin: NDArray[np.float64],
    points: NDArray[np.float64],
    start: NDArray[np.float64],
    reach: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Take steps along x, y and heading while they help, then halve them, until they are small.

    Args:
        grid: (H, W) likelihood, 255 for 1.
        origin: (3,) lower corner of the grid and side of a cell, metres.
        points: (N, 2) metres, scan frame.
        start: (3,) pose.
        reach: (3,) how far from the start it may go; the first step is half of it.
    """
    best = start.copy()
    trial = start.copy()
    score = _mean(grid, origin, points, best)
    for halving in range(1, 6):
        improved = True
        while improved:
            improved = False
            for axis in range(3):
                for sign in (-1.0, 1.0):
                    trial[:] = best
                    trial[axis] += sign * reach[axis] / (1 << halving)
                    if abs(trial[axis] - start[axis]) > reach[axis] * 1.001:
                        continue
                    value = _mean(grid, origin, points, trial)
                    if value > score:
                        best[:] = trial
                        score, improved = value, True
    return best, score
