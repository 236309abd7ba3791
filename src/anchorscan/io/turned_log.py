"""A log whose laser hung upside down without the log saying so."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from ..record import Record
from .log import Log, Report

__all__ = ["TurnedLog"]


class TurnedLog(Log):
    """A log with every scan turned over: angles change sign, poses stay as they are.

    Args:
        log: The log as it was recorded.
    """

    def __init__(self, log: Log) -> None:
        super().__init__(log.path)
        self._log = log
        self.format = log.format
        self.count = log.count
        self.notes = (*log.notes, "the laser hangs upside down, as was said")

    def _read(self, report: Report) -> Iterator[Record]:
        for record in self._log.records(report):
            scan = record.scan
            yield record if scan is None else replace(record, scan=scan.upside_down())
