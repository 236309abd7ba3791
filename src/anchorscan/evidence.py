"""Beyond the paper: what rays found in each cell, in integers that can be taken back.

A cell counts the readings that ended in it, their summed position within it, and the rays that
passed.  Integers make adding and removing exact opposites, in any order.

Only a change of the map looks at evidence, and only at that of a few tiles.  So a tile is
*open*, as arrays that kernels change, only while there are few; others are kept packed, a
hundredth of the size, and so they are stored.

Packed are, compressed by zlib and little endian: the number of cells in which readings ended
(uint16), which these are (uint16, ascending), their hits, x and y (int32, one behind the other),
and the passes of all cells, as uint8 or, where one does not fit, as int32.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import AnchorscanError

__all__ = ["SIDE", "Evidence", "TileEvidence"]

SIDE = 64
"""Cells along a side of a tile."""

_LAYERS = 4
_CELLS = SIDE * SIDE
_COUNT, _PLACE, _SUM = np.dtype("<u2"), np.dtype("<u2"), np.dtype("<i4")
_PER_HIT = _PLACE.itemsize + 3 * _SUM.itemsize
# Passes in bytes, and what is taken where they do not fit.
_FEW, _MANY = np.dtype("<u1"), np.dtype("<i4")
_MOST_BYTES = _COUNT.itemsize + _CELLS * (_PER_HIT + _MANY.itemsize)
# More open tiles than this, an eighth of a gigabyte, are packed.
_MOST_OPEN = 2048
# The quickest level: higher ones take several times as long for a tenth less.
_LEVEL = 1
_NOTHING = b""


class Evidence(NamedTuple):
    """(R, 64, 64) int32 each, of the open tiles; that of row 0 is nothing.

    Args:
        hits: Readings that ended in the cell.
        x: Sum of where, 256ths of a cell.
        y: The same upwards.
        passes: Rays that went through.
    """

    hits: NDArray[np.int32]
    x: NDArray[np.int32]
    y: NDArray[np.int32]
    passes: NDArray[np.int32]


class TileEvidence:
    """The evidence of all tiles of a map, by the row and column of their squares.

    Args:
        squares: (T, 2) stored tiles, in order of rows and columns.
        packed: (E,) uint8, their packed evidence one behind the other.
        starts: (T + 1,) where that of each begins.

    Raises:
        ValueError: The arrays do not fit each other.
    """

    def __init__(
        self,
        squares: NDArray[np.int32] | None = None,
        packed: NDArray[np.uint8] | None = None,
        starts: NDArray[np.int64] | None = None,
    ) -> None:
        self._keys = np.empty(0, np.int64) if squares is None else _keys(squares)
        self._stored = np.empty(0, np.uint8) if packed is None else packed
        self._starts = np.zeros(1, np.int64) if starts is None else starts
        if (
            len(self._starts) != len(self._keys) + 1
            or np.any(np.diff(self._keys) <= 0)
            or np.any(np.diff(self._starts) < 0)
            or self._starts[0] != 0
            or self._starts[-1] != len(self._stored)
        ):
            raise ValueError("the evidence of the map does not fit its tiles")
        self._packed: dict[int, bytes] = {}
        self._open: dict[int, int] = {}
        # Those that were opened to be changed: others need not be packed again.
        self._changed: set[int] = set()
        self._layers = Evidence(*(np.zeros((1, SIDE, SIDE), np.int32) for _ in range(_LAYERS)))

    @property
    def layers(self) -> Evidence:
        """The evidence of open tiles, valid until others are opened."""
        return self._layers

    def rows(self, squares: NDArray[np.int64], *, make: bool) -> NDArray[np.int32]:
        """Open tiles.

        Args:
            squares: (N, 2) row and column.
            make: Whether they are to be changed, and to begin tiles that are not there; the row
                of these is 0 otherwise.

        Returns:
            (N,) row of each in ``layers``.

        Raises:
            AnchorscanError: Stored evidence is damaged.
        """
        keys = _keys(squares).tolist()
        if make:
            self._changed.update(keys)
        closed = list(dict.fromkeys(key for key in keys if key not in self._open))
        if closed:
            self._load(closed, keys, make)
        return np.array([self._open.get(key, 0) for key in keys], np.int32)

    def packed(self, squares: NDArray[np.int64]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """Pack the evidence of (N, 2) squares one behind the other.

        Returns:
            (E,) uint8, and (N + 1,) where that of each begins.
        """
        all_of_them = [self._packed_one(key) for key in _keys(squares).tolist()]
        packed = np.frombuffer(b"".join(all_of_them), np.uint8)
        return packed, np.cumsum([0, *map(len, all_of_them)], dtype=np.int64)

    def _load(self, closed: Sequence[int], wanted: Sequence[int], make: bool) -> None:
        """Open tiles that are not, where there are such or they are to be made."""
        places = np.searchsorted(self._keys, closed).tolist()
        begun = {}
        for key, place in zip(closed, places, strict=True):
            data = self._packed_at(key, place)
            if data is not None or make:
                begun[key] = data or _NOTHING
        if len(self._open) + len(begun) > _MOST_OPEN:
            self._close(set(wanted))
        self._make_room(len(begun))
        for key, data in begun.items():
            row = len(self._open) + 1
            _unpack(data, *(layer[row].reshape(-1) for layer in self._layers))
            self._open[key] = row

    def _close(self, wanted: set[int]) -> None:
        """Pack all open tiles but those that are wanted, and move these together."""
        kept = [key for key in self._open if key in wanted]
        for key, row in self._open.items():
            if key not in wanted and key in self._changed:
                self._packed[key] = self._pack(row)
                self._changed.remove(key)
        rows = [self._open[key] for key in kept]
        for layer in self._layers:  # whose pages are in memory by now
            layer[1 : 1 + len(kept)] = layer[rows]
        self._open = {key: row for row, key in enumerate(kept, 1)}

    def _make_room(self, count: int) -> None:
        need = len(self._open) + 1 + count
        have = len(self._layers.hits)
        if need > have:
            # Zeros take no memory until they are written to: growing once is better than often.
            room = max(need, 2 * have, _MOST_OPEN + 1)
            grown = Evidence(*(np.zeros((room, SIDE, SIDE), np.int32) for _ in range(_LAYERS)))
            used = len(self._open) + 1
            for layer, values in zip(grown, self._layers, strict=True):
                layer[:used] = values[:used]
            self._layers = grown

    def _packed_one(self, key: int) -> bytes:
        row = self._open.get(key)
        if row is not None:
            return self._pack(row)
        return self._packed_at(key, int(np.searchsorted(self._keys, key))) or _NOTHING

    def _packed_at(self, key: int, place: int) -> bytes | None:
        """Packed evidence of a tile that is not open."""
        if key in self._packed:
            return self._packed[key]
        if place < len(self._keys) and self._keys[place] == key:
            return self._stored[self._starts[place] : self._starts[place + 1]].tobytes()
        return None

    def _pack(self, row: int) -> bytes:
        return _packed(*(layer[row].reshape(-1) for layer in self._layers))


def _packed(
    hits: NDArray[np.int32], x: NDArray[np.int32], y: NDArray[np.int32], passes: NDArray[np.int32]
) -> bytes:
    """Pack (4096,) evidence of a tile."""
    at = np.flatnonzero(hits | x | y)
    least, most = int(passes.min()), int(passes.max())
    if not (len(at) or least or most):
        return _NOTHING
    kind = _FEW if least >= 0 and most <= np.iinfo(_FEW).max else _MANY
    parts = (
        np.array(len(at), _COUNT),
        at.astype(_PLACE),
        np.stack([hits[at], x[at], y[at]]).astype(_SUM),
        passes.astype(kind),
    )
    return zlib.compress(b"".join(part.tobytes() for part in parts), _LEVEL)


def _keys(squares: NDArray[np.int32] | NDArray[np.int64]) -> NDArray[np.int64]:
    """One integer a square, in order of rows and columns."""
    rows, columns = squares[:, 0].astype(np.int64), squares[:, 1].astype(np.int64)
    return (rows << 32) + columns


def _unpack(
    packed: bytes,
    hits: NDArray[np.int32],
    x: NDArray[np.int32],
    y: NDArray[np.int32],
    passes: NDArray[np.int32],
) -> None:
    """Lay packed evidence out, (4096,) each.

    Raises:
        AnchorscanError: It is damaged.
    """
    for layer in (hits, x, y, passes):
        layer[:] = 0
    if not packed:
        return
    unpack = zlib.decompressobj()
    try:
        data = unpack.decompress(packed, _MOST_BYTES + 1)
    except zlib.error as error:
        raise _damaged(str(error)) from None
    if not unpack.eof or len(data) < _COUNT.itemsize:
        raise _damaged("it has another size")
    count = int(np.frombuffer(data, _COUNT, 1)[0])
    sums = _COUNT.itemsize + count * _PLACE.itemsize
    rest = _COUNT.itemsize + count * _PER_HIT
    kinds = {_CELLS * kind.itemsize: kind for kind in (_FEW, _MANY)}
    if len(data) - rest not in kinds:
        raise _damaged("it has another size")
    at = np.frombuffer(data, _PLACE, count, _COUNT.itemsize)
    if count and (at[-1] >= _CELLS or np.any(at[1:] <= at[:-1])):
        raise _damaged("its cells are in no order")
    hits[at], x[at], y[at] = np.frombuffer(data, _SUM, 3 * count, sums).reshape(3, count)
    passes[:] = np.frombuffer(data, kinds[len(data) - rest], _CELLS, rest)


def _damaged(what: str) -> AnchorscanError:
    return AnchorscanError(f"the stored evidence of the map is damaged: {what}")
