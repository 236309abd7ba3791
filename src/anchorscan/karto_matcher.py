"""The Karto correlative matcher on the references that we would take: a check of candidates.

A baseline of the benchmark.  Karto's matcher (Konolige et al., "Efficient sparse pose adjustment
for 2D mapping", 2010, after Olson, "Real-time correlative scan matching", 2009) is what
slam_toolbox and many others close loops with.  It cannot search a set of references; it is given
the candidates of our relationship database, and looks around each of them for a pose of the
scan, in the window and at the resolution that Karto uses to close loops but with every heading.
The answer is the pose of the highest response.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .errors import MissingExtraError
from .pose import Pose2D
from .reference import Reference
from .scan import LaserScan

__all__ = ["KartoMatcher", "Response"]

_SIDE = 4.0
_RESOLUTION = 0.1
_DEVIATION = 0.1
_COARSE_TURN = math.radians(2.0)
_FINE_TURN = math.radians(0.2)
_RANGE_LIMIT = 20.0


@dataclass(frozen=True)
class Response:
    """Where Karto's matcher puts a scan, seen from one reference.

    Args:
        reference: Identifier of the reference.
        pose: ``T_set_laser``.
        response: Share of the readings that fall on the reference's, smeared, in [0, 1].
    """

    reference: int
    pose: Pose2D
    response: float


class KartoMatcher:
    """Match scans against candidate references with Karto's matcher.

    Args:
        candidates: Gives for a scan the references to match it with; those without a pose are
            passed over.

    Raises:
        MissingExtraError: ``karto-scanmatcher`` is not installed.
    """

    def __init__(self, candidates: Callable[[LaserScan], Iterable[Reference]]) -> None:
        try:
            import karto_scanmatcher
        except ImportError:
            raise MissingExtraError("the Karto matcher", "bench") from None
        self._karto = karto_scanmatcher
        self._candidates = candidates
        config = karto_scanmatcher.ScanMatcherConfig()
        config.search_size = _SIDE
        config.resolution = _RESOLUTION
        config.smear_deviation = _DEVIATION
        config.coarse_search_angle_offset = math.pi
        config.coarse_angle_resolution = _COARSE_TURN
        config.fine_search_angle_resolution = _FINE_TURN
        config.range_threshold = _RANGE_LIMIT
        config.use_response_expansion = False
        self._matcher = karto_scanmatcher.Wrapper(config)

    def locate(self, scan: LaserScan) -> list[Response]:
        """Match a scan with each of its candidates, highest response first."""
        if not scan.is_return.any():
            return []
        found = [
            self._match(scan, reference, reference.pose)
            for reference in self._candidates(scan)
            if reference.pose is not None
        ]
        return sorted(found, key=lambda one: -one.response)

    def _match(self, scan: LaserScan, reference: Reference, pose: Pose2D) -> Response:
        """Search around one reference, without a penalty for being far from it."""
        result = self._matcher.match_scan(
            self._localized(scan, pose, 1), [self._localized(reference.scan, pose, 0)], False, True
        )
        best = result.best_pose
        return Response(reference.identifier, Pose2D(best.x, best.y, best.yaw), result.response)

    def _localized(self, scan: LaserScan, pose: Pose2D, number: int) -> Any:
        """Hand a scan over, readings in rising order of angle, what is no return out of range."""
        ranges = np.where(scan.is_return, scan.ranges, scan.range_max + 1.0).astype(np.float64)
        angles = scan.angles
        if scan.angle_increment < 0.0:
            ranges, angles = ranges[::-1], angles[::-1]
        config = self._karto.LaserScanConfig(
            float(angles[0]),
            float(angles[-1]),
            abs(scan.angle_increment),
            scan.range_min,
            scan.range_max,
            min(_RANGE_LIMIT, scan.range_max),
            "",
        )
        place = self._karto.Pose2(pose.x, pose.y, pose.theta)
        return self._karto.LocalizedRangeScan(config, ranges.tolist(), place, place, number, 0.0)
