"""What the documentation takes from the code when it is built: commands, settings, parameters.

A page asks for them with a comment on a line of its own: ``<!-- commands -->``.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any, get_args, get_type_hints

import typer
from pydantic import BaseModel

from anchorscan.cli import app
from anchorscan.robot_parameters import RobotParameters
from anchorscan.settings import PRESETS, Settings


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put what a page asks for in the place of the comment (called by mkdocs)."""
    for name, make in _MARKS.items():
        mark = f"<!-- {name} -->"
        if mark in markdown:
            markdown = markdown.replace(mark, make())
    return markdown


def robot_parameters() -> str:
    """The parameters of the ROS 2 node."""
    rows = [
        (f"`{name}`", _as_yaml(default), meaning)
        for name, (default, meaning) in RobotParameters.meanings().items()
    ]
    return "\n".join(_table(("parameter", "default", "meaning"), rows))


def _as_yaml(value: Any) -> str:
    if value is None or value == "":
        return ""
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def commands() -> str:
    """All commands with what they take, as they say it themselves."""
    parts = []
    for command in app.registered_commands:
        callback = command.callback
        assert callback is not None
        name = command.name or callback.__name__.replace("_", "-")
        taken = list(_parameters(callback))
        words = [each.name for each in taken if each.is_argument]
        usage = " ".join(["anchorscan", name, "[OPTIONS]", *words])
        parts += [f"## {name}", "", _paragraphs(callback.__doc__), "", f"```text\n{usage}\n```", ""]
        if taken:
            rows = [(f"`{each.name}`", each.meaning, each.default) for each in taken]
            parts += [*_table(("", "meaning", "default"), rows), ""]
    return "\n".join(parts)


@dataclass(frozen=True)
class _Parameter:
    """An argument or an option of a command."""

    name: str
    meaning: str
    default: str
    is_argument: bool


def _parameters(callback: Callable[..., Any]) -> Iterator[_Parameter]:
    hints = get_type_hints(callback, include_extras=True)
    for name, parameter in inspect.signature(callback).parameters.items():
        kind, *notes = get_args(hints[name]) if hasattr(hints[name], "__metadata__") else (None,)
        for note in notes:
            is_argument = isinstance(note, typer.models.ArgumentInfo)
            # Inside Annotated the first name stands where a default value would.
            words = map(str, (note.default, *(note.param_decls or ())))
            names = [word for word in words if word.startswith("-")]
            long = name.replace("_", "-")
            usual = f"--{long} / --no-{long}" if bool in (kind, *get_args(kind)) else f"--{long}"
            shown = ", ".join(sorted(names or [usual], key=len))
            value = _metavar(kind, note)
            yield _Parameter(
                value if is_argument else f"{shown} {value}".strip(),
                " ".join((note.help or "").split()),
                _default(parameter.default),
                is_argument,
            )


def _metavar(kind: Any, note: Any) -> str:
    """What stands for the value of a parameter; nothing for a switch."""
    if note.metavar:
        return str(note.metavar)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return "|".join(str(each.value) for each in kind)
    if bool in (kind, *get_args(kind)):
        return ""
    return {int: "N", float: "X"}.get(kind, "TEXT")


def _default(value: Any) -> str:
    if value is inspect.Parameter.empty:
        return "required"
    if value is None or value is False:
        return ""
    return f"`{value.value if isinstance(value, Enum) else value}`"


def settings() -> str:
    """All settings, section by section, with their values in every preset."""
    trees = {name: Settings.preset(name) for name in PRESETS}
    order = ["default", *(name for name in trees if name != "default")]
    parts = ["", *_settings_table(Settings, "", [trees[name] for name in order], order)]
    for name, section in _sections(Settings):
        parts += ["", f"## {name}", "", _first_line(section), ""]
        values = [_at(trees[preset], name) for preset in order]
        parts += _settings_table(section, f"{name}.", values, order)
    return "\n".join(parts)


def _settings_table(
    model: type[BaseModel], prefix: str, values: list[Any], order: list[str]
) -> list[str]:
    rows = [
        (
            f"`{prefix}{name}`",
            *(_value(getattr(value, name), known.description or "") for value in values),
            known.description or "",
        )
        for name, known in model.model_fields.items()
        if not _is_section(known.annotation)
    ]
    return _table(("setting", *order, "meaning"), rows)


def _sections(model: type[BaseModel], path: str = "") -> Iterable[tuple[str, type[BaseModel]]]:
    for name, known in model.model_fields.items():
        if _is_section(known.annotation):
            yield f"{path}{name}", known.annotation  # type: ignore[misc]
            yield from _sections(known.annotation, f"{path}{name}.")  # type: ignore[arg-type]


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _at(tree: Any, path: str) -> Any:
    for name in path.split("."):
        tree = getattr(tree, name)
    return tree


def _value(value: Any, meaning: str) -> str:
    if isinstance(value, float) and "radians" in meaning and "metres" not in meaning:
        return f"{value:.4g} ({math.degrees(value):.3g}°)"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _first_line(model: type[BaseModel]) -> str:
    return (model.__doc__ or "").strip().splitlines()[0]


def _paragraphs(text: str | None) -> str:
    return "\n\n".join(" ".join(each.split()) for each in (text or "").split("\n\n"))


def _table(names: tuple[str, ...], rows: Iterable[Iterable[str]]) -> list[str]:
    def line(cells: Iterable[str]) -> str:
        # Inside code a bar needs no escape, and would show it.
        shown = (cell if cell.startswith("`") else cell.replace("|", "\\|") for cell in cells)
        return "| " + " | ".join(shown) + " |"

    return [line(names), line("---" for _ in names), *map(line, rows)]


_MARKS = {"commands": commands, "settings": settings, "robot parameters": robot_parameters}
