"""A run as one HTML page that opens from disk: map, every query, figures, worst cases first.

The page holds its data as JSON and draws with plain JavaScript; it loads nothing from anywhere
and its security policy forbids it to.  Whatever comes from logs, sets and runs is text or
numbers in it, never markup.  Scans are kept as whole centimetres and thinned so that a
thousand queries stay well below ten megabytes.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import __version__
from .answers import Guess, Run, ScanAnswer
from .errors import AnchorscanError
from .explanation import bounds_of, centres_of_cells, wall_points
from .io.whole_file import writing
from .pose import Pose2D
from .protocol import Answer, Figures, figures, precision_recall, reliability
from .record import Record
from .reference import Reference
from .scan import LaserScan

__all__ = ["MOST_QUERIES", "page", "write_report"]

MOST_QUERIES = 2000

_MOST_READINGS = 360
# Bytes of all readings in the page, before they become text, which takes a third more.
_READING_BYTES = 3_000_000
_FEWEST_READINGS = 45
_MOST_CELLS = 250_000
_MOST_PIXELS = 1 << 14
_FINEST_CELL = 0.05
_MOST_STEPS = 400
_TIME_BINS = 40
_LARGEST_RANGE = 655.35
_NOTHING = "\N{EN DASH}"
_NEAR, _NEAR_HEADING = 2.0, math.radians(45.0)

ReadLog = Callable[[], Iterable[Record]]


@dataclass(frozen=True, eq=False)
class _Case:
    """One answer beside what it is judged by.

    Args:
        answer: What was said.
        judged: The same with the truth; NaN as probability where nothing was said.
        is_judged: Whether right and wrong mean anything here.
        is_reference: Whether the scan itself is a reference of the set.
    """

    answer: ScanAnswer
    judged: Answer
    is_judged: bool
    is_reference: bool

    @property
    def is_right(self) -> bool | None:
        """Whether the best guess is right; None where nothing tells."""
        return self.judged.is_correct if self.is_judged and self.answer.guesses else None


@dataclass
class _Pool:
    """Scans of the page, each kept once."""

    readings: int
    sensors: list[tuple[float, float]] = field(default_factory=list)
    scans: list[tuple[int, str]] = field(default_factory=list)

    def add(self, scan: LaserScan) -> int:
        """Keep a scan, thinned, and return its number."""
        step = max(1, math.ceil(len(scan) / self.readings))
        ranges = np.where(scan.is_return, scan.ranges, 0.0)[::step]
        sensor = (round(scan.angle_min, 7), round(step * scan.angle_increment, 9))
        if sensor not in self.sensors:
            self.sensors.append(sensor)
        whole = np.round(np.minimum(ranges, _LARGEST_RANGE) * 100.0)
        self.scans.append((self.sensors.index(sensor), _packed(whole, "<u2")))
        return len(self.scans) - 1


def write_report(
    path: Path,
    runs: Sequence[Run],
    references: Sequence[Reference] = (),
    logs: Mapping[str, ReadLog] | None = None,
    *,
    title: str = "",
    notes: Sequence[str] = (),
    most: int = MOST_QUERIES,
) -> None:
    """Write the page of one or several runs.

    Args:
        path: The HTML file, which appears when it is whole.
        runs: As ``read_runs`` gives them.
        references: Of the set that the runs were made with; without any there is no map.
        logs: By the name that a run calls its log (any name where there is one log): a function
            that reads it from the beginning.  Its poses are the truth, its scans are drawn.
        title: Of the page.
        notes: Sentences that stand above it.
        most: Queries that can be stepped through, over all runs: the worst, and others at equal
            steps.  The figures are of all.

    Raises:
        AnchorscanError: There is nothing to report.
        LogError: A log cannot be read, or the file not be written.
    """
    text = page(runs, references, logs, title=title, notes=notes, most=most)
    with writing(path) as stream:
        stream.write(text)


def page(
    runs: Sequence[Run],
    references: Sequence[Reference] = (),
    logs: Mapping[str, ReadLog] | None = None,
    *,
    title: str = "",
    notes: Sequence[str] = (),
    most: int = MOST_QUERIES,
) -> str:
    """Return the page that ``write_report`` writes; arguments and errors as there."""
    runs = [run for run in runs if run.answers]
    if not runs:
        raise AnchorscanError("there is no answer to report")
    cases = [_cases(run, references, _log_of(run, logs)) for run in runs]
    share = max(most // len(runs), 1)
    shown = [_chosen(each, share) for each in cases]
    wanted = [{case.answer.scan for case in each} for each in shown]
    named = _named(shown, references)
    pool = _Pool(_readings_each(len(named) + sum(map(len, wanted))))
    kept = {each.identifier: pool.add(each.scan) for each in named}
    scans: dict[str, dict[int, int]] = {}
    for run, some in zip(runs, wanted, strict=True):
        _keep_scans(scans.setdefault(run.log, {}), some, _log_of(run, logs), pool)
    maps = [_map_data(references)] if any(each.pose for each in references) else []
    poses = {each.identifier: each.pose for each in named}
    data = {
        "notes": list(notes),
        "maps": maps,
        "sensors": pool.sensors,
        "scans": pool.scans,
        "runs": [
            {
                "map": 0 if maps else None,
                "referenceScans": {i: [n, _pose_data(poses[i])] for i, n in kept.items()},
                **_run_data(run, every, some, scans[run.log], references),
            }
            for run, every, some in zip(runs, cases, shown, strict=True)
        ],
    }
    return _filled(title or "anchorscan", data)


# Judging


def _log_of(run: Run, logs: Mapping[str, ReadLog] | None) -> ReadLog | None:
    """Return the log of a run: the one of its name, or the only one of a run that names none."""
    if not logs:
        return None
    if run.log:
        return logs.get(run.log)
    return next(iter(logs.values())) if len(logs) == 1 else None


def _cases(run: Run, references: Sequence[Reference], log: ReadLog | None) -> list[_Case]:
    """Put every answer of a run beside its truth."""
    truths: dict[int, Pose2D] = {}
    themselves: set[int] = set()
    if log is not None:
        known = {_fingerprint(each.scan) for each in references}
        wanted = {answer.scan for answer in run.answers}
        for record in log():
            if record.index not in wanted:
                continue
            if record.pose is not None:
                truths[record.index] = record.pose
            if record.scan is not None and _fingerprint(record.scan) in known:
                themselves.add(record.index)
    return [
        _case(run, answer, answer.truth or truths.get(answer.scan), answer.scan in themselves)
        for answer in run.answers
    ]


def _case(run: Run, answer: ScanAnswer, truth: Pose2D | None, is_reference: bool) -> _Case:
    best = answer.guesses[0] if answer.guesses else None
    judged = Answer(
        query=answer.scan,
        pose=None if best is None else best.pose,
        truth=truth,
        probability=math.nan if best is None else best.probability,
        accepted=answer.accepted and best is not None,
        seconds=answer.seconds,
        covariance=None if best is None else best.covariance,
    )
    # In a place that is not in the set (protocol P4) there is no truth and every answer wrong.
    is_judged = (truth is not None or run.kind == "bench") and not is_reference
    in_frame = best is None or best.pose is not None
    return _Case(answer, judged, is_judged and in_frame and not answer.reason, is_reference)


def _fingerprint(scan: LaserScan) -> bytes:
    """Bytes that two scans share only if they are one."""
    return hashlib.blake2b(scan.ranges.tobytes(), digest_size=16).digest()


def _severity(case: _Case) -> tuple[float, float]:
    """Order of cases, the worst first: confident errors, then errors, then doubts."""
    said = case.judged.probability
    said = 0.0 if math.isnan(said) else said
    if not case.answer.guesses:
        return 2.0, 0.0
    if case.is_right is None:
        return (3.0, said) if not case.answer.accepted else (4.0, said)
    if not case.is_right:
        return (0.0, -said) if case.answer.accepted else (1.0, -said)
    return (3.0, said) if not case.answer.accepted else (4.0, -case.judged.position_error)


def _chosen(cases: Sequence[_Case], most: int) -> list[_Case]:
    """The cases that can be stepped through, worst first."""
    order = sorted(range(len(cases)), key=lambda n: (_severity(cases[n]), n))
    if len(order) > most:
        worst = order[: (most + 1) // 2]
        rest = order[(most + 1) // 2 :]
        places = np.linspace(0, len(rest) - 1, most - len(worst)).astype(int)
        order = worst + [rest[place] for place in sorted(set(places.tolist()))]
    return [cases[n] for n in order]


# Readings


def _named(shown: Iterable[Sequence[_Case]], references: Sequence[Reference]) -> list[Reference]:
    """The references that a guess names."""
    names = {guess.reference for cases in shown for case in cases for guess in case.answer.guesses}
    return [each for each in references if each.identifier in names]


def _readings_each(scans: int) -> int:
    """Readings that every scan may keep, so that all of them fit."""
    fitting = _READING_BYTES // (2 * max(scans, 1))
    return min(max(fitting, _FEWEST_READINGS), _MOST_READINGS)


def _keep_scans(kept: dict[int, int], wanted: set[int], log: ReadLog | None, pool: _Pool) -> None:
    """Read the log once more and keep the scans that can be stepped through."""
    missing = wanted - set(kept)
    if log is None or not missing:
        return
    for record in log():
        if record.index in missing and record.scan is not None:
            kept[record.index] = pool.add(record.scan)


def _packed(values: NDArray[Any], kind: str) -> str:
    return base64.b64encode(values.astype(kind).tobytes()).decode("ascii")


# The data of the page


def _map_data(references: Sequence[Reference]) -> dict[str, Any]:
    """The stitched readings as cells, and where the references are."""
    poses = [each.pose for each in references if each.pose is not None]
    always = np.array([(pose.x, pose.y) for pose in poses])
    cell = _FINEST_CELL
    points = wall_points(references, cell)
    while len(points) > _MOST_CELLS or (len(points) and _extent(points) / cell >= _MOST_PIXELS):
        cell *= 2.0
        points = centres_of_cells(points, cell)
    corner = points.min(axis=0) - 0.5 * cell if len(points) else np.zeros(2)
    cells = np.round((points - corner) / cell - 0.5)
    return {
        "x": round(float(corner[0]), 4),
        "y": round(float(corner[1]), 4),
        "cell": cell,
        "cells": _packed(cells, "<u2"),
        "bounds": [round(value, 2) for value in bounds_of(points, always)],
        "references": [_pose_data(pose) for pose in poses],
    }


def _extent(points: NDArray[np.float64]) -> float:
    return float(np.ptp(points, axis=0).max())


def _run_data(
    run: Run,
    cases: Sequence[_Case],
    shown: Sequence[_Case],
    scans: Mapping[int, int],
    references: Sequence[Reference],
) -> dict[str, Any]:
    judged = [case.judged for case in cases if case.is_judged]
    probability = np.array([each.probability for each in judged])
    right = np.array([each.is_correct for each in judged], np.bool_)
    accepted = [case.judged.probability for case in cases if case.judged.accepted]
    found = figures(judged) if judged else None
    said = len(judged) > 0 and not np.isnan(probability).all()
    return {
        "name": run.name,
        "notes": _notes(run, cases, shown, references),
        "queries": [_query_data(case, scans) for case in shown],
        "figures": _figure_rows(cases, found),
        "curve": _curve(probability, right) if said else None,
        "reliability": _reliability(probability, right) if said else None,
        "times": _times(cases, found),
        "threshold": _number(min(accepted, default=1.0), 3),
        "judged": {
            "p": [_number(value, 4) for value in probability.tolist()],
            "right": [int(value) for value in right],
            "accepted": [int(each.accepted) for each in judged],
        },
    }


def _query_data(case: _Case, scans: Mapping[int, int]) -> dict[str, Any]:
    answer = case.answer
    return {
        "scan": answer.scan,
        "stamp": _number(answer.stamp, 3),
        "seconds": _number(answer.seconds, 6),
        "accepted": case.judged.accepted,
        "reason": answer.reason,
        "truth": _pose_data(case.judged.truth),
        "right": case.is_right,
        "isReference": case.is_reference,
        "points": scans.get(answer.scan),
        "hypotheses": [_guess_data(guess, case.judged.truth) for guess in answer.guesses],
    }


def _guess_data(guess: Guess, truth: Pose2D | None) -> dict[str, Any]:
    spread = guess.covariance
    off = None
    if truth is not None and guess.pose is not None:
        off = [_number(guess.pose.distance(truth), 3), _number(guess.pose.turn(truth), 4)]
    return {
        "reference": guess.reference,
        "pose": _pose_data(guess.pose),
        "inner": _pose_data(guess.pose_in_reference) if guess.pose is None else None,
        "p": _number(guess.probability, 4) or 0.0,
        "e": _number(guess.evaluation, 3),
        "q": _number(guess.quality, 4),
        "score": _number(guess.score, 4),
        "alike": guess.ambiguous,
        "spread": None
        if spread is None
        else [_number(spread[row, column], 6) or 0.0 for row, column in ((0, 0), (0, 1), (1, 1))],
        "off": off,
    }


def _pose_data(pose: Pose2D | None) -> list[float] | None:
    return None if pose is None else [round(pose.x, 3), round(pose.y, 3), round(pose.theta, 4)]


def _number(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(float(value), digits)


# Figures


def _notes(
    run: Run, cases: Sequence[_Case], shown: Sequence[_Case], references: Sequence[Reference]
) -> list[str]:
    """What one must know to read the figures of a run."""
    notes = []
    if run.problems:
        line, reason = run.problems[0]
        notes.append(f"{len(run.problems)} lines are no answers; the first: line {line}, {reason}")
    themselves = sum(case.is_reference for case in cases)
    if themselves:
        notes.append(
            f"{themselves} of {len(cases)} scans are references of the set themselves; "
            "the figures leave them out."
        )
    if not any(case.judged.truth for case in cases) and run.kind != "bench":
        notes.append("Nothing tells right from wrong here: the log has no poses, or was not given.")
    alone = _far_from_all(cases, references)
    if alone:
        notes.append(
            f"{alone} scans were taken where no reference lies within {_NEAR:g} m and "
            f"{math.degrees(_NEAR_HEADING):g} degrees; there silence is the best answer."
        )
    if len(shown) < len(cases):
        notes.append(
            f"{len(shown)} of {len(cases)} queries can be stepped through, the worst among them; "
            "the figures are of all."
        )
    return notes


def _far_from_all(cases: Sequence[_Case], references: Sequence[Reference]) -> int:
    poses = [each.pose.to_array() for each in references if each.pose is not None]
    truths = [case.judged.truth for case in cases if case.is_judged and case.judged.truth]
    if not poses or not truths:
        return 0
    known = np.array(poses)
    count = 0
    for truth in truths:
        near = np.hypot(known[:, 0] - truth.x, known[:, 1] - truth.y) <= _NEAR
        turn = np.abs(np.remainder(known[:, 2] - truth.theta + np.pi, 2.0 * np.pi) - np.pi)
        count += not (near & (turn <= _NEAR_HEADING)).any()
    return count


def _figure_rows(cases: Sequence[_Case], found: Figures | None) -> list[tuple[str, str]]:
    """Names and values of the table of figures."""
    if found is None:
        located = sum(case.judged.accepted for case in cases)
        unusable = sum(bool(case.answer.reason) for case in cases)
        return [
            ("scans", str(len(cases))),
            ("located", str(located)),
            ("not known", str(len(cases) - located - unusable)),
            ("unusable", str(unusable)),
        ]

    def centimetres(value: float) -> str:
        return _NOTHING if math.isnan(value) else f"{100.0 * value:.1f} cm"

    def degrees(value: float) -> str:
        return _NOTHING if math.isnan(value) else f"{math.degrees(value):.1f}\N{DEGREE SIGN}"

    def share(value: float) -> str:
        return _NOTHING if math.isnan(value) else f"{100.0 * value:.1f} %"

    return [
        ("queries judged", str(found.queries)),
        ("located, right", str(found.correct)),
        ("located, wrong", str(found.wrong)),
        ("not known", str(found.silent)),
        ("best guess right", share(found.top_1)),
        ("recall at 100 % precision", share(found.recall_at_full_precision)),
        ("recall at 99 % precision", share(found.recall_at_99_precision)),
        ("position error, median", centimetres(found.position_median)),
        ("position error, 90 %", centimetres(found.position_90)),
        ("heading error, median", degrees(found.heading_median)),
        ("heading error, 90 %", degrees(found.heading_90)),
        ("covariance honest (95 % if the truth is exact)", share(found.honest_covariance)),
    ]


def _curve(
    probability: NDArray[np.float64], right: NDArray[np.bool_]
) -> list[tuple[float, float, float]]:
    """Recall, precision and threshold, at so many steps that nobody sees them."""
    thresholds, precision, recall = precision_recall(probability, right)
    steps = np.unique(np.linspace(0, len(thresholds) - 1, _MOST_STEPS).astype(int))
    return [
        (round(float(recall[n]), 4), round(float(precision[n]), 4), float(thresholds[n]))
        for n in steps
    ]


def _reliability(probability: NDArray[np.float64], right: NDArray[np.bool_]) -> dict[str, Any]:
    bins = reliability(probability, right)
    return {
        "counts": bins.counts.tolist(),
        "probability": [_number(value, 4) for value in bins.probability.tolist()],
        "accuracy": [_number(value, 4) for value in bins.accuracy.tolist()],
        "error": _number(bins.error, 4),
    }


def _times(cases: Sequence[_Case], found: Figures | None) -> dict[str, Any] | None:
    """Histogram of the seconds a scan, in steps of equal ratio."""
    seconds = np.array([case.answer.seconds for case in cases if case.answer.seconds > 0.0])
    if not len(seconds):
        return None
    low, high = float(seconds.min()) * 0.999, float(seconds.max()) * 1.001
    edges = np.geomspace(low, high, _TIME_BINS + 1)
    counts, _ = np.histogram(seconds, edges)
    median, tail = np.percentile(seconds, (50.0, 99.0)) * 1e3
    words = (
        f"Median {median:.2f} ms, 99 % below {tail:.2f} ms, longest {seconds.max() * 1e3:.2f} ms."
    )
    return {
        "edges": [float(f"{edge:.4g}") for edge in edges],
        "counts": counts.tolist(),
        "words": words,
    }


# The page


def _filled(title: str, data: Mapping[str, Any]) -> str:
    """Put the data into the template, as data."""
    folder = resources.files(__package__) / "report_page"
    parts = {
        name: (folder / f"page.{name}").read_text(encoding="utf-8")
        for name in ("html", "css", "js")
    }
    digest = base64.b64encode(hashlib.sha256(parts["js"].encode()).digest()).decode("ascii")
    values = {
        "POLICY": f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'",
        "TITLE": html.escape(title),
        "STYLE": parts["css"],
        "SCRIPT": parts["js"],
        "FOOTER": f"anchorscan {html.escape(__version__)}. Poses are those of the laser, in the "
        "frame of the set; right is within 0.5 m and 10 degrees.",
        "DATA": _json_for_html(data),
    }
    return re.sub(r"@([A-Z]+)@", lambda match: values[match[1]], parts["html"])


def _json_for_html(data: Mapping[str, Any]) -> str:
    """JSON in which nothing can end the element that holds it."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"), ensure_ascii=True)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text
