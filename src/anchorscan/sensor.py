"""The laser scanner as a model: where it looks, how far, and how it errs.

Used wherever scans are made rather than read: by the ray casting in occupancy grids and
by the simulator of buildings.  Angles follow REP-103, special values REP-117.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .errors import ScanError
from .pose import Pose2D
from .scan import LaserScan

__all__ = ["SensorModel"]


@dataclass(frozen=True)
class SensorModel:
    """A planar laser scanner and its place on the robot.

    Args:
        field_of_view: Angle from the first to the last reading, radians, symmetric about
            the laser's x axis; a full turn has no reading twice.
        resolution: Angle between readings, radians, positive.
        range_min: Shortest range that it reports, metres; nearer is ``-inf``.
        range_max: Longest range that it reports, metres.
        noise: Standard deviation of a range, metres.
        relative_noise: Standard deviation that grows with the range, as a share of it.
        dropout: Share of readings lost at random.
        clockwise: It turns clockwise: readings come in falling order of angle.
        upside_down: It hangs upside down and the scan says so: seen from above, the sense
            of rotation is the other one.
        mirrored: It hangs upside down and the scan does not say so: the scan shows the
            mirror image of the world.
        mounting: ``T_base_laser``.
        no_return_value: What it reports when nothing is within reach, metres or special.
        dropout_value: What it reports for a lost reading, metres or special.

    Raises:
        ScanError: A value is impossible.
    """

    field_of_view: float = math.pi
    resolution: float = math.radians(1.0)
    range_min: float = 0.05
    range_max: float = 30.0
    noise: float = 0.01
    relative_noise: float = 0.0
    dropout: float = 0.0
    clockwise: bool = False
    upside_down: bool = False
    mirrored: bool = False
    mounting: Pose2D = Pose2D()
    no_return_value: float = math.inf
    dropout_value: float = math.nan

    def __post_init__(self) -> None:
        if not 0.0 < self.field_of_view <= 2.0 * math.pi + 1e-9:
            raise ScanError(f"a field of view of {self.field_of_view} rad is not in (0, 2 pi]")
        if not 0.0 < self.resolution <= self.field_of_view:
            raise ScanError(f"an angular resolution of {self.resolution} rad is impossible")
        if not 0.0 <= self.range_min < self.range_max < math.inf:
            raise ScanError(f"range limits are out of order: {self.range_min} to {self.range_max}")
        if not (self.noise >= 0.0 and self.relative_noise >= 0.0 and 0.0 <= self.dropout <= 1.0):
            raise ScanError("noise must not be negative and the dropout must lie in [0, 1]")

    @cached_property
    def _is_full_turn(self) -> bool:
        return self.field_of_view > 2.0 * math.pi - 0.5 * self.resolution

    @cached_property
    def count(self) -> int:
        """Readings in a scan."""
        steps = round(self.field_of_view / self.resolution)
        return steps if self._is_full_turn else steps + 1

    @cached_property
    def angle_increment(self) -> float:
        """Angle from a reading to the next, radians; negative when it sweeps clockwise."""
        steps = round(self.field_of_view / self.resolution)
        turn = 2.0 * math.pi if self._is_full_turn else self.field_of_view
        return math.copysign(turn / steps, -1.0 if self.clockwise != self.upside_down else 1.0)

    @cached_property
    def angle_min(self) -> float:
        """Direction of the first reading, radians, laser frame."""
        half = math.pi if self._is_full_turn else 0.5 * self.field_of_view
        return math.copysign(half, -self.angle_increment)

    @cached_property
    def sweep(self) -> tuple[float, float]:
        """Where it truly looks: angle of the first reading and step to the next, radians."""
        sign = -1.0 if self.mirrored else 1.0
        return sign * self.angle_min, sign * self.angle_increment

    def measure(
        self, distances: NDArray[np.float64], rng: np.random.Generator | None = None
    ) -> LaserScan:
        """Turn exact distances into the scan that this sensor would report.

        Args:
            distances: (count,) metres to the first surface along every reading,
                ``inf`` where there is none.
            rng: Source of noise and dropouts; None leaves both out.

        Raises:
            ScanError: There is not one distance per reading.
        """
        if distances.shape != (self.count,):
            raise ScanError(f"{self.count} readings need as many distances: {distances.shape}")
        ranges = distances.astype(np.float64)
        if rng is not None and (self.noise > 0.0 or self.relative_noise > 0.0):
            ranges += self._deviation(ranges) * rng.standard_normal(self.count)
        too_near = ranges < self.range_min
        too_far = ranges > self.range_max
        ranges[too_near] = -math.inf
        ranges[too_far] = self.no_return_value
        if rng is not None and self.dropout > 0.0:
            ranges[rng.random(self.count) < self.dropout] = self.dropout_value
        return LaserScan(
            ranges.astype(np.float32),
            self.angle_min,
            self.angle_increment,
            self.range_min,
            self.range_max,
        )

    def _deviation(self, distances: NDArray[np.float64]) -> NDArray[np.float64] | float:
        if self.relative_noise == 0.0:
            return self.noise
        finite = np.where(np.isfinite(distances), distances, 0.0)
        return np.asarray(np.hypot(self.noise, self.relative_noise * finite))
