"""Finding a lost robot in a map of places: neighbours, but no poses in a common frame.

The paper's reference scans stand for places, and topological maps (its introduction, after Simmons
and Koenig, "Probabilistic Navigation in Partially Observable Environments", 1995) say which of
them are neighbours.  The belief is one probability for each reference and one for "elsewhere", a
discrete Bayes filter:

    driving a way d leaves a place with the probability 1 - exp(-d / spacing), for each of its
    neighbours alike, and gets lost with a small one;
    a scan weighs a place by exp(likelihood * (e_m - elsewhere)), e_m of section 5 being that of
    the best alignment with its reference, and "elsewhere" by one.

As in the metric belief, scans that follow each other err together, so that a scan counts by the
way driven since the one before.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from .matcher import Candidates, Trace
from .motion import MotionSettings, Odometer, new_share
from .pose import Pose2D
from .reference import Reference
from .scan import LaserScan

__all__ = ["PlaceBelief", "PlaceBeliefSettings", "TopologicalLocalizer", "left", "told"]


class PlaceBeliefSettings(BaseModel):
    """Settings of the belief over places."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    motion: MotionSettings = MotionSettings()
    spacing: float = Field(2.0, gt=0.0, description="way between neighbours, metres")
    likelihood: float = Field(15.0, gt=0.0, description="log odds per unit of e_m")
    elsewhere: float = Field(0.6, gt=0.0, lt=1.0, description="e_m that speaks for no place")
    most_against: float = Field(2.0, gt=0.0, description="log odds that one scan can take")
    most_for: float = Field(4.0, gt=0.0, description="log odds that one scan can give")
    way_alike: float = Field(1.0, gt=0.0, description="way on which scans err together, metres")
    turn_alike: float = Field(1.0, gt=0.0, description="the same of a turn, radians")
    still: float = Field(0.02, ge=0.0, description="share of new evidence in a scan at rest")
    carried_away: float = Field(
        1e-3, gt=0.0, lt=1.0, description="probability of being carried away, per metre"
    )
    back: float = Field(
        0.1, gt=0.0, lt=1.0, description="share of 'elsewhere' that is looked for again, per metre"
    )
    threshold: float = Field(
        0.95,
        gt=0.0,
        lt=1.0,
        description="probability of a place and its neighbours that is reported",
    )


class Places(Protocol):
    """What is asked of a map of places: a `Matcher` or a `ReferenceSet`."""

    @property
    def references(self) -> tuple[Reference, ...]: ...
    def explain(self, scan: LaserScan, candidates: Candidates = None) -> Trace: ...


@dataclass(frozen=True, eq=False)
class PlaceBelief:
    """At which place the robot is believed to be after a scan.

    Args:
        references: (N,) identifiers, likeliest first.
        probabilities: (N,) of each.
        elsewhere: Probability that it is at none of them.
        pose_in_reference: ``T_reference_laser`` at the likeliest, where the latest scan could be
            aligned with it.
        nearby: Probability that it is there or at one of its neighbours.
        accepted: Whether that is to be acted on.
    """

    references: NDArray[np.int64]
    probabilities: NDArray[np.float64]
    elsewhere: float
    pose_in_reference: Pose2D | None
    nearby: float
    accepted: bool

    @property
    def reference(self) -> int | None:
        """Identifier of the likeliest place; None without any."""
        return int(self.references[0]) if len(self.references) else None

    @property
    def probability(self) -> float:
        """Of the likeliest place."""
        return float(self.probabilities[0]) if len(self.references) else 0.0


class TopologicalLocalizer:
    """Keeps a belief over time in a set whose references have neighbours, but need no poses.

    Args:
        places: A reference set or a matcher; its references must not change meanwhile.
        neighbours: Pairs of identifiers, in either order; "recorded" takes every reference for
            the neighbour of the one added before it.
        settings: Of the belief.

    Raises:
        ValueError: A neighbour is not among the references.
    """

    def __init__(
        self,
        places: Places,
        neighbours: Iterable[tuple[int, int]] | Literal["recorded"] = "recorded",
        settings: PlaceBeliefSettings | None = None,
    ) -> None:
        self._places = places
        self._settings = settings or PlaceBeliefSettings()
        self._identifiers = [reference.identifier for reference in places.references]
        self._index = {identifier: k for k, identifier in enumerate(self._identifiers)}
        self._pairs = self._paired(neighbours)
        self.reset()

    def reset(self) -> None:
        """Know nothing: every place alike, and as likely none."""
        count = len(self._identifiers)
        self._belief = np.full(count + 1, 0.5 / max(count, 1))
        self._belief[-1] = 0.5 if count else 1.0
        self._odometer = Odometer(self._settings.motion)

    def update(
        self, scan: LaserScan, odometry: Pose2D | None = None, stamp: float | None = None
    ) -> PlaceBelief:
        """Take the next scan.

        Args:
            scan: In the frame of the laser.
            odometry: ``T_odom_laser`` when it was taken, where known.
            stamp: Seconds on any clock, where known; needed only where odometry is not.

        Returns:
            What is believed now.
        """
        settings = self._settings
        step = self._odometer.step(odometry, stamp)
        belief = left(self._belief, self._pairs, step.driven, settings)
        fits, poses = self._fits(scan)
        if fits is not None:
            share = new_share(step.driven, step.turned, settings)
            belief = told(belief, fits, share, settings)
        self._belief = belief
        return self._report(poses)

    def _paired(self, neighbours: Iterable[tuple[int, int]] | str) -> NDArray[np.int64]:
        if isinstance(neighbours, str):
            count = len(self._identifiers)
            return np.column_stack([np.arange(count - 1), np.arange(1, count)]).reshape(-1, 2)
        pairs = []
        for one, other in neighbours:
            for identifier in (one, other):
                if identifier not in self._index:
                    raise ValueError(f"neighbour {identifier} is not among the references")
            if one != other:
                pairs.append(sorted((self._index[one], self._index[other])))
        return np.array(sorted({tuple(pair) for pair in pairs}), np.int64).reshape(-1, 2)

    def _fits(self, scan: LaserScan) -> tuple[NDArray[np.float64] | None, dict[int, Pose2D]]:
        """Return the best e_m with every reference, and the alignments that gave them."""
        trace = self._places.explain(scan, "all")
        if trace.pairwise is None and trace.in_map is None:
            return None, {}
        fits, poses = np.zeros(len(self._identifiers)), {}
        for identifier, pose, e_m in _alignments(trace):
            place = self._index[identifier]
            if e_m > fits[place]:
                fits[place], poses[place] = e_m, pose
        return fits, poses

    def _report(self, poses: dict[int, Pose2D]) -> PlaceBelief:
        worth = self._belief[:-1]
        order = np.argsort(-worth, kind="stable")
        identifiers = np.array(self._identifiers, np.int64)[order]
        pose, nearby = None, 0.0
        if len(order):
            best = int(order[0])
            pose = poses.get(best)
            beside = self._pairs[(self._pairs == best).any(axis=1)]
            nearby = float(worth[np.unique(np.append(beside, best))].sum())
        return PlaceBelief(
            references=identifiers,
            probabilities=worth[order],
            elsewhere=float(self._belief[-1]),
            pose_in_reference=pose,
            nearby=nearby,
            accepted=nearby >= self._settings.threshold,
        )


def left(
    belief: NDArray[np.float64],
    pairs: NDArray[np.int64],
    driven: float,
    settings: PlaceBeliefSettings,
) -> NDArray[np.float64]:
    """Let a robot drive on: (N + 1,) probabilities of the places and, last, of elsewhere.

    Args:
        belief: Before.
        pairs: (P, 2) indices of neighbours.
        driven: Metres.
        settings: Of the belief.
    """
    places, elsewhere = belief[:-1], float(belief[-1])
    if not len(places):
        return belief
    away = min(settings.carried_away * driven, 0.5)
    back = min(settings.back * driven, 0.5)
    degree = np.bincount(pairs.ravel(), minlength=len(places))
    leaving = (1.0 - math.exp(-driven / settings.spacing)) * places
    share = np.divide(leaving, degree, out=np.zeros(len(places)), where=degree > 0)
    moved = np.where(degree > 0, places - leaving, places)
    np.add.at(moved, pairs[:, 0], share[pairs[:, 1]])
    np.add.at(moved, pairs[:, 1], share[pairs[:, 0]])
    moved = (1.0 - away) * moved + back * elsewhere / len(places)
    return np.append(moved, (1.0 - back) * elsewhere + away * places.sum())


def told(
    belief: NDArray[np.float64],
    fits: NDArray[np.float64],
    share: float,
    settings: PlaceBeliefSettings,
) -> NDArray[np.float64]:
    """Weigh (N + 1,) probabilities by (N,) e_m of a scan, of which a share is new."""
    odds = settings.likelihood * (fits - settings.elsewhere)
    odds = share * np.clip(odds, -settings.most_against, settings.most_for)
    weighed = belief * np.exp(np.append(odds, 0.0))
    return np.asarray(weighed / weighed.sum())


def _alignments(trace: Trace) -> Sequence[tuple[int, Pose2D, float]]:
    """Return reference, ``T_reference_laser`` and e_m of all that was evaluated."""
    search = trace.pairwise
    if search is None:
        return [(h.reference, h.pose_in_reference, h.evaluation) for h in trace.hypotheses]
    identifiers = [reference.identifier for reference in search.candidates]
    return [
        (identifiers[candidate], Pose2D(*pose), e_m)
        for candidate, pose, e_m in zip(
            search.found.candidates.tolist(),
            search.found.poses.tolist(),
            search.evaluations.tolist(),
            strict=True,
        )
    ]
