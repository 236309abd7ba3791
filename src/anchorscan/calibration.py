"""Fitting the decision: what the evidence of a query is worth, on buildings other than scored.

Every query of every split gives the evidence of its best fit (see ``decision.py``) and whether
that fit was right.  A logistic regression with a small ridge maps one to the other.  To say
how the fit does on a building that it has not seen, each building in turn is left out of the
fit, as a place of references and as a place of queries, and scored with what the others gave.

Every split is asked three times: as recorded, and with a tenth and a fifth of the readings
occluded by people, so that the fit knows what a right answer in a crowd looks like.

Splits weigh with the square root of their queries, so that a long drive does not outvote the
rest; sparse references (P2) and unknown places (P4) weigh less, since users see them less.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .decision import beside, evidence
from .matcher import Matcher
from .pose import Pose2D
from .protocol import Case, is_correct, recall_at_precision, reliability
from .regression import logistic_regression
from .scan import LaserScan
from .settings import Settings
from .simulator import occlude

__all__ = ["Fit", "Sample", "fit", "gather", "rotate", "weigh"]

_PROTOCOL_WEIGHTS = {"P1": 1.0, "P2": 0.5, "P3": 1.0, "P4": 0.03}
_RIDGE = 0.02
_CROWDS = (0.0, 0.1, 0.2)
_COEFFICIENTS = ("constant", "log_margin", "explained", "through", "heading", "anchors")


@dataclass(frozen=True, eq=False)
class Sample:
    """The evidence of the queries of one split.

    Args:
        protocol: "P1" to "P4".
        place: What tables call it.
        buildings: Of the references and of the queries.
        crowd: Share of the readings that people occlude.
        evidence: (N, 6) of the best fit of each query.
        most: (N,) that the decision lets it be worth beside the others.
        correct: (N,) whether that fit was right.
    """

    protocol: str
    place: str
    buildings: tuple[str, ...]
    crowd: float
    evidence: NDArray[np.float64]
    most: NDArray[np.float64]
    correct: NDArray[np.bool_]


@dataclass(frozen=True)
class Fit:
    """What a sample looks like to coefficients.

    Args:
        protocol: "P1" to "P4".
        place: What tables call it.
        crowd: Share of the readings that people occlude.
        queries: Their count.
        recall: Recall at 100 % precision.
        recall_99: Recall at 99 % precision.
        calibration_error: Expected calibration error over ten bins.
        accepted_wrong: Wrong answers at the threshold of the settings.
        accepted: Answers at that threshold.
    """

    protocol: str
    place: str
    crowd: float
    queries: int
    recall: float
    recall_99: float
    calibration_error: float
    accepted_wrong: int
    accepted: int


def gather(
    cases: Iterable[Case], settings: Settings, queries: int, say: Callable[[str], None]
) -> list[Sample]:
    """Locate the queries of every case and keep the evidence.

    Args:
        cases: The splits.
        settings: Of the matcher; its method must be the map.
        queries: At most so many of each split, at equal steps.
        say: Told what was gathered.
    """
    samples = []
    for case in cases:
        matcher = Matcher(case.references, settings)
        asked = list(case.queries)
        asked = asked[:: max(1, len(asked) // queries)]
        for crowd in _CROWDS:
            rows, most, correct = _asked(matcher, asked, crowd)
            say(
                f"{case.protocol} {case.place}, {crowd:.0%} occluded: {sum(correct)} of {len(rows)}"
            )
            if len(rows):
                told = (rows, most, correct)
                samples.append(Sample(case.protocol, case.place, case.buildings, crowd, *told))
    return samples


def _asked(
    matcher: Matcher, asked: Sequence[tuple[LaserScan, Pose2D | None]], crowd: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Evidence of the best fits of scans in a crowd, the most they can be worth, and if right."""
    rows, most, right = [], [], []
    for seed, (scan, truth) in enumerate(asked):
        trace = matcher.explain(occlude(scan, crowd, seed) if crowd else scan)
        search = trace.in_map
        if search is not None and len(search.fits):
            rows.append(evidence(search.fits, len(trace.description.anchors)))
            most.append(beside(search.fits, matcher.settings.decision))
            right.append(is_correct(Pose2D.from_array(search.fits.poses[0]), truth))
    return np.array(rows), np.array(most), np.array(right, bool)


def weigh(samples: Sequence[Sample]) -> dict[str, float]:
    """Fit the coefficients of ``DecisionSettings`` to samples."""
    return dict(zip(_COEFFICIENTS, _logistic(samples).tolist(), strict=True))


def rotate(samples: Sequence[Sample], threshold: float) -> list[Fit]:
    """Score every sample by what the samples of other buildings gave."""
    fits = []
    for sample in samples:
        others = [s for s in samples if not set(s.buildings) & set(sample.buildings)]
        if others:
            fits.append(fit(sample, _logistic(others), threshold))
    return fits


def fit(sample: Sample, coefficients: NDArray[np.float64], threshold: float) -> Fit:
    """Score one sample by given coefficients."""
    probability = 1.0 / (1.0 + np.exp(-(sample.evidence @ coefficients)))
    probability = np.minimum(probability, sample.most)
    accepted = probability >= threshold
    return Fit(
        sample.protocol,
        sample.place,
        sample.crowd,
        len(sample.correct),
        recall_at_precision(probability, sample.correct)[0],
        recall_at_precision(probability, sample.correct, 0.99)[0],
        reliability(probability, sample.correct).error,
        int(np.sum(accepted & ~sample.correct)),
        int(np.sum(accepted)),
    )


def _logistic(samples: Sequence[Sample]) -> NDArray[np.float64]:
    """Ridge-regularised logistic regression, splits weighed as the module says."""
    x = np.concatenate([sample.evidence for sample in samples])
    y = np.concatenate([sample.correct for sample in samples]).astype(np.float64)
    weights = np.concatenate(
        [
            np.full(
                len(sample.correct),
                _PROTOCOL_WEIGHTS[sample.protocol] / math.sqrt(len(sample.correct)),
            )
            for sample in samples
        ]
    )
    weights *= len(weights) / weights.sum()
    return logistic_regression(x, y, weights, 2.0 * _RIDGE)
