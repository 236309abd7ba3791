"""``explain``, ``report``, ``view`` and ``demo``: answers to look at."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import LogError
from .console import progress, refuse_overwriting, say
from .logs import record_of, records_of, stem
from .options import (
    CandidatesOption,
    LogArgument,
    LogOptions,
    PresetOption,
    SetArgument,
    SettingsOptions,
)

if TYPE_CHECKING:
    from ..answers import ScanAnswer
    from ..hypothesis import Hypothesis
    from ..record import Record
    from ..reference import Reference
    from ..reference_set import ReferenceSet

__all__ = ["demo", "explain", "report", "view"]


class PictureTheme(str, Enum):
    """Background of pictures."""

    light = "light"
    dark = "dark"
    both = "both"


class PictureFormat(str, Enum):
    """Kind of picture files."""

    png = "png"
    svg = "svg"
    pdf = "pdf"


def explain(
    set_file: SetArgument,
    log: LogArgument,
    scan: Annotated[
        int, typer.Option("--scan", min=0, metavar="N", help="Which scan of the log, from zero.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the pictures.")
    ],
    theme: Annotated[
        PictureTheme, typer.Option(help="Background of the pictures.")
    ] = PictureTheme.light,
    file_format: Annotated[
        PictureFormat, typer.Option("--format", help="Kind of the pictures.")
    ] = PictureFormat.png,
    candidates: CandidatesOption = None,
    *,
    reading: LogOptions,
    settings: SettingsOptions,
) -> None:
    """Draw why a scan was located where it was: a picture for every step of the algorithm.

    Prints the names of the files.
    """
    from ..drawing import require_matplotlib
    from ..explanation import Explanation
    from ..figures import THEMES, save_all
    from ..reference_set import ReferenceSet

    require_matplotlib()
    opened = reading.open(log)
    record = record_of(opened, scan)
    with ReferenceSet.open(set_file, settings=settings.read()) as places:
        assert record.scan is not None
        trace = places.explain(record.scan, candidates)
        explanation = Explanation(trace, places.references, record.pose)
    themes = [each for name, each in THEMES.items() if theme.value in (name, "both")]
    for path in save_all(explanation, output, themes, file_format.value):
        typer.echo(str(path))
    said = [_verdict(trace.hypotheses)]
    if trace.decision is not None and math.isfinite(trace.decision.upside_down):
        best, other = trace.hypotheses[0].score, trace.decision.upside_down
        said.append(f"its score is {best:.3f}, that of the best guess upside down {other:.3f}")
    say(f"{log}: scan {scan}: {'; '.join(said)}")


_VERDICTS = {
    "located": "located",
    "ambiguous": "at one of several places alike; the best guess is",
    "unknown": "not known; the best guess is",
}


def _verdict(hypotheses: Sequence[Hypothesis]) -> str:
    """Say in words what hypotheses amount to."""
    from ..hypothesis import state_of

    best, verdict = hypotheses[0], _VERDICTS[state_of(hypotheses)]
    pose, frame = best.pose, "x {0.x:.2f} m, y {0.y:.2f} m, {1:.0f} degrees"
    if pose is None:
        pose, frame = best.pose_in_reference, f"reference {best.reference}, {frame}"
    where = frame.format(pose, math.degrees(pose.theta))
    return f"{verdict} at {where} (probability {best.probability:.3f})"


def report(
    run_file: Annotated[
        Path,
        typer.Argument(
            metavar="RUN", help="What locate or track wrote, or the folder that bench wrote."
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="HTML", help="The page to write.")
    ],
    set_file: Annotated[
        Path | None,
        typer.Option("--set", metavar="SET", help="The set that the run was made with: its map."),
    ] = None,
    logs: Annotated[
        list[Path] | None,
        typer.Option(
            "--log", metavar="LOG", help="The log that was located: its scans and true poses."
        ),
    ] = None,
    most: Annotated[
        int, typer.Option(min=1, metavar="N", help="Queries that can be stepped through.")
    ] = 2000,
    *,
    reading: LogOptions,
) -> None:
    """Show a run as one HTML page that opens from disk: map, every query, figures, worst first.

    Poses of the log, where it has any, are taken for the truth.
    """
    from ..answers import read_runs
    from ..report import write_report

    refuse_overwriting([output], [run_file, set_file, *(logs or ())])
    runs = read_runs(run_file)
    opened = {stem(path): reading.open(path) for path in logs or ()}
    references: tuple[Reference, ...] = ()
    if set_file is not None:
        from ..reference_set import ReferenceSet

        with ReferenceSet.open(set_file) as places:
            references = places.references
    names = [path.name for path in (run_file, set_file, *(logs or ())) if path is not None]
    write_report(
        output,
        runs,
        references,
        {name: log.__iter__ for name, log in opened.items()},
        title=", ".join(names),
        most=most,
    )
    count = sum(len(run.answers) for run in runs)
    say(f"{output}: {count} answers, {output.stat().st_size / 1e6:.1f} MB")


def view(
    set_file: SetArgument,
    log: LogArgument,
    run_file: Annotated[
        str | None,
        typer.Option(
            "--run",
            metavar="RUN|-",
            help="Answers of locate or track to show, '-' as they come on stdin; else scans are "
            "located now.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="RRD", help="Save to a file, open no window."),
    ] = None,
    *,
    reading: LogOptions,
    settings: SettingsOptions,
) -> None:
    """Show answers with Rerun: map, scan, anchor points, hypotheses, belief over time.

    Live: anchorscan track SET LOG | anchorscan view SET LOG --run -
    """
    from ..reference_set import ReferenceSet
    from ..viewer import Viewer

    refuse_overwriting([output], [set_file, log, run_file, settings.settings_file])
    opened = reading.open(log)
    records = progress(records_of(opened), "showing", opened.count)
    with ReferenceSet.open(set_file, settings=settings.read()) as places:
        answers = None if run_file is None else _read_answers(run_file)
        shown = 0
        with Viewer(places.references, places.settings, output) as viewer:
            for record in records:
                answer = (
                    _answer_now(places, record) if answers is None else answers.get(record.index)
                )
                if answer is not None:
                    viewer.show(record, answer)
                    shown += 1
    say(f"{log}: {shown} scans shown{'' if output is None else f' in {output}'}")


def _answer_now(places: ReferenceSet, record: Record) -> ScanAnswer:
    """Locate the scan of a record."""
    from ..answers import ScanAnswer

    start = time.perf_counter()
    found = [] if record.scan is None else places.locate(record.scan)
    return ScanAnswer.of(record, found, time.perf_counter() - start)


class _Answers:
    """Answers by the number of their scan, in the order in which they come."""

    def __init__(self, answers: Iterator[ScanAnswer]) -> None:
        self._answers = answers
        self._next = next(answers, None)

    def get(self, scan: int) -> ScanAnswer | None:
        """Return the answer to a scan; numbers must be asked for in rising order."""
        while self._next is not None and self._next.scan < scan:
            self._next = next(self._answers, None)
        found = self._next
        return found if found is not None and found.scan == scan else None


def _read_answers(run_file: str) -> _Answers:
    """Read the answers of a run, or take them from stdin as they come."""
    from ..answers import read_line, read_runs

    if run_file != "-":
        return _Answers(iter(read_runs(Path(run_file))[0].answers))

    def lines() -> Iterator[ScanAnswer]:
        for number, line in enumerate(sys.stdin, start=1):
            try:
                yield read_line(line)
            except ValueError as error:
                raise LogError(str(error), "<stdin>", number) from None

    return _Answers(lines())


def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the pictures.")
    ] = Path("anchorscan-demo"),
    preset: PresetOption = None,
) -> None:
    """Locate later visits to the MIT Killian Court in a map made of the first ones."""
    from ..demo import run

    run(output, SettingsOptions(preset).read(), say=typer.echo, progress=progress)
