"""Section 5 taken further: how well a scan fits the map stitched from all references.

The proposals of all relations go through finer and finer sieves: more readings, then only
the best of each place, then a few steps of Gauss-Newton that move the pose until the
readings lie on surfaces, then all readings and the rays that pass through known surfaces.
What is left is a handful of *fits*, each with the numbers that the decision needs.

The last numbers are the paper's e_m seen from the map: the share of readings that agree,
and, beyond the paper, the shares that see through the map or that the map sees through.
Fits are ordered by their *worth*: what the map leaves unexplained and what it contradicts,

    -log(1 - s) - sqrt(through),

with the score ``s`` and the share of rays that pass through known surfaces.  Where references
are sparse and little of a scan can be explained, a wrong pose explains as much by chance, and
often from behind a wall; where they are dense, a door that was opened since costs little.

The paper's anchor points come from large surfaces, since these stay; so what is small may be
new.  At every pose the score is the better one of two worlds: as it was, and with new things in
it, for a price (see ``score.better_score``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .angle_function import AngleFunction, wrapped
from .proposal import spread
from .ranking import best_first
from .rays import passed_through
from .refinement import descended, normal_equations, put_hessian, refined
from .score import Weights, field_scores, score_of
from .segments import is_small
from .tiles import Tiles, look_up, room_for

__all__ = [
    "FEATURES",
    "LARGEST_SCORE",
    "Fits",
    "VerificationSettings",
    "follow",
    "readings",
    "settled",
    "verify",
    "worth",
]

# What is told of every fit: shares of the readings.
FEATURES = ("score", "near", "close", "free", "unknown", "through", "off")
# Scores above this are one: what is left is noise.
LARGEST_SCORE = 0.995
# With fewer readings on large surfaces than this, and than this share, all count as such.
_FEWEST_LARGE, _SMALLEST_SHARE = 20, 0.25


class VerificationSettings(BaseModel):
    """Settings of the sieves between proposals and fits."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    second_readings: int = Field(28, ge=4, description="readings of the second check")
    third_readings: int = Field(80, ge=4, description="readings of the third check")
    third_poses: int = Field(25, ge=1, description="poses that reach the third check")
    fits: int = Field(7, ge=1, description="distinct poses that are refined")
    fit_margin: float = Field(
        0.3, gt=0.0, description="third scores less than the best by more are no rivals"
    )
    fit_readings: int = Field(72, ge=4, description="readings of the refinement")
    iterations: int = Field(6, ge=0, description="steps of the refinement")
    follow_iterations: int = Field(
        8, ge=0, description="the same of expected poses, which may have farther to go"
    )
    distinct_distance: float = Field(0.4, gt=0.0, description="poses nearer are one, metres")
    distinct_turn: float = Field(
        math.radians(15.0), gt=0.0, description="poses turned less are one, radians"
    )
    place_distance: float = Field(0.5, gt=0.0, description="fits nearer are one place, metres")
    place_turn: float = Field(
        math.radians(20.0), gt=0.0, description="fits turned less are one place, radians"
    )
    small_extent: float = Field(
        0.8, ge=0.0, description="way along things that may have come or gone, metres"
    )
    last_readings: int = Field(120, ge=4, description="readings of the last numbers")
    rays: int = Field(45, ge=4, description="rays followed through the map")
    through_margin: float = Field(0.3, gt=0.0, description="end of a ray that may touch, metres")


@dataclass(frozen=True, eq=False)
class Fits:
    """Refined poses, of the highest worth first.

    Args:
        poses: (F, 3) T_set_laser, metres and radians.
        features: (F, 7) of ``FEATURES``.
        hessians: (F, 3, 3) of the refinement, per metre and radian squared.
        residuals: (F,) mean squared distance of the readings that have a surface near, metres
            squared.
        readings: How many readings the shares are of.
    """

    poses: NDArray[np.float64]
    features: NDArray[np.float64]
    hessians: NDArray[np.float64]
    residuals: NDArray[np.float64]
    readings: int

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def highest_score(self) -> float:
        """Of all fits; that of none where there is no fit."""
        return float(self.features[:, FEATURES.index("score")].max(initial=-math.inf))

    def __getitem__(self, chosen: slice) -> Fits:
        """Return some of the fits."""
        return Fits(
            self.poses[chosen],
            self.features[chosen],
            self.hessians[chosen],
            self.residuals[chosen],
            self.readings,
        )


def readings(angles: AngleFunction, settings: VerificationSettings) -> NDArray[np.float64]:
    """Return (N, 3) the returns of a scan: x, y (metres, scan frame), and 1 on small things.

    The paper takes its anchor points from large surfaces only, since these are what stays.  So
    it is with readings: a person, a chair or a stray reading may stand where the map knows
    free space, a wall may not.  A scan that shows hardly anything large has to go by what
    it shows.
    """
    told: NDArray[np.float64] = _readings(
        angles.points, angles.runs, angles.way, settings.small_extent
    )
    return told


@kernel
def _readings(points, runs, way, extent):  # type: ignore[no-untyped-def]
    """Points, and 1 for those on small things, unless hardly any are not."""
    small = is_small(runs, way, extent)
    large = len(small) - np.count_nonzero(small)
    if large < _FEWEST_LARGE or large < _SMALLEST_SHARE * len(small):
        small[:] = False
    told = np.empty((len(points), 3))
    for i in range(len(points)):
        told[i, 0], told[i, 1], told[i, 2] = points[i, 0], points[i, 1], small[i]
    return told


def verify(
    poses: NDArray[np.float64],
    seen: NDArray[np.float64],
    tiles: Tiles,
    weights: Weights,
    settings: VerificationSettings,
) -> Fits:
    """Sieve (P, 3) proposed poses and refine what is left.

    Args:
        poses: T_set_laser, metres and radians.
        seen: (N, 3) readings of the scan, see ``readings``.
        tiles: The stitched map.
        weights: What a reading is worth by the byte of its cell.
        settings: Of the sieves.
    """
    sieves = (
        settings.second_readings,
        settings.third_readings,
        settings.third_poses,
        settings.fits,
        settings.fit_margin,
        (settings.distinct_distance, settings.distinct_turn),
    )
    chosen = _sieve(poses, seen, tiles, weights, sieves)
    places = (settings.place_distance, settings.place_turn)
    rays = (settings.rays, settings.through_margin)
    steps = (settings.fit_readings, settings.iterations, settings.last_readings)
    found = _fit(chosen, seen, tiles, weights, steps, places, rays)
    poses, features, hessians, residuals = found
    count = min(len(seen), settings.last_readings)
    return Fits(poses, features, hessians, residuals, count)


def settled(
    poses: NDArray[np.float64],
    seen: NDArray[np.float64],
    tiles: Tiles,
    settings: VerificationSettings,
) -> NDArray[np.float64]:
    """Move (P, 3) poses that no relation holds until some readings lie on surfaces.

    Args:
        poses: T_set_laser, metres and radians.
        seen: (N, 3) readings of the scan, see ``readings``.
        tiles: The stitched map.
        settings: The second check's readings are taken, and half of the steps of a fit.
    """
    steps = (settings.second_readings, settings.iterations // 2)
    moved: NDArray[np.float64] = _settled(poses, seen, tiles, steps)
    return moved


def follow(
    poses: NDArray[np.float64],
    stiffness: NDArray[np.float64],
    points: NDArray[np.float64],
    tiles: Tiles,
    weights: Weights,
    settings: VerificationSettings,
) -> Fits:
    """Refine (K, 3) expected poses, each held back by how sure the expectation is.

    The robust squared distances of the readings and the square of the move, weighed with the
    stiffness, are made smallest together: along a plain corridor, where no reading holds the
    pose, it stays where it was expected.

    Args:
        poses: T_set_laser, metres and radians.
        stiffness: (K, 3, 3) inverse covariance of each, times the variance of a reading.
        points: (N, 2) end points of the scan's returns, metres, scan frame.
        tiles: The stitched map.
        weights: What a reading is worth by the byte of its cell; no reading counts as small.
        settings: How many readings and steps.

    Returns:
        A fit for every pose, in their order; rays are followed for all of them.
    """
    steps = (settings.fit_readings, settings.follow_iterations, settings.last_readings)
    rays = (settings.rays, settings.through_margin)
    alike = np.column_stack((points, np.zeros(len(points))))
    found = _follow(poses, stiffness, alike, tiles, weights, steps, rays)
    moved, features, hessians, residuals = found
    count = min(len(points), settings.last_readings)
    return Fits(moved, features, hessians, residuals, count)


@kernel
def worth(score, through):  # type: ignore[no-untyped-def]
    """What fits are ordered by, of a score and the share of rays that pass through surfaces."""
    return -math.log(1.0 - min(score, LARGEST_SCORE)) - math.sqrt(through)


@kernel
def _sieve(poses, readings, tiles, weights, sieves):  # type: ignore[no-untyped-def]
    """The best distinct poses by more and more readings, at least two where there are."""
    second, third, most, fits, margin, apart = sieves
    scores = field_scores(poses, spread(readings, second), tiles, weights)
    best = poses[best_first(scores, most)]
    scores = field_scores(best, spread(readings, third), tiles, weights)
    order = best_first(scores, most)
    best = best[order]
    chosen = _distinct(best, apart[0], apart[1], fits)
    left = len(chosen)
    while left > 2 and scores[order[chosen[left - 1]]] < scores[order[0]] - margin:
        left -= 1
    return best[chosen[:left]]


@kernel
def _settled(poses, readings, tiles, steps):  # type: ignore[no-untyped-def]
    """Every pose, refined with a few readings in a few steps."""
    room = room_for(spread(readings, steps[0]))
    moved = np.empty(poses.shape)
    for k in range(len(poses)):
        moved[k] = refined(poses[k], room, tiles, steps[1])
    return moved


@kernel
def _distinct(poses, distance, turn, most):  # type: ignore[no-untyped-def]
    """Indices of the first ``most`` poses that lie apart from all before them."""
    chosen = np.empty(most, np.int64)
    found = 0
    for k in range(len(poses)):
        new = found < most
        for j in chosen[:found]:
            if (
                math.hypot(poses[k, 0] - poses[j, 0], poses[k, 1] - poses[j, 1]) < distance
                and abs(wrapped(poses[k, 2] - poses[j, 2])) < turn
            ):
                new = False
                break
        if new:
            chosen[found] = k
            found += 1
    return chosen[:found]


@kernel
def _features(pose, room, small, tiles, weights, numbers):  # type: ignore[no-untyped-def]
    """The numbers of ``FEATURES`` for one pose, but for the rays."""
    codes = look_up(pose, room, tiles)
    near, close, free, unknown, off = 0, 0, 0, 0, 0
    for code in codes:
        distance = (code & 63) * tiles.reach / 63.0
        is_free = (code & 64) > 0
        near += distance <= 0.1
        close += distance <= 0.2
        free += distance >= tiles.reach and is_free
        unknown += distance >= tiles.reach and not is_free
        off += 0.2 < distance < tiles.reach and is_free
    numbers[1], numbers[2], numbers[3], numbers[4], numbers[6] = near, close, free, unknown, off
    numbers /= max(len(codes), 1)
    numbers[0] = score_of(codes, small, weights)


@kernel
def _fit(poses, readings, tiles, weights, steps, places, rays):  # type: ignore[no-untyped-def]
    """Refine every pose and take the numbers of each place, of the highest worth first."""
    count = len(poses)
    moved = np.empty((count, 3))
    features = np.zeros((count, 7))
    worths = np.empty(count)
    few = room_for(spread(readings, steps[0]))
    many = spread(readings, steps[2])
    small, many = np.flatnonzero(many[:, 2] > 0.0), room_for(many)
    followed = spread(readings, rays[0])
    for k in range(count):
        moved[k] = refined(poses[k], few, tiles, steps[1])
        moved[k, 2] = wrapped(moved[k, 2])
        _features(moved[k], many, small, tiles, weights, features[k])
        features[k, 5] = passed_through(moved[k], followed, tiles, rays[1])
        worths[k] = worth(features[k, 0], features[k, 5])
    order = best_first(worths, count)
    order = order[_distinct(moved[order], places[0], places[1], count)]
    moved, features = moved[order], features[order]
    hessians = np.empty((len(order), 3, 3))
    residuals = np.empty(len(order))
    for k in range(len(order)):
        hessian, _, squares, total = normal_equations(moved[k], few, tiles, 0.1)
        put_hessian(hessian, hessians[k])
        residuals[k] = squares / max(total, 1.0)
    return moved, features, hessians, residuals


@kernel
def _follow(poses, stiffness, readings, tiles, weights, steps, rays):  # type: ignore[no-untyped-def]
    """Refine every expected pose and take all its numbers."""
    count = len(poses)
    moved = np.empty((count, 3))
    features = np.zeros((count, 7))
    hessians = np.empty((count, 3, 3))
    residuals = np.empty(count)
    few = room_for(spread(readings, steps[0]))
    many = spread(readings, steps[2])
    small, many = np.flatnonzero(many[:, 2] > 0.0), room_for(many)
    followed = spread(readings, rays[0])
    for k in range(count):
        moved[k] = _held_back(poses[k], stiffness[k], few, tiles, steps[1])
        _features(moved[k], many, small, tiles, weights, features[k])
        features[k, 5] = passed_through(moved[k], followed, tiles, rays[1])
        hessian, _, squares, total = normal_equations(moved[k], few, tiles, 0.1)
        put_hessian(hessian, hessians[k])
        residuals[k] = squares / max(total, 1.0)
    return moved, features, hessians, residuals


@kernel
def _held_back(pose, k, room, tiles, iterations):  # type: ignore[no-untyped-def]
    """Move a pose as `refined` does, drawn back to where it was by a stiffness ``k``."""
    moved = pose.copy()
    for step in range(iterations):
        scale = 0.2 if 2 * step < iterations else 0.1
        hessian, gradient, _, _ = normal_equations(moved, room, tiles, scale)
        xx, xy, xt, yy, yt, tt = hessian
        hessian = (
            xx + k[0, 0],
            xy + k[0, 1],
            xt + k[0, 2],
            yy + k[1, 1],
            yt + k[1, 2],
            tt + k[2, 2],
        )
        off = (moved[0] - pose[0], moved[1] - pose[1], wrapped(moved[2] - pose[2]))
        gradient = (
            gradient[0] + k[0, 0] * off[0] + k[0, 1] * off[1] + k[0, 2] * off[2],
            gradient[1] + k[1, 0] * off[0] + k[1, 1] * off[1] + k[1, 2] * off[2],
            gradient[2] + k[2, 0] * off[0] + k[2, 1] * off[1] + k[2, 2] * off[2],
        )
        if descended(moved, hessian, gradient) and 2 * step >= iterations:
            break
    moved[2] = wrapped(moved[2])
    return moved
