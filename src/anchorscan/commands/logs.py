"""Logs as the commands read them: what is odd in one is told once."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import LogError
from .console import progress, say

if TYPE_CHECKING:
    from ..io import Log
    from ..record import Record
    from ..reference_set import ReferenceSet

__all__ = [
    "record_of",
    "records_of",
    "records_shown",
    "refuse_another_frame",
    "refuse_mirrored",
    "stem",
]

# How many malformed lines a message names before it says "and so on".
_NAMED_LINES = 5


def records_of(*logs: Log, tell: Callable[[str], None] = say) -> Iterator[Record]:
    """Read logs one after the other; tell what was guessed, malformed, or cannot be meant."""
    from ..plausibility import Plausibility

    for log in logs:
        for note in log.notes:
            tell(f"note: {log.path}: {note}")
        plausibility = Plausibility()
        for record in log:
            plausibility.add(record)
            yield record
        for line in _problems(log):
            tell(line)
        for doubt in plausibility.doubts():
            tell(f"warning: {log.path}: {doubt}")


def records_shown(log: Log, what: str, output: Path | None) -> Iterator[Record]:
    """Read a log and show how far, unless a bar and lines would run into each other."""
    if output is None and sys.stdout.isatty():
        return records_of(log)
    return progress(records_of(log), what, log.count)


def record_of(log: Log, index: int) -> Record:
    """Return one record of a log that has a usable scan."""
    count = 0
    for record in records_of(log):
        if record.index == index:
            if record.scan is None:
                raise LogError(f"scan {index} cannot be used: {record.problem}", log.path)
            return record
        count += 1
    raise LogError(f"has {count} scans, from 0 on: no scan {index}", log.path)


def _problems(log: Log) -> list[str]:
    """Return a line that names the lines of no use by number, and the first reason; or none."""
    if not log.problem_count:
        return []
    first = [str(problem.line) for problem in log.problems[:_NAMED_LINES]]
    more = ", ..." if log.problem_count > len(first) else ""
    lines = "line" if log.problem_count == 1 else "lines"
    return [
        f"warning: {log.path}: {log.problem_count} malformed {lines} "
        f"({', '.join(first)}{more}); the first: {log.problems[0].reason}"
    ]


def refuse_mirrored(places: ReferenceSet, log: Log) -> None:
    """End where a laser hangs upside down and nobody said so: its answers would be wrong.

    Raises:
        LogError: The scans fit the set as their mirror images.
    """
    from ..plausibility import mirror_check

    found = mirror_check(places, log)
    if found.is_mirrored:
        raise LogError(
            f"{found}: one of the two was recorded with "
            "the laser upside down, or was said to be (--upside-down)",
            log.path,
        )


def refuse_another_frame(places: ReferenceSet, log: Log) -> None:
    """End where the poses of a log are not in the frame of a set, which it would spoil.

    Raises:
        LogError: The scans do not fit the set where their poses say.
    """
    from ..set_check import frame_check

    found = frame_check(places, log)
    if found.is_another:
        raise LogError(
            f"{found}: it is of another place, or its poses are in another frame", log.path
        )


def stem(path: Path) -> str:
    """Return the name of a log without what says how it is packed."""
    return path.name.partition(".")[0]
