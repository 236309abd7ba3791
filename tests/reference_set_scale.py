"""Measure a large reference set: its index, how it opens, and what adding and removing cost.

Copies of a real set, laid out far apart with poses and ranges a little off, make a set of any
size::

    anchorscan build intel.log.gz -o intel.apr
    python tests/reference_set_scale.py intel.apr --references 100000

Every measurement is of a process of its own, as a user would have it; times are of the clock,
with the processor's time in brackets.
"""

from __future__ import annotations

import argparse
import math
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from anchorscan import LaserScan, Pose2D, ReferenceSet, Settings
from anchorscan.derived_index import index_path

APART = 60.0
BATCH = 2000
ASKED = 200
CHANGED = 200
# More references than this propose only if they are voted for.
PROPOSING = 20_000
VOTED_FOR = 20


def copies(places: ReferenceSet, count: int) -> Iterator[tuple[LaserScan, Pose2D]]:
    """The scans of a set, again and again, each time elsewhere and a little different."""
    bounds = places.info().bounds
    assert bounds is not None
    left, bottom, right, top = bounds
    pitch = max(right - left, top - bottom) + APART
    columns = math.ceil(math.sqrt(count / len(places)))
    for number in range(count):
        copy, k = divmod(number, len(places))
        reference, rng = places.references[k], np.random.default_rng(number)
        assert reference.pose is not None
        scan = reference.scan
        noise = rng.normal(0.0, 0.01, len(scan)).astype(np.float32)
        ranges = scan.ranges if copy == 0 else scan.ranges + noise
        off = Pose2D(*rng.normal(0.0, (0.02, 0.02, 0.003))) if copy else Pose2D()
        here = Pose2D(copy % columns * pitch, copy // columns * pitch)
        geometry = scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max
        yield LaserScan(ranges, *geometry), here @ reference.pose @ off


def make(source: Path, count: int, path: Path) -> None:
    changes = {"database": {"candidates": VOTED_FOR}} if count > PROPOSING else {}
    settings = Settings.preset().changed(changes)
    begin = time.perf_counter()
    with ReferenceSet(path=path, settings=settings) as places:
        batch: list[tuple[LaserScan, Pose2D]] = []
        for each in copies(ReferenceSet.open(source), count):
            batch.append(each)
            if len(batch) == BATCH:
                places.add_batch(*zip(*batch, strict=True))
                batch = []
        if batch:
            places.add_batch(*zip(*batch, strict=True))
        print(f"made: {count} references, {time.perf_counter() - begin:.1f} s", flush=True)


def timed(what: str, action: Callable[[], Any]) -> Any:
    clock, processor = time.perf_counter(), time.process_time()
    result = action()
    clock, processor = time.perf_counter() - clock, time.process_time() - processor
    print(f"{what}: {clock:.3f} s ({processor:.3f} s), {memory():.0f} MB", flush=True)
    return result


def memory() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def write_index(path: Path) -> None:
    places = ReferenceSet.open(path, use_index=False)
    places.prepare()
    timed("written", places.save_index)
    print(f"set: {path.stat().st_size:,} bytes, index: {index_path(path).stat().st_size:,} bytes, ")


def ask(path: Path) -> None:
    timed("imported", lambda: ReferenceSet().settings)
    places = timed("opened", lambda: ReferenceSet.open(path))
    print(f"index: {places.info().index}" if len(places) < PROPOSING else "", end="\n")
    identifiers = np.linspace(0, len(places) - 1, ASKED).astype(int).tolist()
    timed("first answer", lambda: places.locate(places[identifiers[0]].scan))
    spent, right = [], 0
    for identifier in identifiers:
        reference = places[identifier]
        begin = time.process_time()
        best = places.locate(reference.scan)[0]
        spent.append(1e3 * (time.process_time() - begin))
        assert best.pose is not None
        assert reference.pose is not None
        right += best.pose.distance(reference.pose) < 0.5
    tell("answer", spent)
    print(f"of {ASKED} scans {right} were placed there, the others at their likes", flush=True)
    change(places, identifiers[:CHANGED], ", each elsewhere")
    first = len(places) // 2
    change(places, list(range(first, min(first + CHANGED, len(places)))), ", along one drive")
    print(f"memory: {memory():.0f} MB")


def change(places: ReferenceSet, identifiers: list[int], where: str) -> None:
    """Add and remove in memory: with a file the disk's own time comes on top, once a batch."""
    matcher, added, removed = places._prepared(), [], []
    others = [places[identifier] for identifier in identifiers]
    first = 1 << 40
    for k, reference in enumerate(others):
        again = type(reference)(first + k, reference.scan, reference.pose)
        begin = time.process_time()
        matcher.add(again)
        added.append(1e3 * (time.process_time() - begin))
    for k in range(len(others)):
        begin = time.process_time()
        matcher.remove(first + k)
        removed.append(1e3 * (time.process_time() - begin))
    tell(f"add{where}", added)
    tell(f"remove{where}", removed)


def tell(what: str, spent: list[float]) -> None:
    print(
        f"{what}: median {np.median(spent):.2f} ms, mean {np.mean(spent):.2f} ms, "
        f"99 % {np.percentile(spent, 99):.2f} ms (processor)",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, help="the set to copy")
    parser.add_argument("--references", type=int, default=10_000)
    parser.add_argument("--folder", type=Path, help="where to write; a temporary one if none")
    parser.add_argument("--step", choices=["index", "ask"], help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.step:
        (write_index if arguments.step == "index" else ask)(arguments.source)
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        path = folder / f"{arguments.references}.apr"
        if not path.exists():
            make(arguments.source, arguments.references, path)
        for step in ("index", "ask"):
            subprocess.run([sys.executable, __file__, str(path), "--step", step], check=True)


if __name__ == "__main__":
    main()
