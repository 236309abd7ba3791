"""Beyond the paper: what rays found in each cell, in integers that can be taken back.

A cell counts the readings that ended in it, their summed position within it, and the rays that
passed.  Integers make adding and removing exact opposites, in any order.

Only a change of the map looks at evidence, and only at that of a few tiles.  So a tile is
*open*, as arrays that kernels change, only while there are few; others are kept packed, a
hundredth of the size, and so they are stored.
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
_BYTES = _LAYERS * SIDE * SIDE * 4
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
            row = self._open[key] = len(self._open) + 1
            unpacked = _unpacked(data)
            for layer, values in zip(self._layers, unpacked, strict=True):
                layer[row] = values

    def _close(self, wanted: set[int]) -> None:
        """Pack all open tiles but those that are wanted, and move these together."""
        kept = [key for key in self._open if key in wanted]
        for key, row in self._open.items():
            if key not in wanted and key in self._changed:
                self._packed[key] = self._pack(row)
                self._changed.remove(key)
        rows = [0, *(self._open[key] for key in kept)]
        self._layers = Evidence(*(layer[rows] for layer in self._layers))
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
        values = np.stack([layer[row] for layer in self._layers]).astype("<i4", copy=False)
        return zlib.compress(values.tobytes(), _LEVEL) if values.any() else _NOTHING


def _keys(squares: NDArray[np.int32] | NDArray[np.int64]) -> NDArray[np.int64]:
    """One integer a square, in order of rows and columns."""
    rows, columns = squares[:, 0].astype(np.int64), squares[:, 1].astype(np.int64)
    return (rows << 32) + columns


def _unpacked(data: bytes) -> NDArray[np.int32]:
    """(4, 64, 64) evidence of a tile."""
    if not data:
        return np.zeros((_LAYERS, SIDE, SIDE), np.int32)
    unpack = zlib.decompressobj()
    try:
        values = unpack.decompress(data, _BYTES + 1)
    except zlib.error as error:
        raise AnchorscanError(f"the stored evidence of the map is damaged: {error}") from None
    if len(values) != _BYTES or not unpack.eof:
        raise AnchorscanError("the stored evidence of the map is damaged: it has another size")
    return np.frombuffer(values, "<i4").reshape(_LAYERS, SIDE, SIDE)
