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

from .pose import Pose2D
from .protocol import Answer
from .record import Record

__all__ = ["Journey", "Recovery", "RecoveryFigures", "journeys", "odometry", "recovery", "summary"]

_EVERY = 20
_APART = 10.0
_WITHDRAWN = 2.0


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
        withdrawn: Metres from the jump until no pose of before it was reported any more;
            infinite if that never ended, NaN without a jump.
    """

    driven: float
    was_wrong: bool
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
        withdrawn: Share that withdrew the old pose within 2 m of the jump; NaN without a jump.
    """

    journeys: int
    found: float
    driven_median: float
    driven_90: float
    was_wrong: float
    withdrawn: float


def journeys(
    records: Sequence[Record], every: int = _EVERY, *, kidnap: bool = False, seed: int = 0
) -> tuple[Journey, ...]:
    """Start at every ``every``-th usable record with a pose and drive on to the end.

    With ``kidnap``, the robot is carried away halfway, to a record at least 10 m from where it
    was, drawn among those that are followed by as many records as it still had before it; these
    it drives on along.  A start with no such record is left out.

    Args:
        records: In time order.
        every: Records between starts.
        kidnap: Whether there is a jump.
        seed: Draws the places of the jumps.
    """
    usable = [i for i, r in enumerate(records) if r.scan is not None and _has_pose(r)]
    made = (Journey(tuple(usable[start:])) for start in range(0, len(usable), every))
    if not kidnap:
        return tuple(made)
    rng = np.random.default_rng(seed)
    jumped = (_kidnapped(records, usable, journey, rng) for journey in made)
    return tuple(journey for journey in jumped if journey is not None)


def odometry(records: Sequence[Record], journey: Journey) -> list[Pose2D]:
    """Return ``T_start_laser`` along a journey, as the wheels tell it.

    Made from the odometry of the records where all of them have one, else from their poses.
    A kidnapping is no motion.
    """
    along = [records[position] for position in journey.positions]
    poses = [record.odometry for record in along]
    if any(pose is None for pose in poses):
        poses = [record.pose for record in along]
    told, last = [], Pose2D()
    for index, pose in enumerate(poses):
        before = poses[index - 1] if index else None
        if pose is not None and before is not None and index != journey.jump:
            last = last @ (before.inverse() @ pose)
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
    driven = _driven(records, journey)
    begin = journey.jump or 0
    metres = [along - driven[begin] for along in driven[begin:]] if driven else []
    later = list(zip(metres, reports[begin:], strict=True))
    right = [m for m, report in later if report.accepted and report.is_correct]
    wrong = [m for m, report in later if report.accepted and not report.is_correct]
    first = min(right, default=math.inf)
    if journey.jump is None:
        return Recovery(first, bool(wrong))
    withdrawn = _withdrawn(records, journey, later)
    return Recovery(first, any(m > _WITHDRAWN for m in wrong), withdrawn)


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
        withdrawn=(
            sum(metres <= _WITHDRAWN for metres in withdrawn) / len(withdrawn)
            if withdrawn
            else math.nan
        ),
    )


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


def _driven(records: Sequence[Record], journey: Journey) -> list[float]:
    """Return the metres driven up to each record; being carried is not driving."""
    poses = [_pose(records[position]) for position in journey.positions]
    driven = [0.0] * min(len(poses), 1)
    for index in range(1, len(poses)):
        step = 0.0 if index == journey.jump else poses[index - 1].distance(poses[index])
        driven.append(driven[-1] + step)
    return driven


def _withdrawn(
    records: Sequence[Record], journey: Journey, later: Sequence[tuple[float, Answer]]
) -> float:
    """Return the metres up to the first report that no longer carries the old belief on.

    The old belief, carried on by odometry, is where the robot would be had it not been moved.
    """
    jump = journey.jump or 0
    T_map_old = _pose(records[journey.positions[jump - 1]])
    told = odometry(records, journey)
    T_old_start = told[jump - 1].inverse()
    for index, (metres, report) in enumerate(later):
        carried_on = T_map_old @ T_old_start @ told[jump + index]
        if not report.accepted or report.pose is None:
            return metres
        if report.pose.distance(carried_on) > 2.0 or report.is_correct:
            return metres
    return math.inf
