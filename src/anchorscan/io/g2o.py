"""g2o files: the ``ROBOTLASER1`` line that follows a ``VERTEX_SE2`` is the scan taken there.

The vertex is the optimised pose of the **robot**; the two poses of the scan line tell where
the laser sits on it: ``T_map_laser = T_map_robot @ inverse(T_odom_robot) @ T_odom_laser``.
``T_odom_laser`` is the odometry where it is another trajectory than the vertices'.
Edges and parameters are not needed and not looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from ..errors import LogError, ScanError
from ..pose import Pose2D
from ..record import Record
from ..scan import LaserScan
from .geometry import geometry_of
from .log import Log, Report
from .scan_line import BadLine, ScanLine, parse_robot_laser
from .survey import Survey
from .text import TextFile, shown

__all__ = ["KINDS", "G2oLog"]

KINDS = frozenset({b"VERTEX_SE2", b"EDGE_SE2", b"FIX"})
"""First words by which a g2o file is told from other text."""

_VERTEX_WORDS = 5


class G2oLog(Log):
    """A g2o file with laser scans.

    Args:
        text: The file.
        field_of_view: Angle that the readings cover, radians, instead of the file's geometry.
        range_max: From this range on a reading is no return, metres, instead of the file's.

    Raises:
        LogError: The file has no scan that can be read.
    """

    format = "g2o"

    def __init__(
        self,
        text: TextFile,
        *,
        field_of_view: float | None = None,
        range_max: float | None = None,
    ) -> None:
        super().__init__(text.path)
        self._text = text
        self._field_of_view = field_of_view
        self._range_max = range_max
        self._survey, self.count = self._look_through()

    def _look_through(self) -> tuple[Survey, int]:
        survey = Survey()
        count, usable = 0, False
        complaints: list[tuple[int, str]] = []

        def complain(number: int, reason: str) -> None:
            del complaints[1:]
            complaints.append((number, reason))

        for vertex, line in self._scan_lines(complain):
            count += 1
            if isinstance(line, ScanLine):
                poses = replace(line, laser=_laser_pose(vertex, line), robot=line.laser)
                survey.add(poses, Pose2D())
                usable = usable or self._scan(line, complain) is not None
        if usable:
            return survey, count
        if complaints:
            number, reason = complaints[0]
            raise LogError(f"no readable laser scan: {reason}", self.path, number)
        raise LogError("a pose graph without laser scans (ROBOTLASER1 lines)", self.path)

    def _read(self, report: Report) -> Iterator[Record]:
        survey = self._survey
        has_poses, has_odometry = survey.has_poses, survey.has_odometry
        for index, (vertex, line) in enumerate(self._scan_lines(report)):
            source = f"{self.path}:{line.number}"
            if isinstance(line, BadLine):
                yield Record(index, None, source=source, problem=line.reason)
                continue
            reasons: list[str] = []
            scan = self._scan(line, lambda _, reason: reasons.append(reason))  # noqa: B023
            pose = _laser_pose(vertex, line)
            if has_poses and pose is None:
                reasons.append("the scan has no pose (no VERTEX_SE2 before it, or not finite)")
            for reason in reasons:
                report(line.number, reason)
            yield Record(
                index,
                scan,
                pose if has_poses else None,
                line.laser if has_odometry else None,
                line.stamp if survey.has_stamps else None,
                source,
                reasons[0] if scan is None else "",
            )

    def _scan_lines(self, report: Report) -> Iterator[tuple[Pose2D | None, ScanLine | BadLine]]:
        vertex: Pose2D | None = None
        for number, line in self._text.lines(report):
            kind = line.split(maxsplit=1)[0]
            if kind == b"VERTEX_SE2":
                vertex = _vertex(line)
                if vertex is None:
                    report(number, f"not a vertex: {shown(line)}")
            elif kind == b"ROBOTLASER1":
                try:
                    yield vertex, parse_robot_laser(number, line)
                except ValueError as error:
                    report(number, str(error))
                    yield vertex, BadLine(number, str(error))
            elif not (kind.startswith(b"#") or (kind[:1].isalpha() and kind.isupper())):
                report(number, f"not a line of a g2o file: {shown(line)}")

    def _scan(self, line: ScanLine, report: Report) -> LaserScan | None:
        try:
            geometry = line.geometry
            if geometry is None or self._field_of_view is not None:
                geometry = geometry_of(len(line.ranges), field_of_view=self._field_of_view)
            return line.scan(geometry, self._range_max)
        except (ValueError, ScanError) as error:
            report(line.number, str(error))
            return None


def _vertex(line: bytes) -> Pose2D | None:
    words = line.split()
    if len(words) != _VERTEX_WORDS:
        return None
    try:
        pose = Pose2D(*map(float, words[2:]))
    except ValueError:
        return None
    return pose if pose.is_finite() else None


def _laser_pose(vertex: Pose2D | None, line: ScanLine) -> Pose2D | None:
    if vertex is None:
        return None
    if line.laser is None or line.robot is None:
        return None
    if line.laser == line.robot:
        return vertex
    return vertex @ line.robot.inverse() @ line.laser
