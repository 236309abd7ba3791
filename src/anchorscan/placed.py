"""Beyond the paper: references of one map in lots, which are merged as they grow.

A *lot* is a number of references with what is derived from all of them together: landmarks, and
a grid that tells which reference was taken nearest to a pose.  A new reference is a lot of its
own; the last lots are merged when they have become of a size with the one before.  So a reader
keeps the lots that it has begun with, and adding costs little however many references there are.

Removing marks a reference in its lot.  Its landmarks may still propose poses until the lot is
made anew; the map, which has forgotten what the reference saw, refuses them.  Small lots are made
anew at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ._jit import inlined, kernel
from .anchors import AnchorKind, AnchorStack, stack_anchors
from .angle_function import wrapped
from .pairwise import Known
from .panorama import DIRECTIONS, panorama
from .proposal import Landmarks, ProposalSettings, related
from .reference import Reference

__all__ = ["Lot", "lot_of", "nearest", "tidied"]

# A lot is merged into the one before it once it is more than this share of that.
_MERGED_SHARE = 0.25
# Lots of no more references than this are one, and forget what is removed at once.
_SMALLEST = 24
# A lot is made anew when more than this share of its references are gone.
_GONE_SHARE = 0.25
# The grid: cells of so many metres, and so many of them around a pose before all are looked at.
_CELL = 4.0
_MOST_RINGS = 12
_FARTHEST = 1 << 30


class _Grid(NamedTuple):
    """(C,) occupied cells in order, (C + 1,) where their references begin, (N,) these."""

    cells: NDArray[np.int64]
    starts: NDArray[np.int64]
    order: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Lot:
    """References of a map with what is derived from them; only ``is_there`` ever changes.

    Args:
        identifiers: (N,) ascending.
        serials: (N,) a number that no other reference of the map ever had.
        poses: (N, 3) ``T_set_laser``.
        anchors: Their anchor points.
        panoramas: (N, 180) what they saw.
        references: The references themselves; None for those that are read when needed.
        is_there: (N,) False for those that were removed.
        settings: Of the landmarks.
    """

    identifiers: NDArray[np.int64]
    serials: NDArray[np.int64]
    poses: NDArray[np.float64]
    anchors: AnchorStack
    panoramas: NDArray[np.uint8]
    references: Sequence[Reference | None]
    is_there: NDArray[np.bool_]
    settings: ProposalSettings

    def __len__(self) -> int:
        return int(np.count_nonzero(self.is_there))

    @cached_property
    def landmarks(self) -> Landmarks:
        """Those of all its references."""
        return related(self.anchors, self.poses, self.settings)

    @cached_property
    def grid(self) -> _Grid:
        """Where its references were taken."""
        cells = _cells(self.poses)
        order = np.argsort(cells, kind="stable")
        occupied, starts = np.unique(cells[order], return_index=True)
        return _Grid(occupied, np.append(starts, len(cells)).astype(np.int64), order)

    def check(self) -> None:
        """See that stored references fit each other.

        Raises:
            ValueError: They do not.
        """
        count, anchors = len(self.identifiers), self.anchors
        found = len(anchors.kinds)
        if (
            np.any(np.diff(self.identifiers) <= 0)
            or self.poses.shape != (count, 3)
            or self.panoramas.shape != (count, DIRECTIONS)
            or not np.isfinite(self.poses).all()
            or anchors.main_angles.shape != (count,)
            or anchors.starts.shape != (count + 1,)
            or anchors.starts[0] != 0
            or anchors.starts[-1] != found
            or np.any(np.diff(anchors.starts) < 0)
            or anchors.positions.shape != (found, 2)
            or anchors.directions.shape != (found,)
            or (found and not 0 <= anchors.kinds.min() <= anchors.kinds.max() < len(AnchorKind))
        ):
            raise ValueError("the references do not fit their anchor points")

    def find(self, identifier: int) -> int | None:
        """Tell at which place a reference is, if it is there."""
        place = int(np.searchsorted(self.identifiers, identifier))
        if place == len(self.identifiers) or self.identifiers[place] != identifier:
            return None
        return place if self.is_there[place] else None

    def find_all(self, identifiers: NDArray[np.int64]) -> NDArray[np.int64]:
        """(K,) places of references, -1 for those that are not there."""
        if not len(self.identifiers):
            return np.full(len(identifiers), -1)
        places = np.searchsorted(self.identifiers, identifiers)
        places = np.minimum(places, len(self.identifiers) - 1)
        known = (self.identifiers[places] == identifiers) & self.is_there[places]
        return np.where(known, places, -1)

    def without(self, place: int) -> Lot:
        """Remove a reference: this lot, in which it is marked, or one made anew."""
        self.is_there[place] = False
        left = len(self)
        if left <= _SMALLEST or left < (1.0 - _GONE_SHARE) * len(self.identifiers):
            return self._kept()
        return self

    def followed_by(self, other: Lot) -> Lot:
        """Merge two lots."""
        ours, theirs = self._kept(), other._kept()
        identifiers = np.concatenate([ours.identifiers, theirs.identifiers])
        both = Lot(
            identifiers,
            np.concatenate([ours.serials, theirs.serials]),
            np.concatenate([ours.poses, theirs.poses]),
            ours.anchors.followed_by(theirs.anchors),
            np.concatenate([ours.panoramas, theirs.panoramas]),
            [*ours.references, *theirs.references],
            np.ones(len(identifiers), np.bool_),
            self.settings,
        )
        if np.all(identifiers[1:] > identifiers[:-1]):
            return both
        return both._some(np.argsort(identifiers))

    def _kept(self) -> Lot:
        """Return what is left."""
        return self if self.is_there.all() else self._some(np.flatnonzero(self.is_there))

    def _some(self, places: NDArray[np.int64]) -> Lot:
        return Lot(
            self.identifiers[places],
            self.serials[places],
            self.poses[places],
            self.anchors.of_some(places),
            self.panoramas[places],
            [self.references[place] for place in places.tolist()],
            self.is_there[places],
            self.settings,
        )


def lot_of(known: Iterable[Known], first: int, settings: ProposalSettings) -> Lot:
    """Make a lot of references that all have a pose.

    Args:
        known: The references and their descriptions.
        first: Serial number of the first one.
        settings: Of the landmarks.

    Raises:
        ValueError: One has no pose, or two have the same identifier.
    """
    references, anchors, poses, panoramas = [], [], [], []
    for each in known:
        if each.reference.pose is None:
            raise ValueError(f"reference {each.reference.identifier} has no pose")
        references.append(each.reference)
        anchors.append(each.description.anchors)
        panoramas.append(panorama(each.description.points, each.description.anchors.main_angle))
        poses.append(each.reference.pose.to_array())
    identifiers = np.array([each.identifier for each in references], np.int64)
    if len(np.unique(identifiers)) < len(identifiers):
        raise ValueError("two references have the same identifier")
    lot = Lot(
        identifiers,
        np.arange(first, first + len(identifiers)),
        np.array(poses, np.float64).reshape(-1, 3),
        stack_anchors(anchors),
        np.array(panoramas, np.uint8).reshape(-1, DIRECTIONS),
        references,
        np.ones(len(identifiers), np.bool_),
        settings,
    )
    if np.all(identifiers[1:] > identifiers[:-1]):
        return lot
    return lot._some(np.argsort(identifiers))


def tidied(lots: Sequence[Lot]) -> tuple[Lot, ...]:
    """Merge the last lots until each is much smaller than the one before it."""
    left = list(lots)
    while len(left) > 1:
        before, last = len(left[-2]), len(left[-1])
        if not last:  # merged, it would have all before it made anew
            left.pop()
            continue
        if before + last > _SMALLEST and last <= _MERGED_SHARE * before:
            break
        other = left.pop()
        merged = left[-1].followed_by(other)
        if "landmarks" in left[-1].__dict__ and before > _SMALLEST:
            _ = merged.landmarks  # made here, so that no search has to wait for it
        left[-1] = merged
    return tuple(left)


def nearest(
    lots: Sequence[Lot], poses: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Tell which reference was taken nearest to each of (K, 3) poses.

    A radian of turn counts as a metre; of equals it is the one of the lower identifier.

    Returns:
        (K,) its lot, or -1 where there is no reference at all, its place there, and (K, 3)
        ``T_reference_laser``.
    """
    found, costs = np.empty((len(poses), 2), np.int64), np.empty(len(poses))
    found.fill(-1)
    costs.fill(np.inf)
    relative = np.zeros((len(poses), 3))
    for number, lot in enumerate(lots):
        if len(lot.poses):
            known = (lot.poses, lot.is_there)
            _nearest(poses, number, known, lot.grid, found, costs, relative)
    return found[:, 0], found[:, 1], relative


def _cells(poses: NDArray[np.float64]) -> NDArray[np.int64]:
    """(N,) one integer for the cell of each pose."""
    cells = np.clip(np.floor(poses[:, :2] / _CELL), -_FARTHEST, _FARTHEST).astype(np.int64)
    return (cells[:, 0] << 32) + cells[:, 1]


@kernel
def _nearest(poses, number, known, grid, found, costs, relative):  # type: ignore[no-untyped-def]
    """Note the nearest reference of a lot where it is nearer than what was found before."""
    count = len(known[0])
    for p in range(len(poses)):
        x = np.int64(min(max(math.floor(poses[p, 0] / _CELL), -_FARTHEST), _FARTHEST))
        y = np.int64(min(max(math.floor(poses[p, 1] / _CELL), -_FARTHEST), _FARTHEST))
        done = False
        for ring in range(_MOST_RINGS):
            # Whatever lies in this ring and beyond is at least so far away.
            if costs[p] < (ring - 1) * _CELL:
                done = True
                break
            for i in range(-ring, ring + 1):
                step = 1 if abs(i) == ring else max(2 * ring, 1)
                for j in range(-ring, ring + 1, step):
                    key = ((x + i) << 32) + y + j
                    at = np.searchsorted(grid.cells, key)
                    if at == len(grid.cells) or grid.cells[at] != key:
                        continue
                    for k in range(grid.starts[at], grid.starts[at + 1]):
                        _compare(p, poses, number, known, grid.order[k], found, costs, relative)
        if not done:
            for k in range(count):
                _compare(p, poses, number, known, k, found, costs, relative)


@inlined
def _compare(p, poses, number, known, k, found, costs, relative):  # type: ignore[no-untyped-def]
    """Note a reference for a pose where it is nearer than what was found before."""
    references, is_there = known
    if not is_there[k]:
        return
    dx, dy = poses[p, 0] - references[k, 0], poses[p, 1] - references[k, 1]
    cost = math.hypot(dx, dy)
    if cost > costs[p]:
        return
    cost += abs(wrapped(references[k, 2] - poses[p, 2]))
    if cost > costs[p] or (cost == costs[p] and found[p, 0] == number and found[p, 1] <= k):
        return
    costs[p] = cost
    found[p, 0], found[p, 1] = number, k
    c, s = math.cos(references[k, 2]), math.sin(references[k, 2])
    relative[p, 0] = c * dx + s * dy
    relative[p, 1] = c * dy - s * dx
    relative[p, 2] = wrapped(poses[p, 2] - references[k, 2])
