"""The file of a reference set: nothing stored is lost, and nothing wrong is believed."""

from __future__ import annotations

import math
import os
import random
import resource
import shutil
import sqlite3
import stat
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reference_set_kills import BATCH, WAYS, check_bits, kill_many, pose_of, scan_of

from anchorscan import LaserScan, Pose2D, Record, ReferenceSet, ReferenceSetError
from anchorscan import set_file as set_file_module
from anchorscan.set_file import (
    FORMAT,
    LAST_IDENTIFIER,
    Place,
    SetContent,
    SetFile,
    _load_header,
    _store_header,
    create_set,
    read_set,
)

NOBODY = 65534


def small_set(path: Path, count: int = 30) -> None:
    """A set with all that there can be in one: names, missing poses, two sensors, a gap."""
    rng = np.random.default_rng(0)
    scans = [LaserScan(rng.uniform(0, 9, 61 + i % 2), -1.5, 0.05, 0, 10) for i in range(count)]
    with ReferenceSet(path=path, name="büro") as places:
        places.add_batch(
            scans,
            [Pose2D(*rng.normal(size=3)) if i % 3 else None for i in range(count)],
            [f"place {i}" for i in range(count)],
        )
        places.remove(4)


def told(path: Path, words: str, action: Callable[[], object] | None = None) -> None:
    """The action (opening, if none) fails with one line that names the file and says why."""
    with pytest.raises(ReferenceSetError, match=words or None) as error:
        (action or (lambda: ReferenceSet.open(path)))()
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message


def content_of(path: Path) -> list[tuple[object, ...]]:
    return [
        (r.identifier, r.name, r.pose, r.scan.ranges.tobytes(), r.scan.angle_min)
        for r in read_set(path).references
    ]


class TestKilled:
    @pytest.mark.parametrize("way", WAYS)
    def test_a_writer_killed_at_any_moment_loses_nothing_stored(
        self, way: str, tmp_path: Path
    ) -> None:
        assert kill_many(way, kills=9, seed=1, folder=tmp_path) >= 1

    def test_a_log_cut_anywhere_leaves_whole_batches(self, tmp_path: Path) -> None:
        """As after a power failure that tore the end of the write-ahead log."""
        path, torn = tmp_path / "a.apr", tmp_path / "torn.apr"
        with ReferenceSet(path=path) as places:
            places.add(scan_of(0), pose_of(0))
        with SetFile(path) as file:
            for first in range(1, 50, BATCH):
                file.append([Place(scan_of(n), pose_of(n)) for n in range(first, first + BATCH)])
            main, log = path.read_bytes(), Path(f"{path}-wal").read_bytes()
        rng, seen = random.Random(2), set()
        for _ in range(60):
            torn.write_bytes(main)
            Path(f"{torn}-wal").write_bytes(log[: rng.randrange(len(log) + 1)])
            Path(f"{torn}-shm").unlink(missing_ok=True)
            places = ReferenceSet.open(torn)
            check_bits(places)
            assert len(places) % BATCH == 1
            seen.add(len(places))
        assert len(seen) > 3

    def test_damage_within_the_log_is_never_believed(self, tmp_path: Path) -> None:
        path, torn = tmp_path / "a.apr", tmp_path / "torn.apr"
        ReferenceSet(path=path).close()
        with SetFile(path) as file:
            for first in range(0, 28, BATCH):
                file.append([Place(scan_of(n), pose_of(n)) for n in range(first, first + BATCH)])
            main, log = path.read_bytes(), Path(f"{path}-wal").read_bytes()
        rng = random.Random(3)
        for _ in range(60):
            damaged = bytearray(log)
            damaged[rng.randrange(len(log))] ^= 1 << rng.randrange(8)
            torn.write_bytes(main)
            Path(f"{torn}-wal").write_bytes(damaged)
            Path(f"{torn}-shm").unlink(missing_ok=True)
            places = ReferenceSet.open(torn)
            check_bits(places)
            assert len(places) % BATCH == 0

    def test_what_was_added_is_in_one_file_though_nobody_closed_the_set(
        self, tmp_path: Path
    ) -> None:
        path = tmp_path / "a.apr"
        program = (
            "import sys, anchorscan\n"
            "places = anchorscan.ReferenceSet(path=sys.argv[1])\n"
            "places.add(anchorscan.LaserScan([1.0, 2.0], 0.0, 0.1))\n"
        )
        subprocess.run([sys.executable, "-c", program, str(path)], check=True)
        assert [file.name for file in tmp_path.iterdir()] == ["a.apr"]
        assert len(ReferenceSet.open(path)) == 1


class TestOneFile:
    def test_the_file_at_rest_stands_alone(self, tmp_path: Path) -> None:
        path, mailed = tmp_path / "a.apr", tmp_path / "mailed.apr"
        with ReferenceSet(path=path) as places:
            places.add_batch([scan_of(n) for n in range(50)])
            assert Path(f"{path}-wal").exists()
        assert [file.name for file in tmp_path.iterdir()] == ["a.apr"]
        shutil.copyfile(path, mailed)
        check_scans(mailed, 50)
        # Not in write-ahead mode: readable where nothing can be written beside it.
        assert path.read_bytes()[18:20] == b"\x01\x01"

    def test_opening_changes_nothing(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        small_set(path)
        before = path.read_bytes(), path.stat().st_mtime_ns
        with ReferenceSet.open(path) as places:
            assert len(places) == 29
            assert [file.name for file in tmp_path.iterdir()] == ["a.apr"]
        assert (path.read_bytes(), path.stat().st_mtime_ns) == before

    def test_the_header_tells_programs_what_it_is(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        small_set(path)
        with closing(sqlite3.connect(path)) as connection:
            (application,) = connection.execute("PRAGMA application_id").fetchone()
            (version,) = connection.execute("PRAGMA user_version").fetchone()
        assert (application.to_bytes(4, "big"), version) == (b"APRS", FORMAT)

    @pytest.mark.parametrize("name", ["a b?c#d%20&e=1.apr", "büro ✓.apr", "-x", "'; --"])
    def test_any_name_is_a_name(self, name: str, tmp_path: Path) -> None:
        small_set(tmp_path / name)
        assert len(ReferenceSet.open(tmp_path / name)) == 29
        assert [file.name for file in tmp_path.iterdir()] == [name]

    def test_a_relative_path_is_a_path(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        small_set(Path("a.apr"))
        assert len(ReferenceSet.open("a.apr")) == 29

    def test_the_users_mask_decides_who_may_read(self, tmp_path: Path) -> None:
        old = os.umask(0o027)
        try:
            small_set(tmp_path / "a.apr")
        finally:
            os.umask(old)
        assert stat.S_IMODE((tmp_path / "a.apr").stat().st_mode) == 0o640

    def test_sensors_are_stored_once(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        small_set(path)
        with closing(sqlite3.connect(path)) as connection:
            assert connection.execute("SELECT count(*) FROM sensor").fetchone() == (2,)

    def test_a_pose_of_minus_zero_passes_its_checksum(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        with ReferenceSet(path=path) as places:
            places.add(LaserScan(np.array([1.0, 2.0]), -0.0, 0.5, -0.0), Pose2D(-0.0, 1.0, -0.0))
        assert ReferenceSet.open(path)[0].pose == Pose2D(0.0, 1.0, 0.0)


def check_scans(path: Path, count: int) -> None:
    places = ReferenceSet.open(path)
    assert [r.identifier for r in places.references] == list(range(count))
    for reference in places.references:
        assert reference.scan.ranges.tobytes() == scan_of(reference.identifier).ranges.tobytes()


class TestSharing:
    def test_readers_go_on_while_one_appends(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        ReferenceSet(path=path).close()
        ended, read = threading.Event(), threading.Event()

        def append() -> None:
            with ReferenceSet.open(path) as places:
                for first in range(0, 40 * BATCH, BATCH):
                    if first % (10 * BATCH) == 0:  # however busy the machine is
                        read.clear()
                        read.wait(10.0)
                    numbers = range(first, first + BATCH)
                    places.add_batch([scan_of(n) for n in numbers], [pose_of(n) for n in numbers])
            ended.set()

        writer = threading.Thread(target=append)
        writer.start()
        counts = [0]
        while not ended.is_set():
            places = ReferenceSet.open(path)
            check_bits(places)
            assert len(places) % BATCH == 0
            counts.append(len(places))
            read.set()
        writer.join()
        assert counts == sorted(counts)
        assert len(set(counts)) > 2
        check_scans(path, 40 * BATCH)

    def test_a_reader_holds_nobody_up(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        small_set(path)
        with ReferenceSet.open(path) as reader, ReferenceSet.open(path) as writer:
            writer.add(scan_of(0))
            writer.close()
            assert [file.name for file in tmp_path.iterdir()] == ["a.apr"]
            assert len(reader) == 29

    def test_a_second_writer_waits(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        small_set(path)
        with SetFile(path) as one, ReferenceSet.open(path) as other:
            with one._transaction():
                thread = threading.Thread(target=other.add, args=(scan_of(1),))
                thread.start()
                time.sleep(0.2)
                assert thread.is_alive()
            thread.join()
            assert len(other) == 30

    def test_a_second_writer_that_waited_too_long_is_told(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = tmp_path / "a.apr"
        small_set(path)
        monkeypatch.setattr(set_file_module, "_PATIENCE", 0.05)
        with SetFile(path) as one, ReferenceSet.open(path) as other:
            with one._transaction():
                told(path, "another process is writing", lambda: other.add(scan_of(1)))
                told(path, "another process is writing", lambda: other.remove(1))
                assert len(other) == 29
            assert other.add(scan_of(1)) == 30

    def test_a_second_build_of_the_same_file_is_told(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        records = [Record(i, scan_of(i), pose_of(i)) for i in range(600)]

        def disturbed() -> Iterator[Record]:
            yield from records[:300]
            ReferenceSet.build(records, keep_all=True, path=path)
            yield from records[300:]

        told(
            path,
            "another build",
            lambda: ReferenceSet.build(disturbed(), keep_all=True, path=path),
        )
        check_scans(path, 600)

    def test_two_who_create_the_same_file(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        small_set(path)
        before = path.read_bytes()
        told(path, "exists already", lambda: ReferenceSet(path=path))
        told(path, "exists already", lambda: create_set(path, SetContent()))
        assert path.read_bytes() == before
        assert [file.name for file in tmp_path.iterdir()] == ["a.apr"]

    def test_the_name_taken_at_the_last_moment(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = tmp_path / "a.apr"
        publish = set_file_module._publish

        def later(draft: Path, target: Path) -> None:
            target.write_text("somebody else's")
            publish(draft, target)

        monkeypatch.setattr(set_file_module, "_publish", later)
        told(path, "exist", lambda: ReferenceSet(path=path))
        assert path.read_text() == "somebody else's"
        assert [file.name for file in tmp_path.iterdir()] == ["a.apr"]

    def test_a_file_system_without_links(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def refuse(*_: object) -> None:
            raise PermissionError

        monkeypatch.setattr(os, "link", refuse)
        small_set(tmp_path / "a.apr")
        assert len(ReferenceSet.open(tmp_path / "a.apr")) == 29
        assert [file.name for file in tmp_path.iterdir()] == ["a.apr"]


class TestOtherKinds:
    @pytest.mark.parametrize(
        ("content", "words"),
        [
            (b"", "is empty"),
            (b"FLASER 3 1.0 2.0 3.0 0 0 0 0 0 0 1.0 host 1.0\n", "is not a reference set"),
            (b"\x1f\x8b" + bytes(200), "is not a reference set"),
            (b"SQLite format 3\0", "ends within its header"),
        ],
    )
    def test_a_file_of_another_kind(self, content: bytes, words: str, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        path.write_bytes(content)
        self.refused(path, words)
        assert path.read_bytes() == content

    def test_another_database(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        with closing(sqlite3.connect(path)) as connection:
            connection.execute("CREATE TABLE reference (identifier)")
        before = path.read_bytes()
        self.refused(path, "SQLite database, but not a reference set")
        assert path.read_bytes() == before

    def test_a_newer_version(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        small_set(path)
        with closing(sqlite3.connect(path)) as connection:
            connection.execute(f"PRAGMA user_version = {FORMAT + 1}")
        before = path.read_bytes()
        self.refused(path, f"newer anchorscan .*format {FORMAT + 1}.* upgrade")
        assert path.read_bytes() == before

    def test_a_directory(self, tmp_path: Path) -> None:
        self.refused(tmp_path, "is a directory")

    def test_a_missing_file(self, tmp_path: Path) -> None:
        for path in (tmp_path / "a.apr", tmp_path / "no" / "a.apr"):
            told(path, "no such file")
        told(
            tmp_path / "no" / "a.apr",
            "there is no folder",
            lambda: ReferenceSet(path=tmp_path / "no" / "a.apr"),
        )

    @pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
    def test_a_pipe_does_not_hang(self, tmp_path: Path) -> None:
        os.mkfifo(tmp_path / "pipe")
        self.refused(tmp_path / "pipe", "not a regular file")

    def test_no_path_at_all(self) -> None:
        with pytest.raises(ReferenceSetError, match="null"):
            ReferenceSet.open("a\0b")
        with pytest.raises(ReferenceSetError, match="not a path"):
            ReferenceSet(path="a\0b")

    def refused(self, path: Path, words: str) -> None:
        """By everything that would read or write there."""
        records = [Record(0, scan_of(0), pose_of(0))]
        told(path, words)
        told(path, words, lambda: ReferenceSet.build(records, path=path))
        told(path, words, lambda: ReferenceSet().save(path))


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sound") / "a.apr"
    small_set(path)
    return path


class TestDamage:
    @given(data=st.data())
    @settings(
        max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
    )
    def test_a_damaged_file_is_refused_or_says_what_it_said(
        self, data: st.DataObject, sound: Path, tmp_path: Path
    ) -> None:
        content = bytearray(sound.read_bytes())
        page = set_file_module._PAGE_SIZE
        anywhere = st.integers(0, len(content) - 1)
        # The headers of the pages, too, where little damage does much.
        at = anywhere | st.builds(
            lambda number, offset: number * page + offset,
            st.integers(0, len(content) // page - 1),
            st.integers(0, 20),
        )
        for offset, value in data.draw(st.lists(st.tuples(at, st.integers(0, 255)), max_size=8)):
            content[offset] = value
        if data.draw(st.booleans()):
            del content[data.draw(anywhere) :]
        path = tmp_path / "damaged.apr"
        path.write_bytes(content)
        try:
            found = content_of(path)
        except ReferenceSetError:
            told(path, "")
        else:
            assert found == content_of(sound)
            assert read_set(path).name == "büro"
        assert path.read_bytes() == content

    @pytest.mark.parametrize(
        "change",
        [
            "DELETE FROM reference WHERE identifier = 7",
            "DELETE FROM reference",
            "DELETE FROM reference_set",
            "DELETE FROM sensor",
            "UPDATE reference SET x = x + 1e-9 WHERE identifier = 7",
            "UPDATE reference SET x = NULL WHERE identifier = 7",
            "UPDATE reference SET x = 'left' WHERE identifier = 7",
            "UPDATE reference SET name = 'place 8' WHERE identifier = 7",
            "UPDATE reference SET identifier = 100 WHERE identifier = 7",
            "UPDATE reference SET sensor = 3 - sensor WHERE identifier = 7",
            "UPDATE reference SET ranges = zeroblob(length(ranges)) WHERE identifier = 7",
            "UPDATE reference SET ranges = substr(ranges, 5) WHERE identifier = 7",
            "UPDATE reference SET ranges = CAST(ranges AS TEXT) WHERE identifier = 7",
            "UPDATE reference SET ranges = 17 WHERE identifier = 7",
            "UPDATE reference SET checksum = 'x' WHERE identifier = 7",
            "UPDATE sensor SET range_max = 11",
            "UPDATE sensor SET readings = 1 << 40 WHERE identifier = 1",
            "UPDATE reference_set SET next_identifier = 3",
            "UPDATE reference_set SET name = name || '!'",
            "UPDATE reference_set SET settings = '{}'",
            "INSERT INTO reference_set SELECT * FROM reference_set",
        ],
    )
    def test_a_change_from_outside_is_noticed(
        self, change: str, sound: Path, tmp_path: Path
    ) -> None:
        path = tmp_path / "changed.apr"
        shutil.copyfile(sound, path)
        with closing(sqlite3.connect(path)) as connection:
            connection.execute(change)
            connection.commit()
        told(path, "is damaged")

    @pytest.mark.parametrize(
        "change",
        [
            "CREATE VIEW spy AS SELECT load_extension('evil')",
            "CREATE TRIGGER bomb AFTER INSERT ON reference BEGIN DELETE FROM reference; END",
            "CREATE TABLE more (x)",
            "DROP INDEX sensor_geometry",
            "ALTER TABLE reference ADD COLUMN y2 GENERATED ALWAYS AS (x || y)",
        ],
    )
    def test_other_tables_views_and_triggers_are_refused(
        self, change: str, sound: Path, tmp_path: Path
    ) -> None:
        path = tmp_path / "crafted.apr"
        shutil.copyfile(sound, path)
        with closing(sqlite3.connect(path)) as connection:
            connection.execute(change)
        for action in (None, lambda: SetFile(path), lambda: ReferenceSet().save(path)):
            told(path, "its tables are not those", action)

    def test_values_beyond_all_limits_are_refused_before_they_are_read(
        self, sound: Path, tmp_path: Path
    ) -> None:
        path = tmp_path / "crafted.apr"
        for change in (
            "UPDATE reference SET ranges = zeroblob(1 << 28) WHERE identifier = 7",
            "UPDATE reference SET name = CAST(zeroblob(1 << 25) AS TEXT) WHERE identifier = 7",
            "UPDATE reference_set SET settings = CAST(zeroblob(1 << 25) AS TEXT)",
        ):
            shutil.copyfile(sound, path)
            with closing(sqlite3.connect(path)) as connection:
                connection.execute(change)
                connection.commit()
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            told(path, "is damaged")
            assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000

    def test_more_bytes_than_the_file_has_are_refused(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Scans may share their pages in a crafted file, and so cost more than it weighs."""
        path = tmp_path / "a.apr"
        small_set(path)
        load = set_file_module._load_references

        class Shrunk:
            """A connection to a file that says it has two pages."""

            def __init__(self, connection: sqlite3.Connection) -> None:
                self.connection = connection

            def execute(self, statement: str, *rest: object) -> sqlite3.Cursor:
                if statement == "PRAGMA page_count":
                    statement = "SELECT 1"
                return self.connection.execute(statement, *rest)

        monkeypatch.setattr(
            set_file_module, "_load_references", lambda c, header: load(Shrunk(c), header)
        )
        (tmp_path / "b").mkdir()
        with ReferenceSet(path=tmp_path / "b" / "a.apr") as places:
            places.add_batch([scan_of(n) for n in range(20)])
        told(tmp_path / "b" / "a.apr", "shares its bytes")

    def test_identifiers_that_would_overflow_are_refused(self, sound: Path, tmp_path: Path) -> None:
        path = tmp_path / "crafted.apr"
        shutil.copyfile(sound, path)
        with closing(sqlite3.connect(path)) as connection:
            row = connection.execute("SELECT * FROM reference_set").fetchone()
            values = (*row[:2], (1 << 63) - 1, *row[3:5])
            connection.execute(
                "UPDATE reference_set SET next_identifier = ?, checksum = ?",
                (values[2], set_file_module._seal(*values)),
            )
            connection.commit()
        told(path, "is damaged")
        told(path, "is damaged", lambda: SetFile(path).append([Place(scan_of(0))]))

    def test_a_million_readings_in_a_header_of_nothing(self, sound: Path, tmp_path: Path) -> None:
        """Page counts and sizes in the header that the file does not have."""
        path = tmp_path / "crafted.apr"
        for offset, value in ((28, 0xFFFFFFFF), (16, 0x0200), (16, 0x0001), (32, 7), (36, 7)):
            content = bytearray(sound.read_bytes())
            struct.pack_into(">I" if offset != 16 else ">H", content, offset, value)
            path.write_bytes(content)
            try:
                assert content_of(path) == content_of(sound)
            except ReferenceSetError:
                told(path, "is damaged")


@contextmanager
def as_nobody() -> Iterator[None]:
    """Give up the superuser's rights, who may write everywhere."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that another user can enter."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    folder.chmod(0o755)
    shutil.rmtree(folder)


class TestReadOnly:
    def test_a_set_at_rest_is_read_and_not_written(self, open_folder: Path) -> None:
        path = open_folder / "a.apr"
        small_set(path)
        before = path.read_bytes()
        open_folder.chmod(0o555)
        with as_nobody():
            places = ReferenceSet.open(path)
            assert len(places) == 29
            told(path, "read-only|not accessible", lambda: places.add(scan_of(0)))
            told(path, "read-only|not accessible", lambda: places.remove(0))
            assert len(places) == 29
            target = open_folder / "new.apr"
            told(target, "[Pp]ermission", lambda: places.save(target))
            told(target, "[Pp]ermission", lambda: ReferenceSet(path=target))
            told(target, "[Pp]ermission", lambda: places.export_directory(target))
        assert path.read_bytes() == before
        assert [file.name for file in open_folder.iterdir()] == ["a.apr"]

    def test_a_copy_made_while_it_was_written_is_read(self, open_folder: Path) -> None:
        path, copy = open_folder / "a.apr", open_folder / "copy.apr"
        small_set(path)
        with ReferenceSet.open(path) as places:
            places.add(scan_of(0))
            shutil.copyfile(path, copy)  # in write-ahead mode, without its log
        path.unlink()
        copy.chmod(0o644)
        open_folder.chmod(0o555)
        with as_nobody():
            assert len(ReferenceSet.open(copy)) == 29

    def test_a_log_that_cannot_be_folded_in_is_told(self, open_folder: Path) -> None:
        path, copy = open_folder / "a.apr", open_folder / "copy.apr"
        small_set(path)
        with ReferenceSet.open(path) as places:
            places.add(scan_of(0))
            shutil.copyfile(path, copy)
            shutil.copyfile(f"{path}-wal", f"{copy}-wal")
        path.unlink()
        open_folder.chmod(0o555)
        with as_nobody():
            told(copy, r"copy\.apr-wal is there.* read-only: copy the two")
        open_folder.chmod(0o755)
        assert len(ReferenceSet.open(copy)) == 30

    def test_a_file_that_may_not_be_read(self, open_folder: Path) -> None:
        path = open_folder / "a.apr"
        small_set(path)
        path.chmod(0)
        with as_nobody():
            told(path, "[Pp]ermission")


class TestFullDisk:
    """A limit on the size of files stands for a full disk."""

    @contextmanager
    def room(self, size: int) -> Iterator[None]:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    def test_a_batch_without_room_is_told_and_the_rest_stays(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        small_set(path)
        before = content_of(path)
        with ReferenceSet.open(path) as places:
            with self.room(path.stat().st_size):
                told(
                    path,
                    "full",
                    lambda: places.add_batch([scan_of(n) for n in range(500)]),
                )
                assert len(places) == 29
                assert content_of(path) == before
            assert places.add(scan_of(0)) == 30  # when there is room again
        assert content_of(path)[:-1] == before
        assert [file.name for file in tmp_path.iterdir()] == ["a.apr"]

    def test_a_new_file_without_room_is_not_there(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        places = ReferenceSet()
        places.add_batch([scan_of(n) for n in range(500)])
        with self.room(100_000):
            told(path, "full", lambda: places.save(path))
        directory = tmp_path / "plain"
        with self.room(10_000):
            told(directory, "cannot be written", lambda: places.export_directory(directory))
        assert list(tmp_path.iterdir()) == []

    def test_another_set_is_not_lost_to_one_that_has_no_room(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        small_set(path)
        before = content_of(path)
        places = ReferenceSet()
        places.add_batch([scan_of(n) for n in range(500)])
        with self.room(100_000):
            told(path, "full", lambda: places.save(path))
        assert content_of(path) == before

    def test_a_build_without_room_continues_when_there_is_some(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        records = [Record(i, scan_of(i), pose_of(i)) for i in range(2000)]
        with self.room(600_000):
            told(path, "full", lambda: ReferenceSet.build(records, keep_all=True, path=path))
            stored = len(ReferenceSet.open(path))
            assert 0 < stored < 2000
            assert stored % 256 == 0
        ReferenceSet.build(records, keep_all=True, path=path)
        check_scans(path, 2000)

    def test_a_log_without_room_in_the_file_is_told_and_kept(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        small_set(path)
        places = ReferenceSet.open(path)
        places.add_batch([scan_of(n) for n in range(30, 70)])
        with self.room(path.stat().st_size):
            told(path, "all is stored, but part of it in a.apr-wal", places.close)
        assert len(content_of(path)) == 29 + 40
        assert [file.name for file in tmp_path.iterdir()] == ["a.apr"]


def test_a_set_whose_numbers_are_used_up_takes_no_more_and_stays_sound(tmp_path: Path) -> None:
    path = tmp_path / "a.apr"
    with ReferenceSet(path=path) as places:
        places.add(scan_of(0), pose_of(0))
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("BEGIN")
        header = replace(_load_header(connection), next_identifier=LAST_IDENTIFIER - 1)
        _store_header(connection, header)
        connection.execute("COMMIT")
    with ReferenceSet.open(path) as places:
        told(path, "no number is left", lambda: places.add_batch([scan_of(1), scan_of(2)]))
        assert places.add(scan_of(1), pose_of(1)) == LAST_IDENTIFIER - 1
        told(path, "no number is left", lambda: places.add(scan_of(2), pose_of(2)))
    with ReferenceSet.open(path) as places:
        assert len(places) == 2


def test_paths_are_quoted_for_the_database() -> None:
    """A path is a path, whatever it looks like in a URI."""
    path = Path("/a b/c?mode=memory#d%2F.apr")
    assert path.as_uri() == f"file://{quote(str(path))}"


def test_a_hidden_thread_does_not_own_the_file(tmp_path: Path) -> None:
    """A set opened in one thread is changed and closed in others, as ROS executors do."""
    path = tmp_path / "a.apr"
    places = ReferenceSet(path=path)
    places.add(scan_of(0), Pose2D(0, 0, math.pi))
    threads = [threading.Thread(target=places.add, args=(scan_of(n),)) for n in range(1, 20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    places.close()
    assert len(content_of(path)) == 20


_READ_AND_WRITE = """
import sys
from anchorscan import LaserScan, Pose2D, ReferenceSet
with ReferenceSet.open(sys.argv[1]) as places:
    places.add(LaserScan([2.0] * 9, 0.0, 0.1), Pose2D(), "other")
    print(len(places))
"""


def test_a_writer_that_also_reads_keeps_its_hold_on_the_log(tmp_path: Path) -> None:
    """Another process that opens, writes and closes must not take the log away from it."""
    path = tmp_path / "set.apr"
    scan = LaserScan([1.0] * 9, 0.0, 0.1)
    with ReferenceSet(path=path) as places:
        for count in range(3):
            places.add(scan, Pose2D(), "mine")
            places.refresh()
            ReferenceSet.open(path).close()
            done = subprocess.run(
                [sys.executable, "-c", _READ_AND_WRITE, str(path)],
                capture_output=True,
                text=True,
                check=True,
            )
            assert int(done.stdout) == 2 * count + 2
    names = [reference.name for reference in ReferenceSet.open(path).references]
    assert sorted(names) == 3 * ["mine"] + 3 * ["other"]
