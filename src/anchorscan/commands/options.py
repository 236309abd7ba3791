"""What a user can say to several commands, and what becomes of it.

Options that go together are a frozen dataclass.  A command takes it as one argument, and
``spelled_out`` shows its fields to the parser as options of their own.
"""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

import typer

from ..errors import SettingsError
from .console import say

if TYPE_CHECKING:
    from ..cluster import Spread
    from ..io import Log
    from ..pose import Pose2D
    from ..settings import Settings

__all__ = [
    "CandidatesOption",
    "DrivesArgument",
    "FieldOfViewOption",
    "LaserOption",
    "LinesOption",
    "LogArgument",
    "LogOptions",
    "PresetOption",
    "PresetsOption",
    "ProcessesOption",
    "RangeMaxOption",
    "SetArgument",
    "SettingsOptions",
    "SharingOptions",
    "SweptCandidatesOption",
    "TopicOption",
    "UpsideDownOption",
    "spelled_out",
]

# No laser scanner sees less, degrees.
_NARROW = 10.0

Command = TypeVar("Command", bound=Callable[..., None])


def spelled_out(command: Command) -> Command:
    """Show every field of a dataclass that a command takes as a parameter of the command."""
    groups: dict[str, Any] = {}
    parameters: list[inspect.Parameter] = []
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        if is_dataclass(hints[name]):
            groups[name] = hints[name]
            parameters += _fields(hints[name])
        else:
            named = parameter.replace(kind=parameter.KEYWORD_ONLY, annotation=hints[name])
            parameters.append(named)

    @wraps(command)
    def gathered(**given: Any) -> None:
        for name, group in groups.items():
            given[name] = group(**{field.name: given.pop(field.name) for field in fields(group)})
        command(**given)

    gathered.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    gathered.__annotations__ = {each.name: each.annotation for each in parameters}
    return gathered  # type: ignore[return-value]


def _fields(group: Any) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=field.default,
            annotation=hints[field.name],
        )
        for field in fields(group)
    ]


def _doubt_narrow(degrees: float | None) -> float | None:
    """Warn once of a field of view that was probably meant in radians."""
    if degrees is not None and 0.0 < degrees < _NARROW:
        say(
            f"warning: --field-of-view {degrees:g} is very narrow for a laser: it is given in "
            f"degrees, and {degrees:g} radians are {math.degrees(degrees):.0f} degrees"
        )
    return degrees


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
    from ..pose import Pose2D

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
    typer.Option(
        callback=_doubt_narrow,
        metavar="DEG",
        help="What the readings cover, if the log does not tell.",
    ),
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
PresetsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--preset", parser=_parse_preset, metavar="PRESET", help="Again for more presets."
    ),
]
SweptCandidatesOption = Annotated[
    list[Any] | None,
    typer.Option(
        parser=_parse_candidates,
        metavar="K|all",
        help="Again for more; the preset's own number, 1, 5 and all if none is named.",
    ),
]
ProcessesOption = Annotated[
    Any,
    typer.Option(
        parser=_parse_processes,
        metavar="N|all",
        help="Share the scans among processes; all takes every core.",
    ),
]
LaserOption = Annotated[
    Any,
    typer.Option(parser=_parse_laser, metavar="X,Y,DEG", help="Where the laser sits on the robot."),
]
DrivesArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[BUILDING=]LOG...", help="Logs with poses; those in ANCHORSCAN_DATA if none."
    ),
]
LinesOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="OUT", help="File for the JSON lines, not stdout."),
]


@dataclass(frozen=True)
class LogOptions:
    """What a user may say about a log that the log itself does not."""

    field_of_view: FieldOfViewOption = None
    range_max: RangeMaxOption = None
    topic: TopicOption = None
    upside_down: UpsideDownOption = False

    def reading(self) -> dict[str, Any]:
        """Return it as ``open_log`` wants it."""
        field_of_view = self.field_of_view
        return {
            "field_of_view": None if field_of_view is None else math.radians(field_of_view),
            "range_max": self.range_max,
            "topic": self.topic,
            "is_upside_down": self.upside_down or None,
        }

    def open(self, path: Path) -> Log:
        """Open a log."""
        from ..io import open_log

        return open_log(path, **self.reading())


@dataclass(frozen=True)
class SettingsOptions:
    """Which settings to use: those of a preset, or those in a file."""

    preset: PresetOption = None
    settings_file: Annotated[
        Path | None,
        typer.Option("--settings", metavar="FILE", help="Settings from a JSON file."),
    ] = None

    def read(self) -> Settings | None:
        """Return the settings asked for; None leaves the choice to the reference set."""
        if self.preset is None and self.settings_file is None:
            return None
        from ..settings import Settings

        path = self.settings_file
        if path is None:
            return Settings.preset(self.preset or "default")
        if self.preset is not None:
            raise typer.BadParameter("give --preset or --settings, not both")
        try:
            return Settings.from_json(path.read_text(encoding="utf-8"))
        except SettingsError as error:
            raise SettingsError(f"{path}: {error}") from None
        except UnicodeDecodeError:
            raise SettingsError(f"{path}: not a settings file (JSON in UTF-8)") from None

    def chosen(self) -> Settings:
        """Return the settings asked for, or the default ones."""
        from ..settings import Settings

        return self.read() or Settings.preset()


@dataclass(frozen=True)
class SharingOptions:
    """Who does the work."""

    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Share the work among the workers of a Dask scheduler."
        ),
    ] = None
    workers: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Share the work among processes of this machine."),
    ] = None

    def cluster(self) -> AbstractContextManager[Spread]:
        """Give what work is handed to; the workers end with it."""
        from ..cluster import cluster

        return cluster(self.scheduler, self.workers)
