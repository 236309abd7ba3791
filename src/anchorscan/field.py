"""Beyond the paper: what all references together know of the place, cell by cell.

Section 5 checks a hypothesis against one reference scan.  Where references have poses in a
common frame, all of them together are the better overview: their readings, stitched, tell
for every cell how far the nearest surface is, whether rays passed through it (known free
space), and whether it is a surface itself.  A reading of a new scan that ends on a surface
speaks for a pose, one that ends in known free space against it, one that ends where nobody
looked says nothing; a ray that passes through a known surface speaks against it, too.

The map is kept in tiles of 64 x 64 cells, which exist only where a ray told something: on its
way, and within ``reach`` of its end.  A tile holds the evidence as integers (hits, their mean
position, passes), so that adding and removing a reference are exact opposites and the order of
references is irrelevant, and one byte a cell derived from it:

    bits 0-5   distance to the nearest surface in 63rds of ``reach``; 63 is farther
    bit 6      rays passed here: known free space
    bit 7      a surface: it was hit, and hit about as often as passed

A coarse copy (cells four times as wide) holds the best score of its cells, so that a pose
that is a few decimetres off can be told from a wrong one with a handful of look-ups.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .errors import AnchorscanError
from .pose import Pose2D
from .scan import LaserScan

__all__ = ["FieldSettings", "LikelihoodField", "Tiles"]

_SIDE = 64  # cells of a tile
_COARSE = 4  # cells of a coarse cell
_FAR = 63  # distance code of "farther than reach"
_FREE, _SURFACE = 64, 128
# Farther than this from all surfaces, metres, a ray is clear of them.
_CLEAR = 0.2
# A ray is followed no farther, metres: a reading may claim any length.
_LONGEST_RAY = 100.0
# A table of so many squares, a quarter of a gigabyte, is for a city.
_MOST_SQUARES = 1 << 26
# Hit positions are summed in 256ths of a cell, so that sums stay integers.
_FRACTIONS = 256
_1, _4, _6, _8, _12, _15, _63, _64 = (np.uint64(value) for value in (1, 4, 6, 8, 12, 15, 63, 64))


class FieldSettings(BaseModel):
    """Settings of the stitched map."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    resolution: float = Field(0.05, ge=0.01, le=1.0, description="width of a cell, metres")
    reach: float = Field(
        0.5, gt=0.0, le=3.0, description="distance to a surface that is told, metres"
    )
    farthest: float = Field(
        40.0, gt=0.0, le=1000.0, description="longer readings are left out, metres"
    )
    margin: float = Field(0.15, ge=0.0, description="end of a ray that frees nothing, metres")
    fewest_passes: int = Field(2, ge=1, description="rays that make free space known")
    passes_per_hit: float = Field(2.0, gt=0.0, description="more passes, and it is no surface")
    sharpness: float = Field(0.25, gt=0.0, description="distance that scores nothing, metres")
    unknown_score: float = Field(
        0.05, ge=0.0, le=1.0, description="score of a reading that ends where nobody looked"
    )
    free_penalty: float = Field(0.7, ge=0.0, description="score lost in known free space")

    def weights(self) -> NDArray[np.float32]:
        """(256,) score of a reading by the byte of the cell in which it ends."""
        code = np.arange(256)
        distance = (code & _FAR) * self.reach / _FAR
        score = np.maximum(self.unknown_score, 1.0 - distance / self.sharpness)
        near, far = 0.5 * self.sharpness, 0.75 * self.sharpness
        fall = np.interp(distance, (near, far), (0.5, -self.free_penalty))
        score = np.where(((code & _FREE) > 0) & (distance > near), fall, score)
        return score.astype(np.float32)


class Tiles(NamedTuple):
    """What kernels read of the map.

    Args:
        table: (height * width,) int32, which tile covers each square of the frame; 0 is the
            empty one, and the border squares have no other.
        codes: (T * 4096,) uint8, a byte a cell; tile 0 is all unknown.
        coarse: (T * 256,) int8, best score in each coarse cell, 127ths.
        width: Squares in a row of the table.
        height: Rows of the table.
        column: Cell column of the table's left border in the set's frame.
        row: Cell row of its lower border.
        resolution: Width of a cell, metres.
        reach: Distance that the codes tell, metres.
    """

    table: NDArray[np.int32]
    codes: NDArray[np.uint8]
    coarse: NDArray[np.int8]
    width: int
    height: int
    column: int
    row: int
    resolution: float
    reach: float


class _Evidence(NamedTuple):
    """Per tile and cell, what the rays found; integers, so that it can be taken back."""

    hits: NDArray[np.int32]
    x: NDArray[np.int32]
    y: NDArray[np.int32]
    passes: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class _Rays:
    """(N, 2) sensor positions and end points in the set's frame, metres."""

    origins: NDArray[np.float64]
    ends: NDArray[np.float64]


class LikelihoodField:
    """The map stitched from references, changed by one writer and read as ``tiles``.

    Args:
        settings: Of the map.
        scans: Scans and their poses ``T_set_laser`` to begin with.
    """

    def __init__(
        self, settings: FieldSettings, scans: Iterable[tuple[LaserScan, Pose2D]] = ()
    ) -> None:
        self._settings = settings
        self._table = np.zeros((1, 1), np.int32)
        self._corner = (0, 0)
        self._evidence = _no_evidence(1)
        self._codes = np.full((1, _SIDE, _SIDE), _FAR, np.uint8)
        self._coarse = np.zeros((1, _SIDE // _COARSE, _SIDE // _COARSE), np.int8)
        _pool(np.zeros(1, np.int32), self._codes, self._coarse, settings.weights())
        self._used = 1
        self._tiles = self._snapshot()
        self._change(self._rays(scans), 1)

    @property
    def tiles(self) -> Tiles:
        """The map as kernels read it; it stays as it is when others add and remove."""
        return self._tiles

    def _snapshot(self) -> Tiles:
        row, column = self._corner
        return Tiles(
            self._table.reshape(-1),
            self._codes.reshape(-1),
            self._coarse.reshape(-1),
            self._table.shape[1],
            self._table.shape[0],
            column * _SIDE,
            row * _SIDE,
            self._settings.resolution,
            self._settings.reach,
        )

    def add(self, scan: LaserScan, pose: Pose2D) -> None:
        """Add what a scan taken at ``pose`` (``T_set_laser``) shows."""
        self._change(self._rays([(scan, pose)]), 1)

    def remove(self, scan: LaserScan, pose: Pose2D) -> None:
        """Take back what ``add`` with the same scan and pose put in."""
        self._change(self._rays([(scan, pose)]), -1)

    def _rays(self, scans: Iterable[tuple[LaserScan, Pose2D]]) -> _Rays:
        origins, ends = [np.empty((0, 2))], [np.empty((0, 2))]
        for scan, pose in scans:
            points = scan.points
            points = points[np.hypot(points[:, 0], points[:, 1]) <= self._settings.farthest]
            ends.append(pose.apply(points))
            origins.append(np.broadcast_to((pose.x, pose.y), points.shape))
        return _Rays(np.concatenate(origins), np.concatenate(ends))

    def _change(self, rays: _Rays, sign: int) -> None:
        if not len(rays.ends):
            return
        self._cover(rays)
        touched = np.zeros(self._table.shape, np.bool_)
        row, column = self._corner
        frame = (column * _SIDE, row * _SIDE, self._settings.resolution, self._settings.margin)
        _touch(rays.origins, rays.ends, touched, frame, self._halo)
        self._allocate(touched)
        _deposit(rays.origins, rays.ends, self._table, self._evidence, frame, sign)
        self._derive(touched)
        self._tiles = self._snapshot()

    @property
    def _halo(self) -> int:
        """Cells within ``reach``."""
        return math.ceil(self._settings.reach / self._settings.resolution)

    def _cover(self, rays: _Rays) -> None:
        """Widen the table to all that rays tell of and a tile around it."""
        cells = np.concatenate([rays.origins, rays.ends]) / self._settings.resolution
        if not np.isfinite(cells).all():
            raise AnchorscanError("a reference has a pose that is not finite")
        low = np.floor((cells.min(axis=0) - self._halo) / _SIDE).astype(int) - 1
        high = np.floor((cells.max(axis=0) + self._halo) / _SIDE).astype(int) + 2
        row, column = self._corner
        if self._used > 1:
            low = np.minimum(low, (column, row))
            high = np.maximum(high, (column + self._table.shape[1], row + self._table.shape[0]))
        if float(high[0] - low[0]) * float(high[1] - low[1]) > _MOST_SQUARES:
            apart = float((high - low).max()) * _SIDE * self._settings.resolution
            raise AnchorscanError(f"references lie {apart / 1e3:.0f} km apart; is a pose wrong?")
        table = np.zeros((high[1] - low[1], high[0] - low[0]), np.int32)
        if self._used > 1:
            if table.shape == self._table.shape:
                return
            down, left = row - low[1], column - low[0]
            table[down : down + self._table.shape[0], left : left + self._table.shape[1]] = (
                self._table
            )
        self._table, self._corner = table, (int(low[1]), int(low[0]))

    def _allocate(self, touched: NDArray[np.bool_]) -> None:
        """Give every touched square a tile."""
        new = touched & (self._table == 0)
        count = int(new.sum())
        if count == 0:
            return
        table = self._table.copy()
        table[new] = np.arange(self._used, self._used + count, dtype=np.int32)
        need = self._used + count
        if need > len(self._codes):
            room = need if self._used == 1 else max(need, 2 * len(self._codes))
            self._evidence = _Evidence(*(_grown(layer, room, 0) for layer in self._evidence))
            self._codes = _grown(self._codes, room, _FAR)
            self._coarse = _grown(self._coarse, room, int(self._coarse[0, 0, 0]))
        self._table, self._used = table, need

    def _derive(self, touched: NDArray[np.bool_]) -> None:
        """Bring the bytes of the touched tiles up to date."""
        rows, columns = np.nonzero(touched)
        settings = self._settings
        limits = (
            settings.resolution,
            settings.reach,
            self._halo,
            settings.fewest_passes,
            settings.passes_per_hit,
        )
        codes, coarse = self._codes.copy(), self._coarse.copy()
        _derive(rows, columns, self._table, self._evidence, codes, limits)
        _pool(self._table[rows, columns], codes, coarse, settings.weights())
        self._codes, self._coarse = codes, coarse


def _no_evidence(count: int) -> _Evidence:
    return _Evidence(*(np.zeros((count, _SIDE, _SIDE), np.int32) for _ in range(4)))


def _grown(layer: NDArray, room: int, fill: int) -> NDArray:  # type: ignore[type-arg]
    grown = np.full((room, *layer.shape[1:]), fill, layer.dtype)
    grown[: len(layer)] = layer
    return grown


@kernel
def _steps(ox, oy, ex, ey, resolution, margin):  # type: ignore[no-untyped-def]
    """Number of cell-wide steps along a ray before its margin, and one step."""
    length = math.hypot(ex - ox, ey - oy)
    if length <= 0.0:
        return 0, 0.0, 0.0
    count = int(math.floor((length - margin) / resolution))
    return count, (ex - ox) / length * resolution, (ey - oy) / length * resolution


@kernel
def _touch(origins, ends, touched, frame, halo):  # type: ignore[no-untyped-def]
    """Mark the tiles that rays pass, and those within ``halo`` cells of their ends."""
    column, row, resolution, margin = frame
    for i in range(len(ends)):
        ox, oy, ex, ey = origins[i, 0], origins[i, 1], ends[i, 0], ends[i, 1]
        count, dx, dy = _steps(ox, oy, ex, ey, resolution, margin)
        for k in range(count):
            cx = int(math.floor((ox + k * dx) / resolution)) - column
            cy = int(math.floor((oy + k * dy) / resolution)) - row
            touched[cy // _SIDE, cx // _SIDE] = True
        cx = int(math.floor(ex / resolution)) - column
        cy = int(math.floor(ey / resolution)) - row
        for r in range((cy - halo) // _SIDE, (cy + halo) // _SIDE + 1):
            for c in range((cx - halo) // _SIDE, (cx + halo) // _SIDE + 1):
                touched[r, c] = True


@kernel
def _deposit(origins, ends, table, evidence, frame, sign):  # type: ignore[no-untyped-def]
    """Add the evidence of rays (sign 1), or take it back (sign -1)."""
    column, row, resolution, margin = frame
    for i in range(len(ends)):
        ox, oy, ex, ey = origins[i, 0], origins[i, 1], ends[i, 0], ends[i, 1]
        count, dx, dy = _steps(ox, oy, ex, ey, resolution, margin)
        last_x, last_y = -1, -1
        for k in range(count):
            cx = int(math.floor((ox + k * dx) / resolution)) - column
            cy = int(math.floor((oy + k * dy) / resolution)) - row
            if cx != last_x or cy != last_y:
                evidence.passes[table[cy // _SIDE, cx // _SIDE], cy % _SIDE, cx % _SIDE] += sign
                last_x, last_y = cx, cy
        gx, gy = ex / resolution, ey / resolution
        cx = int(math.floor(gx))
        cy = int(math.floor(gy))
        tile = table[(cy - row) // _SIDE, (cx - column) // _SIDE]
        v, u = (cy - row) % _SIDE, (cx - column) % _SIDE
        evidence.hits[tile, v, u] += sign
        evidence.x[tile, v, u] += sign * int((gx - cx) * _FRACTIONS)
        evidence.y[tile, v, u] += sign * int((gy - cy) * _FRACTIONS)


@kernel
def _derive(rows, columns, table, evidence, codes, limits):  # type: ignore[no-untyped-def]
    """Distances, free space and surfaces of the tiles at ``rows`` and ``columns``."""
    resolution, reach, halo, fewest_passes, passes_per_hit = limits
    distance = np.empty((_SIDE, _SIDE), np.float32)
    for n in range(len(rows)):
        tile = table[rows[n], columns[n]]
        distance[:] = np.inf
        for v in range(-halo, _SIDE + halo):
            for u in range(-halo, _SIDE + halo):
                r, c = rows[n] + v // _SIDE, columns[n] + u // _SIDE
                if r < 0 or c < 0 or r >= table.shape[0] or c >= table.shape[1]:
                    continue
                other = table[r, c]
                hits = evidence.hits[other, v % _SIDE, u % _SIDE]
                if hits <= 0:
                    continue
                x = u + (evidence.x[other, v % _SIDE, u % _SIDE] / hits + 0.5) / _FRACTIONS
                y = v + (evidence.y[other, v % _SIDE, u % _SIDE] / hits + 0.5) / _FRACTIONS
                for j in range(max(0, v - halo), min(_SIDE, v + halo + 1)):
                    for i in range(max(0, u - halo), min(_SIDE, u + halo + 1)):
                        off = (i + 0.5 - x) ** 2 + (j + 0.5 - y) ** 2
                        distance[j, i] = min(distance[j, i], off)
        for j in range(_SIDE):
            for i in range(_SIDE):
                code = int(min(math.sqrt(distance[j, i]) * resolution / reach, 1.0) * _FAR)
                passes, hits = evidence.passes[tile, j, i], evidence.hits[tile, j, i]
                if passes >= fewest_passes:
                    code += _FREE
                if hits > 0 and passes <= passes_per_hit * hits:
                    code += _SURFACE
                codes[tile, j, i] = code


@kernel
def _pool(tiles, codes, coarse, weights):  # type: ignore[no-untyped-def]
    """Best score in every coarse cell."""
    for n in range(len(tiles)):
        tile = tiles[n]
        for j in range(_SIDE // _COARSE):
            for i in range(_SIDE // _COARSE):
                best = np.float32(-1.0)
                for b in range(_COARSE):
                    for a in range(_COARSE):
                        score = weights[codes[tile, j * _COARSE + b, i * _COARSE + a]]
                        best = max(best, score)
                coarse[tile, j, i] = int(round(127.0 * best))


@kernel
def cell_code(tiles, cx, cy):  # type: ignore[no-untyped-def]
    """Byte of a cell of the table; the table's border is empty, so beyond it is unknown."""
    # Unsigned indices spare the check for negative ones, which costs more than the look-up.
    u = np.uint64(min(max(cx, 0), (tiles.width << 6) - 1))
    v = np.uint64(min(max(cy, 0), (tiles.height << 6) - 1))
    tile = tiles.table[(v >> _6) * np.uint64(tiles.width) + (u >> _6)]
    return tiles.codes[(np.uint64(tile) << _12) | ((v & _63) << _6) | (u & _63)]


@kernel
def coarse_score(tiles, cx, cy):  # type: ignore[no-untyped-def]
    """Best score (127ths) in a coarse cell of the table; 0 beyond its border."""
    u = np.uint64(min(max(cx, 0), (tiles.width << 4) - 1))
    v = np.uint64(min(max(cy, 0), (tiles.height << 4) - 1))
    tile = tiles.table[(v >> _4) * np.uint64(tiles.width) + (u >> _4)]
    return int(tiles.coarse[(np.uint64(tile) << _8) | ((v & _15) << _4) | (u & _15)])


@kernel
def field_scores(poses, points, tiles, weights):  # type: ignore[no-untyped-def]
    """(P,) mean score of (N, 2) points (scan frame) at each of (P, 3) poses."""
    scores = np.empty(len(poses))
    scale = 1.0 / tiles.resolution
    for p in range(len(poses)):
        c = math.cos(poses[p, 2]) * scale
        s = math.sin(poses[p, 2]) * scale
        x = poses[p, 0] * scale - tiles.column
        y = poses[p, 1] * scale - tiles.row
        total = 0.0
        for i in range(len(points)):
            cx = int(x + c * points[i, 0] - s * points[i, 1])
            cy = int(y + s * points[i, 0] + c * points[i, 1])
            total += weights[cell_code(tiles, cx, cy)]
        scores[p] = total / max(len(points), 1)
    return scores


@kernel
def _distance_at(tiles, gx, gy):  # type: ignore[no-untyped-def]
    """Distance to the nearest surface and its gradient, bilinear; in metres, cells in."""
    ix, iy = int(gx - 0.5), int(gy - 0.5)
    fx, fy = gx - 0.5 - ix, gy - 0.5 - iy
    unit = tiles.reach / _FAR
    u = np.uint64(min(max(ix, 0), (tiles.width << 6) - 1))
    v = np.uint64(min(max(iy, 0), (tiles.height << 6) - 1))
    if (u & _63) != _63 and (v & _63) != _63:
        # All four cells lie in one tile, as they do for 97 readings of 100.
        tile = tiles.table[(v >> _6) * np.uint64(tiles.width) + (u >> _6)]
        at = (np.uint64(tile) << _12) | ((v & _63) << _6) | (u & _63)
        a = (tiles.codes[at] & _FAR) * unit
        b = (tiles.codes[at + _1] & _FAR) * unit
        c = (tiles.codes[at + _64] & _FAR) * unit
        d = (tiles.codes[at + _64 + _1] & _FAR) * unit
    else:
        a = (cell_code(tiles, ix, iy) & _FAR) * unit
        b = (cell_code(tiles, ix + 1, iy) & _FAR) * unit
        c = (cell_code(tiles, ix, iy + 1) & _FAR) * unit
        d = (cell_code(tiles, ix + 1, iy + 1) & _FAR) * unit
    value = (a * (1.0 - fx) + b * fx) * (1.0 - fy) + (c * (1.0 - fx) + d * fx) * fy
    dx = ((b - a) * (1.0 - fy) + (d - c) * fy) / tiles.resolution
    dy = ((c - a) * (1.0 - fx) + (d - b) * fx) / tiles.resolution
    return value, dx, dy


@kernel
def normal_equations(pose, points, tiles, scale):  # type: ignore[no-untyped-def]
    """Gauss-Newton terms of the robust distances of points to surfaces.

    Returns the (3, 3) Hessian, the (3,) gradient, the weighted sum of squared distances
    and the sum of weights (Geman-McClure weights of the given scale).
    """
    hessian = np.zeros((3, 3))
    gradient = np.zeros(3)
    squares, total = 0.0, 0.0
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(len(points)):
        rx = c * points[i, 0] - s * points[i, 1]
        ry = s * points[i, 0] + c * points[i, 1]
        gx = (pose[0] + rx) / tiles.resolution - tiles.column
        gy = (pose[1] + ry) / tiles.resolution - tiles.row
        value, dx, dy = _distance_at(tiles, gx, gy)
        if value >= 0.9 * tiles.reach:
            continue
        weight = 1.0 / (1.0 + (value / scale) ** 2)
        weight *= weight
        dt = dy * rx - dx * ry
        gradient[0] += weight * dx * value
        gradient[1] += weight * dy * value
        gradient[2] += weight * dt * value
        hessian[0, 0] += weight * dx * dx
        hessian[0, 1] += weight * dx * dy
        hessian[0, 2] += weight * dx * dt
        hessian[1, 1] += weight * dy * dy
        hessian[1, 2] += weight * dy * dt
        hessian[2, 2] += weight * dt * dt
        squares += weight * value * value
        total += weight
    hessian[1, 0] = hessian[0, 1]
    hessian[2, 0] = hessian[0, 2]
    hessian[2, 1] = hessian[1, 2]
    return hessian, gradient, squares, total


@kernel
def _solved(h, g, damping):  # type: ignore[no-untyped-def]
    """Solve the damped symmetric 3 x 3 system by Cramer's rule."""
    a, b, c = h[0, 0] + damping, h[0, 1], h[0, 2]
    d, e, f = h[1, 1] + damping, h[1, 2], h[2, 2] + damping
    p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * p + b * q + c * r
    x = (p * g[0] + q * g[1] + r * g[2]) / determinant
    y = (q * g[0] + (a * f - c * c) * g[1] + (b * c - a * e) * g[2]) / determinant
    z = (r * g[0] + (b * c - a * e) * g[1] + (a * d - b * b) * g[2]) / determinant
    return x, y, z


@kernel
def refined(pose, points, tiles, iterations):  # type: ignore[no-untyped-def]
    """Move a (3,) pose so that points lie on surfaces: damped Gauss-Newton, bounded steps."""
    moved = pose.copy()
    for step in range(iterations):
        # From coarse to fine: wide weights first, so that the pose can still travel.
        scale = 0.2 if 2 * step < iterations else 0.1
        hessian, gradient, _, _ = normal_equations(moved, points, tiles, scale)
        x, y, theta = _solved(hessian, gradient, 1.0)
        size = math.hypot(x, y)
        share = 1.0 if size < 0.1 else 0.1 / size
        moved[0] -= share * x
        moved[1] -= share * y
        moved[2] -= share * theta
        if size < 0.002 and abs(theta) < 0.0005 and 2 * step >= iterations:
            break
    return moved


@kernel
def passed_through(pose, points, tiles, margin):  # type: ignore[no-untyped-def]
    """Share of rays that pass through a known surface more than ``margin`` before their end.

    A ray passes through when it is clear of all surfaces shortly before and shortly after it
    meets one: a ray that grazes a wall touches its cells without passing through.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x = pose[0] / tiles.resolution - tiles.column
    y = pose[1] / tiles.resolution - tiles.row
    clear = int(_CLEAR / tiles.reach * _FAR)
    shortly = int(2.0 * _CLEAR / tiles.resolution)
    through = 0
    for i in range(len(points)):
        length = math.hypot(points[i, 0], points[i, 1])
        dx = (c * points[i, 0] - s * points[i, 1]) / length
        dy = (s * points[i, 0] + c * points[i, 1]) / length
        last_clear, met = -shortly, -1
        for k in range(int((min(length, _LONGEST_RAY) - margin) / tiles.resolution)):
            code = cell_code(tiles, int(x + k * dx), int(y + k * dy))
            if (code & _FAR) >= clear:
                if met >= 0 and k - met <= shortly:
                    through += 1
                    break
                last_clear, met = k, -1
            elif code & _SURFACE and met < 0 and k - last_clear <= shortly:
                met = k
    return through / max(len(points), 1)
