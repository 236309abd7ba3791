"""``info``, ``index``, ``check`` and ``remove``: what a set holds, and whether it fits together."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import ReferenceSetError
from .console import FAILED, progress, say
from .options import SetArgument, SettingsOptions

if TYPE_CHECKING:
    from ..reference_set import SetInfo

__all__ = ["check", "index", "info", "remove"]


def info(
    set_file: SetArgument,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Say what a reference set holds."""
    from ..reference_set import ReferenceSet

    with ReferenceSet.open(set_file, use_index=False) as places:  # which verifies every reference
        facts = _facts(places.info())
    if as_json:
        typer.echo(json.dumps(facts))
        return
    for name, value in facts.items():
        if value is not None:
            typer.echo(f"{name.replace('_', ' ') + ':':<13}{_in_words(name, value)}")


def index(set_file: SetArgument) -> None:
    """Write what is derived from a set to SET.index, so that it opens at once.

    The index may be deleted at any time. What is added to the set later does not need it to be
    written anew, as long as that is little.
    """
    from ..reference_set import ReferenceSet

    with ReferenceSet.open(set_file) as places:
        places.save_index()
        info = places.info()
    say(f"{set_file}.index: {info.index_size or 0:,} bytes of {info.references} references")


def check(
    set_file: SetArgument,
    *,
    settings: SettingsOptions,
) -> None:
    """Name the references that contradict the others, or lie off their way.

    Their poses are wrong, or their places have changed.

    The exit code is 1 when there are any.
    """
    from ..reference_set import ReferenceSet
    from ..set_check import run

    with ReferenceSet.open(set_file, settings=settings.read()) as places:
        bad = run(places, say=typer.echo, progress=progress)
    if bad:
        raise typer.Exit(FAILED)


def remove(
    set_file: SetArgument,
    identifiers: Annotated[
        list[int], typer.Argument(metavar="N...", min=0, help="References, as check numbers them.")
    ],
) -> None:
    """Remove references from a set; their numbers are never used again."""
    from ..reference_set import ReferenceSet

    with ReferenceSet.open(set_file) as places:
        for identifier in identifiers:
            if identifier not in places:  # before any is removed
                raise ReferenceSetError(f"{set_file}: has no reference {identifier}")
        for identifier in dict.fromkeys(identifiers):
            places.remove(identifier)
        say(f"{set_file}: {len(places)} references left")


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
