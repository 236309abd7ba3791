"""Section 4.2 taken further: every relation proposes an alignment, in the set's frame.

The paper aligns graph with graph and takes only the edge correspondences behind the maximum
of a matrix.  Where references have poses in a common frame, every single correspondence
can propose where the scan was taken, because a wrong proposal costs next to nothing: a
dozen look-ups in the map stitched from the references tell it from a right one.

Anchor points here are *oriented*: they carry their kind and the direction of the free space
before them.  Two edges correspond when their lengths, the kinds of their ends and the
directions at both ends agree; that leaves one assignment of the ends instead of two, rules
mirror images out, and leaves a hundredth of the correspondences that length alone would.
The main angles of scan and reference sharpen the rotation.

A scan with few anchor points has few edges.  There an oriented anchor point alone, with the
main angle, relates scan and map: it stands for the edge between itself and the wall.

Anchor points of different references that show one physical thing are merged into a
*landmark*; relations join landmarks that one reference saw together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .anchors import AnchorKind, AnchorPoints, AnchorStack, stack_anchors
from .pose import Pose2D
from .ranking import first_from
from .tiles import Tiles, coarse_score

__all__ = [
    "Landmarks",
    "ProposalSettings",
    "Proposals",
    "check_landmarks",
    "checked",
    "joined",
    "landmarks",
    "on_large",
    "proposals",
    "related",
]

_KINDS = len(AnchorKind)
# Directions are kept in 65,536ths of a turn: 16-bit differences wrap by themselves.
_TURN = 1 << 16
_QUARTER = _TURN // 4
_UNKNOWN = 1 << 14  # in place of an angle to the main angle, which lies within 45 degrees
_HEADINGS = 256
_TRIGONOMETRY = 1 << 12
_ANGLES = (np.arange(_TRIGONOMETRY) + 0.5) * (2.0 * math.pi / _TRIGONOMETRY)
_COSINE, _SINE = np.cos(_ANGLES), np.sin(_ANGLES)
_HEADING = (np.arange(_HEADINGS) + 0.5) * 2.0 * math.pi / _HEADINGS
_HEADING_COSINE, _HEADING_SINE = np.cos(_HEADING), np.sin(_HEADING)
# A proposal in the same cell of position as one before it is the same.
_CELL = 0.12
_MOST = 1 << 16
# Edges are sorted out by their length in steps of this, metres.
_LENGTHS = 1.0 / 64.0
_1 = np.uint64(1)


class ProposalSettings(BaseModel):
    """Settings of the search for alignments in the set's frame."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    shortest_edge: float = Field(0.5, ge=0.0, description="relations that are used, metres")
    longest_edge: float = Field(15.0, gt=0.0, description="relations that are used, metres")
    length_tolerance: float = Field(0.1, gt=0.0, description="corresponding lengths, metres")
    direction_tolerance: float = Field(
        math.radians(20.0), gt=0.0, description="direction at an anchor to its edge, radians"
    )
    heading_tolerance: float = Field(
        math.radians(10.0), gt=0.0, description="edge to main angles, radians"
    )
    lone_heading_tolerance: float = Field(
        math.radians(25.0), gt=0.0, description="lone anchor to main angles, radians"
    )
    most_edges: int = Field(800, ge=1, description="edges of a scan that propose, the longest")
    enough: int = Field(300, ge=0, description="with so many from edges no lone anchors")
    readings: int = Field(12, ge=4, description="readings of the first check")
    most: int = Field(150, ge=1, description="proposals that pass the first check")
    landmark_cell: float = Field(0.2, gt=0.0, description="anchors merged within, metres")
    landmark_turn: float = Field(math.radians(30.0), gt=0.0, description="and within, radians")


class Landmarks(NamedTuple):
    """Anchor points of references in the set's frame and their relations, in blocks.

    A block is searched as a whole; merged landmarks make one, single references one each.
    Directions are in 65,536ths of a turn; *askew* is the angle to the main angle modulo 90
    degrees, or 16,384 where there is no main angle.

    Args:
        positions: (L, 2) metres.
        directions: (L, 2) int16 of the free space, and askew.
        starts: (B, K + 1) where the landmarks of each kind begin.
        edges: (E, 2) int32 landmarks, the one of the lower kind first.
        lengths: (E,) float32 metres, ascending within each pair of kinds.
        turns: (E, 4) int16 bearing of the edge in the set's frame, directions at its ends
            relative to it, and askew.
        edge_starts: (B, K * K + 1) where the edges of each pair of kinds begin.
    """

    positions: NDArray[np.float64]
    directions: NDArray[np.int16]
    starts: NDArray[np.int64]
    edges: NDArray[np.int32]
    lengths: NDArray[np.float32]
    turns: NDArray[np.int16]
    edge_starts: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Proposals:
    """Alignments that passed the first check.

    Args:
        poses: (P, 3) T_set_laser, in the order in which they were proposed.
        scores: (P,) of the first check, in [-1, 1].
        proposed: How many there were before.
    """

    poses: NDArray[np.float64]
    scores: NDArray[np.float64]
    proposed: int


def landmarks(
    anchors: Sequence[tuple[AnchorPoints, Pose2D]], settings: ProposalSettings
) -> Landmarks:
    """Merge the anchor points of references into landmarks and relate them.

    Args:
        anchors: Anchor points of each reference and its pose ``T_set_laser``.
        settings: Of the search.
    """
    poses = np.array([pose.to_array() for _, pose in anchors]).reshape(-1, 3)
    return related(stack_anchors([each for each, _ in anchors]), poses, settings)


def related(
    anchors: AnchorStack, poses: NDArray[np.float64], settings: ProposalSettings
) -> Landmarks:
    """Do what ``landmarks`` does for many references.

    Args:
        anchors: Anchor points of the references.
        poses: (C, 3) ``T_set_laser`` of each.
        settings: Of the search.
    """
    sizes = np.diff(anchors.starts)
    x, y, theta = np.repeat(poses, sizes, axis=0).T
    c, s = np.cos(theta), np.sin(theta)
    positions = np.column_stack(
        (
            x + c * anchors.positions[:, 0] - s * anchors.positions[:, 1],
            y + s * anchors.positions[:, 0] + c * anchors.positions[:, 1],
        )
    )
    kinds, directions = anchors.kinds, anchors.directions + theta
    main = np.repeat(anchors.main_angles, sizes) + theta

    turn = 2.0 * math.pi / max(round(2.0 * math.pi / settings.landmark_turn), 1)
    keys = np.column_stack(
        (
            kinds,
            np.floor(positions / settings.landmark_cell),
            np.floor(np.mod(directions, 2.0 * math.pi) / turn),
        )
    ).astype(np.int64)
    first, member = _alike(keys)
    count = len(first)
    seen = np.bincount(member, minlength=count)
    centre = np.column_stack(
        [np.bincount(member, positions[:, k], minlength=count) / seen for k in range(2)]
    )
    facing = np.arctan2(
        np.bincount(member, np.sin(directions), minlength=count),
        np.bincount(member, np.cos(directions), minlength=count),
    )
    pairs = np.unique(_pairs(kinds, member, anchors.starts))
    a, b = np.divmod(pairs, max(count, 1))
    kinds = kinds[first]
    across = centre[b] - centre[a]
    lengths = np.hypot(across[:, 0], across[:, 1])
    good = (lengths >= settings.shortest_edge) & (lengths <= settings.longest_edge)
    a, b, lengths, across = a[good], b[good], lengths[good], across[good]
    bearing = np.arctan2(across[:, 1], across[:, 0])
    group = kinds[a] * _KINDS + kinds[b]
    order = np.lexsort((b, a, lengths, group))
    turns = np.column_stack(
        (
            _units(bearing),
            _units(facing[a] - bearing),
            _units(facing[b] - bearing),
            _askew(bearing - main[first][a]),
        )
    )
    return Landmarks(
        centre,
        np.column_stack((_units(facing), _askew(facing - main[first]))),
        np.searchsorted(kinds, np.arange(_KINDS + 1))[np.newaxis],
        np.column_stack((a, b))[order].astype(np.int32),
        lengths[order].astype(np.float32),
        turns[order],
        np.searchsorted(group[order], np.arange(_KINDS * _KINDS + 1))[np.newaxis],
    )


def _alike(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort out equal rows: the first of every kind, in order, and which kind each row is."""
    order = np.lexsort(keys.T[::-1])
    is_first = np.ones(len(keys), np.bool_)
    is_first[1:] = np.any(keys[order[1:]] != keys[order[:-1]], axis=1)
    member = np.empty(len(keys), np.int64)
    member[order] = np.cumsum(is_first) - 1
    return order[is_first], member


def check_landmarks(known: Landmarks) -> None:
    """See that stored landmarks name nothing that is not there.

    Raises:
        ValueError: They do.
    """
    count, edges = len(known.positions), len(known.lengths)
    starts = known.starts.reshape(-1), known.edge_starts.reshape(-1)
    if (
        known.positions.shape != (count, 2)
        or known.directions.shape != (count, 2)
        or known.edges.shape != (edges, 2)
        or known.turns.shape != (edges, 4)
        or known.starts.shape != (1, _KINDS + 1)
        or known.edge_starts.shape != (1, _KINDS * _KINDS + 1)
        or any(np.any(np.diff(each) < 0) or each[0] != 0 for each in starts)
        or starts[0][-1] != count
        or starts[1][-1] != edges
        or (edges and not (known.edges.min() >= 0 and known.edges.max() < count))
    ):
        raise ValueError("the landmarks do not fit each other")


def joined(parts: Sequence[Landmarks]) -> Landmarks:
    """Put the blocks of several landmarks side by side, unmerged."""
    counts = np.cumsum([0, *(len(part.positions) for part in parts)])
    edges = np.cumsum([0, *(len(part.lengths) for part in parts)])
    return Landmarks(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.directions for part in parts]),
        np.concatenate([part.starts + n for part, n in zip(parts, counts[:-1], strict=True)]),
        np.concatenate(
            [part.edges + np.int32(n) for part, n in zip(parts, counts[:-1], strict=True)]
        ),
        np.concatenate([part.lengths for part in parts]),
        np.concatenate([part.turns for part in parts]),
        np.concatenate([part.edge_starts + n for part, n in zip(parts, edges[:-1], strict=True)]),
    )


def _units(angles: ArrayLike) -> NDArray[np.int16]:
    """Angles in 65,536ths of a turn, wrapped."""
    turns = np.mod(np.asarray(angles) / (2.0 * math.pi), 1.0)
    return np.round(turns * _TURN).astype(np.int64).astype(np.uint16).view(np.int16)


def _askew(angles: NDArray[np.float64]) -> NDArray[np.int16]:
    """Angles modulo 90 degrees in 65,536ths of a turn; ``_UNKNOWN`` for NaN."""
    known = ~np.isnan(angles)
    units = _units(np.where(known, angles, 0.0)).astype(np.int64)
    folded = ((units + _QUARTER // 2) & (_QUARTER - 1)) - _QUARTER // 2
    return np.where(known, folded, _UNKNOWN).astype(np.int16)


@kernel
def _pairs(kinds, member, starts):  # type: ignore[no-untyped-def]
    """All pairs of landmarks that one reference saw together, the lower kind first.

    A pair is one integer, the first landmark times the number of all plus the second.
    """
    count = 0
    for landmark in member:
        count = max(count, landmark + 1)
    total = 0
    for n in range(len(starts) - 1):
        size = starts[n + 1] - starts[n]
        total += size * (size - 1) // 2
    pairs = np.empty(total, np.int64)
    found = 0
    for n in range(len(starts) - 1):
        for i in range(starts[n], starts[n + 1]):
            for j in range(i + 1, starts[n + 1]):
                a, b = member[i], member[j]
                if a == b:
                    continue
                if kinds[i] > kinds[j] or (kinds[i] == kinds[j] and a > b):
                    a, b = b, a
                pairs[found] = a * count + b
                found += 1
    return pairs[:found]


def proposals(
    anchors: AnchorPoints,
    points: NDArray[np.float64],
    known: Landmarks | Sequence[Landmarks],
    tiles: Tiles,
    settings: ProposalSettings,
) -> Proposals:
    """Let the relations of a scan propose where it was taken, and keep what may be right.

    Args:
        anchors: Of the scan.
        points: (N, 2) end points of the returns to check with, metres, scan frame; or (N, 3)
            ``verification.readings``, of which those on small things are passed over.
        known: Landmarks of the references, all of them or several lots.
        tiles: The map stitched from them.
        settings: Of the search.
    """
    query = (anchors.positions, anchors.kinds, anchors.directions, anchors.main_angle)
    unit = _TURN / (2.0 * math.pi)
    limits = (
        settings.shortest_edge,
        settings.longest_edge,
        settings.length_tolerance,
        int(settings.direction_tolerance * unit),
        int(settings.heading_tolerance * unit),
        int(settings.lone_heading_tolerance * unit),
        settings.most_edges,
    )
    lots = [known] if isinstance(known, Landmarks) else known
    out = np.empty((_MOST, 3))
    found = 0
    for lot in lots:
        found = _edge_proposals(query, lot, limits, out, found)
    if found < settings.enough:
        for lot in lots:
            found = _lone_proposals(query, lot, limits, out, found)
    return _passing(out, found, points, tiles, settings)


def checked(
    poses: NDArray[np.float64],
    points: NDArray[np.float64],
    tiles: Tiles,
    settings: ProposalSettings,
) -> Proposals:
    """Keep those of (P, 3) poses at which a few readings may fit.

    Args:
        poses: T_set_laser, metres and radians.
        points: (N, 2) end points of the returns to check with, metres, scan frame; or (N, 3)
            ``verification.readings``, of which those on small things are passed over.
        tiles: The map.
        settings: How many readings and proposals.
    """
    units = _units(poses[:, 2]).view(np.uint16)
    return _passing(np.column_stack((poses[:, :2], units)), len(poses), points, tiles, settings)


def _passing(
    out: NDArray[np.float64],
    found: int,
    points: NDArray[np.float64],
    tiles: Tiles,
    settings: ProposalSettings,
) -> Proposals:
    """Those of the first poses, with headings in 65,536ths of a turn, that pass the first check."""
    sieve = (settings.readings, settings.most)
    poses, scores = _checked(points, tiles, out, found, sieve)
    return Proposals(poses, scores, found)


@kernel
def on_large(readings):  # type: ignore[no-untyped-def]
    """Those of (N, 3) readings that are not on small things; all where nobody says."""
    large = np.empty(readings.shape)
    found = 0
    for i in range(len(readings)):
        if readings.shape[1] < 3 or readings[i, 2] == 0.0:
            for j in range(readings.shape[1]):
                large[found, j] = readings[i, j]
            found += 1
    return large[:found]


@kernel
def spread(points, most):  # type: ignore[no-untyped-def]
    """At most ``most`` of (N, K) points, evenly over the readings."""
    count = min(len(points), most)
    chosen = np.empty((count, points.shape[1]))
    for k in range(count):
        i = ((2 * k + 1) * len(points)) // (2 * count)
        for j in range(points.shape[1]):
            chosen[k, j] = points[i, j]
    return chosen


@kernel
def _to_units(angle):  # type: ignore[no-untyped-def]
    """An angle in 65,536ths of a turn, not wrapped."""
    return np.int64(math.floor(angle * (_TURN / (2.0 * math.pi)) + 0.5))


@kernel
def _apart(a, b):  # type: ignore[no-untyped-def]
    """How far two angles are apart, from 0 to half a turn, in 65,536ths of one."""
    return abs(np.int64(np.int16(a - b)))


@kernel
def _fold(units):  # type: ignore[no-untyped-def]
    """65,536ths of a turn modulo a quarter turn, from minus to plus an eighth."""
    return ((units + _QUARTER // 2) & (_QUARTER - 1)) - _QUARTER // 2


@kernel
def _rotated(points, tiles):  # type: ignore[no-untyped-def]
    """Points turned to every heading, in coarse cells."""
    table = np.empty((_HEADINGS, len(points), 2), np.float32)
    scale = 0.25 / tiles.resolution
    for h in range(_HEADINGS):
        c, s = _HEADING_COSINE[h] * scale, _HEADING_SINE[h] * scale
        for i in range(len(points)):
            table[h, i, 0] = c * points[i, 0] - s * points[i, 1]
            table[h, i, 1] = s * points[i, 0] + c * points[i, 1]
    return table


@kernel
def _is_new(seen, x, y, heading):  # type: ignore[no-untyped-def]
    """Whether no proposal fell into this cell of position and heading before."""
    cx = np.uint64(np.int64(math.floor(x / _CELL)) + (1 << 24))
    cy = np.uint64(np.int64(math.floor(y / _CELL)) + (1 << 24))
    key = (cx << np.uint64(34)) ^ (cy << np.uint64(8)) ^ np.uint64(heading)
    last = np.uint64(len(seen) - 1)
    slot = ((key * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40)) & last
    while seen[slot] != 0:
        if seen[slot] == key:
            return False
        slot = (slot + np.uint64(1)) & last
    seen[slot] = key
    return True


@kernel
def _first_check(table, heading, x, y, tiles):  # type: ignore[no-untyped-def]
    """Sum of coarse scores of the chosen readings; -1 where the first half says no."""
    scale = 0.25 / tiles.resolution
    gx = np.float32(x * scale - (tiles.column >> 2))
    gy = np.float32(y * scale - (tiles.row >> 2))
    count = table.shape[1]
    total = 0
    for i in range(count):
        total += coarse_score(tiles, int(gx + table[heading, i, 0]), int(gy + table[heading, i, 1]))
        # Half of the readings without a quarter of what they could reach: not here.
        if 2 * (i + 1) == count and total < 16 * count:
            return -1
    return max(total, -1)


@kernel
def _put(out, found, anchor, landmark, units):  # type: ignore[no-untyped-def]
    """Note the pose that lays ``anchor`` on ``landmark`` under a rotation."""
    k = (units & (_TURN - 1)) >> 4
    c, s = _COSINE[k], _SINE[k]
    out[found, 0] = landmark[0] - c * anchor[0] + s * anchor[1]
    out[found, 1] = landmark[1] - s * anchor[0] - c * anchor[1]
    out[found, 2] = units & (_TURN - 1)


@kernel
def _shortest(positions, limits):  # type: ignore[no-untyped-def]
    """Length from which edges propose: of very many the longest, of which the map has least."""
    shortest, longest, most = limits[0], limits[1], limits[6]
    count = len(positions)
    if count * (count - 1) // 2 <= most:
        return shortest
    counts = np.zeros(min(int(longest / _LENGTHS) + 1, _MOST), np.int64)
    for i in range(count):
        for j in range(i + 1, count):
            dx, dy = positions[j, 0] - positions[i, 0], positions[j, 1] - positions[i, 1]
            length = math.sqrt(dx * dx + dy * dy)
            if shortest <= length <= longest:
                counts[min(int(length / _LENGTHS), len(counts) - 1)] += 1
    least = len(counts)
    room = most
    while least > 0 and counts[least - 1] <= room:
        least -= 1
        room -= counts[least]
    return max(shortest, least * _LENGTHS)


@kernel
def _edge_proposals(query, known, limits, out, found):  # type: ignore[no-untyped-def]
    """Poses proposed by corresponding oriented edges; appended to ``out`` as long as they fit."""
    positions, kinds, directions, main = query
    shortest = _shortest(positions, limits)
    for i in range(len(kinds)):
        for j in range(i + 1, len(kinds)):
            a, b = (i, j) if kinds[i] <= kinds[j] else (j, i)
            dx, dy = positions[b, 0] - positions[a, 0], positions[b, 1] - positions[a, 1]
            length = math.sqrt(dx * dx + dy * dy)
            if length < shortest or length > limits[1]:
                continue
            bearing = math.atan2(dy, dx)
            middle = (positions[a, 0] + 0.5 * dx, positions[a, 1] + 0.5 * dy)
            edge = (
                length,
                _to_units(bearing),
                _to_units(directions[a] - bearing),
                _to_units(directions[b] - bearing),
                _fold(_to_units(bearing - main)) if math.isfinite(main) else _UNKNOWN,
            )
            group = kinds[a] * _KINDS + kinds[b]
            for block in range(len(known.edge_starts)):
                found = _corresponding(edge, middle, group, block, known, limits, out, found)
    return found


@kernel
def _corresponding(edge, middle, group, block, known, limits, out, found):  # type: ignore[no-untyped-def]
    """Poses proposed by one edge and the edges of one block that correspond to it."""
    length, bearing, turn_a, turn_b, askew = edge
    tolerance, turn_tolerance, heading_tolerance = limits[2], limits[3], limits[4]
    begin, end = known.edge_starts[block, group], known.edge_starts[block, group + 1]
    # Unsigned indices spare the check for negative ones.
    e = np.uint64(first_from(known.lengths, begin, end, length - tolerance))
    end = np.uint64(end)
    symmetric = group % (_KINDS + 1) == 0
    while e < end and known.lengths[e] <= length + tolerance:
        for flip in range(2 if symmetric else 1):
            # With ends of one kind either may be either: the other way round is half a turn.
            half = flip * (_TURN // 2)
            first, second = (turn_a, turn_b) if flip == 0 else (turn_b, turn_a)
            # One branch for both, since a processor can foresee neither.
            off_first = _apart(known.turns[e, 1], first - half)
            off_second = _apart(known.turns[e, 2], second - half)
            if max(off_first, off_second) > turn_tolerance:
                continue
            units = known.turns[e, 0] - bearing + half
            if askew != _UNKNOWN and known.turns[e, 3] != _UNKNOWN:
                off = _fold(known.turns[e, 3] - askew)
                if abs(off) > heading_tolerance:
                    continue
                units -= off
            if found == len(out):
                return found
            u, v = known.edges[e, 0], known.edges[e, 1]
            centre = (
                0.5 * (known.positions[u, 0] + known.positions[v, 0]),
                0.5 * (known.positions[u, 1] + known.positions[v, 1]),
            )
            _put(out, found, middle, centre, units)
            found += 1
        e += _1
    return found


@kernel
def _lone_proposals(query, known, limits, out, found):  # type: ignore[no-untyped-def]
    """Poses proposed by single oriented anchors; appended to ``out``."""
    positions, kinds, directions, main = query
    for i in range(len(kinds)):
        direction = _to_units(directions[i])
        askew = _fold(_to_units(directions[i] - main)) if math.isfinite(main) else _UNKNOWN
        anchor = (positions[i, 0], positions[i, 1])
        for block in range(len(known.starts)):
            for m in range(known.starts[block, kinds[i]], known.starts[block, kinds[i] + 1]):
                units = known.directions[m, 0] - direction
                if askew != _UNKNOWN and known.directions[m, 1] != _UNKNOWN:
                    off = _fold(known.directions[m, 1] - askew)
                    if abs(off) > limits[5]:
                        continue
                    units -= off
                if found == len(out):
                    return found
                _put(out, found, anchor, (known.positions[m, 0], known.positions[m, 1]), units)
                found += 1
    return found


@kernel
def _checked(points, tiles, out, found, sieve):  # type: ignore[no-untyped-def]
    """Drop what was proposed before, check the others by some readings, and keep the best."""
    count, most = sieve
    chosen = spread(on_large(points), count)
    table = _rotated(chosen, tiles)
    slots = 64
    while slots < 2 * found:
        slots *= 2
    seen = np.zeros(slots, np.uint64)
    scores = np.empty(found, np.int32)
    kept = 0
    for k in range(found):
        heading = int(out[k, 2]) * _HEADINGS // _TURN
        if not _is_new(seen, out[k, 0], out[k, 1], heading):
            continue
        score = _first_check(table, heading, out[k, 0], out[k, 1], tiles)
        if score >= 0:
            for value in range(3):
                out[kept, value] = out[k, value]
            scores[kept] = score
            kept += 1
    full = 127 * max(len(chosen), 1)
    return _highest(out[:kept], scores[:kept], full, most)


@kernel
def _highest(poses, scores, full, most):  # type: ignore[no-untyped-def]
    """The poses of the highest scores; of equals at the border those proposed first."""
    counts = np.zeros(full + 1, np.int64)
    for score in scores:
        counts[score] += 1
    least = full + 1
    room = 0
    while least > 0 and room < most:
        least -= 1
        room += counts[least]
    best = np.empty((min(room, most), 3))
    values = np.empty(len(best))
    border = counts[least] - (room - len(best))
    taken = 0
    for k in range(len(scores)):
        if scores[k] < least or (scores[k] == least and border <= 0):
            continue
        if scores[k] == least:
            border -= 1
        best[taken, 0], best[taken, 1] = poses[k, 0], poses[k, 1]
        best[taken, 2] = poses[k, 2] * (2.0 * math.pi / _TURN)
        values[taken] = scores[k] / full
        taken += 1
    return best, values
