"""Section 4.1 taken further: relations that carry more than a length.

The paper's database knows an edge by its length alone, and every length occurs everywhere:
among a hundred references the right one hardly stands out.  Here an edge carries what else
does not depend on where the scan was taken from:

* the kinds of the anchor points at both ends,
* the edge as a vector in the frame of the main walls, in square cells, instead of its length,
* the direction of the free space at both ends in the same frame, in eighths of a turn.

The frame of the main walls is known up to quarter turns.  So every edge is turned until it
lies in the first quadrant, which gives one integer *key*; the quarter turns that this took are
kept with the edge.  A pair of corresponding edges thereby tells how the two scans are turned
against each other, as the paper's matching angle histogram does (section 4.2): a reference has
four counters, one for each quarter turn, and its n_m is the largest.

A correspondence counts with the rarity of its key, ``log(1 + N / df) / log(1 + N)`` for a key
that occurs ``df`` times among N references, times the share of the cell that lies within the
tolerance of the new edge; a correspondence near the border of the tolerance counts little
instead of flipping between one and nothing.  The quality q_m is the paper's.

References with very many edges keep a sample: those whose keys have the smallest hash, so that
all references keep the same keys, and what two of them have in common is sampled, too.

``docs/scale.md`` has the measurements behind this and behind the defaults.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .anchors import AnchorKind
from .graph import AnchorGraph

__all__ = ["EdgesByKey", "OrientedRelation", "OrientedSettings"]

_KINDS = len(AnchorKind)
_SECTORS = 8
_QUARTER = _SECTORS // 4
# A posting is the slot of a reference and the quarter turns of the edge.
_TURNS = 4
_TURN_BITS = 2
# Tallies are 16-bit integers: a sum of weights that does not depend on their order.
_TALLY_BITS = 16
_FULL = (1 << _TALLY_BITS) - 1
_FINEST_UNIT = 256
_EXPECTED_TOTAL = 30_000
# Slots that are counted together: their tallies are half of what a processor holds close by.
_BLOCK_BITS = 15
_BLOCK = 1 << _BLOCK_BITS
_NO_BLOCK = np.uint32(0xFFFFFFFF)
# References whose edges are put together at once.
_AT_ONCE = 4096
# Keys of a part per entry of its table of contents, about.
_KEYS_PER_ENTRY = 64


class OrientedSettings(BaseModel):
    """Settings of oriented relations."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    cell: float = Field(0.2, ge=0.02, description="width of the cells of edge vectors, metres")
    position_tolerance: float = Field(
        0.16, gt=0.0, le=1.0, description="corresponding edge vectors, per axis, metres"
    )
    direction_tolerance: float = Field(
        math.radians(13.5), ge=0.0, description="free space at an anchor to its sector, radians"
    )
    shortest_edge: float = Field(1.0, ge=0.0, description="edges that are used, metres")
    longest_edge: float = Field(25.0, gt=0.0, le=30.0, description="edges that are used, metres")
    most_edges: int = Field(256, ge=1, description="edges that are kept of one reference")
    most_votes: int = Field(
        300_000, ge=1, description="database edges looked at; the commonest keys go first"
    )
    most_opening: int = Field(
        120_000, ge=1, description="the rarest ones; others count for references that these met"
    )


@dataclass(frozen=True, eq=False)
class EdgesByKey:
    """Edges of references in order of their keys; never changed.

    Args:
        keys: (K,) uint32, ascending.
        starts: (K + 1,) uint32, where the postings of each key begin.
        postings: (E,) uint32, slot of the reference and quarter turns, ascending for each key.
    """

    keys: NDArray[np.uint32]
    starts: NDArray[np.uint32]
    postings: NDArray[np.uint32]

    def __post_init__(self) -> None:
        # A table of contents, so that a look-up touches little of a large part.
        entries = 1
        while entries * _KEYS_PER_ENTRY < len(self.keys):
            entries *= 2
        shift = (int(self.keys[-1]) if len(self.keys) else 0).bit_length()
        shift = max(shift - entries.bit_length() + 1, 0)
        firsts = np.arange(2 * entries + 1, dtype=np.uint64) << np.uint64(shift)
        contents = np.searchsorted(self.keys, firsts).astype(np.uint32)
        object.__setattr__(self, "_shift", shift)
        object.__setattr__(self, "_contents", contents)

    @classmethod
    def of(cls, keys: NDArray[np.uint32], postings: NDArray[np.uint32]) -> EdgesByKey:
        """Order (E,) keys and their postings."""
        rows = keys.astype(np.uint64) << np.uint64(32)
        rows |= postings
        rows.sort()
        ordered = (rows >> np.uint64(32)).astype(np.uint32)
        begins = np.flatnonzero(np.diff(ordered, prepend=ordered[:1] + np.uint32(1)))
        return cls(
            ordered[begins],
            np.append(begins, len(ordered)).astype(np.uint32),
            (rows & np.uint64(0xFFFFFFFF)).astype(np.uint32),
        )

    def __len__(self) -> int:
        return len(self.postings)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what a file has to hold."""
        return {"keys": self.keys, "starts": self.starts, "postings": self.postings}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], slots: int) -> EdgesByKey:
        """Take what ``arrays`` gave, for so many slots; nothing is copied.

        Raises:
            ValueError: The arrays do not fit together.
        """
        keys, starts, postings = (arrays.get(name) for name in ("keys", "starts", "postings"))
        if keys is None or starts is None or postings is None:
            raise ValueError("arrays of edges are missing")
        if any(each.dtype != np.uint32 or each.ndim != 1 for each in (keys, starts, postings)):
            raise ValueError("arrays of edges are of another kind")
        if not _fit_together(keys, starts, postings, slots):
            raise ValueError("arrays of edges do not fit together")
        return cls(keys, starts, postings)

    def merged(self, other: EdgesByKey) -> EdgesByKey:
        """Merge the edges of later slots into these."""
        return EdgesByKey(
            *_merged(
                self.keys, self.starts, self.postings, other.keys, other.starts, other.postings
            )
        )

    def renumbered(self, numbers: NDArray[np.int32]) -> EdgesByKey:
        """Give slots new numbers; edges of slots whose number is negative are left out."""
        return EdgesByKey(*_renumbered(self.keys, self.starts, self.postings, numbers))

    def ranges(self, keys: NDArray[np.uint32]) -> NDArray[np.int64]:
        """(C, 2) where the postings of each of (C,) keys begin and end."""
        found: NDArray[np.int64] = _ranges(
            keys,
            self.keys,
            self.starts,
            self._contents,  # type: ignore[attr-defined]
            self._shift,  # type: ignore[attr-defined]
        )
        return found


class _Scratch(NamedTuple):
    """What one thread counts with, as long as the largest set that it has searched.

    Args:
        tallies: (``_BLOCK``,) uint64, the four of every slot of a block side by side; clear
            between blocks.
        slots: (N,) those that were met, and room for one more, which is written to in vain.
        counts: (N,) n_m of those.
    """

    tallies: NDArray[np.uint64]
    slots: NDArray[np.int32]
    counts: NDArray[np.float32]


class OrientedRelation:
    """Edges correspond by vector, kinds and directions.

    Args:
        settings: Of these.
    """

    def __init__(self, settings: OrientedSettings) -> None:
        self._settings = settings
        self._limits = (
            settings.shortest_edge,
            settings.longest_edge,
            settings.cell,
            math.ceil((settings.longest_edge + settings.position_tolerance) / settings.cell) + 1,
        )
        self._scratch = threading.local()

    def edges(
        self, graphs: Iterable[AnchorGraph], first: int
    ) -> tuple[EdgesByKey, NDArray[np.int32]]:
        """Order the edges of references in slots from ``first`` on, and count them for each."""
        keys, postings, sizes = [_NOTHING], [_NOTHING], [_NO_SIZES]
        slots = enumerate(graphs, first)
        while some := list(islice(slots, _AT_ONCE)):
            found = [
                _keys(_anchors(graph), self._limits, self._settings.most_edges) for _, graph in some
            ]
            count = np.array([len(of_graph) for of_graph, _ in found], np.int32)
            owners = np.repeat(np.array([slot for slot, _ in some], np.uint32), count)
            turns = np.concatenate([turns for _, turns in found])
            keys.append(np.concatenate([of_graph for of_graph, _ in found]))
            postings.append(owners << np.uint32(_TURN_BITS) | turns)
            sizes.append(count)
        edges = EdgesByKey.of(np.concatenate(keys), np.concatenate(postings))
        return edges, np.concatenate(sizes)

    def part(self, arrays: Mapping[str, NDArray[Any]], slots: int) -> EdgesByKey:
        """Take edges of so many slots from arrays.

        Raises:
            ValueError: The arrays do not fit together.
        """
        return EdgesByKey.from_arrays(arrays, slots)

    def size(self, graph: AnchorGraph) -> int:
        """Return the number of edges of a graph that are used."""
        settings = self._settings
        lengths = graph.lengths
        return int(((lengths >= settings.shortest_edge) & (lengths <= settings.longest_edge)).sum())

    def met(
        self,
        graph: AnchorGraph,
        parts: Sequence[EdgesByKey],
        used: int,
        alive: int,
        looks: int = 1,
    ) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Count the corresponding edges by rarity, n_m, of those slots that have any.

        The work is bounded by ``most_votes``, however many references there are: nothing as
        long as the set is cleared or looked through.

        Args:
            graph: Of the scan that is looked for.
            parts: Edges of the references.
            used: Slots in use.
            alive: References among them that count.
            looks: Into so many the work is divided.

        Returns:
            (M,) slots, and (M,) n_m; valid until this thread counts again.
        """
        settings = self._settings
        tolerances = (
            settings.position_tolerance,
            settings.direction_tolerance * _SECTORS / (2.0 * math.pi),
        )
        keys, turns, shares = _cells(_anchors(graph), self._limits, tolerances)
        ranges = [part.ranges(keys) for part in parts]
        found = sum((each[:, 1] - each[:, 0] for each in ranges), np.zeros(len(keys), np.int64))
        unit = min(_FINEST_UNIT, max(1, _EXPECTED_TOTAL // max(self.size(graph), 1)))
        with np.errstate(divide="ignore", invalid="ignore"):
            rarity = np.log1p(alive / found) / math.log1p(max(alive, 1))
        rarity[found == 0] = 0.0
        rarity[self._too_common(found, looks)] = 0.0
        weights = np.round(rarity * shares * unit).astype(np.uint16)
        order, opening = self._rarest_first(found, weights, looks)
        scratch = self._scratch_of(used)
        count = 0
        for part, of_part in zip(parts, ranges, strict=True):
            keys = (of_part[order], turns[order], weights[order])
            count = _vote(part.postings, keys, opening, 1.0 / unit, scratch, count)
        self._scratch.all_clear = scratch
        return scratch.slots[:count], scratch.counts[:count]

    def _rarest_first(
        self, found: NDArray[np.int64], weights: NDArray[np.uint16], looks: int
    ) -> tuple[NDArray[np.int64], int]:
        """Order keys that count by their number of edges, and tell how many of them open."""
        order = np.argsort(found, kind="stable")
        order = order[weights[order] > 0]
        before = np.cumsum(found[order]) - found[order]
        most = max(self._settings.most_opening // looks, 1)
        opening = int(np.searchsorted(before, most))
        return order, opening

    def _too_common(self, found: NDArray[np.int64], looks: int) -> NDArray[np.bool_]:
        """Mark the commonest keys where all together are more than may be looked at."""
        most = self._settings.most_votes // looks
        if int(found.sum()) <= most:
            return np.zeros(len(found), np.bool_)
        ordered = np.sort(found)
        within = int(np.searchsorted(np.cumsum(ordered), most, side="right"))
        return np.asarray(found >= ordered[within])

    def _scratch_of(self, used: int) -> _Scratch:
        """Return clear tallies of this thread, so that a query allocates none.

        They are given back when they are clear again: an interrupted query leaves none behind.
        """
        scratch: _Scratch | None = self._scratch.__dict__.pop("all_clear", None)
        if scratch is None or len(scratch.slots) <= used:
            room = max(2 * used, 64)
            scratch = _Scratch(
                np.zeros(_BLOCK, np.uint64),
                np.empty(room, np.int32),
                np.empty(room, np.float32),
            )
        return scratch


_NOTHING = np.empty(0, np.uint32)
_NO_SIZES = np.empty(0, np.int32)


def _anchors(
    graph: AnchorGraph,
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64], float]:
    """Anchor points as kernels take them; without a main angle the scan's own frame."""
    anchors = graph.anchors
    main = anchors.main_angle if math.isfinite(anchors.main_angle) else 0.0
    return anchors.positions, anchors.kinds, anchors.directions, main


@kernel
def _folded(pair, sector_a, sector_b, i, j, side):  # type: ignore[no-untyped-def]
    """Key of a cell turned into the first quadrant, and the quarter turns that this took."""
    turns = 0
    while i < 0 or j < 0:
        i, j = j, -1 - i
        sector_a -= _QUARTER
        sector_b -= _QUARTER
        turns += 1
    sectors = (sector_a % _SECTORS) * _SECTORS + sector_b % _SECTORS
    return ((pair * _SECTORS * _SECTORS + sectors) * side + i) * side + j, turns


@kernel
def _floor(value):  # type: ignore[no-untyped-def]
    return int(math.floor(value))


@kernel
def _scrambled(key):  # type: ignore[no-untyped-def]
    """A hash of 32 bits, different for different keys."""
    mask = np.uint64(0xFFFFFFFF)
    h = np.uint64(key)
    h = ((h ^ (h >> np.uint64(16))) * np.uint64(0x7FEB352D)) & mask
    h = ((h ^ (h >> np.uint64(15))) * np.uint64(0x846CA68B)) & mask
    return h ^ (h >> np.uint64(16))


@kernel
def _keys(anchors, limits, most):  # type: ignore[no-untyped-def]
    """Distinct keys and quarter turns of a graph's edges: those of the smallest hash."""
    positions, kinds, directions, main = anchors
    shortest, longest, cell, side = limits
    c, s = math.cos(main), math.sin(main)
    count = len(kinds)
    keys = np.empty(count * (count - 1) // 2, np.uint32)
    order = np.empty(len(keys), np.uint64)
    found = 0
    for n in range(count):
        for m in range(n + 1, count):
            a, b = (n, m) if kinds[n] <= kinds[m] else (m, n)
            dx, dy = positions[b, 0] - positions[a, 0], positions[b, 1] - positions[a, 1]
            if not shortest * shortest <= dx * dx + dy * dy <= longest * longest:
                continue
            key, turns = _folded(
                kinds[a] * _KINDS + kinds[b],
                _floor((directions[a] - main) * _SECTORS / (2.0 * math.pi) + 0.5),
                _floor((directions[b] - main) * _SECTORS / (2.0 * math.pi) + 0.5),
                _floor((c * dx + s * dy) / cell),
                _floor((c * dy - s * dx) / cell),
                side,
            )
            keys[found] = key
            low = np.uint64(found) << np.uint64(_TURN_BITS) | np.uint64(turns)
            order[found] = _scrambled(key) << np.uint64(32) | low
            found += 1
    order = np.sort(order[:found])
    chosen = np.empty(min(found, most), np.uint32)
    chosen_turns = np.empty(len(chosen), np.uint32)
    kept = 0
    had = np.zeros(_TURNS, np.bool_)
    for e in range(found):
        if e > 0 and order[e] >> np.uint64(32) != order[e - 1] >> np.uint64(32):
            had[:] = False
        turn = order[e] & np.uint64(_TURNS - 1)
        if had[turn]:
            continue
        if kept == len(chosen):
            break
        had[turn] = True
        edge = (order[e] & np.uint64(0xFFFFFFFF)) >> np.uint64(_TURN_BITS)
        chosen[kept] = keys[edge]
        chosen_turns[kept] = turn
        kept += 1
    return chosen[:kept], chosen_turns[:kept]


@kernel
def _cells(anchors, limits, tolerances):  # type: ignore[no-untyped-def]
    """Keys within the tolerances of a graph's edges, their turns, and how much of each is.

    Of an edge between anchors of one kind, either end may be the first.
    """
    positions, kinds, directions, main = anchors
    shortest, longest, cell, side = limits
    near, wide = tolerances
    c, s = math.cos(main), math.sin(main)
    count = len(kinds)
    window = int(2.0 * near / cell) + 2
    arcs = int(2.0 * wide) + 2
    room = count * (count - 1) * window * window * arcs * arcs
    keys = np.empty(room, np.uint32)
    turned = np.empty(room, np.uint8)
    shares = np.empty(room, np.float32)
    full = min(cell, 2.0 * near)
    found = 0
    for a in range(count):
        for b in range(count):
            dx, dy = positions[b, 0] - positions[a, 0], positions[b, 1] - positions[a, 1]
            if a == b or kinds[a] > kinds[b]:
                continue
            if not shortest * shortest <= dx * dx + dy * dy <= longest * longest:
                continue
            x, y = c * dx + s * dy, c * dy - s * dx
            at_a = (directions[a] - main) * _SECTORS / (2.0 * math.pi) + 0.5
            at_b = (directions[b] - main) * _SECTORS / (2.0 * math.pi) + 0.5
            for i in range(_floor((x - near) / cell), _floor((x + near) / cell) + 1):
                in_x = min((i + 1) * cell, x + near) - max(i * cell, x - near)
                for j in range(_floor((y - near) / cell), _floor((y + near) / cell) + 1):
                    in_y = min((j + 1) * cell, y + near) - max(j * cell, y - near)
                    for p in range(_floor(at_a - wide), _floor(at_a + wide) + 1):
                        for q in range(_floor(at_b - wide), _floor(at_b + wide) + 1):
                            key, turns = _folded(kinds[a] * _KINDS + kinds[b], p, q, i, j, side)
                            keys[found] = key
                            turned[found] = turns
                            shares[found] = in_x * in_y / (full * full)
                            found += 1
    return keys[:found], turned[:found], shares[:found]


@kernel
def _ranges(wanted, keys, starts, contents, shift):  # type: ignore[no-untyped-def]
    """Where the postings of each wanted key begin and end; nowhere, where it does not occur."""
    ranges = np.zeros((len(wanted), 2), np.int64)
    for c in range(len(wanted)):
        entry = np.int64(wanted[c]) >> shift
        if entry + 1 >= len(contents):
            continue
        low, high = np.int64(contents[entry]), np.int64(contents[entry + 1])
        while low < high:
            middle = (low + high) // 2
            if keys[middle] < wanted[c]:
                low = middle + 1
            else:
                high = middle
        if low < len(keys) and keys[low] == wanted[c]:
            ranges[c, 0] = starts[low]
            ranges[c, 1] = starts[low + 1]
    return ranges


@kernel
def _fit_together(keys, starts, postings, slots):  # type: ignore[no-untyped-def]
    """Whether keys ascend, their postings follow each other, and all name slots."""
    if len(starts) != len(keys) + 1 or starts[0] != 0 or starts[-1] != len(postings):
        return False
    for k in range(len(keys)):
        if starts[k + 1] <= starts[k] or (k > 0 and keys[k] <= keys[k - 1]):
            return False
    return len(postings) == 0 or postings.max() >> np.uint32(_TURN_BITS) < slots


@kernel
def _vote(postings, keys, opening, unit, scratch, count):  # type: ignore[no-untyped-def]
    """Add the weights of keys to the tallies of slots, by the turns between edge and query.

    Slots that the first ``opening`` keys meet are noted, with the largest of their four tallies;
    other keys count for these alone.  Returns how many are noted now.  All keys are counted for
    one block of slots before the next, so that the tallies stay in the processor's cache.
    """
    ranges, turns, weights = keys
    left = ranges[:, 0].copy()
    coming = np.full(len(ranges), _NO_BLOCK, np.uint32)
    last = np.int64(-1)
    for c in range(len(ranges)):
        if ranges[c, 0] < ranges[c, 1]:
            coming[c] = postings[ranges[c, 0]] >> np.uint32(_BLOCK_BITS + _TURN_BITS)
            end = postings[ranges[c, 1] - 1] >> np.uint32(_BLOCK_BITS + _TURN_BITS)
            last = max(last, np.int64(end))
    for block in range(last + 1):
        begun = count
        for c in range(len(ranges)):
            if coming[c] == block:
                some = (block, left[c], ranges[c, 1], np.uint32(turns[c]), np.uint64(weights[c]))
                left[c], count = _tallied(postings, some, c < opening, scratch, count)
                coming[c] = _NO_BLOCK
                if left[c] < ranges[c, 1]:
                    coming[c] = postings[left[c]] >> np.uint32(_BLOCK_BITS + _TURN_BITS)
        _strength(scratch, unit, begun, count)
    return count


@kernel
def _tallied(postings, some, opens, scratch, count):  # type: ignore[no-untyped-def]
    """Add the weight of one key for one block; returns where the next block begins."""
    block, begin, end, turn, weight = some
    for e in range(begin, end):
        posting = postings[e]
        slot = posting >> np.uint32(_TURN_BITS)
        if slot >> np.uint32(_BLOCK_BITS) != block:
            return e, count
        at = slot & np.uint32(_BLOCK - 1)
        tally = scratch.tallies[at]
        shift = np.uint64(((posting - turn) & np.uint32(_TURNS - 1)) * np.uint32(_TALLY_BITS))
        room = np.uint64(_FULL) - ((tally >> shift) & np.uint64(_FULL))
        added = min(weight, room) << shift
        # Whether a slot was met before is anybody's guess: nothing branches by it.
        if opens:
            scratch.slots[count] = slot
            count += tally == 0
        else:
            added = added if tally != 0 else np.uint64(0)
        scratch.tallies[at] = tally + added
    return end, count


@kernel
def _strength(scratch, unit, begun, count):  # type: ignore[no-untyped-def]
    """The largest of the four tallies of the slots noted since ``begun``; clears them."""
    for k in range(begun, count):
        at = scratch.slots[k] & (_BLOCK - 1)
        tally = scratch.tallies[at]
        scratch.tallies[at] = 0
        best = np.uint64(0)
        for _ in range(_TURNS):
            best = max(best, tally & np.uint64(_FULL))
            tally >>= np.uint64(_TALLY_BITS)
        scratch.counts[k] = best * unit


@kernel
def _merged(keys, starts, postings, other_keys, other_starts, other_postings):  # type: ignore[no-untyped-def]
    """Keys, starts and postings of two parts in one; the other's slots are the later ones."""
    new_keys = np.empty(len(keys) + len(other_keys), np.uint32)
    new_starts = np.empty(len(new_keys) + 1, np.uint32)
    new_postings = np.empty(len(postings) + len(other_postings), np.uint32)
    a, b, k, e = 0, 0, 0, 0
    while a < len(keys) or b < len(other_keys):
        from_a = b == len(other_keys) or (a < len(keys) and keys[a] <= other_keys[b])
        from_b = a == len(keys) or (b < len(other_keys) and other_keys[b] <= keys[a])
        new_keys[k] = keys[a] if from_a else other_keys[b]
        new_starts[k] = e
        if from_a:
            for p in range(starts[a], starts[a + 1]):
                new_postings[e] = postings[p]
                e += 1
            a += 1
        if from_b:
            for p in range(other_starts[b], other_starts[b + 1]):
                new_postings[e] = other_postings[p]
                e += 1
            b += 1
        k += 1
    new_starts[k] = e
    return new_keys[:k], new_starts[: k + 1], new_postings


@kernel
def _renumbered(keys, starts, postings, numbers):  # type: ignore[no-untyped-def]
    """Keys, starts and postings with other slot numbers; negative ones are left out."""
    new_keys = np.empty(len(keys), np.uint32)
    new_starts = np.empty(len(starts), np.uint32)
    new_postings = np.empty(len(postings), np.uint32)
    k, e = 0, 0
    for a in range(len(keys)):
        new_keys[k] = keys[a]
        new_starts[k] = e
        for p in range(starts[a], starts[a + 1]):
            number = numbers[postings[p] >> np.uint32(_TURN_BITS)]
            if number >= 0:
                turns = postings[p] & np.uint32(_TURNS - 1)
                new_postings[e] = np.uint32(number) << np.uint32(_TURN_BITS) | turns
                e += 1
        if e > new_starts[k]:
            k += 1
    new_starts[k] = e
    return new_keys[:k], new_starts[: k + 1], new_postings[:e]
