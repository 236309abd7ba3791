"""The reference set: the scans a robot can be located by, in memory and in one durable file.

A set holds reference scans, with poses in one common frame (a metric set) or without (a
topological one; section 1 of the paper names both uses).  What sections 2 to 4 of the paper
derive from the scans lives in the matcher, which is made when the first scan is to be located
and follows every change of the set.

A set built from a log keeps, beyond the paper, only what it needs: a scan becomes a reference
when no reference lies within a spacing and a heading of it.  The paper chose its 30 references
by hand.
"""

from __future__ import annotations

import math
import multiprocessing
import operator
import os
import struct
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, MutableMapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from hashlib import blake2b
from itertools import islice, product
from pathlib import Path
from typing import TYPE_CHECKING

from .derived_index import (
    DerivedIndex,
    IndexedReferences,
    index_path,
    read_index,
    write_index,
)
from .errors import AnchorscanError, ReferenceSetError, SettingsError
from .hypothesis import Hypothesis
from .pose import Pose2D
from .record import Record
from .reference import Reference
from .scan import LaserScan
from .set_directory import read_directory, write_directory
from .set_file import (
    FORMAT,
    MOST_READINGS,
    BuildState,
    Place,
    Sensor,
    SetChanges,
    SetContent,
    SetFile,
    checksum_of,
    create_set,
    number,
    read_changes,
    read_set,
    read_summary,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from .decision import Decision
    from .description import Description
    from .matcher import Candidates, Matcher, Trace
    from .settings import Settings
    from .verification import Fits

__all__ = ["ReferenceSet", "SetInfo"]

_BATCH = 256
# Between references, metres and radians, where nobody says it.
_SPACING, _HEADING = 2.0, math.radians(45.0)
# An index that is behind by more than this share of its references is no help.
_BEHIND_SHARE = 0.25
_CHUNKS = 8

# Cells a shade wider than the rule: rounding then never puts two neighbours two cells apart.
_CELL_SLACK = 1.0 + 1e-6
_SMALLEST_SIDE = 1e-3
_SMALLEST_SECTOR = 1e-6
_MOST_SECTORS = 1 << 16
_FARTHEST_CELL = 1e9
_AROUND = (-1, 0, 1)


@dataclass(frozen=True)
class SetInfo:
    """What a set is, in figures.

    Args:
        path: Its file, or None.
        size: Bytes of the file, or None.
        format: Format of the file.
        name: What the user calls it.
        references: Count of references.
        with_pose: Those of them with a pose.
        sensors: The distinct sensors of the scans, most used first, with their counts.
        bounds: Smallest x, smallest y, largest x, largest y of the poses, metres, set frame;
            None without poses.
        next_identifier: What the next reference will be called.
        build: How it was built from a log, if it was.
        index: Whether there is an index beside the file: ``none``, ``current``, ``behind`` (by a
            few references, which are derived on opening), ``outdated`` (of another version, of
            other settings, too far behind, or damaged: it counts for nothing), or ``unknown``
            when the settings are not understood.
        index_size: Bytes of the index, or None.
    """

    path: Path | None
    size: int | None
    format: int
    name: str
    references: int
    with_pose: int
    sensors: tuple[tuple[Sensor, int], ...]
    bounds: tuple[float, float, float, float] | None
    next_identifier: int
    build: BuildState | None
    index: str = "none"
    index_size: int | None = None


class ReferenceSet:
    """Reference scans, and where a scan was taken among them.

    A set with a path writes every change to its file before it returns, in one transaction;
    until ``close`` a log lies beside the file.  The references themselves are held in memory: a
    set shows what the file held when it was opened or refreshed, and its own changes.  Sets of
    several processes may share a file; writers take turns.

    Where ``save_index`` has left an index beside the file, opening maps that instead of reading
    all references and deriving all that they show.

    Made by ``build``, ``open``, ``import_directory``, or empty by the constructor.

    Args:
        name: What the user calls the set.
        settings: Settings of the matcher; None stands for the defaults.
        path: A file to create for it; None keeps the set in memory alone.

    Raises:
        ReferenceSetError: The file exists or cannot be written.
    """

    def __init__(
        self,
        *,
        name: str = "",
        settings: Settings | None = None,
        path: str | os.PathLike[str] | None = None,
    ):
        content = SetContent(name, _as_json(settings))
        if path is not None:
            create_set(Path(path), content)
        self._take(content, None if path is None else Path(path), settings)

    @classmethod
    def build(
        cls,
        records: Iterable[Record],
        *,
        spacing: float = _SPACING,
        heading: float = _HEADING,
        keep_all: bool = False,
        settings: Settings | None = None,
        name: str = "",
        path: str | os.PathLike[str] | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> ReferenceSet:
        """Choose references from a log, in its order, and store them as it goes.

        A scan becomes a reference when no reference lies within ``spacing`` **and** ``heading``
        of it.  Records without a pose, or without a scan that has a return, are counted and
        passed over.

        Where ``path`` holds a build of the same records by the same rule, it is continued after
        the last record that was stored: an interrupted build goes on, a finished one has
        nothing to do, that of a log that grew takes what is new.

        Args:
            records: In time order; read once, from the beginning.
            spacing: Metres, not negative.
            heading: Radians, not negative.
            keep_all: Keep every usable scan with a pose, whatever the rule says.
            settings: Settings to store; None stands for the defaults of whoever opens the set.
            name: What the user calls the set.
            path: File to build into; None keeps the set in memory.
            progress: Called now and then with the records read and the references kept so far.

        Raises:
            ReferenceSetError: No record makes a reference; the file at ``path`` is no set, or a
                set made of other records or by another rule; or it cannot be written.
            SettingsError: ``spacing`` or ``heading`` is negative or not a number.
        """
        start = _begun(spacing, heading, keep_all)
        if path is not None and os.path.lexists(path):
            places = cls._to_continue(Path(path), start, settings, name)
        else:
            places = cls(name=name, settings=settings)
            places.path = None if path is None else Path(path)
        try:
            places._grow(iter(records), start, progress)
        finally:
            places._let_go()
        return places

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        settings: Settings | None = None,
        use_index: bool = True,
    ) -> ReferenceSet:
        """Open a set's file; nothing is written to it before the set is changed.

        Args:
            path: The file.
            settings: Settings to use instead of those in the file.
            use_index: Whether to map the index beside the file, if that is current; otherwise
                every reference in the file is read and verified.

        Raises:
            ReferenceSetError: There is no such file, it is of another kind, newer, damaged, or
                not to be read.
        """
        places = cls.__new__(cls)
        if not (use_index and places._take_index(Path(path), settings)):
            places._take(read_set(Path(path)), Path(path), settings)
        return places

    @classmethod
    def import_directory(
        cls,
        directory: str | os.PathLike[str],
        *,
        settings: Settings | None = None,
        path: str | os.PathLike[str] | None = None,
    ) -> ReferenceSet:
        """Read a set from a directory as ``export_directory`` writes it.

        Args:
            directory: With ``references.csv``, ``scans/`` and, if it is there, ``set.json``.
            settings: Settings instead of those in the directory.
            path: A file to create for the set; None keeps it in memory.

        Raises:
            ReferenceSetError: Something is missing or malformed, named with its line; or the
                file exists or cannot be written.
        """
        content = read_directory(Path(directory))
        if settings is not None:
            content = replace(content, settings=_as_json(settings))
        if path is not None:
            create_set(Path(path), content)
        places = cls.__new__(cls)
        places._take(content, None if path is None else Path(path), settings)
        return places

    def _take(self, content: SetContent, path: Path | None, settings: Settings | None) -> None:
        self.path = path
        self._lock = threading.RLock()
        self._given_settings = settings
        self._file: SetFile | None = None
        self._is_closed = False
        self._references: MutableMapping[int, Reference]
        self._listed: tuple[Reference, ...] | None
        self._index: DerivedIndex | None
        self._adopt(content)

    def _take_index(self, path: Path, settings: Settings | None) -> bool:
        """Take the set from its index and what has changed since, if the index counts."""
        found = _read_indexed(path, settings)
        if found is None:
            return False
        index, changes = found
        self._take(changes.content, path, settings)
        references = IndexedReferences(index)
        for identifier in changes.gone.tolist():
            del references[identifier]
        for reference in changes.content.references:
            references[reference.identifier] = reference
        self._references = references
        self._listed = None
        self._index = index
        return True

    def _adopt(self, content: SetContent) -> None:
        self.name = content.name
        self._stored_settings = content.settings
        self._settings = self._given_settings
        self._build = content.build
        self._next_identifier = content.next_identifier
        self._references = {reference.identifier: reference for reference in content.references}
        self._index = None
        self._listed = content.references
        self._matcher: Matcher | None = None

    @property
    def references(self) -> tuple[Reference, ...]:
        """The references in the order of their identifiers."""
        listed = self._listed
        if listed is None:
            with self._lock:
                listed = tuple(map(self._references.__getitem__, sorted(self._references)))
                self._listed = listed
        return listed

    @property
    def has_poses(self) -> bool:
        """Whether every reference has a pose; those of an index have, and are not read for it."""
        with self._lock:
            known = self._references
            told = known.added if isinstance(known, IndexedReferences) else list(known.values())
        return all(reference.pose is not None for reference in told)

    def __len__(self) -> int:
        return len(self._references)

    def __iter__(self) -> Iterator[Reference]:
        return iter(self.references)

    def __contains__(self, identifier: object) -> bool:
        return identifier in self._references

    def __getitem__(self, identifier: int) -> Reference:
        """Return the reference with an identifier.

        Raises:
            ReferenceSetError: There is none.
        """
        try:
            return self._references[identifier]
        except KeyError:
            raise ReferenceSetError(f"there is no reference {identifier}") from None

    @property
    def settings(self) -> Settings:
        """The settings of the matcher: those given, else those stored, else the defaults.

        Raises:
            SettingsError: Those stored are not understood; give others on opening.
        """
        if self._settings is None:
            from .settings import Settings

            stored = self._stored_settings
            try:
                self._settings = Settings.from_json(stored) if stored else Settings.preset()
            except SettingsError as error:
                raise SettingsError(
                    f"{self.path}: its settings are not understood ({error}); open it with others"
                ) from None
        return self._settings

    def info(self) -> SetInfo:
        """Return what the set is, in figures."""
        sensors: dict[Sensor, int] = {}
        for reference in self.references:
            sensor = Sensor.of(reference.scan)
            sensors[sensor] = sensors.get(sensor, 0) + 1
        poses = [reference.pose for reference in self.references if reference.pose is not None]
        bounds = None
        if poses:
            x, y = [pose.x for pose in poses], [pose.y for pose in poses]
            bounds = (min(x), min(y), max(x), max(y))
        size = None
        if self.path is not None and self.path.exists():
            size = self.path.stat().st_size
        return SetInfo(
            self.path,
            size,
            FORMAT,
            self.name,
            len(self),
            len(poses),
            tuple(sorted(sensors.items(), key=lambda item: -item[1])),
            bounds,
            self._next_identifier,
            self._build,
            *self._index_state(),
        )

    def _index_state(self) -> tuple[str, int | None]:
        """Say what there is of an index, and its size."""
        if self.path is None or not os.path.isfile(index_path(self.path)):
            return "none", None
        size = index_path(self.path).stat().st_size
        try:
            found = _read_indexed(self.path, self.settings)
        except SettingsError:
            return "unknown", size
        if found is None:
            return "outdated", size
        _, changes = found
        return "behind" if len(changes.gone) or changes.content.references else "current", size

    def add(self, scan: LaserScan, pose: Pose2D | None = None, name: str = "") -> int:
        """Add a reference.

        Args:
            scan: The laser scan.
            pose: ``T_set_laser``; None in a topological set.
            name: What the user calls the place.

        Returns:
            Its identifier.

        Raises:
            ReferenceSetError: The pose is not finite, or the file cannot be written.
        """
        return self.add_batch([scan], [pose], [name])[0]

    def add_batch(
        self,
        scans: Sequence[LaserScan],
        poses: Sequence[Pose2D | None] | None = None,
        names: Sequence[str] | None = None,
    ) -> list[int]:
        """Add references, all or none, in one transaction.

        Args:
            scans: The laser scans.
            poses: ``T_set_laser`` of each; None where no scan has one.
            names: A name for each; None where no place has one.

        Returns:
            Their identifiers, rising.

        Raises:
            ReferenceSetError: The lengths differ, a pose is not finite, or the file cannot be
                written.
        """
        poses = [None] * len(scans) if poses is None else poses
        names = [""] * len(scans) if names is None else names
        if not len(scans) == len(poses) == len(names):
            raise ReferenceSetError(
                f"{len(scans)} scans, {len(poses)} poses and {len(names)} names do not go together"
            )
        return self._store([Place(*place) for place in zip(scans, poses, names, strict=True)])

    def extend(
        self,
        records: Iterable[Record],
        *,
        spacing: float | None = None,
        heading: float | None = None,
        keep_all: bool = False,
    ) -> BuildState:
        """Add references from another log whose poses are in the frame of the set.

        Chosen as ``build`` does: where no reference lies within ``spacing`` and ``heading``.
        They are stored as they come; one that is interrupted can be repeated, unless all is kept.

        Args:
            records: In any order.
            spacing: Metres, not negative; None is that of the set's build, or 2.
            heading: Radians, not negative; None likewise, or 45 degrees.
            keep_all: Keep every usable scan with a pose, whatever the rule says.

        Returns:
            The rule, and what was read.

        Raises:
            ReferenceSetError: The file cannot be written.
            SettingsError: ``spacing`` or ``heading`` is negative or not a number.
        """
        rule = self._build or BuildState(_SPACING, _HEADING, False)
        spacing = rule.spacing if spacing is None else spacing
        heading = rule.heading if heading is None else heading
        state = _begun(spacing, heading, keep_all)
        neighbourhood = self._neighbourhood(state)
        for batch in _batches(records):
            kept, state = _choose(batch, state, neighbourhood)
            self._store(kept)
        return replace(state, finished=True)

    def remove(self, identifier: int) -> None:
        """Remove a reference; its identifier is never used again.

        Raises:
            ReferenceSetError: There is none, or the file cannot be written.
        """
        identifier = operator.index(identifier)
        with self._lock:
            if self.path is None:
                self[identifier]
            else:  # the file knows of those that others have added, too
                known = checksum_of(self[identifier]) if identifier in self else None
                self._writer().remove(identifier, known)
            if identifier in self:
                self._forget(identifier)

    def refresh(self) -> bool:
        """Take over what others have written to the file since it was read.

        Returns:
            Whether references, settings or the name had changed.

        Raises:
            ReferenceSetError: As for ``open``.
        """
        if self.path is None:
            return False
        with self._lock:
            if self._file is not None:  # another file would be read with this one's log
                self._file.check()
            content = read_set(self.path)
            fresh = {reference.identifier: reference for reference in content.references}
            old = self._references
            shared = old.keys() & fresh.keys()
            if not all(_are_same(old[identifier], fresh[identifier]) for identifier in shared):
                self._adopt(content)  # not a later state of what was read, but another set
                return True
            self._next_identifier, self._build = content.next_identifier, content.build
            if self._given_settings is None and content.settings != self._stored_settings:
                self._adopt(content)  # what was derived was derived with others
                return True
            is_renamed = content.name != self.name
            self.name, self._stored_settings = content.name, content.settings
            gone, new = old.keys() - shared, sorted(fresh.keys() - shared)
            for identifier in gone:
                self._forget(identifier)
            for identifier in new:
                self._remember(fresh[identifier])
            return bool(gone or new or is_renamed)

    def locate(self, scan: LaserScan, candidates: Candidates = None) -> list[Hypothesis]:
        """Find where a scan may have been taken.

        Args:
            scan: From any sensor, in the frame of its laser.
            candidates: How many references may propose places; None leaves that to the
                settings.

        Returns:
            Hypotheses, best first; none only for an unusable scan or from an empty set.
        """
        return self._prepared().locate(scan, candidates)

    def locate_batch(
        self,
        scans: Iterable[LaserScan],
        candidates: Candidates = None,
        processes: int = 1,
    ) -> list[list[Hypothesis]]:
        """Find where each of many scans may have been taken, each on its own.

        Args:
            scans: From any sensors.
            candidates: As for ``locate``.
            processes: How many processes share the work.

        Returns:
            For every scan what ``locate`` returns, whatever the number of processes.
        """
        scans = list(scans)
        matcher = self._prepared()
        processes = min(processes, len(scans))
        if processes <= 1:
            return [matcher.locate(scan, candidates) for scan in scans]
        matcher.prepare()
        # A forked worker shares references and compiled kernels; forking threads is unsafe.
        can_fork = sys.platform == "linux" and threading.active_count() == 1
        with ProcessPoolExecutor(
            processes,
            multiprocessing.get_context("fork" if can_fork else "spawn"),
            _start_worker,
            (lambda: matcher,) if can_fork else (partial(type(matcher), *self._matched()),),
        ) as pool:
            chunk = max(1, len(scans) // (processes * _CHUNKS))
            return list(pool.map(partial(_work, candidates), scans, chunksize=chunk))

    def explain(self, scan: LaserScan, candidates: Candidates = None) -> Trace:
        """Do what ``locate`` does and return every intermediate value."""
        return self._prepared().explain(scan, candidates)

    def fits(self, description: Description) -> Fits | None:
        """Search for a scan without a decision, as ``Matcher.fits`` does."""
        return self._prepared().fits(description)

    def hypotheses(
        self, description: Description, fits: Fits, decision: Decision
    ) -> tuple[Hypothesis, ...]:
        """Make hypotheses of fits decided on elsewhere, as ``Matcher.hypotheses`` does."""
        return self._prepared().hypotheses(description, fits, decision)

    def follow(
        self, scan: LaserScan, poses: NDArray[np.float64], stiffness: NDArray[np.float64]
    ) -> Fits:
        """Refine poses that are expected, as ``Matcher.follow`` does."""
        return self._prepared().follow(scan, poses, stiffness)

    def nearest(self, poses: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Name the reference taken nearest to each pose, as ``Matcher.nearest`` does."""
        return self._prepared().nearest(poses)

    def prepare(self) -> None:
        """Do now what the first query would wait for: derive the index, compile kernels."""
        self._prepared().prepare()

    def save_index(self) -> None:
        """Write what is derived from the references beside the set's file, for later openings.

        An index of all references takes as long as the first query of a set without one, and
        some three kilobytes a reference; ``derived_index`` says what is in it.  Where the index
        is current nothing is written.

        Raises:
            ReferenceSetError: The set has no file, has references that are not searched as one
                map, or the index cannot be written; an index that was there is as it was.
        """
        if self.path is None:
            raise ReferenceSetError("a set in memory has no index; save it to a file and open that")
        with self._lock:
            if self._index_state()[0] == "current":
                return
            try:
                derived = self._prepared().arrays()
            except ValueError as error:
                raise ReferenceSetError(f"{self.path}: {error}") from None
            write_index(self.path, self.references, derived, self.settings)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the set to a file, whole or not at all; the set stays with the file it has.

        A set in a file already there is replaced, in one transaction; its readers go on with
        what they have read.  Onto its own file a set writes its name and its settings, since
        all else is there.

        Raises:
            ReferenceSetError: At ``path`` is something else than a set, or it cannot be
                written.
        """
        path = Path(path)
        with self._lock:
            content = self._content()
            if self.path is not None and _is_one_file(path, self.path):
                self._writer().describe(content.name, content.settings)
            elif os.path.lexists(path):
                with SetFile(path) as file:
                    file.replace(content)
            else:
                create_set(path, content)

    def export_directory(self, path: str | os.PathLike[str]) -> None:
        """Write the set as a plain directory: poses as CSV, scans as ``.npy``.

        Raises:
            ReferenceSetError: ``path`` exists and is not an empty directory, or it cannot be
                written.
        """
        write_directory(Path(path), self._content())

    def close(self) -> None:
        """Let go of the file, which then stands alone; the set can still locate.

        Raises:
            ReferenceSetError: The file could not be made to stand alone; all is stored, in it
                and in the log beside it.
        """
        self._is_closed = True
        self._let_go()

    def __enter__(self) -> ReferenceSet:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        place = "in memory" if self.path is None else f"in {str(self.path)!r}"
        return f"<ReferenceSet {self.name!r} {place}, {len(self)} references>"

    def _content(self) -> SetContent:
        settings = _as_json(self._given_settings) or self._stored_settings
        return SetContent(self.name, settings, self._next_identifier, self.references, self._build)

    def _prepared(self) -> Matcher:
        matcher = self._matcher
        if matcher is None:
            with self._lock:
                matcher = self._matcher
                if matcher is None:
                    matcher = self._indexed()
                if matcher is None:
                    matcher = self._derived()
                self._matcher = matcher
        return matcher

    def _derived(self) -> Matcher:
        from .matcher import Matcher

        return Matcher(*self._matched())

    def _indexed(self) -> Matcher | None:
        """Make the matcher of the index and what has changed since."""
        if self._index is None or not isinstance(self._references, IndexedReferences):
            return None
        from .matcher import Matcher

        try:
            matcher = Matcher.from_arrays(self._index.arrays, self.settings, self._index.read)
            for identifier in self._references.gone:
                matcher.remove(identifier)
            for reference in self._references.added:
                matcher.add(reference)
        except (ValueError, KeyError, IndexError, AnchorscanError):
            # It contradicts itself: then it is as good as none, and its scans are no better.
            assert self.path is not None
            self._adopt(read_set(self.path))
            return None
        return matcher

    def _matched(self) -> tuple[tuple[Reference, ...], Settings]:
        """Return what a matcher is made of."""
        return self.references, self.settings

    def _writer(self) -> SetFile:
        if self.path is None or self._is_closed:
            raise ReferenceSetError(f"{self.path}: this set was closed; open it again to change it")
        if self._file is None:
            self._file = SetFile(self.path)
        return self._file

    def _let_go(self) -> None:
        with self._lock:
            file, self._file = self._file, None
            if file is not None:
                file.close()

    def check_room(self, poses: Iterable[Pose2D | None]) -> None:
        """See that references at some poses can be searched together with those that are there.

        Raises:
            ReferenceSetError: They lie too far from the origin, or from the others.
        """
        try:
            self._prepared().check_room(pose for pose in poses if pose is not None)
        except AnchorscanError as error:
            raise ReferenceSetError(f"{self.path or 'the set'}: {error}") from None

    def _store(self, places: list[Place]) -> list[int]:
        """Add references in file and memory."""
        with self._lock:
            if self._matcher is not None:  # a set in use stays of use
                self.check_room(place.pose for place in places)
            if self.path is None:
                references = number(places, self._next_identifier)
            else:
                references = self._writer().append(places, known=self._next_identifier)
            for reference in references:
                self._remember(reference)
            return [reference.identifier for reference in references]

    @classmethod
    def _to_continue(
        cls, path: Path, start: BuildState, settings: Settings | None, name: str
    ) -> ReferenceSet:
        """Open what an earlier build has left, if it was the same build."""
        places = cls.open(path)
        build = places._build
        if build is None:
            difference = "was not built from a log"
        elif _rule_of(start) != _rule_of(build):
            difference = f"was built by another rule ({_in_words(build)})"
        elif settings is not None and _as_json(settings) != places._stored_settings:
            difference = "was built with other settings"
        elif name and name != places.name:
            difference = f"was built with another name ({places.name!r})"
        else:
            return places
        raise ReferenceSetError(f"{path}: exists and {difference}; choose another path")

    def _grow(
        self,
        records: Iterator[Record],
        start: BuildState,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        """Take in all records, the stored part of them only to see that they are the same."""
        if self._build is None:
            self._build = start
        state = self._build
        self._check_trail(records, state)
        neighbourhood = self._neighbourhood(state)
        for batch in _batches(records):
            kept, state = _choose(batch, state, neighbourhood)
            self._advance(kept, state)
            if progress is not None:
                progress(state.consumed, len(self))
        if not self._next_identifier:
            raise ReferenceSetError(_nothing_kept(state))
        if not state.finished:
            self._advance([], replace(state, finished=True))

    def _neighbourhood(self, state: BuildState) -> _Neighbourhood:
        """Where there are references, by a rule."""
        neighbourhood = _Neighbourhood(state.spacing, state.heading)
        for reference in self.references:
            if reference.pose is not None:
                neighbourhood.add(reference.pose)
        return neighbourhood

    def _check_trail(self, records: Iterator[Record], state: BuildState) -> None:
        trail, count = bytes(16), 0
        for record in islice(records, state.consumed):
            trail, count = _follow(trail, record), count + 1
        if (count, trail) != (state.consumed, state.trail):
            raise ReferenceSetError(
                f"{self.path}: exists and was built from other records; choose another path"
            )

    def _advance(self, kept: list[Place], state: BuildState) -> None:
        """Store one batch of a build; its file comes into being with the first reference."""
        if self.path is None:
            self._store(kept)
        elif kept or os.path.lexists(self.path):
            if not os.path.lexists(self.path):
                create_set(self.path, self._content())
            known = self._next_identifier
            for reference in self._writer().append(kept, state, self._build, known):
                self._remember(reference)
        self._build = state

    def _remember(self, reference: Reference) -> None:
        self._references[reference.identifier] = reference
        self._next_identifier = max(self._next_identifier, reference.identifier + 1)
        self._listed = None
        self._follow(lambda matcher: matcher.add(reference))

    def _forget(self, identifier: int) -> None:
        del self._references[identifier]
        self._listed = None
        self._follow(lambda matcher: matcher.remove(identifier))

    def _follow(self, change: Callable[[Matcher], None]) -> None:
        """Have the matcher follow a change; where it cannot, the next search makes another."""
        if self._matcher is not None:
            try:
                change(self._matcher)
            except (AnchorscanError, ValueError, KeyError):
                self._matcher = None


def _read_indexed(path: Path, settings: Settings | None) -> tuple[DerivedIndex, SetChanges] | None:
    """Read the index of a set and what has changed since, if the index counts.

    Raises:
        ReferenceSetError: The set's file is damaged, or cannot be read.
    """
    # `Path.is_file` raises where it may not look; reading the set then says so.
    if not os.path.isfile(index_path(path)):
        return None
    if settings is None:
        from .settings import Settings

        stored = read_summary(path).settings
        try:
            settings = Settings.from_json(stored) if stored else Settings.preset()
        except SettingsError:
            return None
    index = read_index(path, settings)
    if index is None:
        return None
    changes = read_changes(path, index.identifiers, index.checksums)
    if changes is None:
        return None
    count = len(changes.gone) + len(changes.content.references)
    return (index, changes) if count <= _BEHIND_SHARE * len(index.identifiers) else None


class _Neighbourhood:
    """Poses in a grid over position and heading, to ask whether one is near another."""

    def __init__(self, spacing: float, heading: float):
        self._spacing, self._heading = spacing, heading
        self._side = max(spacing * _CELL_SLACK, _SMALLEST_SIDE)
        sectors = int(min(math.tau / max(heading * _CELL_SLACK, _SMALLEST_SECTOR), _MOST_SECTORS))
        # With fewer than three, the sectors on both sides of one are the same sector.
        self._sectors = sectors if sectors > len(_AROUND) else 1
        self._cells: dict[tuple[int, int, int], list[Pose2D]] = {}

    def add(self, pose: Pose2D) -> None:
        self._cells.setdefault(self._cell(pose), []).append(pose)

    def is_near(self, pose: Pose2D) -> bool:
        """Tell whether a pose lies within the spacing and the heading of this one."""
        x, y, sector = self._cell(pose)
        turns = _AROUND if self._sectors > 1 else (0,)
        for i, j, k in product(_AROUND, _AROUND, turns):
            for other in self._cells.get((x + i, y + j, (sector + k) % self._sectors), ()):
                if pose.distance(other) <= self._spacing and pose.turn(other) <= self._heading:
                    return True
        return False

    def _cell(self, pose: Pose2D) -> tuple[int, int, int]:
        sector = int((pose.theta + math.pi) / math.tau * self._sectors) % self._sectors
        return self._index(pose.x), self._index(pose.y), sector

    def _index(self, coordinate: float) -> int:
        # What is too far out for exact cells shares the last one: slower, but right.
        return math.floor(min(max(coordinate / self._side, -_FARTHEST_CELL), _FARTHEST_CELL))


def _begun(spacing: float, heading: float, keep_all: bool) -> BuildState:
    """Begin to choose by a rule.

    Raises:
        SettingsError: It is none.
    """
    if not (spacing >= 0.0 and heading >= 0.0):
        raise SettingsError(
            f"spacing and heading must not be negative, not {spacing} and {heading}"
        )
    return BuildState(float(spacing) + 0.0, float(heading) + 0.0, bool(keep_all))


def _batches(records: Iterable[Record]) -> Iterator[list[Record]]:
    """Take some records at a time, each stored as one."""
    left = iter(records)
    return iter(lambda: list(islice(left, _BATCH)), [])


def _choose(
    batch: list[Record], state: BuildState, neighbourhood: _Neighbourhood
) -> tuple[list[Place], BuildState]:
    """Return what to keep of a batch, and where the build stands after it."""
    kept: list[Place] = []
    trail, unusable, without_pose = state.trail, state.unusable, state.without_pose
    for record in batch:
        trail = _follow(trail, record)
        scan, pose = record.scan, record.pose
        if scan is None or len(scan) > MOST_READINGS or not scan.is_return.any():
            unusable += 1
        elif pose is None or not pose.is_finite():
            without_pose += 1
        elif state.keep_all or not neighbourhood.is_near(pose):
            neighbourhood.add(pose)
            kept.append(Place(scan, pose))
    return kept, replace(
        state,
        consumed=state.consumed + len(batch),
        unusable=unusable,
        without_pose=without_pose,
        trail=trail,
        finished=False,
    )


def _follow(trail: bytes, record: Record) -> bytes:
    """Return 16 bytes that stand for the records so far and this one."""
    digest = blake2b(trail, digest_size=16)
    scan, pose = record.scan, record.pose
    if pose is not None:
        digest.update(b"pose" + struct.pack("<3d", pose.x, pose.y, pose.theta))
    if scan is not None:
        geometry = (scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
        digest.update(b"scan" + struct.pack("<4d", *geometry))
        digest.update(scan.ranges.astype("<f4", copy=False).tobytes())
    return digest.digest()


def _rule_of(build: BuildState) -> tuple[float, float, bool]:
    return build.spacing, build.heading, build.keep_all


def _in_words(build: BuildState) -> str:
    if build.keep_all:
        return "every scan"
    return f"spacing {build.spacing:g} m, heading {math.degrees(build.heading):g} degrees"


def _nothing_kept(state: BuildState) -> str:
    if not state.consumed:
        return "there is no record to build a reference set from"
    return (
        f"none of {state.consumed} records makes a reference: {state.unusable} have no usable "
        f"scan, {state.without_pose} no pose"
    )


def _as_json(settings: Settings | None) -> str:
    return "" if settings is None else settings.to_json()


def _is_one_file(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:
        return False


def _are_same(one: Reference, other: Reference) -> bool:
    """Tell whether two references are alike to the last bit."""
    return (
        one.pose == other.pose
        and one.name == other.name
        and Sensor.of(one.scan) == Sensor.of(other.scan)
        and one.scan.ranges.tobytes() == other.scan.ranges.tobytes()
    )


# The matcher of a worker process: set once when it starts.
_workers_matcher: Matcher | None = None


def _start_worker(make: Callable[[], Matcher]) -> None:
    global _workers_matcher  # noqa: PLW0603 - a worker process holds nothing else
    _workers_matcher = make()


def _work(candidates: Candidates, scan: LaserScan) -> list[Hypothesis]:
    assert _workers_matcher is not None
    return _workers_matcher.locate(scan, candidates)
