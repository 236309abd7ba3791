"""The reference scan: a scan whose place is known."""

from __future__ import annotations

from dataclasses import dataclass

from .pose import Pose2D
from .scan import LaserScan

__all__ = ["Reference"]


@dataclass(frozen=True, eq=False)
class Reference:
    """A reference scan of a set.

    Args:
        identifier: Number of the reference in its set; never used again after removal.
        scan: The laser scan.
        pose: ``T_set_laser``, or None in a topological set, whose references have no
            common frame.
        name: What the user calls the place.
    """

    identifier: int
    scan: LaserScan
    pose: Pose2D | None = None
    name: str = ""
