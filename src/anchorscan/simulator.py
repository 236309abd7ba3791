"""Buildings with exact truth: worlds of segments and circles, and the scans seen in them.

A `World` is a plain value: walls, round pillars, doors that turn on a hinge, furniture and
people.  `random_building` draws one from a seed, `simulate` gives the scan at a pose, and
`drive` a log of scans along a path through free space.  Everything is a function of its
arguments and its seed.

Readings are exact ray intersections.  Instead of testing every ray against every surface,
the ray caster computes which readings a surface can be seen by (the readings are uniform in
angle) and intersects only those, so that the cost of a scan grows with what is in view.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from heapq import heappop, heappush

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._jit import kernel
from .errors import AnchorscanError
from .occupancy import OccupancyGrid
from .pose import Pose2D, wrap_angle
from .record import Record
from .scan import LaserScan
from .sensor import SensorModel

__all__ = [
    "Door",
    "Furniture",
    "SensorModel",
    "World",
    "cast_rays",
    "drive",
    "move_furniture",
    "noisy_odometry",
    "random_building",
    "random_poses",
    "rasterise",
    "remove_walls",
    "scatter_people",
    "simulate",
    "turn_doors",
]

Seed = int | np.random.Generator

_LEG_RADIUS = 0.025
_PERSON_RADIUS = 0.22


def _rows(values: ArrayLike, width: int) -> NDArray[np.float64]:
    """Return a read-only (N, width) copy."""
    array = np.array(values, dtype=np.float64).reshape(-1, width)
    array.setflags(write=False)
    return array


@dataclass(frozen=True, slots=True)
class Door:
    """A door leaf on a hinge.

    Args:
        hinge: (x, y) of the hinge, metres, world frame.
        latch: (x, y) of the free edge of the leaf when it is closed.
        opening: Angle by which the leaf is turned from closed, radians; the sign tells to
            which side it opens.
    """

    hinge: tuple[float, float]
    latch: tuple[float, float]
    opening: float = 0.0

    @property
    def leaf(self) -> tuple[float, float, float, float]:
        """The leaf as a segment x1, y1, x2, y2."""
        (x, y), (u, v) = self.hinge, self.latch
        c, s = math.cos(self.opening), math.sin(self.opening)
        return x, y, x + c * (u - x) - s * (v - y), y + s * (u - x) + c * (v - y)


@dataclass(frozen=True, slots=True)
class Furniture:
    """A piece of furniture: a box, or four legs.

    Args:
        pose: ``T_world_furniture``, at its centre.
        length: Size along its x axis, metres.
        width: Size along its y axis, metres.
        has_legs: It stands on four legs that the laser looks through, as a table does.
    """

    pose: Pose2D
    length: float
    width: float
    has_legs: bool = False

    @property
    def corners(self) -> NDArray[np.float64]:
        """(4, 2) corners in order, metres, world frame."""
        half = 0.5 * np.array([self.length, self.width])
        return self.pose.apply(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half)


@dataclass(frozen=True, eq=False)
class World:
    """What the laser can see, as segments and circles.

    Args:
        walls: (W, 4) segments x1, y1, x2, y2, metres.
        pillars: (P, 3) circles x, y, radius, metres.
        doors: Door leaves.
        furniture: Boxes and tables.
        people: (K, 3) circles x, y, radius, metres.
    """

    walls: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 4)))
    pillars: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    doors: tuple[Door, ...] = ()
    furniture: tuple[Furniture, ...] = ()
    people: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))

    def __post_init__(self) -> None:
        object.__setattr__(self, "walls", _rows(self.walls, 4))
        object.__setattr__(self, "pillars", _rows(self.pillars, 3))
        object.__setattr__(self, "people", _rows(self.people, 3))
        object.__setattr__(self, "doors", tuple(self.doors))
        object.__setattr__(self, "furniture", tuple(self.furniture))

    @cached_property
    def segments(self) -> NDArray[np.float64]:
        """(S, 4) all straight surfaces x1, y1, x2, y2, metres."""
        leaves = _rows([door.leaf for door in self.doors], 4)
        boxes = [
            np.hstack((piece.corners, np.roll(piece.corners, -1, axis=0)))
            for piece in self.furniture
            if not piece.has_legs
        ]
        return np.concatenate((self.walls, leaves, *boxes))

    @cached_property
    def circles(self) -> NDArray[np.float64]:
        """(C, 3) all round surfaces x, y, radius, metres."""
        legs = [
            np.column_stack((piece.corners, np.full(4, _LEG_RADIUS)))
            for piece in self.furniture
            if piece.has_legs
        ]
        return np.concatenate((self.pillars, *legs, self.people))

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """Smallest and largest x and y of all surfaces: x1, y1, x2, y2, metres."""
        ends = self.segments.reshape(-1, 2)
        round_ = self.circles
        low = np.concatenate((ends, round_[:, :2] - round_[:, 2:]))
        high = np.concatenate((ends, round_[:, :2] + round_[:, 2:]))
        if len(low) == 0:
            return 0.0, 0.0, 0.0, 0.0
        return (*low.min(axis=0).tolist(), *high.max(axis=0).tolist())

    def moved(self, T_new_world: Pose2D) -> World:
        """Return the world carried rigidly into another frame."""

        def ends(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return T_new_world.apply(values.reshape(-1, 2)).reshape(-1, 4)

        def centres(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.column_stack((T_new_world.apply(values[:, :2]), values[:, 2]))

        def point(values: tuple[float, float]) -> tuple[float, float]:
            x, y = T_new_world.apply([values])[0].tolist()
            return x, y

        return World(
            ends(self.walls),
            centres(self.pillars),
            tuple(Door(point(d.hinge), point(d.latch), d.opening) for d in self.doors),
            tuple(replace(piece, pose=T_new_world @ piece.pose) for piece in self.furniture),
            centres(self.people),
        )


# --- Scans -----------------------------------------------------------------------------


def cast_rays(
    world: World,
    pose: Pose2D,
    first_angle: float,
    increment: float,
    count: int,
    *,
    reach: float = math.inf,
) -> NDArray[np.float64]:
    """Measure exact distances to the first surface along evenly spaced rays.

    Args:
        world: What can be seen.
        pose: ``T_world_laser``.
        first_angle: Angle of the first ray, radians, laser frame.
        increment: Angle between rays, radians; ``abs(count * increment)`` must not exceed
            a turn by more than one increment.
        count: Number of rays.
        reach: Distance beyond which surfaces may be left out, metres.

    Returns:
        (count,) metres; ``inf`` where there is nothing.
    """
    distances = np.full(count, math.inf)
    angle = pose.theta + first_angle
    angles = angle + increment * np.arange(count)
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    beams = (pose.x, pose.y, angle, increment, reach, directions, distances)
    _cast_at_segments(world.segments, *beams)
    _cast_at_circles(world.circles, *beams)
    return distances


def simulate(
    world: World, pose: Pose2D, sensor: SensorModel, rng: np.random.Generator | None = None
) -> LaserScan:
    """Take a scan.

    Args:
        world: What can be seen.
        pose: ``T_world_laser`` (of the laser, not of the robot).
        sensor: The laser scanner.
        rng: Source of noise and dropouts; None leaves both out.
    """
    first_angle, increment = sensor.sweep
    # Beyond the range limit by more than the noise, surfaces cannot matter.
    reach = sensor.range_max * (1.0 + 8.0 * sensor.relative_noise) + 8.0 * sensor.noise
    distances = cast_rays(world, pose, first_angle, increment, sensor.count, reach=reach)
    return sensor.measure(distances, rng)


@kernel
def _window(low: float, high: float, increment: float, lap: int, count: int) -> tuple[int, int]:
    """Readings that look between two angles from the first one, in the sense of rotation."""
    step = abs(increment)
    offset = lap * 2.0 * math.pi
    first = int(math.floor((low - offset) / step))
    last = int(math.ceil((high - offset) / step))
    return max(first, 0), min(last, count - 1)


@kernel
def _cast_at_segments(
    segments: NDArray[np.float64],
    x: float,
    y: float,
    angle: float,
    increment: float,
    reach: float,
    directions: NDArray[np.float64],
    distances: NDArray[np.float64],
) -> None:
    """Lower ``distances`` to those of the segments, for rays ``angle + i * increment``."""
    sense = 1.0 if increment > 0.0 else -1.0
    for index in range(len(segments)):
        ax, ay = segments[index, 0] - x, segments[index, 1] - y
        bx, by = segments[index, 2] - x, segments[index, 3] - y
        if min(ax, bx) > reach or max(ax, bx) < -reach:
            continue
        if min(ay, by) > reach or max(ay, by) < -reach:
            continue
        first = math.atan2(ay, ax)
        span = math.atan2(ax * by - ay * bx, ax * bx + ay * by)
        if sense * span < 0.0:
            first += span
        low = (sense * (first - angle)) % (2.0 * math.pi)
        ex, ey = bx - ax, by - ay
        for lap in range(2):
            start, stop = _window(low, low + abs(span), increment, lap, len(distances))
            for ray in range(start, stop + 1):
                dx, dy = directions[ray, 0], directions[ray, 1]
                cross = dx * ey - dy * ex
                if abs(cross) < 1.0e-12:
                    continue
                share = (ax * dy - ay * dx) / cross
                distance = (ax * ey - ay * ex) / cross
                # The slack closes the joint of two walls for a ray through their common end.
                if -1.0e-9 <= share <= 1.0 + 1.0e-9 and 0.0 <= distance < distances[ray]:
                    distances[ray] = distance


@kernel
def _cast_at_circles(
    circles: NDArray[np.float64],
    x: float,
    y: float,
    angle: float,
    increment: float,
    reach: float,
    directions: NDArray[np.float64],
    distances: NDArray[np.float64],
) -> None:
    """Lower ``distances`` to those of the circles, for rays ``angle + i * increment``."""
    sense = 1.0 if increment > 0.0 else -1.0
    for index in range(len(circles)):
        cx, cy, radius = circles[index, 0] - x, circles[index, 1] - y, circles[index, 2]
        squared = cx * cx + cy * cy
        if squared > (reach + radius) ** 2:
            continue
        half = math.pi if squared <= radius * radius else math.asin(radius / math.sqrt(squared))
        low = (sense * (math.atan2(cy, cx) - angle) - half) % (2.0 * math.pi)
        for lap in range(2):
            start, stop = _window(low, low + 2.0 * half, increment, lap, len(distances))
            for ray in range(start, stop + 1):
                along = cx * directions[ray, 0] + cy * directions[ray, 1]
                root = radius * radius - squared + along * along
                if root < 0.0:
                    continue
                distance = along - math.sqrt(root)
                if distance < 0.0:
                    distance = along + math.sqrt(root)
                if 0.0 <= distance < distances[ray]:
                    distances[ray] = distance


# --- Buildings -------------------------------------------------------------------------

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
            _rows(self.columns, 3),
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


# --- Changes ---------------------------------------------------------------------------


def scatter_people(
    world: World,
    count: int,
    seed: Seed,
    *,
    around: Pose2D,
    reach: float = 5.0,
    nearest: float = 0.6,
) -> World:
    """Put people into the view of a pose, in addition to those already there.

    Args:
        world: The world to fill.
        count: Number of people; those for whom there is no room are left out.
        seed: Seed or generator.
        around: ``T_world_laser``.
        reach: Farthest distance of a person, metres.
        nearest: Nearest distance of a person's surface, metres.
    """
    rng = np.random.default_rng(seed)
    people = list(world.people)
    for angle in rng.uniform(-math.pi, math.pi, count):
        free = min(float(cast_rays(world, around, angle, 1.0, 1)[0]), reach)
        low, high = nearest + _PERSON_RADIUS, free - _PERSON_RADIUS
        distance = rng.uniform(low, max(low, high))
        if low <= high:
            direction = around.theta + angle
            x = around.x + distance * math.cos(direction)
            y = around.y + distance * math.sin(direction)
            people.append(np.array([x, y, _PERSON_RADIUS]))
    return replace(world, people=_rows(people, 3))


def turn_doors(world: World, seed: Seed, *, share: float = 1.0) -> World:
    """Turn a share of the doors: closed ones open, open ones close."""
    rng = np.random.default_rng(seed)
    doors = []
    for door in world.doors:
        chosen, ajar = rng.random() < share, rng.uniform(math.radians(60.0), math.radians(115.0))
        sign = 1.0 if rng.random() < 0.5 else -1.0
        opening = 0.0 if door.opening != 0.0 else sign * ajar
        doors.append(replace(door, opening=opening) if chosen else door)
    return replace(world, doors=tuple(doors))


def move_furniture(world: World, seed: Seed, *, share: float = 1.0, distance: float = 1.0) -> World:
    """Push and turn a share of the furniture by up to ``distance`` metres, not through walls."""
    rng = np.random.default_rng(seed)
    walls = World(world.walls, world.pillars)
    pieces = []
    for piece in world.furniture:
        chosen, direction = rng.random() < share, rng.uniform(-math.pi, math.pi)
        turn, push = rng.uniform(-math.pi, math.pi), rng.uniform(0.0, distance)
        ray = Pose2D(piece.pose.x, piece.pose.y, direction)
        room = float(cast_rays(walls, ray, 0.0, 1.0, 1)[0])
        push = max(min(push, room - 0.5 * math.hypot(piece.length, piece.width)), 0.0)
        x, y = ray.apply([[push, 0.0]])[0].tolist()
        pose = Pose2D(x, y, piece.pose.theta + turn)
        pieces.append(replace(piece, pose=pose) if chosen else piece)
    return replace(world, furniture=tuple(pieces))


def remove_walls(world: World, seed: Seed, *, share: float) -> World:
    """Take a share of the wall segments away."""
    keep = np.random.default_rng(seed).random(len(world.walls)) >= share
    return replace(world, walls=world.walls[keep])


# --- Drives ----------------------------------------------------------------------------


def rasterise(world: World, resolution: float = 0.05) -> OccupancyGrid:
    """Draw the world into a grid: occupied where a surface passes, unknown outside.

    Outside is what is connected to the border of the map without crossing a surface; where
    that leaves nothing free, the world has no inside and all of it is free.
    """
    margin = 5.0 * resolution
    x1, y1, x2, y2 = world.bounds
    columns = math.ceil((x2 - x1 + 2.0 * margin) / resolution)
    rows = math.ceil((y2 - y1 + 2.0 * margin) / resolution)
    origin = Pose2D(x1 - margin, y1 - margin)
    data = np.zeros((rows, columns), dtype=np.int8)
    empty = OccupancyGrid(data, resolution, origin)
    cells = empty.cells(_samples(world, 0.2 * resolution))
    data[cells[:, 0], cells[:, 1]] = 100
    inside = OccupancyGrid(data, resolution, origin).regions()
    border = np.concatenate((inside[0], inside[-1], inside[:, 0], inside[:, -1]))
    is_outside = np.isin(inside, border[border > 0])
    if (data[~is_outside] == 0).any():
        data[is_outside] = -1
    return OccupancyGrid(data, resolution, origin)


def _samples(world: World, step: float) -> NDArray[np.float64]:
    """(N, 2) points on all surfaces, at most ``step`` metres apart along each."""
    points = [np.empty((0, 2))]
    for x1, y1, x2, y2 in world.segments.tolist():
        share = np.linspace(0.0, 1.0, 2 + int(math.hypot(x2 - x1, y2 - y1) / step))[:, None]
        points.append((x1, y1) + share * (x2 - x1, y2 - y1))
    for x, y, radius in world.circles.tolist():
        angle = np.linspace(0.0, 2.0 * math.pi, 4 + int(2.0 * math.pi * radius / step))
        points.append(np.column_stack((x + radius * np.cos(angle), y + radius * np.sin(angle))))
    return np.concatenate(points)


def random_poses(world: World, count: int, seed: Seed, *, radius: float = 0.3) -> list[Pose2D]:
    """Draw poses in the largest space that a round robot can reach, in all headings.

    Args:
        world: Where to stand.
        count: Number of poses.
        seed: Seed or generator.
        radius: Distance to keep from all surfaces, metres.

    Raises:
        AnchorscanError: The robot fits nowhere.
    """
    rng = np.random.default_rng(seed)
    grid = rasterise(world, _PLAN_RESOLUTION)
    # Centres stand for their whole cells, so half a diagonal is kept in addition.
    cells = np.argwhere(grid.reachable(radius + _PLAN_RESOLUTION))
    if len(cells) == 0:
        raise AnchorscanError(f"a robot of radius {radius} m fits nowhere in this world")
    points = grid.centres(cells[rng.integers(len(cells), size=count)])
    points += rng.uniform(-0.5, 0.5, points.shape) * grid.resolution
    headings = rng.uniform(-math.pi, math.pi, count)
    return [Pose2D(x, y, h) for (x, y), h in zip(points.tolist(), headings, strict=True)]


_PLAN_RESOLUTION = 0.1
# Nearer to surfaces than this, metres, a path costs more, so that drives keep to the middle.
_COMFORT = 0.7
_SMOOTHING = 9
_SPEED = 0.5
_TURN_SPEED = 0.8


def drive(
    world: World,
    sensor: SensorModel | None = None,
    *,
    seed: Seed = 0,
    length: float = 100.0,
    step: float = 0.25,
    turn: float = math.radians(15.0),
    radius: float = 0.25,
    odometry_noise: float = 0.02,
) -> list[Record]:
    """Drive from one random goal to the next and take scans on the way.

    The path keeps away from surfaces where it can, bends smoothly, and turns on the spot at
    a goal.  Path, sensor noise and odometry noise have random streams of their own: another
    sensor sees the same drive.

    Args:
        world: Where to drive.
        sensor: The laser scanner; 180 degrees by default.
        seed: Seed or generator.
        length: Metres to drive.
        step: Metres between scans at most.
        turn: Turn between scans at most, radians.
        radius: Robot radius, metres.
        odometry_noise: As for `noisy_odometry`.

    Returns:
        Records with exact poses of the laser (``T_world_laser``), odometry of the laser that
        starts at the identity of the robot, and stamps at a walking robot's speed.

    Raises:
        AnchorscanError: The robot fits nowhere.
    """
    sensor = sensor or SensorModel()
    path_rng, sensor_rng, odometry_rng = np.random.default_rng(seed).spawn(3)
    poses = _poses_along(_path(world, length, radius, path_rng), step, turn)
    odometry = noisy_odometry(poses, odometry_noise, odometry_rng)
    records = []
    stamp = 0.0
    for index, (pose, odom) in enumerate(zip(poses, odometry, strict=True)):
        if index > 0:
            before = poses[index - 1]
            stamp += before.distance(pose) / _SPEED + before.turn(pose) / _TURN_SPEED
        T_world_laser = pose @ sensor.mounting
        records.append(
            Record(
                index,
                simulate(world, T_world_laser, sensor, sensor_rng),
                T_world_laser,
                odom @ sensor.mounting,
                stamp,
                f"simulated scan {index}",
            )
        )
    return records


def noisy_odometry(poses: Iterable[Pose2D], noise: float, rng: np.random.Generator) -> list[Pose2D]:
    """Odometry of a drive: starts at the identity and drifts.

    Distances and turns are wrong by a factor that is constant over the drive (wheels of the
    wrong size) and by one that is new at every step; both have the standard deviation
    ``noise``.  In addition the heading drifts by ``0.1 * noise`` radians a metre.

    Args:
        poses: True poses of the robot, in any frame.
        noise: Relative standard deviation: 0.05 is 5 percent.
        rng: Source of the noise.
    """
    result: list[Pose2D] = []
    before: Pose2D | None = None
    constant = 1.0 + noise * rng.standard_normal(2)
    for pose in poses:
        if before is None:
            result.append(Pose2D())
        else:
            move = before.inverse() @ pose
            far, round_ = constant + noise * rng.standard_normal(2)
            drift = 0.1 * noise * math.hypot(move.x, move.y) * rng.standard_normal()
            result.append(
                result[-1] @ Pose2D(far * move.x, far * move.y, round_ * move.theta + drift)
            )
        before = pose
    return result


def _path(
    world: World, length: float, radius: float, rng: np.random.Generator
) -> list[NDArray[np.float64]]:
    """Legs of a path, each (N, 2) metres, from goal to goal, ``length`` metres together."""
    grid = rasterise(world, _PLAN_RESOLUTION)
    passable = grid.reachable(radius)
    cells = np.argwhere(passable)
    if len(cells) == 0:
        raise AnchorscanError(f"a robot of radius {radius} m fits nowhere in this world")
    cost = 1.0 + 4.0 * np.clip(1.0 - grid.clearance / _COMFORT, 0.0, 1.0)
    cost = np.where(passable, cost, math.inf)
    legs: list[NDArray[np.float64]] = []
    here = cells[rng.integers(len(cells))]
    driven = 0.0
    while driven < length and len(cells) > 1:
        goal = cells[rng.integers(len(cells))]
        way = _cheapest_way(cost, here[0], here[1], goal[0], goal[1])
        if len(way) > 1:
            leg = _smooth(grid.centres(way))
            legs.append(leg)
            driven += float(np.hypot(*np.diff(leg, axis=0).T).sum())
            here = goal
    return legs or [grid.centres(here[None])]


def _smooth(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Moving average along a path that keeps its ends."""
    half = _SMOOTHING // 2
    padded = np.concatenate(
        (np.repeat(points[:1], half, 0), points, np.repeat(points[-1:], half, 0))
    )
    sums = np.cumsum(np.concatenate((np.zeros((1, 2)), padded)), axis=0)
    smooth = (sums[_SMOOTHING:] - sums[:-_SMOOTHING]) / _SMOOTHING
    smooth[[0, -1]] = points[[0, -1]]
    return np.asarray(smooth)


def _poses_along(legs: list[NDArray[np.float64]], step: float, turn: float) -> list[Pose2D]:
    """Poses that look along the path, ``step`` apart, turning by at most ``turn`` each."""
    poses: list[Pose2D] = []
    for leg in legs:
        along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(leg, axis=0).T))))
        at = np.arange(0.0, max(along[-1], 1.0e-9), step)
        x, y = np.interp(at, along, leg[:, 0]), np.interp(at, along, leg[:, 1])
        # The heading is that of a short piece of path ahead, as a robot steers.
        ahead = np.minimum(at + 0.3, along[-1])
        behind = ahead - 0.35
        u = np.interp(ahead, along, leg[:, 0]) - np.interp(behind, along, leg[:, 0])
        v = np.interp(ahead, along, leg[:, 1]) - np.interp(behind, along, leg[:, 1])
        for pose in map(Pose2D, x, y, np.arctan2(v, u)):
            if poses:
                poses.extend(_turns_between(poses[-1], pose, turn))
            poses.append(pose)
    return poses


def _turns_between(before: Pose2D, after: Pose2D, turn: float) -> Iterator[Pose2D]:
    """Poses of a turn on the spot, where the next heading is too far from this one."""
    angle = wrap_angle(after.theta - before.theta)
    parts = math.ceil(abs(angle) / turn)
    for part in range(1, parts):
        yield Pose2D(before.x, before.y, before.theta + angle * part / parts)


@kernel
def _cheapest_way(
    cost: NDArray[np.float64], row: int, column: int, goal_row: int, goal_column: int
) -> NDArray[np.int64]:
    """(N, 2) cells from start to goal by Dijkstra's algorithm; empty when there is no way."""
    rows, columns = cost.shape
    total = np.full((rows, columns), np.inf)
    parent = np.full((rows, columns), -1, dtype=np.int64)
    start, goal = row * columns + column, goal_row * columns + goal_column
    total[row, column] = 0.0
    queue = [(0.0, start)]
    while len(queue) > 0:
        so_far, cell = heappop(queue)
        i, j = cell // columns, cell % columns
        if cell == goal:
            break
        if so_far > total[i, j]:
            continue
        for di in range(-1, 2):
            for dj in range(-1, 2):
                k, m = i + di, j + dj
                if (di == 0 and dj == 0) or not (0 <= k < rows and 0 <= m < columns):
                    continue
                reached = so_far + math.hypot(di, dj) * cost[k, m]
                if reached < total[k, m]:
                    total[k, m] = reached
                    parent[k, m] = cell
                    heappush(queue, (reached, k * columns + m))
    length = 0
    cell = goal
    while cell >= 0 and np.isfinite(total[cell // columns, cell % columns]):
        length += 1
        cell = parent[cell // columns, cell % columns]
    way = np.empty((length, 2), dtype=np.int64)
    cell = goal
    for step in range(length - 1, -1, -1):
        way[step, 0], way[step, 1] = cell // columns, cell % columns
        cell = parent[cell // columns, cell % columns]
    return way
