"""The algorithm on one screen: scan in, hypotheses out (sections 2 to 5).

Hypotheses are ordered by e_m, as in the paper's experiment; equals by support, then by q_m,
then by the reference's identifier, so that the order of the references does not matter.

The paper says nothing of a scan whose graph corresponds to no reference's.  Since every scan
that saw anything is to have an answer, it is then evaluated as if it had been taken where the
candidate references were; that may be right, and e_m says whether it is.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .alignment import Alignment, align
from .anchors import (
    AnchorPoints,
    VirtualEdges,
    angle_anchors,
    gather,
    jump_edge_anchors,
    virtual_edges,
)
from .angle_function import AngleFunction, angle_function
from .database import RelationshipDatabase, Votes
from .evaluation import (
    Evaluation,
    Outline,
    evaluate,
    evaluate_all,
    outline,
    probability,
    stack_outlines,
)
from .graph import AnchorGraph, anchor_graph, stack
from .hypothesis import Hypothesis
from .pose import Pose2D
from .reference import Reference
from .scan import LaserScan
from .segments import Segments, segments
from .settings import Settings

__all__ = ["Candidates", "Description", "Found", "Matcher", "Trace", "describe", "match"]

Candidates = int | Literal["all"] | None


@dataclass(frozen=True, eq=False)
class Description:
    """All that is derived from one scan by itself.

    Args:
        angles: Angle function (section 2).
        surfaces: Large connected surfaces (section 3).
        edges: Walls behind the virtual edges, per main angle (section 3).
        anchors: Anchor points (section 3).
        graph: Anchor graph (section 4).
        outline: What it saw, for the evaluation (section 5).
    """

    angles: AngleFunction
    surfaces: Segments
    edges: tuple[VirtualEdges, ...]
    anchors: AnchorPoints
    graph: AnchorGraph
    outline: Outline


@dataclass(frozen=True, eq=False)
class Found:
    """Poses to be evaluated.

    Args:
        candidates: (N,) candidate that each is with.
        poses: (N, 3) ``T_reference_scan`` as x, y, theta, metres and radians.
        support: (N,) hypotheses behind each.
        scatter: (N, 3, 3) covariance of x, y, theta among those.
    """

    candidates: NDArray[np.int64]
    poses: NDArray[np.float64]
    support: NDArray[np.int64]
    scatter: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Trace:
    """Every value that was computed for one scan, in the order of the algorithm.

    Args:
        scan: The scan.
        description: What was derived from it.
        votes: Of the candidate references, best first (section 4.1).
        candidates: The candidate references, in the order of the votes.
        alignment: Alignment with all candidates (section 4.2).
        found: The alignments that were evaluated.
        evaluations: (N,) e_m of each (section 5).
        hypotheses: The answer, best first.
        settings: The settings of the run.
    """

    scan: LaserScan
    description: Description
    votes: Votes
    candidates: tuple[Reference, ...]
    alignment: Alignment
    found: Found
    evaluations: NDArray[np.float64]
    hypotheses: tuple[Hypothesis, ...]
    settings: Settings

    def evaluation(self, hypothesis: Hypothesis) -> Evaluation:
        """Evaluate one of the hypotheses once more and keep its synthetic scan.

        Raises:
            ValueError: The hypothesis is not one of this trace.
        """
        for reference in self.candidates:
            if reference.identifier == hypothesis.reference:
                return evaluate(
                    self.scan,
                    reference.scan,
                    hypothesis.pose_in_reference,
                    self.settings.evaluation,
                    self.settings.anchors.angle_function,
                )
        raise ValueError(f"reference {hypothesis.reference} is no candidate of this scan")


@dataclass(frozen=True, eq=False)
class _Known:
    reference: Reference
    graph: AnchorGraph
    outline: Outline


class Matcher:
    """Finds the poses from which a scan may have been taken, among reference scans.

    Searching is safe from many threads while one of them adds and removes.

    Args:
        references: To begin with.
        settings: Of all stages; the default preset if None.

    Raises:
        ValueError: Two references have the same identifier.
    """

    def __init__(
        self, references: Iterable[Reference] = (), settings: Settings | None = None
    ) -> None:
        self.settings = settings or Settings.preset("default")
        known = [self._know(reference) for reference in references]
        self._known = {each.reference.identifier: each for each in known}
        self._database = RelationshipDatabase(
            self.settings.database, ((each.reference.identifier, each.graph) for each in known)
        )
        self._writing = threading.Lock()

    def __len__(self) -> int:
        return len(self._known)

    @property
    def references(self) -> tuple[Reference, ...]:
        """The references, in the order in which they came."""
        return tuple(each.reference for each in tuple(self._known.values()))

    def locate(self, scan: LaserScan, candidates: Candidates = None) -> list[Hypothesis]:
        """Say where a scan may have been taken, with no prior.

        Args:
            scan: The scan.
            candidates: References to align and evaluate: their number, ``"all"``, or None
                for the number in the settings.

        Returns:
            Hypotheses, best first; none only for a scan without any return, or when there
            are no references.
        """
        return list(self.explain(scan, candidates).hypotheses)

    def explain(self, scan: LaserScan, candidates: Candidates = None) -> Trace:
        """Do what ``locate`` does and return every intermediate value."""
        settings = self.settings
        description = describe(scan, settings)
        votes = self._database.votes(description.graph, self._most(candidates))
        known = [self._known[identifier] for identifier in votes.references.tolist()]
        references = tuple(each.reference for each in known)
        alignment = align(
            description.graph, stack([each.graph for each in known]), settings.alignment
        )
        found = _found(alignment, len(known))
        e_m = evaluate_all(
            description.outline,
            stack_outlines([each.outline for each in known]),
            found.candidates,
            found.poses,
            settings.evaluation,
        )
        hypotheses = _hypotheses(references, votes, found, e_m, settings)
        if not len(description.outline.rows):
            hypotheses = ()
        return Trace(
            scan, description, votes, references, alignment, found, e_m, hypotheses, settings
        )

    def add(self, reference: Reference) -> None:
        """Add a reference; searches that have begun do without it.

        Raises:
            ValueError: The identifier is in use.
        """
        known = self._know(reference)
        with self._writing:
            if reference.identifier in self._known:
                raise ValueError(f"there is a reference {reference.identifier} already")
            self._known[reference.identifier] = known
            self._database.add(reference.identifier, known.graph)

    def remove(self, identifier: int) -> None:
        """Remove a reference.

        Raises:
            KeyError: There is no such reference.
        """
        with self._writing:
            self._database.remove(identifier)
            del self._known[identifier]

    def prepare(self) -> None:
        """Compile everything, so that the first real scan does not pay for it."""
        places = Matcher((Reference(0, _ROOM, Pose2D()),), self.settings)
        places.add(Reference(1, _ROOM))
        for candidates in (1, "all"):
            for hypothesis in (trace := places.explain(_ROOM, candidates)).hypotheses[:1]:
                trace.evaluation(hypothesis)

    def _know(self, reference: Reference) -> _Known:
        description = describe(reference.scan, self.settings)
        return _Known(reference, description.graph, description.outline)

    def _most(self, candidates: Candidates) -> int | None:
        if candidates is None:
            return self.settings.database.candidates
        return None if candidates == "all" else int(candidates)


def match(
    scan: LaserScan, reference: LaserScan, settings: Settings | None = None
) -> list[Hypothesis]:
    """Align a scan with one reference scan.

    Args:
        scan: The scan.
        reference: The reference scan.
        settings: Of all stages; the default preset if None.

    Returns:
        Hypotheses, best first, with ``pose_in_reference`` and no pose in a set.
    """
    return Matcher((Reference(0, reference),), settings).locate(scan)


def describe(scan: LaserScan, settings: Settings) -> Description:
    """Derive from one scan all that the matching needs (sections 2 to 4)."""
    angles = angle_function(scan, settings.anchors.angle_function)
    surfaces = segments(angles, settings.anchors.segments)
    edges = virtual_edges(angles, settings.anchors)
    anchors = gather(
        jump_edge_anchors(angles, surfaces, settings.anchors),
        angle_anchors(angles, surfaces, settings.anchors),
        edges,
    )
    graph = anchor_graph(anchors, settings.graph)
    return Description(angles, surfaces, tuple(edges), anchors, graph, outline(scan, angles))


def _found(alignment: Alignment, candidates: int) -> Found:
    """Return the poses to evaluate: the alignments, or else the places of the candidates."""
    if len(alignment):
        return Found(alignment.candidates, alignment.poses, alignment.support, alignment.scatter)
    # Nothing tells where around the reference the scan was taken: a metre and half a turn.
    unknown = np.diag([1.0, 1.0, 0.25 * np.pi**2])
    return Found(
        np.arange(candidates),
        np.zeros((candidates, 3)),
        np.zeros(candidates, np.int64),
        np.repeat(unknown[np.newaxis], candidates, axis=0),
    )


def _hypotheses(
    references: tuple[Reference, ...],
    votes: Votes,
    found: Found,
    e_m: NDArray[np.float64],
    settings: Settings,
) -> tuple[Hypothesis, ...]:
    """Order the evaluated alignments and say what each is worth."""
    order = np.lexsort((found.candidates, -found.support, -e_m))[: settings.acceptance.hypotheses]
    e_m = e_m[order]
    worth = probability(e_m, settings.acceptance)
    covariances = found.scatter[order] + np.diag(
        np.square(
            (
                settings.alignment.position_deviation,
                settings.alignment.position_deviation,
                settings.alignment.heading_deviation,
            )
        )
    )
    return tuple(
        _hypothesis(
            references[c], Pose2D(*pose), covariance, e, float(votes.quality[c]), p, settings
        )
        for c, pose, covariance, e, p in zip(
            found.candidates[order].tolist(),
            found.poses[order].tolist(),
            covariances,
            e_m.tolist(),
            worth.tolist(),
            strict=True,
        )
    )


def _hypothesis(
    reference: Reference,
    T_reference_scan: Pose2D,
    covariance: NDArray[np.float64],
    e_m: float,
    quality: float,
    worth: float,
    settings: Settings,
) -> Hypothesis:
    pose = None
    if reference.pose is not None:
        pose = reference.pose @ T_reference_scan
        c, s = math.cos(reference.pose.theta), math.sin(reference.pose.theta)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        covariance = turn @ covariance @ turn.T
    return Hypothesis(
        reference=reference.identifier,
        pose_in_reference=T_reference_scan,
        pose=pose,
        covariance=covariance,
        evaluation=e_m,
        quality=quality,
        score=e_m,
        probability=worth,
        accepted=e_m >= settings.acceptance.threshold,
    )


# A room with a door and a pillar: enough for every kernel to have something to do.
_ROOM = LaserScan.from_field_of_view(
    [
        min(
            abs(3.0 / math.cos(a)) if abs(math.cos(a)) > 0.3 else np.inf,
            abs(2.0 / math.sin(a)) if abs(math.sin(a)) > 0.3 else np.inf,
            1.5 if 0.5 < a < 0.9 else np.inf,
        )
        for a in np.linspace(-math.pi / 2, math.pi / 2, 181).tolist()
    ],
    math.pi,
)
