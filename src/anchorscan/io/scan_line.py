"""The scan lines of CARMEN logs, which g2o files share.

The message formats are those of the header that CARMEN's logger writes::

    FLASER n r1 .. rn  x y theta  odom_x odom_y odom_theta  time host logger_time
    ROBOTLASER1 type start field_of_view resolution max_range accuracy remission_mode
        n r1 .. rn  m s1 .. sm  laser_x laser_y laser_theta  robot_x robot_y robot_theta
        tv rv forward_safety side_safety turn_axis  time host logger_time

A line counts as a whole or not at all: its words must add up to the numbers that it promises,
so that a reading is never taken for a pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..pose import Pose2D
from ..scan import LaserScan
from .geometry import ScanGeometry, geometry_of, make_scan
from .text import shown

__all__ = ["SCAN_KINDS", "BadLine", "ScanLine", "parse_laser", "parse_robot_laser"]

SCAN_KINDS = frozenset({b"FLASER", b"RLASER", b"ROBOTLASER1"})

_POSE_LENGTH = 3
# Behind the readings: two poses; perhaps a time; perhaps host and logger time too.
_LASER_TAILS = (9, 6, 7)
_ROBOT_LASER_HEADER = 9
_ROBOT_LASER_TAIL = 14
_LONGEST_COUNT = 12


@dataclass(frozen=True)
class ScanLine:
    """A scan line whose numbers add up; the ranges are still words.

    Args:
        number: Its number in the file, from one.
        kind: First word of the line.
        ranges: (N,) words.
        laser: ``T_map_laser``, None where it is not finite.
        robot: ``T_odom_base``, None where it is not finite.
        stamp: Seconds, where the line has them.
        geometry: Where the readings look.
        tail_length: Number of words behind the readings.
        mounting: ``T_base_laser``, where the log tells.
    """

    number: int
    kind: bytes
    ranges: Sequence[bytes]
    laser: Pose2D | None
    robot: Pose2D | None
    stamp: float | None
    geometry: ScanGeometry
    tail_length: int
    mounting: Pose2D | None = None

    def scan(self, range_max: float | None = None) -> LaserScan:
        """Make the scan.

        Args:
            range_max: The sensor's limit instead of the geometry's, metres.

        Raises:
            ValueError: There are no readings, or one is not a number.
            ScanError: The geometry is impossible.
        """
        if not self.ranges:
            raise ValueError("the scan has no readings")
        values = np.array(_numbers(self.ranges, "a range"))
        return make_scan(values, self.geometry, range_max=range_max)


@dataclass(frozen=True)
class BadLine:
    """A scan line that cannot be read.

    Args:
        number: Its number in the file, from one.
        reason: Why.
    """

    number: int
    reason: str


def parse_laser(number: int, line: bytes, geometry: Callable[[int], ScanGeometry]) -> ScanLine:
    """Read a ``FLASER`` or ``RLASER`` line.

    Args:
        number: Its number in the file.
        line: The line.
        geometry: Gives the geometry of a number of readings, or raises ValueError.

    Raises:
        ValueError: The line is malformed; the message says how.
    """
    words = line.split()
    tail_at = 2 + _count(words, 1)
    tail = words[tail_at:]
    if len(tail) not in _LASER_TAILS:
        raise ValueError(
            f"promises {tail_at - 2} readings and {_LASER_TAILS[0]} words behind them, "
            f"but holds {len(words) - 2} words"
        )
    values = _numbers(tail[:7], "a pose or the time")
    return ScanLine(
        number,
        words[0],
        words[2:tail_at],
        _pose(values[:_POSE_LENGTH]),
        _pose(values[_POSE_LENGTH : 2 * _POSE_LENGTH]),
        _stamp(values[2 * _POSE_LENGTH :]),
        geometry(tail_at - 2),
        len(tail),
    )


def parse_robot_laser(number: int, line: bytes, field_of_view: float | None = None) -> ScanLine:
    """Read a ``ROBOTLASER1`` line.

    Args:
        number: Its number in the file.
        line: The line.
        field_of_view: Angle that the readings cover, radians, instead of the line's geometry.

    Raises:
        ValueError: The line is malformed; the message says how.
    """
    words = line.split()
    remissions_at = _ROBOT_LASER_HEADER + _count(words, _ROBOT_LASER_HEADER - 1)
    tail_at = remissions_at + 1 + _count(words, remissions_at)
    if len(words) != tail_at + _ROBOT_LASER_TAIL:
        raise ValueError(
            f"promises {remissions_at - _ROBOT_LASER_HEADER} readings and "
            f"{tail_at - remissions_at - 1} remissions, which makes "
            f"{tail_at + _ROBOT_LASER_TAIL} words, but holds {len(words)}"
        )
    start, _, resolution, range_max = _numbers(words[2:6], "the geometry")
    geometry = ScanGeometry(start, resolution, range_max=range_max)
    if field_of_view is not None:
        count = remissions_at - _ROBOT_LASER_HEADER
        geometry = geometry_of(count, field_of_view=field_of_view, range_max=range_max)
    values = _numbers(words[tail_at : tail_at + 2 * _POSE_LENGTH], "a pose")
    return ScanLine(
        number,
        words[0],
        words[_ROBOT_LASER_HEADER:remissions_at],
        _pose(values[:_POSE_LENGTH]),
        _pose(values[_POSE_LENGTH:]),
        _stamp(_numbers(words[-3:-2], "the time")),
        geometry,
        _ROBOT_LASER_TAIL,
    )


def _count(words: Sequence[bytes], at: int) -> int:
    if at >= len(words):
        raise ValueError("the line ends before a number of readings")
    word = words[at]
    # int() would also take "1_0", and spend minutes on a megabyte of digits.
    if not word.isdigit() or len(word) > _LONGEST_COUNT:
        if word.isdigit():
            raise ValueError(f"promises {shown(word)} readings but holds {len(words) - at - 1}")
        raise ValueError(f"the number of readings is {shown(word)}")
    count = int(word)
    if count > len(words) - at - 1:
        raise ValueError(f"promises {count} readings but holds {len(words) - at - 1} words")
    return count


def _numbers(words: Sequence[bytes], what: str) -> list[float]:
    try:
        if b"_" in b"".join(words):  # which float() would take as a separator of thousands
            raise ValueError
        return list(map(float, words))
    except ValueError:
        bad = next(word for word in words if not _is_number(word))
        raise ValueError(f"{what} is not a number: {shown(bad)}") from None


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return b"_" not in word


def _pose(values: Sequence[float]) -> Pose2D | None:
    pose = Pose2D(*values)
    return pose if pose.is_finite() else None


def _stamp(values: Sequence[float]) -> float | None:
    return values[0] if values and math.isfinite(values[0]) else None
