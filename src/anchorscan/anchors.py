"""Section 3: extraction of jump edge, angle and virtual edge anchor points.

An anchor point is a position that another scan of the same place finds again.

*Jump edge* anchors stand at the near surface's margin where the range jumps from near to
far.  At the visibility rim of a round object the ray grazes the surface; there the angle
between ray and surface is too small and no anchor is made.  (At a range r, with s radians
between rays, the last reading on a radius R is still seen under up to sqrt(2 r s / R); so
small or far pillars do get anchors.)  Nor is there an edge where a plain wall only seems to
end: along a corridor, where its readings come to lie too far apart to be joined, and at the
reach of the sensor.

*Angle* anchors stand where two surfaces meet: the surface angle changes within a segment.
The position is the intersection of the two lines fitted to either side, not the nearest
reading.  The surfaces part between two readings, so that no reading counts for both.

*Virtual edge* anchors combine the peaks of the x- and the y-histogram: the distributions
of the scan's points along the main angle and across it.  Every further peak of the angle
histogram gives its own pair of histograms (the paper's remark on its reference [12]).

Departures from the paper: an anchor also carries its kind and the direction of the free
space before it, and each histogram is kept apart for the two sides from which its wall can
be seen (``facing``); the ``paper`` preset switches the latter off and its matching ignores
both.  A wall adds to a histogram only where its surface runs across that axis, which keeps
the walls of the other direction from filling it evenly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .angle_function import (
    FREE,
    TO_FAR,
    TO_NEAR,
    AngleFunction,
    AngleFunctionSettings,
    angle_function,
    line_through,
    wrapped,
)
from .ranking import best_first
from .scan import LaserScan
from .segments import Segments, SegmentSettings, segments

__all__ = [
    "AnchorKind",
    "AnchorPoints",
    "AnchorSettings",
    "AnchorStack",
    "VirtualEdges",
    "anchor_points",
    "angle_anchors",
    "in_other_frame",
    "jump_edge_anchors",
    "stack_anchors",
    "virtual_edges",
]

# Main angles of one scan are at least so far apart, radians.
_MAINS_APART = math.radians(15.0)
# A main angle that might as well be the first one is at least so far from it, and at least such a
# share of it: a room that is not quite a rectangle is seen in one frame from here, in another
# from there.
_OTHER_APART, _OTHER_SHARE = math.radians(7.0), 0.5
# Walls farther than this, metres, are no part of the place.
_FARTHEST_WALL = 500.0


class AnchorKind(IntEnum):
    """What an anchor point is; left and right as seen from the sensor."""

    JUMP_EDGE_LEFT = 0
    JUMP_EDGE_RIGHT = 1
    CONVEX_ANGLE = 2
    CONCAVE_ANGLE = 3
    VIRTUAL_EDGE = 4


class AnchorSettings(BaseModel):
    """Settings of sections 2 and 3, from scan to anchor points."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    finest_increment: float = Field(
        math.radians(0.5),
        ge=0.0,
        description="readings closer to each other are left out, radians; 0 takes all",
    )
    angle_function: AngleFunctionSettings = AngleFunctionSettings()
    segments: SegmentSettings = SegmentSettings()
    smallest_rim_angle: float = Field(
        math.radians(20.0), ge=0.0, description="ray to surface at a jump edge, radians"
    )
    smallest_turn: float = Field(
        math.radians(40.0), gt=0.0, description="change of surface angle at an anchor, radians"
    )
    arm: float = Field(0.4, gt=0.0, description="way along each surface that its line is fitted to")
    shortest_arm: float = Field(0.2, gt=0.0, description="shortest such way, metres")
    flatness: float = Field(0.04, gt=0.0, description="largest rms error of such a line, metres")
    farthest_corner: float = Field(
        0.2, gt=0.0, description="intersection to the readings on either side, metres"
    )
    histogram_bin: float = Field(0.1, ge=0.01, description="bin of the x- and y-histograms, metres")
    smallest_wall: float = Field(0.8, gt=0.0, description="surface that makes a peak, metres")
    most_walls: int = Field(4, ge=0, description="peaks taken of each histogram")
    facing: bool = Field(False, description="tell the two sides of a wall apart")
    wall_angle: float = Field(math.radians(15.0), gt=0.0, description="surface to axis, radians")
    most_main_angles: int = Field(2, ge=1, description="main angles that give histograms")
    smallest_main_share: float = Field(
        0.3, gt=0.0, le=1.0, description="weight of a further main angle, share of the first"
    )


@dataclass(frozen=True, eq=False)
class AnchorPoints:
    """The anchor points of one scan.

    Args:
        positions: (A, 2) metres, scan frame.
        kinds: (A,) of ``AnchorKind``.
        directions: (A,) direction of the free space before the anchor, radians.
        main_angle: Direction of the main walls, radians modulo 90 degrees, scan frame; NaN
            where no surface tells.
    """

    positions: NDArray[np.float64]
    kinds: NDArray[np.int64]
    directions: NDArray[np.float64]
    main_angle: float = math.nan

    def __len__(self) -> int:
        return len(self.kinds)


@dataclass(frozen=True, eq=False)
class AnchorStack:
    """The anchor points of several scans one behind the other.

    Args:
        positions: (A, 2) metres, each in the frame of its own scan.
        kinds: (A,) as in ``AnchorPoints``.
        directions: (A,) radians.
        main_angles: (C,) of each scan.
        starts: (C + 1,) where the anchor points of each scan begin.
    """

    positions: NDArray[np.float64]
    kinds: NDArray[np.int64]
    directions: NDArray[np.float64]
    main_angles: NDArray[np.float64]
    starts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.main_angles)

    def of(self, scan: int) -> AnchorPoints:
        """Return the anchor points of one scan."""
        own = slice(self.starts[scan], self.starts[scan + 1])
        return AnchorPoints(
            self.positions[own],
            self.kinds[own],
            self.directions[own],
            float(self.main_angles[scan]),
        )

    def of_some(self, scans: NDArray[np.int64]) -> AnchorStack:
        """Return the anchor points of some scans, in the order of their numbers given."""
        sizes = np.diff(self.starts)[scans]
        starts = np.zeros(len(scans) + 1, np.int64)
        np.cumsum(sizes, out=starts[1:])
        at = np.arange(starts[-1]) + np.repeat(self.starts[scans] - starts[:-1], sizes)
        return AnchorStack(
            self.positions[at], self.kinds[at], self.directions[at], self.main_angles[scans], starts
        )

    def followed_by(self, others: AnchorStack) -> AnchorStack:
        """Put the anchor points of others behind these."""
        return AnchorStack(
            np.concatenate([self.positions, others.positions]),
            np.concatenate([self.kinds, others.kinds]),
            np.concatenate([self.directions, others.directions]),
            np.concatenate([self.main_angles, others.main_angles]),
            np.concatenate([self.starts, self.starts[-1] + others.starts[1:]]),
        )


def stack_anchors(scans: Sequence[AnchorPoints]) -> AnchorStack:
    """Put the anchor points of scans one behind the other; none at all gives an empty stack."""
    return AnchorStack(
        np.concatenate([np.empty((0, 2)), *(each.positions for each in scans)]),
        np.concatenate([np.empty(0, np.int64), *(each.kinds for each in scans)]),
        np.concatenate([np.empty(0), *(each.directions for each in scans)]),
        np.array([each.main_angle for each in scans], np.float64),
        np.cumsum([0, *(len(each) for each in scans)], dtype=np.int64),
    )


@dataclass(frozen=True, eq=False)
class VirtualEdges:
    """The walls behind the virtual edges of one main angle.

    Args:
        main_angle: Direction of the x axis of the wall frame, radians, scan frame.
        histograms: (2, 2, B) length of surface per bin of x and of y; the second index is
            the side that is seen (towards plus, towards minus; 0 for both if not told apart).
        origin: Coordinate of the first bin's lower border, metres.
        bin_width: Width of a bin, metres.
        x_walls: (X, 3) coordinate (metres), side (+1, -1 or 0) and length of surface.
        y_walls: (Y, 3) the same across.
    """

    main_angle: float
    histograms: NDArray[np.float64]
    origin: float
    bin_width: float
    x_walls: NDArray[np.float64]
    y_walls: NDArray[np.float64]


def anchor_points(scan: LaserScan, settings: AnchorSettings) -> AnchorPoints:
    """Extract all anchor points of a scan (section 3)."""
    angles = angle_function(scan, settings.angle_function)
    surfaces = segments(angles, settings.segments)
    edges = virtual_edges(angles, settings)
    return gather(
        jump_edge_anchors(angles, surfaces, settings),
        angle_anchors(angles, surfaces, settings),
        edges,
    )


def gather(
    jumps: NDArray[np.float64], turns: NDArray[np.float64], edges: list[VirtualEdges]
) -> AnchorPoints:
    """Put the rows of all three extractions together."""
    rows = np.concatenate(
        [jumps, turns, *(_crossings(e.main_angle, e.x_walls, e.y_walls) for e in edges)]
    )
    positions, kinds, directions = _columns(rows)
    main_angle = edges[0].main_angle if edges else math.nan
    return AnchorPoints(positions, kinds, directions, main_angle)


def jump_edge_anchors(
    angles: AngleFunction, surfaces: Segments, settings: AnchorSettings
) -> NDArray[np.float64]:
    """Find the jump edge anchors: (J, 4) rows x, y, direction of free space, kind."""
    rows: NDArray[np.float64] = _jump_edges(
        angles.points,
        angles.gaps,
        angles.way,
        angles.surface,
        angles.moments,
        (surfaces.first, surfaces.last),
        anchor_limits(settings)[0],
        angles.reach,
    )
    return rows


def angle_anchors(
    angles: AngleFunction, surfaces: Segments, settings: AnchorSettings
) -> NDArray[np.float64]:
    """Find the angle anchors: (C, 4) rows x, y, direction of free space, kind."""
    rows: NDArray[np.float64] = _angle_anchors(
        angles.points,
        angles.way,
        angles.moments,
        (surfaces.first, surfaces.last),
        anchor_limits(settings)[1],
    )
    return rows


def virtual_edges(angles: AngleFunction, settings: AnchorSettings) -> list[VirtualEdges]:
    """Find the walls whose crossings are virtual edge anchors, one value per main angle."""
    found = []
    _, _, main_limits, wall_limits = anchor_limits(settings)
    for main in _main_angles(angles.surface, angles.extents, main_limits):
        histograms, origin, x_walls, y_walls = _virtual_edges(
            angles.points, angles.surface, angles.extents, main, wall_limits
        )
        found.append(
            VirtualEdges(float(main), histograms, origin, settings.histogram_bin, x_walls, y_walls)
        )
    return found


def in_other_frame(
    angles: AngleFunction, anchors: AnchorPoints, settings: AnchorSettings
) -> AnchorPoints | None:
    """Give the anchor points for a second main angle that is about as strong as the first.

    Args:
        angles: Of the scan.
        anchors: Of the scan.
        settings: Of the anchor points.

    Returns:
        The jump edges and angles as they are, and virtual edges of the second main angle; None
        where there is no such angle.
    """
    limits = (settings.angle_function.bins, 2, _OTHER_SHARE, _OTHER_APART)
    mains = _main_angles(angles.surface, angles.extents, limits)
    if len(mains) < 2:
        return None
    main, walls = float(mains[1]), anchor_limits(settings)[3]
    _, _, x, y = _virtual_edges(angles.points, angles.surface, angles.extents, main, walls)
    positions, kinds, directions = _columns(_crossings(main, x, y))
    kept = anchors.kinds != AnchorKind.VIRTUAL_EDGE
    return AnchorPoints(
        np.concatenate([anchors.positions[kept], positions]),
        np.concatenate([anchors.kinds[kept], kinds]),
        np.concatenate([anchors.directions[kept], directions]),
        main,
    )


def anchor_limits(settings: AnchorSettings) -> tuple[tuple[Any, ...], ...]:
    """Return the settings that kernels need: of jump edges, angles, main angles and walls."""
    arm = (settings.arm, settings.shortest_arm, settings.flatness)
    return (
        (*arm, settings.smallest_rim_angle),
        (*arm, settings.smallest_turn, settings.farthest_corner),
        (
            settings.angle_function.bins,
            settings.most_main_angles,
            settings.smallest_main_share,
            _MAINS_APART,
        ),
        (
            settings.histogram_bin,
            settings.smallest_wall,
            settings.most_walls,
            settings.wall_angle,
            settings.facing,
        ),
    )


@kernel
def all_anchors(angles, surfaces, limits):  # type: ignore[no-untyped-def]
    """Do what ``gather`` does in one go: positions, kinds, directions, and the main angle.

    ``angles`` are the values of an ``AngleFunction``, ``surfaces`` those of ``Segments``.
    """
    points, _, _, gaps, _, way, surface, extents, moments, reach = angles
    rows = np.concatenate(
        (
            _jump_edges(points, gaps, way, surface, moments, surfaces, limits[0], reach),
            _angle_anchors(points, way, moments, surfaces, limits[1]),
        )
    )
    mains = _main_angles(surface, extents, limits[2])
    for main in mains:
        _, _, x_walls, y_walls = _virtual_edges(points, surface, extents, main, limits[3])
        rows = np.concatenate((rows, _crossings(main, x_walls, y_walls)))
    positions, kinds, directions = _columns(rows)
    return positions, kinds, directions, mains[0] if len(mains) > 0 else np.nan


@kernel
def _jump_edges(points, gaps, way, surface, moments, surfaces, limits, reach):  # type: ignore[no-untyped-def]
    """Margins of large surfaces behind which the range jumps to far."""
    arm, shortest, flatness, rim = limits
    first, last = surfaces
    rows = np.empty((2 * len(first), 4))
    found = 0
    for s in range(len(first)):
        a, b = first[s], last[s]
        for side in range(2):
            at, out = (b, 1) if side == 0 else (a, -1)
            gap = gaps[b] if side == 0 else gaps[a - 1]
            near = TO_FAR if side == 0 else TO_NEAR
            if gap not in (near, FREE):
                continue
            other = at
            while other != (a if side == 0 else b) and abs(way[other] - way[at]) < arm:
                other -= out
            if abs(way[other] - way[at]) < shortest:
                continue
            begin, end = min(at, other), max(at, other)
            dx, dy = points[end, 0] - points[begin, 0], points[end, 1] - points[begin, 1]
            _, _, ux, uy, error = line_through(moments, begin, end, dx, dy)
            if error > flatness:
                continue
            # The surface right at the margin: the line bends with a round object's.
            ex, ey = math.cos(surface[at]), math.sin(surface[at])
            x, y = points[at, 0], points[at, 1]
            if not abs(ex * y - ey * x) >= math.sin(rim) * math.hypot(x, y):
                continue
            # A surface that goes on beyond the reach, or behind readings too far apart to be
            # joined, has no edge there.
            if gap == FREE:
                step = 2.0 * abs(ux * (x - points[at - out, 0]) + uy * (y - points[at - out, 1]))
                if math.hypot(x + out * step * ux, y + out * step * uy) > reach:
                    continue
            else:
                behind = (at + out) % len(points)
                across = ux * (points[behind, 1] - y) - uy * (points[behind, 0] - x)
                if abs(across) <= flatness:
                    continue
            rows[found, 0] = x
            rows[found, 1] = y
            rows[found, 2] = math.atan2(ux, -uy)
            rows[found, 3] = side
            found += 1
    return rows[:found]


@kernel
def _distance_to_chord(x, y, a, b):  # type: ignore[no-untyped-def]
    """Distance from a position to the straight line from ``a`` to ``b``, metres."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    square = dx * dx + dy * dy
    along = ((x - a[0]) * dx + (y - a[1]) * dy) / square if square > 0.0 else 0.0
    along = min(max(along, 0.0), 1.0)
    return math.hypot(x - a[0] - along * dx, y - a[1] - along * dy)


@kernel
def _angle_anchors(points, way, moments, surfaces, limits):  # type: ignore[no-untyped-def]
    """Places within large surfaces where the surface angle changes.

    Every place between two readings may be one; the lines of the surfaces before and behind it
    are fitted to the readings up to the one and from the other on.
    """
    arm, shortest, flatness, smallest_turn, farthest = limits
    first, last = surfaces
    straightest, sharpest = math.cos(smallest_turn), math.cos(0.95 * math.pi)
    rows = np.empty((len(points), 4))
    strength = np.empty(len(points))
    found = 0
    for s in range(len(first)):
        begin = first[s]
        end = begin
        previous = found
        for i in range(first[s], last[s]):
            j = i + 1
            while way[i] - way[begin + 1] >= arm:
                begin += 1
            end = max(end, j)
            while end < last[s] and way[end] - way[j] < arm:
                end += 1
            if way[i] - way[begin] < shortest or way[end] - way[j] < shortest:
                continue
            if end - j < 2 or i - begin < 2:
                continue
            ax, ay, au, av, before = line_through(
                moments, begin, i, points[i, 0] - points[begin, 0], points[i, 1] - points[begin, 1]
            )
            if before > flatness:
                continue
            bx, by, bu, bv, after = line_through(
                moments, j, end, points[end, 0] - points[j, 0], points[end, 1] - points[j, 1]
            )
            dot = au * bu + av * bv
            if after > flatness or dot > straightest or dot < sharpest:
                continue
            cross = au * bv - av * bu
            along = ((bx - ax) * bv - (by - ay) * bu) / cross
            x, y = ax + along * au, ay + along * av
            off = _distance_to_chord(x, y, points[i], points[j])
            if off > farthest:
                continue
            turn = math.atan2(cross, dot)
            quality = abs(turn) / smallest_turn - off / farthest - (before + after) / flatness
            if (
                found > previous
                and math.hypot(rows[found - 1, 0] - x, rows[found - 1, 1] - y) < arm
            ):
                if quality <= strength[found - 1]:
                    continue
                found -= 1
            rows[found, 0] = x
            rows[found, 1] = y
            rows[found, 2] = wrapped(math.atan2(av, au) + 0.5 * (turn + math.pi))
            rows[found, 3] = 3.0 if turn > 0.0 else 2.0
            strength[found] = quality
            found += 1
    return rows[:found]


@kernel
def _main_angles(surface, weights, limits):  # type: ignore[no-untyped-def]
    """Main angles modulo 90 degrees, strongest first, each the mean direction at its peak."""
    bins, most, share, apart = limits
    half = bins // 2
    raw = np.zeros(half)
    quarter = 0.5 * math.pi
    for i in range(len(surface)):
        if surface[i] == surface[i]:
            turn = surface[i] / quarter
            raw[min(int((turn - math.floor(turn)) * half), half - 1)] += weights[i]
    smooth = np.empty(half)
    for k in range(half):
        total = 0.0
        for j in range(-3, 4):
            total += (4 - abs(j)) * raw[(k + j) % half]
        smooth[k] = total
    angles = np.empty(most)
    found = 0
    strongest = smooth.max() if half > 0 else 0.0
    width = math.radians(6.0)
    while found < most:
        peak = np.argmax(smooth)
        if smooth[peak] <= 0.0 or smooth[peak] < share * strongest:
            break
        centre = (peak + 0.5) * quarter / half
        c, s = 0.0, 0.0
        for i in range(len(surface)):
            if surface[i] == surface[i]:
                off = surface[i] - centre
                off -= quarter * math.floor(off / quarter + 0.5)
                if abs(off) < width:
                    c += weights[i]
                    s += weights[i] * off
        angles[found] = centre + (s / c if c > 0.0 else 0.0)
        found += 1
        reach = int(math.ceil(apart / quarter * half))
        for j in range(-reach, reach + 1):
            smooth[(peak + j) % half] = 0.0
    return angles[:found]


@kernel
def _virtual_edges(points, surface, weights, main, limits):  # type: ignore[no-untyped-def]
    """Histograms of one main angle, where they begin, and the walls over x and over y."""
    width, smallest, most, wall_angle, facing = limits
    histograms, origin = _wall_histograms(points, surface, weights, main, width, wall_angle, facing)
    peaks = (origin, width, smallest, most)
    x_walls = _walls(histograms[0], peaks, facing)
    return histograms, origin, x_walls, _walls(histograms[1], peaks, facing)


@kernel
def _makes_wall(point, surface):  # type: ignore[no-untyped-def]
    """Whether a return shows a surface, and one that is not farther than any building's."""
    return not math.isnan(surface) and max(abs(point[0]), abs(point[1])) < _FARTHEST_WALL


@kernel
def _wall_histograms(points, surface, weights, main, width, wall_angle, facing):  # type: ignore[no-untyped-def]
    """Length of surface over x and over y of the wall frame, per side that is seen."""
    c, s = math.cos(main), math.sin(main)
    low, high = 0.0, 0.0
    for i in range(len(points)):
        if _makes_wall(points[i], surface[i]):
            x = c * points[i, 0] + s * points[i, 1]
            y = c * points[i, 1] - s * points[i, 0]
            low = min(low, x, y)
            high = max(high, x, y)
    origin = (math.floor(low / width) - 2.0) * width
    bins = int(math.ceil((high - origin) / width)) + 3
    histograms = np.zeros((2, 2, bins))
    near = math.cos(wall_angle)
    for i in range(len(points)):
        if not _makes_wall(points[i], surface[i]):
            continue
        # The free space lies on the left of the way along the surface.
        normal = surface[i] + 0.5 * math.pi - main
        cn, sn = math.cos(normal), math.sin(normal)
        if abs(cn) >= near:
            axis, side = 0, 0 if cn > 0.0 else 1
            u = c * points[i, 0] + s * points[i, 1]
        elif abs(sn) >= near:
            axis, side = 1, 0 if sn > 0.0 else 1
            u = c * points[i, 1] - s * points[i, 0]
        else:
            continue
        # Shared between the two nearest bins, so that a wall between them is one peak.
        at = (u - origin) / width - 0.5
        k = int(math.floor(at))
        side = side if facing else 0
        histograms[axis, side, k] += weights[i] * (1.0 - (at - k))
        histograms[axis, side, k + 1] += weights[i] * (at - k)
    return histograms, origin


@kernel
def _walls(histograms, limits, facing):  # type: ignore[no-untyped-def]
    """Peaks of the histograms of one axis: rows coordinate, side, length; longest first."""
    origin, width, smallest, most = limits
    bins = histograms.shape[1]
    rows = np.empty((2 * bins, 3))
    found = 0
    for side in range(2 if facing else 1):
        h = histograms[side]
        for k in range(1, bins - 1):
            total = h[k - 1] + h[k] + h[k + 1]
            if total < smallest or h[k] < h[k - 1] or h[k] <= h[k + 1]:
                continue
            shift = (h[k + 1] - h[k - 1]) / total
            rows[found, 0] = origin + (k + 0.5 + shift) * width
            rows[found, 1] = (1.0 - 2.0 * side) if facing else 0.0
            rows[found, 2] = total
            found += 1
    return rows[best_first(rows[:found, 2], most)]


@kernel
def _crossings(main, x_walls, y_walls):  # type: ignore[no-untyped-def]
    """Virtual edge anchors: every x wall with every y wall."""
    c, s = math.cos(main), math.sin(main)
    rows = np.empty((len(x_walls) * len(y_walls), 4))
    found = 0
    for i in range(len(x_walls)):
        for j in range(len(y_walls)):
            x, y = x_walls[i, 0], y_walls[j, 0]
            rows[found, 0] = c * x - s * y
            rows[found, 1] = s * x + c * y
            rows[found, 2] = wrapped(main + math.atan2(y_walls[j, 1], x_walls[i, 1]))
            rows[found, 3] = 4.0
            found += 1
    return rows


@kernel
def _columns(rows):  # type: ignore[no-untyped-def]
    """Positions, kinds and directions of anchors in rows x, y, direction, kind."""
    positions = np.empty((len(rows), 2))
    kinds = np.empty(len(rows), np.int64)
    directions = np.empty(len(rows))
    for k in range(len(rows)):
        positions[k, 0], positions[k, 1] = rows[k, 0], rows[k, 1]
        directions[k], kinds[k] = rows[k, 2], int(rows[k, 3])
    return positions, kinds, directions
