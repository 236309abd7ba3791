"""Trajectories in TUM format: ``time x y z qx qy qz qw`` a line, seconds and metres."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

from ..errors import LogError
from ..pose import Pose2D
from .text import TextFile, shown
from .trajectory import Trajectory
from .whole_file import writing

__all__ = ["read_tum", "write_tum"]

_COLUMNS = 8


def read_tum(text: TextFile) -> tuple[Trajectory, tuple[tuple[int, str], ...]]:
    """Read a TUM trajectory; commas may stand for spaces, and ``#`` begins a comment.

    Args:
        text: The file.

    Returns:
        The trajectory, and number and reason of the first malformed lines.

    Raises:
        LogError: The file has no pose that can be read.
    """
    trajectory = Trajectory()
    problems: list[tuple[int, str]] = []

    def report(number: int, reason: str) -> None:
        if len(problems) < 1000:
            problems.append((number, reason))

    for number, line in text.lines(report):
        if line.startswith(b"#"):
            continue
        try:
            values = tuple(map(float, line.replace(b",", b" ").split()))
        except ValueError:
            values = ()
        if len(values) != _COLUMNS or not trajectory.add(values[0], values[1:]):
            report(number, f"not a TUM pose (time x y z qx qy qz qw): {shown(line)}")
    if not len(trajectory):
        if not problems:
            raise LogError("not a trajectory: there is no pose in it", text.path)
        raise LogError(f"not a trajectory: {problems[0][1]}", text.path, problems[0][0])
    return trajectory, tuple(problems)


def write_tum(path: str | Path, poses: Iterable[tuple[float, Pose2D]]) -> int:
    """Write planar poses as a TUM trajectory, which evo and most SLAM tools read.

    A place that is not known is left out, not written as zero.

    Args:
        path: The file to write, which appears when it is whole.
        poses: Time (seconds) and pose of whatever frame the caller follows, in order.

    Returns:
        Number of poses written.

    Raises:
        LogError: The file cannot be written, or a pose is not finite.
    """
    count = 0
    with writing(path) as stream:
        for stamp, pose in poses:
            if not (math.isfinite(stamp) and pose.is_finite()):
                raise LogError(f"pose {count} is not finite, so it is not written", path)
            half = 0.5 * pose.theta
            stream.write(
                f"{stamp:.9f} {pose.x:.9f} {pose.y:.9f} 0 "
                f"0 0 {math.sin(half):.12f} {math.cos(half):.12f}\n"
            )
            count += 1
    return count
