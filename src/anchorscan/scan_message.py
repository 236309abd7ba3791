"""Scans and answers on the wire: JSON with the names of LaserScan, and a compact binary form.

JSON: an object with the fields of ``sensor_msgs/LaserScan``.  Of them ``angle_min``,
``angle_increment`` and ``ranges`` are needed; ``range_min`` (0) and ``range_max`` (80 m) may be
left out; what else that message has is passed over.  JSON has no special numbers, so a range may
be ``null`` or ``"nan"`` (no information), ``"inf"`` (nothing within reach) or ``"-inf"`` (too
close), as REP-117 means them.

Binary, all little-endian: ``APRSCAN1``, the number of scans as uint32, and for every scan
``angle_min``, ``angle_increment``, ``range_min``, ``range_max`` as float64, the number of readings
as uint32, and the ranges as float32.  Nothing is rounded, so the answer is the one that the
same scan gets in process.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from .errors import ScanError
from .hypothesis import Hypothesis, state_of
from .pose import Pose2D
from .scan import LaserScan

__all__ = [
    "BINARY",
    "MOST_READINGS",
    "hypothesis_of",
    "hypothesis_values",
    "packed",
    "pose_of",
    "pose_values",
    "scan_of",
    "scan_values",
    "state_values",
    "unpacked",
]

BINARY = "application/vnd.anchorscan.scans"
"""The media type of the binary form."""

MOST_READINGS = 20_000
"""The most readings of a scan on the wire."""

_MAGIC = b"APRSCAN1"
_COUNT = struct.Struct("<I")
_GEOMETRY = struct.Struct("<4dI")


def scan_values(scan: LaserScan) -> dict[str, Any]:
    """Return a scan as JSON has it."""
    return {
        "angle_min": scan.angle_min,
        "angle_increment": scan.angle_increment,
        "range_min": scan.range_min,
        "range_max": _spelled(scan.range_max),
        "ranges": [_spelled(value) for value in scan.ranges.tolist()],
    }


def scan_of(values: Mapping[str, Any]) -> LaserScan:
    """Return the scan of a JSON object whose types have been checked.

    Raises:
        ScanError: It cannot be one.
    """
    try:
        return LaserScan(
            np.array([_range(value) for value in values["ranges"]], np.float64),
            float(values["angle_min"]),
            float(values["angle_increment"]),
            float(values.get("range_min", 0.0)),
            float(values.get("range_max", 80.0)),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ScanError(f"not a scan: {error}") from None


def packed(scans: Iterable[LaserScan]) -> bytes:
    """Return scans in the binary form."""
    parts = []
    for scan in scans:
        geometry = (scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
        parts += [_GEOMETRY.pack(*geometry, len(scan)), scan.ranges.astype("<f4").tobytes()]
    return b"".join([_MAGIC, _COUNT.pack(len(parts) // 2), *parts])


def unpacked(data: bytes, most: int) -> list[LaserScan]:
    """Return the scans of the binary form; every size is checked before it is believed.

    Args:
        data: All of it.
        most: The most scans that it may hold.

    Raises:
        ScanError: It is cut off, goes on after its end, or holds what is no scan.
    """
    if data[: len(_MAGIC)] != _MAGIC or len(data) < len(_MAGIC) + _COUNT.size:
        raise ScanError("does not begin as scans in binary form do")
    (count,) = _COUNT.unpack_from(data, len(_MAGIC))
    if not 1 <= count <= most:
        raise ScanError(f"{count} scans are not between 1 and {most}")
    at, scans = len(_MAGIC) + _COUNT.size, []
    for number in range(count):
        if len(data) < at + _GEOMETRY.size:
            raise ScanError(f"is cut off in scan {number}")
        *geometry, readings = _GEOMETRY.unpack_from(data, at)
        at += _GEOMETRY.size
        if readings > MOST_READINGS:
            raise ScanError(f"scan {number} has more than {MOST_READINGS} readings")
        if len(data) < at + 4 * readings:
            raise ScanError(f"is cut off in scan {number}")
        ranges = np.frombuffer(data, "<f4", readings, at)
        at += 4 * readings
        scans.append(LaserScan(ranges, *geometry))
    if at != len(data):
        raise ScanError(f"goes on for {len(data) - at} bytes after the last scan")
    return scans


def hypothesis_values(hypothesis: Hypothesis) -> dict[str, Any]:
    """Return a hypothesis as JSON has it, no digit rounded."""
    return {
        "reference": hypothesis.reference,
        **pose_values(hypothesis.pose),
        "pose_in_reference": pose_values(hypothesis.pose_in_reference),
        "covariance": hypothesis.covariance.tolist(),
        "evaluation": _finite(hypothesis.evaluation),
        "quality": _finite(hypothesis.quality),
        "score": _finite(hypothesis.score),
        "probability": hypothesis.probability,
        "accepted": hypothesis.accepted,
        "ambiguous": hypothesis.ambiguous,
    }


def state_values(hypotheses: Sequence[Hypothesis]) -> dict[str, Any]:
    """Return as JSON what the hypotheses of one scan amount to."""
    state = state_of(hypotheses)
    return {"accepted": state == "located", "state": state}


def hypothesis_of(values: Mapping[str, Any]) -> Hypothesis:
    """Return the hypothesis of a JSON object.

    Raises:
        ValueError: It is none.
    """
    try:
        inner = pose_of(values["pose_in_reference"])
        if inner is None:
            raise ValueError("no pose in the reference")
        return Hypothesis(
            reference=int(values["reference"]),
            pose_in_reference=inner,
            pose=pose_of(values),
            covariance=np.array(values["covariance"], np.float64).reshape(3, 3),
            evaluation=_number(values["evaluation"]),
            quality=_number(values["quality"]),
            score=_number(values["score"]),
            probability=float(values["probability"]),
            accepted=bool(values["accepted"]),
            ambiguous=bool(values.get("ambiguous", False)),
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"no hypothesis: {error}") from None


def pose_values(pose: Pose2D | None) -> dict[str, float | None]:
    """Return a pose as JSON has it; nulls where there is none."""
    if pose is None:
        return {"x": None, "y": None, "theta": None}
    return {"x": pose.x, "y": pose.y, "theta": pose.theta}


def pose_of(values: Mapping[str, Any]) -> Pose2D | None:
    """Return the pose of a JSON object, or None where it has nulls."""
    if values["x"] is None:
        return None
    return Pose2D(float(values["x"]), float(values["y"]), float(values["theta"]))


def _spelled(value: float) -> float | str | None:
    """Spell special numbers, which JSON does not have."""
    if math.isfinite(value):
        return value
    return None if math.isnan(value) else "inf" if value > 0.0 else "-inf"


def _range(value: float | str | None) -> float:
    return math.nan if value is None else float(value)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
