"""Fitting what one answer of a search tells the belief: its odds against a robot off the map.

Every answer comes with the calibrated probability p that it is right (see ``decision.py``), which
compares places of the map with each other.  The belief asks something else: how much likelier is
such an answer where it is right than where the map does not show the robot's place at all
(see ``belief.py``)?  A logistic regression on log(p / (1 - p)) tells, between

    right      answers that are right, to drives through what the map shows (P1 and P3),
    elsewhere  answers to drives through other buildings (P4),
    unmapped   answers to drives through a part of the same building that the map does not show:
               what was recorded within 10 m is taken out.  There look-alikes abound.

Right answers weigh as much as all others, and those as much from each of their kinds; of a kind
every place weighs the same.  Answers along a way err together, so of each drive only scans are
asked that were taken a way apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from .matcher import Matcher
from .pose import Pose2D
from .protocol import Case, choose_references, is_correct, thin
from .record import Record
from .reference import Reference
from .regression import logistic_regression
from .scan import LaserScan
from .settings import Settings

__all__ = ["Answers", "Fit", "fit", "gather", "rotate", "unmapped"]

Kind = Literal["right", "elsewhere", "unmapped"]
Asked = tuple[LaserScan, Pose2D | None]

_KINDS: dict[str, Kind] = {"P1": "right", "P3": "right", "P4": "elsewhere"}
_REGIONS = 8
_AROUND, _AWAY = 5.0, 10.0
_LEAST_PROBABILITY = 1e-4
_RIDGE = 1e-3


class Drive(Protocol):
    """A log, read."""

    @property
    def name(self) -> str: ...
    @property
    def building(self) -> str: ...
    @property
    def records(self) -> tuple[Record, ...]: ...


@dataclass(frozen=True, eq=False)
class Answers:
    """How sure the answers to the scans of one drive were.

    Args:
        kind: Which of those of the module's text.
        place: What tables call it.
        buildings: Of the map and of the drive.
        log_odds: (N,) log(p / (1 - p)) of the probability of each.
    """

    kind: Kind
    place: str
    buildings: tuple[str, ...]
    log_odds: NDArray[np.float64]


@dataclass(frozen=True)
class Fit:
    """The odds of an answer: constant + weight * log(p / (1 - p)).

    Args:
        without: The building that was left out, or "".
        constant: ``answer_constant`` of the settings.
        weight: ``answer_weight`` of the settings.
        right: Share of the right answers with odds above 20 to 1.
        elsewhere: Share of the answers in other buildings with the same.
        unmapped: The same where the map has ended.
    """

    without: str
    constant: float
    weight: float
    right: float
    elsewhere: float
    unmapped: float


def gather(
    cases: Iterable[Case],
    drives: Iterable[Drive],
    settings: Settings,
    queries: int,
    say: Callable[[str], None],
) -> list[Answers]:
    """Locate scans and keep how sure the answers were.

    Args:
        cases: Splits of P1, P3 and P4.
        drives: Drives with poses; regions are taken out of the map of each.
        settings: Of the matcher; its method must be the map.
        queries: At most so many of each split and drive.
        say: Told what was gathered.
    """
    apart = settings.belief.way_alike
    samples: list[tuple[Kind, str, tuple[str, ...], list[tuple[float, bool]]]] = []
    for case in cases:
        asked = _apart(case.queries, apart)
        chosen = [asked[n] for n in thin(range(len(asked)), queries)]
        answers = _asked(Matcher(case.references, settings), chosen)
        if case.protocol != "P4":
            answers = [(odds, right) for odds, right in answers if right]
        samples.append((_KINDS[case.protocol], case.place, case.buildings, answers))
    for drive in drives:
        answers = []
        for references, region in unmapped(drive.records):
            asked = _apart(region, apart)
            chosen = [asked[n] for n in thin(range(len(asked)), -(-queries // _REGIONS))]
            found = _asked(Matcher(references, settings), chosen)
            answers += [(odds, right) for odds, right in found if not right]
        samples.append(("unmapped", drive.name, (drive.building,), answers))
    kept = []
    for kind, place, buildings, answers in samples:
        say(f"{kind} {place}: {len(answers)} answers")
        if answers:
            odds = np.array([odds for odds, _ in answers])
            kept.append(Answers(kind, place, buildings, odds))
    return kept


def unmapped(records: Sequence[Record]) -> Iterator[tuple[tuple[Reference, ...], list[Asked]]]:
    """Take regions of a drive out of its map: give each map with the scans of its region.

    Args:
        records: In time order.
    """
    usable = [r for r in records if r.scan is not None and r.pose is not None]
    usable = [r for r in usable if r.pose is not None and r.pose.is_finite()]
    known = [usable[position] for position in choose_references(usable)]
    for number in thin(range(len(usable)), _REGIONS):
        centre = usable[number].pose
        assert centre is not None
        references = tuple(
            Reference(record.index, record.scan, record.pose)
            for record in known
            if record.scan is not None and _distance(record, centre) > _AROUND + _AWAY
        )
        region = [
            (record.scan, record.pose)
            for record in usable
            if record.scan is not None and _distance(record, centre) <= _AROUND
        ]
        if references:
            yield references, region


def fit(samples: Sequence[Answers], without: str = "") -> Fit:
    """Fit constant and weight to all samples, or to those that do not show a building.

    The shares are those of the samples that were left out, where some were.

    Raises:
        ValueError: There are no right answers, or no others.
    """
    used = [sample for sample in samples if without not in sample.buildings]
    x, y, weights = _rows(used)
    constant, weight = logistic_regression(x, y, weights, _RIDGE).tolist()
    scored = [sample for sample in samples if without in sample.buildings] or samples
    right, elsewhere, ended = (
        _sure(scored, kind, constant, weight) for kind in ("right", "elsewhere", "unmapped")
    )
    return Fit(without, constant, weight, right, elsewhere, ended)


def rotate(samples: Sequence[Answers]) -> list[Fit]:
    """Leave out one building at a time, and score the answers that have to do with it."""
    buildings = sorted({building for sample in samples for building in sample.buildings})
    return [fit(samples, building) for building in buildings]


def _asked(matcher: Matcher, asked: Sequence[Asked]) -> list[tuple[float, bool]]:
    """Log odds of the answer to every scan, and whether it is right."""
    answers = []
    for scan, truth in asked:
        search = matcher.explain(scan).in_map
        if search is None or not len(search.fits):
            continue
        p = float(search.decision.probabilities[0])
        p = min(max(p, _LEAST_PROBABILITY), 1.0 - _LEAST_PROBABILITY)
        right = is_correct(Pose2D.from_array(search.fits.poses[0]), truth)
        answers.append((math.log(p / (1.0 - p)), right))
    return answers


def _apart(asked: Iterable[Asked], way: float) -> list[Asked]:
    """Leave out scans that were taken within a way of the last one kept."""
    kept: list[Asked] = []
    for scan, pose in asked:
        last = kept[-1][1] if kept else None
        if pose is None or last is None or pose.distance(last) >= way:
            kept.append((scan, pose))
    return kept


def _distance(record: Record, centre: Pose2D) -> float:
    return math.inf if record.pose is None else record.pose.distance(centre)


def _rows(
    samples: Sequence[Answers],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """(N, 2) one and log odds, whether right, and weights of all answers."""
    kinds = [sample.kind for sample in samples]
    others = len({*kinds} - {"right"})
    if not others or "right" not in kinds:
        raise ValueError("needs right answers and others: drives that see a place again")
    weights = []
    for sample in samples:
        share = 0.5 if sample.kind == "right" else 0.5 / others
        share /= kinds.count(sample.kind) * len(sample.log_odds)
        weights.append(np.full(len(sample.log_odds), share))
    right = [np.full(len(each.log_odds), each.kind == "right", np.float64) for each in samples]
    x = np.concatenate([sample.log_odds for sample in samples])
    return np.column_stack((np.ones(len(x)), x)), np.concatenate(right), np.concatenate(weights)


def _sure(samples: Sequence[Answers], kind: str, constant: float, weight: float) -> float:
    """Share of the answers of a kind with odds above 20 to 1; NaN without any."""
    odds = [sample.log_odds for sample in samples if sample.kind == kind]
    if not odds:
        return math.nan
    return float(np.mean(constant + weight * np.concatenate(odds) > math.log(20.0)))
