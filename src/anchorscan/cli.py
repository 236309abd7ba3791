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
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
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
    from .cluster import Spread
    from .fleet import Fleet
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
# Sets of fewer references open in a moment without an index.
_WORTH_AN_INDEX = 1000
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


class Endurance(str, Enum):
    """What is to be endured."""

    day = "day"
    load = "load"
    repeat = "repeat"


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


def _parse_processes(text: str | int) -> int:
    text = str(text)  # the default comes as the number that it is
    if text == "all":
        # What this process may use, which in a container is less than the machine has.
        affinity = getattr(os, "sched_getaffinity", None)
        return len(affinity(0)) if affinity else os.cpu_count() or 1
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
    typer.Option("--upside-down", help="The laser hangs with its z axis down."),
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


SchedulerOption = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Share the work among the workers of a Dask scheduler."),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(min=1, metavar="N", help="Share the work among processes of this machine."),
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
    index: Annotated[
        bool | None,
        typer.Option(
            help="Write what is derived from the scans to SET.index, so that a large set opens at "
            "once. Without either, from 1000 references on."
        ),
    ] = None,
    each: Annotated[
        bool, typer.Option("--each", help="A set for every log or map, in the folder SET.")
    ] = False,
    scheduler: SchedulerOption = None,
    workers: WorkersOption = None,
) -> None:
    """Make a reference set from the scans of logs with poses.

    A scan becomes a reference when no reference lies within the spacing and the heading of it.
    In a map (YAML beside PGM or PNG, as map_server has it), references are the scans that the
    laser would take at places spread over all that a robot can reach: by default one that looks
    all around, up to 30 m.

    Of several logs, one that cannot be read is named and left out.
    """
    settings = _read_settings(preset, settings_file)
    is_map = any(log.suffix.lower() in _MAP_SUFFIXES for log in logs)
    if is_map and (topic or poses or laser or upside_down or (len(logs) > 1 and not each)):
        raise typer.BadParameter("a map is built from alone: no other logs, no topics or poses")
    recipe = _Recipe(
        _reading(field_of_view, range_max, topic, upside_down),
        {"poses": poses, "poses_of": poses_of.value, "T_base_laser": laser},
        spacing,
        None if heading is None else math.radians(heading),
        keep_all,
        None if settings is None else settings.to_json(),
    )
    from .cluster import cluster

    if each:
        with cluster(scheduler, workers) as spread:
            _build_each(recipe, logs, output, index, spread)
        return
    if len(logs) == 1:  # one piece: nothing to share
        _say(_built(recipe, logs[0], recipe.records(logs[0], _progress), output))
        _write_index(output, index)
        return
    unread: list[str] = []
    with cluster(scheduler, workers) as spread:
        read = _progress(_read_logs(recipe, logs, spread, unread), "reading")
        _say(_built(recipe, logs[0], read, output))
    _write_index(output, index)
    _tell_unread(unread, len(logs))


@dataclass(frozen=True)
class _Recipe:
    """How a set is made of logs or of a map; plain values that another process can use."""

    reading: dict[str, Any]
    posing: dict[str, Any]
    spacing: float | None
    heading: float | None
    keep_all: bool
    settings: str | None

    def records(self, path: Path, progress: Callable[..., Iterator[Record]]) -> Iterator[Record]:
        """Read a log, or take scans in a map."""
        if _is_map(path):
            taken = _map_records(
                path, self.reading["field_of_view"], self.reading["range_max"], *self.rule(path)
            )
            return progress(taken, "simulating")
        log = _open_log(path, {**self.reading, **self.posing})
        return progress(_records(log), "reading", log.count)

    def rule(self, path: Path) -> tuple[float, float]:
        """Give metres and radians between references."""
        usual = (1.5, math.radians(90.0)) if _is_map(path) else (2.0, math.radians(45.0))
        spacing = usual[0] if self.spacing is None else self.spacing
        return spacing, usual[1] if self.heading is None else self.heading


def _is_map(path: Path) -> bool:
    return path.suffix.lower() in _MAP_SUFFIXES


def _built(recipe: _Recipe, source: Path, records: Iterable[Record], output: Path) -> str:
    """Build one set, and say what it holds."""
    from .reference_set import ReferenceSet
    from .settings import Settings

    spacing, heading = recipe.rule(source)
    with ReferenceSet.build(
        records,
        spacing=spacing,
        heading=heading,
        keep_all=recipe.keep_all or _is_map(source),  # coverage of a map is decided already
        settings=None if recipe.settings is None else Settings.from_json(recipe.settings),
        path=output,
    ) as places:
        info = places.info()
    return f"{output}: {info.references} references{_source(info)}"


def _read_logs(
    recipe: _Recipe, logs: list[Path], spread: Spread, unread: list[str]
) -> Iterator[Record]:
    """Give the records of logs that were read whole, in their order."""
    for done in spread.map(_read_piece, [(recipe, log) for log in logs]):
        if done.value is None:
            unread.append(str(done.error))
            continue
        records, told = done.value
        for line in told:
            _say(line)
        yield from records


def _read_piece(piece: tuple[_Recipe, Path]) -> tuple[list[Record], list[str]]:
    """Read one log, in whatever process."""
    recipe, path = piece
    log = _open_log(path, {**recipe.reading, **recipe.posing})
    records = list(log)
    return records, [*(f"note: {log.path}: {note}" for note in log.notes), *_problems(log)]


def _write_index(path: Path, wanted: bool | None) -> None:
    """Write the index of a set that was built, if it is wanted or worth it."""
    from .reference_set import ReferenceSet

    with ReferenceSet.open(path) as places:
        info = places.info()
        is_map_of_all = info.with_pose == info.references and places.settings.method == "map"
        if wanted or (wanted is None and is_map_of_all and info.references >= _WORTH_AN_INDEX):
            places.save_index()
            size = places.info().index_size or 0
            _say(f"{path}.index: {size:,} bytes, derived from it")


def _build_each(
    recipe: _Recipe, logs: list[Path], folder: Path, index: bool | None, spread: Spread
) -> None:
    """Build a set of every log or map; those that are there already are left alone."""
    folder.mkdir(parents=True, exist_ok=True)
    targets = {log: folder / f"{_stem(log)}.apr" for log in logs}
    if len(set(targets.values())) < len(targets):
        raise typer.BadParameter("two logs have the same name: their sets would, too")
    left = [log for log in logs if not targets[log].exists()]
    unread: list[str] = []
    pieces = spread.map(_set_piece, [(recipe, log) for log in left])
    for done in _progress(pieces, "building", len(left)):
        log = done.item[1]
        if done.value is None:
            unread.append(str(done.error))
            continue
        data, told = done.value
        draft = targets[log].with_name(f".{targets[log].name}.{os.getpid()}.part")
        try:
            draft.write_bytes(data)
            draft.replace(targets[log])
        finally:
            draft.unlink(missing_ok=True)
        _say(f"{targets[log]}: {told}")
        _write_index(targets[log], index)
    if len(left) < len(logs):
        _say(f"{len(logs) - len(left)} were there already")
    _tell_unread(unread, len(logs))


def _set_piece(piece: tuple[_Recipe, Path]) -> tuple[bytes, str]:
    """Build one set, in whatever process, and give its file."""
    import tempfile

    recipe, path = piece
    with tempfile.TemporaryDirectory(prefix="anchorscan-") as folder:
        output = Path(folder) / "set.apr"
        told = _built(recipe, path, recipe.records(path, lambda items, *_: iter(items)), output)
        return output.read_bytes(), told.partition(": ")[2]


def _tell_unread(unread: list[str], count: int) -> None:
    """Name what was left out; then not all was done that was asked."""
    for reason in unread:
        _say(f"left out: {reason}")
    if unread:
        raise AnchorscanError(f"{len(unread)} of {count} could not be read or used")


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
        Any,
        typer.Option(
            parser=_parse_processes,
            metavar="N|all",
            help="Share the scans among processes; all takes every core.",
        ),
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
        for line in _located(records, set_file, settings, candidates, processes, opened):
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
def which(
    sets: Annotated[
        list[Path],
        typer.Argument(
            metavar="SET... LOG", help="Reference sets, or folders of them; then a log."
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="OUT", help="File for the JSON lines, not stdout."),
    ] = None,
    threads: Annotated[
        int, typer.Option(min=1, metavar="N", help="Share the sets among threads.")
    ] = 1,
    field_of_view: FieldOfViewOption = None,
    range_max: RangeMaxOption = None,
    topic: TopicOption = None,
    upside_down: UpsideDownOption = False,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Say in which of many buildings every scan of a log was taken, and where in it.

    One JSON object a scan, as of locate; every hypothesis names its building: the file of its set
    without ".apr". A probability is that the building and the pose are right, among all sets.
    """
    from .fleet import Fleet

    *places, log = sets
    if not places:
        raise typer.BadParameter("give reference sets, and a log after them")
    opened = _open_log(log, _reading(field_of_view, range_max, topic, upside_down))
    fleet = Fleet.open(places, settings=_read_settings(preset, settings_file))
    fleet.prepare()
    records: Iterable[Record] = _records(opened)
    if output is not None or not sys.stdout.isatty():
        records = _progress(records, "asking", opened.count)
    accepted: dict[str, int] = {}
    count = 0
    with _writing(output) as stream:
        for record in records:
            line = _which_line(fleet, record, threads)
            stream.write(json.dumps(line, allow_nan=False) + "\n")
            stream.flush()
            count += 1
            if line["accepted"]:
                building = line["hypotheses"][0]["building"]
                accepted[building] = accepted.get(building, 0) + 1
    told = ", ".join(f"{number} in {name}" for name, number in sorted(accepted.items()))
    _say(f"{log}: {count} scans, {len(fleet)} sets: {told or 'none located'}")


@app.command()
@_guarded
def serve(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="NAME.apr in it is the set NAME.")
    ],
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Where to listen; others need tokens.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, metavar="PORT", help="Port.")] = 8000,
    workers: Annotated[
        int, typer.Option(min=1, metavar="N", help="Processes, each with all sets in memory.")
    ] = 1,
    tokens: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Lines 'read TOKEN' or 'write TOKEN'; else the variable ANCHORSCAN_TOKENS.",
        ),
    ] = None,
    largest_request: Annotated[
        int, typer.Option(min=1, metavar="MB", help="Largest request, megabytes.")
    ] = 64,
    seconds: Annotated[
        float, typer.Option(min=0.1, metavar="S", help="Longest time for a request.")
    ] = 30.0,
    most_scans: Annotated[
        int, typer.Option(min=1, metavar="N", help="Most scans or references in a request.")
    ] = 1000,
) -> None:
    """Serve the reference sets of a folder over HTTP, until told to stop.

    The page /docs says what can be asked. Without tokens only this machine is answered.
    """
    from .service import ServiceOptions, read_tokens
    from .service import serve as listen

    options = ServiceOptions(
        folder,
        read_tokens(tokens),
        largest_request=largest_request << 20,
        seconds=seconds,
        most_scans=most_scans,
    )
    listen(options, host, port, workers, say=_say)


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
        for line in _tracked(records, set_file, settings, opened, window):
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

    with ReferenceSet.open(set_file, use_index=False) as places:  # which verifies every reference
        facts = _facts(places.info())
    if as_json:
        typer.echo(json.dumps(facts))
        return
    for name, value in facts.items():
        if value is not None:
            typer.echo(f"{name.replace('_', ' ') + ':':<13}{_in_words(name, value)}")


@app.command()
@_guarded
def index(set_file: SetArgument) -> None:
    """Write what is derived from a set to SET.index, so that it opens at once.

    The index may be deleted at any time. What is added to the set later does not need it to be
    written anew, as long as that is little.
    """
    from .reference_set import ReferenceSet

    with ReferenceSet.open(set_file) as places:
        places.save_index()
        info = places.info()
    _say(f"{set_file}.index: {info.index_size or 0:,} bytes of {info.references} references")


@app.command()
@_guarded
def check(
    set_file: SetArgument,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Name the references that contradict the others: wrong poses, or places that have changed.

    The exit code is 1 when there are any.
    """
    from .reference_set import ReferenceSet
    from .set_check import run

    with ReferenceSet.open(set_file, settings=_read_settings(preset, settings_file)) as places:
        bad = run(places, say=typer.echo, progress=_progress)
    if bad:
        raise typer.Exit(_FAILED)


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
    scheduler: SchedulerOption = None,
    workers: WorkersOption = None,
) -> None:
    """Measure how well and how fast scans are located, by fixed protocols.

    Logs of one building, given one after the other as BUILDING=LOG, are two sessions. P5, a lost
    robot on the move, runs on its own.
    """
    from .benchmark import BASELINES, PROTOCOLS, run
    from .cluster import cluster

    if protocols and "P5" in protocols:
        _bench_lost_robot(logs, baselines, queries, baseline_queries, seed, output)
        protocols = [protocol for protocol in protocols if protocol != "P5"]
        if not protocols:
            return
        baselines = None if baselines is None else [n for n in baselines if n != "amcl"] or ["none"]
    with cluster(scheduler, workers) as spread:
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
            spread=spread,
        )


@app.command()
@_guarded
def scale(
    logs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[BUILDING=]LOG...", help="Logs with poses; those in ANCHORSCAN_DATA if none."
        ),
    ] = None,
    sizes: Annotated[
        list[int] | None,
        typer.Option(
            "--references", min=1, metavar="N", help="Again for more; 100 to 1,000,000 if none."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder for tables and a picture."),
    ] = None,
    queries: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="At most so many queries of each split.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the distractors, and of the queries.")] = 0,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Measure how the search for candidates grows with the number of references.

    Real queries (P1 and P3) are asked for the references of their place among references of
    other places, made from real and simulated scans. A million need 3 GB of memory.
    """
    from .benchmark import default_logs, read_drives, tasks
    from .growth import SIZES, Place, measure
    from .settings import Settings

    drives = read_drives(logs or default_logs(_say))
    places = [
        Place(
            f"{task.protocol} {task.place}",
            task.known.building,
            task.references,
            tuple((scan, pose) for scan, pose in task.queries if pose is not None),
            tuple(record.scan for record in task.known.records if record.scan is not None),
            task.split.spacing,
            task.split.heading,
        )
        for task in tasks(drives, ("P1", "P3"))
    ]
    growth = measure(
        places,
        _read_settings(preset, settings_file) or Settings.preset(),
        sizes=sorted(set(sizes or SIZES)),
        queries=queries,
        seed=seed,
        say=_say,
    )
    for line in growth.lines():
        typer.echo(line)
    if output is not None:
        for path in growth.write(output):
            typer.echo(str(path))
        growth.draw(output / "growth.png")
        typer.echo(str(output / "growth.png"))


@app.command()
@_guarded
def bench_fleet(
    logs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[BUILDING=]LOG...", help="Logs with poses; those in ANCHORSCAN_DATA if none."
        ),
    ] = None,
    sizes: Annotated[
        list[int] | None,
        typer.Option("--sets", min=1, metavar="N", help="Again for more; 1, 10, 100 and 1000."),
    ] = None,
    also: Annotated[
        list[Path] | None,
        typer.Option("--also", metavar="SET", help="A set that is asked, too; again for more."),
    ] = None,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="At most so many queries of each building.")
    ] = 20,
    simulated: Annotated[
        int, typer.Option(min=0, max=10, metavar="N", help="Simulated buildings with queries.")
    ] = 10,
    seed: Annotated[int, typer.Option(help="Of the simulated buildings.")] = 0,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Measure how surely a scan names its building, and its place there, among many sets.

    Every log gives a set and queries; simulated buildings fill up to the number of sets.
    """
    from . import benchmark, fleet_benchmark
    from .reference_set import ReferenceSet

    settings = _read_settings(preset or (None if settings_file else "default"), settings_file)
    assert settings is not None
    drives = benchmark.read_drives(logs or benchmark.default_logs(_say))
    fleet_benchmark.run(
        benchmark.tasks(drives, ("P1", "P3")),
        [(path.stem, ReferenceSet.open(path, settings=settings)) for path in also or ()],
        settings,
        sorted(set(sizes or (1, 10, 100, 1000))),
        queries,
        simulated,
        seed,
        say=typer.echo,
        progress=_progress,
    )


@app.command()
@_guarded
def bench_service(
    set_file: SetArgument,
    log: LogArgument,
    workers: Annotated[
        int, typer.Option(min=1, metavar="N", help="Worker processes of the service.")
    ] = 1,
    clients: Annotated[
        int, typer.Option(min=1, max=64, metavar="N", help="Clients that ask at once.")
    ] = 2,
    queries: Annotated[
        int, typer.Option(min=1, max=1_000_000, metavar="N", help="Questions of each, at most.")
    ] = 2000,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=600.0, metavar="S", help="To go on for, at most.")
    ] = 20.0,
    batch: Annotated[
        int, typer.Option(min=1, max=1000, metavar="N", help="Scans in a question.")
    ] = 1,
    field_of_view: FieldOfViewOption = None,
) -> None:
    """Load a service of this machine with the scans of a log, beside the same calls in process."""
    from .service_benchmark import run

    opened = _open_log(log, _reading(field_of_view, None, None, False))
    scans = [record.scan for record in _records(opened) if record.scan is not None]
    for line in run(set_file, scans, workers, clients, queries, seconds, batch):
        typer.echo(line)


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
            f"{fit.protocol} {fit.place}, {fit.crowd:.0%} occluded: {fit.queries} queries, "
            f"recall {fit.recall:.3f} at 100 % and {fit.recall_99:.3f} at 99 % precision, calibration error "
            f"{fit.calibration_error:.3f}, {fit.accepted_wrong} of {fit.accepted} answers wrong"
        )
    unknown = [fit for fit in scored if fit.protocol == "P4"]
    for crowd in sorted({fit.crowd for fit in unknown}):
        pairs = [fit for fit in unknown if fit.crowd == crowd]
        typer.echo(
            f"P4, {len(pairs)} pairs of buildings, {crowd:.0%} occluded: "
            f"{sum(fit.accepted for fit in pairs)} of {sum(fit.queries for fit in pairs)} answered"
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
def bench_wrong(
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
    ] = 150,
    seed: Annotated[int, typer.Option(help="Chooses queries and misplaced references.")] = 1,
) -> None:
    """Say what happens with wrong data of right syntax: a table in Markdown.

    Accepted and correct answers with the laser upside down, with a twentieth of the references
    misplaced, and in maps of the wrong scale; and whether it was noticed.
    """
    from . import benchmark, wrong_data

    settings = _read_settings(preset or (None if settings_file else "default"), settings_file)
    assert settings is not None
    drives = benchmark.read_drives(logs or benchmark.default_logs(_say))
    cases = list(benchmark.tasks(drives, ("P1", "P3")))
    wrong_data.run(cases, settings, queries, seed, typer.echo, _progress)


@app.command()
@_guarded
def change(
    logs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[BUILDING=]LOG...", help="Logs with poses; those in ANCHORSCAN_DATA if none."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder for tables and curves."),
    ] = None,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="At most so many queries of each place.")
    ] = 100,
    buildings: Annotated[
        int, typer.Option(min=0, metavar="N", help="Simulated buildings that are changed.")
    ] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Of buildings and changes.")] = 0,
) -> None:
    """Change the world after the references were taken, and say what becomes of the answers.

    People before the laser in recorded drives; people, furniture, doors and walls in simulated
    buildings; from nothing to 60 %.
    """
    from . import benchmark, changed_world

    settings = _read_settings(preset or (None if settings_file else "default"), settings_file)
    assert settings is not None
    drives = benchmark.read_drives(logs or benchmark.default_logs(_say))
    cases = [case for case in benchmark.tasks(drives, ("P1", "P3")) if not case.looks_alike]
    changed_world.run(
        cases,
        settings,
        queries,
        buildings,
        seed,
        output,
        say=typer.echo,
        progress=_progress,
    )


@app.command()
@_guarded
def endure(
    what: Annotated[
        Endurance,
        typer.Argument(
            metavar="day|load|repeat",
            help="day: a day of a robot, and what grows; load: several processes on one set; "
            "repeat: the same questions under other circumstances.",
        ),
    ],
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[LOG...]",
            help="Logs with poses in one frame, the first for the references; a simulated "
            "drive if none.",
        ),
    ] = None,
    hours: Annotated[float, typer.Option(min=0.0, metavar="H", help="Of the robot's day.")] = 24.0,
    rate: Annotated[float, typer.Option(min=0.1, metavar="HZ", help="Its scans a second.")] = 6.0,
    seconds: Annotated[
        float, typer.Option(min=0.0, metavar="S", help="How long each load lasts.")
    ] = 20.0,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="Scans that load and repeat ask.")
    ] = 100,
    pythons: Annotated[
        list[Path] | None,
        typer.Option(
            "--python",
            metavar="PYTHON",
            help="Other interpreters with anchorscan's dependencies, for repeat; again for more.",
        ),
    ] = None,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Let it run for long, under load, and again: what grows, what waits, what differs."""
    from tempfile import TemporaryDirectory

    from . import endurance, load, repetition
    from .protocol import thin
    from .reference_set import ReferenceSet

    drives = _drives(logs or ())
    settings = _read_settings(preset, settings_file)
    with TemporaryDirectory() as folder:
        set_file = Path(folder) / "set.apr"
        with ReferenceSet.build(drives[0], settings=settings, path=set_file) as places:
            if what is Endurance.day:
                endurance.run(places, drives, hours, rate, typer.echo, _progress)
        usable = [record.scan for drive in drives for record in drive if record.scan is not None]
        scans = [usable[index] for index in thin(range(len(usable)), queries)]
        if what is Endurance.load:
            load.run(set_file, scans, seconds, typer.echo)
        if what is Endurance.repeat:
            asked = ReferenceSet(path=Path(folder) / "scans.apr")
            asked.add_batch(scans)
            asked.close()
            others = [
                repetition.Circumstance(str(path), {}, python=str(path), exact=False)
                for path in pythons or ()
            ]
            repetition.run(
                set_file,
                Path(folder) / "scans.apr",
                typer.echo,
                (*repetition.CIRCUMSTANCES, *others),
            )


def _drives(logs: Sequence[Path]) -> list[list[Record]]:
    """Read logs, or simulate two drives in a building."""
    if logs:
        return [list(_records(_open_log(path, {}))) for path in logs]
    from .building import random_building
    from .simulator import drive

    world = random_building(0)
    return [drive(world, seed=seed, length=100.0) for seed in (0, 1)]


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


@app.command()
@_guarded
def compare_sensors(
    buildings: Annotated[
        int, typer.Option(min=1, metavar="N", help="How many simulated offices.")
    ] = 4,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="At most so many queries in each.")
    ] = 60,
    preset: PresetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Locate the scans of one laser among references of another, for every pair of three.

    Prints a table in Markdown: the share whose best hypothesis is right, and in brackets how many
    were answered rightly, wrongly and not at all.
    """
    from .sensor_pairs import run

    settings = _read_settings(preset or (None if settings_file else "default"), settings_file)
    assert settings is not None
    run(buildings, queries, settings, say=typer.echo, progress=_progress)


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
    """Read logs one after the other; say what was guessed, malformed, or cannot be meant."""
    from .plausibility import Plausibility

    for log in logs:
        for note in log.notes:
            _say(f"note: {log.path}: {note}")
        plausibility = Plausibility()
        for record in log:
            plausibility.add(record)
            yield record
        _report_problems(log)
        for doubt in plausibility.doubts():
            _say(f"warning: {log.path}: {doubt}")


def _refuse_mirrored(places: ReferenceSet, log: Log) -> None:
    """End where a laser hangs upside down and nobody said so: its answers would be wrong.

    Raises:
        LogError: The scans fit the set as their mirror images.
    """
    from .plausibility import mirror_check

    found = mirror_check(places, log)
    if found.is_mirrored:
        raise LogError(
            f"its scans fit the set as their mirror images ({found.mirrored} of "
            f"{found.mirrored + found.as_given} that fit at all): one of the two was recorded with "
            "the laser upside down, or was said to be (--upside-down)",
            log.path,
        )


def _map_records(
    path: Path, field_of_view: float | None, range_max: float | None, spacing: float, heading: float
) -> Iterable[Record]:
    """Take scans all over a map, with the laser that was named or one that looks all around."""
    from .map_file import load_map
    from .occupancy import MAP_SENSOR, reference_scans

    sensor = MAP_SENSOR
    if field_of_view is not None:
        sensor = replace(sensor, field_of_view=field_of_view)
    if range_max is not None:
        sensor = replace(sensor, range_max=range_max)
    return reference_scans(load_map(path), sensor, spacing=spacing, heading=heading)


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


def _report_problems(log: Log) -> None:
    """Say once which lines of a log were no use."""
    for line in _problems(log):
        _say(line)


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

        self.places: ReferenceSet = ReferenceSet.open(set_file, settings=settings)
        self._candidates = candidates
        self.places.prepare()

    def line(self, record: Record) -> dict[str, Any]:
        """Return the line of ``locate`` for a record."""
        hypotheses: list[Hypothesis] = []
        start = time.perf_counter()
        if record.scan is not None:
            hypotheses = self.places.locate(record.scan, self._candidates)
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
        return "no reading is a return" if len(self.places) else "the set has no references"


def _which_line(fleet: Fleet, record: Record, threads: int) -> dict[str, Any]:
    """Return the line of ``which`` for a record."""
    start = time.perf_counter()
    found = [] if record.scan is None else fleet.locate(record.scan, threads)
    line: dict[str, Any] = {
        "scan": record.index,
        "stamp": record.stamp,
        "seconds": round(time.perf_counter() - start, _DECIMALS + 1),
        "accepted": bool(found) and found[0].hypothesis.accepted,
        "hypotheses": [
            {"building": each.building, **_hypothesis_line(each.hypothesis)} for each in found
        ],
    }
    if not found:
        line["reason"] = record.problem or "no reading is a return"
    return line


def _tracked(
    records: Iterable[Record],
    set_file: Path,
    settings: Settings | None,
    log: Log,
    window: float,
) -> Iterator[dict[str, Any]]:
    """Yield the line of ``track`` for every record."""
    from .localizer import Localizer
    from .reference_set import ReferenceSet

    places = ReferenceSet.open(set_file, settings=settings)
    places.prepare()
    _refuse_mirrored(places, log)
    localizer = Localizer(places, window)
    localizer.prepare()
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
    log: Log,
) -> Iterator[dict[str, Any]]:
    """Yield the lines of ``locate`` in the order of the records."""
    locator = _Locator(set_file, settings, candidates)
    _refuse_mirrored(locator.places, log)
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


_INDEX_STATES = {
    "current": "current",
    "behind": "behind by a few references, which are derived on opening",
    "outdated": "outdated or damaged, not used; anchorscan index writes it anew",
    "unknown": "not looked at, since the settings of the set are not understood",
}


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
        "index": None if info.index == "none" else {"state": info.index, "bytes": info.index_size},
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
    if name == "index":
        return f"{_INDEX_STATES[value['state']]}, {value['bytes']:,} bytes"
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
