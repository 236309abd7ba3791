"""Beyond the paper: all references of a set as one map, searched by relations.

Joins the parts that need poses in a common frame: the landmarks and their relations, which
propose; the likelihood field, which sieves and refines; and the pose of every reference, so
that an answer can name the reference scan that it stands for.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .angle_function import wrapped
from .database import RelationshipDatabase, Votes, quality
from .decision import Decision, covariance, decide
from .description import Description
from .evaluation import evaluate_all, stack_outlines
from .field import LikelihoodField, Tiles
from .hypothesis import Hypothesis
from .pairwise import Known
from .pose import Pose2D
from .proposal import Landmarks, Proposals, ProposalSettings, joined, landmarks, proposals
from .reference import Reference
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
        references: Those that the hypotheses name, one for each.
        hypotheses: Best first.
    """

    votes: Votes | None
    proposals: Proposals
    fits: Fits
    decision: Decision
    references: tuple[Reference, ...]
    hypotheses: tuple[Hypothesis, ...]


@dataclass(frozen=True, eq=False)
class _Content:
    """What a search reads, replaced as a whole by a writer.

    Args:
        known: The references by their identifiers.
        tiles: The field stitched from them.
        settings: Of the landmarks.
    """

    known: dict[int, Known]
    tiles: Tiles
    settings: ProposalSettings

    @cached_property
    def identifiers(self) -> NDArray[np.int64]:
        """(N,) ascending."""
        return np.array(sorted(self.known), np.int64)

    @cached_property
    def poses(self) -> NDArray[np.float64]:
        """(N, 3) ``T_set_scan`` of the references, in the order of their identifiers."""
        placed = [_placed(self.known[identifier])[1] for identifier in self.identifiers.tolist()]
        return np.array([pose.to_array() for pose in placed]).reshape(-1, 3)

    @cached_property
    def landmarks(self) -> Landmarks:
        """Those of all references."""
        known = [self.known[identifier] for identifier in self.identifiers.tolist()]
        return landmarks(
            [(each.description.anchors, _placed(each)[1]) for each in known], self.settings
        )


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
        # Made when votes are first asked for: without them all references propose.
        self._preparing = threading.Lock()
        self._database: RelationshipDatabase | None = None
        self._relations: dict[int, tuple[Known, Landmarks]] = {}
        self._field = LikelihoodField(settings.field, (_placed(each) for each in begin))
        self._hold({each.reference.identifier: each for each in begin})

    def __len__(self) -> int:
        return len(self._content.known)

    def add(self, known: Known) -> None:
        """Add a reference that has a pose.

        Raises:
            ValueError: The identifier is in use.
        """
        identifier = known.reference.identifier
        with self._preparing:
            self._field.add(*_placed(known))  # first, since it may refuse
            if self._database is not None:
                self._database.add(identifier, known.description.graph)
            self._hold({**self._content.known, identifier: known})

    def remove(self, identifier: int) -> None:
        """Remove a reference.

        Raises:
            KeyError: There is no such reference.
        """
        with self._preparing:
            left = dict(self._content.known)
            known = left.pop(identifier)
            if self._database is not None:
                self._database.remove(identifier)
            self._relations.pop(identifier, None)
            self._field.remove(*_placed(known))
            self._hold(left)

    def search(self, description: Description, most: int | None) -> MapSearch:
        """Let relations propose poses, sieve and refine them, and decide.

        Args:
            description: Of the scan.
            most: How many references, those of the highest quality, may propose; None for all.
        """
        settings, content = self._settings, self._content
        tiles = content.tiles
        points = description.angles.points
        votes = None if most is None else self._voting().votes(description.graph, most)
        known = content.landmarks if votes is None else self._some(votes.references, content)
        proposed = proposals(description.anchors, points, known, tiles, settings.proposal)
        if not len(proposed.poses):
            proposed = _standing(content)
        fits = verify(proposed.poses, points, tiles, self._weights, settings.verification)
        decision = decide(fits, settings.decision)
        hypotheses = self._hypotheses(description, fits, decision, content)
        references = tuple(content.known[each.reference].reference for each in hypotheses)
        return MapSearch(votes, proposed, fits, decision, references, hypotheses)

    def follow(
        self, scan: LaserScan, poses: NDArray[np.float64], stiffness: NDArray[np.float64]
    ) -> Fits:
        """Refine expected poses of a scan, and score them as the belief does."""
        settings, tiles = self._settings.verification, self._content.tiles
        return follow(poses, stiffness, scan.points, tiles, self._readings, settings)

    def nearest(self, poses: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the identifier of the reference taken nearest to each of (K, 3) poses.

        Returns:
            (K,) identifiers and (K, 3) ``T_reference_laser``.
        """
        content = self._content
        nearest, T_reference_scan = _stand_for(content.poses, poses)
        return content.identifiers[nearest], T_reference_scan

    def _hypotheses(
        self, description: Description, fits: Fits, decision: Decision, content: _Content
    ) -> tuple[Hypothesis, ...]:
        """Name for each of the best fits the reference taken nearest, and compare with it."""
        settings = self._settings
        count = min(len(fits), settings.acceptance.hypotheses)
        nearest, T_reference_scan = _stand_for(content.poses, fits.poses[:count])
        known = [content.known[identifier] for identifier in content.identifiers[nearest].tolist()]
        e_m = evaluate_all(
            description.outline,
            stack_outlines([each.description.outline for each in known]),
            np.arange(count),
            T_reference_scan,
            settings.evaluation,
        )
        covariances = covariance(fits[:count], settings.decision)
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

    def _hold(self, known: dict[int, Known]) -> None:
        self._content = _Content(known, self._field.tiles, self._settings.proposal)

    def _voting(self) -> RelationshipDatabase:
        with self._preparing:
            if self._database is None:
                self._database = RelationshipDatabase(
                    self._settings.database,
                    ((k, each.description.graph) for k, each in self._content.known.items()),
                )
            return self._database

    def _some(self, identifiers: NDArray[np.int64], content: _Content) -> Landmarks:
        """Join the relations of single references, less any removed in between."""
        known = [content.known.get(identifier) for identifier in identifiers.tolist()]
        parts = [self._related(each) for each in known if each is not None]
        return joined(parts) if parts else landmarks([], self._settings.proposal)

    def _related(self, known: Known) -> Landmarks:
        identifier = known.reference.identifier
        made_of, relations = self._relations.get(identifier, (None, None))
        if relations is None or made_of is not known:
            anchors = [(known.description.anchors, _placed(known)[1])]
            relations = landmarks(anchors, self._settings.proposal)
            self._relations[identifier] = known, relations
        return relations


def _standing(content: _Content) -> Proposals:
    """Return the poses of the references: a scan without anchors may stand at any."""
    poses = np.concatenate([content.poses, content.poses + np.array([0.0, 0.0, math.pi])])
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
