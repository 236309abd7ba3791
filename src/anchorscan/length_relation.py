"""Section 4.1: relations by length alone, the paper's sorted hash table.

The edges of all references are kept in order of length, with an index by length bin.  Edges
correspond when their lengths differ by no more than a tolerance, tested on the lengths
themselves, so that n_m is exact.

The paper leaves open what happens when an edge corresponds to several edges of the other
graph.  Read literally every correspondence counts (``count_once`` off): n_m is the number of
corresponding pairs, and q_m may exceed one.  With ``count_once`` every edge of either graph
counts at most once: n_m is the size of the largest one-to-one assignment by length, and
q_m is one exactly for graphs whose lengths agree throughout.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .graph import AnchorGraph
from .ranking import first_from

__all__ = ["EdgesByLength", "LengthRelation", "corresponding_lengths"]

# The length index: bins of 5 cm; edges beyond the last bin are in it, and still in order.
_BIN_WIDTH = 0.05
_BINS = 4096


@dataclass(frozen=True, eq=False)
class EdgesByLength:
    """Edges of references in order of length; never changed.

    Args:
        lengths: (E,) float32 metres, ascending.
        slots: (E,) int32, which reference.
        starts: (_BINS + 1,) where each length bin begins.
    """

    lengths: NDArray[np.float32]
    slots: NDArray[np.int32]
    starts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.lengths)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what a file has to hold."""
        return {"lengths": self.lengths, "slots": self.slots}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], slots: int) -> EdgesByLength:
        """Take what ``arrays`` gave, for so many slots; nothing is copied.

        Raises:
            ValueError: The arrays do not fit together.
        """
        lengths, owners = arrays.get("lengths"), arrays.get("slots")
        if lengths is None or owners is None:
            raise ValueError("arrays of edges are missing")
        if lengths.dtype != np.float32 or owners.dtype != np.int32 or lengths.ndim != 1:
            raise ValueError("arrays of edges are of another kind")
        if lengths.shape != owners.shape or not np.all(lengths[1:] >= lengths[:-1]):
            raise ValueError("arrays of edges do not fit together")
        if len(owners) and not 0 <= owners.min() <= owners.max() < slots:
            raise ValueError("arrays of edges do not fit together")
        return cls(lengths, owners, _starts(lengths))

    def merged(self, other: EdgesByLength) -> EdgesByLength:
        """Merge the edges of later slots into these."""
        at = np.searchsorted(self.lengths, other.lengths, side="right")
        return EdgesByLength(
            np.insert(self.lengths, at, other.lengths),
            np.insert(self.slots, at, other.slots),
            self.starts + other.starts,
        )

    def renumbered(self, numbers: NDArray[np.int32]) -> EdgesByLength:
        """Give slots new numbers; edges of slots whose number is negative are left out."""
        slots = numbers[self.slots]
        kept = slots >= 0
        before = np.zeros(len(kept) + 1, np.int64)
        np.cumsum(kept, out=before[1:])
        return EdgesByLength(self.lengths[kept], slots[kept], before[self.starts])


class LengthRelation:
    """Edges correspond by length.

    Args:
        tolerance: Largest difference of corresponding lengths, metres.
        count_once: Count an edge at most once.
    """

    def __init__(self, tolerance: float, count_once: bool) -> None:
        self._tolerance, self._count_once = tolerance, count_once
        self._scratch = threading.local()

    def edges(
        self, graphs: Iterable[AnchorGraph], first: int
    ) -> tuple[EdgesByLength, NDArray[np.int32]]:
        """Order the edges of references in slots from ``first`` on, and count them for each."""
        of_graphs = [_NO_LENGTHS, *(graph.lengths.astype(np.float32) for graph in graphs)]
        sizes = np.array([len(each) for each in of_graphs[1:]], np.int32)
        lengths = np.concatenate(of_graphs)
        slots = np.repeat(np.arange(first, first + len(sizes), dtype=np.int32), sizes)
        order = np.argsort(lengths, kind="stable")
        return EdgesByLength(lengths[order], slots[order], _starts(lengths)), sizes

    def part(self, arrays: Mapping[str, NDArray[Any]], slots: int) -> EdgesByLength:
        """Take edges of so many slots from arrays.

        Raises:
            ValueError: The arrays do not fit together.
        """
        return EdgesByLength.from_arrays(arrays, slots)

    def size(self, graph: AnchorGraph) -> int:
        """Return the number of edges of a graph."""
        return len(graph)

    def met(
        self,
        graph: AnchorGraph,
        parts: Sequence[EdgesByLength],
        used: int,
        alive: int,
        looks: int = 1,
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Count the corresponding edges, n_m, of those slots that have any.

        Every length occurs everywhere, so nearly all have.

        Args:
            graph: Of the scan that is looked for.
            parts: Edges of the references.
            used: Slots in use.
            alive: References among them that count; length alone takes no notice.
            looks: Into so many the work is divided; length alone takes no notice.

        Returns:
            (M,) slots and (M,) n_m.
        """
        counts, cursors = self._scratch_of(used)
        for part in parts:
            if len(part):
                arrays = (part.lengths, part.slots, part.starts)
                _count(graph.lengths, arrays, self._tolerance, counts, cursors)
        slots = np.flatnonzero(counts).astype(np.int32)
        return slots, counts[slots]

    def _scratch_of(self, used: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Return zeroed counters of this thread, so that a query allocates none."""
        counts = getattr(self._scratch, "counts", None)
        if counts is None or len(counts) < used:
            counts = np.empty(max(2 * used, 64), np.float32)
            cursors = np.empty(len(counts) if self._count_once else 0, np.int32)
            self._scratch.counts, self._scratch.cursors = counts, cursors
        counts, cursors = counts[:used], self._scratch.cursors[:used]
        counts.fill(0)
        cursors.fill(0)
        return counts, cursors


def _starts(lengths: NDArray[np.float32]) -> NDArray[np.int64]:
    """(_BINS + 1,) where each length bin begins once (E,) lengths are in order."""
    starts = np.zeros(_BINS + 1, np.int64)
    np.cumsum(np.bincount(_bins(lengths), minlength=_BINS), out=starts[1:])
    return starts


def _bins(lengths: NDArray[np.float32]) -> NDArray[np.int64]:
    """(E,) bin of each length, by the very expression that the kernel uses."""
    return np.minimum(lengths.astype(np.float64) / _BIN_WIDTH, _BINS - 1).astype(np.int64)


_NO_LENGTHS = np.empty(0, np.float32)


@kernel
def _first(lengths, starts, length):  # type: ignore[no-untyped-def]
    """Index of the first database edge that is not shorter."""
    if length <= 0.0:
        return np.int64(0)
    k = np.int64(min(length / _BIN_WIDTH, _BINS - 1.0))
    return first_from(lengths, starts[k], starts[k + 1], length)


@kernel
def _count(query, edges, tolerance, counts, cursors):  # type: ignore[no-untyped-def]
    """Count corresponding edges per slot; at most once each where there are ``cursors``.

    Both sides are in order of length, so the query edges that correspond to a database
    edge are a window that only moves on, and every database edge is looked at once.  For
    the one-to-one assignment ``cursors`` holds the first query edge not yet given away: to
    give every database edge the shortest free one within its window is optimal, because
    all windows are equally wide.
    """
    lengths, slots, starts = edges
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
def corresponding_lengths(query, lengths, tolerance, once):  # type: ignore[no-untyped-def]
    """Count corresponding edges of two graphs, both in order of length: n_m without a database."""
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
