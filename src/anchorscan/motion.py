"""How a robot moved between two scans, by odometry or, without it, within a bound.

The paper leaves motion to the filter that its hypotheses feed.  Odometry of real robots is
biased: raw logs turn four degrees a metre too far, so the spread of the heading grows with the
way driven as well as with the turns made.  Wheels start again from zero, messages get lost and
clocks jump; a step that no robot could have made is taken for no odometry at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from .pose import Pose2D

__all__ = ["Motion", "MotionSettings", "Odometer", "motion", "new_share"]


class MotionSettings(BaseModel):
    """How far odometry can be trusted, and how far a robot gets without it."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    position_deviation: float = Field(0.01, gt=0.0, description="of every step, metres")
    heading_deviation: float = Field(0.005, gt=0.0, description="of every step, radians")
    stretch: float = Field(0.1, ge=0.0, description="metres of deviation per metre driven")
    slip: float = Field(0.05, ge=0.0, description="metres of deviation per radian turned")
    drift: float = Field(0.1, ge=0.0, description="radians of deviation per metre driven")
    skid: float = Field(0.1, ge=0.0, description="radians of deviation per radian turned")
    speed: float = Field(0.5, gt=0.0, description="deviation without odometry, metres a second")
    turn_speed: float = Field(
        0.5, gt=0.0, description="deviation without odometry, radians a second"
    )
    interval: float = Field(0.5, gt=0.0, description="between scans without a stamp, seconds")
    longest_interval: float = Field(
        2.0, gt=0.0, description="from here on a gap counts as no longer, seconds"
    )
    longest_step: float = Field(
        5.0, gt=0.0, description="a longer step of the odometry is none, metres"
    )


@dataclass(frozen=True, eq=False)
class Motion:
    """A step from one scan to the next.

    Args:
        step: ``T_before_now`` of the laser, or of the two lasers that took the scans.
        covariance: (3, 3) of x, y (metres) and theta (radians) of the step, frame of the laser.
        driven: Metres, by the robot's base; without odometry what is to be expected.
        turned: Radians; without odometry what is to be expected.
        measured: Whether odometry told.
    """

    step: Pose2D
    covariance: NDArray[np.float64]
    driven: float
    turned: float
    measured: bool


def motion(
    before: Pose2D | None, now: Pose2D | None, elapsed: float | None, settings: MotionSettings
) -> Motion:
    """Return the step between two scans, of what odometry is told of: the base or the laser.

    Args:
        before: ``T_odom_base`` at the scan before, where known.
        now: The same at this scan.
        elapsed: Seconds between them where known; what is negative or not finite is not.
        settings: How far to trust it.
    """
    if before is not None and now is not None and now.is_finite() and before.is_finite():
        step = before.inverse() @ now
        driven, turned = math.hypot(step.x, step.y), abs(step.theta)
        if driven <= settings.longest_step:
            position = settings.position_deviation
            position += settings.stretch * driven + settings.slip * turned
            heading = settings.heading_deviation
            heading += settings.drift * driven + settings.skid * turned
            return Motion(step, _diagonal(position, heading), driven, turned, True)
    seconds = settings.interval
    if elapsed is not None and math.isfinite(elapsed) and elapsed >= 0.0:
        seconds = min(elapsed, settings.longest_interval)
    driven, turned = settings.speed * seconds, settings.turn_speed * seconds
    covariance = _diagonal(
        settings.position_deviation + driven, settings.heading_deviation + turned
    )
    return Motion(Pose2D(), covariance, driven, turned, False)


def _diagonal(position: float, heading: float) -> NDArray[np.float64]:
    return np.diag(np.square((position, position, heading)))


class Alike(Protocol):
    """How far scans that follow each other err together."""

    @property
    def way_alike(self) -> float: ...
    @property
    def turn_alike(self) -> float: ...
    @property
    def still(self) -> float: ...


def new_share(driven: float, turned: float, alike: Alike) -> float:
    """Return how much of a scan's evidence is new after a way (metres) and a turn (radians)."""
    return min(driven / alike.way_alike + turned / alike.turn_alike + alike.still, 1.0)


class Odometer:
    """Tells of every scan how the robot moved since the one before.

    How far it drove and turned, and how sure that is, are those of its base: a scan that another
    laser of the same robot took is no motion, however far that one is from the first.

    Args:
        settings: How far to trust odometry.

    Attributes:
        latest: ``T_odom_laser`` of the latest scan, where known.
    """

    def __init__(self, settings: MotionSettings) -> None:
        self._settings = settings
        self.latest: Pose2D | None = None
        self._base: Pose2D | None = None
        self._T_base_laser: Pose2D | None = None
        self._stamp: float | None = None

    def step(
        self, odometry: Pose2D | None, stamp: float | None, T_base_laser: Pose2D = Pose2D()
    ) -> Motion:
        """Return the step to the next scan; what is not finite is taken for unknown.

        Args:
            odometry: ``T_odom_laser``, where known.
            stamp: Seconds on any clock, where known.
            T_base_laser: Where the laser that took the scan sits.
        """
        elapsed = None if stamp is None or self._stamp is None else stamp - self._stamp
        base = None if odometry is None else odometry @ T_base_laser.inverse()
        of_base = motion(self._base, base, elapsed, self._settings)
        before = T_base_laser if self._T_base_laser is None else self._T_base_laser
        self.latest = odometry if odometry is None or odometry.is_finite() else None
        self._base, self._T_base_laser = base, T_base_laser
        self._stamp = stamp if stamp is None or math.isfinite(stamp) else None
        return replace(of_base, step=before.inverse() @ of_base.step @ T_base_laser)
