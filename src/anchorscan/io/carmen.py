"""CARMEN logs: ``FLASER``, ``RLASER`` and ``ROBOTLASER1`` lines among others.

**Geometry.**  ``ROBOTLASER1`` carries its own.  ``FLASER`` has none: it follows from
``PARAM laser_front_laser_resolution`` or else from the number of readings, where that number
means one sensor.  Any other number is a problem that asks for ``field_of_view``, because a
wrong guess would give a wrong pose.

**Limit.**  80 m unless the log says less (``max_range``, ``PARAM robot_front_laser_max``) or
the caller says otherwise.

**Poses.**  ``x y theta`` is the corrected pose of the **laser**.  ``odom_x odom_y odom_theta``
is the pose of the **robot** by odometry, as CARMEN's logger writes it; it is carried to the
laser by ``PARAM robot_frontlaser_offset``, ``.._side_offset`` and ``.._angular_offset`` (a rear
laser looks backwards unless they say otherwise).  Where a log has no such lines, both are taken
to be the laser's.  Logs of published benchmarks whose odometry is the laser's have none.

A **raw** log, in which ``x y theta`` is uncorrected odometry too, looks exactly like a corrected
one; ``pose_columns="odometry"`` says that it is one.  What else the columns may lack is told
in `survey`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal

from ..errors import LogError, ScanError
from ..pose import Pose2D
from ..record import Record
from ..scan import LaserScan
from .geometry import RANGE_MAX, geometry_of
from .log import Log, Report
from .scan_line import SCAN_KINDS, BadLine, ScanLine, parse_laser, parse_robot_laser
from .survey import Survey
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


class CarmenLog(Log):
    """A CARMEN log.

    Args:
        text: The log.
        field_of_view: Angle that the readings cover, radians, instead of the geometry that the
            log says or suggests.
        range_max: From this range on a reading is no return, metres, instead of the log's.
        pose_columns: What ``x y theta`` holds: the corrected pose of the laser, or, in a raw
            log, its pose by odometry.

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
    ) -> None:
        super().__init__(text.path)
        self._text = text
        self._field_of_view = field_of_view
        self._range_max = range_max
        self._pose_columns = pose_columns
        self._survey, self.count = self._look_through()

    def _look_through(self) -> tuple[Survey, int]:
        survey, parameters = Survey(), _Parameters()
        count, usable = 0, False
        complaints: list[tuple[int, str]] = []

        def complain(number: int, reason: str) -> None:
            del complaints[1:]
            complaints.append((number, reason))

        for line in self._scan_lines(complain, parameters):
            count += 1
            if isinstance(line, ScanLine):
                survey.add(line, parameters.mounting(line.kind))
                usable = usable or self._scan(line, parameters, complain) is not None
        if usable:
            return survey, count
        if complaints:
            number, reason = complaints[0]
            raise LogError(f"no readable laser scan: {reason}", self.path, number)
        raise LogError("no laser scan in it (FLASER, RLASER or ROBOTLASER1 line)", self.path)

    def _read(self, report: Report) -> Iterator[Record]:
        has_poses, has_odometry = self._survey.has_poses, self._survey.has_odometry
        has_stamps = self._survey.has_stamps
        parameters = _Parameters()
        for index, line in enumerate(self._scan_lines(report, parameters)):
            source = f"{self.path}:{line.number}"
            if isinstance(line, BadLine):
                yield Record(index, None, source=source, problem=line.reason)
                continue
            reasons: list[str] = []
            scan = self._scan(line, parameters, lambda _, reason: reasons.append(reason))  # noqa: B023
            if has_poses and line.laser is None:
                reasons.append("the pose is not finite")
            for reason in reasons:
                report(line.number, reason)
            pose = line.laser if has_poses else None
            odometry = None
            if self._pose_columns == "odometry":
                pose, odometry = None, pose
            elif has_odometry and line.robot is not None:
                odometry = line.robot @ parameters.mounting(line.kind)
            yield Record(
                index,
                scan,
                pose,
                odometry,
                line.stamp if has_stamps else None,
                source,
                reasons[0] if scan is None else "",
            )

    def _scan_lines(self, report: Report, parameters: _Parameters) -> Iterator[ScanLine | BadLine]:
        unknown: set[bytes] = set()
        tail_length: int | None = None
        for number, line in self._text.lines(report):
            kind = line.split(maxsplit=1)[0]
            if kind == b"PARAM":
                parameters.add(line)
            elif kind in SCAN_KINDS:
                try:
                    if kind == b"ROBOTLASER1":
                        yield parse_robot_laser(number, line)
                        continue
                    parsed = parse_laser(number, line, tail_length)
                    tail_length = parsed.tail_length
                    yield parsed
                except ValueError as error:
                    report(number, str(error))
                    yield BadLine(number, str(error))
            elif kind not in _OTHER_KINDS and not kind.startswith(b"#") and kind not in unknown:
                if _is_kind(kind):
                    unknown.add(kind)
                    report(number, f"unknown kind of line {shown(kind)}, left out throughout")
                else:
                    report(number, f"not a line of a CARMEN log: {shown(line)}")

    def _scan(self, line: ScanLine, parameters: _Parameters, report: Report) -> LaserScan | None:
        try:
            geometry = line.geometry
            if geometry is None or self._field_of_view is not None:
                said = geometry.range_max if geometry else parameters.range_max(line.kind)
                geometry = geometry_of(
                    len(line.ranges),
                    field_of_view=self._field_of_view,
                    resolution=parameters.resolution(line.kind),
                    range_max=said,
                )
            return line.scan(geometry, self._range_max)
        except (ValueError, ScanError) as error:
            report(line.number, str(error))
            return None


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

    def resolution(self, kind: bytes) -> float | None:
        """Angle between readings, radians."""
        value = self._values.get(b"laser_%b_laser_resolution" % _side(kind), 0.0)
        return math.radians(value) if value > 0.0 else None

    def range_max(self, kind: bytes) -> float:
        """From this range on a reading is no return, metres."""
        value = self._values.get(b"robot_%b_laser_max" % _side(kind), RANGE_MAX)
        return value if 0.0 < value < RANGE_MAX else RANGE_MAX

    def mounting(self, kind: bytes) -> Pose2D:
        """``T_base_laser``; the identity (turned around for a rear laser) where not told."""
        name = b"robot_%blaser" % _side(kind)
        return Pose2D(
            self._values.get(name + b"_offset", 0.0),
            self._values.get(name + b"_side_offset", 0.0),
            self._values.get(name + b"_angular_offset", math.pi if kind == b"RLASER" else 0.0),
        )


def _side(kind: bytes) -> bytes:
    return b"rear" if kind == b"RLASER" else b"front"


def _is_kind(word: bytes) -> bool:
    return word[:1].isalpha() and word.replace(b"_", b"").isalnum() and word.isupper()
