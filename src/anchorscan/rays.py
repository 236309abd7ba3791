"""Rays of a scan followed through the stitched map: which of them pass through known surfaces."""

from __future__ import annotations

import math

import numpy as np

from ._jit import kernel
from .evidence import SIDE as _SIDE
from .tiles import FAR, SURFACE, tile_at

__all__ = ["passed_through"]

# Farther than this from all surfaces, metres, a ray is clear of them.
_CLEAR = 0.2
# From centre to corner in both of two cells, and some rounding, in cells.
_CORNERS = 1.415
# A ray is followed no farther, metres: a reading may claim any length.
_LONGEST_RAY = 100.0
_6, _12, _63 = np.uint64(6), np.uint64(12), np.uint64(63)


@kernel
def passed_through(pose, points, tiles, margin):  # type: ignore[no-untyped-def]
    """Share of rays that pass through a known surface more than ``margin`` before their end.

    A ray passes through when it is clear of all surfaces shortly before and shortly after it
    meets one: a ray that grazes a wall touches its cells without passing through.  Where the
    nearest surface is far, the cells before it need no look.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x = pose[0] / tiles.resolution - tiles.column
    y = pose[1] / tiles.resolution - tiles.row
    width, height = tiles.width << 12, tiles.height << 12
    clear = int(_CLEAR / tiles.reach * FAR)
    shortly = math.floor(2.0 * _CLEAR / tiles.resolution)
    skipped = _skipped(clear, tiles)
    through = 0
    for i in range(len(points)):
        length = math.hypot(points[i, 0], points[i, 1])
        dx = (c * points[i, 0] - s * points[i, 1]) / length
        dy = (s * points[i, 0] + c * points[i, 1]) / length
        last_clear, met = -shortly, -1.0
        last = math.floor((min(length, _LONGEST_RAY) - margin) / tiles.resolution) - 1.0
        k = 0.0
        tile, tile_x, tile_y = np.uint64(0), -_SIDE, -_SIDE
        while k <= last:
            cx, cy = int(x + k * dx), int(y + k * dy)
            if ((cx ^ tile_x) | (cy ^ tile_y)) >> 6 != 0:
                # Looked up anew only in another tile: each step has to wait for the one before.
                tile_x, tile_y = cx, cy
                u = np.uint64(min(max(cx, 0), width - 1))
                v = np.uint64(min(max(cy, 0), height - 1))
                tile = tile_at(tiles, u >> _6, v >> _6) << _12
            code = tiles.codes[tile | np.uint64((cy & 63) << 6 | (cx & 63))]
            if (code & FAR) >= clear:
                if met >= 0.0 and k - met <= shortly:
                    through += 1
                    break
                k += skipped[code & _63]
                last_clear, met = k, -1.0
            elif code & SURFACE and met < 0.0 and k - last_clear <= shortly:
                met = k
            k += 1.0
    return through / max(len(points), 1)


@kernel
def _skipped(clear, tiles):  # type: ignore[no-untyped-def]
    """Cells of a ray, by the code of the one before them, that are clear of surfaces anyway."""
    skipped = np.zeros(FAR + 1)
    for code in range(clear, FAR + 1):
        far = (code - clear) * tiles.reach / FAR / tiles.resolution
        skipped[code] = max(math.floor(far - _CORNERS), 0.0)
    return skipped
