"""Section 3: segmentation into large connected surfaces.

Large objects tend to be the invariants of a place, so jump edge and angle anchor points
are taken from large surfaces only.  A segment is a run of returns without a gap; it is
large when the way along it reaches ``smallest_extent``.  The paper names no figure;
the ``paper`` preset takes half a metre, about the width of a door leaf's half or a desk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .angle_function import AngleFunction

__all__ = ["SegmentSettings", "Segments", "is_small", "segments"]


class SegmentSettings(BaseModel):
    """Settings of the segmentation step of section 3."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    smallest_extent: float = Field(0.5, ge=0.0, description="way along a large surface, metres")
    fewest_readings: int = Field(4, ge=2, description="returns that make a surface")


@dataclass(frozen=True, eq=False)
class Segments:
    """Large connected surfaces, as stretches of the returns of an angle function.

    Args:
        first: (S,) index of the first return of each.
        last: (S,) index of the last return of each, included.
    """

    first: NDArray[np.int64]
    last: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.first)


def segments(angles: AngleFunction, settings: SegmentSettings) -> Segments:
    """Find the large connected surfaces of a scan (section 3)."""
    return Segments(*_segments(angles.runs, angles.way, segment_limits(settings)))


def segment_limits(settings: SegmentSettings) -> tuple[float, int]:
    """Return the settings that kernels need: the way along a surface, and its readings."""
    return settings.smallest_extent, settings.fewest_readings


@kernel
def is_small(runs, way, extent):  # type: ignore[no-untyped-def]
    """(V,) which returns lie on things along which the way is shorter than ``extent``, metres.

    A thing is a run of returns without a gap, whatever its number of readings: a person, the leg
    of a table, a single reading out of place.  ``runs`` and ``way`` are those of the angle
    function.
    """
    small = np.empty(len(runs), np.bool_)
    last = len(runs) - 1
    for i in range(len(runs) - 1, -1, -1):
        if i + 1 < len(runs) and runs[i + 1] != runs[i]:
            last = i
        small[i] = way[last] - way[runs[i]] < extent
    return small


@kernel
def _segments(runs, way, limits):  # type: ignore[no-untyped-def]
    """First and last return of every run that is long and dense enough."""
    smallest_extent, fewest_readings = limits
    count = len(runs)
    first = np.empty(count, np.int64)
    last = np.empty(count, np.int64)
    found = 0
    for i in range(count):
        if i + 1 < count and runs[i + 1] == runs[i]:
            continue
        if i - runs[i] + 1 >= fewest_readings and way[i] - way[runs[i]] >= smallest_extent:
            first[found] = runs[i]
            last[found] = i
            found += 1
    return first[:found], last[:found]
