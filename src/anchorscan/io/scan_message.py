"""The laser scan as ROS carries it: ``LaserScan`` and ``MultiEchoLaserScan``, live or recorded."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import ScanError
from ..scan import LaserScan
from .geometry import spread

__all__ = ["scan_from_message"]


def scan_from_message(
    message: Any,
    *,
    field_of_view: float | None = None,
    range_min: float | None = None,
    range_max: float | None = None,
    is_upside_down: bool = False,
) -> LaserScan:
    """Return the scan that a message holds, seen from above; of several echoes the first.

    A laser that hangs upside down has its scan turned over: angles change sign.  Drivers older
    than REP-117 publish the limit itself for "no return"; here it becomes ``+inf``.

    Args:
        message: With the fields of ``sensor_msgs/LaserScan`` or ``MultiEchoLaserScan``.
        field_of_view: Angle that the readings cover, radians, instead of the message's.
        range_min: Shortest range that counts, metres, instead of the message's.
        range_max: From this range on a reading is no return, metres, instead of the message's.
        is_upside_down: Whether the laser's z axis points down.

    Raises:
        ScanError: The message cannot be a scan.
    """
    try:
        ranges = np.asarray(_first_echoes(message.ranges), dtype=np.float32)
        if not len(ranges):
            raise ScanError("the scan has no readings")
        start, increment = message.angle_min, message.angle_increment
        if field_of_view is not None:
            start, increment = spread(field_of_view, len(ranges))
        if is_upside_down:
            start, increment = -start, -increment
        least = message.range_min if range_min is None else range_min
        limit = message.range_max if range_max is None else range_max
        ranges = np.where(ranges >= np.float32(limit), np.float32(np.inf), ranges)
        return LaserScan(ranges, start, increment, least, limit)
    except ValueError as error:
        raise ScanError(str(error)) from None


def _first_echoes(ranges: Any) -> ArrayLike:
    """Return the readings, of a reading with several echoes the first."""
    if len(ranges) and hasattr(ranges[0], "echoes"):
        return [one.echoes[0] if len(one.echoes) else math.nan for one in ranges]
    readings: ArrayLike = ranges
    return readings
