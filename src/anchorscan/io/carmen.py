"""CARMEN logs: ``FLASER``, ``RLASER`` and ``ROBOTLASER1`` lines among others.

**Geometry.**  ``ROBOTLASER1`` carries its own.  ``FLASER`` has none: it follows from the
number of readings, where that number means one sensor, and from ``PARAM
laser_front_laser_resolution`` (``.._fov``) otherwise.  Any other number is a problem that asks
for ``field_of_view``, because a wrong guess would give a wrong pose.

**Limit.**  80 m unless the log says less (``max_range``, ``PARAM robot_front_laser_max``) or
the caller says otherwise.

**Poses.**  ``x y theta`` is the corrected pose of the **laser**.  ``odom_x odom_y odom_theta``
is the pose of the **robot** by odometry, as CARMEN's logger writes it; it is carried to the
laser by ``PARAM robot_frontlaser_offset``, ``.._side_offset`` and ``.._angular_offset`` (a rear
laser looks backwards unless they say otherwise).  In a log without such lines it is taken to be
the laser's, which is what logs without a header hold.

A **raw** log, in which ``x y theta`` is uncorrected odometry too, looks exactly like a corrected
one; ``pose_columns="odometry"`` says that it is one.  How columns that nobody filled in are
noticed is told in `survey`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Literal

from ..pose import Pose2D
from .geometry import RANGE_MAX, ScanGeometry, geometry_of
from .line_log import LineLog
from .log import Report
from .scan_line import SCAN_KINDS, BadLine, ScanLine, parse_laser, parse_robot_laser
from .text import TextFile, shown

__all__ = ["KINDS", "CarmenLog", "PoseColumns"]

PoseColumns = Literal["corrected", "odometry"]

_OTHER_KINDS = frozenset(
    b"PARAM SYNC ODOM NEFF TRUEPOS RAWLASER1 RAWLASER2 RAWLASER3 RAWLASER4 RAWLASER5 "
    b"ROBOTLASER0 ROBOTLASER2 ROBOTLASER3 ROBOTLASER4 ROBOTLASER5 LASER3 LASER4 LASER5 "
    b"LASER_READING MARKER SCANMARK POSITIONLASER VECTORMOVE ROBOTVELOCITY FOLLOWTRAJECTORY "
    b"BASEVELOCITY SONAR BUMPER IMU NMEAGGA NMEARMC ODO_UPDATE SM_UPDATE RESAMPLE ENTROPY".split()
)
KINDS = SCAN_KINDS | _OTHER_KINDS
"""First words of the lines of CARMEN logs."""

_FULL_TURN = 2.0 * math.pi
_WHOLE = 0.01


class CarmenLog(LineLog):
    """A CARMEN log.

    Args:
        text: The log.
        field_of_view: Angle that the readings cover, radians, instead of the geometry that the
            log says or suggests.
        range_max: From this range on a reading is no return, metres, instead of the log's.
        pose_columns: What ``x y theta`` holds: the corrected pose of the laser, or, in a raw
            log, its pose by odometry.
        T_base_laser: Where the laser sits on the robot, instead of what the log says.

    Raises:
        LogError: The log has no scan that can be read.
    """

    format = "CARMEN"

    def __init__(
        self,
        text: TextFile,
        *,
        field_of_view: float | None = None,
        range_max: float | None = None,
        pose_columns: PoseColumns = "corrected",
        T_base_laser: Pose2D | None = None,
    ) -> None:
        self._field_of_view = field_of_view
        self._T_base_laser = T_base_laser
        super().__init__(text, range_max=range_max, has_corrected_poses=pose_columns == "corrected")

    def _scan_lines(self, report: Report) -> Iterator[ScanLine | BadLine]:
        parameters = _Parameters()
        unknown: set[bytes] = set()
        for number, line in self._text.lines(report):
            kind = line.split(maxsplit=1)[0]
            if kind in SCAN_KINDS:
                yield self._parse(number, kind, line, parameters)
            elif kind == b"PARAM":
                parameters.add(line)
            elif kind not in _OTHER_KINDS and not kind.startswith(b"#") and kind not in unknown:
                if _is_kind(kind):
                    unknown.add(kind)
                    report(number, f"unknown kind of line {shown(kind)}, left out throughout")
                else:
                    report(number, f"not a line of a CARMEN log: {shown(line)}")

    def _parse(
        self, number: int, kind: bytes, line: bytes, parameters: _Parameters
    ) -> ScanLine | BadLine:
        try:
            if kind == b"ROBOTLASER1":
                parsed = parse_robot_laser(number, line, self._field_of_view)
                return replace(parsed, mounting=self._T_base_laser)
            geometry = partial(parameters.geometry, kind, self._field_of_view)
            mounting = self._T_base_laser or parameters.mounting(kind)
            return replace(parse_laser(number, line, geometry), mounting=mounting)
        except ValueError as error:
            return BadLine(number, str(error))


class _Parameters:
    """What the ``PARAM`` lines so far say about the lasers."""

    def __init__(self) -> None:
        self._values: dict[bytes, float] = {}

    def add(self, line: bytes) -> None:
        words = line.split(maxsplit=3)
        if len(words) > 2 and b"laser" in words[1]:
            try:
                value = float(words[2])
            except ValueError:
                return
            if math.isfinite(value):
                self._values[words[1]] = value

    def geometry(self, kind: bytes, field_of_view: float | None, count: int) -> ScanGeometry:
        """Return the geometry of ``count`` readings of the laser behind a kind of line.

        Raises:
            ValueError: Nothing is known and the number does not tell.
        """
        name = b"laser_%b_laser" % _side(kind)
        resolution = math.radians(self._values.get(name + b"_resolution", 0.0))
        covered = self._values.get(name + b"_fov", 0.0)
        if covered > _FULL_TURN + _WHOLE:
            covered = math.radians(covered)
        limit = self._values.get(b"robot_%b_laser_max" % _side(kind), RANGE_MAX)
        return geometry_of(
            count,
            field_of_view=field_of_view,
            resolution=resolution if resolution > 0.0 else None,
            # Both together are trusted more than what the number suggests, one alone less.
            is_certain=resolution > 0.0
            and min(abs(covered / resolution - steps) for steps in (count, count - 1)) < 1.0,
            range_max=limit if 0.0 < limit < RANGE_MAX else RANGE_MAX,
        )

    def mounting(self, kind: bytes) -> Pose2D | None:
        """Return ``T_base_laser``, or None where the log does not tell."""
        name = b"robot_%blaser" % _side(kind)
        if name + b"_offset" not in self._values:
            return None
        return Pose2D(
            self._values[name + b"_offset"],
            self._values.get(name + b"_side_offset", 0.0),
            self._values.get(name + b"_angular_offset", math.pi if kind == b"RLASER" else 0.0),
        )


def _side(kind: bytes) -> bytes:
    return b"rear" if kind == b"RLASER" else b"front"


def _is_kind(word: bytes) -> bool:
    return word[:1].isalpha() and word.replace(b"_", b"").isalnum() and word.isupper()
