"""The algorithm on one screen: scan in, hypotheses out (sections 2 to 5)."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .decision import Decision
from .description import Description, describe
from .evaluation import Evaluation, evaluate
from .hypothesis import Hypothesis
from .pairwise import Known, Pairwise, PairwiseSearch
from .pose import Pose2D
from .reference import Reference
from .scan import LaserScan
from .settings import Settings
from .stitched_map import MapSearch, StitchedMap
from .verification import Fits

__all__ = ["Candidates", "Matcher", "Trace", "match"]

Candidates = int | Literal["all"] | None


@dataclass(frozen=True, eq=False)
class Trace:
    """Every value that was computed for one scan, in the order of the algorithm.

    Args:
        scan: The scan.
        description: What was derived from it (sections 2 to 4).
        pairwise: The search against single references, where that was the method.
        in_map: The search in the stitched map, where that was the method.
        references: Those that the hypotheses name, and candidates.
        hypotheses: The answer, best first.
        settings: The settings of the run.
    """

    scan: LaserScan
    description: Description
    pairwise: PairwiseSearch | None
    in_map: MapSearch | None
    references: tuple[Reference, ...]
    hypotheses: tuple[Hypothesis, ...]
    settings: Settings

    @property
    def decision(self) -> Decision | None:
        """What the fits in the map are worth, where that was the method."""
        return None if self.in_map is None else self.in_map.decision

    def reference(self, identifier: int) -> Reference:
        """Return a reference that a hypothesis names.

        Raises:
            ValueError: No hypothesis does.
        """
        for reference in self.references:
            if reference.identifier == identifier:
                return reference
        raise ValueError(f"no hypothesis of this scan names reference {identifier}")

    def reference_scan(self, hypothesis: Hypothesis) -> LaserScan:
        """Return the scan of a hypothesis' reference as it is looked at, thinned where it is dense.

        Raises:
            ValueError: The hypothesis is not one of this trace.
        """
        scan = self.reference(hypothesis.reference).scan
        return scan.thinned(self.settings.anchors.finest_increment)

    def evaluation(self, hypothesis: Hypothesis) -> Evaluation:
        """Evaluate one of the hypotheses once more and keep its synthetic scan.

        Raises:
            ValueError: The hypothesis is not one of this trace.
        """
        return evaluate(
            self.description.scan,
            self.reference_scan(hypothesis),
            hypothesis.pose_in_reference,
            self.settings.evaluation,
            self.settings.anchors.angle_function,
        )


class Matcher:
    """Finds the poses from which a scan may have been taken, among reference scans.

    References with a pose are searched as one stitched map, unless the settings ask for the
    method of the paper, which takes references one by one; so are those without a pose.
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
        singles: list[Reference] = []
        placed: list[Reference] = []
        for reference in references:
            (placed if self._fits(reference) else singles).append(reference)
        if {each.identifier for each in placed} & {each.identifier for each in singles}:
            raise ValueError("two references have the same identifier")
        self._singles = Pairwise(self.settings, map(self._know, singles))
        self._map = StitchedMap(self.settings, map(self._know, placed))
        self._writing = threading.Lock()

    @classmethod
    def from_arrays(
        cls,
        arrays: Mapping[str, NDArray[Any]],
        settings: Settings,
        read: Callable[[int], Reference],
    ) -> Matcher:
        """Take up what ``arrays`` gave, with the same settings.

        Args:
            arrays: By name; they may be mapped from a file.
            settings: Of all stages.
            read: Returns the reference of an identifier, when it is needed.

        Raises:
            ValueError: The arrays do not fit each other.
        """
        places = cls((), settings)
        places._map = StitchedMap.from_arrays(settings, arrays, read)
        return places

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all that was derived from the references, as plain arrays by name.

        Raises:
            ValueError: Some references are not searched as one map; of these there is nothing
                to be kept.
        """
        if len(self._singles):
            raise ValueError("only references that are searched as one map have an index")
        return self._map.arrays()

    def __len__(self) -> int:
        return len(self._map) + len(self._singles)

    @property
    def references(self) -> tuple[Reference, ...]:
        """The references: those of the map, then the others."""
        return (*self._map.references, *self._singles.references)

    def locate(self, scan: LaserScan, candidates: Candidates = None) -> list[Hypothesis]:
        """Say where a scan may have been taken, with no prior.

        Args:
            scan: The scan.
            candidates: References whose relations are followed: their number, ``"all"``, or
                None for the number in the settings.

        Returns:
            Hypotheses, best first; none only for a scan without any return, or when there
            are no references.
        """
        return list(self.explain(scan, candidates).hypotheses)

    def explain(self, scan: LaserScan, candidates: Candidates = None) -> Trace:
        """Do what ``locate`` does and return every intermediate value."""
        description = describe(scan, self.settings)
        most = self._most(candidates)
        seen = len(description.readings) > 0
        singles = self._singles.search(description, most) if seen and self._singles else None
        in_map = self._map.search(description, most) if seen and self._map else None
        searches = [search for search in (in_map, singles) if search is not None]
        hypotheses = [hypothesis for search in searches for hypothesis in search.hypotheses]
        if len(searches) > 1:
            hypotheses.sort(key=lambda each: -each.probability)
        voted_for = () if singles is None else singles.candidates
        references = (*(() if in_map is None else in_map.references), *voted_for)
        return Trace(
            scan, description, singles, in_map, references, tuple(hypotheses), self.settings
        )

    def fits(self, description: Description) -> Fits | None:
        """Search the map for a scan, and leave the decision to who knows more maps.

        Args:
            description: Of the scan, by ``describe`` with the same settings.

        Returns:
            Of the highest worth first; None where there is no map.
        """
        return self._map.fits(description, self._most(None)) if self._map else None

    def hypotheses(
        self, description: Description, fits: Fits, decision: Decision
    ) -> tuple[Hypothesis, ...]:
        """Make hypotheses of what ``fits`` gave and what it was found to be worth.

        Returns:
            One for each of the first fits; none if the map has lost all references meanwhile.
        """
        return self._map.hypotheses(description, fits, decision)

    def follow(
        self, scan: LaserScan, poses: NDArray[np.float64], stiffness: NDArray[np.float64]
    ) -> Fits:
        """Refine poses that are expected, and say how well the scan fits there.

        Costs some ten microseconds a pose, whatever the size of the set.

        Args:
            scan: The scan.
            poses: (K, 3) ``T_set_laser``, metres and radians.
            stiffness: (K, 3, 3) inverse covariance of each, times the variance of a reading.

        Returns:
            A fit for every pose, in their order.
        """
        return self._map.follow(scan, poses, stiffness)

    def nearest(self, poses: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Name the reference that was taken nearest to each of (K, 3) poses ``T_set_laser``.

        Returns:
            (K,) identifiers and (K, 3) ``T_reference_laser``; none of either where no reference
            has a pose.
        """
        return self._map.nearest(poses)

    @property
    def has_map(self) -> bool:
        """Whether there are references with poses that are searched as one map."""
        return len(self._map) > 0

    def check_room(self, poses: Iterable[Pose2D]) -> None:
        """See that references can be added at some poses ``T_set_laser``, before they are stored.

        Raises:
            AnchorscanError: They lie too far from the origin, or from the others.
        """
        if self.settings.method == "map":
            self._map.check_room(poses)

    def add(self, reference: Reference) -> None:
        """Add a reference; searches that have begun do without it.

        Raises:
            ValueError: The identifier is in use.
        """
        known = self._know(reference)
        with self._writing:
            if reference.identifier in self._map or reference.identifier in self._singles:
                raise ValueError(f"there is a reference {reference.identifier} already")
            (self._map if self._fits(reference) else self._singles).add(known)

    def remove(self, identifier: int) -> None:
        """Remove a reference.

        Raises:
            KeyError: There is no such reference.
        """
        with self._writing:
            (self._map if identifier in self._map else self._singles).remove(identifier)

    def prepare(self) -> None:
        """Compile and derive what a search needs, so that the first real scan does not pay for it.

        What references like these need, or, where there are none, what any could.  Once for an
        installation that takes one or two minutes, as long as numba's cache lasts.
        """
        places = Matcher((), self.settings)
        if self._map or not self._singles:
            places.add(Reference(0, _ROOM, Pose2D()))
        if self._singles or not self._map:
            places.add(Reference(1, _ROOM))
        for candidates in (1, "all"):
            for hypothesis in (trace := places.explain(_ROOM, candidates)).hypotheses[:1]:
                trace.evaluation(hypothesis)
        places.explain(_CORNERLESS)
        self.explain(_ROOM)  # what is derived from these references when they are first searched

    def _know(self, reference: Reference) -> Known:
        return Known(reference, describe(reference.scan, self.settings))

    def _fits(self, reference: Reference) -> bool:
        return self.settings.method == "map" and reference.pose is not None

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
        Hypotheses, best first; ``pose`` and ``pose_in_reference`` are both
        ``T_reference_scan``.
    """
    return Matcher((Reference(0, reference, Pose2D()),), settings).locate(scan)


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

# No anchor point, so that it may stand anywhere.
_CORNERLESS = LaserScan.from_field_of_view([2.0, 2.0, 2.0], math.radians(2.0))
