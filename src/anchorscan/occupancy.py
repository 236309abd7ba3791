"""Occupancy grids: maps of free, occupied and unknown cells, and the scans they would give.

A grid carries the fields of ``nav_msgs/OccupancyGrid``; files are those of map_server.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._jit import kernel
from .errors import LogError
from .pose import Pose2D

__all__ = ["OccupancyGrid"]

UNKNOWN = -1


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """A map of square cells.

    The cell in row ``i`` and column ``j`` covers ``[j, j+1] x [i, i+1]`` times the
    resolution in the grid's frame, whose origin is the outer corner of cell (0, 0).

    Args:
        data: (H, W) int8: -1 unknown, else the occupancy in percent, 0 to 100; row 0 is the
            lowest y, as in ``nav_msgs/OccupancyGrid`` and unlike an image.
        resolution: Edge length of a cell, metres.
        origin: ``T_map_grid``, the pose of the outer corner of cell (0, 0).
        occupied_threshold: A cell is occupied from this share of 100 percent.
        free_threshold: A cell is free up to this share of 100 percent.

    Raises:
        LogError: The values cannot be a map.
    """

    data: NDArray[np.int8]
    resolution: float
    origin: Pose2D = Pose2D()
    occupied_threshold: float = 0.65
    free_threshold: float = 0.25

    def __post_init__(self) -> None:
        data = np.array(self.data, dtype=np.int8)
        if data.ndim != 2 or data.size == 0:
            raise LogError(f"a map needs rows and columns, not shape {data.shape}")
        if not (math.isfinite(self.resolution) and self.resolution > 0.0):
            raise LogError(f"the resolution must be positive metres, not {self.resolution}")
        if not self.origin.is_finite():
            raise LogError("the origin of the map must be finite")
        if not 0.0 <= self.free_threshold < self.occupied_threshold <= 1.0:
            raise LogError(
                f"thresholds out of order: free {self.free_threshold}, "
                f"occupied {self.occupied_threshold}"
            )
        data.setflags(write=False)
        object.__setattr__(self, "data", data)

    @cached_property
    def is_occupied(self) -> NDArray[np.bool_]:
        """(H, W) whether the cell is occupied."""
        return np.asarray(self.data >= 100.0 * self.occupied_threshold)

    @cached_property
    def is_free(self) -> NDArray[np.bool_]:
        """(H, W) whether the cell is known to be free."""
        return np.asarray((self.data >= 0) & (self.data <= 100.0 * self.free_threshold))

    @cached_property
    def clearance(self) -> NDArray[np.float64]:
        """(H, W) metres from the centre of the cell to that of the nearest occupied one."""
        return np.asarray(self.resolution * np.sqrt(_squared_distances(self.is_occupied)))

    def centres(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Return the (N, 2) centres, metres, map frame, of (N, 2) cells (row, column)."""
        array = np.asarray(cells, dtype=np.float64)
        return self.origin.apply((array[:, ::-1] + 0.5) * self.resolution)

    def cells(self, points: ArrayLike) -> NDArray[np.int64]:
        """Return the (N, 2) cells (row, column) of (N, 2) points, metres, map frame.

        Points outside the map give cells outside its rows and columns.
        """
        local = self.origin.inverse().apply(points)
        return np.floor(local[:, ::-1] / self.resolution).astype(np.int64)

    def regions(self) -> NDArray[np.int32]:
        """Number the connected free regions, (H, W): from one, zero where not free."""
        return np.asarray(_label(self.is_free))

    def reachable(self, radius: float) -> NDArray[np.bool_]:
        """Find where a round robot can be: the largest connected free region, eroded.

        Args:
            radius: Robot radius, metres.

        Returns:
            (H, W) whether the centre of the robot can be in the cell; all False when the
            robot fits nowhere.
        """
        labels = _label(self.is_free & (self.clearance > radius))
        sizes = np.bincount(labels.ravel())
        sizes[0] = 0
        return np.asarray((labels == np.argmax(sizes)) & (labels > 0))


@kernel
def _squared_distances(occupied: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Squared distance in cells to the nearest occupied one; inf when there is none.

    Exact, in two passes: along the columns, then along the rows by lower envelopes of
    parabolas (Felzenszwalb and Huttenlocher, Distance transforms of sampled functions, 2012).
    """
    rows, columns = occupied.shape
    squared = np.full((rows, columns), np.inf)
    for column in range(columns):
        for forward in range(2):
            gap = np.inf
            for step in range(rows):
                row = step if forward else rows - 1 - step
                gap = 0.0 if occupied[row, column] else gap + 1.0
                squared[row, column] = min(squared[row, column], gap * gap)
    for row in range(rows):
        _lower_envelope(squared[row])
    return squared


@kernel
def _lower_envelope(line: NDArray[np.float64]) -> None:
    """Replace ``line[i]`` by the least of ``line[j] + (i - j)**2`` over all ``j``."""
    count = len(line)
    heights = line.copy()
    apex = np.empty(count, dtype=np.int64)
    border = np.empty(count, dtype=np.float64)
    top = -1
    for index in range(count):
        if heights[index] == np.inf:
            continue
        start = -np.inf
        while top >= 0:
            other = apex[top]
            rise = heights[index] + index * index - heights[other] - other * other
            start = rise / (2.0 * (index - other))
            if start > border[top]:
                break
            top -= 1
        top += 1
        apex[top] = index
        border[top] = start if top > 0 else -np.inf
    if top < 0:
        return
    current = 0
    for index in range(count):
        while current < top and border[current + 1] < index:
            current += 1
        line[index] = heights[apex[current]] + (index - apex[current]) ** 2


@kernel
def _label(mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Number the 4-connected regions of ``mask`` from one; zero where it is False."""
    rows, columns = mask.shape
    labels = np.zeros((rows, columns), dtype=np.int32)
    stack = np.empty(rows * columns, dtype=np.int64)
    count = 0
    for first in range(rows * columns):
        if not mask[first // columns, first % columns] or labels[first // columns, first % columns]:
            continue
        count += 1
        labels[first // columns, first % columns] = count
        stack[0] = first
        height = 1
        while height > 0:
            height -= 1
            row, column = stack[height] // columns, stack[height] % columns
            for turn in range(4):
                i = row + (turn == 0) - (turn == 1)
                j = column + (turn == 2) - (turn == 3)
                if 0 <= i < rows and 0 <= j < columns and mask[i, j] and labels[i, j] == 0:
                    labels[i, j] = count
                    stack[height] = i * columns + j
                    height += 1
    return labels
