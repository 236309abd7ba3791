"""What a benchmark found: tables to read, files to keep, pictures to look at."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .errors import MissingExtraError
from .protocol import Answer, Figures, figures, precision_recall, reliability

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["POOLED", "Comparison", "Score", "Scoreboard", "StageTimes", "compared", "pooled"]

POOLED = "pooled"
_WIDTH = 220
# Okabe and Ito's colours, told apart with any colour vision.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#222222", "#f0e442")
_Style = dict[str, Any]
_PANEL = (4.2, 3.4)
_COLUMNS = 3


@dataclass(frozen=True, eq=False)
class Score:
    """The answers of one method to one split.

    Args:
        protocol: "P1" to "P4".
        place: The log, or "references -> queries".
        method: Name of the method.
        references: Number of references.
        answers: To every query, in order.
        calibrated: Whether probabilities are probabilities, and ``accepted`` a decision; else
            they are scores that order the answers and nothing more.
    """

    protocol: str
    place: str
    method: str
    references: int
    answers: tuple[Answer, ...]
    calibrated: bool = True

    @cached_property
    def figures(self) -> Figures:
        """All figures of the protocol; no calibration error where nothing is calibrated."""
        found = figures(self.answers)
        return found if self.calibrated else replace(found, calibration_error=math.nan)

    @property
    def probability(self) -> NDArray[np.float64]:
        """(N,) what was reported for each query, NaN for no answer."""
        return np.array([answer.probability for answer in self.answers])

    @property
    def correct(self) -> NDArray[np.bool_]:
        """(N,) whether each answer is correct."""
        return np.array([answer.is_correct for answer in self.answers], dtype=bool)


@dataclass(frozen=True)
class Comparison:
    """A method beside a baseline, on the queries that both were asked.

    Args:
        protocol: Of the split.
        place: Of the split.
        method: Name of the method.
        baseline: Name of the baseline.
        queries: That both were asked.
        baseline_correct: Best hypotheses of the baseline that are correct.
        share: Of these, those that the method also has; NaN when there are none.
        time_ratio: Mean time of the baseline over that of the method.
    """

    protocol: str
    place: str
    method: str
    baseline: str
    queries: int
    baseline_correct: int
    share: float
    time_ratio: float


@dataclass(frozen=True)
class StageTimes:
    """Mean seconds a query in each stage.

    Args:
        protocol: Of the split.
        place: Of the split.
        method: Name of the method.
        queries: Measured.
        stages: Mean seconds by stage, what is in no stage as "rest".
    """

    protocol: str
    place: str
    method: str
    queries: int
    stages: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Scoreboard:
    """All that a run of the benchmark found.

    Args:
        scores: Of every split and method, in the order of the run.
        comparisons: With the baseline.
        stages: Where the time goes.
        settings: What the run was: arguments, versions, machine, logs.
        presets: All settings of every preset, as JSON.
    """

    scores: tuple[Score, ...]
    comparisons: tuple[Comparison, ...]
    stages: tuple[StageTimes, ...]
    settings: Mapping[str, Any]
    presets: Mapping[str, str]

    def lines(self) -> list[str]:
        """Return all tables as lines of text."""
        text: list[str] = []
        for title, columns, rows in self._tables():
            if rows:
                text += ["", *_rendered(title, columns, rows)]
        return text

    def write(self, folder: Path) -> list[Path]:
        """Write results.json, figures.csv, answers.csv and the settings of every preset.

        Args:
            folder: Made where it is missing.

        Returns:
            The files.

        Raises:
            OSError: The folder cannot be written.
        """
        folder.mkdir(parents=True, exist_ok=True)
        files = [folder / "results.json", folder / "figures.csv", folder / "answers.csv"]
        results = {
            **self.settings,
            "scores": [_score_row(score) for score in self.scores],
            "comparisons": [asdict(one) for one in self.comparisons],
            "stages": [{**asdict(one), "stages": dict(one.stages)} for one in self.stages],
        }
        text = json.dumps(_without_nan(results), indent=2, allow_nan=False)
        files[0].write_text(text + "\n", encoding="utf-8")
        _write_csv(files[1], [_score_row(score) for score in self.scores])
        kept = [score for score in self.scores if score.place != POOLED]
        _write_csv(files[2], (row for score in kept for row in _answer_rows(score)))
        for name, preset in self.presets.items():
            files.append(folder / f"settings-{name}.json")
            files[-1].write_text(preset + "\n", encoding="utf-8")
        return files

    def draw(self, folder: Path) -> list[Path]:
        """Draw precision over recall, reliability, and the trade-off of sparse references.

        Args:
            folder: That exists.

        Returns:
            The pictures.

        Raises:
            MissingExtraError: matplotlib is not installed.
            OSError: A picture cannot be written.
        """
        try:
            from matplotlib.figure import Figure
        except ImportError:
            raise MissingExtraError("drawing pictures", "plot") from None
        pictures = {}
        for protocol in ("P1", "P2", "P3"):
            pictures[f"precision-recall-{protocol}"] = (
                [s for s in self.scores if s.protocol == protocol],
                _draw_precision_recall,
            )
        pictures["precision-recall-pooled"] = (
            [s for s in self.scores if s.place == POOLED],
            _draw_precision_recall,
        )
        pictures["reliability"] = (
            [s for s in self.scores if s.calibrated and s.place == POOLED],
            _draw_reliability,
        )
        pictures["trade-off-P2"] = (
            [s for s in self.scores if s.protocol == "P2" and s.calibrated],
            _draw_trade_off,
        )
        files = []
        for name, (scores, draw) in pictures.items():
            if scores:
                files.append(folder / f"{name}.png")
                _panels(scores, draw, Figure).savefig(files[-1])
        return files

    def _tables(self) -> Iterable[tuple[str, Sequence[str], list[Sequence[str]]]]:
        by_protocol = {
            protocol: [s for s in self.scores if s.protocol == protocol]
            for protocol in ("P1", "P2", "P3", "P4", POOLED)
        }
        titles = {
            "P1": "P1 revisit: one drive, a reference each 2 m and 45 degrees",
            "P3": "P3 two sessions: an independent drive",
            POOLED: "Pooled, one threshold for all (P1 and P3, without look-alike corridors)",
        }
        for protocol, title in titles.items():
            yield title, _SCORE_COLUMNS, [_score_cells(s) for s in by_protocol[protocol]]
        yield (
            "P2 sparse references: the table of section 6 of the paper, at the shipped threshold",
            _PAPER_COLUMNS,
            [_paper_cells(s) for s in by_protocol["P2"]],
        )
        yield (
            "P4 unknown place: every answer is wrong",
            _UNKNOWN_COLUMNS,
            _unknown_rows(by_protocol["P4"]),
        )
        yield (
            "Ambiguous: silent, but told to be at one of two or three places",
            _AMBIGUOUS_COLUMNS,
            [_ambiguous_cells(s) for s in self.scores if s.figures.ambiguous],
        )
        yield (
            "Against exhaustive search, same scans",
            _COMPARISON_COLUMNS,
            [_comparison_cells(one) for one in self.comparisons],
        )
        yield _stage_table(self.stages)


def pooled(scores: Sequence[Score]) -> list[Score]:
    """Sum the queries of several splits, one score a method, in the order of the methods."""
    methods = list(dict.fromkeys(score.method for score in scores))
    result = []
    for method in methods:
        same = [score for score in scores if score.method == method]
        answers = tuple(answer for score in same for answer in score.answers)
        references = sum(score.references for score in same)
        calibrated = all(score.calibrated for score in same)
        result.append(Score(POOLED, POOLED, method, references, answers, calibrated))
    return result


def compared(scores: Sequence[Score], baseline: str) -> list[Comparison]:
    """Compare every calibrated method with a baseline, split by split and over all of them."""
    result = []
    totals: dict[str, list[tuple[Answer, Answer]]] = {}
    for theirs in (score for score in scores if score.method == baseline):
        for ours in scores:
            same = (ours.protocol, ours.place) == (theirs.protocol, theirs.place)
            if same and ours.calibrated:
                pairs = _pairs(ours, theirs)
                totals.setdefault(ours.method, []).extend(pairs)
                result.append(_comparison(ours.protocol, ours.place, ours.method, baseline, pairs))
    for method, pairs in totals.items():
        result.append(_comparison(POOLED, "all of these", method, baseline, pairs))
    return result


def _pairs(ours: Score, theirs: Score) -> list[tuple[Answer, Answer]]:
    by_query = {answer.query: answer for answer in ours.answers}
    return [(by_query[a.query], a) for a in theirs.answers if a.query in by_query]


def _comparison(
    protocol: str, place: str, method: str, baseline: str, pairs: Sequence[tuple[Answer, Answer]]
) -> Comparison:
    correct = [our.is_correct for our, their in pairs if their.is_correct]
    our_time = sum(our.seconds for our, _ in pairs)
    their_time = sum(their.seconds for _, their in pairs)
    return Comparison(
        protocol,
        place,
        method,
        baseline,
        queries=len(pairs),
        baseline_correct=len(correct),
        share=float(np.mean(correct)) if correct else math.nan,
        time_ratio=their_time / our_time if our_time > 0.0 else math.nan,
    )


# Tables.

_SCORE_COLUMNS = (
    *("log", "method", "queries", "top-1", "recall\n100 %", "recall\n99 %"),
    *("correct", "wrong", "silent", "calibration\nerror"),
    *("median\nms", "mean\nms", "99 %\nms", "longest\nms", "error\nm", "error\ndegrees"),
)
_PAPER_COLUMNS = (
    *("log", "method", "references", "queries", "correct", "wrong", "silent"),
    *("recall\n100 %", "recall\n99 %", "mean\nms", "longest\nms"),
)
_UNKNOWN_COLUMNS = ("references of", "method", "buildings asked", "queries", "answers", "share")
_AMBIGUOUS_COLUMNS = ("", "log", "method", "queries", "ambiguous", "right one\namong these")
_COMPARISON_COLUMNS = (
    *("", "log", "method", "queries", "correct of\nexhaustive", "of these\nalso found"),
    "times\nfaster",
)


def _score_cells(score: Score) -> Sequence[str]:
    f = score.figures
    decided = (str(f.correct), str(f.wrong), str(f.silent), _number(f.calibration_error, 3))
    return (
        score.place,
        score.method,
        str(f.queries),
        _number(f.top_1, 3),
        _number(f.recall_at_full_precision, 3),
        _number(f.recall_at_99_precision, 3),
        *(decided if score.calibrated else ("-",) * 4),
        *(_number(1e3 * t, 2) for t in (f.time_median, f.time_mean, f.time_99, f.time_maximum)),
        _number(f.position_median, 3),
        _number(math.degrees(f.heading_median), 2),
    )


def _paper_cells(score: Score) -> Sequence[str]:
    f = score.figures
    decided = (str(f.correct), str(f.wrong), str(f.silent))
    return (
        score.place,
        score.method,
        str(score.references),
        str(f.queries),
        *(decided if score.calibrated else ("-",) * 3),
        _number(f.recall_at_full_precision, 3),
        _number(f.recall_at_99_precision, 3),
        _number(1e3 * f.time_mean, 2),
        _number(1e3 * f.time_maximum, 2),
    )


def _unknown_rows(scores: Sequence[Score]) -> list[Sequence[str]]:
    """Sum over the buildings asked: one row for each known building and method, then for all."""
    groups: dict[tuple[str, str], list[Score]] = {}
    for score in scores:
        groups.setdefault((score.place.split(" -> ")[0], score.method), []).append(score)
    for score in scores:
        groups.setdefault(("all", score.method), []).append(score)
    rows: list[Sequence[str]] = []
    for (building, method), same in groups.items():
        answers = sum(score.figures.wrong for score in same)
        queries = sum(score.figures.queries for score in same)
        share = _number(answers / queries, 5)
        rows.append((building, method, str(len(same)), str(queries), str(answers), share))
    return rows


def _ambiguous_cells(score: Score) -> Sequence[str]:
    f = score.figures
    counts = (str(f.queries), str(f.ambiguous), str(f.named))
    return (score.protocol, score.place, score.method, *counts)


def _comparison_cells(one: Comparison) -> Sequence[str]:
    return (
        one.protocol,
        one.place,
        one.method,
        str(one.queries),
        str(one.baseline_correct),
        _number(one.share, 3),
        _number(one.time_ratio, 1),
    )


def _stage_table(
    measured: Sequence[StageTimes],
) -> tuple[str, Sequence[str], list[Sequence[str]]]:
    stages = list(dict.fromkeys(stage for one in measured for stage in one.stages))
    rows: list[Sequence[str]] = []
    for one in measured:
        cells = [_number(1e3 * one.stages[s], 3) if s in one.stages else "-" for s in stages]
        total = _number(1e3 * sum(one.stages.values()), 3)
        rows.append((one.protocol, one.place, one.method, str(one.queries), *cells, total))
    columns = ("", "log", "method", "queries", *stages, "sum")
    return "Stages: mean milliseconds a query", columns, rows


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _rendered(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        left = column in ("", "log", "method", "references of")
        table.add_column(column, justify="left" if left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console = Console(file=io.StringIO(), width=_WIDTH, color_system=None, emoji=False)
    with console.capture() as capture:
        console.print(table)
    return [line.rstrip() for line in capture.get().splitlines()]


# Files.


def _score_row(score: Score) -> dict[str, Any]:
    row = {
        "protocol": score.protocol,
        "place": score.place,
        "method": score.method,
        "references": score.references,
        "calibrated": score.calibrated,
        **asdict(score.figures),
    }
    if not score.calibrated:
        row.update(correct=None, wrong=None, silent=None)
    return row


def _answer_rows(score: Score) -> Iterable[dict[str, Any]]:
    for answer in score.answers:
        row: dict[str, Any] = {
            "protocol": score.protocol,
            "place": score.place,
            "method": score.method,
            "query": answer.query,
        }
        for prefix, pose in (("", answer.pose), ("true_", answer.truth)):
            values = ("", "", "") if pose is None else (pose.x, pose.y, pose.theta)
            names = (f"{prefix}x", f"{prefix}y", f"{prefix}theta")
            row.update(zip(names, values, strict=True))
        row.update(
            probability=answer.probability,
            accepted=answer.accepted if score.calibrated else "",
            correct=answer.is_correct,
            seconds=answer.seconds,
        )
        yield row


def _write_csv(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer: csv.DictWriter[str] | None = None
        for row in rows:
            if writer is None:
                writer = csv.DictWriter(stream, list(row), lineterminator="\n")
                writer.writeheader()
            writer.writerow({name: _plain(value) for name, value in row.items()})


def _plain(value: Any) -> Any:
    """Write numbers short and missing ones as nothing."""
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else ""
    return value


def _without_nan(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {name: _without_nan(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    return value


# Pictures.


def _panels(scores: Sequence[Score], draw: Any, make: type[Figure]) -> Figure:
    """Draw one panel a place, all methods in each, with the same line everywhere."""
    places = list(dict.fromkeys(score.place for score in scores))
    methods = list(dict.fromkeys(score.method for score in scores))
    styles = {name: _style(i) for i, name in enumerate(methods)}
    columns = min(_COLUMNS, len(places))
    rows = math.ceil(len(places) / columns)
    size = (max(columns * _PANEL[0], 1.5 * _PANEL[0]), rows * _PANEL[1] + 0.25 * len(methods))
    figure = make(figsize=size, dpi=120, layout="constrained", facecolor="white")
    for number, place in enumerate(places, start=1):
        axes = figure.add_subplot(rows, columns, number)
        draw(axes, [score for score in scores if score.place == place], styles)
        axes.set_title(place, fontsize=9, loc="left")
        axes.grid(color="#dddddd", lw=0.5)
    handles = {
        label: handle
        for axes in figure.axes
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=2, frameon=False
    )
    return figure


def _style(number: int) -> _Style:
    """Return colour and line of the n-th method: when the colours are used up, dashes begin."""
    dashes = ("-", "--", ":")
    return {
        "color": _COLOURS[number % len(_COLOURS)],
        "linestyle": dashes[number // len(_COLOURS) % len(dashes)],
    }


def _draw_precision_recall(
    axes: Axes, scores: Sequence[Score], styles: Mapping[str, _Style]
) -> None:
    for score in scores:
        _, precision, recall = precision_recall(score.probability, score.correct)
        axes.step(recall, precision, where="pre", label=score.method, **styles[score.method])
        decided = score.figures.correct + score.figures.wrong
        if score.calibrated and decided:
            point = (score.figures.correct / len(score.answers), score.figures.correct / decided)
            axes.plot(*point, "o", ms=5, color=styles[score.method]["color"])
    axes.set(xlim=(0.0, 1.01), ylim=(0.5, 1.01), xlabel="recall", ylabel="precision")


def _draw_reliability(axes: Axes, scores: Sequence[Score], styles: Mapping[str, _Style]) -> None:
    axes.plot([0.0, 1.0], [0.0, 1.0], color="#999999", lw=0.8)
    for score in scores:
        diagram = reliability(score.probability, score.correct)
        filled = diagram.counts > 0
        axes.plot(
            diagram.probability[filled],
            diagram.accuracy[filled],
            marker="o",
            ms=4,
            label=f"{score.method} (error {diagram.error:.3f})",
            **styles[score.method],
        )
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="reported probability", ylabel="share correct")


def _draw_trade_off(axes: Axes, scores: Sequence[Score], styles: Mapping[str, _Style]) -> None:
    """Draw correct over wrong shares for every threshold, the shipped one marked.

    The three rows of the paper's section 6, on its own data, stand beside them.
    """
    paper = ((366, 0), (606, 1), (819, 10))
    axes.plot(
        [wrong / 1405 for _, wrong in paper],
        [correct / 1405 for correct, _ in paper],
        "k+",
        label="the paper on its own data: 1, 5, all candidates",
    )
    for score in scores:
        _, precision, recall = precision_recall(score.probability, score.correct)
        wrong = recall * (1.0 / np.maximum(precision, 1e-12) - 1.0)
        axes.plot(wrong, recall, label=score.method, **styles[score.method])
        shipped = np.array([score.figures.wrong, score.figures.correct]) / len(score.answers)
        axes.plot(*shipped, "o", ms=5, color=styles[score.method]["color"])
    axes.set(xlim=(-0.0005, 0.02), ylim=(0.0, 1.0), xlabel="share wrong", ylabel="share correct")
