"""The index beside a set: it changes no answer, and what is wrong with it does no harm."""

from __future__ import annotations

import math
import os
import resource
import shutil
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from reference_set_kills import kill_many
from scans import FULL_TURN, WIDE, building

from anchorscan import LaserScan, Pose2D, ReferenceSet, ReferenceSetError, Settings, simulate
from anchorscan.array_file import read_arrays, write_arrays
from anchorscan.derived_index import _made_of as made_of
from anchorscan.derived_index import index_path

COUNT = 14


def drive(number: int) -> tuple[list[tuple[LaserScan, Pose2D]], list[LaserScan]]:
    world, at = building(number)
    rng = np.random.default_rng(number)
    seen = [(simulate(world, pose, FULL_TURN, rng), pose) for pose in at[:COUNT]]
    theirs = [pose @ Pose2D(0.3, -0.2, 0.8) for pose in at[:5]]
    return seen, [simulate(world, pose, WIDE, rng) for pose in theirs]


SEEN, ASKED = drive(1)
OTHERS, _ = drive(2)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set and its index."""
    path = tmp_path_factory.mktemp("indexed") / "office.apr"
    with ReferenceSet(path=path, name="office") as places:
        places.add_batch([scan for scan, _ in SEEN], [pose for _, pose in SEEN], ["ä"] * COUNT)
        places.save_index()
    return path


@pytest.fixture
def path(written: Path, tmp_path: Path) -> Path:
    """A copy of these of one's own."""
    for each in (written, index_path(written)):
        shutil.copyfile(each, tmp_path / each.name)
    return tmp_path / written.name


def is_indexed(places: ReferenceSet) -> bool:
    return places._index is not None


def answers(places: ReferenceSet) -> list[object]:
    return [
        (
            *(h.reference, h.pose, h.pose_in_reference, h.evaluation, h.quality, h.score),
            *(h.probability, h.accepted, h.covariance.tobytes()),
        )
        for scan in ASKED
        for candidates in (None, 3)
        for h in places.locate(scan, candidates)
    ]


def content(places: ReferenceSet) -> list[object]:
    return [
        (r.identifier, r.name, r.pose, r.scan.ranges.tobytes(), r.scan.angle_min)
        for r in places.references
    ]


def anew(path: Path, settings: Settings | None = None) -> ReferenceSet:
    return ReferenceSet.open(path, settings=settings, use_index=False)


# What it must not change.


def test_answers_and_references_are_those_without_an_index(path: Path) -> None:
    places = ReferenceSet.open(path)
    assert is_indexed(places)
    assert places.info().index == "current"
    assert places.name == "office"
    assert len(places) == COUNT
    assert 3 in places
    assert COUNT not in places
    assert content(places) == content(anew(path))
    assert answers(places) == answers(anew(path))


def test_what_was_added_and_removed_since_counts(path: Path) -> None:
    with ReferenceSet.open(path) as places:
        before = index_path(path).read_bytes()
        places.locate(ASKED[0])
        added = [places.add(*each) for each in OTHERS[:2]]
        places.remove(added[0])
        places.remove(4)
        here = answers(places)
        assert index_path(path).read_bytes() == before  # what is mapped is changed in memory only
    later = ReferenceSet.open(path)
    assert later.info().index == "behind"
    assert is_indexed(later)
    assert len(later) == COUNT
    assert content(later) == content(anew(path))
    assert answers(later) == here == answers(anew(path))
    later.save_index()
    assert later.info().index == "current"
    assert answers(ReferenceSet.open(path)) == here


def test_an_index_far_behind_is_not_used(path: Path) -> None:
    with ReferenceSet.open(path) as places:
        places.add_batch([scan for scan, _ in OTHERS], [pose for _, pose in OTHERS])
        assert places.info().index == "outdated"
    assert not is_indexed(ReferenceSet.open(path))
    assert content(ReferenceSet.open(path)) == content(anew(path))


def test_others_that_add_and_remove_are_followed(path: Path) -> None:
    ours, theirs = ReferenceSet.open(path), ReferenceSet.open(path)
    ours.locate(ASKED[0])
    theirs.remove(2)
    theirs.add(*OTHERS[0])
    theirs.close()
    assert len(ours) == COUNT
    assert ours[2].pose == SEEN[2][1]  # what others have removed is still here until then
    assert ours.refresh()
    assert content(ours) == content(anew(path))
    assert answers(ours) == answers(anew(path))


def test_an_index_serves_all_settings_that_derive_the_same(path: Path) -> None:
    thorough = Settings.preset("thorough")
    places = ReferenceSet.open(path, settings=thorough)
    assert is_indexed(places)
    assert answers(places) == answers(anew(path, thorough))
    for changes in ({"field": {"resolution": 0.1}}, {"anchors": {"arm": 0.5}}, {"method": "map"}):
        settings = Settings.preset().changed(changes)
        places = ReferenceSet.open(path, settings=settings)
        assert is_indexed(places) == (settings == Settings.preset())
        assert answers(places) == answers(anew(path, settings))


def test_the_index_of_another_set_is_not_used(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.apr"
    with ReferenceSet(path=other) as places:
        places.add_batch([scan for scan, _ in OTHERS], [pose for _, pose in OTHERS])
    shutil.copyfile(index_path(path), index_path(other))
    assert ReferenceSet.open(other).info().index == "outdated"
    assert content(ReferenceSet.open(other)) == content(anew(other))


def test_a_replaced_set_is_not_what_its_index_says(path: Path) -> None:
    moved = ReferenceSet(name="moved")
    moved.add_batch([scan for scan, _ in SEEN], [Pose2D(1.0, 0.0) @ pose for _, pose in SEEN])
    moved.save(path)
    assert not is_indexed(ReferenceSet.open(path))
    assert answers(ReferenceSet.open(path)) == answers(moved)


def test_a_set_with_an_index_can_be_exported_and_saved(path: Path, tmp_path: Path) -> None:
    places = ReferenceSet.open(path)
    places.save(tmp_path / "copy.apr")
    places.export_directory(tmp_path / "plain")
    assert content(ReferenceSet.open(tmp_path / "copy.apr")) == content(places)
    assert content(ReferenceSet.import_directory(tmp_path / "plain")) == content(places)


# What may be wrong with it.


def test_damage_anywhere_changes_no_answer(path: Path) -> None:
    expected = answers(anew(path))
    whole = index_path(path).read_bytes()
    rng = np.random.default_rng(5)
    used = 0
    for where in [*range(0, 60, 6), *rng.integers(0, 6000, 12), *rng.integers(0, len(whole), 25)]:
        damaged = bytearray(whole)
        damaged[where] ^= 1 << int(rng.integers(8))
        index_path(path).write_bytes(damaged)
        places = ReferenceSet.open(path)
        used += is_indexed(places)
        # A hole between arrays may hold anything.
        assert answers(places) == expected
    assert used < 40


@pytest.mark.parametrize("keep", [0, 10, 60, 4000, -1])
def test_an_index_cut_short_is_not_used(path: Path, keep: int) -> None:
    whole = index_path(path).read_bytes()
    index_path(path).write_bytes(whole[:keep])
    places = ReferenceSet.open(path)
    assert not is_indexed(places)
    assert places.info().index == "outdated"
    assert content(places) == content(anew(path))


def test_something_else_in_its_place_is_not_used(path: Path) -> None:
    for other in (b"", b"hello\n" * 1000, path.read_bytes()):
        index_path(path).write_bytes(other)
        assert not is_indexed(ReferenceSet.open(path))
    index_path(path).unlink()
    index_path(path).mkdir()
    assert ReferenceSet.open(path).info().index == "none"
    with pytest.raises(ReferenceSetError, match=r"office.apr.index: .*directory"):
        ReferenceSet.open(path).save_index()
    index_path(path).rmdir()
    os.mkfifo(index_path(path))
    assert ReferenceSet.open(path).info().index == "none"


CRAFTED = (
    *(("landmarks.edges", value) for value in (-1, 1 << 30)),
    *(("landmarks.starts", value) for value in (-1, 1 << 40)),
    *(("landmarks.edge_starts", value) for value in (-1, 1 << 40)),
    *(("field.squares", value) for value in (-(1 << 30), 1 << 30)),
    *(("field.evidence_starts", value) for value in (-1, 1 << 40)),
    *(("anchors.starts", value) for value in (-1, 1 << 40)),
    *(("anchors.kinds", value) for value in (-1, 5)),
    *(("references.identifiers", value) for value in (-1, 1 << 50)),
    *(("references.poses", value) for value in (math.nan, 1e300)),
    *(("anchors.positions", value) for value in (math.nan, math.inf, 1e300)),
    *(("anchors.directions", value) for value in (math.nan, -1e300)),
    ("anchors.main_angles", math.inf),
    *(("landmarks.positions", value) for value in (math.nan, -math.inf, 1e300)),
    *(("scans.starts", value) for value in (-1, 1 << 40)),
    *(("scans.sensors", value) for value in (-1, 1)),
    *(("names.starts", value) for value in (-1, 1 << 40)),
    ("database.postings", 1 << 31),
    ("database.starts", 1 << 31),
    ("database.identifiers", 1 << 50),
)


@pytest.mark.parametrize(("name", "value"), CRAFTED)
def test_numbers_that_name_what_is_not_there_are_not_used(
    path: Path, name: str, value: float
) -> None:
    """As somebody may write them who knows how the checksums are made."""
    arrays = read_arrays(index_path(path), made_of(Settings.preset()))
    assert arrays is not None
    arrays = {each: array.copy() for each, array in arrays.items()}
    flat = arrays[name].reshape(-1)
    flat[len(flat) // 2] = value
    write_arrays(index_path(path), arrays, made_of(Settings.preset()))
    places = ReferenceSet.open(path)
    assert answers(places) == answers(anew(path))


def test_a_scan_that_is_not_the_sets_is_an_error_that_says_so(path: Path) -> None:
    arrays = read_arrays(index_path(path), made_of(Settings.preset()))
    assert arrays is not None
    arrays["scans.ranges"][:] += 1.0
    write_arrays(index_path(path), arrays, made_of(Settings.preset()))
    with pytest.raises(ReferenceSetError, match="reference 3 of the index fails its checksum"):
        ReferenceSet.open(path)[3]


@pytest.mark.parametrize("name", ["field.codes", "landmarks.lengths", "scans.sensors"])
def test_arrays_of_another_kind_or_size_are_not_used(path: Path, name: str) -> None:
    expected = answers(anew(path))
    whole = read_arrays(index_path(path), made_of(Settings.preset()))
    assert whole is not None
    for change in (
        lambda array: array.astype(np.float64 if array.dtype != np.float64 else np.int8),
        lambda array: array[:-1] if name != "field.codes" else array[:5],
        lambda array: array.reshape(-1)[:, np.newaxis],
    ):
        arrays = {each: array.copy() for each, array in whole.items()}
        write_arrays(
            index_path(path), {**arrays, name: change(arrays[name])}, made_of(Settings.preset())
        )
        assert answers(ReferenceSet.open(path)) == expected
    missing = {each: array for each, array in whole.items() if each != name}
    write_arrays(index_path(path), missing, made_of(Settings.preset()))
    assert answers(ReferenceSet.open(path)) == expected


# Writing it.


@contextmanager
def disk_full_at(size: int) -> Iterator[None]:
    """A limit on the size of files stands for a full disk."""
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


@pytest.mark.parametrize("size", [0, 100, 50_000])
def test_a_full_disk_is_one_line_and_leaves_what_was_there(path: Path, size: int) -> None:
    set_bytes = path.read_bytes()
    with ReferenceSet.open(path) as places:
        index_path(path).unlink()  # a new file: the old one is mapped
        index_path(path).write_bytes(b"another version's")
        with disk_full_at(size), pytest.raises(ReferenceSetError) as told:
            places.save_index()
    assert str(told.value).startswith(f"{index_path(path)}: ")
    assert "\n" not in str(told.value)
    assert index_path(path).read_bytes() == b"another version's"
    assert path.read_bytes() == set_bytes
    assert sorted(each.name for each in path.parent.iterdir()) == [
        "office.apr",
        "office.apr.index",
    ]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_in_a_read_only_folder_it_is_used_but_not_written(path: Path) -> None:
    path.parent.chmod(0o555)
    try:
        places = ReferenceSet.open(path)
        assert is_indexed(places)
        assert answers(places) == answers(anew(path))
        index_path(path).chmod(0)
        assert not is_indexed(ReferenceSet.open(path))
        with pytest.raises(ReferenceSetError, match=r"office\.apr\.index: Permission denied"):
            ReferenceSet.open(path).save_index()
    finally:
        path.parent.chmod(0o755)


def test_a_folder_that_is_gone_is_an_error_that_names_the_index(path: Path) -> None:
    places = ReferenceSet.open(path)
    shutil.rmtree(path.parent)
    with pytest.raises(ReferenceSetError, match=r"office\.apr\.index: No such file"):
        places.save_index()


def test_writers_at_once_do_no_harm(path: Path) -> None:
    index_path(path).unlink()
    sets = [ReferenceSet.open(path) for _ in range(3)]
    threads = [threading.Thread(target=each.save_index) for each in sets]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [each.name for each in path.parent.glob(".*")] == []
    places = ReferenceSet.open(path)
    assert is_indexed(places)
    assert answers(places) == answers(anew(path))


def test_a_reader_keeps_the_index_that_it_opened(path: Path) -> None:
    places = ReferenceSet.open(path)
    with ReferenceSet.open(path) as other:
        other.remove(0)
        other.save_index()
    assert places.info().references == COUNT
    assert content(places)[0][0] == 0
    assert answers(ReferenceSet.open(path)) == answers(anew(path))


def test_a_current_index_is_not_written_again(path: Path) -> None:
    before = index_path(path).stat().st_mtime_ns, index_path(path).stat().st_ino
    ReferenceSet.open(path).save_index()
    assert before == (index_path(path).stat().st_mtime_ns, index_path(path).stat().st_ino)


def test_drafts_of_killed_writers_are_removed_in_time(path: Path) -> None:
    forsaken, fresh = (path.with_name(f".office.apr.index.{k}.part") for k in ("dead", "alive"))
    for draft in (forsaken, fresh):
        draft.write_bytes(b"half")
    os.utime(forsaken, (0.0, 0.0))
    with ReferenceSet.open(path) as places:
        places.add(*OTHERS[0])
        places.save_index()
    assert (forsaken.exists(), fresh.exists()) == (False, True)


def test_what_has_no_index_says_so(tmp_path: Path) -> None:
    with pytest.raises(ReferenceSetError, match="in memory has no index"):
        ReferenceSet().save_index()
    with ReferenceSet(path=tmp_path / "rooms.apr") as rooms:
        rooms.add(SEEN[0][0], name="kitchen")
        with pytest.raises(ReferenceSetError, match="searched as one map have an index"):
            rooms.save_index()
    paper = Settings.preset("paper")
    with ReferenceSet(path=tmp_path / "paper.apr", settings=paper) as places:
        places.add(*SEEN[0])
        with pytest.raises(ReferenceSetError, match="searched as one map have an index"):
            places.save_index()
    with ReferenceSet(path=tmp_path / "empty.apr") as empty:
        empty.save_index()
    with ReferenceSet.open(tmp_path / "empty.apr") as again:
        assert is_indexed(again)
        assert again.locate(ASKED[0]) == []
        again.add(*SEEN[0])
        assert again.locate(SEEN[0][0])[0].accepted


def test_a_writer_of_the_index_killed_at_any_moment_leaves_the_set_right(tmp_path: Path) -> None:
    assert kill_many("index", kills=4, seed=2, folder=tmp_path) >= 1
