"""Worlds of segments and circles with exact truth, and what can change in them.

A `World` is a plain value: walls, round pillars, doors that turn on a hinge, furniture and
people.  Distances to its surfaces are exact ray intersections.  Instead of testing every ray
against every surface, the ray caster computes which rays can meet a surface (rays are uniform
in angle) and intersects only those, so that the cost of a scan grows with what is in view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._jit import kernel
from .pose import Pose2D

__all__ = [
    "Door",
    "Furniture",
    "Seed",
    "World",
    "cast_rays",
    "move_furniture",
    "remove_walls",
    "scatter_people",
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


# --- Rays ------------------------------------------------------------------------------


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
