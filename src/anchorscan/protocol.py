"""How localization is measured: which scans are references, which are queries, and the figures.

Five protocols split recorded drives; none of them looks at a reading, only at poses:

* P1, ``revisit``: one drive, dense references, queries from later (or earlier) visits.
* P2, ``sparse``: as P1 with about thirty references, the setting of section 6 of the paper.
* P3, ``two_sessions``: references from one drive, queries from an independent one.
* P4, ``unknown_place``: references from one building, queries from another; every answer is wrong.
* P5, a drive from many starting points, for a belief over time, is in ``journey.py``.

An answer is *correct* within 0.5 m **and** 10 degrees of the true pose.  Section 6 of the paper
counts correct and wrong answers at one threshold; recall at full precision and the calibration
error are added here, since the threshold is what an answer must be trusted by.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .pose import Pose2D
from .record import Record
from .reference import Reference
from .scan import LaserScan

__all__ = [
    "CORRECT_HEADING",
    "CORRECT_POSITION",
    "Answer",
    "Case",
    "Figures",
    "Reliability",
    "Split",
    "choose_references",
    "figures",
    "is_correct",
    "precision_recall",
    "recall_at_precision",
    "reliability",
    "revisit",
    "sparse",
    "thin",
    "two_sessions",
    "unknown_place",
]

CORRECT_POSITION = 0.5
CORRECT_HEADING = math.radians(10.0)

_SPACING = 2.0
_HEADING = math.radians(45.0)
_GAP = 20.0
_SPARSE_HEADING = math.radians(90.0)
_SPARSE_STEP = 0.5
_BINS = 10
# Shares of wrong answers are compared with this slack, so that 1 of 100 is 1 %.
_SLACK = 1e-9


def is_correct(found: Pose2D, truth: Pose2D | None) -> bool:
    """Tell whether a pose is right: within half a metre and ten degrees of the truth, if any."""
    if truth is None:
        return False
    return found.distance(truth) <= CORRECT_POSITION and found.turn(truth) <= CORRECT_HEADING


@dataclass(frozen=True)
class Split:
    """Which records are references and which are queries.

    Args:
        references: Positions in the sequence of records that the references come from, ascending.
        queries: Positions in the sequence of records that the queries come from, ascending.
        spacing: Metres between references that the split was made with.
        heading: Radians between references that the split was made with.
    """

    references: tuple[int, ...]
    queries: tuple[int, ...]
    spacing: float = _SPACING
    heading: float = _HEADING


class Case(Protocol):
    """A place to be measured: what is known of it, and what is asked."""

    @property
    def protocol(self) -> str:
        """P1, P2, P3 or P4."""

    @property
    def place(self) -> str:
        """What tables call it."""

    @property
    def buildings(self) -> tuple[str, ...]:
        """Of the references and of the queries."""

    @property
    def looks_alike(self) -> bool:
        """Whether no single scan can be sure there."""

    @property
    def references(self) -> Sequence[Reference]:
        """The references, with poses."""

    @property
    def queries(self) -> Iterable[tuple[LaserScan, Pose2D | None]]:
        """Scans, each with its true pose; None in an unknown place."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What a method said to one query, and how far that is from the truth.

    Args:
        query: Position of the query in its sequence of records.
        pose: ``T_set_laser`` of the best hypothesis; None when there was none.
        truth: ``T_set_laser``; None where every answer is wrong (P4).
        probability: What the method ordered its answers by; NaN when there was none.
        accepted: Whether the method itself stands by the answer.
        seconds: Time for the query with all preprocessing.
        covariance: (3, 3) of the pose and, where it is known, of the truth; or None.
        others: ``T_set_laser`` of the other places that explain the scan alike, if it is
            ambiguous.
    """

    query: int
    pose: Pose2D | None
    truth: Pose2D | None
    probability: float
    accepted: bool
    seconds: float
    covariance: NDArray[np.float64] | None = None
    others: tuple[Pose2D, ...] = ()

    @property
    def position_error(self) -> float:
        """Metres between answer and truth; infinite where one of them is missing."""
        if self.pose is None or self.truth is None or not self.pose.is_finite():
            return math.inf
        return self.pose.distance(self.truth)

    @property
    def heading_error(self) -> float:
        """Radians between answer and truth; infinite where one of them is missing."""
        if self.pose is None or self.truth is None or not self.pose.is_finite():
            return math.inf
        return self.pose.turn(self.truth)

    @property
    def is_correct(self) -> bool:
        """Whether the pose is within 0.5 m and 10 degrees of the truth."""
        return self.position_error <= CORRECT_POSITION and self.heading_error <= CORRECT_HEADING

    @property
    def is_named(self) -> bool:
        """Whether the answer or one of the other places alike is correct."""
        return self.is_correct or any(is_correct(other, self.truth) for other in self.others)

    @property
    def squared_error(self) -> float:
        """Normalised estimation error squared (3 degrees of freedom), NaN without covariance."""
        if self.covariance is None or self.pose is None or self.truth is None:
            return math.nan
        turn = math.remainder(self.pose.theta - self.truth.theta, 2.0 * math.pi)
        error = np.array([self.pose.x - self.truth.x, self.pose.y - self.truth.y, turn])
        try:
            return float(error @ np.linalg.solve(self.covariance, error))
        except np.linalg.LinAlgError:
            return math.nan


@dataclass(frozen=True, eq=False)
class Reliability:
    """The reliability diagram: reported probability against the share that was right.

    Args:
        counts: (10,) answers in each equal-width bin.
        probability: (10,) mean reported probability of each bin, NaN where empty.
        accuracy: (10,) share of correct answers of each bin, NaN where empty.
        error: Expected calibration error; NaN without any answer.
    """

    counts: NDArray[np.int64]
    probability: NDArray[np.float64]
    accuracy: NDArray[np.float64]
    error: float


@dataclass(frozen=True)
class Figures:
    """The figures of one method on one split; shares are of all queries.

    Args:
        queries: Number of queries.
        top_1: Share whose best hypothesis is correct, with no threshold.
        recall_at_full_precision: Largest share answered correctly without a wrong answer.
        recall_at_99_precision: The same with at most 1 % of the answers wrong.
        correct: Accepted and correct.
        wrong: Accepted and wrong.
        silent: Not accepted.
        ambiguous: Those of them that are said to have been taken at one of several places.
        named: Ambiguous, and one of these places is correct.
        calibration_error: Expected calibration error over ten bins; NaN without an answer.
        time_median: Seconds a query; ``time_mean``, ``time_99``, ``time_maximum`` alike.
        time_mean: Mean seconds.
        time_99: 99th percentile, seconds.
        time_maximum: Longest, seconds.
        position_median: Position error of the correct answers, metres.
        position_90: 90th percentile of the same.
        heading_median: Heading error of the correct answers, radians.
        heading_90: 90th percentile of the same.
        honest_covariance: Share of the correct answers whose normalised estimation error squared
            lies below the 95 % bound of its chi-square; NaN without covariances.
    """

    queries: int
    top_1: float
    recall_at_full_precision: float
    recall_at_99_precision: float
    correct: int
    wrong: int
    silent: int
    ambiguous: int
    named: int
    calibration_error: float
    time_median: float
    time_mean: float
    time_99: float
    time_maximum: float
    position_median: float
    position_90: float
    heading_median: float
    heading_90: float
    honest_covariance: float


# 95 % of a chi-square with three degrees of freedom.
_CHI_SQUARE_95 = 7.814727903251179


def choose_references(
    records: Sequence[Record], spacing: float = _SPACING, heading: float = _HEADING
) -> tuple[int, ...]:
    """Walk the records in order; one is a reference when none lies within both limits of it.

    Args:
        records: In time order; those without a usable scan or a finite pose are passed over.
        spacing: Metres.
        heading: Radians.

    Returns:
        Positions in ``records``, ascending.
    """
    poses, usable = _poses(records)
    chosen: list[int] = []
    for position in np.flatnonzero(usable):
        if not np.any(_near(poses[chosen], poses[position], spacing, heading)):
            chosen.append(int(position))
    return tuple(chosen)


def revisit(
    records: Sequence[Record],
    spacing: float = _SPACING,
    heading: float = _HEADING,
    gap: float = _GAP,
) -> Split:
    """Split one drive into references and later (or earlier) visits: P1.

    A record is a query when at least one reference lies within ``spacing`` and ``heading`` of
    it, and each of those was recorded at least ``gap`` metres of driving away from it.

    Args:
        records: In time order.
        spacing: Metres.
        heading: Radians.
        gap: Metres of driving: the sum of steps between the poses.
    """
    references = choose_references(records, spacing, heading)
    poses, usable = _poses(records)
    driven = _driven(poses)
    chosen = np.array(references, dtype=np.int64)
    queries = []
    for position in np.flatnonzero(usable):
        near = chosen[_near(poses[chosen], poses[position], spacing, heading)]
        if near.size and np.all(np.abs(driven[near] - driven[position]) >= gap):
            queries.append(int(position))
    return Split(references, tuple(queries), spacing, heading)


def sparse(
    records: Sequence[Record],
    count: int = 30,
    heading: float = _SPARSE_HEADING,
    gap: float = _GAP,
) -> Split:
    """As P1 with the spacing enlarged until about ``count`` references are left: P2.

    The spacing grows from 2.0 m in steps of 0.5 m; of the first that leaves no more than
    ``count`` references and the one before it, the one nearer to ``count`` is taken.  Headings
    alone can keep more than ``count`` apart; then the spacing stops at the extent of the drive.

    Args:
        records: In time order.
        count: References wanted.
        heading: Radians.
        gap: Metres of driving between a query and the references near it.
    """
    spacing, widest = _SPACING, _extent(records)
    left = len(choose_references(records, spacing, heading))
    before = left
    while left > count and spacing <= widest:
        before, spacing = left, spacing + _SPARSE_STEP
        left = len(choose_references(records, spacing, heading))
    if before > count and before - count < abs(count - left):
        spacing -= _SPARSE_STEP
    return revisit(records, spacing, heading, gap)


def two_sessions(
    references: Sequence[Record],
    queries: Sequence[Record],
    spacing: float = _SPACING,
    heading: float = _HEADING,
) -> Split:
    """References from one drive, queries from an independent one in the same frame: P3.

    Every record of the second drive that has a reference within both limits is a query.

    Args:
        references: Records of the first drive, in time order.
        queries: Records of the second drive.
        spacing: Metres.
        heading: Radians.
    """
    chosen = choose_references(references, spacing, heading)
    reference_poses = _poses(references)[0][list(chosen)]
    poses, usable = _poses(queries)
    near = tuple(
        int(position)
        for position in np.flatnonzero(usable)
        if np.any(_near(reference_poses, poses[position], spacing, heading))
    )
    return Split(chosen, near, spacing, heading)


def unknown_place(
    references: Sequence[Record],
    queries: Sequence[Record],
    spacing: float = _SPACING,
    heading: float = _HEADING,
) -> Split:
    """References from one building, queries from another: P4.

    Every usable record of the other building is a query, with or without a pose.

    Args:
        references: Records of the building that is known, in time order.
        queries: Records of the other building.
        spacing: Metres between references.
        heading: Radians between references.
    """
    usable = tuple(i for i, record in enumerate(queries) if record.scan is not None)
    return Split(choose_references(references, spacing, heading), usable, spacing, heading)


def thin(queries: Sequence[int], count: int | None, seed: int = 0) -> tuple[int, ...]:
    """Take about ``count`` queries at equal steps, the same for the same seed.

    Equal steps cover the whole drive; the seed moves where they begin.  All queries are returned
    when ``count`` is None or not smaller than their number.

    Raises:
        ValueError: ``count`` is negative.
    """
    if count is not None and count < 0:
        raise ValueError(f"cannot take {count} queries")
    if count is None or count >= len(queries):
        return tuple(queries)
    if count == 0:
        return ()
    begin = np.random.default_rng(seed).random() if seed else 0.0
    steps = ((begin + np.arange(count)) * len(queries) / count).astype(np.int64)
    return tuple(queries[step] for step in steps)


def precision_recall(
    probability: ArrayLike, correct: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the curve over all thresholds, from the strictest to none.

    Answers of equal probability are given or withheld together.

    Args:
        probability: (N,) reported for each query; NaN where nothing was answered.
        correct: (N,) whether the answer is correct.

    Returns:
        (T,) thresholds, falling; (T,) share of the answers at or above each that are correct;
        (T,) share of all queries answered correctly.
    """
    thresholds, given, hits = _counts(probability, correct)
    return thresholds, hits / given, hits / max(np.size(probability), 1)


def recall_at_precision(
    probability: ArrayLike, correct: ArrayLike, precision: float = 1.0
) -> tuple[float, float]:
    """Place the threshold where recall is largest at no less than ``precision``.

    Answers of equal probability are given or withheld together.

    Args:
        probability: (N,) reported for each query; NaN where nothing was answered.
        correct: (N,) whether the answer is correct.
        precision: Share of the given answers that must be correct.

    Returns:
        The share of all queries answered correctly, and the threshold (answers at or above it
        are given); 0 and infinity when no threshold will do.
    """
    thresholds, given, hits = _counts(probability, correct)
    allowed = np.flatnonzero(given - hits <= (1.0 - precision) * given + _SLACK)
    if not allowed.size or hits[allowed].max() == 0:
        return 0.0, math.inf
    best = allowed[np.argmax(hits[allowed])]
    return float(hits[best]) / np.size(probability), float(thresholds[best])


def reliability(probability: ArrayLike, correct: ArrayLike) -> Reliability:
    """Compare reported probabilities with the shares that were right, over ten bins.

    Args:
        probability: (N,) in [0, 1]; NaN where nothing was answered.
        correct: (N,) whether the answer is correct.
    """
    values = np.asarray(probability, dtype=np.float64)
    answered = ~np.isnan(values)
    values, right = values[answered], np.asarray(correct, dtype=bool)[answered]
    bins = np.clip((values * _BINS).astype(np.int64), 0, _BINS - 1)
    counts = np.bincount(bins, minlength=_BINS)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(bins, weights=values, minlength=_BINS) / counts
        share = np.bincount(bins, weights=right, minlength=_BINS) / counts
    filled = counts > 0
    gaps = counts[filled] * np.abs(mean[filled] - share[filled])
    error = float(gaps.sum() / len(values)) if len(values) else math.nan
    return Reliability(counts, mean, share, error)


def figures(answers: Iterable[Answer]) -> Figures:
    """Compute every figure of one method on one split, or pooled over several.

    Raises:
        ValueError: There are no answers.
    """
    given = tuple(answers)
    if not given:
        raise ValueError("there are no answers to compute figures of")
    probability = np.array([answer.probability for answer in given])
    correct = np.array([answer.is_correct for answer in given])
    accepted = np.array([answer.accepted for answer in given])
    seconds = np.array([answer.seconds for answer in given])
    hits = [answer for answer in given if answer.is_correct]
    ambiguous = [answer for answer in given if answer.others]
    squared = np.array([answer.squared_error for answer in hits])
    position = [answer.position_error for answer in hits]
    heading = [answer.heading_error for answer in hits]
    return Figures(
        queries=len(given),
        top_1=float(correct.mean()),
        recall_at_full_precision=recall_at_precision(probability, correct, 1.0)[0],
        recall_at_99_precision=recall_at_precision(probability, correct, 0.99)[0],
        correct=int(np.sum(accepted & correct)),
        wrong=int(np.sum(accepted & ~correct)),
        silent=int(np.sum(~accepted)),
        ambiguous=len(ambiguous),
        named=sum(answer.is_named for answer in ambiguous),
        calibration_error=reliability(probability, correct).error,
        time_median=float(np.median(seconds)),
        time_mean=float(seconds.mean()),
        time_99=float(np.percentile(seconds, 99)),
        time_maximum=float(seconds.max()),
        position_median=_percentile(position, 50),
        position_90=_percentile(position, 90),
        heading_median=_percentile(heading, 50),
        heading_90=_percentile(heading, 90),
        honest_covariance=_share_below(squared, _CHI_SQUARE_95),
    )


def _counts(
    probability: ArrayLike, correct: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return (T,) thresholds, falling, and (T,) answers and correct answers at or above each."""
    values = np.asarray(probability, dtype=np.float64)
    right = np.asarray(correct, dtype=bool)
    answered = ~np.isnan(values)
    falling, group = np.unique(-values[answered], return_inverse=True)
    given = np.cumsum(np.bincount(group, minlength=len(falling))).astype(np.float64)
    hits = np.cumsum(np.bincount(group[right[answered]], minlength=len(falling)))
    return -falling, given, hits.astype(np.float64)


def _poses(records: Sequence[Record]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return (N, 3) poses, NaN where there is none, and (N,) whether scan and pose are usable."""
    poses = np.full((len(records), 3), np.nan)
    usable = np.zeros(len(records), dtype=bool)
    for position, record in enumerate(records):
        if record.pose is not None and record.pose.is_finite():
            poses[position] = record.pose.to_array()
            usable[position] = record.scan is not None
    return poses, usable


def _near(
    poses: NDArray[np.float64], pose: NDArray[np.float64], spacing: float, heading: float
) -> NDArray[np.bool_]:
    """Tell which of (N, 3) poses lie within both limits of one pose."""
    distance = np.hypot(poses[:, 0] - pose[0], poses[:, 1] - pose[1])
    turn = np.abs(np.remainder(poses[:, 2] - pose[2] + math.pi, 2.0 * math.pi) - math.pi)
    return np.asarray((distance <= spacing) & (turn <= heading))


def _driven(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N,) metres driven up to each pose, NaN where a record has none."""
    driven = np.full(len(poses), np.nan)
    known = np.flatnonzero(~np.isnan(poses[:, 0]))
    steps = np.hypot(*np.diff(poses[known, :2], axis=0).T)
    driven[known] = np.concatenate(([0.0], np.cumsum(steps)))[: len(known)]
    return driven


def _extent(records: Sequence[Record]) -> float:
    """Return a distance that no two poses exceed, metres."""
    poses, usable = _poses(records)
    if not usable.any():
        return 0.0
    return float(np.hypot(*np.ptp(poses[usable, :2], axis=0)))


def _percentile(values: Sequence[float], share: float) -> float:
    return float(np.percentile(values, share)) if values else math.nan


def _share_below(values: NDArray[np.float64], bound: float) -> float:
    known = values[~np.isnan(values)]
    return float(np.mean(known <= bound)) if known.size else math.nan
