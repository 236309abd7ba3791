"""A folder of reference sets that several processes serve and change together.

The files are the truth: every process has the sets of the folder in its own memory, opened when
first asked for, and looks at the stamps of a file and of the log beside it before each use, which
costs some microseconds.  Where they have changed, it takes over what others have written before
it answers.  So a process sees its own writes at once and those of others with the next question,
and a process that dies takes nothing with it: what counts is on disk.

A *version* is a digest of all that a set holds: the same content has the same version in every
process and on every machine, and other content another one.

Not safe for threads: one thread of a process has the shelf, so that no set can change between
the look at its version and its answer.
"""

from __future__ import annotations

import os
import re
import secrets
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path

from .errors import ReferenceSetError
from .fleet import Fleet
from .reference import Reference
from .reference_set import ReferenceSet
from .set_file import Place, SetFile

__all__ = ["NAME", "Kept", "Shelf", "UnknownSetError"]

NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
"""What the name of a set may be: it becomes the name of a file."""

_NAME = re.compile(NAME, re.ASCII)
_SUFFIX = ".apr"
# Stamps of files are coarse: one that is younger than this may hide another change, nanoseconds.
_SETTLED = 50_000_000

_Stamp = tuple[tuple[int, int, int] | None, ...]


class UnknownSetError(ReferenceSetError):
    """There is no set of that name in the folder."""


@dataclass(eq=False)
class Kept:
    """A set in memory.

    Args:
        name: Its name.
        places: The set.
        stamp: Of its file when it was read; None where another look is needed.
        version: Digest of its content.
    """

    name: str
    places: ReferenceSet
    stamp: _Stamp | None
    version: str = ""
    digests: dict[int, tuple[Reference, int]] = field(default_factory=dict)

    def sign(self) -> None:
        """Bring the version up to the content; references that were signed are not read again."""
        references = self.places.references
        old, total = self.digests, 0
        self.digests = {}
        for reference in references:
            signed = old.get(reference.identifier)
            if signed is None or signed[0] is not reference:
                signed = reference, _digest(reference)
            self.digests[reference.identifier] = signed
            total += signed[1]
        settings = self.places.settings.to_json()
        text = f"{total % (1 << 128):x} {len(references)} {self.places.name} {settings}"
        self.version = blake2b(text.encode(), digest_size=8).hexdigest()


class Shelf:
    """The sets of a folder.

    Args:
        folder: Where they are: NAME.apr is the set NAME.

    Raises:
        ReferenceSetError: There is no such folder.
    """

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise ReferenceSetError(f"{folder}: is not a folder")
        self.folder = folder
        self._kept: dict[str, Kept] = {}
        self._writers: dict[str, tuple[int, SetFile]] = {}
        self._fleet: tuple[tuple[tuple[str, str], ...], Fleet] | None = None

    def names(self) -> list[str]:
        """Name the sets that are in the folder now."""
        names = (path.name.removesuffix(_SUFFIX) for path in self.folder.glob(f"*{_SUFFIX}"))
        return sorted(name for name in names if _NAME.fullmatch(name))

    def take(self, name: str) -> Kept:
        """Give a set as its file has it now.

        Raises:
            UnknownSetError: There is none.
            ReferenceSetError: It cannot be read.
        """
        path = self._path(name)
        stamp = _stamp(path)
        if stamp[0] is None:
            self._kept.pop(name, None)
            raise UnknownSetError(f"there is no set {name}")
        kept = self._kept.get(name)
        if kept is not None and kept.stamp == stamp:
            return kept
        if kept is None:
            kept = Kept(name, ReferenceSet.open(path), None)
        else:
            kept.places.refresh()
        kept.stamp = stamp if _is_settled(stamp) else None
        kept.sign()
        self._kept[name] = kept
        return kept

    def fleet(self) -> tuple[Fleet, dict[str, str]]:
        """Give all sets that have references as one fleet, and their versions.

        Raises:
            ReferenceSetError: There is none, or they cannot be asked together.
            SettingsError: They have different settings.
        """
        kept = [each for each in map(self.take, self.names()) if len(each.places)]
        versions = tuple((each.name, each.version) for each in kept)
        if self._fleet is None or self._fleet[0] != versions:
            self._fleet = versions, Fleet({each.name: each.places for each in kept})
        return self._fleet[1], dict(versions)

    def add(self, name: str, places: Sequence[Place]) -> tuple[list[int], str]:
        """Add references, all or none; they are on disk when this returns.

        Returns:
            Their identifiers, and the version of the set with them.

        Raises:
            UnknownSetError: There is no such set.
            ReferenceSetError: It cannot be written, or not be searched with them.
        """
        kept = self.take(name)
        kept.places.check_room(place.pose for place in places)
        kept.stamp = None  # whatever happens, look again
        # Past the set in memory, which another process may have overtaken.
        stored = self._writer(name).append(places)
        return [reference.identifier for reference in stored], self.take(name).version

    def put(self, name: str, data: bytes) -> tuple[Kept, bool]:
        """Put a set's file into the folder, in place of what has that name: one transaction.

        Returns:
            The set, and whether the name is new.

        Raises:
            ReferenceSetError: The data are no set, or it cannot be written.
            SettingsError: Its settings are not understood.
        """
        path = self._path(name)
        with self._draft(data) as draft:
            try:
                with ReferenceSet.open(draft) as places:
                    _ = places.settings  # understood, or refused here
                    is_new = not path.exists()
                    places.save(path)
            except ReferenceSetError as error:
                raise ReferenceSetError(str(error).replace(f"{draft}: ", "")) from None
        return self.take(name), is_new

    def close(self) -> None:
        """Let go of all files."""
        for _, writer in self._writers.values():
            with suppress(ReferenceSetError):  # all is stored, in the file and its log
                writer.close()
        self._writers.clear()
        self._kept.clear()

    def _writer(self, name: str) -> SetFile:
        """Give the writer of a set; a new one where the file is not the one it has open."""
        path = self._path(name)
        now = _stamp(path)[0]
        inode, writer = self._writers.get(name, (None, None))
        if writer is None or now is None or inode != now[0]:
            if writer is not None:
                with suppress(ReferenceSetError):  # that its file is another one is known
                    writer.close()
            writer = SetFile(path)
            self._writers[name] = path.stat().st_ino, writer
        return writer

    def _path(self, name: str) -> Path:
        if not _NAME.fullmatch(name):
            raise UnknownSetError("a name is up to 64 letters, digits, '_' and '-'")
        return self.folder / f"{name}{_SUFFIX}"

    @contextmanager
    def _draft(self, data: bytes) -> Iterator[Path]:
        draft = self.folder / f".{os.getpid()}-{secrets.token_hex(4)}.upload"
        try:
            try:
                draft.write_bytes(data)
            except OSError as error:
                raise ReferenceSetError(f"cannot be written: {error.strerror}") from None
            yield draft
        finally:
            draft.unlink(missing_ok=True)


def _digest(reference: Reference) -> int:
    """Sign all that a reference means."""
    scan, pose = reference.scan, reference.pose
    geometry = (scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
    place = None if pose is None else (pose.x, pose.y, pose.theta)
    text = repr((reference.identifier, reference.name, place, geometry))
    return int.from_bytes(
        blake2b(text.encode() + scan.ranges.tobytes(), digest_size=16).digest(), "big"
    )


def _stamp(path: Path) -> _Stamp:
    """Return what changes with every write to a set's file or to the log beside it."""
    return tuple(map(_file_stamp, (str(path), f"{path}-wal")))


def _file_stamp(path: str) -> tuple[int, int, int] | None:
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size


def _is_settled(stamp: _Stamp) -> bool:
    now = time.time_ns()
    return all(part is None or now - part[1] > _SETTLED for part in stamp)
