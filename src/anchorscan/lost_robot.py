"""``anchorscan bench --protocol P5``: how soon a lost robot knows where it is, and whether it lies.

The journeys and their figures are in ``journey.py``.  Whoever follows the robot gets the same
scans and the same odometry, in order:

* "anchorscan": the `Localizer`;
* "window": the same, searching with the scans of the last 5 m joined into one view;
* "amcl": Monte Carlo localization spread uniformly over the map (``monte_carlo.py``); slow, and
  so measured under two of the conditions only.

A place is two independent drives, one the map and one the journeys; or one drive, with all that
was recorded near the journey taken out of the map.  A start counts where the map has a reference
within 2 m and 45 degrees, as P1 asks of a query; after a kidnapping so does the place of the
jump.  A journey ends where it has left the map for 5 m of driving, but for one condition, and
counts where that leaves 10 m at least:

* "recorded": with the odometry of the log, where it has one;
* "noise": with 5 % of noise in the odometry, or in one made from the poses;
* "leaving": the same, driving on where the map ends, so that only silence is right there;
* "kidnapping": carried away in the middle; odometry as recorded, else noisy.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Protocol, TypeVar

from .errors import AnchorscanError
from .journey import Journey, RecoveryFigures, independent, journeys, odometry, recovery, summary
from .localizer import Belief, Localizer
from .matcher import Matcher
from .monte_carlo import MonteCarlo
from .pose import Pose2D
from .progress import ProgressOf
from .protocol import Answer, Reliability, choose_references, reliability, thin
from .record import Record
from .reference import Reference
from .scan import LaserScan
from .settings import Settings

__all__ = [
    "FOLLOWERS",
    "Course",
    "Departure",
    "Outcome",
    "courses",
    "departures",
    "follow",
    "is_mapped",
    "run",
]

_NOISE = 0.05
_NEAR, _ALIKE = 2.0, math.radians(45.0)
_LEFT, _SHORTEST = 5.0, 10.0
_WINDOW = 5.0
_CONDITIONS = ("recorded", "noise", "leaving", "kidnapping")
_BASELINE_CONDITIONS = ("noise", "kidnapping")
Item = TypeVar("Item")


class Drive(Protocol):
    """A log, read."""

    @property
    def name(self) -> str: ...
    @property
    def records(self) -> tuple[Record, ...]: ...
    @property
    def building(self) -> str: ...
    @property
    def recording(self) -> str: ...


class Follower(Protocol):
    """What keeps a belief over time."""

    def update(self, scan: LaserScan, odometry: Pose2D | None, stamp: float | None) -> Belief: ...


Prepare = Callable[[Sequence[Reference]], Callable[[], Follower]]


@dataclass(frozen=True, eq=False)
class Course:
    """A drive to get lost on, and the drive that the map comes from.

    Args:
        place: What tables call it.
        known: Drive of the references.
        asked: Drive of the journeys; the same drive where there is no other.
    """

    place: str
    known: Drive
    asked: Drive

    @property
    def has_odometry(self) -> bool:
        """Whether odometry was recorded."""
        return all(record.odometry is not None for record in self.asked.records)

    def references(self, journey: Journey) -> tuple[Reference, ...]:
        """Return the references by P1's rule, none of them recorded near the journey."""
        records: Sequence[Record] = self.known.records
        if self.known is self.asked:
            records = independent(records, journey)
        chosen = [records[position] for position in choose_references(records)]
        return tuple(
            Reference(record.index, record.scan, record.pose)
            for record in chosen
            if record.scan is not None
        )


@dataclass(frozen=True)
class Outcome:
    """The figures of one follower on one course under one condition.

    Args:
        place: Name of the course.
        condition: One of those named above.
        follower: Name of who followed.
        figures: Those of P5.
        outside: Starts that do not count, since they or the next 10 m are not in the map.
        step_median: Seconds a step.
        step_99: 99th percentile of the same.
        reliability: Of the probability reported at every step of all journeys; the truth is
            right nowhere else than where the robot is, be that in the map or not.
    """

    place: str
    condition: str
    follower: str
    figures: RecoveryFigures
    outside: int
    step_median: float
    step_99: float
    reliability: Reliability


def _localizer(references: Sequence[Reference]) -> Callable[[], Follower]:
    matcher = Matcher(references, Settings.preset("default"))
    return lambda: Localizer(matcher)


def _with_window(references: Sequence[Reference]) -> Callable[[], Follower]:
    matcher = Matcher(references, Settings.preset("default"))
    return lambda: Localizer(matcher, _WINDOW)


def _monte_carlo(references: Sequence[Reference]) -> Callable[[], Follower]:
    return MonteCarlo(references).again


FOLLOWERS: dict[str, Prepare] = {
    "anchorscan": _localizer,
    "window": _with_window,
    "amcl": _monte_carlo,
}


def run(
    drives: Sequence[Drive],
    followers: Sequence[str] = ("anchorscan", "amcl"),
    *,
    starts: int | None = None,
    baseline_starts: int | None = None,
    longest: float = 100.0,
    seed: int = 0,
    output_folder: str | Path | None = None,
    say: Callable[[str], None] = lambda line: None,
    progress: ProgressOf = lambda items, what, total=None: items,
) -> tuple[Outcome, ...]:
    """Measure P5 on all courses that the drives make.

    Args:
        drives: Drives of one building, from two recordings, make one course, each other drive
            makes one of its own.
        followers: Names of ``FOLLOWERS``.
        starts: At most so many of each course, at equal steps; None for all.
        baseline_starts: The same for "amcl", among those.
        longest: Metres after which a journey ends.
        seed: Draws noise and kidnappings, and moves where the steps begin.
        output_folder: For ``lost-robot.json``; None writes nothing.
        say: Takes the lines of the table and messages.
        progress: Wraps what takes a while.

    Raises:
        AnchorscanError: A name is unknown, or no journey starts within the map.
        OSError: The folder cannot be written.
    """
    for name in followers:
        if name not in FOLLOWERS:
            raise AnchorscanError(f"unknown method {name!r}: there are {', '.join(FOLLOWERS)}")
    outcomes: list[Outcome] = []
    Matcher().prepare()
    for course in courses(drives):
        for condition in _CONDITIONS:
            if condition == "recorded" and not course.has_odometry:
                continue
            for name in followers:
                if name == "amcl" and condition not in _BASELINE_CONDITIONS:
                    continue
                most = _fewer(starts, baseline_starts) if name == "amcl" else starts
                what = f"P5 {course.place}, {condition}: {name}"
                made = _measured(course, condition, name, most, longest, seed, what, progress)
                if made is not None:
                    if not outcomes:
                        say(_HEADER)
                    outcomes.append(made)
                    say(_line(made))
    if not outcomes:
        raise AnchorscanError("no journey starts within a map: the drives visit no place twice")
    say(_STEPS_HEADER)
    for one in outcomes:
        say(_steps_line(one))
    if output_folder is not None:
        say(str(_kept(outcomes, Path(output_folder))))
    return tuple(outcomes)


def courses(drives: Sequence[Drive]) -> list[Course]:
    """Pair drives of one building, from two recordings; what is left is its own map."""
    pairs = [
        (first, second)
        for i, first in enumerate(drives)
        for second in drives[i + 1 :]
        if first.building == second.building and first.recording != second.recording
    ]
    paired = {drive.name for pair in pairs for drive in pair}
    made = [Course(f"{a.name} -> {b.name}", a, b) for a, b in pairs]
    return made + [Course(drive.name, drive, drive) for drive in drives if drive.name not in paired]


def follow(
    records: Sequence[Record], journey: Journey, told: Sequence[Pose2D], follower: Follower
) -> list[Answer]:
    """Feed a follower with a journey and compare what it reports with the truth."""
    answers = []
    for position, pose in zip(journey.positions, told, strict=True):
        record = records[position]
        assert record.scan is not None
        scan = _fresh(record.scan)
        begin = time.perf_counter()
        belief = follower.update(scan, pose, record.stamp)
        seconds = time.perf_counter() - begin
        answers.append(
            Answer(
                position,
                belief.pose,
                record.pose,
                belief.probability,
                belief.accepted,
                seconds,
                belief.covariance,
            )
        )
    return answers


@dataclass(frozen=True, eq=False)
class Departure:
    """A journey that counts, and what its robot knows.

    Args:
        number: Of the start, along the drive.
        journey: What is fed.
        references: The map.
        odometry: ``T_start_laser`` at every record of the journey.
    """

    number: int
    journey: Journey
    references: tuple[Reference, ...]
    odometry: list[Pose2D]


def departures(
    course: Course,
    condition: str,
    starts: int | None = None,
    *,
    longest: float = 100.0,
    seed: int = 0,
) -> Iterator[Departure | None]:
    """Yield the journeys of a condition, as `run` measures them.

    Args:
        course: Where to get lost.
        condition: "recorded", "noise", "leaving" or "kidnapping".
        starts: At most so many, at equal steps; None for all.
        longest: Metres after which a journey ends.
        seed: Draws noise and kidnappings, and moves where the steps begin.

    Yields:
        None for a start that does not count, since it or the next 10 m are not in the map.
    """
    records = course.asked.records
    noisy = condition in ("noise", "leaving") or not course.has_odometry
    made = journeys(records, longest=longest, kidnap=condition == "kidnapping", seed=seed)
    for number in thin(range(len(made)), starts, seed):
        journey = made[number]
        references = course.references(journey)
        begin = records[journey.positions[journey.jump or 0]].pose
        if not is_mapped(references, begin):
            yield None
            continue
        inside = _within(records, journey, references)
        if _length(records, inside) < _SHORTEST:
            yield None
            continue
        journey = journey if condition == "leaving" else inside
        told = odometry(records, journey, _NOISE if noisy else 0.0, seed)
        yield Departure(number, journey, references, told)


def _measured(
    course: Course,
    condition: str,
    name: str,
    starts: int | None,
    longest: float,
    seed: int,
    what: str,
    progress: ProgressOf,
) -> Outcome | None:
    records = course.asked.records
    prepared = _Prepared(FOLLOWERS[name])
    recoveries, steps, outside = [], list[Answer](), 0
    made = departures(course, condition, starts, longest=longest, seed=seed)
    for departure in progress(made, what, starts):
        if departure is None:
            outside += 1
            continue
        journey, told = departure.journey, departure.odometry
        answers = follow(records, journey, told, prepared.follower(departure.references))
        recoveries.append(recovery(records, journey, answers))
        steps += answers
    if not recoveries:
        return None
    seconds = sorted(step.seconds for step in steps)
    named = [step for step in steps if step.pose is not None]
    return Outcome(
        course.place,
        condition,
        name,
        summary(recoveries),
        outside,
        seconds[len(seconds) // 2],
        seconds[int(0.99 * len(seconds))],
        reliability([step.probability for step in named], [step.is_correct for step in named]),
    )


class _Prepared:
    """Keeps what was made of the latest references, since journeys may share them."""

    def __init__(self, prepare: Prepare) -> None:
        self._prepare = prepare
        self._known: tuple[int, ...] | None = None
        self._make: Callable[[], Follower] | None = None

    def follower(self, references: Sequence[Reference]) -> Follower:
        known = tuple(reference.identifier for reference in references)
        if self._make is None or known != self._known:
            self._known, self._make = known, self._prepare(references)
        return self._make()


def _within(
    records: Sequence[Record], journey: Journey, references: Sequence[Reference]
) -> Journey:
    """End a journey where no reference has been near it for a while."""
    left, before = 0.0, None
    for index in range(journey.jump or 0, len(journey.positions)):
        pose = records[journey.positions[index]].pose
        if pose is None or is_mapped(references, pose):
            left = 0.0
        elif before is not None:
            left += before.distance(pose)
        if left > _LEFT:
            return Journey(journey.positions[:index], journey.jump)
        before = pose
    return journey


def _length(records: Sequence[Record], journey: Journey) -> float:
    """Metres that a journey drives from its start or its jump on."""
    poses = [records[position].pose for position in journey.positions[journey.jump or 0 :]]
    known = [pose for pose in poses if pose is not None]
    return sum(a.distance(b) for a, b in pairwise(known))


def is_mapped(references: Sequence[Reference], pose: Pose2D | None) -> bool:
    """Tell whether a reference was taken within 2 m and 45 degrees of a pose."""
    return pose is not None and any(
        each.pose is not None
        and each.pose.distance(pose) <= _NEAR
        and each.pose.turn(pose) <= _ALIKE
        for each in references
    )


def _fresh(scan: LaserScan) -> LaserScan:
    """Give the scan as a new value: nothing derived may be left over in it."""
    return LaserScan(
        scan.ranges, scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max
    )


def _fewer(one: int | None, other: int | None) -> int | None:
    numbers = [number for number in (one, other) if number is not None]
    return min(numbers) if numbers else None


_HEADER = (
    "P5 lost robot: no prior, scans and odometry in order\n"
    f"{'place':<18} {'condition':<10} {'method':<10} {'starts':>6} {'found':>6} "
    f"{'metres: median':>14} {'90 %':>6} {'ever wrong':>10} {'2 m off':>7} "
    f"{'withdrawn':>9} {'ms a step':>9}"
)


def _line(one: Outcome) -> str:
    figures = one.figures
    withdrawn = "" if math.isnan(figures.withdrawn) else f"{figures.withdrawn:.3f}"
    return (
        f"{one.place:<18} {one.condition:<10} {one.follower:<10} {figures.journeys:>6} "
        f"{figures.found:>6.3f} {figures.driven_median:>14.1f} {figures.driven_90:>6.1f} "
        f"{figures.was_wrong:>10.3f} {figures.was_far:>7.3f} "
        f"{withdrawn:>9} {1e3 * one.step_median:>9.2f}"
    )


_STEPS_HEADER = (
    "All steps by the probability reported: how many, and which share was right\n"
    f"{'place':<18} {'condition':<10} {'method':<10}"
    + "".join(f"{f'{low / 10:.1f} ..':>12}" for low in range(10))
)


def _steps_line(one: Outcome) -> str:
    bins = zip(one.reliability.counts.tolist(), one.reliability.accuracy.tolist(), strict=True)
    cells = "".join(f"{count:>7} {share:>4.2f}" if count else " " * 12 for count, share in bins)
    return f"{one.place:<18} {one.condition:<10} {one.follower:<10}{cells}".rstrip()


def _kept(outcomes: Sequence[Outcome], folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "lost-robot.json"
    rows = [
        {
            **asdict(one),
            "figures": {
                name: None if math.isnan(value) else value
                for name, value in asdict(one.figures).items()
            },
            "reliability": {
                name: [None if math.isnan(each) else each for each in values.tolist()]
                for name, values in asdict(one.reliability).items()
                if name != "error"
            },
        }
        for one in outcomes
    ]
    path.write_text(json.dumps(rows, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return path
