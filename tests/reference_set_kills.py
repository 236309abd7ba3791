"""Kill a process that writes a reference set, at random moments, and look at what is left.

As a script it goes on for as long as it is asked to::

    python tests/reference_set_kills.py --kills 1000 --seed 7

and ends with one line per way of writing, or with the first thing that was lost.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np

from anchorscan import LaserScan, Pose2D, Record, ReferenceSetError
from anchorscan.reference_set import ReferenceSet

BATCH = 7
WAYS = ("add", "build", "save")
# Takes a second to start: the numbers of anchors are derived.
INDEXED = "index"
BUILT = 1500
LONGEST_WAIT = 0.12


def scan_of(number: int) -> LaserScan:
    """The scan that reference ``number`` must hold, to the bit."""
    ranges = np.random.default_rng(number).uniform(0.1, 30.0, 181).astype(np.float32)
    return LaserScan(ranges, -0.5 * math.pi, math.pi / 180.0, 0.05, 30.0 + number % 3)


def pose_of(number: int) -> Pose2D:
    return Pose2D(math.sin(number), 0.1 * number, number)


def records() -> Iterator[Record]:
    """A log in which every fifth record is of no use."""
    for number in range(BUILT):
        yield Record(number, scan_of(number), pose_of(number) if number % 5 else None)


def write(way: str, path: Path) -> None:
    """Write until killed; say on stdout what is stored by then."""
    say("ready")
    if way == "build":
        ReferenceSet.build(
            records(), keep_all=True, path=path, progress=lambda _, kept: say(f"{kept} 0")
        )
        say("done")
    while way == "add":
        add_and_remove(path)
    while way == INDEXED:
        add_and_index(path)
    while way == "save":
        for generation in range(1, 1_000_000):
            places = ReferenceSet(name=str(generation))
            numbers = range(generation, generation + 5 * BATCH)
            places.add_batch([scan_of(n) for n in numbers], [pose_of(n) for n in numbers])
            places.save(path)
            say(f"{generation} 0")


def add_and_remove(path: Path) -> None:
    """Open, add three batches, remove the first reference of each, close."""
    with ReferenceSet.open(path) if path.exists() else ReferenceSet(path=path) as places:
        for _ in range(3):
            first = places.info().next_identifier
            numbers = range(first, first + BATCH)
            added = places.add_batch(
                [scan_of(n) for n in numbers],
                [pose_of(n) for n in numbers],
                [f"place {n}" for n in numbers],
            )
            say(f"{added[-1] + 1} {len(places)}")
            places.remove(added[0])
            say(f"{added[-1] + 1} {len(places)}")


def add_and_index(path: Path) -> None:
    """Open, add a batch, and write the index anew, several times."""
    with ReferenceSet.open(path) if path.exists() else ReferenceSet(path=path) as places:
        for _ in range(3):
            first = places.info().next_identifier
            numbers = range(first, first + BATCH)
            added = places.add_batch([scan_of(n) for n in numbers], [pose_of(n) for n in numbers])
            say(f"{added[-1] + 1} {len(places)}")
            places.save_index()


def say(line: str) -> None:
    os.write(1, f"{line}\n".encode())


def kill_once(way: str, path: Path, wait: float, let_store: bool) -> list[str]:
    """Start a writer, kill it some seconds after it is ready, return what it said.

    On a busy machine it may not have come to anything by then: where ``let_store`` is set, the
    seconds count from the first change that it stored.
    """
    writer = subprocess.Popen(
        [sys.executable, __file__, "--write", way, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert writer.stdout is not None
    try:
        assert writer.stdout.readline() == "ready\n"
        first = [writer.stdout.readline().strip()] if let_store else []
        time.sleep(wait)
    finally:
        writer.send_signal(signal.SIGKILL)
    said = first + writer.stdout.read().splitlines()
    writer.wait()
    writer.stdout.close()
    assert writer.returncode in (0, -signal.SIGKILL), "the writer failed by itself"
    return said


def check_sound(path: Path) -> None:
    """The file by itself, once it was opened, is all there is; SQLite finds it in order too."""
    assert not Path(f"{path}-wal").exists()
    alone = path.with_suffix(".alone")
    shutil.copyfile(path, alone)
    one, other = ReferenceSet.open(path), ReferenceSet.open(alone)
    assert [r.identifier for r in one.references] == [r.identifier for r in other.references]
    assert one.info().build == other.info().build
    assert one.name == other.name
    with closing(sqlite3.connect(alone)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


def check_bits(places: ReferenceSet, shift: int = 0) -> None:
    """Every reference holds what belongs to its number."""
    for reference in places.references:
        number = reference.identifier + shift
        assert reference.scan.ranges.tobytes() == scan_of(number).ranges.tobytes()
        assert reference.pose == pose_of(number)


def check_added(path: Path, said: list[str], before: int) -> int:
    """Nothing that was stored is gone, and no half of a batch is there."""
    places = ReferenceSet.open(path)
    check_bits(places)
    following = places.info().next_identifier
    assert following % BATCH == 0
    present = {reference.identifier for reference in places.references}
    for first in range(0, following, BATCH):
        batch = present & set(range(first, first + BATCH))
        assert len(batch) == BATCH - (first not in present)
    if said:
        told, count = (int(word) for word in said[-1].split())
        # At most one change was done and not yet told of.
        assert (following, len(present)) in {
            (told, count),
            (told, count - 1),
            (told + BATCH, count + BATCH),
        }
    assert following >= before
    return following


def check_built(path: Path, said: list[str], before: int) -> int:
    """What was kept is the beginning of what an undisturbed build keeps."""
    places = ReferenceSet.open(path)
    build = places.info().build
    assert build is not None
    numbers = [number for number in range(build.consumed) if number % 5]
    assert len(places) == len(numbers)
    for reference, number in zip(places.references, numbers, strict=True):
        assert reference.scan.ranges.tobytes() == scan_of(number).ranges.tobytes()
        assert reference.pose == pose_of(number)
    if said and said[-1] != "done":
        assert len(places) >= int(said[-1].split()[0])
    assert len(places) >= before
    return len(places)


def check_saved(path: Path, said: list[str], _: int) -> int:
    """The set is one generation, whole; the last one told of, or the next."""
    places = ReferenceSet.open(path)
    generation = int(places.name)
    assert len(places) == 5 * BATCH
    check_bits(places, shift=generation)
    if said:
        assert generation - int(said[-1].split()[0]) in (0, 1)
    return 0


def check_indexed(path: Path, said: list[str], before: int) -> int:
    """Whatever index is there, the set with it is the set without it, and so are answers."""
    places, plain = ReferenceSet.open(path), ReferenceSet.open(path, use_index=False)
    check_bits(places)
    assert (
        len(places) == len(plain) >= max([before, *(int(line.split()[1]) - BATCH for line in said)])
    )
    assert [r.identifier for r in places.references] == [r.identifier for r in plain.references]
    for number in {0, len(plain) - 1} if len(plain) else ():
        ours, theirs = (each.locate(scan_of(number), 3)[0] for each in (places, plain))
        assert ours.pose == theirs.pose
        assert ours.probability == theirs.probability
    return len(places)


CHECKS = {
    "add": check_added,
    "build": check_built,
    "save": check_saved,
    INDEXED: check_indexed,
}


def kill_many(way: str, kills: int, seed: int, folder: Path) -> int:
    """Kill writers of one file again and again; return how many left something behind."""
    rng = random.Random(seed)
    path = folder / f"{way}.apr"
    stored, left = 0, 0
    for _ in range(kills):
        said = kill_once(way, path, rng.uniform(0.0, LONGEST_WAIT), rng.random() < 0.5)
        if not path.exists():
            assert not said
            continue
        left += 1
        stored = CHECKS[way](path, said, stored)
        check_sound(path)
        if way == "build" and ReferenceSet.open(path).info().build.finished:
            path.unlink()
            stored = 0
    return left


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=300, help="for every way of writing")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", nargs=2, metavar=("WAY", "PATH"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.write:
        write(arguments.write[0], Path(arguments.write[1]))
        return
    folder = Path(tempfile.mkdtemp())
    try:
        for way in (*WAYS, INDEXED):
            left = kill_many(way, arguments.kills, arguments.seed, folder)
            print(f"{way}: {arguments.kills} kills, {left} files checked, nothing lost")
    except (AssertionError, ReferenceSetError):
        print(f"what was left is in {folder}", file=sys.stderr)
        raise
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
