"""``anchorscan endure day``: a day of a robot in fast motion, and what grows with it.

A robot's whole path is used, from stamped odometry and scans to reports (`Robot`, `Localizer`),
lap after lap through the same drives on one clock that goes on.  Between two drives, and between
two laps, the robot is carried away and its odometry begins anew, so that it is lost and found
again in every lap.

Every lap does the same work.  So what a lap costs must not depend on how many were before it:
memory, and processor time a step, are compared over the laps by a straight line, whose slope is
told with its standard error.  The first lap, in which kernels are compiled and caches are filled,
is left out.
"""

from __future__ import annotations

import gc
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from .errors import AnchorscanError
from .localizer import Localizer
from .pose import Pose2D
from .progress import ProgressOf
from .protocol import is_correct
from .record import Record
from .reference_set import ReferenceSet
from .robot import Report, Robot

__all__ = ["Lap", "Trend", "day", "drive_lap", "memory", "run", "trend"]

Item = TypeVar("Item")

_SECONDS = 3600.0
# Fewer laps make no line with an error.
_FEWEST_LAPS = 4
# So many standard errors above zero are a growth.
_SURE = 3.0


@dataclass(frozen=True)
class Lap:
    """One lap through all drives.

    Args:
        hours: Of the robot, at its end.
        seconds: Processor time a step, mean.
        memory: Resident bytes of the process at its end.
        objects: That Python's garbage collector follows, at its end.
        located: Share of the steps at which the robot was located.
        wrong: Share of the steps at which it was located wrongly.
    """

    hours: float
    seconds: float
    memory: int
    objects: int
    located: float
    wrong: float


@dataclass(frozen=True)
class Trend:
    """A straight line through measured values.

    Args:
        mean: Of the values.
        slope: Per unit of the abscissa.
        error: Standard error of the slope.
    """

    mean: float
    slope: float
    error: float

    @property
    def grows(self) -> bool:
        """Whether the slope is above zero by more than chance explains."""
        return self.slope > _SURE * self.error


def run(
    places: ReferenceSet,
    drives: Sequence[Sequence[Record]],
    hours: float,
    rate: float,
    say: Callable[[str], None],
    progress: ProgressOf,
) -> list[Lap]:
    """Drive for some hours of robot time, and say what grew.

    Args:
        places: The map.
        drives: In its frame, with poses and odometry.
        hours: Of the robot.
        rate: Scans a second.
        say: Takes the lines.
        progress: Wraps the laps.

    Raises:
        AnchorscanError: There is nothing to drive, or too little for a line.
    """
    laps = day(places, drives, hours, rate, progress)
    at = [lap.hours for lap in laps]
    say(
        f"{at[-1]:.1f} hours of a robot at {rate:g} scans a second: {len(laps)} laps, the first "
        "left out below"
    )
    figures = (
        ("memory", "MB", [lap.memory / 1e6 for lap in laps]),
        ("objects", "thousand", [lap.objects / 1e3 for lap in laps]),
        ("processor time a step", "ms", [1e3 * lap.seconds for lap in laps]),
    )
    for name, unit, values in figures:
        found = trend(at[1:], values[1:])
        verdict = "GROWS" if found.grows else "no growth"
        say(
            f"{name}: {found.mean:.3f} {unit}, slope {found.slope:+.5f} +- {found.error:.5f} "
            f"{unit} an hour: {verdict}"
        )
    say(
        f"located {100.0 * laps[0].located:.1f} % of the steps in the first lap and "
        f"{100.0 * laps[-1].located:.1f} % in the last, of all steps wrongly "
        f"{100.0 * laps[0].wrong:.2f} % and {100.0 * laps[-1].wrong:.2f} %"
    )
    return laps


def day(
    places: ReferenceSet,
    drives: Sequence[Sequence[Record]],
    hours: float,
    rate: float,
    progress: ProgressOf = lambda items, what, total=None: items,
) -> list[Lap]:
    """Drive for some hours of robot time, in whole laps; arguments as for `run`."""
    usable = [[record for record in drive if record.scan is not None] for drive in drives]
    steps = sum(map(len, usable))
    count = math.ceil(hours * _SECONDS * rate / max(steps, 1))
    if not steps or count < _FEWEST_LAPS:
        raise AnchorscanError(
            f"{count} laps of {steps} scans make no line: ask for more hours, or a shorter drive"
        )
    places.prepare()
    robot = Robot(Localizer(places))
    # Made beforehand, so that what is noted of a lap is no object that a lap leaves behind.
    costs = np.zeros((count, 5))
    for number in progress(range(count), "driving", count):
        start = time.process_time()
        located, wrong = drive_lap(robot, usable, number * steps / rate, rate)
        seconds = (time.process_time() - start) / steps
        gc.collect()
        costs[number] = seconds, memory(), len(gc.get_objects()), located / steps, wrong / steps
    hours_a_lap = steps / rate / _SECONDS
    return [
        Lap((number + 1) * hours_a_lap, seconds, int(size), int(objects), *shares)
        for number, (seconds, size, objects, *shares) in enumerate(costs.tolist())
    ]


def drive_lap(
    robot: Robot, drives: Sequence[Sequence[Record]], begin: float, rate: float
) -> tuple[int, int]:
    """Drive one lap; give at how many steps the robot was located, and located wrongly.

    Args:
        robot: That keeps its belief from lap to lap.
        drives: With usable scans and with poses.
        begin: Time of the first scan, seconds.
        rate: Scans a second.
    """
    located = wrong = step = 0
    for drive in drives:
        for record in drive:
            stamp = begin + step / rate
            step += 1
            odometry = record.odometry or record.pose
            if odometry is not None:
                robot.odometry.add(stamp, odometry)
            assert record.scan is not None
            report = robot.take(record.scan, stamp)
            if report is not None and report.state == "located":
                located += 1
                wrong += not _is_right(report, record.pose)
    return located, wrong


def trend(at: ArrayLike, values: ArrayLike) -> Trend:
    """Fit a straight line by least squares.

    Args:
        at: (N,) abscissas, N of 3 or more.
        values: (N,) what was measured there.
    """
    x, y = np.asarray(at, np.float64), np.asarray(values, np.float64)
    centred = x - x.mean()
    spread = float(centred @ centred)
    slope = float(centred @ y) / spread
    rest = y - y.mean() - slope * centred
    error = math.sqrt(float(rest @ rest) / (len(x) - 2) / spread)
    return Trend(float(y.mean()), slope, error)


def memory() -> int:
    """Return the resident bytes of this process; the most so far where the system tells no more."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        import resource

        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most if sys.platform == "darwin" else 1024 * most
    import resource

    return pages * resource.getpagesize()


def _is_right(report: Report, truth: Pose2D | None) -> bool:
    found = report.T_map_base
    if found is None or truth is None:
        return truth is None
    return is_correct(found, truth)
