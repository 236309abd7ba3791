"""Planar poses and the transforms between frames.

A pose is the transform that carries points of a *source* frame into a *target*
frame; variables say so: ``T_target_source``.  Frames follow REP-103: x forward,
y left, theta counter-clockwise, metres and radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Pose2D", "wrap_angle"]


def wrap_angle(angle: float) -> float:
    """Return ``angle`` (radians) wrapped into (-pi, pi]."""
    wrapped = math.remainder(angle, 2.0 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped


@dataclass(frozen=True, slots=True)
class Pose2D:
    """A rigid motion of the plane, ``T_target_source``.

    Args:
        x: Translation along the target's x axis, metres.
        y: Translation along the target's y axis, metres.
        theta: Rotation, radians; stored wrapped into (-pi, pi].
    """

    x: float = 0.0
    y: float = 0.0
    theta: float = 0.0

    def __post_init__(self) -> None:
        is_plain = type(self.x) is type(self.y) is type(self.theta) is float
        if is_plain and -math.pi < self.theta <= math.pi:
            return
        object.__setattr__(self, "x", float(self.x))
        object.__setattr__(self, "y", float(self.y))
        theta = float(self.theta)
        object.__setattr__(self, "theta", wrap_angle(theta) if math.isfinite(theta) else math.nan)

    @classmethod
    def from_array(cls, values: ArrayLike) -> Pose2D:
        """Build a pose from ``(3,)`` values x, y, theta.

        Raises:
            ValueError: The input has not exactly three values.
        """
        array = np.asarray(values, dtype=np.float64)
        if array.shape != (3,):
            raise ValueError(f"a pose has three values x, y, theta, not shape {array.shape}")
        return cls(*array.tolist())

    def to_array(self) -> NDArray[np.float64]:
        """Return ``(3,)`` values x, y, theta."""
        return np.array([self.x, self.y, self.theta])

    def __matmul__(self, other: Pose2D) -> Pose2D:
        """Chain transforms: ``T_a_c = T_a_b @ T_b_c``."""
        c, s = math.cos(self.theta), math.sin(self.theta)
        return Pose2D(
            self.x + c * other.x - s * other.y,
            self.y + s * other.x + c * other.y,
            self.theta + other.theta,
        )

    def inverse(self) -> Pose2D:
        """Return ``T_source_target``."""
        c, s = math.cos(self.theta), math.sin(self.theta)
        return Pose2D(-c * self.x - s * self.y, s * self.x - c * self.y, -self.theta)

    def apply(self, points: ArrayLike) -> NDArray[np.float64]:
        """Carry ``(N, 2)`` points (metres) from the source frame into the target frame."""
        array = np.asarray(points, dtype=np.float64)
        c, s = math.cos(self.theta), math.sin(self.theta)
        moved: NDArray[np.float64] = array @ np.array([[c, s], [-s, c]]) + (self.x, self.y)
        return moved

    def distance(self, other: Pose2D) -> float:
        """Return the distance between the two positions, metres."""
        return math.hypot(self.x - other.x, self.y - other.y)

    def turn(self, other: Pose2D) -> float:
        """Return the smallest rotation between the two headings, radians in [0, pi]."""
        return abs(wrap_angle(self.theta - other.theta))

    def is_finite(self) -> bool:
        """Tell whether all three values are finite."""
        return math.isfinite(self.x) and math.isfinite(self.y) and math.isfinite(self.theta)
