"""Random buildings: rooms, doors and furniture drawn from a seed.

A plan starts with one corridor or hall; the block on each side of it becomes a row of rooms
or, where it is deep, gets a corridor of its own and is divided further.  Walls have two faces
and openings have jambs, as the laser sees them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from .errors import AnchorscanError
from .pose import Pose2D
from .world import Door, Furniture, Seed, World

__all__ = ["random_building"]

_Box = tuple[float, float, float, float]  # x1, y1, x2, y2 with x1 < x2 and y1 < y2


@dataclass(frozen=True, slots=True)
class _Style:
    """What makes one kind of building differ from another; lengths in metres."""

    corridor: tuple[float, float]
    room_width: tuple[float, float]
    room_depth: tuple[float, float]
    has_side_corridors: bool = False
    is_alike: bool = False
    column_spacing: float = math.inf


_STYLES = {
    "office": _Style((1.7, 3.0), (2.5, 6.5), (3.5, 6.5), has_side_corridors=True),
    "hall": _Style((10.0, 18.0), (3.0, 8.0), (3.0, 6.0), column_spacing=5.0),
    "lookalike": _Style((2.2, 2.2), (4.0, 4.0), (5.0, 5.0), is_alike=True),
}

_WALL = 0.15
_DOORWAY = (0.8, 1.1)
# A block deeper than this gets a corridor of its own instead of one row of rooms.
_DEEPEST_ROOM = 9.0
_SHORTEST_BLOCK = 12.0
# What stands nearer to a doorway than this would block it.
_DOORWAY_CLEARANCE = 1.1


def random_building(
    seed: Seed, *, style: str = "office", length: float = 40.0, depth: float = 24.0
) -> World:
    """Draw a building: rooms on both sides of a corridor or a hall, all reachable.

    Doors stand open, ajar or closed; some rooms also have a doorway to their neighbour.

    Args:
        seed: Seed or generator; the same seed gives the same building.
        style: "office" (rooms of all sizes, furnished at random, side corridors where the
            building is deep enough), "hall" (one large space with columns and shelves,
            rooms around it) or "lookalike" (equal rooms with equal furniture).
        length: Size along x, metres.
        depth: Size along y, metres, about.

    Raises:
        AnchorscanError: There is no such style, or the building is too small for it.
    """
    if style not in _STYLES:
        raise AnchorscanError(f"no style {style!r}; there are {', '.join(_STYLES)}")
    rules = _STYLES[style]
    least = rules.corridor[0] + 2.0 * (rules.room_depth[0] + _WALL)
    if length < 2.0 * rules.room_width[1] or depth < least:
        raise AnchorscanError(f"{length} x {depth} m is too small for the style {style!r}")
    return _Architect(rules, np.random.default_rng(seed)).building(length, depth)


@dataclass(frozen=True, slots=True)
class _Frame:
    """An axis-aligned frame of a block: along its corridor, and inward away from it."""

    x: float
    y: float
    along: tuple[float, float]
    inward: tuple[float, float]

    def point(self, s: float, t: float) -> tuple[float, float]:
        (a, b), (c, d) = self.along, self.inward
        return self.x + s * a + t * c, self.y + s * b + t * d

    def box(self, s1: float, t1: float, s2: float, t2: float) -> _Box:
        (x1, y1), (x2, y2) = self.point(s1, t1), self.point(s2, t2)
        return min(x1, x2), min(y1, y2), max(x1, x2), max(y1, y2)

    def angle(self, angle: float) -> float:
        """Carry the direction of an axis into the world (a mirrored frame turns it round)."""
        (a, b), (c, d) = self.along, self.inward
        u, v = math.cos(angle), math.sin(angle)
        return math.atan2(u * b + v * d, u * a + v * c)

    def at(self, s: float, t: float) -> _Frame:
        return _Frame(*self.point(s, t), self.along, self.inward)


class _Architect:
    """Draws one building into lists: spaces, the openings between them, what stands in them.

    Distances ``s`` run along the corridor that serves a block, ``t`` away from it; the wall
    between corridor and block fills ``-_WALL < t < 0``.
    """

    def __init__(self, style: _Style, rng: np.random.Generator) -> None:
        self.style = style
        self.rng = rng
        self.template = int(rng.integers(2**31))
        self.spaces: list[_Box] = []
        self.openings: list[tuple[_Box, bool]] = []  # with: the wall runs along x
        self.corridors: list[tuple[_Frame, float, float]] = []
        self.walls: list[tuple[float, ...]] = []
        self.columns: list[tuple[float, float, float]] = []
        self.doors: list[Door] = []
        self.furniture: list[Furniture] = []

    def building(self, length: float, depth: float) -> World:
        style, rng = self.style, self.rng
        spare = depth - 2.0 * (style.room_depth[0] + _WALL)
        width = min(rng.uniform(*style.corridor), spare)
        if style.has_side_corridors:
            above = (depth - width - 2.0 * _WALL) * rng.uniform(0.35, 0.65)
            below = depth - width - 2.0 * _WALL - above
        else:
            above, below = rng.uniform(*style.room_depth, size=2)
        self.spaces.append((0.0, 0.0, length, width))
        self.corridors.append((_Frame(0.0, 0.0, (1.0, 0.0), (0.0, 1.0)), length, width))
        self._block(_Frame(0.0, width + _WALL, (1.0, 0.0), (0.0, 1.0)), length, above)
        self._block(_Frame(0.0, -_WALL, (1.0, 0.0), (0.0, -1.0)), length, below)
        for corridor in self.corridors:
            self._furnish_corridor(*corridor)
        for space in self.spaces:
            self.walls.extend(_outline(space, self.openings))
        for opening, runs_along_x in self.openings:
            self.walls.extend(_jambs(opening, runs_along_x))
        return World(
            np.array(self.walls),
            np.array(self.columns),
            tuple(self.doors),
            tuple(self.furniture),
        )

    def _opening(self, frame: _Frame, low: float, high: float) -> None:
        """Open the wall before the block from ``s = low`` to ``high``."""
        self.openings.append((frame.box(low, -_WALL, high, 0.0), frame.along[1] == 0.0))

    def _block(self, frame: _Frame, length: float, depth: float) -> None:
        if depth <= _DEEPEST_ROOM or length < _SHORTEST_BLOCK:
            self._rooms(frame, length, depth)
            return
        width = self.rng.uniform(*self.style.corridor)
        low = (length - width) * self.rng.uniform(0.35, 0.65)
        high = low + width
        self.spaces.append(frame.box(low, 0.0, high, depth))
        self.corridors.append((frame.at(low, 0.0), width, depth))
        self._opening(frame, low, high)
        (a, b), inward = frame.along, frame.inward
        left, right = frame.point(low - _WALL, 0.0), frame.point(high + _WALL, 0.0)
        self._block(_Frame(*left, inward, (-a, -b)), depth, low - _WALL)
        self._block(_Frame(*right, inward, (a, b)), depth, length - high - _WALL)

    def _rooms(self, frame: _Frame, length: float, depth: float) -> None:
        low = 0.0
        least, most = self.style.room_width
        while length - low >= least:
            high = low + self.rng.uniform(least, most)
            # What is left over and too narrow for a room of its own goes to the last one.
            if length - high - _WALL < least and not self.style.is_alike:
                high = length
            if high > length:
                return
            self._room(frame.at(low, 0.0), high - low, depth)
            if high < length and not self.style.is_alike and self.rng.random() < 0.15:
                # A doorway to the next room, in the wall along t.
                t = self.rng.uniform(0.5, depth - 1.5)
                box = frame.box(high, t, high + _WALL, t + 0.9)
                self.openings.append((box, frame.along[1] != 0.0))
            low = high + _WALL

    def _room(self, frame: _Frame, width: float, depth: float) -> None:
        alike = self.style.is_alike
        rng = np.random.default_rng(self.template) if alike else self.rng
        self.spaces.append(frame.box(0.0, 0.0, width, depth))
        doorway = rng.uniform(*_DOORWAY)
        low = rng.uniform(0.15, width - doorway - 0.15)
        self._opening(frame, low, low + doorway)
        self._door(frame, low, low + doorway, rng)
        if rng.random() < 0.15:
            cut = rng.uniform(0.4, 0.9)
            self.walls.append((*frame.point(0.0, depth - cut), *frame.point(cut, depth)))
        taken = [(low + 0.5 * doorway, 0.0, _DOORWAY_CLEARANCE)]
        for _ in range(rng.poisson(width * depth / 6.0)):
            self._piece(frame, (width, depth), taken, rng)

    def _door(self, frame: _Frame, low: float, high: float, rng: np.random.Generator) -> None:
        """Hang a leaf that opens into the room, or leave the doorway without one."""
        kind = rng.random()
        ajar = rng.uniform(math.radians(60.0), math.radians(115.0))
        swap = rng.random() < 0.5
        if kind < 0.15:
            return
        hinge, latch = frame.point(low, 0.0), frame.point(high, 0.0)
        into_room = math.copysign(1.0, _cross(frame.along, frame.inward))
        if swap:
            hinge, latch, into_room = latch, hinge, -into_room
        # A fifth of the doors is closed; where all rooms are alike that would be all or none.
        is_closed = kind < 0.35 and not self.style.is_alike
        self.doors.append(Door(hinge, latch, 0.0 if is_closed else into_room * ajar))

    def _piece(
        self,
        frame: _Frame,
        size: tuple[float, float],
        taken: list[tuple[float, float, float]],
        rng: np.random.Generator,
    ) -> None:
        """Put one piece of furniture where nothing stands yet, or give up."""
        at_wall = rng.random() < 0.7
        length, width = (
            (rng.uniform(0.4, 1.8), rng.uniform(0.3, 0.6))
            if at_wall
            else (rng.uniform(1.0, 1.8), rng.uniform(0.6, 0.9))
        )
        reach = 0.5 * math.hypot(length, width)
        for _ in range(8):
            s, t = rng.uniform((0.0, 0.0), size)
            angle = rng.uniform(0.0, math.pi)
            if at_wall:
                s, t, angle = _against_wall(s, t, size, (length, width), int(rng.integers(4)))
            if not at_wall and not (reach < s < size[0] - reach and reach < t < size[1] - reach):
                continue
            if all(math.hypot(s - a, t - b) > reach + c for a, b, c in taken):
                taken.append((s, t, reach))
                pose = Pose2D(*frame.point(s, t), frame.angle(angle))
                self.furniture.append(Furniture(pose, length, width, not at_wall))
                return

    def _furnish_corridor(self, frame: _Frame, length: float, width: float) -> None:
        """Columns in halls, cupboards and pilasters along the walls of wide corridors."""
        rng, spacing = self.rng, self.style.column_spacing
        taken = [
            (*_local(frame, 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])), 1.0)
            for box, _ in self.openings
        ]
        radius = rng.uniform(0.2, 0.4)
        if math.isfinite(spacing):
            for s in np.arange(0.5 * spacing, length, spacing):
                for t in np.arange(0.5 * spacing, width - 0.3 * spacing, spacing):
                    self.columns.append((*frame.point(s, t), radius))
                    taken.append((s, t, radius))
            for _ in range(rng.poisson(length * width / 40.0)):
                self._piece(frame, (length, width), taken, rng)
        elif min(length, width) > 1.9 and not self.style.is_alike:
            self._pilasters(frame, (length, width), taken)

    def _pilasters(
        self, frame: _Frame, size: tuple[float, float], taken: list[tuple[float, float, float]]
    ) -> None:
        rng = self.rng
        for _ in range(rng.poisson(max(size) / 6.0)):
            length, width = rng.uniform(0.3, 1.2), rng.uniform(0.15, 0.4)
            # Along the longer walls only: at the ends it could close the way on.
            side = int(rng.integers(2)) + (0 if size[0] > size[1] else 2)
            s, t = rng.uniform((0.0, 0.0), size)
            s, t, angle = _against_wall(s, t, size, (length, width), side)
            reach = 0.5 * math.hypot(length, width)
            if all(math.hypot(s - a, t - b) > reach + c for a, b, c in taken):
                taken.append((s, t, reach + 1.0))
                pose = Pose2D(*frame.point(s, t), frame.angle(angle))
                self.furniture.append(Furniture(pose, length, width))


def _cross(a: tuple[float, float], b: tuple[float, float]) -> float:
    return a[0] * b[1] - a[1] * b[0]


def _local(frame: _Frame, x: float, y: float) -> tuple[float, float]:
    """Carry a point of the world into the frame."""
    (a, b), (c, d) = frame.along, frame.inward
    return (x - frame.x) * a + (y - frame.y) * b, (x - frame.x) * c + (y - frame.y) * d


def _against_wall(
    s: float, t: float, size: tuple[float, float], piece: tuple[float, float], side: int
) -> tuple[float, float, float]:
    """Push a piece (length, width) against one of four walls; give its centre and angle."""
    length, width = piece
    if side < 2:
        s = min(max(s, 0.5 * length), size[0] - 0.5 * length)
        return s, 0.5 * width if side == 0 else size[1] - 0.5 * width, 0.0
    t = min(max(t, 0.5 * length), size[1] - 0.5 * length)
    return 0.5 * width if side == 2 else size[0] - 0.5 * width, t, 0.5 * math.pi


def _outline(
    space: _Box, openings: Iterable[tuple[_Box, bool]]
) -> Iterator[tuple[float, float, float, float]]:
    """Walls around a space, open where an opening touches them."""
    x1, y1, x2, y2 = space
    slack = 1.0e-6
    for y in (y1, y2):
        gaps = [
            (o[0], o[2]) for o, along_x in openings if along_x and o[1] - slack < y < o[3] + slack
        ]
        for low, high in _without(x1, x2, gaps):
            yield low, y, high, y
    for x in (x1, x2):
        gaps = [
            (o[1], o[3])
            for o, along_x in openings
            if not along_x and o[0] - slack < x < o[2] + slack
        ]
        for low, high in _without(y1, y2, gaps):
            yield x, low, x, high


def _without(
    low: float, high: float, gaps: Iterable[tuple[float, float]]
) -> Iterator[tuple[float, float]]:
    """Give the parts of an interval that no gap covers."""
    for start, stop in sorted(gaps):
        if stop <= low or start >= high:
            continue
        if start > low:
            yield low, start
        low = stop
    if low < high:
        yield low, high


def _jambs(opening: _Box, runs_along_x: bool) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The two sides of an opening through the thickness of the wall."""
    x1, y1, x2, y2 = opening
    if runs_along_x:
        return (x1, y1, x1, y2), (x2, y1, x2, y2)
    return (x1, y1, x2, y1), (x1, y2, x2, y2)
