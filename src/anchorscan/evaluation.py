"""Section 5: synthetic scans and the evaluation e_m.

Two scans of one place, taken from different poses, cannot be compared reading by reading.
So it is checked first which of them contains the other's sensing position and therefore has
the better *overview*: the position must lie in its field of view, nearer than what it sees
there.  From the overview's points a *synthetic scan* is computed for the pose of the other,
the *front scan*: neighbouring readings of one surface are joined by a straight line, and of
all that lies in the direction of a beam the nearest counts.  Then

    e_m = (readings of front and synthetic scan that differ by at most a tolerance)
          / (readings of the front scan),

where a reading of the front scan is a return; those without one say nothing of a distance.

The paper does not say what to do when both or neither of the positions are visible.  If both
are, the one with more free way behind the other's position has the better overview; if
neither is, the one that faces the other's position more.  At equal claims it is the reference.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import inlined, kernel
from .angle_function import (
    CONNECTED,
    FREE,
    AngleFunction,
    AngleFunctionSettings,
    angle_function,
    sweep,
)
from .pose import Pose2D
from .scan import LaserScan

__all__ = [
    "AcceptanceSettings",
    "Evaluation",
    "EvaluationSettings",
    "Outline",
    "OutlineStack",
    "clearance",
    "evaluate",
    "evaluate_all",
    "outline",
    "probability",
    "stack_outlines",
    "synthetic_scan",
]

# Columns of the rows of an outline.
_X, _Y, _RANGE, _BEAM, _GAP = range(5)
_FULL_TURN = 2.0 * math.pi
# A beam that misses the end of a line by less than this share of a step still meets it.
_SLACK = 1e-6
# Coefficients of the arc tangent over its argument t by powers of t squared, the highest first:
# interpolated at Chebyshev's points for t up to the tangent of an eighth of pi.
_STEEP, _TINY = math.tan(math.pi / 8.0), 1e-300
_ARC = (
    -0.025345761550124298,
    0.05030301131043306,
    -0.06508962196078676,
    0.07674293552076389,
    -0.09089635821705612,
    0.11111057303795945,
    -0.14285713038303977,
    0.19999999986904501,
    -0.3333333333329765,
    1.0000000000000002,
)
# So near its own position, metres, a scan sees every position.
_HERE = 0.1


class EvaluationSettings(BaseModel):
    """Settings of the evaluation of section 5."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    tolerance: float = Field(0.05, gt=0.0, description="readings that differ no more agree, metres")
    relative_tolerance: float = Field(
        0.05, ge=0.0, description="what is added to that for every metre of range"
    )
    largest_tolerance: float = Field(
        0.2, gt=0.0, description="readings that differ more never agree, metres"
    )


class AcceptanceSettings(BaseModel):
    """What an evaluation is worth: the probability of a hypothesis and the decision.

    The paper answers where e_m reaches a threshold and is silent elsewhere.  Threshold and
    curve were fitted to the ``paper`` preset: the threshold with five candidates, so that
    freiburg-079 has no wrong answer under P1 and P2 and scans of csail and Killian Court next
    to none in it (P4); the curve on freiburg-079 and csail under P1 and P2 with 1, 5 and all.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    threshold: float = Field(0.7, ge=0.0, le=1.0, description="smallest e_m that is accepted")
    even: float = Field(0.5, description="e_m at which a hypothesis is as likely right as wrong")
    hypotheses: int = Field(5, ge=1, description="most hypotheses in an answer")
    slope: float = Field(10.0, gt=0.0, description="growth of the log odds with e_m")


@dataclass(frozen=True, eq=False)
class Outline:
    """What a scan saw, ready to be looked at from elsewhere.

    Args:
        rows: (V, 5) of every return, counter-clockwise: x, y and range (metres, scan frame),
            direction of the beam (radians, ascending), and what follows before the next
            return (as ``AngleFunction.gaps``; the last row is followed by the first).
        geometry: (4,) direction of the first beam, angle between beams (both radians,
            counter-clockwise), number of beams, and 1 for a full turn.
    """

    rows: NDArray[np.float64]
    geometry: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class OutlineStack:
    """Several outlines one behind the other.

    Args:
        rows: (V, 5) as in ``Outline``.
        starts: (C + 1,) where each outline begins.
        geometries: (C, 4) as in ``Outline``.
    """

    rows: NDArray[np.float64]
    starts: NDArray[np.int64]
    geometries: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """How well a scan and a reference agree in one alignment.

    Args:
        e_m: Share of the front scan's readings that agree, in [0, 1].
        overview: Whether the ``"reference"`` or the ``"scan"`` has the better overview.
        synthetic: The synthetic scan at the pose and with the beams of the front scan; NaN
            where the overview saw nothing.
    """

    e_m: float
    overview: str
    synthetic: LaserScan


def outline(scan: LaserScan, angles: AngleFunction) -> Outline:
    """Prepare a scan for the evaluation.

    Args:
        scan: The scan.
        angles: Its angle function, which knows what belongs to one surface.
    """
    seen = (angles.points, angles.ranges, angles.beams, angles.gaps)
    return Outline(*_outline(seen, len(scan), sweep(scan)))


def stack_outlines(outlines: Sequence[Outline]) -> OutlineStack:
    """Put outlines one behind the other; none at all gives an empty stack."""
    if not outlines:
        return OutlineStack(_NO_ROWS, np.zeros(1, np.int64), np.empty((0, 4)))
    rows = [each.rows for each in outlines]
    return OutlineStack(
        np.concatenate(rows),
        np.array([0, *accumulate(map(len, rows))], np.int64),
        np.concatenate([each.geometry for each in outlines]).reshape(-1, 4),
    )


def clearance(overview: Outline, x: float, y: float) -> float:
    """Tell how far a scan saw beyond a position; positive where it contains the position.

    Args:
        overview: The scan.
        x: Of the position, metres, scan frame.
        y: The same across.

    Returns:
        Range seen in the direction of the position minus its distance, metres; infinite
        where nothing is in the way, minus infinite where the scan knows nothing.
    """
    return float(_clearance(overview.rows, overview.geometry, x, y))


def evaluate_all(
    scan: Outline,
    references: OutlineStack,
    candidates: NDArray[np.int64],
    poses: NDArray[np.float64],
    settings: EvaluationSettings,
) -> NDArray[np.float64]:
    """Compute e_m of many alignments of one scan (section 5).

    Args:
        scan: The scan.
        references: The candidate references.
        candidates: (N,) which reference each alignment is with.
        poses: (N, 3) ``T_reference_scan`` as x, y, theta, metres and radians.
        settings: Of the evaluation.

    Returns:
        (N,) e_m.
    """
    e_m: NDArray[np.float64] = _evaluations(
        scan.rows,
        scan.geometry,
        references.rows,
        references.starts,
        references.geometries,
        candidates,
        poses,
        tolerances(settings),
    )
    return e_m


def tolerances(settings: EvaluationSettings) -> tuple[float, float, float]:
    """Return the settings that kernels need: how much readings that agree may differ."""
    return settings.tolerance, settings.relative_tolerance, settings.largest_tolerance


def evaluate(
    scan: LaserScan,
    reference: LaserScan,
    T_reference_scan: Pose2D,
    settings: EvaluationSettings | None = None,
    surfaces: AngleFunctionSettings | None = None,
) -> Evaluation:
    """Evaluate one alignment and keep the synthetic scan (section 5).

    Args:
        scan: The scan.
        reference: The reference scan.
        T_reference_scan: The alignment.
        settings: Of the evaluation; the defaults if None.
        surfaces: Of the angle function, which tells what readings are joined.
    """
    settings = settings or EvaluationSettings()
    surfaces = surfaces or AngleFunctionSettings()
    ours = outline(scan, angle_function(scan, surfaces))
    theirs = outline(reference, angle_function(reference, surfaces))
    pose = T_reference_scan.to_array()
    e_m = evaluate_all(
        ours, stack_outlines([theirs]), np.zeros(1, np.int64), pose[np.newaxis], settings
    )
    if _reference_has_overview(ours.rows, ours.geometry, theirs.rows, theirs.geometry, pose):
        synthetic = synthetic_scan(reference, T_reference_scan, scan, surfaces)
        return Evaluation(float(e_m[0]), "reference", synthetic)
    synthetic = synthetic_scan(scan, T_reference_scan.inverse(), reference, surfaces)
    return Evaluation(float(e_m[0]), "scan", synthetic)


def probability(e_m: float, settings: AcceptanceSettings) -> float:
    """Turn an evaluation into the probability of being right, by a logistic curve."""
    return 0.5 * (1.0 + math.tanh(0.5 * settings.slope * (e_m - settings.even)))


def synthetic_scan(
    overview: LaserScan,
    T_overview_front: Pose2D,
    front: LaserScan,
    surfaces: AngleFunctionSettings | None = None,
) -> LaserScan:
    """Compute what the front scan's sensor would have seen of the overview's surfaces.

    Args:
        overview: The scan whose points are used.
        T_overview_front: Pose of the front scan's sensor in the overview's frame.
        front: Gives the beams and the limits.
        surfaces: Of the angle function, which tells what readings are joined.

    Returns:
        A scan with the beams of ``front``; NaN where the overview saw nothing.
    """
    angles = angle_function(overview, surfaces or AngleFunctionSettings())
    # The front needs only its beams here: its geometry, not what it saw.
    geometry = outline(front, angle_function(front, AngleFunctionSettings())).geometry
    inverse = np.zeros(int(geometry[2]))
    rows = outline(overview, angles).rows
    _render(rows, T_overview_front.inverse().to_array(), geometry, inverse)
    with np.errstate(divide="ignore"):
        seen = np.where(inverse > 0.0, 1.0 / inverse, np.nan)
    ranges = np.full(len(front), np.nan)
    ranges[: len(seen)] = seen if front.angle_increment >= 0.0 else seen[::-1]
    return LaserScan(
        ranges, front.angle_min, front.angle_increment, front.range_min, front.range_max
    )


_NO_ROWS = np.empty((0, 5))


@kernel
def _outline(seen, readings, sweep):  # type: ignore[no-untyped-def]
    """Rows and geometry of the outline of a scan of so many readings."""
    points, ranges, beams, gaps = seen
    step = abs(sweep[1]) if sweep[1] != 0.0 else 1.0
    count = max(min(readings, int(_FULL_TURN / step + 0.5)), 1)
    first = sweep[0] + min(sweep[1], 0.0) * (count - 1)
    geometry = np.array([first, step, float(count), 1.0 if sweep[5] > 0 else 0.0])
    rows = np.empty((len(ranges), 5))
    for i in range(len(ranges)):
        rows[i, _X], rows[i, _Y] = points[i, 0], points[i, 1]
        rows[i, _RANGE], rows[i, _BEAM], rows[i, _GAP] = ranges[i], beams[i], gaps[i]
    return rows, geometry


@kernel
def _positive(angle):  # type: ignore[no-untyped-def]
    """Wrap an angle into [0, 2 pi)."""
    return angle - _FULL_TURN * math.floor(angle / _FULL_TURN)


@kernel
def _clearance(rows, geometry, x, y):  # type: ignore[no-untyped-def]
    """Range seen towards a position minus its distance; see ``clearance``."""
    count = len(rows)
    distance = math.sqrt(x * x + y * y)
    if distance <= _HERE:
        return np.inf
    if count == 0:
        return -np.inf
    step = geometry[1]
    offset = _positive(math.atan2(y, x) - rows[0, _BEAM])
    low, high = 0, count
    while high - low > 1:
        middle = (low + high) // 2
        if rows[middle, _BEAM] - rows[0, _BEAM] <= offset:
            low = middle
        else:
            high = middle
    after = low + 1 if low + 1 < count else 0
    begin = rows[low, _BEAM] - rows[0, _BEAM]
    end = rows[after, _BEAM] - rows[0, _BEAM] if after > 0 else _FULL_TURN
    share = (offset - begin) / max(end - begin, _SLACK)
    near, far = rows[low, _RANGE], rows[after, _RANGE]
    gap = rows[low, _GAP]
    if gap == CONNECTED:
        return 1.0 / ((1.0 - share) / near + share / far) - distance
    if gap == FREE:
        return np.inf
    # Between two surfaces, or at the rim of the field of view, the nearest beam answers.
    if min(offset - begin, end - offset) > step:
        return -np.inf
    return (near if share < 0.5 else far) - distance


@kernel
def _reference_has_overview(rows, geometry, reference_rows, reference_geometry, pose):  # type: ignore[no-untyped-def]
    """Tell whether the reference, not the scan, has the better overview."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    # The reference's sensing position in the frame of the scan.
    x, y = -c * pose[0] - s * pose[1], s * pose[0] - c * pose[1]
    theirs = _clearance(reference_rows, reference_geometry, pose[0], pose[1])
    ours = _clearance(rows, geometry, x, y)
    if theirs > 0.0 or ours > 0.0:
        return theirs >= ours
    return _aside(reference_geometry, pose[0], pose[1]) <= _aside(geometry, x, y)


@kernel
def _aside(geometry, x, y):  # type: ignore[no-untyped-def]
    """Angle between the middle of the field of view and a position, radians."""
    middle = geometry[0] + 0.5 * geometry[1] * (geometry[2] - 1.0)
    return abs(_positive(math.atan2(y, x) - middle + math.pi) - math.pi)


@kernel
def _render(rows, pose, geometry, inverse):  # type: ignore[no-untyped-def]
    """Draw an outline, carried by ``pose`` (T_front_overview), into inverse ranges per beam.

    Over an angle, the inverse range of a straight line is all but linear between two close
    directions; where they are far apart the exact formula is taken.
    """
    count = len(rows)
    if count == 0:
        return
    step = geometry[1]
    period = _FULL_TURN / step
    coordinates, inverse_ranges = _carried(rows, pose, geometry)
    k, over, joined = coordinates[-1], inverse_ranges[-1], rows[-1, _GAP] == CONNECTED
    for i in range(count):
        k_before, over_before, joined_before = k, over, joined
        k, over, joined = coordinates[i], inverse_ranges[i], rows[i, _GAP] == CONNECTED
        if joined_before:
            span = k - k_before
            if span > 0.5 * period:
                span -= period
            elif span < -0.5 * period:
                span += period
            begin, near, far = (k_before, over_before, over)
            if span < 0.0:
                begin, near, far = (k, over, over_before)
            _draw(begin, abs(span), near, far, step, period, inverse)
        if not (joined_before and joined):
            # The margin of a surface reaches half a beam beyond its last reading.
            _draw(k - 0.5 + _SLACK, 1.0 - 3.0 * _SLACK, over, over, step, period, inverse)


@kernel
def _carried(rows, pose, geometry):  # type: ignore[no-untyped-def]
    """Beam coordinate and inverse range of every return of an outline carried by ``pose``.

    Two loops, since a processor does several returns at once in the second.
    """
    first, step = geometry[0], geometry[1]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = np.empty(len(rows)), np.empty(len(rows))
    for i in range(len(rows)):
        x[i] = c * rows[i, _X] - s * rows[i, _Y] + pose[0]
        y[i] = s * rows[i, _X] + c * rows[i, _Y] + pose[1]
    for i in range(len(rows)):
        u, v = x[i], y[i]
        angle = _direction(u, v) - first
        x[i] = (angle - _FULL_TURN * np.floor(angle / _FULL_TURN)) / step
        y[i] = 1.0 / max(math.sqrt(u * u + v * v), _SLACK)
    return x, y


@inlined
def _direction(x, y):  # type: ignore[no-untyped-def]
    """``math.atan2(y, x)`` to a few units in the last place, without a branch or a call."""
    along, across = abs(x), abs(y)
    low, high = min(along, across), max(along, across)
    # Beyond an eighth of pi the angle to the diagonal is the smaller one.
    steep = low > _STEEP * high
    t = (low - high if steep else low) / (low + high if steep else max(high, _TINY))
    z = t * t
    series = _ARC[4] + z * (_ARC[3] + z * (_ARC[2] + z * (_ARC[1] + z * _ARC[0])))
    series = _ARC[7] + z * (_ARC[6] + z * (_ARC[5] + z * series))
    angle = t * (_ARC[9] + z * (_ARC[8] + z * series))
    angle = angle + 0.25 * math.pi if steep else angle
    angle = 0.5 * math.pi - angle if across > along else angle
    angle = math.pi - angle if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@inlined
def _draw(k, span, over, over_end, step, period, inverse):  # type: ignore[no-untyped-def]
    """Draw a line from beam coordinate ``k`` over ``span`` beams; the nearest remains."""
    if k < 0.0:
        k += period
    wide = span * step > 0.3
    denominator = math.sin(span * step) if wide else 1.0
    if denominator < _SLACK:
        return
    for lap in range(2):
        begin = k - lap * period
        end = begin + span + _SLACK
        if end < 0.0:
            return
        low = max(int(math.ceil(begin - _SLACK)), 0)
        high = min(int(end), len(inverse) - 1)
        for beam in range(low, high + 1):
            along = min(max(beam - begin, 0.0), span)
            if wide:
                value = math.sin((span - along) * step) * over + math.sin(along * step) * over_end
                value /= denominator
            elif span > 0.0:
                value = over + (over_end - over) * along / span
            else:
                value = max(over, over_end)
            inverse[beam] = max(inverse[beam], value)


@kernel
def _agreement(rows, geometry, inverse, tolerances):  # type: ignore[no-untyped-def]
    """Share of the front scan's returns that agree with the synthetic scan."""
    least, relative, largest = tolerances
    agree = 0
    for i in range(len(rows)):
        beam = int(_positive(rows[i, _BEAM] - geometry[0] + _SLACK) / geometry[1] + 0.5)
        if beam >= len(inverse) or inverse[beam] <= 0.0:
            continue
        tolerance = min(least + relative * rows[i, _RANGE], largest)
        if abs(1.0 / inverse[beam] - rows[i, _RANGE]) <= tolerance:
            agree += 1
    return agree / len(rows) if len(rows) > 0 else 0.0


@kernel
def evaluation(rows, geometry, reference_rows, reference_geometry, pose, tolerances):  # type: ignore[no-untyped-def]
    """e_m of one alignment."""
    if _reference_has_overview(rows, geometry, reference_rows, reference_geometry, pose):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        back = (-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2])
        inverse = np.zeros(int(geometry[2]))
        _render(reference_rows, back, geometry, inverse)
        return _agreement(rows, geometry, inverse, tolerances)
    inverse = np.zeros(int(reference_geometry[2]))
    _render(rows, (pose[0], pose[1], pose[2]), reference_geometry, inverse)
    return _agreement(reference_rows, reference_geometry, inverse, tolerances)


@kernel
def _evaluations(rows, geometry, all_rows, starts, geometries, candidates, poses, tolerances):  # type: ignore[no-untyped-def]
    """(N,) e_m of all alignments."""
    e_m = np.empty(len(poses))
    for n in range(len(poses)):
        c = candidates[n]
        reference_rows = all_rows[starts[c] : starts[c + 1]]
        e_m[n] = evaluation(rows, geometry, reference_rows, geometries[c], poses[n], tolerances)
    return e_m
