"""The one file that a reference set is kept in: scans, poses, names, sensors, settings.

The file is an SQLite database of format 1, marked by ``APPLICATION`` in its header.  What
anchors and edges can be computed from is stored; anchors and edges are not (``derived_index``
keeps them beside it), so nothing in the file can grow stale.  A reference is written once and
never changed:

* ``reference``: a row per reference, the ranges as little-endian float32 exactly as given,
  ``T_set_laser`` as three numbers or three NULLs, and a checksum over everything the row means;
* ``sensor``: the geometry of every distinct sensor, shared by its scans;
* ``reference_set``: one row with name, settings, the next identifier, and the count and the
  combined checksum of all references, so that a lost row is noticed as surely as a changed one;
* ``build``: at most one row, how far a build has come.

Every change is one transaction in a write-ahead log, synchronised to disk before it counts as
done.  When the last writer closes, the log is folded in and the journal mode set back, so that
the file at rest is one file that can be copied, mailed, and read in a read-only folder.

Nothing in a file is believed: header, schema, types, sizes and checksums are verified before
a value is used, and the sizes before the memory for them is taken.
"""

from __future__ import annotations

import os
import secrets
import sqlite3
import stat
import struct
import threading
import time
import weakref
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import astuple, dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .array_file import keep_names
from .errors import ReferenceSetError, ScanError
from .pose import Pose2D
from .reference import Reference
from .scan import LaserScan

__all__ = [
    "APPLICATION",
    "FORMAT",
    "LAST_IDENTIFIER",
    "LONGEST_NAME",
    "MOST_READINGS",
    "BuildState",
    "Place",
    "Sensor",
    "SetChanges",
    "SetContent",
    "SetFile",
    "checksum_of",
    "create_set",
    "number",
    "read_changes",
    "read_set",
    "read_summary",
]

APPLICATION = 0x41505253
"""``application_id`` in the header of the file: "APRS"."""

FORMAT = 1
"""``user_version`` in the header of the file: the newest format that is read and written."""

MOST_READINGS = 1 << 20
"""The most readings that a stored scan may have."""

LONGEST_NAME = 4096
"""The longest name of a set or of a reference, bytes of UTF-8."""

# Five scans of 360 readings fill a page; on pages of 4096 bytes the file is a quarter larger.
_PAGE_SIZE = 8192
_LONGEST_SETTINGS = 1 << 20
_LARGEST_VALUE = 1 << 24
LAST_IDENTIFIER = 1 << 53
_PATIENCE = 5.0
_CLOSING_PATIENCE = 1.0
_PAUSE = 0.01

_SCHEMA = {
    "reference_set": "CREATE TABLE reference_set (name TEXT NOT NULL, settings TEXT NOT NULL, "
    "next_identifier INTEGER NOT NULL, count INTEGER NOT NULL, content INTEGER NOT NULL, "
    "checksum INTEGER NOT NULL)",
    "sensor": "CREATE TABLE sensor (identifier INTEGER PRIMARY KEY, readings INTEGER NOT NULL, "
    "angle_min REAL NOT NULL, angle_increment REAL NOT NULL, range_min REAL NOT NULL, "
    "range_max REAL NOT NULL)",
    "sensor_geometry": "CREATE UNIQUE INDEX sensor_geometry ON sensor "
    "(readings, angle_min, angle_increment, range_min, range_max)",
    "reference": "CREATE TABLE reference (identifier INTEGER PRIMARY KEY, sensor INTEGER "
    "NOT NULL, x REAL, y REAL, theta REAL, name TEXT NOT NULL, checksum INTEGER NOT NULL, "
    "ranges BLOB NOT NULL)",
    "build": "CREATE TABLE build (spacing REAL NOT NULL, heading REAL NOT NULL, "
    "keep_all INTEGER NOT NULL, consumed INTEGER NOT NULL, unusable INTEGER NOT NULL, "
    "without_pose INTEGER NOT NULL, trail BLOB NOT NULL, finished INTEGER NOT NULL, "
    "checksum INTEGER NOT NULL)",
}

_SELECT_REFERENCES = f"""
    SELECT reference.identifier, readings, angle_min, angle_increment, range_min, range_max,
        x, y, theta,
        CASE WHEN length(CAST(name AS BLOB)) <= {LONGEST_NAME} THEN name END,
        checksum,
        CASE WHEN typeof(ranges) = 'blob' AND length(ranges) = 4 * readings
            AND readings <= {MOST_READINGS} THEN ranges END
    FROM reference CROSS JOIN sensor ON sensor.identifier = reference.sensor
    ORDER BY reference.identifier"""

_COORDINATE = (float, type(None))
_ROW_TYPES = (int, int, *4 * (float,), *3 * (_COORDINATE,), str, int, bytes)

_MAGIC = b"SQLite format 3\0"
_HEADER_SIZE = 100

# The second, when SQLite's own message quotes damaged text.
_STORAGE_ERRORS = (sqlite3.Error, UnicodeError)
_FORMAT_AT = 60
_APPLICATION_AT = 68


@dataclass(frozen=True)
class Sensor:
    """The geometry that the scans of one sensor share; fields as in ``LaserScan``.

    Args:
        readings: Readings in a scan.
        angle_min: Direction of the first reading, radians.
        angle_increment: Angle between readings, radians.
        range_min: Shortest range that counts, metres.
        range_max: Longest range that counts, metres.
    """

    readings: int
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float

    @classmethod
    def of(cls, scan: LaserScan) -> Sensor:
        """Return the geometry of a scan."""
        # Adding zero turns -0.0 into 0.0, as the file does; otherwise checksums would differ.
        return cls(
            len(scan),
            scan.angle_min + 0.0,
            scan.angle_increment + 0.0,
            scan.range_min + 0.0,
            scan.range_max + 0.0,
        )


@dataclass(frozen=True, eq=False)
class Place:
    """A reference to be: it gets its identifier when it is stored.

    Args:
        scan: The laser scan, at most ``MOST_READINGS`` readings.
        pose: ``T_set_laser``, finite, or None.
        name: What the user calls the place, at most ``LONGEST_NAME`` bytes of UTF-8.

    Raises:
        ReferenceSetError: It breaks one of these limits.
    """

    scan: LaserScan
    pose: Pose2D | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if len(self.scan) > MOST_READINGS:
            raise ReferenceSetError(
                f"a reference scan has at most {MOST_READINGS} readings, not {len(self.scan)}"
            )
        if self.pose is not None and not self.pose.is_finite():
            raise ReferenceSetError(f"the pose of a reference must be finite, not {self.pose}")
        object.__setattr__(self, "name", _plain_name(self.name))


@dataclass(frozen=True)
class BuildState:
    """How a set is built from a log, and how far that has come.

    Args:
        spacing: Of the rule, metres.
        heading: Of the rule, radians.
        keep_all: Whether every usable scan with a pose was kept, whatever the rule says.
        consumed: Records read so far.
        unusable: Those of them without a scan that can be stored and has a return.
        without_pose: Those of them with a usable scan but no finite pose.
        trail: 16 bytes that stand for the records read so far, in their order.
        finished: Whether the last record was reached.
    """

    spacing: float
    heading: float
    keep_all: bool
    consumed: int = 0
    unusable: int = 0
    without_pose: int = 0
    trail: bytes = bytes(16)
    finished: bool = False


@dataclass(frozen=True, eq=False)
class SetContent:
    """Everything that a file holds.

    Args:
        name: What the user calls the set.
        settings: Settings as JSON; empty stands for the defaults of the reader.
        next_identifier: What the next reference will be called.
        references: In the order of their identifiers.
        build: How the set is being built from a log, if it is.
    """

    name: str = ""
    settings: str = ""
    next_identifier: int = 0
    references: tuple[Reference, ...] = ()
    build: BuildState | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", _plain_name(self.name))
        if len(self.settings.encode()) > _LONGEST_SETTINGS:
            raise ReferenceSetError(f"settings of over {_LONGEST_SETTINGS} bytes are refused")


@dataclass(frozen=True, eq=False)
class SetChanges:
    """How a file differs from what somebody knew of it.

    Args:
        content: The set, with only those references that are new.
        gone: (G,) identifiers of references that are no longer there.
    """

    content: SetContent
    gone: NDArray[np.int64]


@dataclass(frozen=True)
class _Header:
    """The row of ``reference_set``, in the order of its columns, without the checksum."""

    name: str
    settings: str
    next_identifier: int
    count: int
    content: int


class SetFile:
    """A set's file, open for appending and removing.

    Others may read meanwhile; another writer's transaction is waited for, some seconds long.

    Args:
        path: An existing file.

    Raises:
        ReferenceSetError: It is not the file of a reference set, or cannot be written.
    """

    def __init__(self, path: Path):
        self.path = path
        with _opening, _told(path):
            _check_file(path)
            self._connection = _connect(path, "mode=rw")
            self._identity = _hold(path)
            self._size = path.stat().st_size
            self._log = _mark_of(path)
            # Runs at the end of the process too: a set that nobody closed is one file even so.
            self._finish = weakref.finalize(
                self, _abandon, self._connection, path, self._identity, os.getpid()
            )
            try:
                _check_schema(self._connection)
                _patiently(self._connection, "PRAGMA journal_mode = WAL")
                self._connection.execute("PRAGMA synchronous = FULL")
            except BaseException:
                self._finish.detach()
                self._connection.close()
                _release(self._identity)
                raise

    def append(
        self,
        places: Sequence[Place],
        build: BuildState | None = None,
        after: BuildState | None = None,
        known: int = 0,
    ) -> list[Reference]:
        """Store references in one transaction.

        Args:
            places: What to store.
            build: Where the build stands with them; None leaves that as it is.
            after: Where the build must stand before, when ``build`` is given.
            known: Identifiers below this one were used, as far as the writer knows.

        Returns:
            The references, with identifiers in rising order.

        Raises:
            ReferenceSetError: Nothing was stored: full disk, read-only or damaged file, another
                writer, another build of the same file, or another set in its place.
        """
        with _told(self.path), self._transaction() as connection:
            header = _load_header(connection)
            if header.next_identifier < known:
                raise self._another()
            if build is not None:
                if _load_build(connection) != after:
                    raise ReferenceSetError(f"{self.path}: another build is writing to this set")
                _store_build(connection, build)
            try:
                references = number(places, header.next_identifier)
            except ReferenceSetError as error:
                raise ReferenceSetError(f"{self.path}: {error}") from None
            _store_references(connection, header, references)
        return references

    def remove(self, identifier: int, checksum: int | None = None) -> None:
        """Remove a reference in one transaction.

        Args:
            identifier: Of the reference.
            checksum: That it must have, if the writer knows it.

        Raises:
            ReferenceSetError: It is not there, or is another one, or the file cannot be written.
        """
        with _told(self.path), self._transaction() as connection:
            header = _load_header(connection)
            row = None
            if 0 <= identifier < header.next_identifier:
                row = connection.execute(
                    "SELECT checksum FROM reference WHERE identifier = ?", (identifier,)
                ).fetchone()
            if row is None:
                raise ReferenceSetError(f"{self.path}: there is no reference {identifier}")
            if not _are(row, (int,)):
                raise _DamageError(f"reference {identifier} has a checksum of the wrong kind")
            if checksum not in (None, row[0]):
                raise self._another()
            connection.execute("DELETE FROM reference WHERE identifier = ?", (identifier,))
            content = header.content ^ row[0]
            _store_header(connection, replace(header, count=header.count - 1, content=content))

    def replace(self, content: SetContent) -> None:
        """Put other content in the place of all that is there, in one transaction.

        Raises:
            ReferenceSetError: The file cannot be written; it is as it was.
        """
        with _told(self.path), self._transaction() as connection:
            for table in ("reference", "sensor", "reference_set", "build"):
                connection.execute(f"DELETE FROM {table}")
            _store_content(connection, content)

    def describe(self, name: str, settings: str) -> None:
        """Change the name and the settings of the set in one transaction.

        Raises:
            ReferenceSetError: The file cannot be written; it is as it was.
        """
        with _told(self.path), self._transaction() as connection:
            header = _load_header(connection)
            _store_header(connection, replace(header, name=name, settings=settings))

    def _another(self) -> ReferenceSetError:
        return ReferenceSetError(
            f"{self.path}: holds another set than the one that was opened; open it again"
        )

    def check(self) -> None:
        """See that the path still leads to the file that was opened.

        SQLite goes on writing to a file that was removed, where nobody will ever read it.

        Raises:
            ReferenceSetError: The file was removed, replaced or cut short meanwhile.
        """
        try:
            found = self.path.stat()
            is_whole = found.st_size >= self._size
            happened = None if is_whole else "cut short"
            if (found.st_dev, found.st_ino) != self._identity:
                happened = "replaced by another file"
        except OSError:
            happened = "removed"
        if happened is not None:
            raise ReferenceSetError(
                f"{self.path}: was {happened} while it was open to be changed; save the set under "
                f"another name, close it, and open what is to be used"
            )

    def close(self) -> None:
        """Fold the write-ahead log in, so that the file stands alone, and let go of it.

        Raises:
            ReferenceSetError: The log could not be folded in and stays beside the file; nothing
                is lost, the next opening tries again.  Or the file was removed, replaced or cut
                short meanwhile.
        """
        if self._finish.detach() is None:
            return
        try:
            self.check()
        except ReferenceSetError:
            self._connection.close()
            _release(self._identity)
            self._take_log_along()
            raise
        _fold_in(self._connection, self.path, self._identity)

    def __enter__(self) -> SetFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _take_log_along(self) -> None:
        """Remove the log of a file that is gone, lest it be folded into the one in its place.

        Only where nobody has written to it since; what is in it has no file any more.
        """
        if self._log is not None and _mark_of(self.path) == self._log:
            for suffix in ("-wal", "-shm"):
                with suppress(OSError):
                    Path(f"{self.path}{suffix}").unlink()

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        self.check()
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            yield self._connection
            self._connection.execute("COMMIT")
            self._log = _mark_of(self.path)
        except BaseException:
            # A full disk has rolled back by itself; then there is no transaction to end.
            with suppress(sqlite3.Error):
                self._connection.execute("ROLLBACK")
            raise


def number(places: Sequence[Place], first: int) -> list[Reference]:
    """Make references of places, with identifiers that rise from ``first``.

    Raises:
        ReferenceSetError: There are not so many identifiers.
    """
    if first + len(places) > LAST_IDENTIFIER:
        raise ReferenceSetError("no number is left for another reference of this set")
    return [
        Reference(first + i, place.scan, place.pose, place.name) for i, place in enumerate(places)
    ]


def create_set(path: Path, content: SetContent) -> None:
    """Write a new file, which appears at ``path`` whole or not at all.

    A process killed meanwhile leaves at most a hidden draft beside it, ``.NAME.*.new``.

    Raises:
        ReferenceSetError: Something is at ``path`` already, or it cannot be written.
    """
    if "\0" in str(path):
        raise ReferenceSetError(f"{str(path)!a} is not a path")
    if os.path.lexists(path):
        raise ReferenceSetError(f"{path}: exists already")
    if not path.parent.is_dir():
        raise ReferenceSetError(f"{path}: there is no folder {path.parent}")
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}.new")
    with _told(path):
        # Made here and not by SQLite: the permissions are then what the user's mask says.
        os.close(os.open(draft, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666))
        try:
            with closing(_connect(draft, "mode=rw")) as connection:
                connection.execute(f"PRAGMA page_size = {_PAGE_SIZE}")
                connection.execute("PRAGMA journal_mode = OFF")
                connection.execute("PRAGMA synchronous = FULL")
                connection.execute(f"PRAGMA application_id = {APPLICATION}")
                connection.execute(f"PRAGMA user_version = {FORMAT}")
                connection.execute("BEGIN EXCLUSIVE")
                for statement in _SCHEMA.values():
                    connection.execute(statement)
                _store_content(connection, content)
                connection.execute("COMMIT")
            _publish(draft, path)
        finally:
            draft.unlink(missing_ok=True)


def read_set(path: Path) -> SetContent:
    """Read a file and verify every part of it.

    What is read is the state after the last transaction that was done when reading began,
    whoever writes meanwhile.

    Raises:
        ReferenceSetError: There is no such file, it is of another kind, newer, damaged, or not
            to be read.
    """
    _check_file(path)
    with _told(path), closing(_connect_to_read(path)) as connection:
        connection.execute("BEGIN")
        _check_schema(connection)
        header = _load_header(connection)
        references = tuple(_load_references(connection, header))
        return SetContent(
            header.name,
            header.settings,
            header.next_identifier,
            references,
            _load_build(connection),
        )


def read_summary(path: Path) -> SetContent:
    """Read a file without its references.

    Raises:
        ReferenceSetError: As for ``read_set``.
    """
    _check_file(path)
    with _told(path), closing(_connect_to_read(path)) as connection:
        connection.execute("BEGIN")
        _check_schema(connection)
        header = _load_header(connection)
        build = _load_build(connection)
    return SetContent(header.name, header.settings, header.next_identifier, (), build)


def read_changes(
    path: Path, identifiers: NDArray[np.int64], checksums: NDArray[np.int64]
) -> SetChanges | None:
    """Read only what of a file is not known yet.

    That takes no time where nothing has changed; otherwise the checksums of all references are
    read, and the new references.

    Args:
        path: The file.
        identifiers: (N,) of the references that are known, ascending.
        checksums: (N,) of these.

    Returns:
        The changes; None where the file is not a later state of what is known.

    Raises:
        ReferenceSetError: As for ``read_set``.
    """
    _check_file(path)
    with _told(path), closing(_connect_to_read(path)) as connection:
        connection.execute("BEGIN")
        _check_schema(connection)
        header = _load_header(connection)
        gone, new = np.empty(0, np.int64), []
        known = len(identifiers), int(np.bitwise_xor.reduce(checksums, initial=0))
        if known != (header.count, header.content):
            rows = connection.execute(
                """SELECT identifier, checksum FROM reference
                    WHERE typeof(checksum) = 'integer' ORDER BY identifier"""
            ).fetchall()
            there, theirs = np.array(rows, np.int64).reshape(-1, 2).T
            at = np.searchsorted(identifiers, there)
            at[at == len(identifiers)] = 0
            is_known = identifiers[at] == there if len(identifiers) else np.zeros(len(at), np.bool_)
            if np.any(checksums[at[is_known]] != theirs[is_known]):
                return None
            gone = np.setdiff1d(identifiers, there[is_known], assume_unique=True)
            new = there[~is_known].tolist()
            if (len(there), int(np.bitwise_xor.reduce(theirs, initial=0))) != (
                header.count,
                header.content,
            ):
                raise _DamageError(f"of its {header.count} references {len(there)} could be found")
        if header.next_identifier <= (int(identifiers[-1]) if len(identifiers) else -1):
            return None
        references = tuple(_load_some(connection, new))
        content = SetContent(
            header.name,
            header.settings,
            header.next_identifier,
            references,
            _load_build(connection),
        )
    return SetChanges(content, gone)


def checksum_of(reference: Reference) -> int:
    """Return the checksum over everything that a reference means."""
    sensor, pose = Sensor.of(reference.scan), reference.pose
    place = (None,) * 3 if pose is None else (pose.x + 0.0, pose.y + 0.0, pose.theta + 0.0)
    values = (reference.identifier, *astuple(sensor), *place, reference.name)
    return _seal(*values, data=reference.scan.ranges.astype("<f4", copy=False).tobytes())


class _DamageError(Exception):
    """A file that contradicts itself; the message says where."""


def _plain_name(name: str) -> str:
    """Return a name as the file has it: a ``str``, and not a NumPy text or a member of an Enum.

    Raises:
        ReferenceSetError: It may not be a name.
    """
    if not isinstance(name, str):
        raise ReferenceSetError(f"a name must be text, not {name!a}")
    name = str.__str__(name)
    try:
        size = len(name.encode())
    except UnicodeEncodeError:
        raise ReferenceSetError(f"a name must be Unicode text, not {name!a}") from None
    if "\0" in name:
        raise ReferenceSetError("a name must not hold the character NUL")
    if size > LONGEST_NAME:
        raise ReferenceSetError(f"a name has at most {LONGEST_NAME} bytes, not {size}")
    return name


# The files that this process has open to write, with how many times.  POSIX drops all locks of
# a process on a file when the process closes any handle of it, SQLite's as well; another process
# would then take itself for the last user and remove the log that this one still writes to.
_Identity = tuple[int, int]
_held: dict[_Identity, int] = {}
_opening = threading.RLock()


def _mark_of(path: Path) -> tuple[int, ...] | None:
    """Tell the log beside a file from any other, and from itself when somebody has written."""
    try:
        found = Path(f"{path}-wal").stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def _hold(path: Path) -> _Identity:
    found = path.stat()
    identity = (found.st_dev, found.st_ino)
    _held[identity] = _held.get(identity, 0) + 1
    return identity


def _release(identity: _Identity) -> None:
    with _opening:
        _held[identity] -= 1
        if not _held[identity]:
            del _held[identity]


def _check_file(path: Path) -> None:
    """Tell a reference set from everything else by its first bytes alone."""
    with _opening:
        _check_header(path)


def _check_header(path: Path) -> None:
    try:
        found = path.stat()
        if (found.st_dev, found.st_ino) in _held:
            return  # it was looked at when it was opened, and must not be closed now
        kind = found.st_mode
        if stat.S_ISDIR(kind):
            raise ReferenceSetError(f"{path}: is a directory, not a reference set")
        if not stat.S_ISREG(kind):
            raise ReferenceSetError(f"{path}: is not a regular file")
        with path.open("rb") as file:
            header = file.read(_HEADER_SIZE)
    except FileNotFoundError:
        raise ReferenceSetError(f"{path}: there is no such file") from None
    except (OSError, ValueError) as error:
        raise ReferenceSetError(f"{path}: {_reason(error)}") from None
    if not header:
        raise ReferenceSetError(f"{path}: is empty, not a reference set")
    if not header.startswith(_MAGIC):
        raise ReferenceSetError(f"{path}: is not a reference set")
    if len(header) < _HEADER_SIZE:
        raise ReferenceSetError(f"{path}: is damaged: it ends within its header")
    if struct.unpack_from(">I", header, _APPLICATION_AT)[0] != APPLICATION:
        raise ReferenceSetError(f"{path}: is an SQLite database, but not a reference set")
    version = struct.unpack_from(">i", header, _FORMAT_AT)[0]
    if version > FORMAT:
        raise ReferenceSetError(
            f"{path}: was written by a newer anchorscan (format {version}; this one reads up to "
            f"{FORMAT}): upgrade anchorscan"
        )
    if version < 1:
        raise ReferenceSetError(f"{path}: is damaged: there is no format {version}")


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Turn what the storage raises into one line about ``path``."""
    try:
        yield
    except (*_STORAGE_ERRORS, OSError, _DamageError) as error:
        raise ReferenceSetError(f"{path}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    text = " ".join((getattr(error, "strerror", None) or str(error)).split())
    if isinstance(error, OSError):
        return text
    for sign, meaning in (
        ("locked", "another process is writing to it; try again when that has ended"),
        ("full", "the disk is full; nothing of this change was stored"),
        ("disk I/O", "the disk cannot be read or written (disk I/O error); is it full?"),
        ("readonly", "cannot be written here: the file or its folder is read-only"),
        ("unable to open", "cannot be opened: the file or its folder is not accessible"),
    ):
        if sign in text:
            return meaning
    return f"is damaged: {text}"


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?{mode}",
        uri=True,
        timeout=_PATIENCE,
        isolation_level=None,
        check_same_thread=False,
    )
    # A crafted file must neither call functions from its schema nor, by claims about its
    # sizes, read beyond a page or take all memory; a mapped file that shrinks would be fatal.
    connection.execute("PRAGMA trusted_schema = OFF")
    connection.execute("PRAGMA cell_size_check = ON")
    connection.execute("PRAGMA mmap_size = 0")
    if hasattr(connection, "setlimit"):  # Python 3.11
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LARGEST_VALUE)
    return connection


def _connect_to_read(path: Path) -> sqlite3.Connection:
    """Connect so that a log left by a killed writer counts, wherever the file lies.

    That needs the right to write beside the file.  Without it a file at rest is read as the
    immutable thing that it then is.
    """
    connection = _connect(path, "mode=rw")
    try:
        connection.execute("PRAGMA query_only = ON")
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.OperationalError as error:
        connection.close()
        if "readonly" not in str(error) and "unable to open" not in str(error):
            raise
        for suffix in ("-wal", "-journal"):
            log = Path(f"{path}{suffix}")
            # A journal that begins with zero was never finished, and counts for nothing.
            if log.exists() and _first_byte(log) not in (b"", b"\0"):
                raise _UnfinishedError(log) from None
        return _connect(path, "immutable=1")
    except BaseException:
        connection.close()
        raise
    return connection


def _first_byte(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(1)


class _UnfinishedError(OSError):
    """A log beside a file in a folder where it cannot be folded in."""

    def __init__(self, log: Path):
        super().__init__(
            f"its last writer has not finished ({log.name} is there) and the folder is "
            f"read-only: copy the two together to a folder that can be written, and open it there"
        )


def _patiently(connection: sqlite3.Connection, statement: str) -> None:
    """Execute a change of journal mode, for which SQLite itself does not always wait."""
    deadline = time.monotonic() + _PATIENCE
    while True:
        try:
            connection.execute(statement).fetchall()
            return
        except sqlite3.OperationalError as error:
            if "locked" not in str(error) or time.monotonic() > deadline:
                raise
        time.sleep(_PAUSE)


def _abandon(connection: sqlite3.Connection, path: Path, identity: _Identity, process: int) -> None:
    """Close as well as it goes where nobody is left to be told."""
    if os.getpid() == process:  # in a forked copy the connection is the parent's
        with suppress(Exception):
            _fold_in(connection, path, identity)


def _fold_in(connection: sqlite3.Connection, path: Path, identity: _Identity) -> None:
    """Bring the write-ahead log into the file, leave that mode, and close."""
    try:
        connection.execute(f"PRAGMA busy_timeout = {int(1000 * _CLOSING_PATIENCE)}")
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        connection.execute("PRAGMA journal_mode = DELETE").fetchall()
    except _STORAGE_ERRORS as error:
        # Where somebody else has it open, the last to close does it.
        if "locked" not in str(error):
            raise ReferenceSetError(
                f"{path}: {_reason(error)}: all is stored, but part of it in {path.name}-wal; "
                f"keep the two together and open the set again"
            ) from error
    finally:
        connection.close()
        _release(identity)


def _publish(draft: Path, path: Path) -> None:
    """Give a finished file its name, unless something took that name meanwhile."""
    try:
        os.link(draft, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        if os.path.lexists(path):
            raise FileExistsError("exists already") from None
        draft.rename(path)
    keep_names(path.parent)


def _check_schema(connection: sqlite3.Connection) -> None:
    rows = connection.execute("SELECT name, sql FROM sqlite_master LIMIT 20").fetchall()
    if len(rows) != len(_SCHEMA) or dict(rows) != _SCHEMA:
        raise _DamageError(f"its tables are not those of format {FORMAT}")


def _seal(*values: object, data: bytes = b"") -> int:
    """Checksum of plain values and of bytes, as SQLite stores integers: signed, 64 bits."""
    digest = blake2b(repr(values).encode(), digest_size=8)
    digest.update(data)
    return int.from_bytes(digest.digest(), "big", signed=True)


def _load_header(connection: sqlite3.Connection) -> _Header:
    rows = connection.execute(
        f"""SELECT CASE WHEN length(CAST(name AS BLOB)) <= {LONGEST_NAME} THEN name END,
            CASE WHEN length(CAST(settings AS BLOB)) <= {_LONGEST_SETTINGS} THEN settings END,
            next_identifier, count, content, checksum FROM reference_set LIMIT 2"""
    ).fetchall()
    if len(rows) != 1:
        raise _DamageError("the description of the set is missing")
    *values, checksum = rows[0]
    if not _are(values, (str, str, int, int, int)) or _seal(*values) != checksum:
        raise _DamageError("the description of the set fails its checksum")
    header = _Header(*values)
    if not 0 <= header.next_identifier <= LAST_IDENTIFIER:
        raise _DamageError(f"the next reference cannot be number {header.next_identifier}")
    return header


def _store_header(connection: sqlite3.Connection, header: _Header) -> None:
    values = astuple(header)
    connection.execute("DELETE FROM reference_set")
    connection.execute(
        "INSERT INTO reference_set VALUES (?, ?, ?, ?, ?, ?)", (*values, _seal(*values))
    )


def _load_build(connection: sqlite3.Connection) -> BuildState | None:
    rows = connection.execute(
        """SELECT spacing, heading, keep_all, consumed, unusable, without_pose,
            CASE WHEN length(trail) = 16 THEN trail END, finished, checksum
            FROM build LIMIT 2"""
    ).fetchall()
    if not rows:
        return None
    *values, checksum = rows[0]
    types = (float, float, int, int, int, int, bytes, int)
    if len(rows) > 1 or not _are(values, types) or _seal(*values) != checksum:
        raise _DamageError("the state of the build fails its checksum")
    state = BuildState(*values)
    return replace(state, keep_all=bool(state.keep_all), finished=bool(state.finished))


def _store_build(connection: sqlite3.Connection, build: BuildState) -> None:
    values = tuple(int(value) if isinstance(value, bool) else value for value in astuple(build))
    connection.execute("DELETE FROM build")
    connection.execute(
        "INSERT INTO build VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", (*values, _seal(*values))
    )


def _load_references(connection: sqlite3.Connection, header: _Header) -> Iterator[Reference]:
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    (page,) = connection.execute("PRAGMA page_size").fetchone()
    space = pages * page
    last, count, content = -1, 0, 0
    for row in connection.execute(_SELECT_REFERENCES):
        if not _are(row, _ROW_TYPES):
            raise _DamageError(f"reference {row[0]!a} has values of the wrong kind or size")
        reference, checksum = _reference(row)
        # Pages that claim to be part of several scans could promise more than any memory.
        space -= len(row[-1]) + len(reference.name)
        if space < 0 or reference.identifier <= last:
            raise _DamageError(f"reference {reference.identifier} shares its bytes with another")
        last, count, content = reference.identifier, count + 1, content ^ checksum
        yield reference
    if (count, content) != (header.count, header.content) or last >= header.next_identifier:
        raise _DamageError(f"of its {header.count} references {count} could be found")


def _load_some(connection: sqlite3.Connection, identifiers: Sequence[int]) -> Iterator[Reference]:
    """Read single references, and verify them."""
    select = _SELECT_REFERENCES.replace(
        "ORDER BY reference.identifier", "WHERE reference.identifier = ?"
    )
    for identifier in identifiers:
        row = connection.execute(select, (identifier,)).fetchone()
        if row is None or not _are(row, _ROW_TYPES):
            raise _DamageError(f"reference {identifier} has values of the wrong kind or size")
        yield _reference(row)[0]


def _reference(row: tuple[Any, ...]) -> tuple[Reference, int]:
    """Make a reference of a row of the right types, and verify its checksum."""
    identifier, *geometry, x, y, theta, name, checksum, ranges = row
    sensor = Sensor(*geometry)
    if _seal(identifier, *geometry, x, y, theta, name, data=ranges) != checksum:
        raise _DamageError(f"reference {identifier} fails its checksum")
    try:
        scan = LaserScan(
            np.frombuffer(ranges, dtype="<f4"),
            sensor.angle_min,
            sensor.angle_increment,
            sensor.range_min,
            sensor.range_max,
        )
    except ScanError as error:
        raise _DamageError(f"reference {identifier}: {error}") from None
    pose = None
    if None not in (x, y, theta):
        pose = Pose2D(x, y, theta)
    elif (x, y, theta) != (None, None, None):
        raise _DamageError(f"reference {identifier} has half a pose")
    if pose is not None and not pose.is_finite():
        raise _DamageError(f"reference {identifier} is nowhere")
    return Reference(identifier, scan, pose, name), checksum


def _store_references(
    connection: sqlite3.Connection, header: _Header, references: Iterable[Reference]
) -> None:
    """Insert references whose identifiers begin at the header's next, and renew the header."""
    sensors: dict[Sensor, int] = {}
    for reference in references:
        sensor = Sensor.of(reference.scan)
        if sensor not in sensors:
            sensors[sensor] = _sensor(connection, sensor)
        pose = reference.pose
        place = (None,) * 3 if pose is None else (pose.x + 0.0, pose.y + 0.0, pose.theta + 0.0)
        ranges = reference.scan.ranges.astype("<f4", copy=False).tobytes()
        values = (reference.identifier, *astuple(sensor), *place, reference.name)
        checksum = _seal(*values, data=ranges)
        connection.execute(
            "INSERT INTO reference VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            (reference.identifier, sensors[sensor], *place, reference.name, checksum, ranges),
        )
        header = replace(
            header,
            next_identifier=max(header.next_identifier, reference.identifier + 1),
            count=header.count + 1,
            content=header.content ^ checksum,
        )
    _store_header(connection, header)


def _sensor(connection: sqlite3.Connection, sensor: Sensor) -> int:
    """Return the number of a sensor in the file, which is new where it was not there."""
    values = astuple(sensor)
    row = connection.execute(
        """SELECT identifier FROM sensor WHERE readings = ? AND angle_min = ?
            AND angle_increment = ? AND range_min = ? AND range_max = ?""",
        values,
    ).fetchone()
    if row is not None:
        return int(row[0])
    inserted = connection.execute("INSERT INTO sensor VALUES (NULL, ?, ?, ?, ?, ?)", values)
    return int(inserted.lastrowid or 0)


def _store_content(connection: sqlite3.Connection, content: SetContent) -> None:
    header = _Header(content.name, content.settings, content.next_identifier, 0, 0)
    _store_references(connection, header, content.references)
    if content.build is not None:
        _store_build(connection, content.build)


def _are(values: Sequence[Any], types: Sequence[Any]) -> bool:
    return all(isinstance(value, kind) for value, kind in zip(values, types, strict=True))
