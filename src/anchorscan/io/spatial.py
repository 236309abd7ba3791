"""Rigid motions in space, as ROS carries them, and what is left of them in the plane.

A motion is a (4, 4) matrix ``T_target_source``; a sample of one is seven numbers, translation
and quaternion ``x y z qx qy qz qw``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..pose import Pose2D

__all__ = ["from_pose", "inverse", "matrix_of", "planar", "tilt"]

_SHORTEST_QUATERNION = 1e-6


def matrix_of(sample: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the (4, 4) matrix of a (7,) sample, or None where it is no motion."""
    length = float(np.linalg.norm(sample[3:]))
    if not np.isfinite(sample).all() or not length > _SHORTEST_QUATERNION:
        return None
    x, y, z, w = (sample[3:] / length).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), sample[0]],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), sample[1]],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), sample[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def from_pose(pose: Pose2D) -> NDArray[np.float64]:
    """Return the (4, 4) matrix of a planar pose."""
    c, s = math.cos(pose.theta), math.sin(pose.theta)
    motion = np.eye(4)
    motion[:2, :2] = [[c, -s], [s, c]]
    motion[:2, 3] = pose.x, pose.y
    return motion


def inverse(motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``T_source_target`` of a (4, 4) ``T_target_source``."""
    rotation = motion[:3, :3].T
    result = np.eye(4)
    result[:3, :3] = rotation
    result[:3, 3] = -rotation @ motion[:3, 3]
    return result


def planar(motion: NDArray[np.float64]) -> Pose2D:
    """Return where the source's origin lies and where its x axis points, seen from above."""
    return Pose2D(float(motion[0, 3]), float(motion[1, 3]), math.atan2(motion[1, 0], motion[0, 0]))


def tilt(motion: NDArray[np.float64]) -> float:
    """Return the angle between the two z axes, radians in [0, pi]."""
    return math.acos(max(-1.0, min(1.0, float(motion[2, 2]))))
