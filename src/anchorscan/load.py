"""``anchorscan endure load``: several processes on one set file, and threads on one set.

Every worker asks the same scans without a pause for a given time.  Told are the queries a second
of all workers together and the 99th percentile of a query, against that of one worker; and
whether every answer was the same to the bit as the one that a single worker gives.  More workers
than processors wait for each other: the number of processors is told with the table.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .errors import AnchorscanError
from .hypothesis import Hypothesis
from .reference_set import ReferenceSet
from .scan import LaserScan

if TYPE_CHECKING:
    from multiprocessing.queues import Queue

__all__ = ["Load", "digest", "processes", "run", "table", "threads"]

_WORKERS = (1, 2, 4)
# A worker that has not begun by then never will, seconds.
_PATIENCE = 300.0


@dataclass(frozen=True, eq=False)
class Load:
    """What some workers saw.

    Args:
        kind: "processes" or "threads".
        workers: Their number.
        seconds: (N,) of every query, all workers together.
        lasted: Seconds from the first query to the last.
        alike: Whether all answers were those of a single worker, to the bit.
    """

    kind: str
    workers: int
    seconds: NDArray[np.float64]
    lasted: float
    alike: bool


def run(
    set_file: Path, scans: Sequence[LaserScan], seconds: float, say: Callable[[str], None]
) -> list[Load]:
    """Load a set with one, two and four processes, then threads, and print the table.

    Args:
        set_file: The set.
        scans: The questions.
        seconds: For how long each.
        say: Takes the lines.

    Raises:
        AnchorscanError: There is no question, or a worker ended early.
        ReferenceSetError: The set cannot be read.
    """
    if not scans:
        raise AnchorscanError("there is no scan to ask")
    places = ReferenceSet.open(set_file)
    places.prepare()
    expected = [digest(places.locate(_fresh(scan))) for scan in scans]
    found = [processes(set_file, scans, expected, count, seconds) for count in _WORKERS]
    found += [threads(places, scans, expected, count, seconds) for count in _WORKERS]
    say(f"{len(places)} references, {len(scans)} scans, {os.cpu_count()} processors")
    for line in table(found):
        say(line)
    return found


def table(loads: Sequence[Load]) -> list[str]:
    """Return the table in Markdown."""
    lines = [
        "| workers | queries a second | median ms | 99th percentile ms | of one | longest ms | "
        "same answers |",
        "| --- | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    for load in loads:
        alone = next(each for each in loads if each.kind == load.kind)
        high, first = (float(np.percentile(each.seconds, 99)) for each in (load, alone))
        kind = load.kind if load.workers > 1 else {"processes": "process"}.get(load.kind, "thread")
        lines.append(
            f"| {load.workers} {kind} | {len(load.seconds) / load.lasted:.0f} | "
            f"{1e3 * float(np.median(load.seconds)):.2f} | {1e3 * high:.2f} | {high / first:.2f} | "
            f"{1e3 * float(load.seconds.max()):.1f} | {'yes' if load.alike else '**no**'} |"
        )
    return lines


def processes(
    set_file: Path,
    scans: Sequence[LaserScan],
    expected: Sequence[bytes],
    count: int,
    seconds: float,
) -> Load:
    """Load a set file with processes, each of which opens it.

    Args:
        set_file: The set.
        scans: The questions.
        expected: The `digest` of the answer to each.
        count: Of processes.
        seconds: For how long.

    Raises:
        AnchorscanError: A worker ended early.
    """
    context = multiprocessing.get_context("spawn")
    ready, told = context.Barrier(count), context.Queue()
    workers = [
        context.Process(
            target=_work, args=(set_file, list(scans), list(expected), seconds, ready, told)
        )
        for _ in range(count)
    ]
    for worker in workers:
        worker.start()
    try:
        parts = [told.get(timeout=_PATIENCE + seconds) for _ in workers]
    except Exception:  # the queue's own: nothing came
        raise AnchorscanError(f"one of {count} processes ended early") from None
    finally:
        for worker in workers:
            worker.join(timeout=1.0)
            worker.terminate()
    return _together("processes", parts)


def threads(
    places: ReferenceSet,
    scans: Sequence[LaserScan],
    expected: Sequence[bytes],
    count: int,
    seconds: float,
) -> Load:
    """Load one set with threads; arguments as for `processes`."""
    parts: list[_Part] = []
    ready = threading.Barrier(count)

    def work() -> None:
        ready.wait()
        parts.append(_ask(places, scans, expected, seconds))

    workers = [threading.Thread(target=work) for _ in range(count)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    return _together("threads", parts)


def digest(hypotheses: Sequence[Hypothesis]) -> bytes:
    """Return 16 bytes that stand for all that an answer says, to the last bit."""
    told = blake2b(digest_size=16)
    for each in hypotheses:
        poses = [
            pose.to_array() for pose in (each.pose_in_reference, each.pose) if pose is not None
        ]
        numbers = (each.evaluation, each.quality, each.score, each.probability)
        told.update(f"{each.reference} {each.accepted}".encode())
        told.update(np.concatenate((*poses, each.covariance.ravel(), numbers)).tobytes())
    return told.digest()


_Part = tuple[NDArray[np.float64], float, float, bool]


def _ask(
    places: ReferenceSet, scans: Sequence[LaserScan], expected: Sequence[bytes], seconds: float
) -> _Part:
    """Ask one scan after the other until the time is over, and each at least once."""
    taken: list[float] = []
    alike = True
    begin = now = time.perf_counter()
    while now - begin < seconds or len(taken) < len(scans):
        index = len(taken) % len(scans)
        scan = _fresh(scans[index])
        start = time.perf_counter()
        found = places.locate(scan)
        now = time.perf_counter()
        taken.append(now - start)
        alike = alike and digest(found) == expected[index]
    return np.array(taken), begin, now, alike


def _work(
    set_file: Path,
    scans: list[LaserScan],
    expected: list[bytes],
    seconds: float,
    ready: Barrier,
    told: Queue[_Part],
) -> None:
    """What a process does."""
    with ReferenceSet.open(set_file) as places:
        places.prepare()
        places.locate(_fresh(scans[0]))
        ready.wait(_PATIENCE)
        told.put(_ask(places, scans, expected, seconds))


def _together(kind: str, parts: Sequence[_Part]) -> Load:
    taken, begun, ended, alike = zip(*parts, strict=True)
    return Load(kind, len(parts), np.concatenate(taken), max(ended) - min(begun), all(alike))


def _fresh(scan: LaserScan) -> LaserScan:
    """Give the scan as a new value: nothing derived may be left over in it."""
    return replace(scan)
