"""Where a robot may be: places with weights, moved by odometry and weighed by every scan.

The paper's hypotheses are meant to feed probabilistic localization.  Here they feed a mixture of
Gaussians over poses, a few dozen *places*, and two weights for the rest of the world:

    unsearched  anywhere; the next search for the scan in the map says where,
    nowhere     searched and not found: outside of the map, or where no proposal leads.

A scan weighs a place by the share s of its readings that the map explains from there.  On the
recorded drives the odds of a place against any other place grow as

    u = likelihood * (log(1 / (1 - s)) - log(1 / (1 - s0)))  -  see_through * through,

where s0 is the score with which the rest of the world competes and ``through`` the share of
rays that pass through known surfaces.  Readings that end where nobody looked say nothing, so
that a robot may leave the map and come back.  A scan that people block is not taken against a
place where all that it still shows is explained: there u is raised to ``benefit``.

Scans that follow each other err together.  If u wavers around its mean over a way L, the odds
after a drive are those of the mean of the first and the last scan and of the integral of u over
the way in units of 2 L (the likelihood ratio of an Ornstein-Uhlenbeck process).  So every place
has a *weight*, which collects u along the way, and a *support*, which is of the latest scan
alone: standing still proves nothing, and a robot that is carried away is doubted at once.

Where furniture has moved since the map was made, every place explains less, the right one as well,
and u alone cannot tell it from the rest of the world.  A search can: it compares what is explained
with the best other place in the map.  Its answer comes with the calibrated probability p that it
is right, and its odds against a robot that is nowhere in the map are

    a = answer_constant + answer_weight * log(p / (1 - p)).

Both u and a are of the same scan, so they are not added: the place of the answer gets the larger
of the two, and keeps what a is above u for a short way, over which it fades.  Like u it counts by
the way driven.  A sure answer also speaks against every other place: the search has compared it
with them, and so errs much more rarely where one of them is right than where the map shows
nothing of what the robot sees.  They lose a, up to ``answered_against``, in the same way; an
unsure answer, as the right place has among look-alikes, takes nothing.  And an answer speaks, by
a, for all that had not been searched before, be its place new or one that was given up: this is
how a robot that was carried away is found again.

A search also says when the pose of a known place has slipped: what it finds within reach of a
place, by the covariances of both, is either another place or where this one is truly.  So it
starts with a share of its weight, taken off it.  Poses that are all but equal are joined at once,
and the likelier is kept; further off, both are followed.  Whoever acts on a pose does not mind
which of two it is that are a hand apart, so those are reported together, as the likelier; of
others nothing is reported until the way has told which it is.

Weights compare places with each other; whether the best of them is any good is another matter.
A pose that slips off along a corridor or where little is known, or one carried on in a place
that looks alike, has no rival yet.  So every place keeps its *record*, the mean of u over the
latest way, and only a place is reported whose record is not bad, neither by itself nor beside
that of another place.  For the same reason a scan holds a pose only as much as it fits there:
its information counts with the probability that u stands for, by itself and not by an answer,
and with the share of its readings that the map explains, since the few that happen to lie near
a surface where the map ends turn a pose without telling it.  And walls are never quite
straight: along a plain corridor they seem to hold the pose by a small share of what they do
across it, and scan after scan would make certain what none of them can tell.  So that share of
the information of the best direction is taken off in every direction.

The constants are fitted on the development logs; the page on the belief says how.  Those of a come
from a logistic regression between right answers in known buildings and answers in others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .angle_function import wrapped
from .covariance import inverses
from .field import FieldSettings
from .motion import Motion, MotionSettings
from .score import Weights
from .verification import FEATURES, LARGEST_SCORE, Fits

__all__ = [
    "BeliefSettings",
    "Claim",
    "Found",
    "Mixture",
    "admitted",
    "claimed",
    "has_stood",
    "log_odds",
    "moved",
    "nothing_known",
    "probabilities",
    "stiffness",
    "tidied",
    "together",
    "weighed",
]

_SCORE, _CLOSE, _FREE, _UNKNOWN, _THROUGH = (
    FEATURES.index(name) for name in ("score", "close", "free", "unknown", "through")
)
_SMALLEST_SHARE = 0.05
_LEAST_PROBABILITY = 1e-4
# Of the limits of one place: nearer poses are the same fit, and need no second look.
_REFOUND_DISTANCE, _REFOUND_TURN = 2.0 / 3.0, 1.0 / 3.0
_NEVER = -1e3  # logarithm of a weight that is none, finite so that differences are


class BeliefSettings(BaseModel):
    """Settings of the belief over time."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    motion: MotionSettings = MotionSettings()
    likelihood: float = Field(6.0, gt=0.0, description="weight of log(1 / (1 - score))")
    elsewhere: float = Field(
        0.88, gt=0.0, lt=1.0, description="score with which the rest of the world competes"
    )
    sharpness: float = Field(
        0.4, gt=0.0, description="distance to a surface with which a reading scores nothing, metres"
    )
    free_penalty: float = Field(
        0.5, ge=0.0, description="score that a reading in known free space loses"
    )
    see_through: float = Field(
        6.3, ge=0.0, description="weight of the root of the share of rays that see through"
    )
    shown_likelihood: float = Field(
        3.5, gt=0.0, description="the same as likelihood, of the readings that may not be blocked"
    )
    shown_elsewhere: float = Field(
        0.917, gt=0.0, lt=1.0, description="the same as elsewhere, of those readings"
    )
    doubt: float = Field(0.9, ge=0.0, description="log odds against a view that may be blocked")
    benefit: float = Field(0.5, description="most log odds for a view that may be blocked")
    most_against: float = Field(6.0, gt=0.0, description="log odds that one scan can take")
    most_for: float = Field(4.0, gt=0.0, description="log odds that one scan can give")
    answer_constant: float = Field(-2.5, description="log odds of an answer that is half sure")
    answer_weight: float = Field(
        1.4, ge=0.0, description="weight of the log odds of an answer's probability"
    )
    most_answered: float = Field(6.0, ge=0.0, description="log odds that one answer can give")
    answered_against: float = Field(
        3.0, ge=0.0, description="most log odds that an answer takes from every other place"
    )
    answer_fades: float = Field(
        4.0, gt=0.0, description="way on which what an answer added fades, metres"
    )
    answer_deviation: float = Field(
        0.17, gt=0.0, description="of the position of a place that an accepted answer found, metres"
    )
    support: float = Field(
        0.5, ge=0.0, le=1.0, description="share of the log odds that the latest scan has at once"
    )
    way_alike: float = Field(2.0, gt=0.0, description="way on which scans err together, metres")
    turn_alike: float = Field(2.0, gt=0.0, description="the same of a turn on the spot, radians")
    still: float = Field(0.01, ge=0.0, description="share of new evidence in a scan at rest")
    carried_away: float = Field(
        1e-3, gt=0.0, lt=1.0, description="probability of being carried away, per metre"
    )
    search_again: float = Field(
        0.1, ge=0.0, description="share of 'nowhere' that is searched again, per metre"
    )
    reading_deviation: float = Field(
        0.16, gt=0.0, description="of a reading, as many err together, metres"
    )
    found_deviation: float = Field(
        0.3, gt=0.0, description="of the position of a place when it is found, metres"
    )
    found_turn: float = Field(0.15, gt=0.0, description="of its heading, radians")
    same_distance: float = Field(0.15, gt=0.0, description="places nearer are one, metres")
    same_turn: float = Field(0.15, gt=0.0, description="places turned less are one, radians")
    together: float = Field(
        0.3, gt=0.0, description="poses nearer are reported as one, which is the likeliest, metres"
    )
    reach: float = Field(
        3.0, ge=0.0, description="deviations within which a place may have been mistaken"
    )
    mistaken: float = Field(0.1, ge=0.0, le=1.0, description="probability that it was")
    places: int = Field(32, ge=1, description="most places that are kept")
    smallest: float = Field(1e-6, ge=0.0, description="probability of a place worth keeping")
    news: float = Field(
        2.0, gt=0.0, description="how much sooner scans tell of the pose anew than of the place"
    )
    spurious: float = Field(
        0.2, ge=0.0, le=1.0, description="share of information that walls pretend along them"
    )
    record_way: float = Field(0.5, gt=0.0, description="way of a place's record, metres")
    least_record: float = Field(0.0, description="mean log odds of a place that is reported")
    rival_record: float = Field(
        2.5, gt=0.0, description="how much better the record of another place may be"
    )
    search_spacing: float = Field(
        0.5, ge=0.0, description="way between searches of the whole map while lost, metres"
    )
    search_less: float = Field(
        0.1, ge=0.0, description="share of the way since it was located that the same grows to"
    )
    check_spacing: float = Field(
        2.0, ge=0.0, description="the same while located, and the most, metres"
    )
    threshold: float = Field(0.99, gt=0.0, lt=1.0, description="probability that is reported")

    def readings(self, field: FieldSettings) -> Weights:
        """What a reading is worth, by the byte of the cell in which it ends; none is small.

        Milder than the scores that the search orders by: over time it counts more that the
        right place never looks wrong than that the best scan stands out.
        """
        distance = (np.arange(256) & 63) * field.reach / 63.0
        score = np.maximum(0.0, 1.0 - distance / self.sharpness)
        score[127] = score[255] = -self.free_penalty
        return Weights(score.astype(np.float32), np.zeros(256, np.bool_), 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Mixture:
    """Places and their weights; logarithms of weights, summing to one with the support.

    Args:
        poses: (K, 3) T_set_laser, metres and radians.
        covariances: (K, 3, 3) of x, y and theta, set's frame.
        weights: (K,) collected along the way.
        support: (K,) log odds of the latest scan.
        record: (K,) mean log odds over the latest way.
        answered: (K,) log odds that the latest answer adds to those of a scan, or takes.
        unsearched: Of anywhere else.
        nowhere: Of what was searched and not found.
    """

    poses: NDArray[np.float64]
    covariances: NDArray[np.float64]
    weights: NDArray[np.float64]
    support: NDArray[np.float64]
    record: NDArray[np.float64]
    answered: NDArray[np.float64]
    unsearched: float = 0.0
    nowhere: float = _NEVER

    def __len__(self) -> int:
        return len(self.weights)


@dataclass(frozen=True, eq=False)
class Found:
    """What a search of the map says of one scan.

    Args:
        poses: (F, 3) T_set_laser, best first, metres and radians.
        probability: That the first is right.
        accepted: Whether that is an answer by itself.
    """

    poses: NDArray[np.float64]
    probability: float = 0.0
    accepted: bool = False


@dataclass(frozen=True)
class Claim:
    """That a place is the right one.

    Args:
        place: Its index.
        odds: Logarithm of its odds against a robot that is nowhere in the map.
    """

    place: int
    odds: float


def nothing_known() -> Mixture:
    """Return the belief of a robot that was just switched on."""
    none = np.empty(0)
    return Mixture(np.empty((0, 3)), np.empty((0, 3, 3)), none, none, none, none)


def moved(mixture: Mixture, step: Motion, settings: BeliefSettings) -> Mixture:
    """Move all places by a step of the robot and spread them by its uncertainty."""
    way = step.driven + 0.5 * step.turned + 0.01
    again = min(settings.search_again * way, 0.5)
    away = min(settings.carried_away * way, 0.5)
    total = _log_sum(mixture.weights + settings.support * mixture.support)
    unsearched = _log_sum(
        np.array([mixture.unsearched, mixture.nowhere + _log(again), total + _log(away)])
    )
    poses, covariances = _moved(
        mixture.poses, mixture.covariances, step.step.to_array(), step.covariance
    )
    return replace(
        mixture,
        poses=poses,
        covariances=covariances,
        weights=mixture.weights + math.log1p(-away),
        answered=mixture.answered * math.exp(-way / settings.answer_fades),
        unsearched=unsearched,
        nowhere=mixture.nowhere + math.log1p(-again),
    )


def admitted(
    mixture: Mixture, found: Found, settings: BeliefSettings
) -> tuple[Mixture, NDArray[np.int64]]:
    """Take in the places that a search of the map found, where they are new.

    A place within reach of one that was known may be that one, mistaken (along a corridor, or
    after a step without odometry), and inherits from it; so does another pose of the same
    place, but not one that is all but equal.  What earlier answers added is forgotten.

    Returns:
        The mixture, new places last and without weight; (K,) index of the place that each
        comes from: its own if it was known, -1 if it comes from what was unsearched.
    """
    # Nearly all accepted answers are within half a metre: three of these deviations.
    position = np.full(len(found.poses), settings.found_deviation)
    position[: int(found.accepted)] = settings.answer_deviation
    turn = np.full(len(position), settings.found_turn)
    spread = np.square(np.column_stack([position, position, turn]))[:, :, None] * np.eye(3)
    same = (_REFOUND_DISTANCE * settings.same_distance, _REFOUND_TURN * settings.same_turn)
    new, parents = _new(
        (mixture.poses, mixture.covariances, mixture.weights),
        (found.poses, spread),
        same,
        settings.reach,
    )
    count, spread = len(new), spread[new]
    origin = np.concatenate([np.arange(len(mixture)), parents])
    return replace(
        mixture,
        poses=np.concatenate([mixture.poses, found.poses[new]]),
        covariances=np.concatenate([mixture.covariances, spread]),
        weights=np.concatenate([mixture.weights, np.full(count, _NEVER)]),
        support=np.concatenate([mixture.support, np.zeros(count)]),
        record=np.concatenate([mixture.record, np.zeros(count)]),
        answered=np.zeros(len(mixture) + count),
    ), origin


def claimed(mixture: Mixture, found: Found, settings: BeliefSettings) -> Claim | None:
    """Say at which of the places, those just found among them, the answer of a search is."""
    if not len(found.poses):
        return None
    off = mixture.poses - found.poses[0]
    distance = np.hypot(off[:, 0], off[:, 1])
    turn = np.abs(np.arctan2(np.sin(off[:, 2]), np.cos(off[:, 2])))
    same = (distance < settings.same_distance) & (turn < settings.same_turn)
    p = min(max(found.probability, _LEAST_PROBABILITY), 1.0 - _LEAST_PROBABILITY)
    odds = settings.answer_constant + settings.answer_weight * math.log(p / (1.0 - p))
    place = int(np.argmin(np.where(same, distance, math.inf)))
    return Claim(place, min(odds, settings.most_answered))


def stiffness(mixture: Mixture, settings: BeliefSettings) -> NDArray[np.float64]:
    """Return (K, 3, 3) how firmly each place holds its pose against the readings of a scan."""
    held: NDArray[np.float64] = inverses(mixture.covariances) * settings.reading_deviation**2
    return held


def log_odds(fits: Fits, settings: BeliefSettings) -> NDArray[np.float64]:
    """Return (K,) u of the module's text for every place."""
    score, close, free, unknown, through = fits.features[
        :, [_SCORE, _CLOSE, _FREE, _UNKNOWN, _THROUGH]
    ].T
    against = settings.see_through * np.sqrt(through)
    seen = np.maximum(1.0 - unknown, _SMALLEST_SHARE)
    plain = settings.likelihood * seen * _excess(score / seen, settings.elsewhere) - against
    shown = np.maximum(close, _SMALLEST_SHARE)
    rest = _excess((score + settings.free_penalty * free) / shown, settings.shown_elsewhere)
    blocked = settings.shown_likelihood * shown * rest - settings.doubt - against
    odds = np.maximum(plain, np.minimum(blocked, settings.benefit))
    return np.asarray(np.clip(odds, -settings.most_against, settings.most_for))


def _excess(score: NDArray[np.float64], elsewhere: float) -> NDArray[np.float64]:
    """Logarithm of how much less a score leaves unexplained than the rest of the world."""
    rest = 1.0 - np.clip(score, 0.0, LARGEST_SCORE)
    return math.log(1.0 - elsewhere) - np.log(rest)


def weighed(
    mixture: Mixture,
    fits: Fits,
    origin: NDArray[np.int64],
    share: float,
    settings: BeliefSettings,
    claim: Claim | None = None,
) -> Mixture:
    """Weigh all places by how well a scan fits there.

    Args:
        mixture: The places as they were expected, those just found last.
        fits: Of the scan at every place.
        origin: (K,) where each comes from, as `admitted` says.
        share: Of new evidence in this scan, in [0, 1].
        settings: Of the belief.
        claim: The answer of a search for this scan, where there was one.
    """
    plain, answered, count = log_odds(fits, settings), mixture.answered, len(mixture)
    if claim is not None:
        answered = np.full(count, -min(max(claim.odds, 0.0), settings.answered_against))
        answered[claim.place] = max(claim.odds - plain[claim.place], 0.0)
    odds = plain + answered
    weights = mixture.weights.copy()
    known = origin == np.arange(count)
    inherits = ~known & (origin >= 0)
    children = np.bincount(origin[inherits], minlength=count)
    weights[inherits] = (weights - np.log(np.maximum(children, 1)))[origin[inherits]]
    weights[inherits] += _log(settings.mistaken)
    weights[children > 0] += math.log1p(-settings.mistaken)
    weights[known | inherits] += share * odds[known | inherits]
    unsearched, nowhere = mixture.unsearched, mixture.nowhere
    found = origin < 0
    if claim is not None:
        found[claim.place] = True
        unsearched += max(claim.odds, 0.0)
    if found.any():
        total = _log_sum(np.append(odds[found], 0.0))
        fresh = unsearched + (1.0 - settings.support) * odds[found] - total
        weights[found] = np.logaddexp(np.where(origin[found] < 0, _NEVER, weights[found]), fresh)
        nowhere = _log_sum(np.array([nowhere, unsearched - total]))
        unsearched = _NEVER
    new = np.where(known, min(settings.news * share, 1.0), 1.0)
    new *= np.clip(fits.features[:, _SCORE], 0.0, 1.0) / (1.0 + np.exp(-plain))
    information = _certain(fits.hessians, settings.spurious)
    information *= (new / settings.reading_deviation**2)[:, None, None]
    covariances = inverses(inverses(mixture.covariances) + information)
    latest = min(share * settings.way_alike / settings.record_way, 1.0)
    record = np.where(known, mixture.record + latest * (odds - mixture.record), odds)
    return Mixture(fits.poses, covariances, weights, odds, record, answered, unsearched, nowhere)


def tidied(mixture: Mixture, settings: BeliefSettings) -> Mixture:
    """Join places that have become one, drop the least likely, and let the weights sum to one."""
    total = mixture.weights + settings.support * mixture.support
    order = np.argsort(-total, kind="stable")
    owner = _owners(mixture.poses[order], settings.same_distance, settings.same_turn)
    weights = mixture.weights[order]
    for k in np.flatnonzero(owner != np.arange(len(order))):
        weights[owner[k]] = _log_sum(np.array([weights[owner[k]], weights[k]]))
    kept = np.flatnonzero(owner == np.arange(len(order)))
    order, weights = order[kept], weights[kept]
    support = mixture.support[order]
    total = weights + settings.support * support
    one = _log_sum(np.append(total, [mixture.unsearched, mixture.nowhere]))
    good = total - one >= _log(settings.smallest)
    good[settings.places :] = False
    lost = _log_sum(np.append(total[~good], mixture.nowhere))
    return Mixture(
        mixture.poses[order[good]],
        mixture.covariances[order[good]],
        weights[good] - one,
        support[good],
        mixture.record[order[good]],
        mixture.answered[order[good]],
        max(mixture.unsearched - one, _NEVER),
        max(lost - one, _NEVER),
    )


def probabilities(mixture: Mixture, settings: BeliefSettings) -> NDArray[np.float64]:
    """Return (K,) that the robot is at each place; what is missing to one is elsewhere."""
    total = mixture.weights + settings.support * mixture.support
    one = _log_sum(np.append(total, [mixture.unsearched, mixture.nowhere]))
    return np.asarray(np.exp(total - one))


def together(
    mixture: Mixture, settings: BeliefSettings
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Take poses that are as good as one for whoever acts on them together.

    Returns:
        (N,) places, likeliest first, no two of which are nearer than that; (N,) probability of
        each with all that are nearer to it than to one before.
    """
    worth = probabilities(mixture, settings)
    order = np.argsort(-worth, kind="stable")
    owner = _owners(mixture.poses[order], settings.together, settings.same_turn)
    summed = np.bincount(owner, worth[order], minlength=len(order)).astype(np.float64)
    named = np.flatnonzero(owner == np.arange(len(order)))
    return order[named], summed[named]


def has_stood(mixture: Mixture, place: int, settings: BeliefSettings) -> bool:
    """Whether the latest scans speak neither against a place nor much more for another one."""
    record = float(mixture.record[place])
    beaten = float(mixture.record.max()) - record > settings.rival_record
    return record >= settings.least_record and not beaten


def _log(value: float) -> float:
    return math.log(value) if value > 0.0 else _NEVER


def _log_sum(values: NDArray[np.float64]) -> float:
    """Logarithm of the sum of exponentials; ``_NEVER`` of none."""
    if not len(values):
        return _NEVER
    largest = float(values.max())
    return max(largest + math.log(float(np.exp(values - largest).sum())), _NEVER)


@kernel
def _moved(poses, covariances, step, noise):  # type: ignore[no-untyped-def]
    """Chain every pose with a step and carry both covariances along."""
    out = np.empty((len(poses), 3))
    spread = np.empty((len(poses), 3, 3))
    for k in range(len(poses)):
        c, s = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        x, y = c * step[0] - s * step[1], s * step[0] + c * step[1]
        out[k, 0] = poses[k, 0] + x
        out[k, 1] = poses[k, 1] + y
        out[k, 2] = wrapped(poses[k, 2] + step[2])
        before = covariances[k]
        a = before[0, 0] - y * before[0, 2] - y * (before[0, 2] - y * before[2, 2])
        b = before[0, 1] + x * before[0, 2] - y * (before[1, 2] + x * before[2, 2])
        d = before[1, 1] + x * before[1, 2] + x * (before[1, 2] + x * before[2, 2])
        e, f = before[0, 2] - y * before[2, 2], before[1, 2] + x * before[2, 2]
        # The noise turns with the laser.
        p, q, r = noise[0, 0], noise[0, 1], noise[1, 1]
        u, v = noise[0, 2], noise[1, 2]
        spread[k, 0, 0] = a + c * c * p - 2.0 * c * s * q + s * s * r
        spread[k, 1, 1] = d + s * s * p + 2.0 * c * s * q + c * c * r
        spread[k, 0, 1] = spread[k, 1, 0] = b + c * s * (p - r) + (c * c - s * s) * q
        spread[k, 0, 2] = spread[k, 2, 0] = e + c * u - s * v
        spread[k, 1, 2] = spread[k, 2, 1] = f + s * u + c * v
        spread[k, 2, 2] = before[2, 2] + noise[2, 2]
    return out, spread


@kernel
def _certain(hessians, spurious):  # type: ignore[no-untyped-def]
    """Shrink every (3, 3) information along the axes of its position part.

    Along each axis what is left of the information l is l - spurious * (the larger l), at least
    none.
    """
    out = np.empty(hessians.shape)
    for k in range(len(hessians)):
        h = hessians[k]
        mean, half = 0.5 * (h[0, 0] + h[1, 1]), 0.5 * (h[0, 0] - h[1, 1])
        size = math.hypot(half, h[0, 1])
        large, small = mean + size, mean - size
        axis = 0.5 * math.atan2(h[0, 1], half)
        c, s = math.cos(axis), math.sin(axis)
        first = math.sqrt(max(1.0 - spurious, 0.0))
        second = 0.0
        if small > spurious * large:
            second = math.sqrt(1.0 - spurious * large / small)
        # Shrinking from both sides keeps the matrix positive.
        a = first * c * c + second * s * s
        b = (first - second) * c * s
        d = first * s * s + second * c * c
        p, q = a * h[0, 0] + b * h[0, 1], a * h[0, 1] + b * h[1, 1]
        r, t = b * h[0, 0] + d * h[0, 1], b * h[0, 1] + d * h[1, 1]
        out[k, 0, 0] = p * a + q * b
        out[k, 0, 1] = out[k, 1, 0] = p * b + q * d
        out[k, 1, 1] = r * b + t * d
        out[k, 0, 2] = out[k, 2, 0] = a * h[0, 2] + b * h[1, 2]
        out[k, 1, 2] = out[k, 2, 1] = b * h[0, 2] + d * h[1, 2]
        out[k, 2, 2] = h[2, 2]
    return out


@kernel
def _is_same(a, b, same):  # type: ignore[no-untyped-def]
    """Whether two poses are one place."""
    return math.hypot(a[0] - b[0], a[1] - b[1]) < same[0] and abs(wrapped(a[2] - b[2])) < same[1]


@kernel
def _owners(poses, distance, turn):  # type: ignore[no-untyped-def]
    """Index of the first place that each is one with, which is its own if there is none."""
    owner = np.arange(len(poses))
    for k in range(len(poses)):
        for j in range(k):
            if owner[j] == j and _is_same(poses[k], poses[j], (distance, turn)):
                owner[k] = j
                break
    return owner


@kernel
def _new(known, found, same, reach):  # type: ignore[no-untyped-def]
    """Which found poses are new, and the heaviest place within reach of each, or -1."""
    poses, covariances, weights = known
    new = np.empty(len(found[0]), np.int64)
    parents = np.empty(len(found[0]), np.int64)
    count = 0
    for n in range(len(found[0])):
        is_new, parent, best = True, -1, -np.inf
        information = inverses(covariances + found[1][n])
        for k in range(len(poses)):
            if _is_same(found[0][n], poses[k], same):
                is_new = False
                break
            x, y = found[0][n, 0] - poses[k, 0], found[0][n, 1] - poses[k, 1]
            t = wrapped(found[0][n, 2] - poses[k, 2])
            i = information[k]
            off = x * x * i[0, 0] + y * y * i[1, 1] + t * t * i[2, 2]
            off += 2.0 * (x * y * i[0, 1] + x * t * i[0, 2] + y * t * i[1, 2])
            if off < reach * reach and weights[k] > best:
                parent, best = k, weights[k]
        if is_new:
            new[count] = n
            parents[count] = parent
            count += 1
    return new[:count], parents[:count]
