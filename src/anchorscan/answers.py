"""The answers of a run, read back from what ``locate``, ``track`` and ``bench`` wrote.

``locate`` and ``track`` write JSON lines, a line a scan; ``bench`` writes a folder with a table
of the answers of every method to every split.  All become the same values here, for whoever
shows them.
"""

from __future__ import annotations

import csv
import gzip
import json
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import LogError
from .hypothesis import Hypothesis
from .pose import Pose2D
from .record import Record

__all__ = ["Guess", "Run", "ScanAnswer", "read_line", "read_runs"]

_TABLE = "answers.csv"
_NO_ANSWER = (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError)
# JSON lines pack to a fifth; a thousandth is a trap.
_SMALL_TEXT = 1 << 22
_MOST_FOLDED = 100
_COLUMNS = ("protocol", "place", "method", "query", "x", "y", "theta", "probability", "seconds")


@dataclass(frozen=True, eq=False)
class Guess:
    """One hypothesis as it was written.

    Args:
        pose: ``T_set_laser``; None in a set without a common frame.
        probability: That it is right; NaN where nothing was said.
        reference: Identifier of the reference, where one is named.
        pose_in_reference: ``T_reference_laser``, where it was written.
        covariance: (3, 3) of x, y (metres) and theta (radians), where it was written.
        evaluation: e_m of section 5, NaN where it was not written.
        quality: q_m of section 4.1, NaN where it was not written.
        score: What the hypotheses were ordered by, NaN where it was not written.
        ambiguous: Whether it is one of several places that explain the scan alike.
    """

    pose: Pose2D | None
    probability: float
    reference: int | None = None
    pose_in_reference: Pose2D | None = None
    covariance: NDArray[np.float64] | None = None
    evaluation: float = math.nan
    quality: float = math.nan
    score: float = math.nan
    ambiguous: bool = False


@dataclass(frozen=True, eq=False)
class ScanAnswer:
    """What was said to one scan.

    Args:
        scan: Index among the scan records of the log.
        accepted: Whether the first guess is believed.
        guesses: Best first.
        stamp: Seconds on the log's own clock, where known.
        seconds: How long it took; NaN where not written.
        reason: Why there is no guess.
        truth: ``T_set_laser``, where the run itself tells.
    """

    scan: int
    accepted: bool
    guesses: tuple[Guess, ...]
    stamp: float | None = None
    seconds: float = math.nan
    reason: str = ""
    truth: Pose2D | None = None

    @classmethod
    def of(cls, record: Record, hypotheses: Sequence[Hypothesis], seconds: float) -> ScanAnswer:
        """Make one of what the library answered.

        Args:
            record: Whose scan was located.
            hypotheses: Best first.
            seconds: How long it took.
        """
        guesses = tuple(
            Guess(
                each.pose,
                each.probability,
                each.reference,
                each.pose_in_reference,
                each.covariance,
                each.evaluation,
                each.quality,
                each.score,
                each.ambiguous,
            )
            for each in hypotheses
        )
        accepted = bool(hypotheses) and hypotheses[0].accepted
        reason = "" if guesses else record.problem or "no reading is a return"
        return cls(record.index, accepted, guesses, record.stamp, seconds, reason)


@dataclass(frozen=True, eq=False)
class Run:
    """The answers of one method to one sequence of scans.

    Args:
        kind: "locate", "track" or "bench".
        name: What tells it from others of the same file.
        answers: In the order in which they were written.
        log: What the run calls the log that its scans are from; "" where it does not say.
        problems: (line, reason) of every line that is no answer.
    """

    kind: str
    name: str
    answers: tuple[ScanAnswer, ...]
    log: str = ""
    problems: tuple[tuple[int, str], ...] = field(default=())


def read_runs(path: Path) -> list[Run]:
    """Read what a run wrote.

    Lines that are no answers (the last one of an interrupted run) are passed over and told in
    ``problems``.

    Args:
        path: The JSON lines of ``locate`` or ``track``, plain or gzipped; or the folder of
            ``bench``, or the table ``answers.csv`` in it.

    Raises:
        LogError: There is no such file, or nothing in it is an answer.
    """
    table = path / _TABLE if path.is_dir() else path
    if not table.is_file():
        raise LogError("no such file" if table == path else f"there is no {_TABLE} in it", path)
    try:
        text = _text(table)
    except (OSError, EOFError, UnicodeDecodeError, zlib.error) as error:
        raise LogError(f"cannot be read: {error}", path) from None
    try:
        runs = _bench_runs(text) if text.startswith("protocol,") else _lines_run(table, text)
    except csv.Error as error:
        raise LogError(f"is no table of bench: {error}", path) from None
    if not any(run.answers for run in runs):
        raise LogError("holds no line of locate or track and no table of bench", path)
    return runs


def _text(path: Path) -> str:
    data = path.read_bytes()
    if data[:2] == b"\x1f\x8b":
        limit = max(_SMALL_TEXT, _MOST_FOLDED * len(data))
        with gzip.open(path, "rb") as stream:
            data = stream.read(limit + 1)
        if len(data) > limit:
            raise LogError("unfolds to more than a run does", path)
    return data.decode("utf-8")


# JSON lines


def read_line(line: str) -> ScanAnswer:
    """Read one line of ``locate`` or ``track``.

    Raises:
        ValueError: It is none.
    """
    try:
        return _answer(json.loads(line))
    except _NO_ANSWER as error:
        raise ValueError(f"no answer: {type(error).__name__}: {error}") from None


def _lines_run(path: Path, text: str) -> list[Run]:
    answers, problems = [], []
    kinds = set()
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            answers.append(read_line(line))
        except ValueError as error:
            problems.append((number, str(error)))
        else:
            kinds.add("locate" if '"hypotheses"' in line else "track")
    kind = "locate" if "locate" in kinds else "track"
    return [Run(kind, path.stem.removesuffix(".jsonl"), tuple(answers), "", tuple(problems))]


def _answer(values: Mapping[str, Any]) -> ScanAnswer:
    if "hypotheses" in values:
        guesses = tuple(_guess(each) for each in values["hypotheses"])
    else:
        guesses = (_guess(values),) if values["x"] is not None else ()
    stamp = values.get("stamp")
    return ScanAnswer(
        scan=int(values["scan"]),
        accepted=bool(values["accepted"]),
        guesses=guesses,
        stamp=None if stamp is None else float(stamp),
        seconds=_number(values, "seconds"),
        reason=str(values.get("reason", "")),
    )


def _guess(values: Mapping[str, Any]) -> Guess:
    reference, covariance = values.get("reference"), values.get("covariance")
    inner = values.get("pose_in_reference")
    return Guess(
        pose=_pose(values),
        probability=_number(values, "probability"),
        reference=None if reference is None else int(reference),
        pose_in_reference=None if inner is None else _pose(inner),
        covariance=None if covariance is None else _square(covariance),
        evaluation=_number(values, "evaluation"),
        quality=_number(values, "quality"),
        score=_number(values, "score"),
        ambiguous=bool(values.get("ambiguous", False)),
    )


def _pose(values: Mapping[str, Any]) -> Pose2D | None:
    if values["x"] is None:
        return None
    pose = Pose2D(float(values["x"]), float(values["y"]), float(values["theta"]))
    if not pose.is_finite():
        raise ValueError("a pose is not finite")
    return pose


def _square(values: Any) -> NDArray[np.float64]:
    matrix = np.array(values, np.float64)
    if matrix.shape != (3, 3):
        raise ValueError(f"a covariance has shape {matrix.shape}")
    return matrix


def _number(values: Mapping[str, Any], name: str) -> float:
    value = values.get(name)
    return math.nan if value is None else float(value)


# The table of bench


def _bench_runs(text: str) -> list[Run]:
    rows = enumerate(csv.DictReader(text.splitlines()), start=2)
    runs = []
    for key, group in groupby(rows, key=lambda row: tuple(row[1].get(k) for k in _COLUMNS[:3])):
        answers, problems = _table_answers(group)
        name = " · ".join(str(part) for part in key)
        queries_of = str(key[1]).split("->")[-1].strip()
        runs.append(Run("bench", name, tuple(answers), queries_of, tuple(problems)))
    return runs


def _table_answers(
    rows: Iterable[tuple[int, Mapping[str, str]]],
) -> tuple[list[ScanAnswer], list[tuple[int, str]]]:
    answers, problems = [], []
    for number, row in rows:
        try:
            answers.append(_table_answer(row))
        except _NO_ANSWER as error:
            problems.append((number, f"no answer: {type(error).__name__}: {error}"))
    return answers, problems


def _table_answer(row: Mapping[str, str]) -> ScanAnswer:
    pose, truth = _table_pose(row, ""), _table_pose(row, "true_")
    probability = float(row["probability"]) if row["probability"] else math.nan
    return ScanAnswer(
        scan=int(row["query"]),
        accepted=row.get("accepted") == "True",
        guesses=() if pose is None else (Guess(pose, probability),),
        seconds=float(row["seconds"]) if row["seconds"] else math.nan,
        truth=truth,
    )


def _table_pose(row: Mapping[str, str], prefix: str) -> Pose2D | None:
    values = [row.get(f"{prefix}{name}") for name in ("x", "y", "theta")]
    if not all(values):
        return None
    pose = Pose2D(*(float(value) for value in values if value))
    if not pose.is_finite():
        raise ValueError("a pose is not finite")
    return pose
