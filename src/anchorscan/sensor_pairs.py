"""``anchorscan compare-sensors``: references of one laser, queries of another.

Two robots rarely carry the same laser, and a set outlives the one that it was made with.  In
simulated offices, where the truth is exact, one drive is made with each of `SENSORS` for the
references and another one with each for the queries; every pair is measured on the same places.
Between the drives doors are turned and furniture is moved.

A sensor model stands for a kind of laser, not for a product: a half turn at one degree, three
quarters of a turn at a quarter of a degree that hangs upside down off the robot's centre, a full
turn that sees 12 m, turns clockwise and loses one reading in ten, and a small one that sees 4 m.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from .building import random_building
from .matcher import Matcher
from .pose import Pose2D
from .progress import ProgressOf
from .protocol import Answer, figures, thin, two_sessions
from .record import Record
from .reference import Reference
from .sensor import SensorModel
from .settings import Settings
from .simulator import drive
from .world import World, move_furniture, turn_doors

__all__ = ["SENSORS", "Pair", "compare", "run", "table"]

SENSORS = {
    "180°, 1°, 30 m": SensorModel(math.radians(180.0), math.radians(1.0), range_max=30.0),
    "270°, 0.25°, 20 m, upside down": SensorModel(
        math.radians(270.0),
        math.radians(0.25),
        range_max=20.0,
        upside_down=True,
        mounting=Pose2D(0.25, -0.1, math.radians(20.0)),
    ),
    "360°, 1°, 12 m, clockwise": SensorModel(
        math.radians(360.0),
        math.radians(1.0),
        range_max=12.0,
        noise=0.02,
        dropout=0.1,
        clockwise=True,
        mounting=Pose2D(-0.1, 0.0, math.radians(90.0)),
    ),
    "240°, 0.36°, 4 m": SensorModel(
        math.radians(240.0), math.radians(0.36), range_max=4.0, noise=0.02
    ),
}
# Of the doors and the furniture, how much is elsewhere when the queries are taken.
_CHANGED = 0.3
_LENGTH = 120.0

Item = TypeVar("Item")


@dataclass(frozen=True)
class Pair:
    """What one laser makes of the references of another.

    Args:
        references: Name of the laser that took the references.
        queries: Name of the laser that took the queries.
        answers: To every query of all buildings.
    """

    references: str
    queries: str
    answers: tuple[Answer, ...]


def run(
    buildings: int,
    queries: int,
    settings: Settings,
    say: Callable[[str], None],
    progress: ProgressOf = lambda items, what, total=None: items,
) -> list[Pair]:
    """Measure every pair in buildings drawn with the seeds 1, 2, ..., and say it as a table.

    Args:
        buildings: How many.
        queries: At most so many of each building.
        settings: Of the matcher.
        say: Takes the lines of the table, in Markdown.
        progress: Wraps what takes a while.
    """
    measured: dict[tuple[str, str], tuple[Answer, ...]] = {}
    for seed in progress(range(1, buildings + 1), "buildings", buildings):
        for pair in compare(random_building(seed), seed, queries, settings):
            key = (pair.references, pair.queries)
            measured[key] = measured.get(key, ()) + pair.answers
    pairs = [Pair(*names, answers) for names, answers in measured.items()]
    for line in table(pairs):
        say(line)
    return pairs


def compare(world: World, seed: int, queries: int, settings: Settings) -> list[Pair]:
    """Measure every pair of `SENSORS` in one building.

    Args:
        world: The building, as it was for the references.
        seed: Of both drives and of the changes between them.
        queries: At most so many.
        settings: Of the matcher.
    """
    changed = move_furniture(turn_doors(world, seed, share=_CHANGED), seed, share=_CHANGED)
    # The places are those of the robot, the same for every laser.
    plain = replace(next(iter(SENSORS.values())), mounting=Pose2D())
    split = two_sessions(_drive(world, plain, seed), _drive(changed, plain, seed + 1_000))
    asked = thin(split.queries, queries)
    later = {name: _drive(changed, sensor, seed + 1_000) for name, sensor in SENSORS.items()}
    pairs = []
    for name, sensor in SENSORS.items():
        records = _drive(world, sensor, seed)
        matcher = Matcher([_reference(records[k]) for k in split.references], settings)
        pairs += [
            Pair(name, other, tuple(_ask(matcher, taken[k]) for k in asked))
            for other, taken in later.items()
        ]
    return pairs


def table(pairs: Sequence[Pair]) -> list[str]:
    """Return the lines of a table in Markdown: top-1, and what is answered at the threshold."""
    names = list(dict.fromkeys(pair.queries for pair in pairs))
    known = {(pair.references, pair.queries): pair for pair in pairs}
    lines = [
        _line(["references \\ queries", *names]),
        _line(["---", *("---:" for _ in names)]),
    ]
    for row in dict.fromkeys(pair.references for pair in pairs):
        lines.append(_line([row, *(_cell(known[row, name]) for name in names)]))
    return lines


def _drive(world: World, sensor: SensorModel, seed: int) -> list[Record]:
    return drive(world, sensor, seed=seed, length=_LENGTH)


def _reference(record: Record) -> Reference:
    assert record.scan is not None
    return Reference(record.index, record.scan, record.pose)


def _ask(matcher: Matcher, record: Record) -> Answer:
    assert record.scan is not None
    found = matcher.locate(record.scan)
    best = found[0] if found else None
    return Answer(
        record.index,
        best.pose if best else None,
        record.pose,
        best.probability if best else 0.0,
        best.accepted if best else False,
        0.0,
    )


def _cell(pair: Pair) -> str:
    told = figures(pair.answers)
    return f"{told.top_1:.3f} ({told.correct} / {told.wrong} / {told.silent})"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
