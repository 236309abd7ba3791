"""The laser scan: ranges over angles, with the fields and the validity rules of ROS.

Fields are those of ``sensor_msgs/LaserScan``; special values follow REP-117:
``+inf`` is "nothing within reach" (free space is known), ``-inf`` is "too close",
NaN is "no information".  A reading is a *return* when
``range_min <= range <= range_max``, which NaN fails, and no longer than 10 km: what a message
claims beyond that no laser has measured, and following such a ray through a map would take hours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import ScanError

__all__ = ["LaserScan"]

# So many readings may be missing to a full turn: some sensors leave out the one that would
# complete it, and rounding of the increment takes a little more.
_CLOSING_SLACK = 1.5
# Longer readings, metres, are errors in the message, whatever its limit says.
_LONGEST = 1e4
# A smaller angle between readings, radians, is no angle but an error in the message.
_SMALLEST_INCREMENT = 1e-9


@dataclass(frozen=True, eq=False)
class LaserScan:
    """One 2D laser scan in the frame of the laser.

    Reading ``i`` looks along ``angle_min + i * angle_increment`` (radians about +z,
    zero along +x).  A negative increment is a sensor that turns clockwise.

    Args:
        ranges: (N,) metres; stored as a read-only float32 copy, as ROS carries them.
        angle_min: Direction of the first reading, radians.
        angle_increment: Angle between readings, radians, not zero.
        range_min: Shortest range that counts, metres.
        range_max: Longest range that counts, metres.

    Raises:
        ScanError: ``ranges`` is not one-dimensional, the geometry is not finite, the
            increment is zero, or the limits are out of order.
    """

    ranges: NDArray[np.float32]
    angle_min: float
    angle_increment: float
    range_min: float = 0.0
    range_max: float = 80.0

    def __post_init__(self) -> None:
        try:
            with np.errstate(over="ignore"):
                ranges = np.array(self.ranges, dtype=np.float32)
        except (TypeError, ValueError) as error:
            raise ScanError(f"ranges are not numbers: {error}") from None
        if ranges.ndim != 1:
            raise ScanError(f"ranges must have one dimension, not shape {ranges.shape}")
        for name in ("angle_min", "angle_increment", "range_min"):
            if not math.isfinite(getattr(self, name)):
                raise ScanError(f"{name} must be finite, not {getattr(self, name)}")
        if self.angle_increment == 0.0 and len(ranges) > 1:
            raise ScanError("angle_increment must not be zero")
        if 0.0 < abs(self.angle_increment) < _SMALLEST_INCREMENT:
            raise ScanError(f"angle_increment is too small: {self.angle_increment}")
        if abs(self.angle_increment) * len(ranges) > 4.0 * math.pi:
            raise ScanError("the readings span more than two turns; is angle_increment in degrees?")
        if not 0.0 <= self.range_min < self.range_max:
            raise ScanError(f"range limits are out of order: {self.range_min} to {self.range_max}")
        ranges.setflags(write=False)
        object.__setattr__(self, "ranges", ranges)
        for name in ("angle_min", "angle_increment", "range_min", "range_max"):
            object.__setattr__(self, name, float(getattr(self, name)))

    @classmethod
    def from_field_of_view(
        cls,
        ranges: ArrayLike,
        field_of_view: float,
        *,
        range_min: float = 0.0,
        range_max: float = 80.0,
    ) -> LaserScan:
        """Build a scan that looks symmetrically about +x, counter-clockwise.

        Args:
            ranges: (N,) metres.
            field_of_view: Angle from the first to the last reading, radians.
            range_min: Shortest range that counts, metres.
            range_max: Longest range that counts, metres.

        Raises:
            ScanError: As for the constructor.
        """
        count = len(np.atleast_1d(np.asarray(ranges)))
        increment = field_of_view / max(count - 1, 1)
        return cls(np.asarray(ranges), -0.5 * field_of_view, increment, range_min, range_max)

    def __len__(self) -> int:
        return len(self.ranges)

    def thinned(self, increment: float) -> LaserScan:
        """Leave out readings so that those left are as close as may be, but not closer.

        Args:
            increment: Smallest angle between readings that are left, radians.

        Returns:
            Every n-th reading, beginning where most of them are returns; the scan itself where
            none is left out.
        """
        # Half of a quarter of a degree may be a hair's breadth less than that.
        every = int(1.000001 * increment / (abs(self.angle_increment) or math.inf))
        if every < 2 or not len(self.ranges):
            return self
        is_return = self.is_return
        begins = range(min(every, len(self.ranges)))
        begin = max(begins, key=lambda k: np.count_nonzero(is_return[k::every]))
        return LaserScan(
            self.ranges[begin::every],
            self.angle_min + begin * self.angle_increment,
            every * self.angle_increment,
            self.range_min,
            self.range_max,
        )

    def upside_down(self) -> LaserScan:
        """Return what the same laser says that hangs upside down: the scan, mirrored at +x."""
        return LaserScan(
            self.ranges, -self.angle_min, -self.angle_increment, self.range_min, self.range_max
        )

    @property
    def angles(self) -> NDArray[np.float64]:
        """(N,) direction of every reading, radians, scan frame."""
        readings = np.arange(len(self.ranges), dtype=np.float64)
        return self.angle_min + self.angle_increment * readings

    @property
    def is_return(self) -> NDArray[np.bool_]:
        """(N,) whether the reading hit something within the limits."""
        ranges = self.ranges
        is_long_enough = (ranges >= self.shortest_return) & (ranges > 0.0)
        return is_long_enough & (ranges <= self.longest_return)

    @property
    def shortest_return(self) -> float:
        """Shortest range that a return may have, metres: ``range_min`` as a reading holds it."""
        return float(np.float32(min(self.range_min, 2.0 * _LONGEST)))

    @property
    def longest_return(self) -> float:
        """Longest range of a return, metres: ``range_max`` as a reading holds it, or 10 km."""
        return float(np.float32(min(self.range_max, _LONGEST)))

    @property
    def is_free(self) -> NDArray[np.bool_]:
        """(N,) whether the reading found nothing within reach (REP-117 ``+inf``)."""
        with np.errstate(invalid="ignore", over="ignore"):
            return np.asarray(self.ranges > self.range_max)

    @property
    def points(self) -> NDArray[np.float64]:
        """(V, 2) end points of the returns, metres, scan frame, in the order of the readings."""
        is_return = self.is_return
        ranges = self.ranges[is_return].astype(np.float64)
        angles = self.angles[is_return]
        return np.column_stack((ranges * np.cos(angles), ranges * np.sin(angles)))

    @property
    def field_of_view(self) -> float:
        """Angle from the first to the last reading, radians, not negative."""
        return abs(self.angle_increment) * max(len(self.ranges) - 1, 0)

    @property
    def is_full_turn(self) -> bool:
        """Whether the last reading is followed by the first, as with a 360 degree sensor."""
        step = abs(self.angle_increment)
        return len(self.ranges) > 2 and step * (len(self.ranges) + _CLOSING_SLACK) >= 2.0 * math.pi
