"""The log: one iterator of records, whatever the recording was written with."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ..record import Record

__all__ = ["Log", "Problem", "Report"]

Report = Callable[[int, str], None]
"""How a reader reports a malformed line (or message): its number from one, and the reason."""

# A file of garbage may have millions of malformed lines; nobody reads more than these.
_KEPT_PROBLEMS = 1000


@dataclass(frozen=True)
class Problem:
    """A line that was skipped, or used only in part.

    Args:
        line: Number of the line (of the message, in a recording without lines), from one.
        reason: What is wrong with it.
    """

    line: int
    reason: str

    def __str__(self) -> str:
        return f"line {self.line}: {self.reason}"


class Log(ABC):
    """A recording of laser scans, read anew by every ``iter``.

    Iterating yields one `Record` for every scan record in file order; a record that cannot
    be made into a scan has ``scan=None`` and says why in ``problem``, so that ``index``
    counts alike for everybody.  Only one record is held in memory at a time.

    Attributes:
        path: The file or folder.
        format: What it is, for messages: "CARMEN", "g2o", "rosbag2", ...
        count: Number of scan records where it is known without reading, for progress.
        notes: What was guessed or is missing, a line each, to be shown to people.
        problem_count: Number of problems met by the latest iteration.
    """

    format: str = ""
    count: int | None = None
    notes: tuple[str, ...] = ()

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problem_count = 0
        self._problems: list[Problem] = []

    @property
    def problems(self) -> tuple[Problem, ...]:
        """What the latest iteration could not read; at most the first thousand."""
        return tuple(self._problems)

    def __iter__(self) -> Iterator[Record]:
        """Read the recording from its beginning.

        Raises:
            LogError: The recording became unreadable since it was opened.
        """
        self._problems = []
        self.problem_count = 0
        return self._read(self._report)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.path)!r})"

    def _report(self, line: int, reason: str) -> None:
        self.problem_count += 1
        if len(self._problems) < _KEPT_PROBLEMS:
            self._problems.append(Problem(line, reason))

    def records(self, report: Report) -> Iterator[Record]:
        """Read the recording for another log, which takes the reports."""
        return self._read(report)

    @abstractmethod
    def _read(self, report: Report) -> Iterator[Record]:
        """Yield the records; report what is malformed."""
