"""Beyond the paper: all references of a set as one map, searched by relations.

Joins the parts that need poses in a common frame: the landmarks and their relations, which
propose; the likelihood field, which sieves and refines; and the pose of every reference, so
that an answer can name the reference scan that it stands for.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .angle_function import wrapped
from .database import RelationshipDatabase, Votes, quality
from .decision import Decision, covariance, decide
from .description import Description
from .evaluation import evaluate_all, stack_outlines
from .field import LikelihoodField
from .hypothesis import Hypothesis
from .pairwise import Known
from .pose import Pose2D
from .proposal import Landmarks, Proposals, joined, landmarks, proposals
from .scan import LaserScan
from .settings import Settings
from .verification import Fits, follow, verify

__all__ = ["MapSearch", "StitchedMap"]


@dataclass(frozen=True, eq=False)
class MapSearch:
    """What a search in the stitched map came through.

    Args:
        votes: Of the candidate references, best first; None where all may propose.
        proposals: Alignments that passed the first check.
        fits: What is left after all sieves, best score first.
        decision: What they are worth.
        hypotheses: Best first.
    """

    votes: Votes | None
    proposals: Proposals
    fits: Fits
    decision: Decision
    hypotheses: tuple[Hypothesis, ...]


class StitchedMap:
    """References in a common frame, searched as one map; one writer, many readers.

    Args:
        settings: Of all stages.
        known: References to begin with, all with a pose.
    """

    def __init__(self, settings: Settings, known: Iterable[Known] = ()) -> None:
        begin = list(known)
        self._settings = settings
        self._weights = settings.field.weights()
        self._readings = settings.belief.readings(settings.field)
        self._known = {each.reference.identifier: each for each in begin}
        self._relations = {identifier: self._relate(k) for identifier, k in self._known.items()}
        self._database = RelationshipDatabase(
            settings.database,
            ((each.reference.identifier, each.description.graph) for each in begin),
        )
        self._field = LikelihoodField(settings.field, (_placed(each) for each in begin))
        self._changed()

    def __len__(self) -> int:
        return len(self._known)

    def add(self, known: Known) -> None:
        """Add a reference that has a pose.

        Raises:
            ValueError: The identifier is in use.
        """
        identifier = known.reference.identifier
        self._database.add(identifier, known.description.graph)
        self._field.add(*_placed(known))
        self._relations[identifier] = self._relate(known)
        self._known[identifier] = known
        self._changed()

    def remove(self, identifier: int) -> None:
        """Remove a reference.

        Raises:
            KeyError: There is no such reference.
        """
        known = self._known[identifier]
        self._database.remove(identifier)
        self._field.remove(*_placed(known))
        del self._relations[identifier]
        del self._known[identifier]
        self._changed()

    def search(self, description: Description, most: int | None) -> MapSearch:
        """Let relations propose poses, sieve and refine them, and decide.

        Args:
            description: Of the scan.
            most: How many references, those of the highest quality, may propose; None for all.
        """
        settings = self._settings
        tiles = self._field.tiles
        points = description.angles.points
        votes = None if most is None else self._database.votes(description.graph, most)
        known = self._all() if votes is None else self._some(votes.references)
        proposed = proposals(description.anchors, points, known, tiles, settings.proposal)
        if not len(proposed.poses):
            proposed = self._standing()
        fits = verify(proposed.poses, points, tiles, self._weights, settings.verification)
        decision = decide(fits, settings.decision)
        hypotheses = self._hypotheses(description, fits, decision)
        return MapSearch(votes, proposed, fits, decision, hypotheses)

    def follow(
        self, scan: LaserScan, poses: NDArray[np.float64], stiffness: NDArray[np.float64]
    ) -> Fits:
        """Refine expected poses of a scan, and score them as the belief does."""
        settings = self._settings.verification
        return follow(poses, stiffness, scan.points, self._field.tiles, self._readings, settings)

    def nearest(self, poses: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the identifier of the reference taken nearest to each of (K, 3) poses.

        Returns:
            (K,) identifiers and (K, 3) ``T_reference_laser``.
        """
        nearest, T_reference_scan = _stand_for(self._poses, poses)
        return self._identifiers[nearest], T_reference_scan

    def _hypotheses(
        self, description: Description, fits: Fits, decision: Decision
    ) -> tuple[Hypothesis, ...]:
        """Name for each of the best fits the reference taken nearest, and compare with it."""
        settings = self._settings
        count = min(len(fits), settings.acceptance.hypotheses)
        nearest, T_reference_scan = _stand_for(self._poses, fits.poses[:count])
        known = [self._known[identifier] for identifier in self._identifiers[nearest].tolist()]
        e_m = evaluate_all(
            description.outline,
            stack_outlines([each.description.outline for each in known]),
            np.arange(count),
            T_reference_scan,
            settings.evaluation,
        )
        covariances = covariance(fits, settings.decision)
        return tuple(
            Hypothesis(
                reference=each.reference.identifier,
                pose_in_reference=Pose2D(*T_reference_scan[n].tolist()),
                pose=Pose2D(*fits.poses[n].tolist()),
                covariance=covariances[n],
                evaluation=float(e_m[n]),
                quality=quality(description.graph, each.description.graph, settings.database),
                score=float(fits.features[n, 0]),
                probability=float(decision.probabilities[n]),
                accepted=decision.accepted and n == 0,
            )
            for n, each in enumerate(known)
        )

    def _changed(self) -> None:
        identifiers = sorted(self._known)
        self._identifiers = np.array(identifiers, np.int64)
        poses = [_placed(self._known[identifier])[1].to_array() for identifier in identifiers]
        self._poses = np.array(poses).reshape(-1, 3)
        self._landmarks: Landmarks | None = None

    def _relate(self, known: Known) -> Landmarks:
        return landmarks([(known.description.anchors, _placed(known)[1])], self._settings.proposal)

    def _all(self) -> Landmarks:
        if self._landmarks is None:
            known = [self._known[identifier] for identifier in self._identifiers.tolist()]
            self._landmarks = landmarks(
                [(each.description.anchors, _placed(each)[1]) for each in known],
                self._settings.proposal,
            )
        return self._landmarks

    def _some(self, identifiers: NDArray[np.int64]) -> Landmarks:
        return joined([self._relations[identifier] for identifier in identifiers.tolist()])

    def _standing(self) -> Proposals:
        """Return the poses of the references: a scan without anchors may stand at any."""
        poses = np.concatenate([self._poses, self._poses + np.array([0.0, 0.0, math.pi])])
        return Proposals(poses, np.zeros(len(poses)), len(poses))


def _placed(known: Known) -> tuple[LaserScan, Pose2D]:
    """Scan and pose of a reference that has one."""
    if known.reference.pose is None:
        raise ValueError(f"reference {known.reference.identifier} has no pose")
    return known.reference.scan, known.reference.pose


@kernel
def _stand_for(references, poses):  # type: ignore[no-untyped-def]
    """Index of the reference taken nearest to each pose, and ``T_reference_scan``.

    A radian of turn counts as a metre.
    """
    nearest = np.zeros(len(poses), np.int64)
    relative = np.empty((len(poses), 3))
    for p in range(len(poses)):
        best = np.inf
        for r in range(len(references)):
            dx, dy = poses[p, 0] - references[r, 0], poses[p, 1] - references[r, 1]
            distance = math.hypot(dx, dy)
            if distance >= best:
                continue
            distance += abs(wrapped(references[r, 2] - poses[p, 2]))
            if distance < best:
                best = distance
                nearest[p] = r
                c, s = math.cos(references[r, 2]), math.sin(references[r, 2])
                relative[p, 0] = c * dx + s * dy
                relative[p, 1] = c * dy - s * dx
                relative[p, 2] = wrapped(poses[p, 2] - references[r, 2])
    return nearest, relative
