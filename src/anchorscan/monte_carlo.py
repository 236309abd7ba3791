"""Adaptive Monte Carlo localization, spread uniformly over the map: what users have today.

A baseline of the benchmark, after Fox, "Adapting the sample size in particle filters through
KLD-sampling" (2003), and Thrun, Burgard and Fox, "Probabilistic Robotics" (2005), chapters 5, 6
and 8, with the formulas and the default settings of Nav2's AMCL: the differential motion model
with 0.2 for each of its noises, the likelihood field of 60 beams with ``1 + sum(p^3)``, updates
each 0.25 m or 0.2 rad, and 500 particles at least.  The two averages that add random poses when
the scans fit worse than they used to are off, as there; on (0.001 and 0.1, the values that its
manual names), they keep the particles from ever agreeing.  Apart from Nav2 are the 20,000
particles at most, and that resampling searches the cumulated weights in logarithmic time.

AMCL has no notion of being sure.  Here it is when nine tenths of the particles are in one cluster
whose covariance leaves 0.99 within 0.5 m and 10 degrees, the bounds by which the belief of this
package reports its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .covariance import held
from .hypothesis import Hypothesis
from .localizer import Belief
from .occupancy import OccupancyGrid, stitch
from .pose import Pose2D
from .record import Record
from .reference import Reference
from .scan import LaserScan

__all__ = ["MonteCarlo"]

_BEAMS = 60
_HIT, _RANDOM, _DEVIATION, _FARTHEST = 0.5, 0.5, 0.2, 2.0
_RANGE = 80.0
_NOISE = 0.2
_UPDATE_DISTANCE, _UPDATE_TURN = 0.25, 0.2
_FEWEST = 500
_ERROR, _QUANTILE = 0.05, 2.3263478740408408  # of the normal distribution at 0.99
_CELL, _CELL_TURN = 0.5, math.radians(10.0)
_THRESHOLD, _CLUSTER = 0.99, 0.9
_CLUSTER_DISTANCE, _CLUSTER_TURN = 1.0, math.radians(30.0)


class MonteCarlo:
    """Follow a robot with particles on the occupancy grid stitched from references.

    Args:
        references: With poses.
        particles: At most.
        resolution: Edge length of a cell of the grid, metres.
        seed: Draws everything that is random.
        slow: Rate of the slow average of the likelihood; zero adds no random poses.
        fast: Rate of the fast one.
    """

    def __init__(
        self,
        references: Sequence[Reference],
        particles: int = 20000,
        resolution: float = 0.05,
        seed: int = 0,
        slow: float = 0.0,
        fast: float = 0.0,
    ) -> None:
        records = (
            Record(each.identifier, each.scan, each.pose)
            for each in references
            if each.pose is not None
        )
        grid = stitch(records, resolution)
        self._origin = grid.origin.to_array()
        self._resolution = grid.resolution
        self._places = grid.centres(np.argwhere(grid.is_free))
        self._field = _likelihoods(grid)
        self._most, self._seed = particles, seed
        self._rates = slow, fast
        self.reset()

    def again(self) -> MonteCarlo:
        """Return itself, knowing nothing."""
        self.reset()
        return self

    def reset(self) -> None:
        """Spread all particles uniformly over the free cells and all headings."""
        self._rng = np.random.default_rng(self._seed)
        self._poses = self._anywhere(self._most)
        self._weights = np.full(self._most, 1.0 / self._most)
        self._odometry: Pose2D | None = None
        self._slow = self._fast = 0.0
        self._belief = Belief((), 1.0, False)

    def update(
        self, scan: LaserScan, odometry: Pose2D | None, stamp: float | None = None
    ) -> Belief:
        """Take the next scan with ``T_odom_laser``; a scan that moved too little is passed over."""
        if odometry is None:
            return self._belief
        if self._odometry is not None:
            step = self._odometry.inverse() @ odometry
            driven = math.hypot(step.x, step.y)
            if driven < _UPDATE_DISTANCE and abs(step.theta) < _UPDATE_TURN:
                return self._carried(step)
            self._move(step)
        self._odometry = odometry
        self._weigh(scan)
        self._resample()
        self._belief = self._report()
        return self._belief

    def _anywhere(self, count: int) -> NDArray[np.float64]:
        places = self._places[self._rng.integers(0, len(self._places), count)]
        turns = self._rng.uniform(-math.pi, math.pi, count)
        return np.column_stack([places, turns])

    def _move(self, step: Pose2D) -> None:
        """Draw a motion for every particle: turn, drive, turn (Probabilistic Robotics, 5.4)."""
        driven = math.hypot(step.x, step.y)
        first = math.atan2(step.y, step.x) if driven >= 0.01 else 0.0
        last = math.remainder(step.theta - first, 2.0 * math.pi)
        # Backwards is no half turn.
        turned = [min(abs(t), abs(math.pi - abs(t))) for t in (first, last)]
        spread = _NOISE * np.array(
            [turned[0] ** 2 + driven**2, driven**2 + sum(t * t for t in turned), 0.0]
        )
        spread[2] = _NOISE * (turned[1] ** 2 + driven**2)
        drawn = self._rng.standard_normal((len(self._poses), 3)) * np.sqrt(spread)
        heading = self._poses[:, 2] + first + drawn[:, 0]
        way = driven + drawn[:, 1]
        self._poses = np.column_stack(
            [
                self._poses[:, 0] + way * np.cos(heading),
                self._poses[:, 1] + way * np.sin(heading),
                heading + last + drawn[:, 2],
            ]
        )

    def _weigh(self, scan: LaserScan) -> None:
        points = scan.points
        beams = points[:: max(len(points) // _BEAMS, 1)]
        frame = np.append(self._origin[:2], self._resolution)
        likelihood = _likelihood(self._poses, beams, self._field, frame)
        weights = self._weights * likelihood
        total = float(weights.sum())
        self._weights = weights / total
        # The weights before summed to one, so that their sum is the average likelihood.
        slow, fast = self._rates
        self._slow += slow * (total - self._slow) if self._slow else total
        self._fast += fast * (total - self._fast) if self._fast else total

    def _resample(self) -> None:
        random = max(0.0, 1.0 - self._fast / self._slow) if any(self._rates) else 0.0
        if random > 0.0:
            self._slow = self._fast = 0.0
        cumulated = np.cumsum(self._weights)
        drawn = np.searchsorted(cumulated, self._rng.uniform(0.0, cumulated[-1], self._most))
        poses = self._poses[np.minimum(drawn, len(cumulated) - 1)]
        is_random = self._rng.uniform(size=self._most) < random
        poses[is_random] = self._anywhere(int(is_random.sum()))
        count = _enough(poses, np.array([_CELL, _CELL, _CELL_TURN]), _ERROR, _QUANTILE, _FEWEST)
        self._poses = poses[:count]
        self._weights = np.full(count, 1.0 / count)

    def _carried(self, step: Pose2D) -> Belief:
        """Carry the latest report on by odometry, as the frame of the map does."""
        hypotheses = tuple(
            Hypothesis(
                reference=each.reference,
                pose_in_reference=each.pose_in_reference,
                pose=None if each.pose is None else each.pose @ step,
                covariance=each.covariance,
                evaluation=each.evaluation,
                quality=each.quality,
                score=each.score,
                probability=each.probability,
                accepted=each.accepted,
            )
            for each in self._belief.hypotheses
        )
        return Belief(hypotheses, self._belief.elsewhere, self._belief.accepted)

    def _report(self) -> Belief:
        """Name the heaviest cluster: the fullest cell, and what lies around it."""
        cells = np.floor(self._poses / (_CELL, _CELL, _CELL_TURN)).astype(np.int64)
        keys = (cells[:, 0] * 1_000_003 + cells[:, 1]) * 1_009 + cells[:, 2]
        _, first, count = np.unique(keys, return_index=True, return_counts=True)
        centre = self._poses[first[int(np.argmax(count))]]
        off = self._poses - centre
        off[:, 2] = np.arctan2(np.sin(off[:, 2]), np.cos(off[:, 2]))
        near = np.hypot(off[:, 0], off[:, 1]) < _CLUSTER_DISTANCE
        near &= np.abs(off[:, 2]) < _CLUSTER_TURN
        mean = centre + off[near].mean(axis=0)
        covariance = np.cov(off[near].T) if near.sum() > 1 else np.eye(3)
        share = float(near.mean())
        accepted = share >= _CLUSTER and held(covariance) >= _THRESHOLD
        best = Hypothesis(
            reference=0,
            pose_in_reference=Pose2D(),
            pose=Pose2D.from_array(mean),
            covariance=covariance,
            evaluation=math.nan,
            quality=math.nan,
            score=math.nan,
            probability=share * held(covariance),
            accepted=accepted,
        )
        return Belief((best,), 1.0 - best.probability, accepted)


def _likelihoods(grid: OccupancyGrid) -> NDArray[np.float32]:
    """Likelihood of a reading by the cell in which it ends; last row and column: off the map."""
    distance = np.minimum(grid.clearance, _FARTHEST)
    hit = _HIT * np.exp(-0.5 * np.square(distance / _DEVIATION))
    away = _HIT * math.exp(-0.5 * (_FARTHEST / _DEVIATION) ** 2)
    return np.asarray(np.pad(hit, ((0, 1), (0, 1)), constant_values=away), np.float32)


@kernel
def _likelihood(poses, beams, field, frame):  # type: ignore[no-untyped-def]
    """``1 + sum(p^3)`` of the beams at every pose, as Nav2 weighs."""
    rows, columns = field.shape
    out = np.empty(len(poses))
    random = _RANDOM / _RANGE
    for k in range(len(poses)):
        c, s = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        total = 1.0
        for i in range(len(beams)):
            x = (poses[k, 0] + c * beams[i, 0] - s * beams[i, 1] - frame[0]) / frame[2]
            y = (poses[k, 1] + s * beams[i, 0] + c * beams[i, 1] - frame[1]) / frame[2]
            row, column = rows - 1, columns - 1
            if 0.0 <= x < columns - 1 and 0.0 <= y < rows - 1:
                row, column = int(y), int(x)
            p = field[row, column] + random
            total += p * p * p
        out[k] = total
    return out


@kernel
def _enough(poses, cells, error, quantile, fewest):  # type: ignore[no-untyped-def]
    """How many of the poses KLD sampling takes, in their order, by the cells that they fill."""
    filled = set()
    filled.add((0, 0, 0))
    filled.clear()
    for k in range(len(poses)):
        filled.add(
            (
                int(math.floor(poses[k, 0] / cells[0])),
                int(math.floor(poses[k, 1] / cells[1])),
                int(math.floor((poses[k, 2] % (2.0 * math.pi)) / cells[2])),
            )
        )
        bins = len(filled)
        need = fewest
        if bins > 1:
            a = 2.0 / (9.0 * (bins - 1))
            b = 1.0 - a + math.sqrt(a) * quantile
            need = max(fewest, int(math.ceil((bins - 1) / (2.0 * error) * b * b * b)))
        if k + 1 >= need:
            return k + 1
    return len(poses)
