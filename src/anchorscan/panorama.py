"""Beyond section 4.1: which of the references voted for have seen what the scan sees.

Relations between a dozen anchor points cannot tell a million places apart.  What the scans saw
in between can, and a byte for every two degrees is enough for that: the *panorama* of a
reference, the distance of the nearest reading in each of 180 directions, in the frame of the
main walls.

The references of the most votes, a few thousand at most, are compared.  Anchor points of the
same kind and direction, one of the scan and one of the reference, propose how far the scan was
taken from the reference, for each of the four quarter turns between the frames of their walls;
the two shifts that most pairs agree on are tried.  There the cheap question of section 5 is
asked, in both directions: how many readings of the one scan end where the other's panorama
says, less those that end before it, in space that the other saw to be free.  What ends behind
it is hidden, and says nothing.

The order is that of

    worth = agreement + agreement the other way + 0.05 * pairs + 0.2 * log(q_m).

``docs/scale.md`` has the measurements.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .anchors import AnchorPoints, AnchorStack
from .database import _LEAST_QUALITY, Votes

__all__ = ["DIRECTIONS", "View", "panorama", "reordered", "view", "worth"]

DIRECTIONS = 180
"""Directions of a panorama."""

# Codes: 0 is nothing seen, others are distances in steps of 2.7 %.
_NEAREST, _FARTHEST = 0.1, 80.0
_SMALLEST = 0.08
_STEP = math.log(1000.0) / 254
_DISTANCES = np.array(
    [0.0, *(_SMALLEST * math.exp(_STEP * code) for code in range(255))], np.float32
)
_ANGLES = (np.arange(DIRECTIONS) + 0.5) * (2.0 * math.pi / DIRECTIONS) - math.pi
_UNITS = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)]).astype(np.float32)
# Readings of the scan that are compared, the farthest of them, and every which direction of the
# reference is.
_READINGS = 40
_FARTHEST_READING = 30.0
_EVERY = 4
# Readings side by side agree together.  Whoever asks far apart ones first knows sooner: steps of
# the golden ratio, and every seventh of the directions in turn.
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_STRIDE = 7 * _EVERY
# Pairs of anchor points: directions differ by no more, radians; the scan was taken no farther
# from the reference; shifts that agree, metres; pairs of one quarter turn; shifts that are tried;
# anchor points of one scan: more make some searches slow, and choose hardly better.
_ALIKE = 0.5
_SHIFT = 5.0
_AGREEING = 0.2
_MOST_PAIRS = 48
_TRIED = 2
_MOST_ANCHORS = 20
# A reading is where it is expected within so many metres and so much of its distance.
_TOLERANCE, _TOLERANCE_SHARE = 0.07, 0.015
# Agreement is counted in whole readings; the bound is to err on the safe side.
_SLACK = 1e-3
_PER_PAIR, _PER_VOTE = 0.05, 0.2
_NO_AGREEMENT = -2.0
_QUARTERS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))


class View(NamedTuple):
    """What a scan is compared by, in the frame of its main walls.

    Args:
        positions: (A, 2) float32 anchor points, metres.
        kinds: (A,) int64.
        directions: (A,) float32 of the free space before them, radians.
        readings: (R, 2) float32 some end points, metres.
        distances: (180,) float32 of its panorama, metres; 0 where nothing was seen.
    """

    positions: NDArray[np.float32]
    kinds: NDArray[np.int64]
    directions: NDArray[np.float32]
    readings: NDArray[np.float32]
    distances: NDArray[np.float32]


def panorama(points: NDArray[np.float64], main_angle: float) -> NDArray[np.uint8]:
    """Return what a scan saw in each direction.

    Args:
        points: (N, 2) end points, metres, scan frame.
        main_angle: Of the main walls, radians, scan frame; NaN for the frame of the scan.

    Returns:
        (180,) uint8, 0 where nothing was seen; otherwise the code of the distance.
    """
    main = main_angle if math.isfinite(main_angle) else 0.0
    seen: NDArray[np.uint8] = _panorama(np.asarray(points, np.float64), main)
    return seen


def view(points: NDArray[np.float64], anchors: AnchorPoints) -> View:
    """Prepare a scan for being compared.

    Args:
        points: (N, 2) end points, metres, scan frame.
        anchors: Its anchor points.
    """
    main = anchors.main_angle if math.isfinite(anchors.main_angle) else 0.0
    c, s = math.cos(main), math.sin(main)
    upright = np.array([[c, -s], [s, c]])
    near = points[np.hypot(points[:, 0], points[:, 1]) < _FARTHEST_READING]
    some = np.linspace(0, len(near) - 1, min(_READINGS, len(near))).astype(np.int64)
    some = some[np.argsort(np.arange(len(some)) * _GOLDEN % 1.0)]
    return View(
        (anchors.positions[:_MOST_ANCHORS] @ upright).astype(np.float32),
        anchors.kinds[:_MOST_ANCHORS].astype(np.int64),
        (anchors.directions[:_MOST_ANCHORS] - main).astype(np.float32),
        (near[some] @ upright).astype(np.float32),
        _DISTANCES[panorama(points, main)],
    )


def worth(
    seen: View,
    anchors: AnchorStack,
    panoramas: NDArray[np.uint8],
    places: NDArray[np.int64],
    quality: NDArray[np.float64],
    most: int,
) -> NDArray[np.float64]:
    """Compare a scan with references.

    Args:
        seen: Of the scan.
        anchors: Anchor points of all references.
        panoramas: (N, 180) of all references.
        places: (K,) which of them.
        quality: (K,) q_m of these.
        most: How many of the best will be asked for: those that provably are not among them
            get a lower bound of their worth instead.

    Returns:
        (K,) what they are worth.
    """
    stack = (
        anchors.positions,
        anchors.kinds,
        anchors.directions,
        anchors.main_angles,
        anchors.starts,
    )
    votes = _PER_VOTE * np.log(quality + _LEAST_QUALITY)
    found: NDArray[np.float64] = _worth(seen, stack, panoramas, places, votes, most)
    return found


def reordered(found: Sequence[tuple[Votes, NDArray[np.float64]]], most: int) -> Votes:
    """Put the first votes in the order of their worth, and keep as many as are wanted.

    Args:
        found: Votes of the references and what (K,) the first of them are worth, for each look
            at the scan; a reference counts by the look that it is worth most in.
        most: How many are wanted.
    """
    worths = [np.append(worth, np.full(len(votes) - len(worth), -np.inf)) for votes, worth in found]
    references, counts, quality = (
        np.concatenate([getattr(votes, name) for votes, _ in found])
        for name in ("references", "counts", "quality")
    )
    order = np.lexsort((references, -quality, -np.concatenate(worths)))
    if len(found) > 1:
        _, first = np.unique(references[order], return_index=True)
        order = order[np.sort(first)]
    order = order[:most]
    return Votes(references[order], counts[order], quality[order])


@kernel
def _direction(x, y):  # type: ignore[no-untyped-def]
    """Which direction of a panorama a point lies in.

    The angle is that of a polynomial, within 0.3 degrees: quicker than the exact one.
    """
    across, along = abs(y), abs(x)
    low, high = min(across, along), max(across, along)
    if high <= 0.0:
        return 0
    a = low / high
    angle = a * (np.float32(0.7853982) + np.float32(0.273) * (np.float32(1.0) - a))
    if across > along:
        angle = np.float32(1.5707964) - angle
    if x < 0.0:
        angle = np.float32(3.1415927) - angle
    if y < 0.0:
        angle = -angle
    at = int((angle + np.float32(3.1415927)) * np.float32(DIRECTIONS / (2.0 * math.pi)))
    return at if at < DIRECTIONS else 0


@kernel
def _panorama(points, main):  # type: ignore[no-untyped-def]
    """The nearest reading in each direction."""
    seen = np.zeros(DIRECTIONS, np.uint8)
    c, s = math.cos(main), math.sin(main)
    for i in range(len(points)):
        distance = math.hypot(points[i, 0], points[i, 1])
        if not _NEAREST <= distance <= _FARTHEST:
            continue
        x = np.float32(c * points[i, 0] + s * points[i, 1])
        y = np.float32(c * points[i, 1] - s * points[i, 0])
        at = _direction(x, y)
        code = np.uint8(min(1 + int(math.log(distance / _SMALLEST) / _STEP + 0.5), 255))
        if seen[at] == 0 or code < seen[at]:
            seen[at] = code
    return seen


@kernel
def _agrees(x, y, distances):  # type: ignore[no-untyped-def]
    """1 for a point that ends where a panorama says, -1 for one before it, 0 for others."""
    at = _direction(x, y)
    low = distances[at]
    if low <= 0.0:
        return 0
    high = low
    # Between two directions a wall may be anywhere between what both see.
    for other in (at + 1 if at + 1 < DIRECTIONS else 0, at - 1 if at > 0 else DIRECTIONS - 1):
        distance = distances[other]
        if distance > 0.0:
            low = min(low, distance)
            high = max(high, distance)
    distance = math.sqrt(x * x + y * y)
    tolerance = np.float32(_TOLERANCE) + np.float32(_TOLERANCE_SHARE) * distance
    if distance < low - tolerance:
        return -1
    return 1 if distance <= high + tolerance else 0


@kernel
def _there(readings, c, s, x, y, distances, needed):  # type: ignore[no-untyped-def]
    """Agreement of the scan's readings with the reference's panorama.

    Once less than ``needed`` is sure, it is left at what it would be if no other one agreed;
    the second value says so.
    """
    count = max(len(readings), 1)
    least = needed * count - _SLACK
    total, left = 0, len(readings)
    for i in range(len(readings)):
        px, py = readings[i, 0], readings[i, 1]
        total += _agrees(c * px - s * py + x, s * px + c * py + y, distances)
        left -= 1
        if total + left < least:
            return (total - left) / count, False
    return total / count, True


@kernel
def _back(distances, c, s, x, y, own, needed):  # type: ignore[no-untyped-def]
    """Agreement of the reference's directions with the scan's panorama, as in ``_there``."""
    left = 0
    for at in range(0, DIRECTIONS, _EVERY):
        left += distances[at] > 0.0
    count = max(left, 1)
    least = needed * count - _SLACK
    total, at = 0, 0
    for _ in range(DIRECTIONS // _EVERY):
        at = (at + _STRIDE) % DIRECTIONS
        distance = distances[at]
        if distance <= 0.0:
            continue
        px, py = distance * _UNITS[at, 0] - x, distance * _UNITS[at, 1] - y
        total += _agrees(c * px + s * py, c * py - s * px, own)
        left -= 1
        if total + left < least:
            return (total - left) / count
    return total / count


@kernel
def _shifts(seen, positions, kinds, directions, pairs, tried):  # type: ignore[no-untyped-def]
    """The shifts between scan and reference that most pairs of anchor points agree on.

    Rows of ``tried`` are the quarter turn, the shift, and the pairs that agree; returns how many.
    """
    counts = np.zeros(4, np.int64)
    for i in range(len(seen.kinds)):
        for j in range(len(kinds)):
            if kinds[j] != seen.kinds[i]:
                continue
            # Directions tell the quarter turn: no pair is alike in two of them.
            off = (directions[j] - seen.directions[i]) * np.float32(2.0 / math.pi)
            quarters = math.floor(off + np.float32(0.5))
            turn = int(quarters) & 3
            if abs(off - quarters) > np.float32(_ALIKE * 2.0 / math.pi):
                continue
            c, s = np.float32(_QUARTERS[turn][0]), np.float32(_QUARTERS[turn][1])
            dx = positions[j, 0] - (c * seen.positions[i, 0] - s * seen.positions[i, 1])
            dy = positions[j, 1] - (s * seen.positions[i, 0] + c * seen.positions[i, 1])
            if dx * dx + dy * dy > np.float32(_SHIFT * _SHIFT) or counts[turn] == _MOST_PAIRS:
                continue
            pair = pairs[turn, counts[turn]]
            pair[0], pair[1], pair[2], pair[3] = dx, dy, i, j
            counts[turn] += 1
    found = 0
    for turn in range(4):
        for k in range(counts[turn]):
            if found == _TRIED and tried[found - 1, 3] >= counts[turn]:
                break
            found = _noted(pairs[turn], counts[turn], k, turn, tried, found)
    return found


@kernel
def _noted(pairs, count, k, turn, tried, found):  # type: ignore[no-untyped-def]
    """Note the mean shift of the pairs that agree with pair ``k``, each anchor point once."""
    agreeing, x, y = 0, np.float32(0.0), np.float32(0.0)
    had_i, had_j = np.uint64(0), np.uint64(0)
    for other in range(count):
        dx, dy = pairs[other, 0] - pairs[k, 0], pairs[other, 1] - pairs[k, 1]
        if dx * dx + dy * dy > np.float32(_AGREEING * _AGREEING):
            continue
        bit_i = np.uint64(1) << np.uint64(pairs[other, 2])
        bit_j = np.uint64(1) << np.uint64(pairs[other, 3])
        if had_i & bit_i or had_j & bit_j:
            continue
        had_i |= bit_i
        had_j |= bit_j
        agreeing += 1
        x += pairs[other, 0]
        y += pairs[other, 1]
    x /= np.float32(agreeing)
    y /= np.float32(agreeing)
    for n in range(found):
        dx, dy = tried[n, 1] - x, tried[n, 2] - y
        if tried[n, 0] == turn and dx * dx + dy * dy < np.float32(_AGREEING * _AGREEING):
            if tried[n, 3] < agreeing:
                tried[n, 1], tried[n, 2], tried[n, 3] = x, y, agreeing
            return found
    if found == _TRIED:
        if tried[found - 1, 3] >= agreeing:
            return found
        found -= 1
    n = found
    while n > 0 and tried[n - 1, 3] < agreeing:
        for column in range(4):
            tried[n, column] = tried[n - 1, column]
        n -= 1
    tried[n, 0], tried[n, 1], tried[n, 2], tried[n, 3] = turn, x, y, agreeing
    return found + 1


@kernel
def _upright(stack, place, positions, kinds, directions):  # type: ignore[no-untyped-def]
    """Anchor points of a reference in the frame of its walls; returns how many."""
    all_positions, all_kinds, all_directions, main_angles, starts = stack
    main = main_angles[place] if math.isfinite(main_angles[place]) else 0.0
    c, s = math.cos(main), math.sin(main)
    count = min(starts[place + 1] - starts[place], _MOST_ANCHORS)
    for k in range(count):
        at = starts[place] + k
        x, y = all_positions[at, 0], all_positions[at, 1]
        positions[k, 0], positions[k, 1] = c * x + s * y, c * y - s * x
        kinds[k] = all_kinds[at]
        directions[k] = all_directions[at] - main
    return count


@kernel
def _worth(seen, stack, panoramas, places, votes, most):  # type: ignore[no-untyped-def]
    """What each reference is worth, or a lower bound where it is not among the best."""
    found = np.empty(len(places))
    best = np.full(max(min(most, len(places)), 1), -np.inf)
    positions = np.empty((_MOST_ANCHORS, 2), np.float32)
    kinds = np.empty(_MOST_ANCHORS, np.int64)
    directions = np.empty(_MOST_ANCHORS, np.float32)
    pairs = np.empty((4, _MOST_PAIRS, 4), np.float32)
    tried = np.empty((_TRIED, 4), np.float32)
    distances = np.empty(DIRECTIONS, np.float32)
    for k in range(len(places)):
        count = _upright(stack, places[k], positions, kinds, directions)
        shifts = _shifts(seen, positions[:count], kinds[:count], directions[:count], pairs, tried)
        for at in range(DIRECTIONS):
            distances[at] = _DISTANCES[panoramas[places[k], at]]
        found[k] = _NO_AGREEMENT + votes[k]
        for n in range(shifts):
            quarter = _QUARTERS[int(tried[n, 0])]
            c, s = np.float32(quarter[0]), np.float32(quarter[1])
            x, y = tried[n, 1], tried[n, 2]
            sure = _PER_PAIR * tried[n, 3] + votes[k]
            # The other way adds one at most: the worst of the best may be out of reach already.
            needed = best[-1] - sure
            there, complete = _there(seen.readings, c, s, x, y, distances, needed - 1.0)
            value = sure + there
            if not complete:
                found[k] = max(found[k], value - 1.0)
                continue
            needed -= there
            found[k] = max(found[k], value + _back(distances, c, s, x, y, seen.distances, needed))
        if found[k] > best[-1]:
            n = len(best) - 1
            while n > 0 and best[n - 1] < found[k]:
                best[n] = best[n - 1]
                n -= 1
            best[n] = found[k]
    return found
