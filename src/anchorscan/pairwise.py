"""The method of the paper: a scan against single references (sections 4.2 and 5).

Candidates are aligned one by one through the node correspondence matrix, every alignment is
evaluated with a synthetic scan, and hypotheses are ordered by e_m as in the paper's
experiment; equals by support, then by q_m, then by the reference's identifier, so that the
order of the references does not matter.

The paper says nothing of a scan whose graph corresponds to no reference's.  Since every scan
that saw anything is to have an answer, it is then evaluated as if it had been taken where the
candidate references were; that may be right, and e_m says whether it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .alignment import Alignment, align
from .database import RelationshipDatabase, Votes
from .description import Description
from .evaluation import evaluate_all, probability, stack_outlines
from .graph import stack
from .hypothesis import Hypothesis
from .pose import Pose2D
from .reference import Reference
from .settings import Settings

__all__ = ["Found", "Known", "Pairwise", "PairwiseSearch"]


@dataclass(frozen=True, eq=False)
class Known:
    """A reference and what was derived from its scan."""

    reference: Reference
    description: Description


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
class PairwiseSearch:
    """What a search among single references came through.

    Args:
        candidates: The candidate references, in the order of the votes.
        votes: Of the candidates, best first (section 4.1).
        alignment: Alignment with all candidates (section 4.2).
        found: The alignments that were evaluated.
        evaluations: (N,) e_m of each (section 5).
        hypotheses: Best first.
    """

    candidates: tuple[Reference, ...]
    votes: Votes
    alignment: Alignment
    found: Found
    evaluations: NDArray[np.float64]
    hypotheses: tuple[Hypothesis, ...]


class Pairwise:
    """References that are searched one by one; one writer, many readers.

    Args:
        settings: Of all stages.
        known: References to begin with.

    Raises:
        ValueError: Two references have the same identifier.
    """

    def __init__(self, settings: Settings, known: Iterable[Known] = ()) -> None:
        begin = list(known)
        self._settings = settings
        self._known = {each.reference.identifier: each for each in begin}
        self._database = RelationshipDatabase(
            settings.database,
            ((each.reference.identifier, each.description.graph) for each in begin),
        )

    def __len__(self) -> int:
        return len(self._known)

    def __contains__(self, identifier: int) -> bool:
        return identifier in self._known

    @property
    def references(self) -> tuple[Reference, ...]:
        """The references, in the order in which they came."""
        return tuple(each.reference for each in tuple(self._known.values()))

    def add(self, known: Known) -> None:
        """Add a reference.

        Raises:
            ValueError: The identifier is in use.
        """
        identifier = known.reference.identifier
        if identifier in self._known:
            raise ValueError(f"there is a reference {identifier} already")
        self._known[identifier] = known
        self._database.add(identifier, known.description.graph)

    def remove(self, identifier: int) -> None:
        """Remove a reference.

        Raises:
            KeyError: There is no such reference.
        """
        self._database.remove(identifier)
        del self._known[identifier]

    def search(self, description: Description, most: int | None) -> PairwiseSearch:
        """Align a scan with the references of highest quality, evaluate, and order.

        Args:
            description: Of the scan.
            most: How many references are candidates; None for all.
        """
        settings = self._settings
        candidates, votes = self._present(self._database.votes(description.graph, most))
        references = tuple(each.reference for each in candidates)
        graphs = stack([each.description.graph for each in candidates])
        alignment = align(description.graph, graphs, settings.alignment)
        found = _found(alignment, len(candidates))
        e_m = evaluate_all(
            description.outline,
            stack_outlines([each.description.outline for each in candidates]),
            found.candidates,
            found.poses,
            settings.evaluation,
        )
        hypotheses = _hypotheses(references, votes, found, e_m, settings)
        return PairwiseSearch(references, votes, alignment, found, e_m, hypotheses)

    def _present(self, votes: Votes) -> tuple[list[Known], Votes]:
        """Give what is known of the references voted for, less any removed in between."""
        known = [self._known.get(identifier) for identifier in votes.references.tolist()]
        there = [each for each in known if each is not None]
        if len(there) < len(known):
            kept = np.array([each is not None for each in known])
            votes = Votes(votes.references[kept], votes.counts[kept], votes.quality[kept])
        return there, votes


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
    order, covariances = _best(
        found.candidates,
        found.support,
        found.scatter,
        e_m,
        np.array([_heading(reference) for reference in references]),
        (settings.alignment.position_deviation, settings.alignment.heading_deviation),
        settings.acceptance.hypotheses,
    )
    # As plain numbers at once: to take them out of arrays one by one takes several times as long.
    candidates, poses, fits = found.candidates.tolist(), found.poses.tolist(), e_m.tolist()
    qualities = votes.quality.tolist()
    hypotheses = []
    for n, k in enumerate(order.tolist()):
        reference, fit = references[candidates[k]], fits[k]
        T_reference_scan = Pose2D(*poses[k])
        hypotheses.append(
            Hypothesis(
                reference=reference.identifier,
                pose_in_reference=T_reference_scan,
                pose=None if reference.pose is None else reference.pose @ T_reference_scan,
                covariance=covariances[n],
                evaluation=fit,
                quality=qualities[candidates[k]],
                score=fit,
                probability=probability(fit, settings.acceptance),
                accepted=fit >= settings.acceptance.threshold,
            )
        )
    return tuple(hypotheses)


def _heading(reference: Reference) -> float:
    return 0.0 if reference.pose is None else reference.pose.theta


@kernel
def _covariances(scatter, headings, deviations):  # type: ignore[no-untyped-def]
    """Scatter with the least deviations added, turned into the frame of the set."""
    position, heading = deviations
    covariances = np.empty((len(scatter), 3, 3))
    for n in range(len(scatter)):
        c, s = math.cos(headings[n]), math.sin(headings[n])
        xx = scatter[n, 0, 0] + position * position
        yy = scatter[n, 1, 1] + position * position
        xy, xt, yt = scatter[n, 0, 1], scatter[n, 0, 2], scatter[n, 1, 2]
        out = covariances[n]
        out[0, 0] = c * c * xx - 2.0 * c * s * xy + s * s * yy
        out[1, 1] = s * s * xx + 2.0 * c * s * xy + c * c * yy
        out[0, 1] = out[1, 0] = c * s * (xx - yy) + (c * c - s * s) * xy
        out[0, 2] = out[2, 0] = c * xt - s * yt
        out[1, 2] = out[2, 1] = s * xt + c * yt
        out[2, 2] = scatter[n, 2, 2] + heading * heading
    return covariances


@kernel
def _is_better(k, other, candidates, support, e_m):  # type: ignore[no-untyped-def]
    """Whether an alignment comes before another, which stands before it."""
    if e_m[k] != e_m[other]:
        return e_m[k] > e_m[other]
    if support[k] != support[other]:
        return support[k] > support[other]
    return candidates[k] < candidates[other]


@kernel
def _best(candidates, support, scatter, e_m, headings, deviations, most):  # type: ignore[no-untyped-def]
    """Which alignments are the best, and the covariance of each in the frame of the set."""
    order = np.empty(min(most, len(e_m)), np.int64)
    is_taken = np.zeros(len(e_m), np.bool_)
    for n in range(len(order)):
        best = -1
        for k in range(len(e_m)):
            if not is_taken[k] and (best < 0 or _is_better(k, best, candidates, support, e_m)):
                best = k
        order[n] = best
        is_taken[best] = True
    return order, _covariances(scatter[order], headings[candidates[order]], deviations)
