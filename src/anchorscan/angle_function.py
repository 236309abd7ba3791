"""Section 2: the angle function and the angle histogram.

The angle function gives the direction of the surface at every reading.  Hinkel and
Knieriemen take two readings a constant angle apart; the paper chooses the offset per
reading so that the two points lie at similar *metric* distance, and so do we: the pair
of reading *i* is the nearest reading on either side that lies half a ``baseline`` of way
along the surface away, or else the end of the surface; it never reaches across a gap.

Departures from the paper: readings are taken in counter-clockwise order and the angle
is kept modulo 360 degrees, as the direction in which the surface is *walked* with the
free space on the left; modulo 180 degrees it is the paper's angle.  With
``fitted=True`` the angle is that of the line fitted to all readings between the pair
instead of the chord, which lowers its noise at no cost (prefix sums).

The way between two readings is that of a chord over so many readings around them that it is
longer than the noise: the way of a zigzag would make near surfaces longer than far ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .scan import LaserScan

__all__ = [
    "AngleFunction",
    "AngleFunctionSettings",
    "angle_function",
    "angle_histogram",
    "main_angle",
]

# What lies between a return and the next one, counter-clockwise.
CONNECTED, TO_FAR, TO_NEAR, FREE, UNKNOWN = 0, 1, 2, 3, 4


class AngleFunctionSettings(BaseModel):
    """Settings of section 2."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    baseline: float = Field(0.4, gt=0.0, description="metric distance of a point pair, metres")
    fitted: bool = Field(False, description="fit a line through the readings between the pair")
    grazing_angle: float = Field(
        math.radians(10.0), gt=0.0, description="flattest incidence that still connects, radians"
    )
    noise: float = Field(0.05, ge=0.0, description="gap that noise alone can make, metres")
    largest_gap: float = Field(0.5, gt=0.0, description="no two readings connect across more")
    smallest_jump: float = Field(0.3, gt=0.0, description="range step that is a jump, metres")
    bins: int = Field(
        180, ge=8, le=3600, description="bins of the angle histogram over 180 degrees"
    )


@dataclass(frozen=True, eq=False)
class AngleFunction:
    """The returns of a scan in counter-clockwise order, with the surface at each.

    Args:
        points: (V, 2) metres, scan frame.
        ranges: (V,) metres.
        beams: (V,) direction of the ray, radians, ascending.
        gaps: (V,) what lies between this return and the next: ``CONNECTED``, ``TO_FAR``,
            ``TO_NEAR``, ``FREE`` or ``UNKNOWN``.  The last entry speaks of the first
            return only where the scan is a full turn.
        runs: (V,) index of the first return of the connected run that each belongs to.
        way: (V,) way along the surface since the first return, gaps left out, metres; where
            readings are nearer to each other than their noise, without the zigzag of that.
        surface: (V,) direction of the surface, radians in (-pi, pi]; NaN where a run is
            too short to tell.
        extents: (V,) length of surface that the return stands for, metres.
        moments: (V + 1, 5) running sums of x, y, xx, xy, yy, from which any stretch of
            returns has its fitted line in constant time.
        reach: Longest range that counts, metres.
    """

    points: NDArray[np.float64]
    ranges: NDArray[np.float64]
    beams: NDArray[np.float64]
    gaps: NDArray[np.int64]
    runs: NDArray[np.int64]
    way: NDArray[np.float64]
    surface: NDArray[np.float64]
    extents: NDArray[np.float64]
    moments: NDArray[np.float64]
    reach: float


def angle_function(scan: LaserScan, settings: AngleFunctionSettings) -> AngleFunction:
    """Compute the angle function of a scan (section 2).

    A scan of either sense of rotation and any field of view will do; the ends of a full
    turn are neighbours, and a second look at the same direction is dropped.
    """
    return AngleFunction(*_angle_function(scan.ranges, sweep(scan), surface_limits(settings)))


def sweep(scan: LaserScan) -> tuple[float, float, float, float, float, int]:
    """Return what kernels need to know of a scan.

    First direction, increment, shortest and longest return, ``range_max``, and the number of
    readings in a full turn where the sweep is closed, or else 0.
    """
    return (
        scan.angle_min,
        scan.angle_increment,
        scan.shortest_return,
        scan.longest_return,
        scan.range_max,
        round(2.0 * math.pi / abs(scan.angle_increment)) if scan.is_full_turn else 0,
    )


def surface_limits(
    settings: AngleFunctionSettings,
) -> tuple[tuple[float, float, float, float], float, bool]:
    """Return the settings that kernels need: what connects, the baseline, whether to fit."""
    gap = (
        settings.grazing_angle,
        settings.noise,
        settings.largest_gap,
        settings.smallest_jump,
    )
    return gap, settings.baseline, settings.fitted


def angle_histogram(angles: AngleFunction, settings: AngleFunctionSettings) -> NDArray[np.float64]:
    """Return the (bins,) angle histogram over [0, pi), smoothed by 1-2-1 (section 2).

    Every reading weighs as the length of surface that it stands for, not as one: so a
    wall counts by its size and not by its closeness to the sensor.
    """
    histogram: NDArray[np.float64] = _histogram(angles.surface, angles.extents, settings.bins)
    return histogram


def main_angle(histogram: NDArray[np.float64]) -> float:
    """Return the direction of the highest peak of an angle histogram, radians in [0, pi).

    The peak is refined by the parabola through its three bins; NaN without any weight.
    """
    count = len(histogram)
    peak = int(np.argmax(histogram))
    if histogram[peak] <= 0.0:
        return math.nan
    before, here, after = (float(histogram[(peak + k) % count]) for k in (-1, 0, 1))
    curvature = before - 2.0 * here + after
    shift = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
    return ((peak + 0.5 + shift) * math.pi / count) % math.pi


@kernel
def _angle_function(readings, sweep, settings):  # type: ignore[no-untyped-def]
    """All values of an ``AngleFunction``, in their order; see ``sweep`` and ``surface_limits``."""
    angle_min, increment, shortest, longest, range_max, turn = sweep
    limits, baseline, fitted = settings
    step = abs(increment)
    geometry = (angle_min, increment, shortest, longest)
    points, ranges, beams, indices, count = _returns(readings, geometry)
    free = _free_before(readings, range_max, increment, count)
    closed = max(count, turn) if turn > 0 else 0
    gaps = _gaps(ranges, indices, free, closed, step, limits)
    if turn > 0 and len(beams) > 0:
        points, ranges, beams, gaps = _begin_at_gap(points, ranges, beams, gaps)
    runs, way, extents, moments = _runs(points, ranges, gaps, step, limits[1])
    surface = _surface(points, runs, way, moments, baseline, fitted)
    return points, ranges, beams, gaps, runs, way, surface, extents, moments, range_max


@kernel
def _returns(ranges, geometry):  # type: ignore[no-untyped-def]
    """End points, ranges, directions and sweep positions of the returns, counter-clockwise."""
    angle_min, increment, range_min, range_max = geometry
    step = abs(increment)
    count = len(ranges)
    if count > 2:  # two never come to a second look
        count = min(count, int(math.floor(2.0 * math.pi / step + 0.5)))
    points = np.empty((count, 2))
    out = np.empty(count)
    beams = np.empty(count)
    indices = np.empty(count, np.int64)
    first = angle_min if increment > 0.0 else angle_min + increment * (count - 1)
    used = 0
    for k in range(count):
        r = np.float64(ranges[k if increment > 0.0 else count - 1 - k])
        if r >= range_min and r <= range_max and r > 0.0 and r < np.inf:
            beam = first + k * step
            points[used, 0] = r * math.cos(beam)
            points[used, 1] = r * math.sin(beam)
            out[used] = r
            beams[used] = beam
            indices[used] = k
            used += 1
    return points[:used], out[:used], beams[:used], indices[:used], count


@kernel
def _free_before(ranges, range_max, increment, count):  # type: ignore[no-untyped-def]
    """(count + 1,) number of free readings before each sweep position."""
    free = np.zeros(count + 1, np.int64)
    for k in range(count):
        r = ranges[k if increment > 0.0 else count - 1 - k]
        free[k + 1] = free[k] + (1 if r > range_max else 0)
    return free


@kernel
def _gap(near, far, cosine, spread, limits):  # type: ignore[no-untyped-def]
    """Tell whether two returns on neighbouring rays may lie on one surface.

    ``cosine`` is of the angle between the rays; ``spread`` is how far apart, per metre of
    range, they may be on a surface seen under the flattest incidence.
    """
    apart = near * near + far * far - 2.0 * near * far * cosine
    reach = min(near * spread + limits[1], max(limits[2], 2.0 * limits[1]))
    return apart <= reach * reach


@kernel
def _gaps(ranges, indices, free, turn, step, limits):  # type: ignore[no-untyped-def]
    """What lies between each return and the next.

    ``turn`` is the number of readings in a full turn where the sweep is closed, or else 0.
    """
    count = len(ranges)
    gaps = np.full(count, UNKNOWN, np.int64)
    most_missing = 3
    cosine = np.empty(most_missing + 2)
    spread = np.empty(most_missing + 2)
    for k in range(most_missing + 2):
        cosine[k] = math.cos(k * step)
        flattest = limits[0] - k * step
        spread[k] = math.sin(k * step) / math.sin(flattest) if flattest > 0.0 else np.inf
    for i in range(count):
        j = i + 1
        if j == count:
            if turn == 0 or count < 2:
                break
            j = 0
        between = indices[j] - indices[i]
        seen_free = free[indices[j]] - free[indices[i] + 1]
        if j == 0:
            between += turn
            seen_free = free[len(free) - 1] - free[indices[i] + 1] + free[indices[0]]
        missing = between - 1 - seen_free
        if seen_free > 0:
            gaps[i] = FREE if missing <= most_missing else UNKNOWN
            continue
        if missing > most_missing:
            continue
        near = min(ranges[i], ranges[j])
        far = max(ranges[i], ranges[j])
        if _gap(near, far, cosine[between], spread[between], limits):
            gaps[i] = CONNECTED
        elif far - near >= limits[3]:
            gaps[i] = TO_FAR if ranges[j] > ranges[i] else TO_NEAR
    return gaps


@kernel
def _begin_at_gap(points, ranges, beams, gaps):  # type: ignore[no-untyped-def]
    """Turn a closed sweep so that it begins behind a gap, or else on a straight stretch."""
    count = len(ranges)
    begin = -1
    for i in range(count):
        if gaps[i] != CONNECTED:
            begin = (i + 1) % count
            break
    if begin < 0:
        begin = 0
        straightest = np.inf
        offset = max(1, count // 90)
        for i in range(count):
            a = points[(i - offset) % count]
            b = points[(i + offset) % count]
            bend = math.hypot(a[0] + b[0] - 2.0 * points[i, 0], a[1] + b[1] - 2.0 * points[i, 1])
            if bend < straightest:
                straightest = bend
                begin = i
    order = (np.arange(count) + begin) % count
    turned = beams[order]
    for i in range(count - begin, count):
        turned[i] += 2.0 * math.pi
    return points[order], ranges[order], turned, gaps[order]


@kernel
def _runs(points, ranges, gaps, step, noise):  # type: ignore[no-untyped-def]
    """Connected runs, way along them, surface length per return, and running moments."""
    count = len(points)
    runs = np.zeros(count, np.int64)
    ends = np.full(count, count - 1)
    moments = np.zeros((count + 1, 5))
    for i in range(count):
        x, y = points[i, 0], points[i, 1]
        moments[i + 1, 0] = moments[i, 0] + x
        moments[i + 1, 1] = moments[i, 1] + y
        moments[i + 1, 2] = moments[i, 2] + x * x
        moments[i + 1, 3] = moments[i, 3] + x * y
        moments[i + 1, 4] = moments[i, 4] + y * y
        if i > 0:
            runs[i] = runs[i - 1] if gaps[i - 1] == CONNECTED else i
    for i in range(count - 2, -1, -1):
        ends[i] = ends[i + 1] if runs[i + 1] == runs[i] else i
    way = np.zeros(count)
    extents = np.zeros(count)
    for i in range(1, count):
        way[i] = way[i - 1]
        if runs[i] != runs[i - 1]:
            continue
        # Over so many readings that the way is longer than what noise adds to it.
        spread = noise / (min(ranges[i - 1], ranges[i]) * step)
        wide = int(math.ceil(0.5 * (min(spread, 1e6) - 1.0)))
        wide = max(min(wide, i - 1 - runs[i], ends[i] - i), 0)
        a, b = points[i - 1 - wide], points[i + wide]
        length = math.hypot(b[0] - a[0], b[1] - a[1]) / (2 * wide + 1)
        way[i] += length
        extents[i - 1] += 0.5 * length
        extents[i] += 0.5 * length
    return runs, way, extents, moments


@kernel
def wrapped(angle):  # type: ignore[no-untyped-def]
    """Wrap an angle into [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@kernel
def line_through(moments, first, last, dx, dy):  # type: ignore[no-untyped-def]
    """Total least squares line of returns ``first`` to ``last``, in the sense of (dx, dy).

    Returns its centre, its unit vector and its rms error.
    """
    n = last - first + 1.0
    cx = (moments[last + 1, 0] - moments[first, 0]) / n
    cy = (moments[last + 1, 1] - moments[first, 1]) / n
    xx = (moments[last + 1, 2] - moments[first, 2]) / n - cx * cx
    xy = (moments[last + 1, 3] - moments[first, 3]) / n - cx * cy
    yy = (moments[last + 1, 4] - moments[first, 4]) / n - cy * cy
    spread = math.sqrt((xx - yy) * (xx - yy) + 4.0 * xy * xy)
    error = math.sqrt(max(0.5 * (xx + yy - spread), 0.0))
    # The longer of the two forms of the eigenvector, which does not cancel.
    ux, uy = (xx - yy + spread, 2.0 * xy) if xx >= yy else (2.0 * xy, yy - xx + spread)
    length = math.sqrt(ux * ux + uy * uy)
    if length <= 0.0:
        return cx, cy, 1.0, 0.0, error
    if ux * dx + uy * dy < 0.0:
        length = -length
    return cx, cy, ux / length, uy / length, error


@kernel
def _surface(points, runs, way, moments, baseline, fitted):  # type: ignore[no-untyped-def]
    """Direction of the surface at every return over a near-constant metric baseline."""
    count = len(points)
    surface = np.full(count, np.nan)
    first = 0
    last = 0
    for i in range(count):
        first = max(first, runs[i])
        while way[i] - way[first] > 0.5 * baseline and first < i:
            first += 1
        # One more than half a baseline away, where the run goes on: pairs are never too short.
        begin = first - 1 if first > runs[i] else first
        last = max(last, i)
        while (
            last + 1 < count and runs[last + 1] == runs[i] and (way[last] - way[i] < 0.5 * baseline)
        ):
            last += 1
        dx = points[last, 0] - points[begin, 0]
        dy = points[last, 1] - points[begin, 1]
        if dx * dx + dy * dy < 0.0625 * baseline * baseline:
            continue
        if fitted and last - begin >= 2:
            _, _, dx, dy, _ = line_through(moments, begin, last, dx, dy)
        surface[i] = math.atan2(dy, dx)
    return surface


@kernel
def _histogram(surface, weights, bins):  # type: ignore[no-untyped-def]
    """Weighted histogram of directions modulo pi, smoothed by 1-2-1."""
    raw = np.zeros(bins)
    for i in range(len(surface)):
        if surface[i] == surface[i]:
            turn = surface[i] / math.pi
            raw[min(int((turn - math.floor(turn)) * bins), bins - 1)] += weights[i]
    smooth = np.empty(bins)
    for k in range(bins):
        smooth[k] = 0.25 * raw[k - 1] + 0.5 * raw[k] + 0.25 * raw[(k + 1) % bins]
    return smooth
