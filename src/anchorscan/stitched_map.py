"""Beyond the paper: all references of a set as one map, searched by relations.

Joins the parts that need poses in a common frame: the landmarks and their relations, which
propose; the likelihood field, which sieves and refines; and the pose of every reference, so
that an answer can name the reference scan that it stands for.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import chain
from queue import SimpleQueue
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .anchors import AnchorStack, stack_anchors
from .database import RelationshipDatabase, Votes, quality
from .decision import Decision, covariance, decide
from .description import Description, describe, looks
from .evaluation import evaluation, tolerances
from .field import FieldArrays, LikelihoodField
from .graph import anchor_graph
from .hypothesis import Hypothesis
from .pairwise import Known
from .panorama import View, reordered, worth
from .placed import Lot, lot_of, nearest, tidied
from .pose import Pose2D
from .proposal import (
    Landmarks,
    Proposals,
    check_landmarks,
    joined,
    landmarks,
    proposals,
    related,
)
from .reference import Reference
from .scan import LaserScan
from .settings import Settings
from .spacing import spacings
from .standing import Places, places, standing
from .tiles import Tiles
from .verification import Fits, follow, settled, verify

__all__ = ["MapSearch", "StitchedMap", "candidates"]

# What is known of so many references, some fifty megabytes, is kept; of others it is made again.
_REMEMBERED = 4096
# Around so many references a scan without anchor points may stand.
_MOST_STANDING = 1024

Value = TypeVar("Value")
Other = TypeVar("Other")


@dataclass(frozen=True, eq=False)
class MapSearch:
    """What a search in the stitched map came through.

    Args:
        votes: Of the candidate references, in the order of what they are worth (``panorama``);
            None where all may propose.
        proposals: Alignments that passed the first check.
        fits: What is left after all sieves, of the highest worth first.
        decision: What they are worth.
        references: Those that the hypotheses name, one for each.
        hypotheses: Best first.
    """

    votes: Votes | None
    proposals: Proposals
    fits: Fits
    decision: Decision
    references: tuple[Reference, ...]
    hypotheses: tuple[Hypothesis, ...]


@dataclass(frozen=True, eq=False)
class _Content:
    """What a search reads, replaced as a whole by a writer.

    Args:
        lots: The references.
        field: Stitched from them, and from what was added since.
        count: References that are there.
    """

    lots: tuple[Lot, ...]
    field: LikelihoodField
    count: int

    def find(self, identifier: int) -> tuple[Lot, int] | None:
        """Tell in which lot and where there a reference is."""
        for lot in self.lots:
            place = lot.find(identifier)
            if place is not None:
                return lot, place
        return None

    @property
    def tiles(self) -> Tiles:
        """The map as it is now."""
        return self.field.tiles

    @property
    def landmarks(self) -> list[Landmarks]:
        """Those of all references."""
        return [lot.landmarks for lot in self.lots]

    @cached_property
    def places(self) -> Places:
        """Where a scan without anchor points may stand; of very many references around some."""
        there = [(lot, np.flatnonzero(lot.is_there)) for lot in self.lots]
        poses = np.concatenate([lot.poses[at] for lot, at in there])
        walls = np.concatenate([lot.anchors.main_angles[at] for lot, at in there])
        step = -(-len(poses) // _MOST_STANDING) or 1
        return places(poses[::step], walls[::step], self.tiles)


class StitchedMap:
    """References in a common frame, searched as one map; one writer, many readers.

    Args:
        settings: Of all stages.
        known: References to begin with, all with a pose.

    Raises:
        ValueError: Two references have the same identifier, or one has no pose.
    """

    def __init__(self, settings: Settings, known: Iterable[Known] = ()) -> None:
        self._begin(settings, _no_reading)
        known = iter(known)
        first = next(known, None)
        if first is None:
            lot = lot_of((), 0, settings.proposal)
            self._field = LikelihoodField(settings.field)
        else:
            lot = self._stitch(chain((first,), known))
        self._next_serial = len(lot)
        self._hold((lot,))

    def _stitch(self, known: Iterable[Known]) -> Lot:
        """Stitch the map while the references are still being described."""
        described = _Passed[tuple[LaserScan, Pose2D]]()
        with ThreadPoolExecutor(1) as thread:
            field = thread.submit(LikelihoodField, self._settings.field, described)
            with described:
                passed = (described.put(_placed(each.reference), each) for each in known)
                lot = lot_of(map(self._remembered, passed), 0, self._settings.proposal)
            self._field = field.result()
        return lot

    @classmethod
    def from_arrays(
        cls,
        settings: Settings,
        arrays: Mapping[str, NDArray[Any]],
        read: Callable[[int], Reference],
    ) -> StitchedMap:
        """Take up a map as ``arrays`` gave it, with the same settings; little is copied.

        Args:
            settings: Of all stages.
            arrays: By name; they may be mapped from a file.
            read: Returns the reference of an identifier, when it is needed.

        Raises:
            ValueError: The arrays do not fit each other.
        """
        places = cls.__new__(cls)
        places._begin(settings, read)
        try:
            lot = _lot_from(arrays, settings)
        except (KeyError, TypeError) as error:
            raise ValueError(f"arrays of the map are missing: {error}") from None
        places._next_serial = len(lot)
        places._database = RelationshipDatabase.from_arrays(
            settings.database, _section(arrays, "database.")
        )
        # Removed references leave their slots, so these may be in another order.
        if not np.array_equal(np.sort(arrays["database.identifiers"]), lot.identifiers):
            raise ValueError("the relationship database is of other references")
        field = FieldArrays._make(arrays[f"field.{name}"] for name in FieldArrays._fields)
        places._field = LikelihoodField.from_arrays(settings.field, field)
        places._hold((lot,))
        return places

    def _begin(self, settings: Settings, read: Callable[[int], Reference]) -> None:
        self._settings = settings
        self._read = read
        self._weights = settings.field.weights()
        self._readings = settings.belief.readings(settings.field)
        # Made when votes are first asked for: without them all references propose.
        self._preparing = threading.Lock()
        self._database: RelationshipDatabase | None = None
        self._relations = _Memory[Landmarks]()
        self._memory = _Memory[Known]()

    def __len__(self) -> int:
        return self._content.count

    def __contains__(self, identifier: int) -> bool:
        return self._content.find(identifier) is not None

    @property
    def references(self) -> tuple[Reference, ...]:
        """The references in the order of their identifiers."""
        found = [
            self._reference(lot, place)
            for lot in self._content.lots
            for place in np.flatnonzero(lot.is_there).tolist()
        ]
        return tuple(sorted(found, key=lambda reference: reference.identifier))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all that is derived from the references, as plain arrays by name."""
        with self._preparing:
            lot = reduce(Lot.followed_by, self._content.lots)
            lot = lot.followed_by(lot_of((), 0, lot.settings))  # which leaves out what is gone
            found = {
                "references.identifiers": lot.identifiers,
                "references.poses": lot.poses,
                "references.panoramas": lot.panoramas,
                **{f"anchors.{name}": array for name, array in vars(lot.anchors).items()},
                **self._stored_landmarks(lot),
                **{f"field.{name}": each for name, each in self._field.arrays()._asdict().items()},
            }
        database = self._voting().arrays()
        return found | {f"database.{name}": array for name, array in database.items()}

    def _stored_landmarks(self, lot: Lot) -> dict[str, NDArray[Any]]:
        """Landmarks of all references, unless only those that are voted for propose."""
        if self._settings.database.candidates is not None:
            return {}
        return {f"landmarks.{name}": each for name, each in lot.landmarks._asdict().items()}

    def check_room(self, poses: Iterable[Pose2D]) -> None:
        """See that references can be added at some poses.

        Raises:
            AnchorscanError: They lie too far from the origin, or from the others.
        """
        self._field.check_room(poses)

    def add(self, known: Known) -> None:
        """Add a reference that has a pose.

        Raises:
            ValueError: The identifier is in use.
        """
        identifier = known.reference.identifier
        with self._preparing:
            if self._content.find(identifier) is not None:
                raise ValueError(f"there is a reference {identifier} already")
            lot = lot_of([known], self._next_serial, self._settings.proposal)
            self._field.add(*_placed(known.reference))  # first, since it may refuse
            if self._database is not None:
                saw = spacings(lot.panoramas)[0]
                self._database.add(identifier, known.description.graph, saw)
            self._memory[self._next_serial] = known
            self._next_serial += 1
            self._hold(tidied([*self._content.lots, lot]))

    def remove(self, identifier: int) -> None:
        """Remove a reference.

        Raises:
            KeyError: There is no such reference.
        """
        with self._preparing:
            found = self._content.find(identifier)
            if found is None:
                raise KeyError(identifier)
            lot, place = found
            self._field.remove(*_placed(self._reference(lot, place)))
            if self._database is not None:
                self._database.remove(identifier)
            left = lot.without(place)
            self._hold(tidied([left if each is lot else each for each in self._content.lots]))

    def search(self, description: Description, most: int | None) -> MapSearch:
        """Let relations propose poses, sieve and refine them, and decide.

        Args:
            description: Of the scan.
            most: How many references, the best by votes and what they saw, may propose; None
                for all.
        """
        content = self._content
        votes, proposed, fits = self._sought(description, most, content)
        decision = self._decided(description, fits, most, content)
        hypotheses, known = self._hypotheses(description, fits, decision, content)
        references = tuple(each.reference for each in known)
        return MapSearch(votes, proposed, fits, decision, references, hypotheses)

    def _decided(
        self, description: Description, fits: Fits, most: int | None, content: _Content
    ) -> Decision:
        """Decide; where that is asked, what may be an answer once more beside its mirror image."""
        settings, anchors = self._settings.decision, len(description.anchors)
        decision = decide(fits, anchors, settings)
        if not (settings.both_ways and decision.alike):
            return decision
        upside_down = describe(description.scan.upside_down(), self._settings)
        _, _, others = self._sought(upside_down, most, content)
        return decide(fits, anchors, settings, others.highest_score)

    def fits(self, description: Description, most: int | None) -> Fits:
        """Search as ``search`` does, but neither decide nor name references."""
        return self._sought(description, most, self._content)[2]

    def hypotheses(
        self, description: Description, fits: Fits, decision: Decision
    ) -> tuple[Hypothesis, ...]:
        """Name the references of fits that were decided on elsewhere."""
        return self._hypotheses(description, fits, decision, self._content)[0]

    def follow(
        self, scan: LaserScan, poses: NDArray[np.float64], stiffness: NDArray[np.float64]
    ) -> Fits:
        """Refine expected poses of a scan, and score them as the belief does."""
        settings, tiles = self._settings.verification, self._content.tiles
        return follow(poses, stiffness, scan.points, tiles, self._readings, settings)

    def nearest(self, poses: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the identifier of the reference taken nearest to each of (K, 3) poses.

        Returns:
            (K,) identifiers and (K, 3) ``T_reference_laser``; none of either where there is no
            reference at all.
        """
        lots = self._content.lots
        numbers, places, T_reference_scan = nearest(lots, poses)
        if (numbers < 0).any():
            return np.empty(0, np.int64), np.empty((0, 3))
        identifiers = [
            lots[n].identifiers[k] for n, k in zip(numbers.tolist(), places.tolist(), strict=True)
        ]
        return np.array(identifiers, np.int64), T_reference_scan

    def _sought(
        self, description: Description, most: int | None, content: _Content
    ) -> tuple[Votes | None, Proposals, Fits]:
        """Let relations propose poses, sieve and refine them."""
        settings, tiles = self._settings, content.tiles
        seen = description.readings
        votes = None if most is None else self._candidates(description, most, content)
        related = content.landmarks if votes is None else self._some(votes.references, content)
        proposed = proposals(description.anchors, seen, related, tiles, settings.proposal)
        poses = proposed.poses
        if not len(poses):
            walls = description.anchors.main_angle
            proposed = standing(content.places, walls, seen, tiles, settings.proposal)
            poses = settled(proposed.poses, seen, tiles, settings.verification)
        fits = verify(poses, seen, tiles, self._weights, settings.verification)
        return votes, proposed, fits

    def _hypotheses(
        self, description: Description, fits: Fits, decision: Decision, content: _Content
    ) -> tuple[tuple[Hypothesis, ...], list[Known]]:
        """Name for each of the best fits the reference taken nearest, and compare with it."""
        settings = self._settings
        count = min(len(fits), settings.acceptance.hypotheses)
        found = nearest(content.lots, fits.poses[:count])
        numbers, places, T_reference_scan = (array.tolist() for array in found)
        if -1 in numbers:  # the last reference was removed meanwhile
            return (), []
        known = [self._know(content.lots[n], k) for n, k in zip(numbers, places, strict=True)]
        poses, scores = fits.poses.tolist(), fits.features[:, 0].tolist()
        covariances = covariance(fits, settings.decision)
        probabilities = decision.probabilities.tolist()
        agreement = [
            compared(description, each.description, T_reference_scan, settings)
            for each, T_reference_scan in zip(known, found[2], strict=True)
        ]
        hypotheses = tuple(
            Hypothesis(
                reference=each.reference.identifier,
                pose_in_reference=Pose2D(*T_reference_scan[n]),
                pose=Pose2D(*poses[n]),
                covariance=covariances[n],
                evaluation=agreement[n][0],
                quality=agreement[n][1],
                score=scores[n],
                probability=probabilities[n],
                accepted=decision.accepted and n == 0,
                ambiguous=decision.is_ambiguous(n),
            )
            for n, each in enumerate(known)
        )
        return hypotheses, known

    def _hold(self, lots: tuple[Lot, ...]) -> None:
        self._content = _Content(lots, self._field, sum(map(len, lots)))

    def _voting(self) -> RelationshipDatabase:
        with self._preparing:
            if self._database is None:
                self._database = RelationshipDatabase(
                    self._settings.database,
                    (
                        (identifier, anchor_graph(lot.anchors.of(place), self._settings.graph))
                        for lot in self._content.lots
                        for place, identifier in enumerate(lot.identifiers.tolist())
                        if lot.is_there[place]
                    ),
                    chain.from_iterable(
                        spacings(lot.panoramas[lot.is_there]) for lot in self._content.lots
                    ),
                )
            return self._database

    def _candidates(self, description: Description, most: int, content: _Content) -> Votes:
        """Choose by votes, and among the first of these by what they saw."""

        def worths(
            seen: View, first: NDArray[np.int64], quality: NDArray[np.float64]
        ) -> NDArray[np.float64]:
            found = np.full(len(first), -np.inf)  # of those removed in between
            for lot in content.lots:
                places = lot.find_all(first)
                at = np.flatnonzero(places >= 0)
                asked = (places[at], quality[at], most)
                found[at] = worth(seen, lot.anchors, lot.panoramas, *asked)
            return found

        return candidates(description, self._voting(), self._settings, most, worths)

    def _some(self, identifiers: NDArray[np.int64], content: _Content) -> Landmarks:
        """Join the relations of single references, less any removed in between."""
        found = [content.find(identifier) for identifier in identifiers.tolist()]
        parts = [self._related(*each) for each in found if each is not None]
        return joined(parts) if parts else landmarks([], self._settings.proposal)

    def _related(self, lot: Lot, place: int) -> Landmarks:
        serial = int(lot.serials[place])
        relations = self._relations.get(serial)
        if relations is None:
            anchors = stack_anchors([lot.anchors.of(place)])
            pose = lot.poses[place : place + 1]
            relations = self._relations[serial] = related(anchors, pose, lot.settings)
        return relations

    def _know(self, lot: Lot, place: int) -> Known:
        serial = int(lot.serials[place])
        known = self._memory.get(serial)
        if known is None:
            reference = self._reference(lot, place)
            known = Known(reference, describe(reference.scan, self._settings))
            self._memory[serial] = known
        return known

    def _reference(self, lot: Lot, place: int) -> Reference:
        return lot.references[place] or self._read(int(lot.identifiers[place]))

    def _remembered(self, known: Known) -> Known:
        """Keep what is known of references to begin with, as far as there is room."""
        if len(self._memory) < _REMEMBERED:
            self._memory[len(self._memory)] = known
        return known


def candidates(
    description: Description,
    database: RelationshipDatabase,
    settings: Settings,
    most: int,
    worths: Callable[[View, NDArray[np.int64], NDArray[np.float64]], NDArray[np.float64]],
) -> Votes:
    """Choose references by votes, and among the first of these by what they saw.

    Args:
        description: Of the scan.
        database: Of the references.
        settings: Of all stages.
        most: How many are wanted.
        worths: Says what references are worth (``panorama.worth``), by their identifiers and
            q_m, to a view of the scan.
    """
    found, taken = [], looks(description, settings)
    few = settings.database.compared // len(taken)
    for look in taken:
        votes = database.votes(look.graph, max(most, few), look.spacings, len(taken))
        first = (votes.references[:few], votes.quality[:few])
        found.append((votes, worths(look.view, *first)))
    return reordered(found, most)


def compared(
    ours: Description,
    theirs: Description,
    T_reference_scan: NDArray[np.float64],
    settings: Settings,
) -> tuple[float, float]:
    """Compare a scan with a reference: e_m (section 5) and q_m (section 4.1).

    Args:
        ours: Description of the scan.
        theirs: That of the reference.
        T_reference_scan: (3,) x, y, theta, metres and radians.
        settings: Of all stages.
    """
    e_m, q_m = _compared(
        (ours.outline.rows, ours.outline.geometry, ours.graph.lengths),
        (theirs.outline.rows, theirs.outline.geometry, theirs.graph.lengths),
        T_reference_scan,
        tolerances(settings.evaluation),
        (settings.database.length_tolerance, settings.database.count_once),
    )
    return e_m, q_m


@kernel
def _compared(ours, theirs, T_reference_scan, tolerances, relation):  # type: ignore[no-untyped-def]
    """Compare two outlines and two graphs by the lengths of their edges, in one call."""
    rows, geometry, lengths = ours
    other_rows, other_geometry, other_lengths = theirs
    return (
        evaluation(rows, geometry, other_rows, other_geometry, T_reference_scan, tolerances),
        quality(lengths, other_lengths, relation[0], relation[1]),
    )


class _Passed(Iterator[Value]):
    """Values that one thread passes on to another until it is done."""

    def __init__(self) -> None:
        self._values: SimpleQueue[Value | None] = SimpleQueue()

    def put(self, value: Value, returned: Other) -> Other:
        """Pass on a value, and return another one."""
        self._values.put(value)
        return returned

    def __enter__(self) -> None:
        """Nothing is done yet."""

    def __exit__(self, *_: object) -> None:
        self._values.put(None)

    def __next__(self) -> Value:
        value = self._values.get()
        if value is None:
            self._values.put(None)  # for whoever asks again
            raise StopIteration
        return value


class _Memory(dict[int, Value]):
    """Values that can be made again: beyond a number of them the oldest goes."""

    def __init__(self) -> None:
        super().__init__()
        self._changing = threading.Lock()

    def __setitem__(self, serial: int, value: Value) -> None:
        with self._changing:
            if len(self) >= _REMEMBERED:
                del self[next(iter(self))]
            super().__setitem__(serial, value)


def _no_reading(identifier: int) -> Reference:
    raise ValueError(f"reference {identifier} is not in memory")


def _section(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    return {
        name.removeprefix(prefix): each for name, each in arrays.items() if name.startswith(prefix)
    }


def _lot_from(arrays: Mapping[str, NDArray[Any]], settings: Settings) -> Lot:
    """Make a lot of stored arrays, whose landmarks are there already."""
    anchors = AnchorStack(**_section(arrays, "anchors."))
    panoramas = arrays["references.panoramas"]
    identifiers, poses = arrays["references.identifiers"], arrays["references.poses"]
    count = len(identifiers)
    lot = Lot(
        identifiers,
        np.arange(count),
        poses,
        anchors,
        panoramas,
        [None] * count,
        np.ones(count, np.bool_),
        settings.proposal,
    )
    lot.check()
    landmarks = _section(arrays, "landmarks.")
    if landmarks:
        stored = Landmarks(**landmarks)
        check_landmarks(stored)
        lot.__dict__["landmarks"] = stored
    return lot


def _placed(reference: Reference) -> tuple[LaserScan, Pose2D]:
    """Scan and pose of a reference that has one."""
    if reference.pose is None:
        raise ValueError(f"reference {reference.identifier} has no pose")
    return reference.scan, reference.pose
