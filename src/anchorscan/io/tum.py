"""Trajectories in TUM format: ``time x y z qx qy qz qw`` a line, seconds and metres."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

from ..errors import LogError
from ..pose import Pose2D

__all__ = ["write_tum"]


def write_tum(path: str | Path, poses: Iterable[tuple[float, Pose2D]]) -> int:
    """Write planar poses as a TUM trajectory, which evo and most SLAM tools read.

    A place that is not known is left out, not written as zero.

    Args:
        path: The file to write.
        poses: Time (seconds) and pose of whatever frame the caller follows, in order.

    Returns:
        Number of poses written.

    Raises:
        LogError: The file cannot be written.
    """
    count = 0
    try:
        with Path(path).open("w", encoding="ascii") as stream:
            for stamp, pose in poses:
                half = 0.5 * pose.theta
                stream.write(
                    f"{stamp:.9f} {pose.x:.9f} {pose.y:.9f} 0 "
                    f"0 0 {math.sin(half):.12f} {math.cos(half):.12f}\n"
                )
                count += 1
    except OSError as error:
        raise LogError(f"cannot be written: {error.strerror}", path) from None
    return count
