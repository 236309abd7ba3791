"""Many sets, a share of them held by each worker of a cluster: which building is this?

Every worker opens its share once, finds for a scan what its sets have (``fleet.search``), and names
the references of those places that are left when all shares have been joined.  So the answers are
those of one process that holds all sets, to the last bit.  A share whose worker has died is opened
by another one.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice, tee
from pathlib import Path
from typing import TypeVar

from .cluster import Spread
from .description import describe
from .errors import ReferenceSetError, SettingsError
from .fleet import (
    BuildingFits,
    BuildingHypothesis,
    BuildingPlace,
    Fleet,
    decide_over,
    search,
    set_files,
)
from .scan import LaserScan
from .settings import Settings

__all__ = ["SpreadFleet"]

Item = TypeVar("Item")
_Scans = Sequence[LaserScan]
_Recipe = tuple[tuple[Path, ...], Settings | None]

# Scans that workers are asked at once: a question costs its way there and back.
_TOGETHER = 32


class SpreadFleet:
    """Named reference sets, as files that every worker can read, asked together.

    Args:
        paths: Files and folders; of a folder, all of its sets.
        spread: Who holds them.
        settings: Settings to use instead of those in the files.

    Raises:
        ReferenceSetError: Two sets have the same name, or a folder has none.
        SettingsError: Two workers have sets of different settings.
        AnchorscanError: A worker cannot open its sets, or ask them together.
    """

    def __init__(
        self,
        paths: Iterable[str | os.PathLike[str]],
        spread: Spread,
        settings: Settings | None = None,
    ) -> None:
        files = [path.absolute() for path in set_files(paths).values()]
        if not files:
            raise ReferenceSetError("a fleet needs a set")
        count = min(max(spread.workers, 1), len(files))
        recipes = [(tuple(files[start::count]), settings) for start in range(count)]
        self._sets = len(files)
        self._spread = spread
        self._shares = spread.hold(_opened, recipes)
        (told,) = spread.ask(_settings, self._shares, [None])
        self._settings = told[0]
        if any(each != self._settings for each in told):
            raise SettingsError("the sets have different settings: give the same to all")

    def __len__(self) -> int:
        return self._sets

    def locate_all(self, scans: Iterable[LaserScan]) -> Iterator[list[BuildingHypothesis]]:
        """Find in which building, and where in it, each scan may have been taken.

        Args:
            scans: From any sensor, in the frame of its laser.

        Yields:
            What ``Fleet.locate`` returns, in the order of the scans.

        Raises:
            AnchorscanError: The same scans ended several workers.
        """
        asked, named = tee(_parts(scans, _TOGETHER if self._spread.workers else 1))
        found = self._spread.ask(_searched, self._shares, asked)
        decided = zip(named, map(self._decided, found), strict=True)
        for parts in self._spread.ask(_named, self._shares, decided):
            for by_share in zip(*parts, strict=True):
                ranks = sorted(chain.from_iterable(by_share), key=lambda each: each[0])
                yield [hypothesis for _, hypothesis in ranks]

    def _decided(self, found: list[list[list[BuildingFits]]]) -> list[list[BuildingPlace]]:
        """Decide for each of some scans over all shares."""
        joined = (list(chain.from_iterable(by_share)) for by_share in zip(*found, strict=True))
        return [decide_over(each, self._sets, self._settings.decision) for each in joined]


def _opened(recipe: _Recipe) -> Fleet:
    files, settings = recipe
    fleet = Fleet.open(files, settings=settings)
    fleet.prepare()
    return fleet


def _settings(share: Fleet, _: None) -> Settings:
    return share.settings


def _searched(share: Fleet, scans: _Scans) -> list[list[BuildingFits]]:
    return [list(search(share.sets.items(), describe(scan, share.settings))) for scan in scans]


def _named(
    share: Fleet, question: tuple[_Scans, list[list[BuildingPlace]]]
) -> list[list[tuple[int, BuildingHypothesis]]]:
    """Name those places that are in sets of this share, each with its rank."""
    sets = share.sets
    answers: list[list[tuple[int, BuildingHypothesis]]] = []
    for scan, places in zip(*question, strict=True):
        ours = [(rank, place) for rank, place in enumerate(places) if place.building in sets]
        if not ours:
            answers.append([])
            continue
        description = describe(scan, share.settings)
        answers.append(
            [(rank, found) for rank, place in ours for found in share.named(place, description)]
        )
    return answers


def _parts(items: Iterable[Item], size: int) -> Iterator[tuple[Item, ...]]:
    """Yield items in groups of a size, the last one as it comes."""
    rest = iter(items)
    while part := tuple(islice(rest, size)):
        yield part
