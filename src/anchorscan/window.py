"""Recent scans joined by odometry into one wider view: 180 degrees become 360.

Two half-turn views of a place from opposite directions share little.  A robot that has driven a
few metres has seen both sides: the readings of its latest scans, carried along by odometry, are
what a scanner that looks all around would have seen, but for what moved meanwhile.  The joined view
is made as section 5 makes its synthetic scan: readings are seen again from one pose, each angle
keeps the nearest, and what lies behind a known surface stays hidden.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .pose import Pose2D
from .record import Record
from .scan import LaserScan

__all__ = ["joined_scan"]

_LENGTH = 4.0
_READINGS = 720
# Neighbouring readings nearer than this many times their own spacing lie on one surface.
_SURFACE = 0.3


def joined_scan(
    records: Sequence[Record], length: float = _LENGTH, readings: int = _READINGS
) -> LaserScan:
    """Join the latest scans into one full turn, seen from where the last was taken.

    Args:
        records: In time order, all of them with odometry (else with poses) of the laser;
            records without a scan are passed over.
        length: Metres of driving back from the last that are joined.
        readings: Of the joined scan.

    Returns:
        A scan in the frame of the last laser; angles that none of the scans saw are NaN.

    Raises:
        ValueError: No record has a scan and a pose by odometry.
    """
    usable = [record for record in records if record.scan is not None]
    wheels = all(record.odometry is not None for record in usable)
    poses = [record.odometry if wheels else record.pose for record in usable]
    known = [(r.scan, p) for r, p in zip(usable, poses, strict=True) if p is not None]
    if not known:
        raise ValueError("no record has a scan and a pose to join it by")
    last, T_odom_last = known[-1]
    assert last is not None
    ranges = np.full(readings, np.nan)
    way, before = 0.0, T_odom_last
    for scan, T_odom_scan in reversed(known):
        way += before.distance(T_odom_scan)
        before = T_odom_scan
        if way > length:
            break
        assert scan is not None
        T_last_scan = T_odom_last.inverse() @ T_odom_scan
        _see_again(ranges, *_seen(scan, T_last_scan))
    return LaserScan(ranges, -math.pi, 2.0 * math.pi / readings, last.range_min, last.range_max)


def _seen(
    scan: LaserScan, T_last_scan: Pose2D
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return the points in the last scan's frame, their ranges, and the spacing of the readings."""
    points = np.ascontiguousarray(T_last_scan.apply(scan.points))
    ranges = scan.ranges[scan.is_return].astype(np.float64)
    return points, ranges, abs(scan.angle_increment)


@kernel
def _see_again(ranges, points, seen, increment):  # type: ignore[no-untyped-def]
    """Keep at every angle the nearest of what was seen, surfaces between neighbours filled in."""
    count = len(ranges)
    step = 2.0 * math.pi / count
    for i in range(len(points)):
        first = points[i]
        last = points[i]
        if i + 1 < len(points):
            apart = math.hypot(points[i + 1, 0] - first[0], points[i + 1, 1] - first[1])
            if apart < _SURFACE + 2.0 * increment * seen[i]:
                last = points[i + 1]
        a = math.atan2(first[1], first[0])
        turn = math.atan2(last[1], last[0]) - a
        turn -= 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
        pieces = max(int(math.ceil(abs(turn) / step)), 1)
        for n in range(pieces):
            share = n / pieces
            x = first[0] + share * (last[0] - first[0])
            y = first[1] + share * (last[1] - first[1])
            r = math.hypot(x, y)
            k = int(math.floor((math.atan2(y, x) + math.pi) / step + 0.5)) % count
            if r > 0.0 and not ranges[k] <= r:
                ranges[k] = r
