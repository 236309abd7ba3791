"""What a log holds per scan: the scan, and the poses and the time where they are known."""

from __future__ import annotations

from dataclasses import dataclass

from .pose import Pose2D
from .scan import LaserScan

__all__ = ["Record"]


@dataclass(frozen=True, eq=False)
class Record:
    """One scan record of a log, as every reader yields it.

    Args:
        index: Position among the log's scan records, from zero; unusable scans count.
        scan: The laser scan, or None when the record could not be made into one.
        pose: ``T_map_laser``, the corrected pose of the **laser** where the log has one.
        odometry: ``T_odom_laser``, the pose of the **laser** by odometry where known.
        stamp: Seconds, on the log's own clock, where known.
        source: File and line (or topic and message) that it came from, for messages.
        problem: Why ``scan`` is None.
        T_base_laser: Where the laser sits on the robot, where the log tells; with it
            ``T_map_base = pose @ T_base_laser.inverse()``.
    """

    index: int
    scan: LaserScan | None
    pose: Pose2D | None = None
    odometry: Pose2D | None = None
    stamp: float | None = None
    source: str = ""
    problem: str = ""
    T_base_laser: Pose2D | None = None
