"""Section 4.1: the relationship database and the preselection of candidates.

The database holds the edges of all reference graphs, each with the reference that it belongs
to.  The edges of a new graph are looked up, and for every database edge that corresponds a
counter of its reference goes up.  With ``n_m`` the count of reference *m*, ``r`` the edges of
the new graph and ``s`` those of the reference, the quality measure is

    q_m = n_m ** 2 / (r * s).

What corresponds is a setting: the paper's edges by their length (``length_relation``), or
edges that also know kinds, directions and the main walls (``oriented_relation``).

The database consists of parts, each a few times smaller than the one before it and never
changed once made: a new reference is a part of its own, and the last parts are merged when
they have become of a size.  Removing marks the reference and leaves its edges until the next
large merge.  So a reader keeps what it has begun with, and writing costs little.

Among very many references the votes leave thousands about as good.  So the database can also hold
which spacings of walls each one saw (``spacing``): of the references with the largest n_m those
are taken of which ``0.15 * log(q_m)`` and the likeness of the spacings together are largest.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .graph import AnchorGraph
from .length_relation import LengthRelation, corresponding_lengths
from .oriented_relation import OrientedRelation, OrientedSettings

__all__ = ["WORDS", "DatabaseSettings", "RelationshipDatabase", "Votes", "quality"]

WORDS = 3
"""Integers of 64 bits that hold the spacings of a scan (``spacing``)."""

# A part is merged into the one before it once it is more than this share of that: larger
# shares make fewer parts to search, smaller ones less to copy.
_MERGED_SHARE = 0.25
# Parts with no more edges than this are one part, and forget what is removed at once.
_SMALLEST_PART = 4096
# A reference of fewer edges counts as one of so many oriented ones: few edges prove little.
_FEWEST_EDGES = 16
# So few references are put in order sooner than it takes to tell which are among the best.
_FEW = 128
# The histogram that tells which qualities are among the best: bins of the square root of the
# quality, and how many of them make one.
_BINS = 4096
_BINS_OF_ONE = 2048.0
# References have at most about so many edges; the quality of larger ones takes longer.
_SIZES = 512
# Logarithm of the quality and likeness of the spacings choose together.
_PER_VOTE = 0.15
_LEAST_QUALITY = 1e-6

Number = TypeVar("Number", np.int32, np.int64, np.uint64)


class DatabaseSettings(BaseModel):
    """Settings of the preselection of section 4.1."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    relation: Literal["oriented", "length"] = Field(
        "oriented", description="what corresponding edges have in common; the paper's is length"
    )
    oriented: OrientedSettings = OrientedSettings()
    length_tolerance: float = Field(
        0.1, gt=0.0, description="edges correspond when their lengths differ no more, metres"
    )
    count_once: bool = Field(
        False, description="by length, count an edge once, not once for every correspondence"
    )
    candidates: int | None = Field(
        None, ge=1, description="references that are followed further; null for all"
    )
    shortlisted: int = Field(
        4000,
        ge=0,
        description="references of the most votes that the spacings of walls choose these from",
    )
    compared: int = Field(
        600,
        ge=0,
        description="references in a map that are compared by what they saw to choose these",
    )


@dataclass(frozen=True, eq=False)
class Votes:
    """How well references correspond to a graph by their edges.

    Args:
        references: (K,) identifiers, highest quality first; equals by identifier.
        counts: (K,) n_m, corresponding edges; fractions where they count by their rarity.
        quality: (K,) q_m.
    """

    references: NDArray[np.int64]
    counts: NDArray[np.float32]
    quality: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.references)


@dataclass(frozen=True, eq=False)
class _State:
    """Everything that a reader needs, replaced as a whole by a writer.

    Args:
        parts: Edges of the references, large parts first.
        identifiers: (capacity,) of the reference in every slot.
        sizes: (capacity,) edges of the reference in every slot; -1 for a removed one.
        spacings: (capacity, 3) which spacings of walls it saw.
        used: Slots in use.
        alive: References that are not removed.
    """

    parts: tuple[Any, ...]
    identifiers: NDArray[np.int64]
    sizes: NDArray[np.int32]
    spacings: NDArray[np.uint64]
    used: int
    alive: int


class RelationshipDatabase:
    """All edges of all references; searched by many, changed by one at a time.

    Args:
        settings: Of the preselection.
        graphs: Identifier and graph of the references to begin with.
        spacings: (3,) uint64 of each of them (``spacing``), taken after all graphs; none at all
            where nobody will ask for them.

    Raises:
        ValueError: Two references have the same identifier, or there are not as many spacings.
    """

    def __init__(
        self,
        settings: DatabaseSettings,
        graphs: Iterable[tuple[int, AnchorGraph]] = (),
        spacings: Iterable[NDArray[np.uint64]] = (),
    ) -> None:
        self._writing = threading.Lock()
        self._shortlisted = settings.shortlisted
        self._relation: LengthRelation | OrientedRelation
        if settings.relation == "length":
            self._relation = LengthRelation(settings.length_tolerance, settings.count_once)
            self._fewest = 0
        else:
            self._relation = OrientedRelation(settings.oriented)
            self._fewest = _FEWEST_EDGES
        identifiers: list[int] = []

        def in_slots() -> Iterator[AnchorGraph]:
            for identifier, graph in graphs:
                identifiers.append(identifier)
                yield graph

        edges, sizes = self._relation.edges(in_slots(), 0)
        saw = np.array(list(spacings), np.uint64).reshape(-1, WORDS)
        if not len(saw):
            saw = np.zeros((len(sizes), WORDS), np.uint64)
        self._state = self._beginning(edges, sizes, np.array(identifiers, np.int64), saw)

    @classmethod
    def from_arrays(
        cls, settings: DatabaseSettings, arrays: Mapping[str, NDArray[Any]]
    ) -> RelationshipDatabase:
        """Take what ``arrays`` gave, which may be mapped from a file; the edges are not copied.

        Args:
            settings: The same as those of the database that gave the arrays.
            arrays: By name.

        Raises:
            ValueError: The arrays do not fit together, or are those of another relation.
        """
        identifiers, sizes = arrays.get("identifiers"), arrays.get("sizes")
        saw = arrays.get("spacings")
        if identifiers is None or sizes is None or saw is None:
            raise ValueError("arrays of references are missing")
        if identifiers.dtype != np.int64 or sizes.dtype != np.int32 or identifiers.ndim != 1:
            raise ValueError("arrays of references are of another kind")
        if saw.dtype != np.uint64 or saw.shape != (len(identifiers), WORDS):
            raise ValueError("arrays of references are of another kind")
        if identifiers.shape != sizes.shape or (len(sizes) and sizes.min() < 0):
            raise ValueError("arrays of references do not fit together")
        made = cls(settings)
        edges = made._relation.part(arrays, len(identifiers))
        made._state = made._beginning(edges, np.array(sizes), np.array(identifiers), saw)
        return made

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all that the database holds, as plain arrays by name.

        ``identifiers`` (N,) int64, ``sizes`` (N,) int32 and ``spacings`` (N, 3) uint64 of the
        references, and the edges:
        ``keys`` (K,), ``starts`` (K + 1,) and ``postings`` (E,), all uint32, or, by length,
        ``lengths`` (E,) float32 and ``slots`` (E,) int32.
        """
        with self._writing:
            if self._removed or len(self._state.parts) > 1:
                self._forget_removed(one_part=True)
            state = self._state
        used = state.used
        references = {
            "identifiers": state.identifiers[:used],
            "sizes": state.sizes[:used].copy(),
            "spacings": state.spacings[:used],
        }
        return {**references, **state.parts[0].arrays()}

    def __len__(self) -> int:
        return len(self._slots)

    def __contains__(self, identifier: int) -> bool:
        return identifier in self._slots

    def add(
        self, identifier: int, graph: AnchorGraph, spacings: NDArray[np.uint64] | None = None
    ) -> None:
        """Add a reference while others search.

        Args:
            identifier: Of the reference.
            graph: Of the reference.
            spacings: (3,) of the walls that it saw.

        Raises:
            ValueError: The identifier is in use.
        """
        with self._writing:
            if identifier in self._slots:
                raise ValueError(f"reference {identifier} is in the database already")
            state = self._state
            slot = state.used
            edges, size = self._relation.edges([graph], slot)
            identifiers = _with_room(state.identifiers, slot)
            sizes = _with_room(state.sizes, slot)
            saw = _with_room(state.spacings, slot)
            identifiers[slot], sizes[slot] = identifier, size[0]
            saw[slot] = 0 if spacings is None else spacings
            self._slots[identifier] = slot
            parts = _tidied([*state.parts, edges])
            self._state = _State(parts, identifiers, sizes, saw, slot + 1, state.alive + 1)

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
            self._state = replace(state, alive=state.alive - 1)
            edges = sum(map(len, state.parts))
            if 2 * self._removed > edges or edges <= _SMALLEST_PART:
                self._forget_removed()

    def votes(
        self,
        graph: AnchorGraph,
        most: int | None = None,
        spacings: NDArray[np.uint64] | None = None,
        looks: int = 1,
    ) -> Votes:
        """Count corresponding edges and compute the quality measure (section 4.1).

        Args:
            graph: Of the scan that is looked for.
            most: How many references to return; None for all.
            spacings: (3,) of the walls that it saw (``spacing``): they choose the references
                from the first ``shortlisted`` by n_m.
            looks: Into so many the work for this scan is divided.
        """
        state = self._state
        slots, counts = self._relation.met(graph, state.parts, state.used, state.alive, looks)
        edges = (self._relation.size(graph), self._fewest)
        if most is not None and most < len(slots):
            some, of_some = slots, counts
            if len(slots) > _FEW:
                if spacings is None:
                    chosen = _promising(slots, counts, state.sizes, edges, most)
                else:
                    chosen = _frequent(counts, max(most, self._shortlisted // looks))
                some, of_some = slots[chosen], counts[chosen]
            if spacings is not None and most < len(some):
                chosen = _alike(some, of_some, state, edges, spacings, most)
                some, of_some = some[chosen], of_some[chosen]
            found = _in_order(some, of_some, state, edges, most)
            if len(found[0]) == most:
                return Votes(*found)
        everywhere = np.zeros(state.used, np.float32)
        everywhere[slots] = counts
        return Votes(*_in_order(np.arange(state.used), everywhere, state, edges, most))

    def _beginning(
        self,
        edges: Any,
        sizes: NDArray[np.int32],
        identifiers: NDArray[np.int64],
        spacings: NDArray[np.uint64],
    ) -> _State:
        """Hold the edges of references in slots from zero on, and nothing else."""
        self._slots = {identifier: slot for slot, identifier in enumerate(identifiers.tolist())}
        if len(self._slots) != len(identifiers):
            raise ValueError("two references have the same identifier")
        if len(spacings) != len(identifiers):
            raise ValueError(f"{len(identifiers)} references have {len(spacings)} spacings")
        self._removed = 0
        return _State((edges,), identifiers, sizes, spacings, len(sizes), len(sizes))

    def _forget_removed(self, *, one_part: bool = False) -> None:
        """Leave out what was removed and count the slots anew."""
        state, used = self._state, self._state.used
        alive = state.sizes[:used] >= 0
        numbers = np.where(alive, np.cumsum(alive, dtype=np.int32) - np.int32(1), np.int32(-1))
        parts = _tidied([part.renumbered(numbers) for part in state.parts], one_part)
        identifiers, sizes = state.identifiers[:used][alive], state.sizes[:used][alive]
        spacings = state.spacings[:used][alive]
        self._slots = {identifier: slot for slot, identifier in enumerate(identifiers.tolist())}
        self._removed = 0
        count = len(identifiers)
        self._state = _State(parts, identifiers, sizes, spacings, count, count)


def _tidied(parts: list[Any], one_part: bool = False) -> tuple[Any, ...]:
    """Merge the last parts until each is much smaller than the one before it, or all."""
    while len(parts) > 1:
        before, last = len(parts[-2]), len(parts[-1])
        small_enough = before + last > _SMALLEST_PART and last <= _MERGED_SHARE * before
        if small_enough and not one_part:
            break
        last = parts.pop()
        parts[-1] = parts[-1].merged(last)
    return tuple(parts)


def _in_order(
    slots: NDArray[np.int32] | NDArray[np.int64],
    counts: NDArray[np.float32],
    state: _State,
    edges: tuple[int, int],
    most: int | None,
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float64]]:
    """Order slots by quality: identifiers, counts and qualities of the first ones."""
    identifiers, counts, quality = _qualities(slots, counts, state.identifiers, state.sizes, edges)
    order = np.lexsort((identifiers, -quality))[:most]
    return identifiers[order], counts[order], quality[order]


@kernel
def _pairs(size, edges):  # type: ignore[no-untyped-def]
    """Edges of a scan times those of a reference, one at least, that q_m is relative to."""
    return max(np.float64(edges[0]) * max(size, edges[1]), 1.0)


@kernel
def _quality(count, size, edges):  # type: ignore[no-untyped-def]
    """The q_m of a reference of so many edges."""
    return np.float64(count) ** 2 / _pairs(size, edges)


@kernel
def quality(lengths, others, tolerance, once):  # type: ignore[no-untyped-def]
    """The q_m of two graphs without a database, by the lengths of their edges, in order."""
    count = corresponding_lengths(lengths, others, tolerance, once)
    return _quality(count, len(others), (len(lengths), 0))


@kernel
def _qualities(slots, counts, identifiers, sizes, edges):  # type: ignore[no-untyped-def]
    """Identifiers, counts and qualities of those slots whose reference is not removed."""
    alive = np.empty(len(slots), np.int64)
    found = np.empty(len(slots), np.float32)
    quality = np.empty(len(slots))
    used = 0
    for k in range(len(slots)):
        size = sizes[slots[k]]
        if size < 0:
            continue
        alive[used], found[used] = identifiers[slots[k]], counts[k]
        quality[used] = _quality(counts[k], size, edges)
        used += 1
    return alive[:used], found[:used], quality[:used]


def _alike(
    slots: NDArray[np.int32],
    counts: NDArray[np.float32],
    state: _State,
    edges: tuple[int, int],
    spacings: NDArray[np.uint64],
    most: int,
) -> NDArray[np.int64]:
    """Places of the ``most`` slots that are best by quality and spacings; equals by identifier."""
    known = (state.sizes, state.spacings)
    scores: NDArray[np.float64] = _scores(slots, counts, known, edges, spacings)
    least = np.partition(scores, len(scores) - most)[len(scores) - most]
    chosen = np.flatnonzero(scores >= least)
    if len(chosen) > most:
        order = np.lexsort((state.identifiers[slots[chosen]], -scores[chosen]))
        chosen = chosen[order[:most]]
    return chosen


@kernel
def _bits(word):  # type: ignore[no-untyped-def]
    """How many bits of a word are set."""
    word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
    pairs = np.uint64(0x3333333333333333)
    word = (word & pairs) + ((word >> np.uint64(2)) & pairs)
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@kernel
def _scores(slots, counts, known, edges, spacings):  # type: ignore[no-untyped-def]
    """What slots promise by quality and by spacings that are those of the scan.

    The likeness is the cosine between the bits, the larger one of both ways that the directions
    of the main walls may correspond.
    """
    sizes, saw = known
    half = np.uint64(32)
    x, y, back = spacings[0], spacings[1], spacings[2]
    kcab = (back >> half) | (back << half)
    own = _bits(x) + _bits(y) + _bits(back)
    scores = np.empty(len(slots))
    for k in range(len(slots)):
        size = sizes[slots[k]]
        if size < 0:
            scores[k] = -np.inf
            continue
        quality = _quality(counts[k], size, edges)
        of_x, of_y, of_back = saw[slots[k], 0], saw[slots[k], 1], saw[slots[k], 2]
        straight = _bits(of_x & x) + _bits(of_y & y) + _bits(of_back & back)
        across = _bits(of_x & y) + _bits(of_y & x) + _bits(of_back & kcab)
        both = np.float64(own) * np.float64(_bits(of_x) + _bits(of_y) + _bits(of_back))
        alike = np.float64(max(straight, across)) / math.sqrt(both) if both > 0.0 else 0.0
        scores[k] = _PER_VOTE * math.log(quality + _LEAST_QUALITY) + alike
    return scores


def _with_room(values: NDArray[Number], slot: int) -> NDArray[Number]:
    """Return the array, or a longer copy when it has no place for one more."""
    if slot < len(values):
        return values
    longer = np.zeros((max(2 * len(values), 64), *values.shape[1:]), values.dtype)
    longer[: len(values)] = values
    return longer


@kernel
def _upper(scale, reached, most):  # type: ignore[no-untyped-def]
    """Places of the ``most`` highest values, and of all in the bin where so many are reached.

    ``scale`` is the bin of each value, negative for those that do not count; ``reached`` says how
    many lie in each bin.
    """
    least, enough = _BINS, 0
    while least > 0 and enough < most:
        least -= 1
        enough += reached[least]
    chosen = np.empty(enough, np.int64)
    found = 0
    for k in range(len(scale)):
        if scale[k] >= least:
            chosen[found] = k
            found += 1
    return chosen


@kernel
def _frequent(counts, most):  # type: ignore[no-untyped-def]
    """Places of the ``most`` largest counts, and of some that are about as large.

    Not the quality decides: to read a size for every one of them takes longer than all else here.
    """
    highest = np.float32(1e-9)
    for k in range(len(counts)):
        highest = max(highest, counts[k])
    unit = np.float32(_BINS - 1) / highest
    scale = np.empty(len(counts), np.int32)
    reached = np.zeros(_BINS, np.int64)
    for k in range(len(counts)):
        scale[k] = int(counts[k] * unit)
        reached[scale[k]] += 1
    return _upper(scale, reached, most)


@kernel
def _promising(slots, counts, sizes, edges, most):  # type: ignore[no-untyped-def]
    """Places of the ``most`` slots of highest quality, and of some that are about as good.

    A histogram of the square roots tells which quality that many reach, so that nothing is
    sorted but the few that are left.
    """
    # A root and a division for each size instead of each slot.
    shares = np.empty(_SIZES)
    for size in range(_SIZES):
        shares[size] = _BINS_OF_ONE / math.sqrt(_pairs(size, edges))
    scale = np.empty(len(counts), np.int32)
    reached = np.zeros(_BINS, np.int64)
    for k in range(len(slots)):
        size = sizes[slots[k]]
        if size < 0 or edges[0] == 0:
            scale[k] = -1
            continue
        if size < _SIZES:
            root = counts[k] * shares[size]
        else:
            root = counts[k] * _BINS_OF_ONE / math.sqrt(_pairs(size, edges))
        scale[k] = min(int(root), _BINS - 1)
        reached[scale[k]] += 1
    return _upper(scale, reached, most)
