"""Beyond the paper: what all references together know of the place, cell by cell.

Section 5 checks a hypothesis against one reference scan.  Where references have poses in a
common frame, all of them together are the better overview: their readings, stitched, tell
for every cell how far the nearest surface is, whether rays passed through it (known free
space), and whether it is a surface itself.  A reading of a new scan that ends on a surface
speaks for a pose, one that ends in known free space against it, one that ends where nobody
looked says nothing; a ray that passes through a known surface speaks against it, too.

The map is kept in tiles of 64 x 64 cells, which exist only where a ray told something: on its
way, and within ``reach`` of its end.  A tile has evidence in integers (``evidence``), so that
adding and removing a reference are exact opposites and the order of references is irrelevant,
and one byte a cell derived from it, which says how far the nearest surface is, whether the cell is
known free space, and whether it is a surface itself (``tiles``).

Whoever reads keeps the map that was there when reading began: a change writes new versions of the
tiles and pages that it touches, and no others, so that its price does not grow with the map.

Bytes are derived when the map is next read: what several changes have touched is derived once.
When very much has been touched, the change itself derives it, so that no reader waits for long.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .errors import AnchorscanError
from .evidence import SIDE as _SIDE
from .evidence import TileEvidence
from .pose import Pose2D
from .scan import LaserScan
from .score import Weights
from .tiles import FAR, FREE, SURFACE, Tiles

__all__ = ["FieldArrays", "FieldSettings", "LikelihoodField"]

_BLOCK = 8  # cells of the blocks of a tile that are derived anew
_BLOCKS = _SIDE // _BLOCK
_ALL_BLOCKS = (1 << _BLOCKS * _BLOCKS) - 1
_COARSE = 4  # cells of a coarse cell
_PAGE = 64  # squares along a side of a page of the table
# So many pages cover fifty kilometres times fifty with cells of 5 cm.
_MOST_PAGES = 1 << 16
# Farther from the origin than any frame on the ground, metres; cells beyond it have no numbers.
_FARTHEST = 1e8
# So many squares at most wait to be derived: about fifty milliseconds for the next reader.
_MOST_WAITING = 512
# Tiles whose evidence is worked on at once, and rays that are deposited at once.
_GROUP = 1024
_MANY_RAYS = 1 << 14
# Scans that lie so many squares apart are not deposited at once.
_WIDEST = 256
_CENTRES = np.arange(_BLOCK, dtype=np.float32) + np.float32(0.5)
# Hit positions are summed in 256ths of a cell, so that sums stay integers.
_FRACTIONS = 256
_1 = np.uint64(1)


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
    new_share: float = Field(
        0.1,
        gt=0.0,
        le=1.0,
        description="a reading on a new thing, maybe a person, counts as this share of one",
    )
    new_price: float = Field(
        1.6, ge=1.0, description="new things have to leave so many times less unexplained"
    )

    def weights(self) -> Weights:
        """What a reading is worth, and which may be of new things: see ``field_scores``."""
        code = np.arange(256)
        distance = (code & FAR) * self.reach / FAR
        score = np.maximum(self.unknown_score, 1.0 - distance / self.sharpness)
        near, far = 0.5 * self.sharpness, 0.75 * self.sharpness
        fall = np.interp(distance, (near, far), (0.5, -self.free_penalty))
        is_free = ((code & FREE) > 0) & (distance > near)
        scores = np.where(is_free, fall, score).astype(np.float32)
        return Weights(scores, is_free, self.new_share, self.new_price)


class FieldArrays(NamedTuple):
    """A map as plain arrays, to be stored.

    Args:
        squares: (T, 2) int32 row and column of every tile, in this order.
        evidence: (E,) uint8, their packed evidence, one behind the other.
        evidence_starts: (T + 1,) int64, where that of each begins.
        coarse: (T + 1, 256) int8 as in ``Tiles``, in the order of the squares after the empty one.
        codes: (T + 1, 4096) uint8 likewise; may have room for more.
    """

    squares: NDArray[np.int32]
    evidence: NDArray[np.uint8]
    evidence_starts: NDArray[np.int64]
    coarse: NDArray[np.int8]
    codes: NDArray[np.uint8]


class _Rays(NamedTuple):
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
        unknown = np.full((1, _SIDE * _SIDE), FAR, np.uint8)
        coarse = np.zeros((1, (_SIDE // _COARSE) ** 2), np.int8)
        everything = np.full((1, 2), _ALL_BLOCKS, np.uint64)
        _pool(np.zeros(1, np.int32), everything, unknown, coarse, settings.weights().scores)
        self._begin(settings, TileEvidence(), unknown, coarse, 1)
        stale: set[tuple[int, int]] = set()
        for rays in self._batches(scans):
            touched, _ = self._deposit(rays, 1)
            stale.update(map(tuple, touched.tolist()))
        squares = np.array(sorted(stale), np.int64).reshape(-1, 2)
        self._make_room(len(squares))  # at once: growing copies, and leaves room that nobody needs
        self._derive_all(squares, np.full((len(squares), 2), _ALL_BLOCKS, np.uint64))
        self._publish()

    @classmethod
    def from_arrays(cls, settings: FieldSettings, arrays: FieldArrays) -> LikelihoodField:
        """Take up a map as it was stored; its arrays are used, not copied.

        Raises:
            ValueError: The arrays do not fit each other.
        """
        squares, codes, coarse = arrays.squares, arrays.codes, arrays.coarse
        count = len(squares)
        if (
            squares.shape != (count, 2)
            or codes.ndim != 2
            or codes.shape[1] != _SIDE * _SIDE
            or coarse.shape != (len(codes), (_SIDE // _COARSE) ** 2)
            or len(codes) <= count
        ):
            raise ValueError("the tiles of the map have other sizes")
        field = cls.__new__(cls)
        evidence = TileEvidence(squares, arrays.evidence, arrays.evidence_starts)
        field._begin(settings, evidence, codes, coarse, count + 1)
        if count:
            field._cover(squares.min(axis=0) - 1, squares.max(axis=0) + 2)
            field._point(squares.astype(np.int64), np.arange(1, count + 1, dtype=np.int32))
        field._live = count
        field._publish()
        return field

    def _begin(
        self,
        settings: FieldSettings,
        evidence: TileEvidence,
        codes: NDArray[np.uint8],
        coarse: NDArray[np.int8],
        used: int,
    ) -> None:
        self._settings = settings
        self._scores = settings.weights().scores
        self._evidence = evidence
        self._pages = np.zeros((1, 1), np.int32)
        self._corner = (0, 0)  # of the pages, counted in pages
        self._is_placed = False
        self._table = np.zeros((1, _PAGE * _PAGE), np.int32)
        self._table_used = self._table_published = 1
        self._codes, self._coarse = codes, coarse
        self._used = self._published = used
        self._live = 0
        # Squares with blocks that wait to be derived, as ``_deposit`` tells them.
        self._changing = threading.RLock()
        self._waiting: dict[tuple[int, int], NDArray[np.uint64]] = {}
        self._publish()

    @property
    def tiles(self) -> Tiles:
        """The map as kernels read it; it stays as it is when others add and remove."""
        if self._waiting:
            with self._changing:
                self._derive_waiting()
        return self._tiles

    def arrays(self) -> FieldArrays:
        """Return the map as plain arrays, all that ``from_arrays`` needs."""
        with self._changing:
            self._derive_waiting()
            return self._arrays()

    def _arrays(self) -> FieldArrays:
        pages = np.argwhere(self._pages)
        rows, columns, tiles = [], [], []
        for i, j in pages.tolist():
            page = self._table[self._pages[i, j]]
            at = np.flatnonzero(page)
            rows.append((self._corner[0] + i) * _PAGE + at // _PAGE)
            columns.append((self._corner[1] + j) * _PAGE + at % _PAGE)
            tiles.append(page[at])
        squares = np.column_stack([np.concatenate([[], *part]) for part in (rows, columns)])
        squares = squares.astype(np.int64).reshape(-1, 2)
        numbers = np.concatenate([np.empty(0, np.int32), *tiles])
        order = np.lexsort((squares[:, 1], squares[:, 0]))
        squares, numbers = squares[order], numbers[order]
        # What was removed leaves tiles that tell nothing.
        evidence, starts = self._evidence.packed(squares)
        told = np.array([np.any(self._codes[number] != FAR) for number in numbers], np.bool_)
        told |= np.diff(starts) > 0
        numbers = np.concatenate([[0], numbers[told]]).astype(np.int64)
        return FieldArrays(
            squares[told].astype(np.int32),
            evidence,
            np.append(starts[:-1][told], starts[-1]),
            _rows(self._coarse, numbers),
            _rows(self._codes, numbers),
        )

    def check_room(self, poses: Iterable[Pose2D]) -> None:
        """See that scans taken at some poses can be added.

        Raises:
            AnchorscanError: They lie too far from the origin, or from what there is.
        """
        positions = []
        for pose in poses:
            _check_pose(pose)
            positions.append((pose.y, pose.x))  # rows before columns
        if positions:
            reach = self._settings.farthest + self._settings.reach
            tile = _SIDE * self._settings.resolution
            low = (np.min(positions, axis=0) - reach) / tile
            high = (np.max(positions, axis=0) + reach) / tile
            self._covering(np.floor(low) - 1, np.floor(high) + 2)

    def add(self, scan: LaserScan, pose: Pose2D) -> None:
        """Add what a scan taken at ``pose`` (``T_set_laser``) shows."""
        self._change(scan, pose, 1)

    def remove(self, scan: LaserScan, pose: Pose2D) -> None:
        """Take back what ``add`` with the same scan and pose put in."""
        self._change(scan, pose, -1)

    def _change(self, scan: LaserScan, pose: Pose2D, sign: int) -> None:
        with self._changing:
            for rays in self._batches([(scan, pose)]):
                touched, dirty = self._deposit(rays, sign)
                # Opened here, since damaged evidence is the writer's to hear of.
                self._evidence.rows(self._around(touched), make=False)
                for square, blocks in zip(map(tuple, touched.tolist()), dirty, strict=True):
                    if square in self._waiting:
                        self._waiting[square] |= blocks
                    else:
                        self._waiting[square] = blocks
            if len(self._waiting) > _MOST_WAITING:
                self._derive_waiting()

    def _derive_waiting(self) -> None:
        """Bring the map up to date for readers."""
        if not self._waiting:
            return
        squares = np.array(sorted(self._waiting), np.int64)
        dirty = np.array([self._waiting[square] for square in map(tuple, squares.tolist())])
        self._derive_all(squares, dirty)
        self._publish()
        self._waiting = {}

    def _publish(self) -> None:
        row, column = self._corner
        self._tiles = Tiles(
            self._pages.reshape(-1),
            self._table[: self._table_used].reshape(-1),
            self._codes[: self._used].reshape(-1),
            self._coarse[: self._used].reshape(-1),
            self._pages.shape[1],
            self._pages.shape[0],
            column * _PAGE * _SIDE,
            row * _PAGE * _SIDE,
            self._settings.resolution,
            self._settings.reach,
        )
        self._published, self._table_published = self._used, self._table_used

    def _batches(self, scans: Iterable[tuple[LaserScan, Pose2D]]) -> Iterator[_Rays]:
        """Rays of scans, of several at once where these lie together."""
        batch: list[_Rays] = []
        count = 0
        for scan, pose in scans:
            _check_pose(pose)
            points = scan.points
            points = points[np.hypot(points[:, 0], points[:, 1]) <= self._settings.farthest]
            if not len(points):
                continue
            origins = np.repeat([[pose.x, pose.y]], len(points), axis=0)
            rays = _Rays(origins, pose.apply(points))
            if batch and (count > _MANY_RAYS or self._are_apart(batch[0], rays)):
                yield _Rays(*map(np.concatenate, zip(*batch, strict=True)))
                batch, count = [], 0
            batch.append(rays)
            count += len(points)
        if batch:
            yield _Rays(*map(np.concatenate, zip(*batch, strict=True)))

    def _are_apart(self, rays: _Rays, others: _Rays) -> bool:
        apart = np.abs(rays.origins[0] - others.origins[0]).max()
        return float(apart) > _WIDEST * _SIDE * self._settings.resolution

    @property
    def _halo(self) -> int:
        """Cells within ``reach``."""
        return math.ceil(self._settings.reach / self._settings.resolution)

    @cached_property
    def _near(self) -> NDArray[np.int64]:
        """(K, 2) steps to the squares within ``reach`` of one."""
        wide = -(-self._halo // _SIDE)
        steps = np.arange(-wide, wide + 1)
        return np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)

    def _deposit(self, rays: _Rays, sign: int) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
        """Change the evidence of rays.

        Returns:
            (N, 2) touched squares in order, and (N, 2) which of their blocks a hit, and which a
            hit or a pass, has changed.
        """
        size = self._settings.resolution
        cells = np.concatenate([rays.origins, rays.ends]) / size
        low = np.floor((cells.min(axis=0) - self._halo) / _SIDE)[::-1]
        high = np.floor((cells.max(axis=0) + self._halo) / _SIDE)[::-1] + 1
        self._cover(low - 1, high + 1)
        corner, shape = low.astype(np.int64), (high - low).astype(np.int64)
        frame = (int(corner[1]) * _SIDE, int(corner[0]) * _SIDE, size, self._settings.margin)
        is_touched = np.zeros(shape, np.bool_)
        _touch(rays.origins, rays.ends, is_touched, frame, self._halo)
        at = np.argwhere(is_touched)
        rows = np.zeros(shape, np.int32)
        rows[at[:, 0], at[:, 1]] = self._evidence.rows(at + corner, make=True)
        dirty = np.zeros((*shape, 2), np.uint64)
        change = (self._halo, sign)
        _deposit(rays, rows, self._evidence.layers, dirty, frame, change)
        return at + corner, dirty[at[:, 0], at[:, 1]]

    def _cover(self, low: NDArray, high: NDArray) -> None:  # type: ignore[type-arg]
        """Widen the pages to all squares from ``low`` up to ``high``, rows before columns."""
        low, shape = self._covering(low, high)
        old = np.array(self._corner)
        if self._is_placed and tuple(shape.astype(int)) == self._pages.shape:
            return
        pages = np.zeros(shape.astype(int), np.int32)
        if self._is_placed:
            i, j = (old - low).astype(int)
            pages[i : i + self._pages.shape[0], j : j + self._pages.shape[1]] = self._pages
        self._pages, self._corner = pages, (int(low[0]), int(low[1]))
        self._is_placed = True

    def _covering(self, low: NDArray, high: NDArray) -> tuple[NDArray, NDArray]:  # type: ignore[type-arg]
        """Return first page and number of the pages that cover squares and all that there is.

        Raises:
            AnchorscanError: They are too many.
        """
        low, high = np.floor(low / _PAGE), np.ceil(high / _PAGE)
        if self._is_placed:
            corner = np.array(self._corner)
            low, high = np.minimum(low, corner), np.maximum(high, corner + self._pages.shape)
        shape = high - low
        if float(shape[0]) * float(shape[1]) > _MOST_PAGES:
            apart = float(shape.max()) * _PAGE * _SIDE * self._settings.resolution
            raise AnchorscanError(f"references lie {apart / 1e3:.0f} km apart; is a pose wrong?")
        return low, shape

    def _derive_all(self, squares: NDArray[np.int64], dirty: NDArray[np.uint64]) -> None:
        """Derive the dirty blocks of many tiles, some at a time."""
        for first in range(0, len(squares), _GROUP):
            self._derive(squares[first : first + _GROUP], dirty[first : first + _GROUP])

    def _derive(self, squares: NDArray[np.int64], dirty: NDArray[np.uint64]) -> None:
        """Bring the bytes of dirty blocks up to date, in new versions of their tiles."""
        settings = self._settings
        around = self._around(squares)
        rows = self._evidence.rows(around, make=False).reshape(len(squares), -1)
        limits = (
            settings.resolution,
            settings.reach,
            self._halo,
            settings.fewest_passes,
            settings.passes_per_hit,
        )
        tiles = self._renewed(squares)
        _derive(tiles, rows, dirty, self._evidence.layers, self._codes, limits)
        _pool(tiles, dirty, self._codes, self._coarse, self._scores)

    def _around(self, squares: NDArray[np.int64]) -> NDArray[np.int64]:
        """Squares with those within reach of them, one behind the other."""
        return (squares[:, np.newaxis] + self._near).reshape(-1, 2)

    def _renewed(self, squares: NDArray[np.int64]) -> NDArray[np.int32]:
        """Give squares tiles that nobody reads yet, with what theirs held before."""
        old = self._tiles_of(squares)
        stale = np.flatnonzero(old < self._published)  # the empty tile is one of them
        self._make_room(len(stale))
        old = self._tiles_of(squares)  # which making room may have renumbered
        new = old.copy()
        new[stale] = np.arange(self._used, self._used + len(stale), dtype=np.int32)
        self._codes[new[stale]] = self._codes[old[stale]]
        self._coarse[new[stale]] = self._coarse[old[stale]]
        self._used += len(stale)
        self._live += int((old[stale] == 0).sum())
        self._point(squares[stale], new[stale])
        return new

    def _make_room(self, count: int) -> None:
        """Provide for more tiles: in place of outlived versions where these are the most."""
        if self._used + count <= len(self._codes):
            return
        kept = np.arange(self._used)
        if self._used > 2 * self._live + _GROUP:
            kept = np.unique(self._table[np.unique(np.append(self._pages, 0))])
            numbers = np.zeros(self._used, np.int32)
            numbers[kept] = np.arange(len(kept), dtype=np.int32)
            named = numbers[self._table[: self._table_used]]
            self._table, self._table_published = _grown(named, len(self._table)), 1
        room = len(kept) + count + max(len(kept) // 2, _GROUP // 2)
        self._codes = _grown(self._codes[kept], room)
        self._coarse = _grown(self._coarse[kept], room)
        # Nobody reads these copies yet.
        self._used, self._published = len(kept), 1

    def _tiles_of(self, squares: NDArray[np.int64]) -> NDArray[np.int32]:
        pages, at = self._places_of(squares)
        return self._table[self._pages[pages[:, 0], pages[:, 1]], at]

    def _places_of(self, squares: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(N, 2) page, and (N,) place in it, of squares."""
        pages = (squares >> 6) - np.array(self._corner)
        return pages, ((squares[:, 0] & 63) << 6) | (squares[:, 1] & 63)

    def _point(self, squares: NDArray[np.int64], tiles: NDArray[np.int32]) -> None:
        """Let the table name these tiles for squares, in new versions of its pages."""
        if not len(squares):
            return
        pages, at = self._places_of(squares)
        directory = self._pages.copy()
        i, j = np.unique(pages, axis=0).T
        if self._table_used + len(i) > len(self._table):
            used = np.unique(np.append(directory, 0))
            directory = np.searchsorted(used, directory).astype(np.int32)
            self._table = _grown(self._table[used], 2 * (len(used) + len(i)))
            self._table_used, self._table_published = len(used), 1
        stale = directory[i, j] < self._table_published
        i, j = i[stale], j[stale]
        new = np.arange(self._table_used, self._table_used + len(i), dtype=np.int32)
        self._table[new] = self._table[directory[i, j]]
        self._table_used += len(i)
        directory[i, j] = new
        self._pages = directory
        self._table[directory[pages[:, 0], pages[:, 1]], at] = tiles


def _check_pose(pose: Pose2D) -> None:
    """See that a reference lies where there are cells.

    Raises:
        AnchorscanError: It does not.
    """
    if not pose.is_finite():
        raise AnchorscanError("a reference has a pose that is not finite")
    away = max(abs(pose.x), abs(pose.y))
    if away > _FARTHEST:
        raise AnchorscanError(f"a reference lies {away / 1e3:.3g} km away; is its pose wrong?")


def _rows(layer: NDArray, numbers: NDArray[np.int64]) -> NDArray:  # type: ignore[type-arg]
    """Rows of a layer by their numbers: the layer itself where they are its first ones."""
    is_first = np.array_equal(numbers, np.arange(len(numbers)))
    rows: NDArray = layer[: len(numbers)] if is_first else layer[numbers]  # type: ignore[type-arg]
    return rows


def _grown(layer: NDArray, room: int) -> NDArray:  # type: ignore[type-arg]
    """Copy into a longer array; what is new holds anything."""
    grown = np.empty((room, *layer.shape[1:]), layer.dtype)
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
def _deposit(rays, rows, layers, dirty, frame, change):  # type: ignore[no-untyped-def]
    """Add the evidence of rays (sign 1), or take it back (sign -1), and mark the blocks changed."""
    column, row, resolution, margin = frame
    halo, sign = change
    for i in range(len(rays.ends)):
        ox, oy = rays.origins[i, 0], rays.origins[i, 1]
        ex, ey = rays.ends[i, 0], rays.ends[i, 1]
        count, dx, dy = _steps(ox, oy, ex, ey, resolution, margin)
        last_x, last_y = -1, -1
        for k in range(count):
            cx = int(math.floor((ox + k * dx) / resolution)) - column
            cy = int(math.floor((oy + k * dy) / resolution)) - row
            if cx != last_x or cy != last_y:
                v, u = cy % _SIDE, cx % _SIDE
                layers.passes[rows[cy // _SIDE, cx // _SIDE], v, u] += sign
                block = _1 << np.uint64(v // _BLOCK * _BLOCKS + u // _BLOCK)
                dirty[cy // _SIDE, cx // _SIDE, 1] |= block
                last_x, last_y = cx, cy
        gx, gy = ex / resolution, ey / resolution
        cx = int(math.floor(gx))
        cy = int(math.floor(gy))
        at_x, at_y = int((gx - cx) * _FRACTIONS), int((gy - cy) * _FRACTIONS)
        cx -= column
        cy -= row
        tile = rows[cy // _SIDE, cx // _SIDE]
        layers.hits[tile, cy % _SIDE, cx % _SIDE] += sign
        layers.x[tile, cy % _SIDE, cx % _SIDE] += sign * at_x
        layers.y[tile, cy % _SIDE, cx % _SIDE] += sign * at_y
        for v in range((cy - halo) // _BLOCK, (cy + halo) // _BLOCK + 1):
            for u in range((cx - halo) // _BLOCK, (cx + halo) // _BLOCK + 1):
                block = _1 << np.uint64(v % _BLOCKS * _BLOCKS + u % _BLOCKS)
                dirty[v // _BLOCKS, u // _BLOCKS, 0] |= block
                dirty[v // _BLOCKS, u // _BLOCKS, 1] |= block


@kernel
def _distances(first_v, first_u, around, layers, halo, squares):  # type: ignore[no-untyped-def]
    """Squared distance to the nearest surface, in cells, for a block of a tile."""
    squares[:] = np.inf
    side = int(math.sqrt(len(around)))
    middle = side // 2
    for n in range(len(around)):
        row = around[n]
        top, left = (n // side - middle) * _SIDE, (n % side - middle) * _SIDE
        for v in range(
            max(first_v - halo - top, 0), min(first_v + _BLOCK + halo - top, _SIDE if row else 0)
        ):
            for u in range(
                max(first_u - halo - left, 0), min(first_u + _BLOCK + halo - left, _SIDE)
            ):
                hits = layers.hits[row, v, u]
                if hits <= 0:
                    continue
                x = u + left - first_u + (layers.x[row, v, u] / hits + 0.5) / _FRACTIONS
                y = v + top - first_v + (layers.y[row, v, u] / hits + 0.5) / _FRACTIONS
                _lay(np.float32(x), np.float32(y), squares)


@kernel
def _lay(x, y, squares):  # type: ignore[no-untyped-def]
    """Note the squared distance to a point, for the cells of a block that it is nearer to."""
    for j in range(_BLOCK):
        up = (_CENTRES[j] - y) * (_CENTRES[j] - y)
        for i in range(_BLOCK):
            off = (_CENTRES[i] - x) * (_CENTRES[i] - x) + up
            squares[j, i] = off if off < squares[j, i] else squares[j, i]


@kernel
def _derive(tiles, around, dirty, layers, codes, limits):  # type: ignore[no-untyped-def]
    """Distances, free space and surfaces of the dirty blocks of tiles.

    Those that no hit has changed keep their distances.
    """
    resolution, reach, halo, fewest_passes, passes_per_hit = limits
    squares = np.empty((_BLOCK, _BLOCK), np.float32)
    middle = around.shape[1] // 2
    for n in range(len(tiles)):
        own = around[n, middle]
        for block in range(_BLOCKS * _BLOCKS):
            if not (dirty[n, 1] >> np.uint64(block)) & _1:
                continue
            first_v, first_u = block // _BLOCKS * _BLOCK, block % _BLOCKS * _BLOCK
            is_hit = (dirty[n, 0] >> np.uint64(block)) & _1
            if is_hit:
                _distances(first_v, first_u, around[n], layers, halo, squares)
            for j in range(_BLOCK):
                for i in range(_BLOCK):
                    v, u = first_v + j, first_u + i
                    code = int(codes[tiles[n], v * _SIDE + u]) & FAR
                    if is_hit:
                        far = math.sqrt(squares[j, i]) * resolution / reach
                        code = int(min(far, 1.0) * FAR)
                    passes, hits = layers.passes[own, v, u], layers.hits[own, v, u]
                    if passes >= fewest_passes:
                        code += FREE
                    if hits > 0 and passes <= passes_per_hit * hits:
                        code += SURFACE
                    codes[tiles[n], v * _SIDE + u] = code


@kernel
def _pool(tiles, dirty, codes, coarse, scores):  # type: ignore[no-untyped-def]
    """Best score in every coarse cell of the dirty blocks."""
    side = _SIDE // _COARSE
    for n in range(len(tiles)):
        for j in range(side):
            for i in range(side):
                block = j * _COARSE // _BLOCK * _BLOCKS + i * _COARSE // _BLOCK
                if not (dirty[n, 1] >> np.uint64(block)) & _1:
                    continue
                best = np.float32(-1.0)
                for b in range(_COARSE):
                    for a in range(_COARSE):
                        at = (j * _COARSE + b) * _SIDE + i * _COARSE + a
                        best = max(best, scores[codes[tiles[n], at]])
                coarse[tiles[n], j * side + i] = int(round(127.0 * best))
