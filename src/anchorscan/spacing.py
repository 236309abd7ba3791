"""Beyond section 4.1: how far apart the walls are that a scan saw.

Whoever stands a metre away sees the walls elsewhere, but as far from each other as before.  So
the *spacings* of a scan say, for both directions of the main walls, whether it saw two walls at
a distance, in steps of 0.2 m up to 6.4 m: two that face the same way, two that face each other,
or two that turn their backs on each other.  That is one bit each, 192 in all, and neither where
the scan was taken nor half a turn changes them; a quarter turn exchanges the two directions.

They are made from the panorama.  Walls are what joins its neighbouring directions, where it runs
along a direction of the main walls.  They are few bits and cheap to compare: the database tells
by them which of the thousands of references with the most votes are looked at more closely.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .database import WORDS
from .panorama import _DISTANCES, _UNITS

__all__ = ["spacings"]

# Walls lie in bins of so many metres, from -12.8 m to 12.8 m; a spacing is of two bins.
_BIN = 0.1
_BINS = 256
_LAGS = 64
_LENGTHS = _LAGS // 2
_LEAST_LAG = 2
# Neighbouring directions are joined over so many metres and so much of their distance.
_JOINED, _JOINED_SHARE = 0.25, 0.12
# A wall runs along an axis when it runs no more than this share across it.
_ASLANT = 0.35
# More metres of a wall prove no more; and how much two walls have to weigh together.
_LONG_ENOUGH = 1.0
_LEAST_WEIGHT = 0.25


def spacings(panoramas: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return which spacings of walls scans saw.

    Args:
        panoramas: (N, 180) of the scans.

    Returns:
        (N, 3) uint64: of walls across x that face the same way and each other (32 bits each, low
        half first), the same of walls across y, and those that turn their backs, x and y.
    """
    # Handed over: a compiled kernel does not notice that arrays of another file have changed.
    found: NDArray[np.uint64] = _spacings(panoramas, (_DISTANCES, _UNITS))
    return found


@kernel
def _walls(seen, tables, walls):  # type: ignore[no-untyped-def]
    """Metres of wall in every bin of x and of y: of those that face minus and that face plus."""
    distances, units = tables
    walls[:] = 0.0
    for a in range(len(seen)):
        b = a + 1 if a + 1 < len(seen) else 0
        if seen[a] == 0 or seen[b] == 0:
            continue
        r, s = distances[seen[a]], distances[seen[b]]
        ax, ay = r * units[a, 0], r * units[a, 1]
        bx, by = s * units[b, 0], s * units[b, 1]
        dx, dy = bx - ax, by - ay
        length = math.sqrt(dx * dx + dy * dy)
        if length > np.float32(_JOINED) + np.float32(_JOINED_SHARE) * min(r, s):
            continue
        if abs(dx) < np.float32(_ASLANT) * length:
            axis, side, u = 0, 0 if dy > 0.0 else 1, (ax + bx) / 2
        elif abs(dy) < np.float32(_ASLANT) * length:
            axis, side, u = 1, 1 if dx > 0.0 else 0, (ay + by) / 2
        else:
            continue
        # Shared between the two nearest bins.
        at = u / np.float32(_BIN) + np.float32(_BINS / 2 - 0.5)
        k = int(math.floor(at))
        if k >= 0 and k + 1 < _BINS:
            walls[axis, side, k] += length * (1.0 - (at - k))
            walls[axis, side, k + 1] += length * (at - k)


@kernel
def _weights(walls, weights):  # type: ignore[no-untyped-def]
    """How much the walls of one axis weigh at each spacing: the same way, facing, back to back."""
    weights[:] = 0.0
    for side in range(2):
        for k in range(_BINS):
            own = walls[side, k]
            if own <= 0.0:
                continue
            for lag in range(min(_LAGS, _BINS - k)):
                for other in range(2):
                    if walls[other, k + lag] <= 0.0:
                        continue
                    if other == side and lag < _LEAST_LAG:
                        continue
                    # The lower wall faces plus: they face each other.
                    kind = 0 if other == side else 2 - side
                    weight = math.sqrt(
                        min(own, _LONG_ENOUGH) * min(walls[other, k + lag], _LONG_ENOUGH)
                    )
                    # Shared with the nearer of the neighbouring lengths.
                    length = lag // 2
                    near = length - 1 if lag % 2 == 0 else length + 1
                    weights[kind, length] += 0.75 * weight
                    if 0 <= near < _LENGTHS:
                        weights[kind, near] += 0.25 * weight


@kernel
def _spacings(panoramas, tables):  # type: ignore[no-untyped-def]
    """The words of each panorama."""
    found = np.zeros((len(panoramas), WORDS), np.uint64)
    walls = np.empty((2, 2, _BINS))
    weights = np.empty((3, _LENGTHS))
    for n in range(len(panoramas)):
        _walls(panoramas[n], tables, walls)
        for axis in range(2):
            _weights(walls[axis], weights)
            for length in range(_LENGTHS):
                bit = np.uint64(1) << np.uint64(length)
                if weights[0, length] >= _LEAST_WEIGHT:
                    found[n, axis] |= bit
                if weights[1, length] >= _LEAST_WEIGHT:
                    found[n, axis] |= bit << np.uint64(_LENGTHS)
                if weights[2, length] >= _LEAST_WEIGHT:
                    found[n, 2] |= bit << np.uint64(_LENGTHS * axis)
    return found
