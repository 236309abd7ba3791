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
from .anchors import AnchorKind, AnchorPoints, AnchorStack
from .database import _LEAST_QUALITY, Votes, _bits

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
# Shifts lie in cells, so wide that those which agree are in the same or in neighbouring ones;
# there is one more cell on each side.
_CELL = 1.01 * _AGREEING
_CELLS = int(2.0 * _SHIFT / _CELL) + 3
_MOST_ANCHORS = 20
_KINDS = len(AnchorKind)
# A reading is where it is expected within so many metres and so much of its distance.
_TOLERANCE, _TOLERANCE_SHARE = 0.07, 0.015
# Agreement is counted in whole readings; the bound is to err on the safe side.
_SLACK = 1e-3
# So many readings are asked before it is looked whether the bound is out of reach.
_BETWEEN = 8
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
def _nearby(distances, lows, highs):  # type: ignore[no-untyped-def]
    """The nearest and the farthest that each direction and its two neighbours saw.

    Between two directions a wall may be anywhere between what both see.
    """
    for at in range(DIRECTIONS):
        low = high = distances[at]
        for other in (at + 1 if at + 1 < DIRECTIONS else 0, at - 1 if at > 0 else DIRECTIONS - 1):
            distance = distances[other]
            low = min(low, distance) if distance > 0.0 else low
            high = max(high, distance)
        lows[at], highs[at] = low, high


@kernel
def _agrees(x, y, lows, highs):  # type: ignore[no-untyped-def]
    """1 for a point that ends where a panorama says, -1 for one before it, 0 for others.

    What comes out is anybody's guess, so that nothing branches by it.
    """
    at = _direction(x, y)
    low, high = lows[at], highs[at]
    distance = math.sqrt(x * x + y * y)
    tolerance = np.float32(_TOLERANCE) + np.float32(_TOLERANCE_SHARE) * distance
    seen = int(low > 0.0)
    return seen * (int(distance <= high + tolerance) - 2 * int(distance < low - tolerance))


@kernel
def _there(readings, c, s, x, y, nearby, needed):  # type: ignore[no-untyped-def]
    """Agreement of the scan's readings with the reference's panorama.

    Once less than ``needed`` is sure, it is left at what it would be if no other one agreed;
    returns whether it was not.
    """
    lows, highs = nearby
    count = max(len(readings), 1)
    least = needed * count - _SLACK
    total, asked = 0, 0
    while asked < len(readings):
        end = min(asked + _BETWEEN, len(readings))
        for i in range(asked, end):
            px, py = readings[i, 0], readings[i, 1]
            total += _agrees(c * px - s * py + x, s * px + c * py + y, lows, highs)
        asked = end
        left = len(readings) - asked
        if total + left < least:
            return (total - left) / count, False
    return total / count, True


@kernel
def _back(distances, c, s, x, y, own, needed):  # type: ignore[no-untyped-def]
    """Agreement of the reference's directions with the scan's panorama, as in ``_there``."""
    lows, highs = own
    left = 0
    for at in range(0, DIRECTIONS, _EVERY):
        left += distances[at] > 0.0
    count = max(left, 1)
    least = needed * count - _SLACK
    total, at = 0, 0
    for n in range(DIRECTIONS // _EVERY):
        at = (at + _STRIDE) % DIRECTIONS
        distance = distances[at]
        if distance <= 0.0:
            continue
        px, py = distance * _UNITS[at, 0] - x, distance * _UNITS[at, 1] - y
        total += _agrees(c * px + s * py, c * py - s * px, lows, highs)
        left -= 1
        if n % _BETWEEN == 0 and total + left < least:
            return (total - left) / count
    return total / count


@kernel
def _shifts(seen, turned, positions, directions, starts, pairs, lying, tried):  # type: ignore[no-untyped-def]
    """The shifts between scan and reference that most pairs of anchor points agree on.

    Rows of ``tried`` are the quarter turn, the shift, and the pairs that agree; returns how many.
    ``lying`` says which pairs of a turn lie in each cell, a bit each; all clear between turns.
    """
    counts = np.zeros(4, np.int64)
    for i in range(len(seen.kinds)):
        kind = seen.kinds[i]
        for j in range(starts[kind], starts[kind + 1]):
            # Directions tell the quarter turn: no pair is alike in two of them.
            off = (directions[j] - seen.directions[i]) * np.float32(2.0 / math.pi)
            # Rounded: a conversion cuts off what is positive, and costs less than a floor.
            quarters = np.int32(off + np.float32(64.5)) - np.int32(64)
            quarter = quarters & 3
            dx = positions[j, 0] - turned[i, quarter, 0]
            dy = positions[j, 1] - turned[i, quarter, 1]
            unlike = abs(off - np.float32(quarters)) > np.float32(_ALIKE * 2.0 / math.pi)
            if unlike | (dx * dx + dy * dy > np.float32(_SHIFT * _SHIFT)):
                continue
            if counts[quarter] == _MOST_PAIRS:
                continue
            row = counts[quarter]
            pairs[quarter, row, 0], pairs[quarter, row, 1] = dx, dy
            pairs[quarter, row, 2], pairs[quarter, row, 3] = i, j
            counts[quarter] += 1
    found = 0
    for turn in range(4):
        if found == _TRIED and tried[found - 1, 3] >= counts[turn]:
            continue
        for k in range(counts[turn]):
            at = _cell(pairs[turn, k, 0], pairs[turn, k, 1])
            lying[at] |= np.uint64(1) << np.uint64(k)
        for k in range(counts[turn]):
            near = _around(lying, _cell(pairs[turn, k, 0], pairs[turn, k, 1]))
            # No more can agree than lie near: too few would change neither shift.
            if found < _TRIED or np.float32(_bits(near)) > min(tried[0, 3], tried[1, 3]):
                found = _noted(pairs[turn], near, k, turn, tried, found)
        for k in range(counts[turn]):
            lying[_cell(pairs[turn, k, 0], pairs[turn, k, 1])] = 0
    return found


@kernel
def _cell(dx, dy):  # type: ignore[no-untyped-def]
    """Which cell a shift lies in."""
    u = np.int32((dx + np.float32(_SHIFT)) * np.float32(1.0 / _CELL)) + 1
    v = np.int32((dy + np.float32(_SHIFT)) * np.float32(1.0 / _CELL)) + 1
    return u * _CELLS + v


@kernel
def _around(lying, at):  # type: ignore[no-untyped-def]
    """The pairs in a cell and in those around it, a bit each."""
    near = np.uint64(0)
    for row in range(at - _CELLS, at + _CELLS + 1, _CELLS):
        near |= lying[row - 1] | lying[row] | lying[row + 1]
    return near


@kernel
def _noted(pairs, near, k, turn, tried, found):  # type: ignore[no-untyped-def]
    """Note the mean shift of the pairs that agree with pair ``k``, each anchor point once."""
    agreeing, x, y = 0, np.float32(0.0), np.float32(0.0)
    had_i, had_j = np.uint64(0), np.uint64(0)
    while near != 0:
        rest = near & (near - np.uint64(1))
        other = np.int64(_bits((near ^ rest) - np.uint64(1)))
        near = rest
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
def _turned(positions):  # type: ignore[no-untyped-def]
    """Positions in each of the four quarter turns."""
    turned = np.empty((len(positions), 4, 2), np.float32)
    for i in range(len(positions)):
        x, y = positions[i, 0], positions[i, 1]
        for turn in range(4):
            turned[i, turn, 0], turned[i, turn, 1] = x, y
            x, y = -y, x
    return turned


@kernel
def _upright(stack, place, positions, directions, starts):  # type: ignore[no-untyped-def]
    """Anchor points of a reference in the frame of its walls, ordered by kind."""
    all_positions, all_kinds, all_directions, main_angles, begins = stack
    main = main_angles[place] if math.isfinite(main_angles[place]) else 0.0
    c, s = math.cos(main), math.sin(main)
    first = begins[place]
    last = min(begins[place + 1], first + _MOST_ANCHORS)
    starts[:] = 0
    for at in range(first, last):
        starts[all_kinds[at] + 2] += 1
    for kind in range(2, _KINDS + 2):
        starts[kind] += starts[kind - 1]
    # Where the next of each kind goes; in the end that is where the next kind begins.
    for at in range(first, last):
        k = starts[all_kinds[at] + 1]
        starts[all_kinds[at] + 1] += 1
        x, y = all_positions[at, 0], all_positions[at, 1]
        positions[k, 0], positions[k, 1] = c * x + s * y, c * y - s * x
        directions[k] = all_directions[at] - main


@kernel
def _worth(seen, stack, panoramas, places, votes, most):  # type: ignore[no-untyped-def]
    """What each reference is worth, or a lower bound where it is not among the best."""
    found = np.empty(len(places))
    best = np.full(max(min(most, len(places)), 1), -np.inf)
    positions = np.empty((_MOST_ANCHORS, 2), np.float32)
    directions = np.empty(_MOST_ANCHORS, np.float32)
    starts = np.empty(_KINDS + 2, np.int64)
    turned = _turned(seen.positions)
    pairs = np.empty((4, _MOST_PAIRS, 4), np.float32)
    lying = np.zeros(_CELLS * _CELLS, np.uint64)
    tried = np.empty((_TRIED, 4), np.float32)
    distances = np.empty(DIRECTIONS, np.float32)
    nearby = (np.empty(DIRECTIONS, np.float32), np.empty(DIRECTIONS, np.float32))
    own = (np.empty(DIRECTIONS, np.float32), np.empty(DIRECTIONS, np.float32))
    _nearby(seen.distances, own[0], own[1])
    for k in range(len(places)):
        _upright(stack, places[k], positions, directions, starts)
        shifts = _shifts(seen, turned, positions, directions, starts, pairs, lying, tried)
        for at in range(DIRECTIONS):
            distances[at] = _DISTANCES[panoramas[places[k], at]]
        _nearby(distances, nearby[0], nearby[1])
        found[k] = _NO_AGREEMENT + votes[k]
        for n in range(shifts):
            quarter = _QUARTERS[int(tried[n, 0])]
            c, s = np.float32(quarter[0]), np.float32(quarter[1])
            x, y = tried[n, 1], tried[n, 2]
            sure = _PER_PAIR * tried[n, 3] + votes[k]
            # The other way adds one at most: the worst of the best may be out of reach already.
            needed = best[-1] - sure
            there, complete = _there(seen.readings, c, s, x, y, nearby, needed - 1.0)
            value = sure + there
            if not complete:
                found[k] = max(found[k], value - 1.0)
                continue
            needed -= there
            found[k] = max(found[k], value + _back(distances, c, s, x, y, own, needed))
        if found[k] > best[-1]:
            n = len(best) - 1
            while n > 0 and best[n - 1] < found[k]:
                best[n] = best[n - 1]
                n -= 1
            best[n] = found[k]
    return found
