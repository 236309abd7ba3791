"""``anchorscan change``: what becomes of the answers when the world has changed since.

References are taken in the world as it was, questions are asked in the world as it is now.
In recorded drives people are put before the laser; in simulated buildings, where everything can
be changed and the truth stays exact, furniture is moved, doors are turned, walls are taken
away, and all of it together with people.  The amount of a change is the share of what there is:
of the readings, of the pieces, of the doors, of the walls.

Recall has to fall as the world changes.  What counts is that answers do not become wrong
with it: at the shipped threshold 99.5 % of those that are given should be right whatever the
amount.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from .building import random_building
from .drawing import LIGHT, require_matplotlib
from .errors import AnchorscanError, MissingExtraError
from .matcher import Matcher
from .pose import Pose2D
from .progress import ProgressOf
from .protocol import Answer, Case, thin, two_sessions
from .record import Record
from .reference import Reference
from .scan import LaserScan
from .sensor import SensorModel
from .settings import Settings
from .simulator import drive, occlude, simulate
from .world import World, cast_rays, move_furniture, remove_walls, turn_doors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "AMOUNTS",
    "CHANGES",
    "Outcome",
    "changed",
    "draw",
    "in_buildings",
    "in_drives",
    "pooled",
    "run",
    "table",
    "write",
]

AMOUNTS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
CHANGES = ("people", "furniture", "doors", "walls", "everything")
POOLED = "pooled"

Item = TypeVar("Item")

# Buildings: offices of their own seeds, and every fourth a hall.
_STYLES = ("office", "office", "office", "hall")
_DRIVEN = 200.0
_PUSH = 2.0
# Nearer to a surface than this, metres, there is no room for a robot any more.
_ROOM = 0.2
_WANTED = 0.995


@dataclass(frozen=True)
class Outcome:
    """What became of the questions of one place after one change.

    Args:
        change: One of `CHANGES`.
        place: Where.
        amount: Share of what there is that was changed.
        queries: Questions.
        top_1: Those whose best hypothesis was correct, accepted or not.
        correct: Answers given that were correct.
        wrong: Answers given that were wrong.
    """

    change: str
    place: str
    amount: float
    queries: int
    top_1: int
    correct: int
    wrong: int

    @property
    def precision(self) -> float:
        """Share of the answers given that were correct; NaN without any."""
        given = self.correct + self.wrong
        return self.correct / given if given else math.nan


def run(
    cases: Sequence[Case],
    settings: Settings,
    queries: int,
    buildings: int,
    seed: int,
    folder: Path | None,
    say: Callable[[str], None],
    progress: ProgressOf,
) -> list[Outcome]:
    """Measure every change at every amount, print the tables, and keep what was found.

    Args:
        cases: Splits of recorded drives.
        settings: Of the matcher.
        queries: At most so many of each place, at equal steps.
        buildings: Simulated ones.
        seed: Of buildings and changes.
        folder: For the table as CSV and JSON and the curves; None writes nothing.
        say: Takes the lines of the tables and messages.
        progress: Wraps what takes a while.

    Raises:
        AnchorscanError: There are no questions.
        OSError: The folder cannot be written.
    """
    found = [
        *in_drives(cases, settings, queries, seed, progress),
        *in_buildings(buildings, settings, queries, seed, progress),
    ]
    if not any(outcome.queries for outcome in found):
        raise AnchorscanError("there is no question to ask: name logs or simulate buildings")
    found += pooled(found)
    for line in table(found):
        say(line)
    if folder is not None:
        for path in write(found, folder, settings):
            say(str(path))
        try:
            draw(found).savefig(folder / "changed-world.png")
            say(str(folder / "changed-world.png"))
        except MissingExtraError as error:
            say(f"no pictures: {error}")
    return found


def in_drives(
    cases: Sequence[Case], settings: Settings, queries: int, seed: int, progress: ProgressOf
) -> Iterator[Outcome]:
    """Put people before the laser of recorded drives."""
    for case in cases:
        matcher = Matcher(case.references, settings)
        asked = list(case.queries)
        chosen = [asked[index] for index in thin(range(len(asked)), queries, seed)]
        for amount in progress(AMOUNTS, f"people, {case.place}", len(AMOUNTS)):
            crowded = (
                (_with_people(scan, amount, (seed, index)), truth)
                for index, (scan, truth) in enumerate(chosen)
            )
            yield _outcome("people", case.place, amount, matcher, crowded)


def in_buildings(
    count: int, settings: Settings, queries: int, seed: int, progress: ProgressOf
) -> Iterator[Outcome]:
    """Change simulated buildings in every way."""
    sensor = SensorModel()
    for number in range(count):
        style = _STYLES[number % len(_STYLES)]
        place = f"{style} {number}"
        plan, first, second = np.random.default_rng((seed, number)).spawn(3)
        world = random_building(plan, style=style)
        known = drive(world, sensor, seed=first, length=_DRIVEN)
        asked = drive(world, sensor, seed=second, length=_DRIVEN)
        split = two_sessions(known, asked)
        matcher = Matcher(_references(known, split.references), settings)
        poses = [pose for k in thin(split.queries, queries) if (pose := asked[k].pose) is not None]
        for change in progress(CHANGES, f"changes, {place}", len(CHANGES)):
            for amount in AMOUNTS:
                now = changed(world, change, amount, seed=(seed, number))
                scans = _seen(now, poses, sensor, change, amount, seed)
                yield _outcome(change, place, amount, matcher, scans)


def changed(world: World, change: str, amount: float, seed: int | Sequence[int] = 0) -> World:
    """Change a share of a building; people come with the single scan, not with the building.

    Args:
        world: As it was.
        change: One of `CHANGES`.
        amount: Share of the pieces, doors or walls, in [0, 1].
        seed: Of the change.

    Raises:
        AnchorscanError: There is no such change.
    """
    if change not in CHANGES:
        raise AnchorscanError(f"unknown change {change!r}: there are {', '.join(CHANGES)}")
    furniture, doors, walls = np.random.default_rng(seed).spawn(3)
    if change in ("furniture", "everything"):
        world = move_furniture(world, furniture, share=amount, distance=_PUSH)
    if change in ("doors", "everything"):
        world = turn_doors(world, doors, share=amount)
    if change in ("walls", "everything"):
        world = remove_walls(world, walls, share=amount)
    return world


def pooled(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Add up all places, recorded and simulated apart, change by change and amount by amount."""
    sums: dict[tuple[str, str, float], list[int]] = {}
    for each in outcomes:
        kind = "simulated" if each.place.partition(" ")[0] in _STYLES else "recorded"
        counts = sums.setdefault((each.change, kind, each.amount), [0, 0, 0, 0])
        for index, count in enumerate((each.queries, each.top_1, each.correct, each.wrong)):
            counts[index] += count
    return [
        Outcome(change, f"{POOLED}, {kind}", amount, *counts)
        for (change, kind, amount), counts in sums.items()
    ]


def table(outcomes: Sequence[Outcome]) -> list[str]:
    """Return what was found as a table in Markdown; too many wrong answers stand in bold."""
    lines = [
        "| change | place | amount | queries | top-1 | correct | wrong | silent | answers right |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for each in outcomes:
        right = "-" if math.isnan(each.precision) else f"{100.0 * each.precision:.1f} %"
        if each.precision < _WANTED:
            right = f"**{right}**"
        silent = each.queries - each.correct - each.wrong
        lines.append(
            f"| {each.change} | {each.place} | {100.0 * each.amount:.0f} % | {each.queries} | "
            f"{each.top_1 / max(each.queries, 1):.3f} | {each.correct} | {each.wrong} | {silent} | "
            f"{right} |"
        )
    return lines


def write(outcomes: Sequence[Outcome], folder: Path, settings: Settings) -> list[Path]:
    """Write changed-world.csv and changed-world.json, with the settings, into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [asdict(outcome) for outcome in outcomes]
    as_csv, as_json = folder / "changed-world.csv", folder / "changed-world.json"
    with as_csv.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    content = {"outcomes": rows, "settings": json.loads(settings.to_json())}
    as_json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return [as_csv, as_json]


def draw(outcomes: Sequence[Outcome]) -> Figure:
    """Draw over the amount of change what share is found, answered, and answered wrongly.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    sums = [each for each in outcomes if each.place.startswith(POOLED)]
    titles = list(dict.fromkeys((each.change, each.place) for each in sums))
    columns = min(3, len(titles))
    rows = math.ceil(len(titles) / columns)
    figure = Figure(figsize=(4.0 * columns, 3.0 * rows), dpi=100, layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat
    for (change, place), panel in zip(titles, axes, strict=False):
        shown = [each for each in sums if (each.change, each.place) == (change, place)]
        amount = [100.0 * each.amount for each in shown]
        for values, color, style, name in (
            ([each.top_1 / each.queries for each in shown], LIGHT.reference, "s--", "top-1"),
            ([each.correct / each.queries for each in shown], LIGHT.scan, "o-", "correct"),
            ([each.wrong / each.queries for each in shown], LIGHT.jump, "x-", "wrong"),
        ):
            panel.plot(amount, values, style, color=color, label=name)
        panel.set_title(f"{change} ({place.rpartition(' ')[2]})", fontsize=9)
        panel.set_xlabel("% changed", fontsize=8)
        panel.set_ylim(-0.03, 1.03)
        panel.grid(color=LIGHT.faint)
    figure.axes[0].legend(fontsize=8)
    figure.axes[0].set_ylabel("share of the questions", fontsize=8)
    return figure


def _references(records: Sequence[Record], positions: Iterable[int]) -> list[Reference]:
    return [
        Reference(number, scan, records[position].pose)
        for number, position in enumerate(positions)
        if (scan := records[position].scan) is not None
    ]


def _with_people(scan: LaserScan, amount: float, seed: Sequence[int]) -> LaserScan:
    return occlude(scan, amount, np.random.default_rng(seed)) if amount > 0.0 else scan


def _seen(
    world: World,
    poses: Sequence[Pose2D],
    sensor: SensorModel,
    change: str,
    amount: float,
    seed: int,
) -> Iterator[tuple[LaserScan, Pose2D]]:
    """Yield what the laser sees now, wherever there is still room for it."""
    for index, pose in enumerate(poses):
        if cast_rays(world, pose, -math.pi, math.radians(2.0), 180).min() < _ROOM:
            continue
        scan = simulate(world, pose, sensor, np.random.default_rng((seed, index)))
        if change in ("people", "everything"):
            scan = _with_people(scan, amount, (seed, index))
        yield scan, pose


def _outcome(
    change: str,
    place: str,
    amount: float,
    matcher: Matcher,
    asked: Iterable[tuple[LaserScan, Pose2D | None]],
) -> Outcome:
    queries = top_1 = correct = wrong = 0
    for scan, truth in asked:
        queries += 1
        found = matcher.locate(scan)
        if not found:
            continue
        best = found[0]
        is_right = Answer(0, best.pose, truth, best.probability, best.accepted, 0.0).is_correct
        top_1 += is_right
        correct += best.accepted and is_right
        wrong += best.accepted and not is_right
    return Outcome(change, place, amount, queries, top_1, correct, wrong)
