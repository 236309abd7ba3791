"""``anchorscan bench-wrong``: what happens with data of right syntax and wrong meaning.

The queries of P1 and P3 are asked once more, with one thing wrong at a time:

* the laser of the queries hangs upside down, and nobody says so; scan by scan, without and with
  ``decision.both_ways``, and of a robot that is followed over the whole drive, without and with
  what watches for it;
* a twentieth of the references stand two to six metres from where they were taken, half of them
  turned as well;
* the map is too large, by a twentieth or by two: poses and ranges of all references are;
* positions in millimetres, headings in degrees.

An answer to a mirrored scan is correct only by accident; one in a map of the wrong scale is where
the place is in that map.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np

from .localizer import Localizer
from .plausibility import MirrorWatch, Plausibility, mirror_check
from .pose import Pose2D
from .progress import ProgressOf
from .protocol import Case, Split, is_correct, thin
from .record import Record
from .reference_set import ReferenceSet
from .robot import Robot
from .scan import LaserScan
from .set_check import check
from .settings import Settings

__all__ = ["Told", "displaced", "mirrored", "run", "scaled"]

Item = TypeVar("Item")

_SHARE = 0.05
_NEAREST, _FARTHEST = 2.0, 6.0
_SCALES = (1.05, 2.0)
_COLUMNS = (
    *("place", "queries", "as they are", "mirrored", "asked both ways"),
    *("said", "followed", "mirrored, followed"),
    *("5 % misplaced", "named", "false"),
    *("map 5 % large", "map twice as large", "mm", "degrees"),
)


class Drive(Protocol):
    """A recorded drive."""

    @property
    def records(self) -> Sequence[Record]:
        """Its records, in order."""


class SplitCase(Case, Protocol):
    """A case with the drives that it was made of."""

    @property
    def known(self) -> Drive:
        """The drive that the references come from."""

    @property
    def asked(self) -> Drive:
        """The drive that the queries come from."""

    @property
    def split(self) -> Split:
        """Which records of both."""


@dataclass(frozen=True)
class Told:
    """Answers that were accepted, and those of them that are right."""

    accepted: int
    correct: int

    def __str__(self) -> str:
        """As a cell of the table."""
        return f"{self.accepted} / {self.correct}"


def run(
    tasks: Sequence[SplitCase],
    settings: Settings,
    queries: int,
    seed: int,
    say: Callable[[str], None],
    progress: ProgressOf,
) -> None:
    """Ask every task with one thing wrong at a time, and print a table in Markdown."""
    say("| " + " | ".join(_COLUMNS) + " |")
    say("| --- |" + " ---: |" * (len(_COLUMNS) - 1))
    for task in progress(tasks, "asking", len(tasks)):
        say("| " + " | ".join(map(str, _row(task, settings, queries, seed))) + " |")


def mirrored(record: Record) -> Record:
    """Return a record as a laser upside down would have made it."""
    return record if record.scan is None else replace(record, scan=record.scan.upside_down())


def scaled(record: Record, scale: float) -> Record:
    """Return a record of a building so many times as large."""
    scan, pose = record.scan, record.pose
    if scan is not None:
        geometry = (scan.angle_min, scan.angle_increment, scale * scan.range_min)
        scan = LaserScan(scale * scan.ranges, *geometry, scale * scan.range_max)
    if pose is not None:
        pose = Pose2D(scale * pose.x, scale * pose.y, pose.theta)
    return replace(record, scan=scan, pose=pose)


def displaced(
    records: Sequence[Record], rng: np.random.Generator, share: float = _SHARE
) -> tuple[list[Record], set[int]]:
    """Move some of the records that have a pose by metres, and turn half of these.

    Returns:
        The records, and the positions of those that were moved.
    """
    count = max(1, round(share * len(records)))
    chosen = set(rng.choice(len(records), count, replace=False).tolist())
    moved = list(records)
    for number in sorted(chosen):
        way, direction = rng.uniform(_NEAREST, _FARTHEST), rng.uniform(-math.pi, math.pi)
        turn = rng.uniform(-math.pi, math.pi) if rng.random() < 0.5 else 0.0
        pose = records[number].pose
        assert pose is not None
        x, y = pose.x + way * math.cos(direction), pose.y + way * math.sin(direction)
        moved[number] = replace(moved[number], pose=Pose2D(x, y, pose.theta + turn))
    return moved, chosen


def _row(task: SplitCase, settings: Settings, queries: int, seed: int) -> list[object]:
    known = [task.known.records[position] for position in task.split.references]
    asked = [task.asked.records[position] for position in thin(task.split.queries, queries, seed)]
    places = _set(known, settings)
    moved, wrong = displaced(known, np.random.default_rng(seed))
    misplaced = _set(moved, settings)
    named = {each.reference.identifier for each in check(misplaced) if each.is_wrong}
    turned = [mirrored(record) for record in asked]
    wary = _set(known, settings.changed({"decision": {"both_ways": True}}))
    drive = list(map(mirrored, task.asked.records))
    said = mirror_check(places, drive).is_mirrored
    alarm = mirror_check(places, task.asked.records).is_mirrored
    return [
        f"{task.protocol} {task.place}",
        len(asked),
        _ask(places, asked),
        _ask(places, turned),
        f"{_ask(wary, asked)}; {_ask(wary, turned)}",
        f"{_yes(said)}{' (and as it is!)' if alarm else ''}",
        _follow(places, task.asked.records, MirrorWatch(places)),
        f"{_follow(places, drive)}; {_follow(places, drive, MirrorWatch(places))}",
        _ask(misplaced, asked),
        f"{len(named & wrong)} of {len(wrong)}",
        f"{len(named - wrong)} of {len(known) - len(wrong)}",
        *(
            _ask(
                _set([scaled(record, scale) for record in known], settings),
                asked,
                scale,
            )
            for scale in _SCALES
        ),
        _noticed(task.asked.records, 1000.0, 1.0),
        _noticed(task.asked.records, 1.0, math.degrees(1.0)),
    ]


def _set(records: Sequence[Record], settings: Settings) -> ReferenceSet:
    places = ReferenceSet(settings=settings)
    usable = [record for record in records if record.scan is not None]
    places.add_batch(
        [record.scan for record in usable if record.scan is not None],
        [record.pose for record in usable],
    )
    return places


def _ask(places: ReferenceSet, records: Sequence[Record], scale: float = 1.0) -> Told:
    accepted = correct = 0
    for record in records:
        assert record.scan is not None
        best = next(iter(places.locate(record.scan)), None)
        if best is None or not best.accepted:
            continue
        accepted += 1
        truth = scaled(record, scale).pose
        correct += best.pose is not None and is_correct(best.pose, truth)
    return Told(accepted, correct)


def _follow(
    places: ReferenceSet, records: Sequence[Record], mirror: MirrorWatch | None = None
) -> Told:
    """Follow a robot by its scans and odometry, or by its poses where it has none."""
    robot = Robot(Localizer(places), mirror=mirror)
    located = correct = 0
    for step, record in enumerate(records):
        moved = record.pose if record.odometry is None else record.odometry
        if moved is not None:
            robot.odometry.add(step, moved)
        report = None if record.scan is None else robot.take(record.scan, step)
        if report is not None and report.state == "located" and report.T_map_base is not None:
            located += 1
            correct += record.pose is not None and is_correct(report.T_map_base, record.pose)
    return Told(located, correct)


def _noticed(records: Sequence[Record], positions: float, headings: float) -> str:
    """Whether wrong units of the poses are noticed, and right ones are not."""
    right, wrong = Plausibility(), Plausibility()
    for record in records:
        pose = record.pose
        right.add(record)
        if pose is not None:
            pose = Pose2D(positions * pose.x, positions * pose.y, headings * pose.theta)
        wrong.add(replace(record, pose=pose))
    false = len(_of_units(right))
    return f"{_yes(bool(_of_units(wrong)))}{' (and as it is!)' if false else ''}"


def _of_units(plausibility: Plausibility) -> list[str]:
    return [
        doubt for doubt in plausibility.doubts() if "millimetres" in doubt or "degrees" in doubt
    ]


def _yes(value: bool) -> str:
    return "yes" if value else "no"
