"""``build`` and ``add``: a reference set of logs with poses, or of a map."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import AnchorscanError
from .console import progress, refuse_overwriting, say
from .logs import records_of, refuse_another_frame, refuse_mirrored, stem
from .options import LaserOption, LogOptions, SetArgument, SettingsOptions, SharingOptions

if TYPE_CHECKING:
    from ..cluster import Spread
    from ..record import Record
    from ..set_file import BuildState

__all__ = ["add", "build"]

_MAP_SUFFIXES = (".yaml", ".yml", ".pgm", ".png", ".bmp", ".jpg", ".jpeg")
# Sets of fewer references open in a moment without an index.
_WORTH_AN_INDEX = 1000


class Body(str, Enum):
    """Whose poses a recording or a file of poses holds."""

    base = "base"
    laser = "laser"


@dataclass(frozen=True)
class RuleOptions:
    """Which scans become references."""

    spacing: Annotated[
        float | None,
        typer.Option(min=0.0, metavar="M", help="Metres between references (2; in a map 1.5) ..."),
    ] = None
    heading: Annotated[
        float | None,
        typer.Option(min=0.0, max=180.0, metavar="DEG", help="... or degrees (45; in a map 90)."),
    ] = None
    keep_all: Annotated[bool, typer.Option("--all", help="Keep every scan with a pose.")] = False

    @property
    def radians(self) -> float | None:
        """The heading."""
        return None if self.heading is None else math.radians(self.heading)


@dataclass(frozen=True)
class PosesOptions:
    """Where the poses of a log are, where it does not hold them itself."""

    poses: Annotated[
        str | None,
        typer.Option(metavar="FILE|TOPIC", help="Poses from a TUM file, a topic, or /tf."),
    ] = None
    poses_of: Annotated[
        Body, typer.Option(help="Whose poses those are, if a topic does not say.")
    ] = Body.base
    laser: LaserOption = None

    def posing(self) -> dict[str, Any]:
        """Return it as ``open_log`` wants it."""
        poses = _from_anywhere(self.poses)
        return {"poses": poses, "poses_of": self.poses_of.value, "T_base_laser": self.laser}


def build(
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Logs of laser scans with poses, or one map.yaml."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="SET", help="The reference set to write.")
    ],
    *,
    rule: RuleOptions,
    reading: LogOptions,
    posing: PosesOptions,
    settings: SettingsOptions,
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
    sharing: SharingOptions,
) -> None:
    """Make a reference set from the scans of logs with poses.

    A scan becomes a reference when no reference lies within the spacing and the heading of it.
    In a map (YAML beside PGM or PNG, as map_server has it), references are the scans that the
    laser would take at places spread over all that a robot can reach: by default one that looks
    all around, up to 30 m.

    Of several logs, one that cannot be read is named and left out.
    """
    refuse_overwriting([output], [*logs, posing.poses, settings.settings_file])
    chosen = settings.read()
    is_map = any(map(_is_map, logs))
    said = reading.topic or reading.upside_down or posing.poses or posing.laser
    if is_map and (said or (len(logs) > 1 and not each)):
        raise typer.BadParameter("a map is built from alone: no other logs, no topics or poses")
    recipe = _Recipe(
        reading.reading(),
        posing.posing(),
        rule.spacing,
        rule.radians,
        rule.keep_all,
        None if chosen is None else chosen.to_json(),
    )

    if each:
        with sharing.cluster() as spread:
            _build_each(recipe, logs, output, index, spread)
        return
    if len(logs) == 1:  # one piece: nothing to share
        say(_built(recipe, logs[0], recipe.records(logs[0], progress), output))
        _write_index(output, index)
        return
    unread: list[str] = []
    with sharing.cluster() as spread:
        read = progress(_read_logs(recipe, logs, spread, unread), "reading")
        say(_built(recipe, logs[0], read, output))
    _write_index(output, index)
    _tell_unread(unread, len(logs))


def add(
    set_file: SetArgument,
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="Logs with poses in the frame of the set."),
    ],
    *,
    rule: RuleOptions,
    reading: LogOptions,
    posing: PosesOptions,
) -> None:
    """Add references from more logs to a set, where it has none.

    By the rule that the set was built by, unless another is named. A log is refused when its
    scans do not fit the set where its poses say.
    """
    from ..io import open_log
    from ..reference_set import ReferenceSet

    if any(map(_is_map, logs)):
        raise typer.BadParameter("a map is built from alone: it cannot be added")
    told = {**reading.reading(), **posing.posing()}
    with ReferenceSet.open(set_file) as places:
        for path in logs:
            log = open_log(path, **told)
            refuse_mirrored(places, log)
            refuse_another_frame(places, log)
            before = len(places)
            state = places.extend(
                progress(records_of(log), "reading", log.count),
                spacing=rule.spacing,
                heading=rule.radians,
                keep_all=rule.keep_all,
            )
            say(f"{set_file}: {len(places) - before} references added{_source(state)}")
    _write_index(set_file, None)


def _from_anywhere(poses: str | None) -> str | None:
    """Name a file of poses, if it is one, so that another working directory has it, too."""
    if poses is None or not Path(poses).is_file():
        return poses
    return str(Path(poses).absolute())


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
        from ..io import open_log

        if _is_map(path):
            taken = _map_records(
                path, self.reading["field_of_view"], self.reading["range_max"], *self.rule(path)
            )
            return progress(taken, "simulating")
        log = open_log(path, **self.reading, **self.posing)
        return progress(records_of(log), "reading", log.count)

    def rule(self, path: Path) -> tuple[float, float]:
        """Give metres and radians between references."""
        usual = (1.5, math.radians(90.0)) if _is_map(path) else (2.0, math.radians(45.0))
        spacing = usual[0] if self.spacing is None else self.spacing
        return spacing, usual[1] if self.heading is None else self.heading


def _is_map(path: Path) -> bool:
    """Tell whether a file is a map, or the image of one, of which `load_map` says more."""
    return path.suffix.lower() in _MAP_SUFFIXES


def _map_records(
    path: Path, field_of_view: float | None, range_max: float | None, spacing: float, heading: float
) -> Iterable[Record]:
    """Take scans all over a map, with the laser that was named or one that looks all around."""
    from ..map_file import load_map
    from ..occupancy import MAP_SENSOR, reference_scans

    sensor = MAP_SENSOR
    if field_of_view is not None:
        sensor = replace(sensor, field_of_view=field_of_view)
    if range_max is not None:
        sensor = replace(sensor, range_max=range_max)
    return reference_scans(load_map(path), sensor, spacing=spacing, heading=heading)


def _built(recipe: _Recipe, source: Path, records: Iterable[Record], output: Path) -> str:
    """Build one set, and say what it holds."""
    from ..reference_set import ReferenceSet
    from ..settings import Settings

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
    told = "" if info.build is None else _source(info.build)
    return f"{output}: {info.references} references{told}"


def _source(build: BuildState) -> str:
    """Say what was read for references."""
    parts = [f" from {build.consumed} scans"]
    if build.unusable:
        parts.append(f"{build.unusable} unusable")
    if build.without_pose:
        parts.append(f"{build.without_pose} without a pose")
    return ", ".join(parts)


def _read_logs(
    recipe: _Recipe, logs: list[Path], spread: Spread, unread: list[str]
) -> Iterator[Record]:
    """Give the records of logs that were read whole, in their order."""
    for done in spread.map(_read_piece, _pieces(recipe, logs, spread)):
        if done.value is None:
            unread.append(str(done.error))
            continue
        records, told = done.value
        for line in told:
            say(line)
        yield from records
    if len(unread) == len(logs):
        _tell_unread(unread, len(logs))


def _pieces(recipe: _Recipe, logs: list[Path], spread: Spread) -> list[tuple[_Recipe, Path]]:
    """Name the logs so that workers find them, whose working directory is another one."""
    return [(recipe, log.absolute() if spread.workers else log) for log in logs]


def _read_piece(piece: tuple[_Recipe, Path]) -> tuple[list[Record], list[str]]:
    """Read one log, in whatever process."""
    from ..io import open_log

    recipe, path = piece
    told: list[str] = []
    records = list(records_of(open_log(path, **recipe.reading, **recipe.posing), tell=told.append))
    return records, told


def _write_index(path: Path, wanted: bool | None) -> None:
    """Write the index of a set that was built, if it is wanted or worth it."""
    from ..reference_set import ReferenceSet

    with ReferenceSet.open(path) as places:
        info = places.info()
        is_map_of_all = info.with_pose == info.references and places.settings.method == "map"
        if wanted or (wanted is None and is_map_of_all and info.references >= _WORTH_AN_INDEX):
            places.save_index()
            size = places.info().index_size or 0
            say(f"{path}.index: {size:,} bytes, derived from it")


def _build_each(
    recipe: _Recipe, logs: list[Path], folder: Path, index: bool | None, spread: Spread
) -> None:
    """Build a set of every log or map; those that are there already are left alone."""
    folder.mkdir(parents=True, exist_ok=True)
    targets = {log: folder / f"{stem(log)}.apr" for log in logs}
    if len(set(targets.values())) < len(targets):
        raise typer.BadParameter("two logs have the same name: their sets would, too")
    left = [log for log in logs if not targets[log].exists()]
    unread: list[str] = []
    pieces = spread.map(_set_piece, _pieces(recipe, left, spread))
    built = zip(left, pieces, strict=True)
    for log, done in progress(built, "building", len(left)):
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
        say(f"{targets[log]}: {told}")
        _write_index(targets[log], index)
    if len(left) < len(logs):
        say(f"{len(logs) - len(left)} were there already")
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
        say(f"left out: {reason}")
    if unread:
        raise AnchorscanError(f"{len(unread)} of {count} could not be read or used")
