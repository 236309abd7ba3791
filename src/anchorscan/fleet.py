"""Which building is this?  One scan asked of many sets, and one decision over all of them.

Section 1 of the paper asks where a robot is in one building.  A fleet knows many, and a robot that
was just switched on may be in any.  Every set is searched by itself, and what is left of the fits
of all sets is put in one order and decided **once** (see ``decision.py``): the rival that the
best fit must beat is then the best fit at any other place of any building.  A thousand
buildings hold more look-alikes than one, so the margin to that rival shrinks by itself, and
with it the probability.

What the margin does not see: a set that does not hold the place is one more chance for an accident
that fits better than the right place does.  The logistic of the decision therefore loses
``look_alikes * log(N)`` with N sets: with ``look_alikes`` = 1 the odds would fall as 1 / N, as if
every set brought an accident of its own and the margin told nothing; 0 trusts the margin alone.
``anchorscan bench-fleet`` measures which is right; what it gave stands on the page "A fleet".

Two buildings may be the same, floors of one hotel for instance.  The decision knows twins; here,
where they are likelier than within one building, it takes them to differ by ``TWINS``.

A part of the sets can be searched elsewhere (``spread_fleet.py``): ``search`` gives values, and
``decide_over`` joins them, in any order of the parts, to the same answer.

The scan is described once for all sets, and references are named for the few fits that are left
of all sets together: done for each set, both took as long as the searches themselves.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .decision import Decision, DecisionSettings, decide, worths
from .description import Description, describe
from .errors import ReferenceSetError, SettingsError
from .hypothesis import Hypothesis
from .reference_set import ReferenceSet
from .scan import LaserScan
from .verification import Fits

if TYPE_CHECKING:
    from .settings import Settings

__all__ = [
    "LOOK_ALIKES",
    "TWINS",
    "BuildingFits",
    "BuildingHypothesis",
    "BuildingPlace",
    "Fleet",
    "decide_over",
    "ranked",
    "search",
    "set_files",
]

LOOK_ALIKES = 0.2
"""How fast the odds fall with the number of sets, beyond the margin; fitted on simulated scans."""

TWINS = 0.018
"""Root mean square of the difference of a scan's scores in two equal, simulated buildings."""

_SUFFIX = ".apr"


@dataclass(frozen=True, eq=False)
class BuildingFits:
    """What the search of one set found.

    Args:
        building: Name of the set.
        anchors: How many anchor points the scan has.
        fits: Of the highest worth first, as many as one set has hypotheses.
        upside_down: Highest score of the mirror image of the scan, where that is asked.
    """

    building: str
    anchors: int
    fits: Fits
    upside_down: float = -math.inf


@dataclass(frozen=True, eq=False)
class BuildingPlace:
    """A fit among those of all sets.

    Args:
        building: Name of the set.
        fit: Of length one.
        probability: Knows of all sets.
        accepted: Whether it is an answer.
        ambiguous: Whether it is one of several places that explain the scan alike.
    """

    building: str
    fit: Fits
    probability: float
    accepted: bool
    ambiguous: bool


@dataclass(frozen=True, eq=False)
class BuildingHypothesis:
    """One possible place of a scan among all buildings.

    Args:
        building: Name of the set.
        hypothesis: The place in that set; ``probability``, ``accepted`` and ``ambiguous`` know of
            all sets.
    """

    building: str
    hypothesis: Hypothesis


class Fleet:
    """Named reference sets that are asked together.

    Args:
        sets: By name; all with poses in every reference, and with the same settings, since
            scores of different settings cannot be compared.

    Raises:
        ReferenceSetError: A set has references without a pose, or there is no set.
        SettingsError: Two sets have different settings.
    """

    def __init__(self, sets: Mapping[str, ReferenceSet]) -> None:
        self._sets = dict(sets)
        if not self._sets:
            raise ReferenceSetError("a fleet needs a set")
        first = next(iter(self._sets))
        self.settings: Settings = self._sets[first].settings
        if self.settings.method != "map":
            raise SettingsError("many sets are asked together by the method 'map' only")
        for name, places in self._sets.items():
            if places.settings != self.settings:
                raise SettingsError(
                    f"the sets {first} and {name} have different settings: "
                    "give the same to all, for instance by a preset"
                )
            if not places.has_poses:
                raise ReferenceSetError(
                    f"{name}: has references without a pose, which have no common map to ask"
                )

    @classmethod
    def open(
        cls, paths: Iterable[str | os.PathLike[str]], *, settings: Settings | None = None
    ) -> Fleet:
        """Open sets, each named by its file without ``.apr``; of a folder, all of its sets.

        Args:
            paths: Files and folders.
            settings: Settings to use instead of those in the files.

        Raises:
            ReferenceSetError: A set cannot be opened, two have the same name, or a folder has
                none.
            SettingsError: Two sets have different settings.
        """
        return cls(
            {
                name: ReferenceSet.open(path, settings=settings)
                for name, path in set_files(paths).items()
            }
        )

    def __len__(self) -> int:
        return len(self._sets)

    @property
    def sets(self) -> dict[str, ReferenceSet]:
        """The sets by name."""
        return dict(self._sets)

    def prepare(self) -> None:
        """Do now what the first query would wait for: derive every index, compile kernels."""
        for number, places in enumerate(self._sets.values()):
            if not number:
                places.prepare()
            places.nearest(np.zeros((1, 3)))  # derives the index of this set

    def locate(self, scan: LaserScan) -> list[BuildingHypothesis]:
        """Find in which building, and where in it, a scan may have been taken.

        Args:
            scan: From any sensor, in the frame of its laser.

        Returns:
            Hypotheses of all buildings, best first; none only for an unusable scan or from
            empty sets.
        """
        description = describe(scan, self.settings)
        found = list(search(self._sets.items(), description))
        places = decide_over(found, len(self), self.settings.decision)
        return list(chain.from_iterable(self.named(place, description) for place in places))

    def named(self, place: BuildingPlace, description: Description) -> Iterator[BuildingHypothesis]:
        """Name the reference of a place; nothing, if its set has lost all of them meanwhile.

        Args:
            place: In one of the sets.
            description: Of the scan, with the settings of the sets.
        """
        worth = np.array([place.probability])
        alike = 1 if place.accepted else 2 * place.ambiguous
        decision = Decision(worth, 1.0 - place.probability, alike)
        for found in self._sets[place.building].hypotheses(description, place.fit, decision):
            yield BuildingHypothesis(place.building, found)


def search(
    sets: Iterable[tuple[str, ReferenceSet]], description: Description
) -> Iterator[BuildingFits]:
    """Search every set by itself; a set without a fit, either way, is passed over.

    Args:
        sets: Names and sets.
        description: Of the scan, with the settings of the sets.
    """
    if not len(description.readings):
        return
    anchors, upside_down = len(description.anchors), None
    for name, places in sets:
        fits, settings = places.fits(description), places.settings
        if fits is None:
            continue
        highest = -math.inf
        if settings.decision.both_ways:
            upside_down = upside_down or describe(description.scan.upside_down(), settings)
            others = places.fits(upside_down)
            highest = -math.inf if others is None else others.highest_score
        if len(fits) or highest > -math.inf:
            yield BuildingFits(name, anchors, fits[: settings.acceptance.hypotheses], highest)


def decide_over(
    found: Sequence[BuildingFits],
    sets: int,
    settings: DecisionSettings,
    look_alikes: float = LOOK_ALIKES,
    twins: float = TWINS,
) -> list[BuildingPlace]:
    """Put what many sets found for one scan into one order, and decide once.

    Args:
        found: What the sets found, in any order.
        sets: How many sets were asked, those without a fit as well.
        settings: Of the decision.
        look_alikes: How fast the odds fall with the number of sets.
        twins: How far the scores of equal buildings lie apart.

    Returns:
        Places in all buildings, best first, as many as one set gives at most.
    """
    if not any(len(each.fits) for each in found):
        return []
    best, fits = ranked(found)
    harder = settings.constant - look_alikes * math.log(max(sets, 1))
    anchors = best[0][0].anchors
    stricter = settings.model_copy(update={"constant": harder, "twins": twins})
    decision = decide(fits, anchors, stricter, max(each.upside_down for each in found))
    return [
        BuildingPlace(
            each.building,
            fits[rank : rank + 1],
            float(decision.probabilities[rank]),
            decision.accepted and rank == 0,
            decision.is_ambiguous(rank),
        )
        for rank, (each, _) in enumerate(best)
    ]


def ranked(found: Sequence[BuildingFits]) -> tuple[list[tuple[BuildingFits, int]], Fits]:
    """Put the fits of many sets into one order, of the highest worth first.

    Returns:
        For each of the best, as many as one set has at most, its set and its number there; and
        the fits themselves.
    """
    most = max(len(each.fits) for each in found)
    order = [
        (-worth, each.building, place, n)
        for place, each in enumerate(found)
        for n, worth in enumerate(worths(each.fits).tolist())
    ]
    best = [(found[place], n) for _, _, place, n in sorted(order)[:most]]
    return best, _joined([each.fits[n : n + 1] for each, n in best])


def set_files(paths: Iterable[str | os.PathLike[str]]) -> dict[str, Path]:
    """Return the files of sets by their names; of a folder, all that end in ``.apr``.

    Raises:
        ReferenceSetError: A folder has none, or two have the same name.
    """
    files: dict[str, Path] = {}
    for path in map(Path, paths):
        within = sorted(path.glob(f"*{_SUFFIX}")) if path.is_dir() else [path]
        if not within:
            raise ReferenceSetError(f"{path}: has no set: no file that ends in {_SUFFIX}")
        for file in within:
            name = file.name.removesuffix(_SUFFIX)
            if name in files:
                raise ReferenceSetError(f"{file}: there is another set with the name {name}")
            files[name] = file
    return files


def _joined(parts: Sequence[Fits]) -> Fits:
    return Fits(
        np.concatenate([part.poses for part in parts]),
        np.concatenate([part.features for part in parts]),
        np.concatenate([part.hessians for part in parts]),
        np.concatenate([part.residuals for part in parts]),
        parts[0].readings,
    )
