"""Drives as files, and the command line run as a user types it, for the tests of the leaves."""

from __future__ import annotations

import contextlib
import io
import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

from anchorscan import Record
from anchorscan.cli import main


@dataclass(frozen=True)
class Outcome:
    """How a command ended and what it said."""

    code: int
    out: str
    err: str


def run(*words: object) -> Outcome:
    """Run the command line in this process."""
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["anchorscan", *map(str, words)]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as ended:
            return Outcome(int(ended.code or 0), out.getvalue(), err.getvalue())
    raise AssertionError("the command line did not say how it ended")


def write_log(path: Path, records: Iterable[Record]) -> Path:
    """Write a CARMEN log with corrected poses and odometry."""
    with path.open("w", encoding="ascii") as stream:
        for record in records:
            assert record.scan is not None
            ranges = [f"{r:.3f}" if math.isfinite(r) else "90" for r in record.scan.ranges.tolist()]
            poses = (record.pose, record.odometry)
            places = ["0 0 0" if p is None else f"{p.x} {p.y} {p.theta}" for p in poses]
            stamp = record.stamp or 0.0
            line = ["FLASER", str(len(ranges)), *ranges, *places, str(stamp), "robot", str(stamp)]
            stream.write(" ".join(line) + "\n")
    return path
