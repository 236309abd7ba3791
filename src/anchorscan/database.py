"""Section 4.1: the relationship database and the preselection of candidates.

The database holds the edges of all reference graphs, ordered by length, each with the
reference that it belongs to.  The edges of a new graph are looked up by their length, and
for every database edge that corresponds a counter of its reference goes up.  With ``n_m``
the count of reference *m*, ``r`` the edges of the new graph and ``s`` those of the
reference, the quality measure is

    q_m = n_m ** 2 / (r * s).

The paper's sorted hash table is a sorted array with an index by length bin.  It consists of
a large main part and a small recent part, both never changed once made: adding merges into
the recent part and now and then the recent part into the main part, removing marks the
reference and leaves its edges until the next merge.  So a reader keeps what it has begun
with, and writing costs little.

The paper leaves open what happens when an edge corresponds to several edges of the other
graph.  Read literally every correspondence counts (``count_once`` off): n_m is the number of
corresponding pairs, and q_m may exceed one.  With ``count_once`` every edge of either graph
counts at most once: n_m is the size of the largest one-to-one assignment by length, and
q_m is one exactly for graphs whose lengths agree throughout.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .graph import AnchorGraph

__all__ = ["DatabaseSettings", "RelationshipDatabase", "Votes", "quality"]

# The length index: bins of 5 cm; edges beyond the last bin are in it, and still in order.
_BIN_WIDTH = 0.05
_BINS = 4096
# The recent part may grow to the root of this many times the edges of the main part, which
# balances what an addition costs by itself and by its share of the next merge.
_RECENT_SHARE = 64
_SMALLEST_RECENT = 4096
# Up to so many the best are picked in one pass; beyond, all are sorted.
_FEW = 64

Number = TypeVar("Number", np.int32, np.int64)


class DatabaseSettings(BaseModel):
    """Settings of the preselection of section 4.1."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    length_tolerance: float = Field(
        0.1, gt=0.0, description="edges correspond when their lengths differ no more, metres"
    )
    count_once: bool = Field(
        False, description="count an edge at most once, not once for every correspondence"
    )
    candidates: int | None = Field(
        None, ge=1, description="references that are followed further; null for all"
    )


@dataclass(frozen=True, eq=False)
class Votes:
    """How well references correspond to a graph by the lengths of their edges.

    Args:
        references: (K,) identifiers, highest quality first; equals by identifier.
        counts: (K,) n_m, corresponding edges.
        quality: (K,) q_m.
    """

    references: NDArray[np.int64]
    counts: NDArray[np.int64]
    quality: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.references)


@dataclass(frozen=True, eq=False)
class _Part:
    """Edges in order of length; never changed.

    Args:
        lengths: (E,) float32 metres, ascending.
        slots: (E,) int32, which reference.
        starts: (_BINS + 1,) where each length bin begins.
    """

    lengths: NDArray[np.float32]
    slots: NDArray[np.int32]
    starts: NDArray[np.int64]

    @classmethod
    def of(cls, lengths: NDArray[np.float32], slots: NDArray[np.int32]) -> _Part:
        """Order edges by length."""
        order = np.argsort(lengths, kind="stable")
        starts = np.zeros(_BINS + 1, np.int64)
        np.cumsum(np.bincount(_bins(lengths), minlength=_BINS), out=starts[1:])
        return cls(lengths[order], slots[order], starts)

    def merged(self, other: _Part) -> _Part:
        """Merge a smaller part into this one."""
        at = np.searchsorted(self.lengths, other.lengths, side="right")
        return _Part(
            np.insert(self.lengths, at, other.lengths),
            np.insert(self.slots, at, other.slots),
            self.starts + other.starts,
        )

    def renumbered(self, alive: NDArray[np.bool_]) -> _Part:
        """Leave out the edges of dead slots and count the living from zero."""
        kept = alive[self.slots]
        before = np.zeros(len(kept) + 1, np.int64)
        np.cumsum(kept, out=before[1:])
        numbers = np.cumsum(alive, dtype=np.int32) - np.int32(1)
        return _Part(self.lengths[kept], numbers[self.slots[kept]], before[self.starts])


@dataclass(frozen=True, eq=False)
class _State:
    """Everything that a reader needs, replaced as a whole by a writer.

    Args:
        main: The large part.
        recent: The small part.
        identifiers: (capacity,) of the reference in every slot.
        sizes: (capacity,) edges of the reference in every slot; -1 for a removed one.
        used: Slots in use.
    """

    main: _Part
    recent: _Part
    identifiers: NDArray[np.int64]
    sizes: NDArray[np.int32]
    used: int


class RelationshipDatabase:
    """All edges of all references, ordered by length; searched by many, changed by one at a time.

    Args:
        settings: Of the preselection.
        graphs: Identifier and graph of the references to begin with.
    """

    def __init__(
        self, settings: DatabaseSettings, graphs: Iterable[tuple[int, AnchorGraph]] = ()
    ) -> None:
        self._settings = settings
        self._writing = threading.Lock()
        self._scratch = threading.local()
        self._removed = 0
        begin = list(graphs)
        identifiers = np.array([identifier for identifier, _ in begin], np.int64)
        sizes = np.array([len(graph) for _, graph in begin], np.int32)
        self._slots = {int(identifier): slot for slot, identifier in enumerate(identifiers)}
        if len(self._slots) != len(begin):
            raise ValueError("two references have the same identifier")
        lengths = np.concatenate([_NO_LENGTHS, *(graph.lengths for _, graph in begin)])
        main = _Part.of(
            lengths.astype(np.float32), np.repeat(np.arange(len(begin), dtype=np.int32), sizes)
        )
        self._state = _State(main, _EMPTY, identifiers, sizes, len(begin))

    def __len__(self) -> int:
        return len(self._slots)

    def __contains__(self, identifier: int) -> bool:
        return identifier in self._slots

    def add(self, identifier: int, graph: AnchorGraph) -> None:
        """Add a reference while others search.

        Raises:
            ValueError: The identifier is in use.
        """
        with self._writing:
            if identifier in self._slots:
                raise ValueError(f"reference {identifier} is in the database already")
            state = self._state
            slot = state.used
            identifiers = _with_room(state.identifiers, slot)
            sizes = _with_room(state.sizes, slot)
            identifiers[slot] = identifier
            sizes[slot] = len(graph)
            lengths = graph.lengths.astype(np.float32)
            edges = _Part.of(lengths, np.full(len(lengths), slot, np.int32))
            recent = state.recent.merged(edges)
            self._slots[identifier] = slot
            self._state = _State(state.main, recent, identifiers, sizes, slot + 1)
            share = math.isqrt(_RECENT_SHARE * len(state.main.lengths))
            if len(recent.lengths) > max(_SMALLEST_RECENT, share):
                self._merge()

    def remove(self, identifier: int) -> None:
        """Remove a reference while others search.

        Raises:
            KeyError: There is no such reference.
        """
        with self._writing:
            slot = self._slots.pop(identifier)
            state = self._state
            self._removed += max(int(state.sizes[slot]), 1)
            state.sizes[slot] = -1
            if 2 * self._removed > len(state.main.lengths) + len(state.recent.lengths):
                self._merge()

    def votes(self, graph: AnchorGraph, most: int | None = None) -> Votes:
        """Count corresponding edges and compute the quality measure (section 4.1).

        Args:
            graph: Of the scan that is looked for.
            most: How many references to return; None for all.
        """
        state = self._state
        counts, cursors = self._scratch_of(state.used)
        for part in (state.main, state.recent):
            if len(part.lengths):
                _count(
                    graph.lengths,
                    part.lengths,
                    part.slots,
                    part.starts,
                    self._settings.length_tolerance,
                    counts,
                    cursors,
                )
        sizes, identifiers = state.sizes[: state.used], state.identifiers[: state.used]
        if most is None or most > _FEW:
            return Votes(*_in_order(counts, sizes, identifiers, len(graph), most))
        return Votes(*_best(counts, sizes, identifiers, len(graph), min(most, state.used)))

    def _scratch_of(self, used: int) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Return zeroed counters of this thread, so that a query allocates none."""
        counts = getattr(self._scratch, "counts", None)
        if counts is None or len(counts) < used:
            counts = np.empty(max(2 * used, 64), np.int64)
            cursors = np.empty(len(counts) if self._settings.count_once else 0, np.int32)
            self._scratch.counts, self._scratch.cursors = counts, cursors
        counts, cursors = counts[:used], self._scratch.cursors[:used]
        counts.fill(0)
        cursors.fill(0)
        return counts, cursors

    def _merge(self) -> None:
        """Put both parts into a new main part and forget what was removed."""
        state = self._state
        main, recent, used = state.main, state.recent, state.used
        identifiers, sizes = state.identifiers, state.sizes
        if self._removed:
            alive = sizes[:used] >= 0
            main, recent = main.renumbered(alive), recent.renumbered(alive)
            identifiers, sizes = identifiers[:used][alive], sizes[:used][alive]
            used = len(identifiers)
            self._slots = {identifier: slot for slot, identifier in enumerate(identifiers.tolist())}
            self._removed = 0
        self._state = _State(main.merged(recent), _EMPTY, identifiers, sizes, used)


def quality(graph: AnchorGraph, other: AnchorGraph, settings: DatabaseSettings) -> float:
    """Compute q_m of two graphs without a database (section 4.1)."""
    pairs = float(len(graph)) * len(other)
    if not pairs:
        return 0.0
    count = _count_pair(
        graph.lengths, other.lengths, settings.length_tolerance, settings.count_once
    )
    return float(count) ** 2 / pairs


def _bins(lengths: NDArray[np.float32]) -> NDArray[np.int64]:
    """(E,) bin of each length, by the very expression that the kernel uses."""
    return np.minimum(lengths.astype(np.float64) / _BIN_WIDTH, _BINS - 1).astype(np.int64)


def _in_order(
    counts: NDArray[np.int64],
    sizes: NDArray[np.int32],
    identifiers: NDArray[np.int64],
    edges: int,
    most: int | None,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Order all slots by quality: what ``_best`` does, where many are wanted."""
    alive = np.flatnonzero(sizes >= 0)
    counts, identifiers = counts[alive], identifiers[alive]
    pairs = float(edges) * sizes[alive]
    quality = np.divide(
        counts.astype(np.float64) ** 2, pairs, out=np.zeros(len(alive)), where=pairs > 0
    )
    order = np.lexsort((identifiers, -quality))[:most]
    return identifiers[order], counts[order], quality[order]


def _with_room(values: NDArray[Number], slot: int) -> NDArray[Number]:
    """Return the array, or a longer copy when it has no place for one more."""
    if slot < len(values):
        return values
    longer = np.zeros(max(2 * len(values), 64), values.dtype)
    longer[: len(values)] = values
    return longer


_NO_LENGTHS = np.empty(0)
_EMPTY = _Part.of(np.empty(0, np.float32), np.empty(0, np.int32))


@kernel
def _first(lengths, starts, length):  # type: ignore[no-untyped-def]
    """Index of the first database edge that is not shorter."""
    if length <= 0.0:
        return np.int64(0)
    k = np.int64(min(length / _BIN_WIDTH, _BINS - 1.0))
    low, high = starts[k], starts[k + 1]
    while low < high:
        middle = (low + high) // 2
        if lengths[middle] < length:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def _count(query, lengths, slots, starts, tolerance, counts, cursors):  # type: ignore[no-untyped-def]
    """Count corresponding edges per slot; at most once each where there are ``cursors``.

    Both sides are in order of length, so the query edges that correspond to a database
    edge are a window that only moves on, and every database edge is looked at once.  For
    the one-to-one assignment ``cursors`` holds the first query edge not yet given away: to
    give every database edge the shortest free one within its window is optimal, because
    all windows are equally wide.
    """
    size = len(query)
    once = len(cursors) > 0
    low = 0
    high = 0
    at = np.int64(0)
    while low < size:
        at = max(at, _first(lengths, starts, query[low] - tolerance))
        while at < len(lengths):
            length = np.float64(lengths[at])
            while high < size and query[high] - length <= tolerance:
                high += 1
            while low < size and length - query[low] > tolerance:
                low += 1
            if low >= high:
                # Between two windows; the edge itself is passed over where rounding put
                # it at the very border of the next one.
                if low < size and query[low] - tolerance <= length:
                    at += 1
                break
            slot = slots[at]
            if not once:
                counts[slot] += high - low
            else:
                free = max(int(cursors[slot]), low)
                if free < high:
                    counts[slot] += 1
                    cursors[slot] = free + 1
            at += 1
        if at >= len(lengths):
            break


@kernel
def _count_pair(query, lengths, tolerance, once):  # type: ignore[no-untyped-def]
    """Corresponding edges of two graphs, both in order of length."""
    count = 0
    low = 0
    high = 0
    free = 0
    for length in lengths:
        # As the database keeps it.
        at = np.float64(np.float32(length))
        while high < len(query) and query[high] - at <= tolerance:
            high += 1
        while low < len(query) and at - query[low] > tolerance:
            low += 1
        if not once:
            count += high - low
        elif max(free, low) < high:
            free = max(free, low) + 1
            count += 1
    return count


@kernel
def _best(counts, sizes, identifiers, edges, most):  # type: ignore[no-untyped-def]
    """The ``most`` slots of highest quality: identifiers, counts and qualities, in order."""
    alive = 0
    for slot in range(len(sizes)):
        if sizes[slot] >= 0:
            alive += 1
    most = min(most, alive)
    quality = np.empty(most)
    chosen = np.empty(most, np.int64)
    found = 0
    for slot in range(len(sizes)):
        if sizes[slot] < 0 or most == 0:
            continue
        pairs = np.float64(edges) * sizes[slot]
        q = np.float64(counts[slot]) ** 2 / pairs if pairs > 0.0 else 0.0
        if found == most:
            worst = chosen[found - 1]
            if q < quality[found - 1] or (
                q == quality[found - 1] and identifiers[slot] > identifiers[worst]
            ):
                continue
            found -= 1
        k = found
        while k > 0 and (
            quality[k - 1] < q
            or (quality[k - 1] == q and identifiers[chosen[k - 1]] > identifiers[slot])
        ):
            quality[k] = quality[k - 1]
            chosen[k] = chosen[k - 1]
            k -= 1
        quality[k] = q
        chosen[k] = slot
        found += 1
    return identifiers[chosen], counts[chosen], quality
