"""The command line: what to read and where to write; the work is done elsewhere.

Results go to stdout or to a file, messages and progress to stderr.  The exit code is 0, 1 for
an error that is known (one line says what to do), 2 for a command that makes no sense; what is
not known ends in a traceback, because it is our mistake.  Every heavy module is imported by the
command that needs it, so that ``--help`` answers at once.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import Enum
from functools import wraps
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO, TypeVar

import typer

from . import __version__
from .errors import AnchorscanError, LogError, SettingsError

if TYPE_CHECKING:
    from .answers import ScanAnswer
    from .hypothesis import Hypothesis
    from .io import Log
    from .pose import Pose2D
    from .record import Record
    from .reference import Reference
    from .reference_set import ReferenceSet, SetInfo
    from .settings import Settings

__all__ = ["app", "main"]

_FAILED = 1
_MAP_SUFFIXES = (".yaml", ".yml")
_PROGRESS_DELAY = 1.0
_PROGRESS_INTERVAL = 0.1
# How many malformed lines a message names before it says "and so on".
_NAMED_LINES = 5
# Digits that a user can use: a micrometre, a microradian, and six of a covariance.
_DECIMALS = 6
# Scans that a worker process takes at once, and how many such lots may wait for it.
_CHUNK = 16
_CHUNKS_AHEAD = 4


class Body(str, Enum):
    """Whose poses a recording or a file of poses holds."""

    base = "base"
    laser = "laser"


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


app = typer.Typer(
    name="anchorscan",
    help="Where a robot is, from one 2D laser scan and no prior guess.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Command = TypeVar("Command", bound=Callable[..., None])
Item = TypeVar("Item")


def main() -> None:
    """Run the command line (the entry point of ``anchorscan``)."""
    app()


def _guarded(command: Command) -> Command:
    """End known errors as one line, and an interrupted or unread run without a word."""

    @wraps(command)
    def guarded(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
            sys.stdout.flush()
        except AnchorscanError as error:
            _say(f"error: {error}")
            raise typer.Exit(_FAILED) from None
        except BrokenPipeError:
            # Whoever read us (head, less) has seen enough; what is buffered has no reader.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(128 + signal.SIGPIPE) from None
        except KeyboardInterrupt:
            raise typer.Exit(128 + signal.SIGINT) from None
        except OSError as error:
            if error.filename is None and error.errno is None:
                raise
            place = "" if error.filename is None else f"{error.filename}: "
            _say(f"error: {place}{error.strerror}")
            raise typer.Exit(_FAILED) from None

    return guarded  # type: ignore[return-value]


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"anchorscan {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Where a robot is, from one 2D laser scan and no prior guess."""


# Arguments and options that several commands share.


def _parse_candidates(text: str) -> int | str:
    if text == "all":
        return text
    if text.isdecimal() and int(text) > 0:
        return int(text)
    raise typer.BadParameter(f"{text!r} is neither a positive number nor 'all'")


def _parse_laser(text: str) -> Pose2D:
    from .pose import Pose2D

    try:
        x, y, degrees = (float(part) for part in text.split(","))
        T_base_laser = Pose2D(x, y, math.radians(degrees))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not X,Y,DEG") from None
    if not T_base_laser.is_finite():
        raise typer.BadParameter(f"{text!r} is nowhere")
    return T_base_laser


def _parse_preset(text: str) -> str:
    if text not in ("default", "paper", "thorough"):
        raise typer.BadParameter(f"{text!r} is none of default, paper, thorough")
    return text


CandidatesOption = Annotated[
    Any,
    typer.Option(
        parser=_parse_candidates,
        metavar="K|all",
        help="How many references to align with, instead of what the settings say.",
    ),
]
SetArgument = Annotated[Path, typer.Argument(metavar="SET", help="A reference set.")]
LogArgument = Annotated[Path, typer.Argument(metavar="LOG", help="A log of laser scans.")]
FieldOfViewOption = Annotated[
    float | None,
    typer.Option(metavar="DEG", help="What the readings cover, if the log does not tell."),
]
RangeMaxOption = Annotated[
    float | None,
    typer.Option(metavar="M", help="From this range on a reading means 'no return'."),
]
TopicOption = Annotated[
    str | None, typer.Option(metavar="TOPIC", help="Scans of a ROS recording that has several.")
]
UpsideDownOption = Annotated[
    bool,
    typer.Option("--upside-down", help="The laser of a ROS recording hangs with its z axis down."),
]
PresetOption = Annotated[
    str | None,
    typer.Option(
        parser=_parse_preset, metavar="PRESET", help="Settings: default, paper or thorough."
    ),
]
SettingsOption = Annotated[
    Path | None,
    typer.Option("--settings", metavar="FILE", help="Settings from a JSON file."),
]


@app.command()
@_guarded
def build(
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Logs of laser scans with poses, or one map.yaml."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="SET", help="The reference set to write.")
    ],
    spacing: Annotated[
        float | None,
        typer.Option(min=0.0, metavar="M", help="Metres between references (2; in a map 1.5) ..."),
    ] = None,
    heading: Annotated[
        float | None,
        typer.Option(min=0.0, max=180.0, metavar="DEG", help="... or degrees (45; in a map 90)."),
    ] = None,
    keep_all: Annotated[bool, typer.Option("--all", help="Keep every scan with a pose.")] = False,
    field_of_view: FieldOfViewOption = None,
    range_max: RangeMaxOption = None,
    topic: TopicOption = None,
    poses: Annotated[
        str | None,
        typer.Option(metavar="FILE|TOPIC", help="Poses from a TUM file, a topic, or /tf."),
    ] = None,
    poses_of: Annotated[
        Body, typer.Option(help="Whose poses those are, if a topic does not say.")
    ] = Body.base,
    laser: Annotated[
        Any,
        typer.Option(
            parser=_parse_laser, metavar="X,Y,DEG", help="Where the laser sits on the robot."
        ),
    ] = None,
    upside_down: UpsideDownOption = False,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Make a reference set from the scans of logs with poses.

    A scan becomes a reference when no reference lies within the spacing and the heading of it.
    In a map (YAML beside PGM or PNG, as map_server has it), references are the scans that the
    laser would take at places spread over all that a robot can reach: by default one that looks
    all around, up to 30 m.
    """
    from .reference_set import ReferenceSet

    settings = _read_settings(preset, settings_file)
    is_map = any(log.suffix.lower() in _MAP_SUFFIXES for log in logs)
    usual = (1.5, 90.0) if is_map else (2.0, 45.0)
    spacing = usual[0] if spacing is None else spacing
    heading = math.radians(usual[1] if heading is None else heading)
    if is_map:
        if len(logs) > 1 or topic or poses or laser or upside_down:
            raise typer.BadParameter("a map is built from alone: no other logs, no topics or poses")
        records = _map_records(logs[0], field_of_view, range_max, spacing, heading)
    else:
        options = {
            **_reading(field_of_view, range_max, topic, upside_down),
            **{"poses": poses, "poses_of": poses_of.value, "T_base_laser": laser},
        }
        opened = [_open_log(log, options) for log in logs]
        records = _progress(_records(*opened), "reading", _total(*opened))
    with ReferenceSet.build(
        records,
        spacing=spacing,
        heading=heading,
        keep_all=keep_all or is_map,  # coverage of a map is decided already
        settings=settings,
        path=output,
    ) as places:
        info = places.info()
    _say(f"{output}: {info.references} references{_source(info)}")


@app.command()
@_guarded
def locate(
    set_file: SetArgument,
    log: LogArgument,
    candidates: CandidatesOption = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="OUT", help="File for the JSON lines, not stdout."),
    ] = None,
    processes: Annotated[
        int, typer.Option(min=1, metavar="N", help="Share the scans among processes.")
    ] = 1,
    field_of_view: FieldOfViewOption = None,
    range_max: RangeMaxOption = None,
    topic: TopicOption = None,
    upside_down: UpsideDownOption = False,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Say where every scan of a log was taken, each on its own, with no prior.

    One JSON object a scan, in the order of the log, hypotheses best first; the poses are those
    of the laser in the frame of the set, in metres and radians.
    """
    opened = _open_log(log, _reading(field_of_view, range_max, topic, upside_down))
    settings = _read_settings(preset, settings_file)
    records: Iterable[Record] = _records(opened)
    if output is not None or not sys.stdout.isatty():  # a bar and lines would run into each other
        records = _progress(records, "locating", opened.count)
    accepted = unusable = count = 0
    with _writing(output) as stream:
        for line in _located(records, set_file, settings, candidates, processes):
            stream.write(json.dumps(line, allow_nan=False) + "\n")
            stream.flush()
            count += 1
            accepted += line["accepted"]
            unusable += "reason" in line
    _say(
        f"{log}: {count} scans: {accepted} located, {count - accepted - unusable} not known, "
        f"{unusable} unusable"
    )


@app.command()
@_guarded
def track(
    set_file: SetArgument,
    log: LogArgument,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="OUT", help="File for the JSON lines, not stdout."),
    ] = None,
    tum: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write where the robot was located as a TUM trajectory, too."
        ),
    ] = None,
    window: Annotated[
        float,
        typer.Option(
            min=0.0,
            metavar="M",
            help="Search with the scans of the latest M metres joined into a view all around.",
        ),
    ] = 0.0,
    field_of_view: FieldOfViewOption = None,
    range_max: RangeMaxOption = None,
    topic: TopicOption = None,
    upside_down: UpsideDownOption = False,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Follow a robot through a log: scans and odometry in order, with no prior.

    One JSON object a scan; "accepted" says whether the robot is located. The poses are those
    of the laser in the frame of the set, in metres and radians.
    """
    from .io import write_tum

    opened = _open_log(log, _reading(field_of_view, range_max, topic, upside_down))
    settings = _read_settings(preset, settings_file)
    records: Iterable[Record] = _records(opened)
    if output is not None or not sys.stdout.isatty():
        records = _progress(records, "tracking", opened.count)
    accepted = count = 0
    trajectory: list[tuple[float, Pose2D]] = []
    with _writing(output) as stream:
        for line in _tracked(records, set_file, settings, window):
            stream.write(json.dumps(line, allow_nan=False) + "\n")
            stream.flush()
            count += 1
            accepted += line["accepted"]
            if line["accepted"] and line["stamp"] is not None:
                trajectory.append((line["stamp"], _pose_of(line)))
    _say(f"{log}: {count} scans: located after {accepted}, not known after {count - accepted}")
    if tum is not None:
        if accepted and not trajectory:
            raise LogError("has no times, and a trajectory in TUM format needs them", log)
        _say(f"{tum}: {write_tum(tum, trajectory)} poses")


@app.command()
@_guarded
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
    field_of_view: FieldOfViewOption = None,
    range_max: RangeMaxOption = None,
    topic: TopicOption = None,
    upside_down: UpsideDownOption = False,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Draw why a scan was located where it was: a picture for every step of the algorithm.

    Prints the names of the files.
    """
    from .drawing import require_matplotlib
    from .explanation import Explanation
    from .figures import THEMES, save_all
    from .reference_set import ReferenceSet

    require_matplotlib()
    opened = _open_log(log, _reading(field_of_view, range_max, topic, upside_down))
    record = _record(opened, scan)
    with ReferenceSet.open(set_file, settings=_read_settings(preset, settings_file)) as places:
        assert record.scan is not None
        trace = places.explain(record.scan, candidates)
        explanation = Explanation(trace, places.references, record.pose)
    themes = [each for name, each in THEMES.items() if theme.value in (name, "both")]
    for path in save_all(explanation, output, themes, file_format.value):
        typer.echo(str(path))
    _say(f"{log}: scan {scan}: {_verdict(trace.hypotheses[0])}")


@app.command()
@_guarded
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
    field_of_view: FieldOfViewOption = None,
    range_max: RangeMaxOption = None,
    topic: TopicOption = None,
    upside_down: UpsideDownOption = False,
) -> None:
    """Show a run as one HTML page that opens from disk: map, every query, figures, worst first.

    Poses of the log, where it has any, are taken for the truth.
    """
    from .answers import read_runs
    from .report import write_report

    runs = read_runs(run_file)
    reading = _reading(field_of_view, range_max, topic, upside_down)
    opened = {_stem(path): _open_log(path, reading) for path in logs or ()}
    references: tuple[Reference, ...] = ()
    if set_file is not None:
        from .reference_set import ReferenceSet

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
    _say(f"{output}: {count} answers, {output.stat().st_size / 1e6:.1f} MB")


@app.command()
@_guarded
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
    field_of_view: FieldOfViewOption = None,
    range_max: RangeMaxOption = None,
    topic: TopicOption = None,
    upside_down: UpsideDownOption = False,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Show answers with Rerun: map, scan, anchor points, hypotheses, belief over time.

    Live: anchorscan track SET LOG | anchorscan view SET LOG --run -
    """
    from .reference_set import ReferenceSet
    from .viewer import Viewer

    opened = _open_log(log, _reading(field_of_view, range_max, topic, upside_down))
    records = _progress(_records(opened), "showing", opened.count)
    with ReferenceSet.open(set_file, settings=_read_settings(preset, settings_file)) as places:
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
    _say(f"{log}: {shown} scans shown{'' if output is None else f' in {output}'}")


@app.command()
@_guarded
def info(
    set_file: SetArgument,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Say what a reference set holds."""
    from .reference_set import ReferenceSet

    with ReferenceSet.open(set_file) as places:
        facts = _facts(places.info())
    if as_json:
        typer.echo(json.dumps(facts))
        return
    for name, value in facts.items():
        if value is not None:
            typer.echo(f"{name.replace('_', ' ') + ':':<13}{_in_words(name, value)}")


@app.command()
@_guarded
def bench(
    logs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[BUILDING=]LOG...", help="Logs with poses; those in ANCHORSCAN_DATA if none."
        ),
    ] = None,
    presets: Annotated[
        list[str] | None,
        typer.Option(
            "--preset", parser=_parse_preset, metavar="PRESET", help="Again for more presets."
        ),
    ] = None,
    protocols: Annotated[
        list[str] | None,
        typer.Option(
            "--protocol", metavar="P1..P5", help="Again for more; P1 to P4 if none is named."
        ),
    ] = None,
    candidates: Annotated[
        list[Any] | None,
        typer.Option(
            parser=_parse_candidates,
            metavar="K|all",
            help="Again for more; the preset's own number, 1, 5 and all if none is named.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder for tables and pictures."),
    ] = None,
    queries: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="At most so many queries of each split; starts of each drive."
        ),
    ] = None,
    baselines: Annotated[
        list[str] | None,
        typer.Option(
            "--baseline", metavar="NAME", help="exhaustive, karto, for P5 amcl, or none; all."
        ),
    ] = None,
    baseline_queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="The same for the baselines, which are slow.")
    ] = 136,
    seed: Annotated[int, typer.Option(help="Chooses the queries, where not all are asked.")] = 0,
) -> None:
    """Measure how well and how fast scans are located, by fixed protocols.

    Logs of one building, given one after the other as BUILDING=LOG, are two sessions. P5, a lost
    robot on the move, runs on its own.
    """
    from .benchmark import BASELINES, PROTOCOLS, run

    if protocols and "P5" in protocols:
        _bench_lost_robot(logs, baselines, queries, baseline_queries, seed, output)
        protocols = [protocol for protocol in protocols if protocol != "P5"]
        if not protocols:
            return
        baselines = None if baselines is None else [n for n in baselines if n != "amcl"] or ["none"]
    run(
        logs or (),
        presets=presets or ("default",),
        protocols=protocols or PROTOCOLS,
        candidates=candidates or (None, 1, 5, "all"),
        output_folder=output,
        queries=queries,
        seed=seed,
        baselines=() if baselines == ["none"] else baselines or BASELINES,
        baseline_queries=baseline_queries,
        say=typer.echo,
        progress=_progress,
    )


@app.command()
@_guarded
def calibrate(
    logs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[BUILDING=]LOG...", help="Logs with poses; those in ANCHORSCAN_DATA if none."
        ),
    ] = None,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="At most so many queries of each split.")
    ] = 200,
) -> None:
    """Fit what an answer's evidence is worth, each building scored by the others.

    Prints the coefficients for the settings file's section "decision".
    """
    from . import benchmark, calibration

    settings = _read_settings(preset or (None if settings_file else "default"), settings_file)
    assert settings is not None
    cases = benchmark.tasks(benchmark.read_drives(logs or benchmark.default_logs()))
    samples = calibration.gather(cases, settings, queries, _say)
    typer.echo("scored by the fit to the other buildings:")
    scored = calibration.rotate(samples, settings.decision.threshold)
    for fit in (fit for fit in scored if fit.protocol != "P4"):
        typer.echo(
            f"{fit.protocol} {fit.place}: {fit.queries} queries, recall {fit.recall:.3f} at 100 % "
            f"and {fit.recall_99:.3f} at 99 % precision, calibration error "
            f"{fit.calibration_error:.3f}, {fit.accepted_wrong} of {fit.accepted} answers wrong"
        )
    unknown = [fit for fit in scored if fit.protocol == "P4"]
    typer.echo(
        f"P4, {len(unknown)} pairs of buildings: {sum(fit.accepted for fit in unknown)} of "
        f"{sum(fit.queries for fit in unknown)} queries answered"
    )
    typer.echo(json.dumps({"decision": calibration.weigh(samples)}, indent=2))


@app.command()
@_guarded
def ablate(
    logs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[BUILDING=]LOG...", help="Logs with poses; those in ANCHORSCAN_DATA if none."
        ),
    ] = None,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="At most so many queries of each split.")
    ] = 100,
    changes: Annotated[
        list[str] | None,
        typer.Option("--change", metavar="NAME", help="Again for more; all if none is named."),
    ] = None,
) -> None:
    """Change one thing at a time, and say what each is worth: a table in Markdown."""
    from . import ablation, benchmark

    chosen = ablation.changes_named(changes or ())
    settings = _read_settings(preset or (None if settings_file else "default"), settings_file)
    assert settings is not None
    drives = benchmark.read_drives(logs or benchmark.default_logs(_say))
    cases = benchmark.tasks(drives, ("P1", "P2", "P3"))
    ablation.run(cases, settings, queries, typer.echo, chosen)


@app.command()
@_guarded
def check_map(
    map_file: Annotated[Path, typer.Argument(metavar="MAP", help="YAML file of a map.")],
    log: LogArgument,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Folder for a picture.")
    ] = None,
    topic: TopicOption = None,
    upside_down: UpsideDownOption = False,
    range_max: RangeMaxOption = None,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Say how well the scans of a drive are located in a map, without any truth.

    Answers that are right move as the odometry of the log does.
    """
    from .map_check import run

    settings = _read_settings(preset, settings_file)
    opened = _open_log(log, _reading(None, range_max, topic, upside_down))
    run(map_file, opened, output, settings, say=typer.echo, progress=_progress)


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
@_guarded
def ros(context: typer.Context) -> None:
    """Run the ROS 2 node: tell a robot where it is, as soon as it is known.

    All words are passed on to ROS: anchorscan ros --ros-args -p base_frame_id:=base_link
    """
    from .ros_node import main

    main(context.args, autostart=True)


@app.command()
@_guarded
def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the pictures.")
    ] = Path("anchorscan-demo"),
    preset: PresetOption = None,
) -> None:
    """Locate later visits to the MIT Killian Court in a map made of the first ones."""
    from .demo import run

    run(output, _read_settings(preset, None), say=typer.echo, progress=_progress)


# Reading


def _bench_lost_robot(
    logs: list[str] | None,
    baselines: list[str] | None,
    starts: int | None,
    baseline_starts: int,
    seed: int,
    output: Path | None,
) -> None:
    """Measure P5 on the logs that were named, else on those with odometry and on Killian Court."""
    from .benchmark import default_drives, read_drives
    from .lost_robot import run

    paths = logs or default_drives(typer.echo)
    with_baseline = baselines is None or "amcl" in baselines
    run(
        read_drives(_progress(paths, "reading", len(paths))),
        ("anchorscan", "amcl") if with_baseline else ("anchorscan",),
        starts=starts,
        baseline_starts=baseline_starts,
        seed=seed,
        output_folder=output,
        say=typer.echo,
        progress=_progress,
    )


def _reading(
    field_of_view: float | None, range_max: float | None, topic: str | None, upside_down: bool
) -> dict[str, Any]:
    """Return what every command may say about a log, as ``open_log`` wants it."""
    return {
        "field_of_view": None if field_of_view is None else math.radians(field_of_view),
        "range_max": range_max,
        "topic": topic,
        "is_upside_down": upside_down or None,
    }


def _open_log(path: Path, options: dict[str, Any]) -> Log:
    from .io import open_log

    return open_log(path, **options)


def _records(*logs: Log) -> Iterator[Record]:
    """Read logs one after the other, and say what was guessed and what was malformed."""
    for log in logs:
        for note in log.notes:
            _say(f"note: {log.path}: {note}")
        yield from log
        _report_problems(log)


def _map_records(
    path: Path, field_of_view: float | None, range_max: float | None, spacing: float, heading: float
) -> Iterator[Record]:
    """Take scans all over a map, with the laser that was named or one that looks all around."""
    from .map_file import load_map
    from .occupancy import MAP_SENSOR, reference_scans

    sensor = MAP_SENSOR
    if field_of_view is not None:
        sensor = replace(sensor, field_of_view=math.radians(field_of_view))
    if range_max is not None:
        sensor = replace(sensor, range_max=range_max)
    grid = load_map(path)
    return _progress(reference_scans(grid, sensor, spacing=spacing, heading=heading), "simulating")


def _answer_now(places: ReferenceSet, record: Record) -> ScanAnswer:
    """Locate the scan of a record."""
    from .answers import ScanAnswer

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
    from .answers import read_line, read_runs

    if run_file != "-":
        return _Answers(iter(read_runs(Path(run_file))[0].answers))

    def lines() -> Iterator[ScanAnswer]:
        for number, line in enumerate(sys.stdin, start=1):
            try:
                yield read_line(line)
            except ValueError as error:
                raise LogError(str(error), "<stdin>", number) from None

    return _Answers(lines())


def _stem(path: Path) -> str:
    """Return the name of a log without what says how it is packed."""
    return path.name.partition(".")[0]


def _record(log: Log, index: int) -> Record:
    """Return one record of a log that has a usable scan."""
    count = 0
    for record in _records(log):
        if record.index == index:
            if record.scan is None:
                raise LogError(f"scan {index} cannot be used: {record.problem}", log.path)
            return record
        count += 1
    raise LogError(f"has {count} scans, from 0 on: no scan {index}", log.path)


def _total(*logs: Log) -> int | None:
    total = 0
    for log in logs:
        if log.count is None:
            return None
        total += log.count
    return total


def _report_problems(log: Log) -> None:
    """Say once which lines of a log were no use, by number and first reason."""
    if not log.problem_count:
        return
    first = [str(problem.line) for problem in log.problems[:_NAMED_LINES]]
    more = ", ..." if log.problem_count > len(first) else ""
    lines = "line" if log.problem_count == 1 else "lines"
    _say(
        f"warning: {log.path}: {log.problem_count} malformed {lines} "
        f"({', '.join(first)}{more}); the first: {log.problems[0].reason}"
    )


def _read_settings(preset: str | None, path: Path | None) -> Settings | None:
    """Return the settings asked for; None leaves the choice to the reference set."""
    if preset is None and path is None:
        return None
    from .settings import Settings

    if path is None:
        return Settings.preset(preset or "default")
    if preset is not None:
        raise typer.BadParameter("give --preset or --settings, not both")
    try:
        return Settings.from_json(path.read_text(encoding="utf-8"))
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from None
    except UnicodeDecodeError:
        raise SettingsError(f"{path}: not a settings file (JSON in UTF-8)") from None


# Locating


class _Locator:
    """Locates records in an opened set; one for every process."""

    def __init__(self, set_file: Path, settings: Settings | None, candidates: Any) -> None:
        from .reference_set import ReferenceSet

        self._places: ReferenceSet = ReferenceSet.open(set_file, settings=settings)
        self._candidates = candidates
        self._places.prepare()

    def line(self, record: Record) -> dict[str, Any]:
        """Return the line of ``locate`` for a record."""
        hypotheses: list[Hypothesis] = []
        start = time.perf_counter()
        if record.scan is not None:
            hypotheses = self._places.locate(record.scan, self._candidates)
        seconds = time.perf_counter() - start
        line: dict[str, Any] = {
            "scan": record.index,
            "stamp": record.stamp,
            "seconds": round(seconds, _DECIMALS + 1),
            "accepted": bool(hypotheses) and hypotheses[0].accepted,
            "hypotheses": [_hypothesis_line(hypothesis) for hypothesis in hypotheses],
        }
        if not hypotheses:
            line["reason"] = self._reason(record)
        return line

    def _reason(self, record: Record) -> str:
        if record.scan is None:
            return record.problem
        return "no reading is a return" if len(self._places) else "the set has no references"


def _tracked(
    records: Iterable[Record], set_file: Path, settings: Settings | None, window: float
) -> Iterator[dict[str, Any]]:
    """Yield the line of ``track`` for every record."""
    from .localizer import Localizer
    from .reference_set import ReferenceSet

    places = ReferenceSet.open(set_file, settings=settings)
    places.prepare()
    localizer = Localizer(places, window)
    for record in records:
        line: dict[str, Any] = {"scan": record.index, "stamp": record.stamp}
        if record.scan is None:
            yield {**line, "seconds": 0.0, "accepted": False, "reason": record.problem}
            continue
        start = time.perf_counter()
        belief = localizer.update(record.scan, record.odometry, record.stamp)
        line["seconds"] = round(time.perf_counter() - start, _DECIMALS + 1)
        line["accepted"] = bool(belief.accepted)
        line |= _pose_line(belief.pose)
        spread = belief.covariance
        line["covariance"] = (
            None if spread is None else [[_significant(value) for value in row] for row in spread]
        )
        line["probability"] = round(belief.probability, _DECIMALS)
        line["state"] = belief.state
        yield line


def _hypothesis_line(hypothesis: Hypothesis) -> dict[str, Any]:
    return {
        "reference": hypothesis.reference,
        **_pose_line(hypothesis.pose),
        "covariance": [[_significant(value) for value in row] for row in hypothesis.covariance],
        "evaluation": round(hypothesis.evaluation, _DECIMALS),
        "quality": round(hypothesis.quality, _DECIMALS),
        "probability": round(hypothesis.probability, _DECIMALS),
        "score": _significant(hypothesis.score),
        "pose_in_reference": _pose_line(hypothesis.pose_in_reference),
    }


def _pose_line(pose: Pose2D | None) -> dict[str, float | None]:
    if pose is None:  # the set has no common frame
        return {"x": None, "y": None, "theta": None}
    return {name: round(getattr(pose, name), _DECIMALS) for name in ("x", "y", "theta")}


def _pose_of(line: dict[str, Any]) -> Pose2D:
    from .pose import Pose2D

    return Pose2D(line["x"], line["y"], line["theta"])


def _verdict(best: Hypothesis) -> str:
    """Say in words what a best hypothesis amounts to."""
    verdict = "located" if best.accepted else "not known; the best guess is"
    pose, frame = best.pose, "x {0.x:.2f} m, y {0.y:.2f} m, {1:.0f} degrees"
    if pose is None:
        pose, frame = best.pose_in_reference, f"reference {best.reference}, {frame}"
    where = frame.format(pose, math.degrees(pose.theta))
    return f"{verdict} at {where} (probability {best.probability:.3f})"


def _significant(value: float) -> float:
    return float(f"{value:.{_DECIMALS}g}")


def _located(
    records: Iterable[Record],
    set_file: Path,
    settings: Settings | None,
    candidates: Any,
    processes: int,
) -> Iterator[dict[str, Any]]:
    """Yield the lines of ``locate`` in the order of the records."""
    locator = _Locator(set_file, settings, candidates)
    if processes == 1:
        yield from map(locator.line, records)
        return
    import multiprocessing
    from concurrent.futures import Future, ProcessPoolExecutor

    # The kernels are compiled by now, and the others load them from numba's cache.
    del locator
    # Spawned, because the thread that draws the progress must not be forked.
    with ProcessPoolExecutor(
        processes,
        multiprocessing.get_context("spawn"),
        _start_worker,
        (set_file, settings, candidates),
    ) as pool:
        pending: deque[Future[list[dict[str, Any]]]] = deque()
        remaining = iter(records)
        for chunk in iter(lambda: list(islice(remaining, _CHUNK)), []):
            pending.append(pool.submit(_work, chunk))
            if len(pending) > _CHUNKS_AHEAD * processes:
                yield from pending.popleft().result()
        for future in pending:
            yield from future.result()


_worker: _Locator | None = None


def _start_worker(set_file: Path, settings: Settings | None, candidates: Any) -> None:
    global _worker  # noqa: PLW0603 - a worker process holds nothing else
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is told, and ends the workers
    _worker = _Locator(set_file, settings, candidates)


def _work(records: list[Record]) -> list[dict[str, Any]]:
    assert _worker is not None
    return [_worker.line(record) for record in records]


# What a set holds


def _source(info: SetInfo) -> str:
    """Say what a set was built from."""
    build = info.build
    if build is None:
        return ""
    parts = [f" from {build.consumed} scans"]
    if build.unusable:
        parts.append(f"{build.unusable} unusable")
    if build.without_pose:
        parts.append(f"{build.without_pose} without a pose")
    return ", ".join(parts)


def _facts(info: SetInfo) -> dict[str, Any]:
    build = info.build
    return {
        "file": str(info.path),
        "bytes": info.size,
        "format": info.format,
        "name": info.name or None,
        "references": info.references,
        "with_pose": info.with_pose,
        "bounds": info.bounds,
        "sensors": [
            {
                "scans": count,
                "readings": sensor.readings,
                "field_of_view": abs(sensor.angle_increment) * max(sensor.readings - 1, 0),
                "angle_min": sensor.angle_min,
                "angle_increment": sensor.angle_increment,
                "range_max": sensor.range_max,
            }
            for sensor, count in info.sensors
        ],
        "build": None
        if build is None
        else {
            "spacing": build.spacing,
            "heading": build.heading,
            "keep_all": build.keep_all,
            "scans": build.consumed,
            "unusable": build.unusable,
            "without_pose": build.without_pose,
            "finished": build.finished,
        },
    }


def _in_words(name: str, value: Any) -> str:
    """Say a fact as a person would."""
    if name == "bytes":
        return f"{value:,}"
    if name == "bounds":
        left, bottom, right, top = value
        return f"x {left:.1f} to {right:.1f} m, y {bottom:.1f} to {top:.1f} m"
    if name == "sensors":
        return "; ".join(
            f"{each['scans']} scans of {each['readings']} readings over "
            f"{math.degrees(each['field_of_view']):.0f} degrees, up to {each['range_max']:g} m"
            for each in value
        )
    if name == "build":
        rule = f"one per {value['spacing']:g} m and {math.degrees(value['heading']):g} degrees"
        state = "" if value["finished"] else "; not finished, build it again to go on"
        return f"{'every scan' if value['keep_all'] else rule}, of {value['scans']} scans{state}"
    return str(value)


# Writing


def _say(message: str) -> None:
    """Tell the user something that is no result."""
    typer.echo(message, err=True)


@contextmanager
def _writing(path: Path | None) -> Iterator[TextIO]:
    """Give a stream to stdout or to a file that appears only when it is whole."""
    if path is None:
        yield sys.stdout
        return
    target = path.resolve()
    if target.exists() and not target.is_file():  # a pipe or a device is written, not replaced
        with target.open("w", encoding="utf-8") as stream:
            yield stream
        return
    draft = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        with draft.open("w", encoding="utf-8") as stream:
            yield stream
        draft.replace(target)
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            raise
        raise LogError(f"cannot be written: {error.strerror}", path) from None
    finally:
        draft.unlink(missing_ok=True)


def _progress(items: Iterable[Item], what: str, total: int | None = None) -> Iterator[Item]:
    """Pass items on; show on a terminal how many, once that has taken a second."""
    if not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn(what),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    bar = Progress(*columns, console=Console(stderr=True), transient=True, auto_refresh=False)
    begin = shown = time.monotonic()
    task = bar.add_task(what, total=total)
    try:
        for done, item in enumerate(items, start=1):
            yield item
            now = time.monotonic()
            if now - begin > _PROGRESS_DELAY and now - shown > _PROGRESS_INTERVAL:
                bar.start()
                bar.update(task, completed=done, refresh=True)
                shown = now
    finally:
        bar.stop()
