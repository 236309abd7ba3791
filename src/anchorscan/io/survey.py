"""One look through a whole log: which of its columns say anything.

A log has the same columns whether anybody filled them in or not:

* poses that are zero in every one of several records, or that stand still while the other
  column or the scans show motion, were never filled in: the log has none;
* odometry that goes with the pose, a fixed offset apart, is one trajectory written twice, as in
  corrected logs: the log has the poses and no odometry;
* a time that is zero in every record is no time.
"""

from __future__ import annotations

import math
from statistics import median

from ..pose import Pose2D
from .scan_line import ScanLine

__all__ = ["Survey"]

# How much must change before a column that stands still is disbelieved.
_MOVED_DISTANCE = 0.5
_MOVED_ANGLE = math.radians(30.0)
_CHANGED_RANGE = 0.25
# Poses that differ by less than the printed digits are one, metres and radians.
_SAME = 2e-3
_DAMAGED = 0.01
# Ways in which the columns may differ; more than one, as the first line may be the damaged one.
_KEPT_RELATIVES = 3


class Survey:
    """What the columns of a log hold, gathered line by line."""

    def __init__(self) -> None:
        self.count = 0
        self._poses = _Column()
        self._odometry = _Column()
        self._first: ScanLine | None = None
        self._change = 0.0
        self._has_stamps = False
        # The first few ways in which the columns differ, and how many lines differ so.
        self._relatives: list[Pose2D] = []
        self._alike: list[int] = []
        self._compared = 0

    def add(self, line: ScanLine) -> None:
        """Count one scan line."""
        self.count += 1
        self._poses.add(line.laser)
        self._odometry.add(line.robot)
        self._has_stamps = self._has_stamps or bool(line.stamp)
        if line.laser is not None and line.robot is not None:
            self._add_relative(line.robot.inverse() @ line.laser)
        if not (self._poses.moves and self._odometry.moves):
            self._compare(line)

    @property
    def is_one_trajectory(self) -> bool:
        """Whether poses and odometry are one trajectory, perhaps of two places on the robot."""
        # A damaged number here and there does not make a second trajectory.
        return self._compared - max(self._alike, default=0) <= _DAMAGED * self.count

    @property
    def relative(self) -> Pose2D | None:
        """``T_base_laser`` as the columns have it, where they are one trajectory of two bodies."""
        if not self.is_one_trajectory or not self._relatives:
            return None
        relative = self._relatives[self._alike.index(max(self._alike))]
        # Two equal columns may be those of one body as well as of two that coincide.
        return None if _is_same(relative, Pose2D()) else relative

    @property
    def has_poses(self) -> bool:
        """Whether the pose column was filled in."""
        return self._poses.is_filled(motion_seen=self._odometry.is_drive or self._scans_change)

    @property
    def has_odometry(self) -> bool:
        """Whether the odometry column was filled in, with something else than the poses."""
        return not self.is_one_trajectory and self._odometry.is_filled(
            motion_seen=self._poses.is_drive or self._scans_change
        )

    @property
    def has_stamps(self) -> bool:
        """Whether the time column was filled in."""
        return self._has_stamps

    @property
    def _scans_change(self) -> bool:
        return self._change > _CHANGED_RANGE

    def _add_relative(self, relative: Pose2D) -> None:
        """Count a line as one of those whose columns differ alike."""
        self._compared += 1
        for number, known in enumerate(self._relatives):
            if _is_same(relative, known):
                self._alike[number] += 1
                return
        if len(self._relatives) < _KEPT_RELATIVES:
            self._relatives.append(relative)
            self._alike.append(1)

    def _compare(self, line: ScanLine) -> None:
        """Keep how far the readings of a laser that claims to stand still have changed."""
        if self._first is None or len(self._first.ranges) != len(line.ranges):
            self._first = line
        elif not self._scans_change:
            try:
                pairs = zip(map(float, self._first.ranges), map(float, line.ranges), strict=True)
                steps = [abs(a - b) for a, b in pairs if math.isfinite(a - b)]
            except ValueError:
                return
            # People walking past change some readings; driving changes most of them.
            self._change = median(steps) if steps else 0.0


class _Column:
    """One pose column."""

    def __init__(self) -> None:
        self.moves = False
        self.is_drive = False
        self._first: Pose2D | None = None
        self._count = 0

    def add(self, pose: Pose2D | None) -> None:
        if pose is None:
            return
        self._count += 1
        if self._first is None:
            self._first = pose
        elif not self.is_drive:
            self.moves = self.moves or pose != self._first
            distance, turn = pose.distance(self._first), pose.turn(self._first)
            self.is_drive = distance > _MOVED_DISTANCE or turn > _MOVED_ANGLE

    def is_filled(self, *, motion_seen: bool) -> bool:
        if self._first == Pose2D() and not self.moves and self._count > 1:
            return False
        return self._count > 0 and (self.moves or not motion_seen)


def _is_same(a: Pose2D, b: Pose2D) -> bool:
    return a.distance(b) < _SAME and a.turn(b) < _SAME
