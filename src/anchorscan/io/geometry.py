"""Where the readings of a scan look, and from which range on they mean "no return".

Formats without a geometry of their own (``FLASER`` lines, tables) get it from the number of
readings, where that number means one sensor, or from the field of view that the caller gives.
Readings run counter-clockwise and lie symmetrically about forward.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..scan import LaserScan

__all__ = [
    "RANGE_MAX",
    "Angles",
    "ScanGeometry",
    "geometry_note",
    "geometry_of",
    "make_scan",
    "spread",
]

RANGE_MAX = 80.0
"""Limit of a sensor that nobody said anything about, metres."""

# LMS sensors say "no measurement" with these, in their 80 m mode and counting millimetres.
_LMS_CODES = (81.8, 82.0)
_LMS_MILLIMETRE_CODES = (32.7585, 32.7675)
_WHOLE_CENTIMETRE = 0.05

# Numbers of readings that mean one geometry: resolution, degrees.  An even number is the odd
# one without its last reading, which is how CARMEN itself takes it.
_RESOLUTIONS = {
    181: 1.0,  # 180 degrees
    361: 0.5,  # 180 degrees
    401: 0.25,  # 100 degrees
    541: 0.5,  # 270 degrees
    683: 360.0 / 1024.0,  # 240 degrees, Hokuyo URG-04LX
    1081: 0.25,  # 270 degrees
}
_FULL_TURN = 2.0 * math.pi
# Resolutions of real sensors are whole multiples of this, degrees.
_RESOLUTION_STEP = 1.0 / 24.0
_ROUND = 1e-4


@dataclass(frozen=True)
class ScanGeometry:
    """Where the readings of a scan look.

    Args:
        angle_min: Direction of the first reading, radians.
        angle_increment: Angle between readings, radians.
        range_min: Below this range a reading is no return, metres.
        range_max: From this range on a reading is no return, metres.
        is_guessed: Whether nothing but the number of readings tells.
    """

    angle_min: float
    angle_increment: float
    range_min: float = 0.0
    range_max: float = RANGE_MAX
    is_guessed: bool = False


@dataclass(frozen=True)
class Angles:
    """What a table says of where the readings of a scan look, radians; two of three are enough.

    Args:
        angle_min: Direction of the first reading.
        angle_max: Direction of the last reading.
        angle_increment: Angle between readings.
    """

    angle_min: float | None = None
    angle_max: float | None = None
    angle_increment: float | None = None

    def geometry(
        self, count: int, *, field_of_view: float | None, range_min: float, range_max: float
    ) -> ScanGeometry:
        """Return the geometry of ``count`` readings.

        Args:
            count: Number of readings.
            field_of_view: Angle that they cover instead, radians.
            range_min: Below this range a reading is no return, metres.
            range_max: From this range on a reading is no return, metres.

        Raises:
            ValueError: One angle alone does not tell, or none is given and the number does not.
        """
        start, end, step = self.angle_min, self.angle_max, self.angle_increment
        if field_of_view is not None:
            return ScanGeometry(*spread(field_of_view, count), range_min, range_max)
        told = [name for name, value in vars(self).items() if value is not None]
        if not told:
            return replace(geometry_of(count, range_max=range_max), range_min=range_min)
        if len(told) == 1:
            raise ValueError(
                f"{told[0]} alone does not say where the readings look; give two of angle_min, "
                "angle_max and angle_increment, or the field of view (field_of_view, "
                "--field-of-view)"
            )
        if step is None and start is not None and end is not None:
            step = (end - start) / max(count - 1, 1)
        if start is None and end is not None and step is not None:
            start = end - (count - 1) * step
        assert start is not None
        assert step is not None
        return ScanGeometry(start, step, range_min, range_max)


def geometry_of(
    count: int,
    *,
    field_of_view: float | None = None,
    resolution: float | None = None,
    is_certain: bool = False,
    range_max: float = RANGE_MAX,
) -> ScanGeometry:
    """Return the geometry of ``count`` readings.

    Args:
        count: Number of readings.
        field_of_view: Angle that they cover, radians, where it is known.
        resolution: Angle between readings, radians, where somebody told it.
        is_certain: Whether ``resolution`` stands above what the number suggests.
        range_max: From this range on a reading is no return, metres.

    Raises:
        ValueError: Nothing is known and the number does not tell.
    """
    if count < 2:
        raise ValueError("the scan has no readings" if count < 1 else "the scan has one reading")
    if field_of_view is not None:
        return ScanGeometry(*spread(field_of_view, count), range_max=range_max)
    known = _RESOLUTIONS.get(count if count % 2 else count + 1)
    is_guessed = known is not None and not is_certain
    if known is not None and is_guessed:
        resolution = math.radians(known)
    if resolution is None or not 0.0 < resolution * (count - 1) < _FULL_TURN:
        raise ValueError(
            f"the field of view of {count} readings is not known; give it "
            "(field_of_view, --field-of-view)"
        )
    steps = count if count % 2 == 0 else count - 1
    start = -0.5 * steps * resolution
    return ScanGeometry(start, resolution, range_max=range_max, is_guessed=is_guessed)


def geometry_note(scan: LaserScan, *, is_guessed: bool) -> str:
    """Return what is said of where the readings of a log look."""
    start, end = math.degrees(scan.angles[0]), math.degrees(scan.angles[-1])
    note = f"{len(scan)} readings from {start:g} to {end:g} degrees, up to {scan.range_max:g} m"
    if not is_guessed:
        return note
    return (
        f"{note}; guessed from their number, give the field of view (field_of_view, "
        "--field-of-view) if it is another, such as 360 degrees"
    )


def spread(field_of_view: float, count: int) -> tuple[float, float]:
    """Return the first direction and the increment of readings spread about forward, radians.

    The last of ``count`` readings ends the field of view, or is left out at its end, as in
    180 readings over 180 degrees: whichever gives a resolution that sensors have.  Over a full
    turn it is always left out, because the first reading looks there.

    Raises:
        ValueError: The field of view is not an angle in radians, or there is one reading.
    """
    if not 0.0 < field_of_view < _FULL_TURN + _ROUND:
        raise ValueError(f"field_of_view must lie in (0, 2 pi] radians, not {field_of_view:g}")
    if count < 2:
        raise ValueError("the scan has fewer than two readings")
    closed, opened = field_of_view / (count - 1), field_of_view / count
    is_full_turn = field_of_view > _FULL_TURN - _ROUND
    if is_full_turn or (_is_round(opened) and not _is_round(closed)):
        return -0.5 * field_of_view, opened
    return -0.5 * field_of_view, closed


def make_scan(
    ranges: ArrayLike, geometry: ScanGeometry, *, range_max: float | None = None
) -> LaserScan:
    """Make a scan of ranges as old logs write them, with "no return" as ``+inf`` (REP-117).

    A range at or above the limit is no return.  LMS sensors report their error codes as 81.81
    to 81.91 m, or as 32.759 to 32.767 m when they count millimetres; those are no return too
    unless the caller gives the limit.

    Args:
        ranges: (N,) metres.
        geometry: Where they look.
        range_max: The sensor's limit instead of the geometry's, metres.

    Raises:
        ScanError: The geometry is impossible.
    """
    values = np.asarray(ranges, dtype=np.float64)
    limit = geometry.range_max if range_max is None else range_max
    if not limit > 0.0:
        limit = RANGE_MAX
    free = values >= limit
    if range_max is None:
        free |= _is_lms_code(values)
    return LaserScan(
        np.where(free, np.inf, values),
        geometry.angle_min,
        geometry.angle_increment,
        geometry.range_min,
        limit,
    )


def _is_lms_code(ranges: NDArray[np.float64]) -> NDArray[np.bool_]:
    metres, millimetres = _LMS_CODES, _LMS_MILLIMETRE_CODES
    code = (ranges > metres[0]) & (ranges < metres[1])
    suspect = (ranges > millimetres[0]) & (ranges < millimetres[1])
    if suspect.any():
        # A log in centimetres cannot hold such a code, but may hold a wall at 32.76 m.
        centimetres = np.where(suspect, ranges, 0.0) * 100.0
        code |= suspect & (np.abs(centimetres - np.round(centimetres)) > _WHOLE_CENTIMETRE)
    return code


def _is_round(increment: float) -> bool:
    steps = math.degrees(increment) / _RESOLUTION_STEP
    return abs(steps - round(steps)) < _ROUND * max(steps, 1.0)
