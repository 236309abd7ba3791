"""g2o files: the ``ROBOTLASER1`` line that follows a ``VERTEX_SE2`` is the scan taken there.

The vertex is the optimised pose of the **robot**; the two poses of the scan line tell where
the laser sits on it: ``T_map_laser = T_map_base @ inverse(T_odom_base) @ T_odom_laser``.
The scan line's poses are the odometry where they are another trajectory than the vertices'.
Edges and parameters are not needed and not looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from ..pose import Pose2D
from .line_log import LineLog
from .log import Report
from .scan_line import BadLine, ScanLine, parse_robot_laser
from .text import TextFile, shown

__all__ = ["KINDS", "G2oLog"]

KINDS = frozenset({b"VERTEX_SE2", b"EDGE_SE2", b"FIX"})
"""First words by which a g2o file is told from other text."""

_VERTEX_WORDS = 5


class G2oLog(LineLog):
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
        self._field_of_view = field_of_view
        super().__init__(text, range_max=range_max)

    def _scan_lines(self, report: Report) -> Iterator[ScanLine | BadLine]:
        vertex: Pose2D | None = None
        for number, line in self._text.lines(report):
            kind = line.split(maxsplit=1)[0]
            if kind == b"VERTEX_SE2":
                vertex = _vertex(line)
                if vertex is None:
                    report(number, f"not a vertex: {shown(line)}")
            elif kind == b"ROBOTLASER1":
                try:
                    parsed = parse_robot_laser(number, line, self._field_of_view)
                    yield _placed(parsed, vertex)
                except ValueError as error:
                    yield BadLine(number, str(error))
            elif not (kind.startswith(b"#") or (kind[:1].isalpha() and kind.isupper())):
                report(number, f"not a line of a g2o file: {shown(line)}")


def _vertex(line: bytes) -> Pose2D | None:
    words = line.split()
    if len(words) != _VERTEX_WORDS:
        return None
    try:
        pose = Pose2D(*map(float, words[2:]))
    except ValueError:
        return None
    return pose if pose.is_finite() else None


def _placed(line: ScanLine, vertex: Pose2D | None) -> ScanLine:
    """Return the line with the pose that the vertex gives its laser."""
    if vertex is None or line.laser is None or line.robot is None:
        return replace(line, laser=None)
    # Not by way of the inverse where it can be avoided: the vertex keeps its last digit.
    if line.laser == line.robot:
        return replace(line, laser=vertex, mounting=Pose2D())
    mounting = line.robot.inverse() @ line.laser
    return replace(line, laser=vertex @ mounting, mounting=mounting)
