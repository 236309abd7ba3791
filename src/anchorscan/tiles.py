"""The stitched map as it is read: a byte a cell, in tiles, and how to find them.

A tile is 64 x 64 cells.  Tiles are found through a table of squares, in pages of 64 x 64 squares.
A byte tells of its cell:

    bits 0-5   distance to the nearest surface in 63rds of ``reach``; 63 is farther
    bit 6      rays passed here: known free space
    bit 7      a surface: it was hit, and hit about as often as passed

A coarse copy (cells four times as wide) holds the best score of its cells, so that a pose
that is a few decimetres off can be told from a wrong one with a handful of look-ups.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ._jit import inlined, kernel

__all__ = ["FAR", "FREE", "SURFACE", "Tiles"]

# The parts of a byte.  The distance "farther than reach", and the bits.
FAR = 63
FREE, SURFACE = 64, 128
_4, _6, _8, _12 = (np.uint64(value) for value in (4, 6, 8, 12))
_15, _63 = np.uint64(15), np.uint64(63)


class Tiles(NamedTuple):
    """What kernels read of the map.

    Args:
        pages: (height * width,) int32, which page of the table covers each block of 64 x 64
            squares; page 0 has no tiles.
        table: (P * 4096,) int32, which tile covers each square; 0 is the empty one, and the
            squares along the border have no other.
        codes: (T * 4096,) uint8, a byte a cell; tile 0 is all unknown.
        coarse: (T * 256,) int8, best score in each coarse cell, 127ths.
        width: Pages in a row.
        height: Rows of pages.
        column: Cell column of the left border in the set's frame.
        row: Cell row of the lower border.
        resolution: Width of a cell, metres.
        reach: Distance that the codes tell, metres.
    """

    pages: NDArray[np.int32]
    table: NDArray[np.int32]
    codes: NDArray[np.uint8]
    coarse: NDArray[np.int8]
    width: int
    height: int
    column: int
    row: int
    resolution: float
    reach: float


@kernel
def tile_at(tiles, u, v):  # type: ignore[no-untyped-def]
    """Tile that covers a square, counted from the border."""
    page = np.uint64(tiles.pages[(v >> _6) * np.uint64(tiles.width) + (u >> _6)])
    return np.uint64(tiles.table[(page << _12) | ((v & _63) << _6) | (u & _63)])


@kernel
def cell_code(tiles, cx, cy):  # type: ignore[no-untyped-def]
    """Byte of a cell of the table; the table's border is empty, so beyond it is unknown."""
    # Unsigned indices spare the check for negative ones, which costs more than the look-up.
    u = np.uint64(min(max(cx, 0), (tiles.width << 12) - 1))
    v = np.uint64(min(max(cy, 0), (tiles.height << 12) - 1))
    tile = tile_at(tiles, u >> _6, v >> _6)
    return tiles.codes[(tile << _12) | ((v & _63) << _6) | (u & _63)]


@kernel
def is_clear(x, y, tiles, distance):  # type: ignore[no-untyped-def]
    """Whether a position is known free space, so far from all surfaces."""
    cx = int(math.floor(x / tiles.resolution)) - tiles.column
    cy = int(math.floor(y / tiles.resolution)) - tiles.row
    code = cell_code(tiles, cx, cy)
    return code & FREE != 0 and (code & FAR) * tiles.reach >= distance * FAR


@kernel
def coarse_score(tiles, cx, cy):  # type: ignore[no-untyped-def]
    """Best score (127ths) in a coarse cell of the table; 0 beyond its border."""
    u = np.uint64(min(max(cx, 0), (tiles.width << 10) - 1))
    v = np.uint64(min(max(cy, 0), (tiles.height << 10) - 1))
    tile = tile_at(tiles, u >> _4, v >> _4)
    return int(tiles.coarse[(tile << _8) | ((v & _15) << _4) | (u & _15)])


@kernel
def room_for(readings):  # type: ignore[no-untyped-def]
    """Columns of (N, 2) or more readings, and room to look all of them up at once."""
    count = len(readings)
    across, up = readings[:, 0].copy(), readings[:, 1].copy()
    places = np.empty((3, count), np.int32)
    return across, up, places, np.empty((4, count), np.uint8), np.empty((8, count))


@inlined
def note_place(cx, cy, tiles, places, i):  # type: ignore[no-untyped-def]
    """Note where to look a cell up: its page, its square there and its place in that one's tile."""
    # In 32 bits throughout: a processor has no instruction that does several of 64 bits.
    u = min(max(cx, np.int32(0)), np.int32((tiles.width << 12) - 1))
    v = min(max(cy, np.int32(0)), np.int32((tiles.height << 12) - 1))
    places[0, i] = (v >> 12) * np.int32(tiles.width) + (u >> 12)
    places[1, i] = ((v >> 6) & 63) << 6 | ((u >> 6) & 63)
    places[2, i] = (v & 63) << 6 | (u & 63)


@inlined
def index_of(tiles, places, i):  # type: ignore[no-untyped-def]
    """Index of the code of a cell of which ``note_place`` has noted where to look."""
    page = np.uint64(tiles.pages[np.uint64(places[0, i])])
    tile = np.uint64(tiles.table[(page << _12) | np.uint64(places[1, i])])
    return (tile << _12) | np.uint64(places[2, i])


@inlined
def look_up(pose, room, tiles):  # type: ignore[no-untyped-def]
    """Note the bytes of the cells in which readings end at a pose; return these notes.

    Two loops, since a processor does several readings at once in the first.
    """
    across, up, places, notes, _ = room
    scale = 1.0 / tiles.resolution
    c, s = math.cos(pose[2]) * scale, math.sin(pose[2]) * scale
    x = pose[0] * scale - tiles.column
    y = pose[1] * scale - tiles.row
    for i in range(len(across)):
        cx = np.int32(x + c * across[i] - s * up[i])
        cy = np.int32(y + s * across[i] + c * up[i])
        note_place(cx, cy, tiles, places, i)
    codes = notes[0]
    for i in range(len(across)):
        codes[i] = tiles.codes[index_of(tiles, places, i)]
    return codes
