"""What is fuzzed: everything that reads bytes from outside, and the matcher with any scan.

A target takes any bytes.  It may raise the errors of ``errors.py``, each with a message of one
line; it may skip and count; it must give nothing but sound values, within a second, and with no
more memory than follows from the size of the input.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import gzip
import io
import math
import resource
import sqlite3
import struct
import tempfile
import time
import zipfile
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from anchorscan import (
    AnchorscanError,
    LaserScan,
    Log,
    LogError,
    Matcher,
    Pose2D,
    Record,
    Reference,
    ReferenceSet,
    ReferenceSetError,
    ScanError,
    Settings,
    SettingsError,
    load_map,
    open_log,
    reference_scans,
)
from anchorscan.answers import read_runs
from anchorscan.array_file import read_arrays, write_arrays
from anchorscan.derived_index import _index_of, _made_of, index_path
from anchorscan.io import _tum_file
from anchorscan.io.log import Report
from anchorscan.io.posed_log import PosedLog
from anchorscan.set_file import _Header, _seal, _store_header

from . import seeds

__all__ = ["TARGETS", "Target", "execute"]

LONGEST = 1.0
"""Seconds of processor time that one input may take."""

MEMORY = 64 << 20
MEMORY_PER_BYTE = 256
"""Bytes that one input may take: so many, and so many for each of its own."""

_REPEATS = 2


class SlowError(Exception):
    """An input that took too long."""


class HungryError(Exception):
    """An input that took too much memory."""


@dataclass(frozen=True)
class Target:
    """Something that reads bytes from outside.

    Args:
        name: What the command calls it.
        seeds: Gives inputs to begin with.
        check: Reads an input, in a folder of its own, and says by an exception what is wrong.
        words: Pieces that mean something there.
    """

    name: str
    seeds: Callable[[], list[bytes]]
    check: Callable[[bytes, Path], None]
    words: tuple[bytes, ...] = ()


def execute(target: Target, data: bytes, folder: Path) -> None:
    """Give one input to a target, and watch time and memory.

    Raises:
        SlowError: It took longer than a second of processor time, twice.
        HungryError: It took more memory than its size allows.
        Exception: Whatever else the target should not have raised.
    """
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    spent = math.inf
    for _ in range(_REPEATS):
        begin = time.process_time()
        target.check(data, folder)
        spent = min(spent, time.process_time() - begin)
        if spent < LONGEST:
            break
        gc.collect()
    if spent > LONGEST:
        raise SlowError(f"{len(data)} bytes took {spent:.1f} s")
    taken = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    if taken > MEMORY + MEMORY_PER_BYTE * len(data):
        raise HungryError(f"{len(data)} bytes took {taken >> 20} MB")


def _one_line(error: Exception) -> None:
    message = str(error)
    assert message
    assert "\n" not in message, f"not one line: {message!r}"
    assert len(message) < 2000, f"a message of {len(message)} characters"


def _check_records(log: Log) -> None:
    for index, record in enumerate(log):
        assert record.index == index
        assert (record.scan is None) == bool(record.problem)
        assert record.pose is None or record.pose.is_finite()
        assert record.odometry is None or record.odometry.is_finite()
        assert record.stamp is None or math.isfinite(record.stamp)
    for problem in log.problems:
        assert "\n" not in problem.reason
        assert problem.line > 0


def _check_log(path: Path) -> None:
    try:
        _check_records(open_log(path))
    except LogError as error:
        _one_line(error)


def _log(data: bytes, folder: Path) -> None:
    path = folder / "log"
    path.write_bytes(data)
    _check_log(path)


_CLOCK = "PARAM laser_front_laser_resolution 1.0 1.0 host 0\n" + "".join(
    f"FLASER 3 1 2 3 {i} 0 0 {2 * i} 0 0 {i}.5 host {i}\n" for i in range(2)
)


class _KeptLog(Log):
    """A log that was read before: it is not what is looked at."""

    def __init__(self, log: Log) -> None:
        super().__init__(log.path)
        self._kept = tuple(log)

    def _read(self, report: Report) -> Iterator[Record]:
        yield from self._kept


@functools.cache
def _clock() -> _KeptLog:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clock.log"
        path.write_text(_CLOCK, encoding="ascii")
        return _KeptLog(open_log(path))


def _tum(data: bytes, folder: Path) -> None:
    path = folder / "poses.tum"
    path.write_bytes(data)
    try:
        poses = _tum_file(path, _clock().path)
        assert poses is not None
        _check_records(PosedLog(_clock(), poses, "laser"))
    except LogError as error:
        _one_line(error)


def _numpy(data: bytes, folder: Path) -> None:
    path = folder / "log"
    members = data.split(seeds.SEPARATOR)
    if len(members) == 1:
        path.write_bytes(data)
    else:
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in zip(seeds.NPZ_MEMBERS, members, strict=False):
                archive.writestr(f"{name}.npy", content)
    _check_log(path)


def _archive(data: bytes, folder: Path) -> None:
    kind, content = data[:1], data[1:]
    if kind == b"\1":
        content = gzip.compress(content, 1)
    elif kind == b"\2":
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr("a.log", content)
        content = stream.getvalue()
    _log(content, folder)


_ENDINGS = {b"#ROSB": ".bag", b"SQLit": ".db3", b"\x89MCAP": ".mcap"}


def _bag(data: bytes, folder: Path) -> None:
    ending = next((e for magic, e in _ENDINGS.items() if data.startswith(magic)), ".bag")
    path = folder / f"log{ending}"
    path.write_bytes(data)
    try:
        _check_log(path)
    finally:
        path.unlink()


def _metadata(data: bytes, folder: Path) -> None:
    home = folder / "rosbag2"
    home.mkdir(exist_ok=True)
    (home / "run.db3").touch()
    (home / "metadata.yaml").write_bytes(data)
    with _kept_storage(None), _yaml_read_once():
        _check_log(home)


@contextlib.contextmanager
def _yaml_read_once() -> Iterator[None]:
    """Have rosbags parse a text once, however often it opens the recording."""
    from rosbags.rosbag2 import reader

    class Once(reader.YAML):  # type: ignore[misc]
        load = staticmethod(functools.lru_cache(1)(reader.YAML(typ="safe").load))

    with mock.patch.object(reader, "YAML", Once):
        yield


def _message(data: bytes, folder: Path) -> None:
    path = folder / "log.db3"
    if not path.exists():
        path.write_bytes(seeds.storage())
    with _kept_storage(data):
        _check_log(path)


@contextlib.contextmanager
def _kept_storage(data: bytes | None) -> Iterator[None]:
    """Have rosbags take a storage that was read before for any, perhaps with other messages.

    The storage itself is what the target `bag` is for.
    """
    from rosbags.rosbag2 import reader

    connections, metadata, messages = _stored()

    class Kept:
        def __init__(self, path: Path) -> None:
            self.metadata, self.connections = metadata, list(connections)

        def open(self) -> None:
            """Nothing is to be opened."""

        def close(self) -> None:
            """Nothing is to be closed."""

        def messages(self, wanted: Collection[Any], *_: Any) -> Iterator[tuple[Any, int, bytes]]:
            for connection, stamp, content in messages:
                if connection in wanted:
                    yield connection, stamp, content if data is None else data

    with (
        mock.patch.dict(reader.Reader.STORAGE_PLUGINS, {".db3": Kept}),
        mock.patch.dict(reader.DirectoryReader.STORAGE_PLUGINS, {"sqlite3": Kept}),
    ):
        yield


@functools.cache
def _stored() -> tuple[tuple[Any, ...], Any, tuple[tuple[Any, int, bytes], ...]]:
    """What rosbags reads of a sound storage: connections, metadata and messages."""
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.db3"
        path.write_bytes(seeds.storage())
        storage = Sqlite3Reader(path)
        storage.open()
        try:
            found = tuple(storage.messages(storage.connections))
            return tuple(storage.connections), storage.metadata, found
        finally:
            storage.close()


def _check_set(places: ReferenceSet) -> None:
    last = -1
    for reference in places.references:
        assert reference.identifier > last
        assert reference.pose is None or reference.pose.is_finite()
        last = reference.identifier


def _set(data: bytes, folder: Path) -> None:
    path = folder / "a.apr"
    path.write_bytes(data)
    for ending in ("-wal", "-shm", "-journal"):
        (folder / f"a.apr{ending}").unlink(missing_ok=True)
    try:
        with ReferenceSet.open(path) as places:
            _check_set(places)
    except ReferenceSetError as error:
        _one_line(error)


@functools.cache
def _empty_set() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.apr"
        ReferenceSet(path=path).close()
        return path.read_bytes()


def _sealed(data: bytes, folder: Path) -> None:
    """A file that was crafted with care: every checksum is right, the values are not."""
    head, name, settings, ranges = (*data.split(seeds.SEPARATOR, 3), *3 * (b"",))[:4]
    identifier, readings, *numbers = seeds.SEALED.unpack(
        head[: seeds.SEALED.size].ljust(seeds.SEALED.size, b"\0")
    )
    geometry, pose = numbers[:4], numbers[4:]
    title = name.decode("utf-8", "replace")
    path = folder / "sealed.apr"
    path.write_bytes(_empty_set())
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode = OFF")
        connection.execute("PRAGMA synchronous = OFF")
        connection.execute("BEGIN")
        seal = _seal(identifier, readings, *geometry, *pose, title, data=ranges)
        try:
            connection.execute(
                "INSERT INTO sensor VALUES (1, ?, ?, ?, ?, ?)", (readings, *geometry)
            )
            connection.execute(
                "INSERT INTO reference VALUES (?, 1, ?, ?, ?, ?, ?, ?)",
                (identifier, *pose, title, seal, ranges),
            )
        except (sqlite3.Error, OverflowError):  # NaN is NULL to SQLite, and not allowed there
            return
        text = settings.decode("utf-8", "replace")
        following = max(0, min(identifier, (1 << 63) - 2) + 1)  # what SQLite can hold
        _store_header(connection, _Header(title, text, following, 1, seal))
        connection.execute("COMMIT")
    try:
        with ReferenceSet.open(path) as places:
            _check_set(places)
            _ask(places)
    except AnchorscanError as error:
        _one_line(error)


def _arrays(data: bytes, folder: Path) -> None:
    """A file of arrays: what is read is what was written, or nothing."""
    path = folder / "arrays"
    path.write_bytes(data)
    read = read_arrays(path, "fuzz")
    if read is None:
        return
    for name, array in seeds.ARRAYS.items():
        assert read[name].dtype == array.dtype
        assert read[name][: len(array)].tobytes() == array.tobytes()
    for array in read.values():
        array[len(array) :] = 7  # what is nobody's must not be somebody else's
        array[len(seeds.ARRAYS["rows"]) :] = 7
    for name, array in seeds.ARRAYS.items():
        assert name != "rows" or read[name][: len(array)].tobytes() == array.tobytes()


_INDEXED = (Settings(), Settings.preset().changed({"database": {"candidates": 1}}))


@functools.cache
def _indexed(kind: int) -> tuple[bytes, dict[str, np.ndarray]]:
    """A set's file, and the arrays of its index, by one kind of settings."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.apr"
        with ReferenceSet(path=path, settings=_INDEXED[kind]) as places:
            for scan, pose in seeds.rooms():
                places.add(scan, pose, "niche")
            places.save_index()
        found = read_arrays(index_path(path), _made_of(_INDEXED[kind]))
        assert found is not None
        used = {name: len(found["field.squares"]) + 1 for name in ("field.codes", "field.coarse")}
        cut = {name: array[: used.get(name)].copy() for name, array in found.items()}
        return path.read_bytes(), cut


def _edited(arrays: dict[str, np.ndarray], edit: bytes) -> None:
    """Change arrays as somebody would who knows what they are and means harm."""
    which, how, place, count, value = seeds.EDIT.unpack(edit.ljust(seeds.EDIT.size, b"\0"))
    name = sorted(arrays)[which % len(arrays)]
    array = arrays[name]
    size = array.dtype.itemsize
    own = np.frombuffer(struct.pack("<q", value)[:size], array.dtype)[0]
    if array.dtype == np.float32:
        with np.errstate(over="ignore"):
            own = np.float32(struct.unpack("<d", struct.pack("<q", value))[0])
    flat = array.reshape(-1)
    at = place % max(len(flat), 1)
    ways = ("set", "fill", "shift", "cut", "repeat", "retype", "remove", "reshape", "reverse")
    match ways[how % len(ways)]:
        case "set":
            flat[at : at + 1] = own
        case "fill":
            flat[at : at + count] = own
        case "shift":
            with np.errstate(all="ignore"):
                flat[at : at + count] += own
        case "cut":
            arrays[name] = array[: place % (len(array) + 1)].copy()
        case "repeat":
            arrays[name] = np.concatenate([array, array[: count % 64]])
        case "retype":
            kinds = "bBhHiIqQfd"
            with np.errstate(all="ignore"):
                arrays[name] = array.astype(kinds[value % len(kinds)])
        case "remove":
            del arrays[name]
        case "reshape":
            arrays[name] = flat[:, np.newaxis] if value % 2 else flat.copy()
        case "reverse":
            flat[at : at + count] = flat[at : at + count][::-1].copy()


def _index(data: bytes, folder: Path) -> None:
    """An index that was crafted with care: every checksum is right, the numbers are not.

    It must be left alone, or serve: whatever happens to the set then, it holds.  Most inputs spare
    the files, which other targets are for, and do one thing with the index, so that many can be
    tried; some do all that a program could, with files.
    """
    first = data[0] if data else 0
    kind, deed = first & 1, (first >> 1) % (3 * len(_DEEDS) + 1)
    content, sound = _indexed(kind)
    arrays = {name: array.copy() for name, array in sound.items()}
    for at in range(1, len(data), seeds.EDIT.size):
        if arrays:
            _edited(arrays, data[at : at + seeds.EDIT.size])
    try:
        if deed:
            _serve_arrays(arrays, kind, _DEEDS[deed % len(_DEEDS)])
        else:
            _serve_file(content, arrays, kind, folder)
    except AnchorscanError as error:
        _one_line(error)


def _serve_arrays(
    arrays: dict[str, np.ndarray], kind: int, deed: Callable[[Matcher], None]
) -> None:
    """Take arrays as they are taken from a file, and do one thing with them."""
    index = _index_of(arrays, 0)
    if index is None:
        return
    try:
        matcher = Matcher.from_arrays(index.arrays, _INDEXED[kind], index.read)
    except (ValueError, KeyError, IndexError):  # the set is read without its index then
        return
    deed(matcher)


def _ask(places: Matcher | ReferenceSet, candidates: int | None = None) -> None:
    for hypothesis in places.locate(_rooms()[0].scan, candidates):
        _check_hypothesis(hypothesis)


def _ask_voted(matcher: Matcher) -> None:
    _ask(matcher, 1)


def _add_and_ask(matcher: Matcher) -> None:
    matcher.add(Reference(1 << 40, _rooms()[0].scan, Pose2D(20.0, 3.0, 1.0)))
    _ask(matcher)


def _remove_and_ask(matcher: Matcher) -> None:
    with contextlib.suppress(KeyError):
        matcher.remove(0)
    _ask(matcher)


def _store_again(matcher: Matcher) -> None:
    matcher.arrays()


_DEEDS = (_ask, _ask_voted, _add_and_ask, _remove_and_ask, _store_again)


def _serve_file(content: bytes, arrays: dict[str, np.ndarray], kind: int, folder: Path) -> None:
    """Open a set with an index of such arrays, ask it, and change it."""
    path = folder / "indexed.apr"
    path.write_bytes(content)
    room = dict.fromkeys(("field.codes", "field.coarse"), 8)
    write_arrays(index_path(path), arrays, _made_of(_INDEXED[kind]), room)
    with ReferenceSet.open(path, settings=_INDEXED[kind]) as places:  # not read every time
        places._matcher = places._indexed()
        if places._matcher is None:  # without its index the set is the same every time
            _check_set(places)
            return
        _ask(places)
        _ask(places, 1)
        _check_set(places)
        places.add(_rooms()[0].scan, Pose2D(20.0, 3.0, 1.0))
        places.remove(0)
        _ask(places)


def _directory(data: bytes, folder: Path) -> None:
    description, table, ranges = (*data.split(seeds.SEPARATOR, 2), b"", b"")[:3]
    home = folder / "exported"
    (home / "scans").mkdir(parents=True, exist_ok=True)
    (home / "set.json").write_bytes(description)
    (home / "references.csv").write_bytes(table)
    (home / "scans" / "000000.npy").write_bytes(ranges)
    try:
        _check_set(ReferenceSet.import_directory(home))
    except ReferenceSetError as error:
        _one_line(error)


def _map(data: bytes, folder: Path) -> None:
    text, image = (*data.split(seeds.SEPARATOR, 1), b"")[:2]
    path = folder / "m.yaml"
    path.write_bytes(text)
    (folder / "m.pgm").write_bytes(image)
    try:
        grid = load_map(path)
    except LogError as error:
        _one_line(error)
        return
    assert grid.resolution > 0.0
    assert grid.origin.is_finite()
    assert ((grid.data >= -1) & (grid.data <= 100)).all()


def _map_scans(data: bytes, folder: Path) -> None:
    """The same, and the scans that would be taken there."""
    text, image = (*data.split(seeds.SEPARATOR, 1), b"")[:2]
    path = folder / "m.yaml"
    path.write_bytes(text)
    (folder / "m.pgm").write_bytes(image)
    try:
        for record in islice(reference_scans(load_map(path)), 3):
            assert record.pose is not None
            assert record.pose.is_finite()
    except AnchorscanError as error:
        _one_line(error)


def _settings(data: bytes, folder: Path) -> None:
    try:
        found = Settings.from_json(data)
    except SettingsError as error:
        _one_line(error)
        return
    assert Settings.from_json(found.to_json()) == found


@functools.cache
def _rooms() -> list[Reference]:
    return [Reference(n, scan, pose) for n, (scan, pose) in enumerate(seeds.rooms())]


@functools.cache
def _matcher(preset: str) -> Matcher:
    return Matcher(_rooms(), Settings.preset(preset))


def _check_hypothesis(hypothesis: object) -> None:
    pose, spread = hypothesis.pose, hypothesis.covariance  # type: ignore[attr-defined]
    assert pose is None or pose.is_finite()
    assert hypothesis.pose_in_reference.is_finite()  # type: ignore[attr-defined]
    assert 0.0 <= hypothesis.probability <= 1.0  # type: ignore[attr-defined]
    assert np.isfinite(spread).all()
    assert (np.linalg.eigvalsh(spread) > -1e-9).all()
    assert 0.0 <= hypothesis.evaluation <= 1.0  # type: ignore[attr-defined]


def _scan_of(data: bytes) -> LaserScan | None:
    size = seeds.LIMITS.size
    limits = seeds.LIMITS.unpack(data[:size].ljust(size, b"\0"))
    ranges = np.frombuffer(data[size : size + (len(data) - size) // 4 * 4], np.float32)
    try:
        return LaserScan(ranges, *limits)
    except ScanError as error:
        _one_line(error)
        return None


def _scan(data: bytes, folder: Path) -> None:
    scan = _scan_of(data)
    if scan is None:
        return
    hypotheses = _matcher("default").locate(scan)
    turn = round(2.0 * math.pi / abs(scan.angle_increment)) if scan.is_full_turn else len(scan)
    assert bool(hypotheses) == bool(scan.is_return[:turn].any())  # later looks are second ones
    for hypothesis in hypotheses:
        _check_hypothesis(hypothesis)


def _scan_paper(data: bytes, folder: Path) -> None:
    scan = _scan_of(data)
    if scan is not None:
        for hypothesis in _matcher("paper").locate(scan):
            _check_hypothesis(hypothesis)


def _answers(data: bytes, folder: Path) -> None:
    path = folder / "answers"
    path.write_bytes(data)
    try:
        for run in read_runs(path):
            for answer in run.answers:
                for guess in answer.guesses:
                    assert guess.pose is None or guess.pose.is_finite()
    except LogError as error:
        _one_line(error)


_NUMBERS = (b"1e400", b"nan", b"-inf", b"9" * 30, b"-1", b"0", b"1_0", b"1000000000", b"5e-324")
_LINES = (b"\n", b"\r\n", b"\r", b"\0", b"\xff", b"\xef\xbb\xbf", b"#", *_NUMBERS)
_CARMEN = (b"FLASER", b"RLASER", b"ROBOTLASER1", b"PARAM", b"robot_frontlaser_offset", b"ODOM")
_YAML = (b"&a", b"*a", b"<<: *a", b"!!python/object", b"!!binary", b"[", b"{", b"? ", b"|", b"---")
_MAP = (b"image", b"m.pgm", b"resolution", b"origin", b"mode", b"raw", b"scale", b"trinary")
_JSON = (
    b"{",
    b"[" * 50,
    b"null",
    b"NaN",
    b"Infinity",
    b'"method"',
    b'"field"',
    b"1e999",
    b"\\u0000",
)
_DOUBLES = tuple(
    struct.pack("<d", value)
    for value in (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 0.0, -0.0, 1e-9, 7.0)
)
_FLOATS = tuple(
    struct.pack("<f", value)
    for value in (math.nan, math.inf, -math.inf, 3e38, 1e-45, 0.0, -1.0, 80.0)
)

TARGETS = {
    target.name: target
    for target in (
        Target("carmen", seeds.carmen, _log, _LINES + _CARMEN),
        Target("g2o", seeds.g2o, _log, (*_LINES, b"VERTEX_SE2", b"EDGE_SE2", b"ROBOTLASER1")),
        Target(
            "csv",
            seeds.csv,
            _log,
            (*_LINES, b",", b";", b"\t", b"r0", b"ranges[1]", b"x", b"theta"),
        ),
        Target("tum", seeds.tum, _tum, _LINES),
        Target(
            "numpy", seeds.numpy_files, _numpy, (seeds.SEPARATOR, b"'descr'", b"'|O'", *_NUMBERS)
        ),
        Target("archive", seeds.archives, _archive, (*_LINES, b"PK\1\2", b"PK\3\4", b"PK\5\6")),
        Target("answers", seeds.answers, _answers, _JSON),
        Target("bag", seeds.bags, _bag, (b"op=\2", b"\xff\xff\xff\xff", b"\x89MCAP0\r\n")),
        Target("bag-metadata", seeds.metadata, _metadata, _YAML),
        Target("bag-message", seeds.messages, _message, _FLOATS),
        Target("set", seeds.sets, _set, (b"CREATE", b"TRIGGER", b"SQLite format 3\0")),
        Target("set-sealed", seeds.sealed, _sealed, (seeds.SEPARATOR, *_DOUBLES, *_FLOATS)),
        Target(
            "set-directory", seeds.directories, _directory, (seeds.SEPARATOR, *_JSON, *_NUMBERS)
        ),
        Target("arrays", seeds.array_files, _arrays, (b'"shape"', b'"rows"', b"[", *_NUMBERS)),
        Target("index", seeds.index_edits, _index, (b"\xff" * 8, *_DOUBLES)),
        Target("map", seeds.maps, _map, (seeds.SEPARATOR, *_YAML, *_MAP, *_NUMBERS)),
        Target("map-scans", seeds.maps, _map_scans, (seeds.SEPARATOR, *_MAP, *_NUMBERS)),
        Target("settings", seeds.settings, _settings, _JSON),
        Target("scan", seeds.scans, _scan, _DOUBLES + _FLOATS),
        Target("scan-paper", seeds.scans, _scan_paper, _DOUBLES + _FLOATS),
    )
}
"""By name."""
