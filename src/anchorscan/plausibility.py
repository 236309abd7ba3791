"""Data that is well formed and yet cannot be meant: units, clocks, and lasers upside down.

A reader takes what is written.  Here a whole recording is looked at for what no robot does:

* every reading beyond the sensor's limit, or walls hundreds of metres away: millimetres;
* steps of tens of metres from scan to scan: positions in millimetres;
* headings that have nothing to do with where the robot drives: degrees.  Robots drive along one
  axis; twice the angle between heading and step is then nearly constant, however the laser is
  mounted, and the length of its mean direction is 0.53 to 0.98 on the logs that this was tried
  with, but 0.02 to 0.30 on the same with their headings in degrees;
* times that repeat or run backwards;
* scans that fit the map only as their mirror image: a laser that hangs upside down;
* scans that fit the map only when all their readings are so many times as long: a map of another
  scale.

All but the last two need nothing but the recording.  One scan cannot tell these: a room on the left
of a corridor is the mirror image of one on the right, and a small office has the shape of a large
one.  Several scans can.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice
from statistics import median
from typing import Protocol

from .hypothesis import Hypothesis
from .pose import Pose2D
from .record import Record
from .scan import LaserScan

__all__ = [
    "MirrorCheck",
    "MirrorWatch",
    "Plausibility",
    "ScaleCheck",
    "mirror_check",
    "scale_check",
    "scaled_scan",
]

_FEWEST = 5
_MOST_STEPS = 10_000
# Metres: no hall is as wide, and no robot drives as far between two scans.
_WIDE_RANGE, _LONG_STEP = 150.0, 20.0
# Steps of this length, metres, tell where a robot drives; so many, and so constant an angle.
_SHORT_STEP, _NEAR_STEP = 0.05, 1.5
_FEWEST_STEPS, _LEAST_CONSTANT = 30, 0.4
# Scans that are asked both ways, of so many at the beginning.
_LOOKED_AT, _ASKED = 400, 24
# A scan so far from another, metres, is of another place; where nobody knows, so many later.
_ELSEWHERE, _EVERY = 0.5, 16
_MIRRORED_SHARE = 0.7
# A third of the scans: more do not fit a map of quite another scale, fewer do not tell one.
_THIRD = 1.0 / 3.0
# Scales that are tried, as logarithms; a scan is located within two or three hundredths of its own.
_LARGEST_SCALE, _SCALE_STEP, _FINE_STEP = 2.2, 0.02, 0.005
_NEAR_SCALES, _NEAR_STEPS = 0.06, 0.01
# The cells of a map, and how thick its walls are drawn, may well be some thousandths off.
_ALIKE_SCALES = 0.02
# Other scales are tried with every so many-th of the scans first.
_SOME = 2


class Plausibility:
    """Looks at the records of one recording as they go by, and holds a few numbers of them."""

    def __init__(self) -> None:
        self._scans = self._with_return = 0
        self._limit = 0.0
        self._ranges: list[float] = []
        self._steps: list[float] = []
        self._courses: list[complex] = []
        self._before: Record | None = None
        self._stamp: float | None = None
        self._stamps = self._repeated = self._reversed = 0
        self._first_wrong = 0

    def add(self, record: Record) -> None:
        """Look at the next record."""
        if record.scan is not None:
            self._add_scan(record.scan)
        self._add_poses(record)
        self._add_stamp(record)

    def doubts(self) -> list[str]:
        """Return what cannot be meant, a line each."""
        found = []
        if self._scans >= _FEWEST and not self._with_return:
            found.append(
                f"no reading of its {self._scans} scans lies within the sensor's limit of "
                f"{self._limit:g} m: are ranges in millimetres?"
            )
        elif self._ranges and median(self._ranges) > _WIDE_RANGE:
            found.append(
                f"half of the readings are longer than {median(self._ranges):.0f} m: are ranges in "
                "millimetres?"
            )
        if len(self._steps) >= _FEWEST and median(self._steps) > _LONG_STEP:
            found.append(
                f"poses jump by {median(self._steps):.0f} m from scan to scan: are they in "
                "millimetres?"
            )
        courses = self._courses
        if len(courses) >= _FEWEST_STEPS and abs(sum(courses)) < _LEAST_CONSTANT * len(courses):
            found.append(
                "headings have nothing to do with where the robot drives: are they in degrees, not "
                "radians, or does it drive in any direction?"
            )
        if wrong := self._repeated + self._reversed:
            found.append(
                f"{wrong} of {self._stamps} times do not follow the one before ({self._repeated} "
                f"repeated, {self._reversed} backwards), the first at scan {self._first_wrong}"
            )
        return found

    def _add_scan(self, scan: LaserScan) -> None:
        self._scans += 1
        self._limit = max(self._limit, scan.range_max)
        returns = scan.ranges[scan.is_return]
        if len(returns):
            self._with_return += 1
            if len(self._ranges) < _MOST_STEPS:
                self._ranges.append(float(returns[len(returns) // 2]))

    def _add_poses(self, record: Record) -> None:
        """Look at the step from the record before, in one frame: that of poses, or odometry."""
        before, self._before = self._before, record
        if before is None:
            return
        if before.pose is not None and record.pose is not None:
            self._add_step(before.pose, record.pose)
        elif before.odometry is not None and record.odometry is not None:
            self._add_step(before.odometry, record.odometry)

    def _add_step(self, before: Pose2D, pose: Pose2D) -> None:
        if len(self._steps) >= _MOST_STEPS:
            return
        step = pose.distance(before)
        if step > 0.0:
            self._steps.append(step)
            if _SHORT_STEP < step < _NEAR_STEP:
                course = math.atan2(pose.y - before.y, pose.x - before.x) - before.theta
                self._courses.append(complex(math.cos(2.0 * course), math.sin(2.0 * course)))

    def _add_stamp(self, record: Record) -> None:
        if record.stamp is None:
            return
        self._stamps += 1
        if self._stamp is not None and record.stamp <= self._stamp:
            self._first_wrong = self._first_wrong or record.index
            self._repeated += record.stamp == self._stamp
            self._reversed += record.stamp < self._stamp
        self._stamp = record.stamp


class _Places(Protocol):
    """What can say where a scan was taken: a matcher or a reference set."""

    def locate(self, scan: LaserScan) -> list[Hypothesis]: ...


@dataclass(frozen=True)
class MirrorCheck:
    """How many scans fit as they are, and how many as their mirror image.

    Args:
        as_given: Scans that are located, and fit at least as well as their mirror image.
        mirrored: Scans whose mirror image is located, and fits better.
    """

    as_given: int
    mirrored: int

    def with_scan(self, places: _Places, scan: LaserScan) -> MirrorCheck:
        """Return what is found with one more scan, located both ways."""
        here, there = places.locate(scan)[:1], places.locate(scan.upside_down())[:1]
        if not (here and there):
            return self
        if there[0].score > here[0].score:
            return replace(self, mirrored=self.mirrored + there[0].accepted)
        return replace(self, as_given=self.as_given + here[0].accepted)

    def __str__(self) -> str:
        """As the middle of a message."""
        fitting = self.as_given + self.mirrored
        share = f"{self.mirrored} of {fitting} that fit at all"
        return f"its scans fit the set as their mirror images ({share})"

    @property
    def is_mirrored(self) -> bool:
        """Whether the scans are mirrored, beyond reasonable doubt."""
        fitting = self.as_given + self.mirrored
        return self.mirrored >= _FEWEST and self.mirrored >= _MIRRORED_SHARE * fitting


def mirror_check(places: _Places, records: Iterable[Record]) -> MirrorCheck:
    """Locate some scans of the beginning of a recording, each also as its mirror image.

    Args:
        places: Where they are sought.
        records: The recording, from its beginning.
    """
    scans = [record.scan for record in islice(records, _LOOKED_AT) if record.scan is not None]
    found = MirrorCheck(0, 0)
    for scan in scans[:: max(1, len(scans) // _ASKED)]:
        found = found.with_scan(places, scan)
    return found


class MirrorWatch:
    """Asks of a robot on the move whether its laser hangs upside down and nobody said so.

    Scans that were taken half a metre apart, by odometry, or one of sixteen where there is none,
    are located both ways, until two dozen of them are: some milliseconds each, and then none.

    Args:
        places: Where they are sought.

    Attributes:
        found: What was found so far.
    """

    def __init__(self, places: _Places) -> None:
        self._places = places
        self.reset()

    def reset(self) -> None:
        """Know nothing of the laser."""
        self.found = MirrorCheck(0, 0)
        self._last: Pose2D | None = None
        self._unasked = _EVERY

    def add(self, scan: LaserScan, odometry: Pose2D | None = None) -> None:
        """Look at the next scan; odometry is of the base, or always of the same laser."""
        if self._is_done or not self._is_elsewhere(odometry):
            return
        self._last, self._unasked = odometry, 0
        self.found = self.found.with_scan(self._places, scan)

    @property
    def is_doubtful(self) -> bool:
        """Whether answers must not be trusted, as far as is known now."""
        if self._is_done:
            return self.found.is_mirrored
        return self.found.mirrored > self.found.as_given

    @property
    def _is_done(self) -> bool:
        return self.found.as_given + self.found.mirrored >= _ASKED

    def _is_elsewhere(self, odometry: Pose2D | None) -> bool:
        """Tell whether the scan says something that the one asked last does not."""
        if odometry is not None and self._last is not None:
            return self._last.distance(odometry) >= _ELSEWHERE
        self._unasked += 1
        return self._unasked >= _EVERY


@dataclass(frozen=True)
class ScaleCheck:
    """How many scans fit as they are, and how many when they are made longer or shorter.

    Args:
        asked: Scans that were asked.
        as_given: Those of them that are located as they are.
        scale: By how much all readings must be longer for them to fit best.
        scaled: Scans that are located then.
    """

    asked: int
    as_given: int
    scale: float
    scaled: int

    @property
    def is_scaled(self) -> bool:
        """Whether map and scans are of different scales, beyond reasonable doubt."""
        enough = self.scaled >= max(_FEWEST, _THIRD * self.asked)
        better = self.as_given <= (self.scaled if self._is_near else _THIRD * self.scaled)
        return abs(self.scale - 1.0) > _ALIKE_SCALES and enough and better

    @property
    def _is_near(self) -> bool:
        return abs(math.log(self.scale)) < _NEAR_SCALES + _FINE_STEP


def scale_check(places: _Places, scans: Iterable[LaserScan]) -> ScaleCheck:
    """Locate some scans of the beginning of a recording at other scales, too.

    Scales within 6 % are always tried, and the best is that of the highest scores; it takes some
    four hundred queries.  Where few scans are located at any of these, scales from 0.45 to 2.2 are
    tried, with about a thousand.

    Args:
        places: Where they are sought.
        scans: Of the recording, from its beginning.
    """
    scans = list(islice(scans, _LOOKED_AT))
    scans = scans[:: max(1, len(scans) // _ASKED)]
    as_given, _ = _fitting(places, scans, 1.0)
    if len(scans) < _FEWEST:
        return ScaleCheck(len(scans), as_given, 1.0, as_given)
    near, _ = _best_scored(places, scans, _scales(1.0, _NEAR_SCALES, _NEAR_STEPS))
    near, located = _best_scored(places, scans, _scales(near, _NEAR_STEPS, _FINE_STEP))
    if as_given > _THIRD * len(scans) or located > _THIRD * len(scans):
        return ScaleCheck(len(scans), as_given, near, located)
    some = scans[::_SOME]
    wide = _scales(1.0, math.log(_LARGEST_SCALE), _SCALE_STEP)
    scale = max(wide, key=lambda each: _fitting(places, some, each))
    scale, _ = _best_scored(places, some, _scales(scale, _SCALE_STEP, _FINE_STEP))
    return ScaleCheck(len(scans), as_given, scale, _fitting(places, scans, scale)[0])


def _scales(middle: float, reach: float, step: float) -> list[float]:
    """Scales about a middle one, at equal steps of their logarithm."""
    steps = int(reach / step + 0.5)
    return [middle * math.exp(step * k) for k in range(-steps, steps + 1)]


def _best_scored(places: _Places, scans: list[LaserScan], scales: list[float]) -> tuple[float, int]:
    """Return the scale of the highest scores, and how many scans are located at it."""
    fitting = {scale: _fitting(places, scans, scale) for scale in scales}
    best = max(scales, key=lambda scale: fitting[scale][1])
    return best, fitting[best][0]


def _fitting(places: _Places, scans: Iterable[LaserScan], scale: float) -> tuple[int, float]:
    """Count the scans that are located at a scale, and add the scores of all."""
    best = [each for scan in scans for each in places.locate(scaled_scan(scan, scale))[:1]]
    return sum(each.accepted for each in best), sum(each.score for each in best)


def scaled_scan(scan: LaserScan, scale: float) -> LaserScan:
    """Return what the same laser would see in a building so many times as large."""
    geometry = (scan.angle_min, scan.angle_increment, scale * scan.range_min)
    return LaserScan(scale * scan.ranges, *geometry, scale * scan.range_max)
