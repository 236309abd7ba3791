"""P5, the lost robot: a drive from many starting points, with no prior, for a belief over time.

A robot starts at every 20th scan of a drive, knows nothing, and is fed scans and odometry in
order.  What counts is how far it drives until it reports a confident and correct pose, and
whether it ever reports a confident wrong one.  In a *kidnapping* it is carried to another place
in the middle without notice: the odometry says that it stood still.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .pose import Pose2D
from .protocol import Answer
from .record import Record

__all__ = [
    "Journey",
    "Recovery",
    "RecoveryFigures",
    "independent",
    "journeys",
    "metres_driven",
    "odometry",
    "recovery",
    "summary",
]

_EVERY = 20
_APART = 10.0
_WITHDRAWN = 2.0
_FAR = 2.0
_GAP = 20.0


@dataclass(frozen=True)
class Journey:
    """The records that a lost robot is fed, in order.

    Args:
        positions: In the sequence of records.
        jump: Index in ``positions`` of the first record after the kidnapping, or None.
    """

    positions: tuple[int, ...]
    jump: int | None = None


@dataclass(frozen=True)
class Recovery:
    """How one journey went, from its start or from its jump.

    Args:
        driven: Metres until the first confident and correct report; infinite if there was none.
        was_wrong: Whether a confident wrong pose was ever reported; after a jump, later than
            2 m behind it.
        was_far: The same of a confident pose that was more than 2 m off: another place, where
            less may be a slip, or a stretch where two passes of the log itself disagree.
        withdrawn: Metres from the jump until no pose of before it was reported any more;
            infinite if that never ended, NaN where there was no jump or no pose before it.
    """

    driven: float
    was_wrong: bool
    was_far: bool = False
    withdrawn: float = math.nan


@dataclass(frozen=True)
class RecoveryFigures:
    """The figures of P5.

    Args:
        journeys: Their number.
        found: Share that reported a confident and correct pose.
        driven_median: Metres until then, of those that did.
        driven_90: 90th percentile of the same.
        was_wrong: Share that ever reported a confident wrong pose.
        was_far: Share that ever reported one that was more than 2 m off.
        withdrawn: Share of those located before a jump that withdrew the old pose within 2 m of
            it; NaN without a jump.
    """

    journeys: int
    found: float
    driven_median: float
    driven_90: float
    was_wrong: float
    was_far: float
    withdrawn: float


def journeys(
    records: Sequence[Record],
    every: int = _EVERY,
    *,
    longest: float = math.inf,
    kidnap: bool = False,
    seed: int = 0,
) -> tuple[Journey, ...]:
    """Start at every ``every``-th usable record with a pose and drive on.

    With ``kidnap``, the robot is carried away halfway, to a record at least 10 m from where it
    was, drawn among those that are followed by as many records as it still had before it; these
    it drives on along.  A start with no such record is left out.

    Args:
        records: In time order.
        every: Records between starts.
        longest: Metres after which a journey ends; by default it goes on to the end of the drive.
        kidnap: Whether there is a jump.
        seed: Draws the places of the jumps.
    """
    usable = [i for i, r in enumerate(records) if r.scan is not None and _has_pose(r)]
    made = (_ended(records, usable[start:], longest) for start in range(0, len(usable), every))
    if not kidnap:
        return tuple(made)
    rng = np.random.default_rng(seed)
    jumped = (_kidnapped(records, usable, journey, rng) for journey in made)
    return tuple(journey for journey in jumped if journey is not None)


def independent(
    records: Sequence[Record], journey: Journey, gap: float = _GAP
) -> tuple[Record, ...]:
    """Return the records that were taken apart from a journey through the same drive.

    Args:
        records: In time order.
        journey: What was fed.
        gap: Metres of driving before the first and after the last record of each of its parts.
    """
    usable = [i for i, r in enumerate(records) if r.scan is not None and _has_pose(r)]
    along = dict(zip(usable, metres_driven(records, Journey(tuple(usable))), strict=True))
    parts = [journey.positions[: journey.jump], journey.positions[journey.jump or 0 :]]
    spans = [(along[part[0]] - gap, along[part[-1]] + gap) for part in parts if part]
    return tuple(
        records[position]
        for position, metres in along.items()
        if not any(first < metres < last for first, last in spans)
    )


def odometry(
    records: Sequence[Record], journey: Journey, noise: float = 0.0, seed: int = 0
) -> list[Pose2D]:
    """Return ``T_start_laser`` along a journey, as the wheels tell it.

    Made from the odometry of the records where all of them have one, else from their poses.
    A kidnapping is no motion.

    Args:
        records: In time order.
        journey: What is fed.
        noise: Share by which distances and turns are off: on the whole journey by one factor
            each, on every step by another, all normal; and every step's heading is off by so
            many radians per metre.
        seed: Draws the noise.
    """
    rng = np.random.default_rng((seed, *journey.positions[:1]))
    whole = 1.0 + noise * rng.standard_normal(2)
    along = [records[position] for position in journey.positions]
    poses = [record.odometry for record in along]
    if any(pose is None for pose in poses):
        poses = [record.pose for record in along]
    told, last = [], Pose2D()
    for index, pose in enumerate(poses):
        before = poses[index - 1] if index else None
        if pose is not None and before is not None and index != journey.jump:
            last = last @ _disturbed(before.inverse() @ pose, whole, noise, rng)
        told.append(last)
    return told


def recovery(records: Sequence[Record], journey: Journey, reports: Sequence[Answer]) -> Recovery:
    """Say how a journey went; after a kidnapping, from the jump on.

    Args:
        records: In time order.
        journey: What was fed.
        reports: One for each record of the journey; ``accepted`` where the belief was confident.

    Raises:
        ValueError: There is not one report for each record.
    """
    if len(reports) != len(journey.positions):
        raise ValueError(f"{len(journey.positions)} records need as many reports: {len(reports)}")
    driven = metres_driven(records, journey)
    begin = journey.jump or 0
    metres = [along - driven[begin] for along in driven[begin:]] if driven else []
    later = list(zip(metres, reports[begin:], strict=True))
    right = [m for m, report in later if report.accepted and report.is_correct]
    first = min(right, default=math.inf)
    allowed = -math.inf if journey.jump is None else _WITHDRAWN
    wrong = [r for m, r in later if m > allowed and r.accepted and not r.is_correct]
    far = any(_is_far(report) for report in wrong)
    was_located = journey.jump is not None and any(each.accepted for each in reports[:begin])
    withdrawn = _withdrawn(records, journey, later) if was_located else math.nan
    return Recovery(first, bool(wrong), far, withdrawn)


def summary(recoveries: Sequence[Recovery]) -> RecoveryFigures:
    """Compute the figures of P5 over all journeys.

    Raises:
        ValueError: There are none.
    """
    if not recoveries:
        raise ValueError("there are no journeys to compute figures of")
    driven = [one.driven for one in recoveries if math.isfinite(one.driven)]
    withdrawn = [one.withdrawn for one in recoveries if not math.isnan(one.withdrawn)]
    return RecoveryFigures(
        journeys=len(recoveries),
        found=len(driven) / len(recoveries),
        driven_median=float(np.median(driven)) if driven else math.nan,
        driven_90=float(np.percentile(driven, 90)) if driven else math.nan,
        was_wrong=sum(one.was_wrong for one in recoveries) / len(recoveries),
        was_far=sum(one.was_far for one in recoveries) / len(recoveries),
        withdrawn=(
            sum(metres <= _WITHDRAWN for metres in withdrawn) / len(withdrawn)
            if withdrawn
            else math.nan
        ),
    )


def _ended(records: Sequence[Record], positions: Sequence[int], longest: float) -> Journey:
    journey = Journey(tuple(positions))
    if math.isinf(longest):
        return journey
    within = [metres <= longest for metres in metres_driven(records, journey)]
    return Journey(
        tuple(position for position, near in zip(positions, within, strict=True) if near)
    )


def _disturbed(
    step: Pose2D, whole: NDArray[np.float64], noise: float, rng: np.random.Generator
) -> Pose2D:
    if noise == 0.0:
        return step
    longer, further, aside = (noise * rng.standard_normal(3)).tolist()
    length = float(whole[0]) * (1.0 + longer)
    turn = step.theta * float(whole[1]) * (1.0 + further) + aside * math.hypot(step.x, step.y)
    return Pose2D(length * step.x, length * step.y, turn)


def _has_pose(record: Record) -> bool:
    return record.pose is not None and record.pose.is_finite()


def _pose(record: Record) -> Pose2D:
    assert record.pose is not None
    return record.pose


def _kidnapped(
    records: Sequence[Record], usable: list[int], journey: Journey, rng: np.random.Generator
) -> Journey | None:
    half = len(journey.positions) // 2
    if half == 0:
        return None
    left = len(journey.positions) - half
    here = _pose(records[journey.positions[half - 1]])
    places = [
        index
        for index in range(len(usable) - left + 1)
        if _pose(records[usable[index]]).distance(here) >= _APART
    ]
    if not places:
        return None
    there = int(rng.choice(places))
    return Journey((*journey.positions[:half], *usable[there : there + left]), half)


def _is_far(report: Answer) -> bool:
    return (
        report.pose is not None
        and report.truth is not None
        and report.pose.distance(report.truth) > _FAR
    )


def metres_driven(records: Sequence[Record], journey: Journey) -> list[float]:
    """Return the metres driven up to each record of a journey; being carried is not driving."""
    poses = [_pose(records[position]) for position in journey.positions]
    driven = [0.0] * min(len(poses), 1)
    for index in range(1, len(poses)):
        step = 0.0 if index == journey.jump else poses[index - 1].distance(poses[index])
        driven.append(driven[-1] + step)
    return driven


def _withdrawn(
    records: Sequence[Record], journey: Journey, later: Sequence[tuple[float, Answer]]
) -> float:
    """Return the metres up to the report after the last one that carries the old belief on.

    The old belief, carried on by odometry, is where the robot would be had it not been moved.
    """
    jump = journey.jump or 0
    T_map_old = _pose(records[journey.positions[jump - 1]])
    told = odometry(records, journey)
    T_old_start = told[jump - 1].inverse()
    withdrawn = 0.0
    for index, (_, report) in enumerate(later):
        carried_on = T_map_old @ T_old_start @ told[jump + index]
        pose = report.pose if report.accepted and not report.is_correct else None
        if pose is not None and pose.distance(carried_on) <= _WITHDRAWN:
            withdrawn = later[index + 1][0] if index + 1 < len(later) else math.inf
    return withdrawn
