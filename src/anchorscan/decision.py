"""From fits to probabilities: how sure one scan can be, and when to say "not known".

The paper thresholds e_m and leaves probabilities to the filter.  Nearly all confident wrong
answers have a near-equal twin elsewhere: the same shape in another room.  Where references are
sparse, a short piece of wall fits many places, and the twin may be where nobody looked.  So the
probability that the best fit is right is a logistic function of five numbers:

    log m           of the margin m of its worth (see ``verification``) to the best fit at
                    another place,
    -log(1 - s)     of its score s: how much of the scan the map explains,
    sqrt(through)   of the share of rays that pass through known surfaces,
    log(1 + h)      of the information h that the explained readings give on the heading: it
                    grows with their number and the square of how far around they lie,
    log(1 + a)      of the number a of anchor points of the scan: how much shape it shows.

The first three compare the fit with others and with the map; the last two say how much the
scan could tell at all, so that less of a margin will do for a wide view of many corners than
for a look into a plain corner.

The scans behind this have 120 readings or more.  Fewer can agree by chance, so that up to ten
are held not to, the fewer there are the more.

This is the probability of the right *place*.  A scan of few readings, or of a plain corridor, may
be explained without a rest and still not hold the pose: so the probability is multiplied by how
much of the pose's covariance lies within what counts as correct.  On the development logs
neither changes an answer, since what was answered there is held to 9 cm in 99 of 100 cases;
without them a scan with a single reading is an answer.

**Twins.**  Two places may be the same: rooms of one hotel, or one building in two sets.  Whichever
is right, how much of the scan they explain differs only by how the map's grid happens to lie: by
0.004 to 0.008 in the root mean square for drives whose map was doubled, by 0.008 to 0.017 for
simulated buildings, whose walls are straight.  A logistic of logarithms does not see that where
nearly all is explained, and the evidence that it was fitted to has no twins.  So the probability is
held to at most

    1 - exp(-(m / twins)^2 / 2) / 2

with the score's margin ``m`` to the highest of any other place, whatever rays see through there:
doors are opened and walls taken away.

**Upside down.**  A laser that hangs upside down without anybody knowing shows the mirror image of
every room, and a room on the left of a corridor is the mirror image of one on the right.  With
``both_ways`` the scan is asked upside down, too, and the best place found then counts as one more
that may be the same.

Where two or three places explain a scan alike, their scores no farther apart than those of equal
places, none is an answer, and to say "not known" would keep something back: it is at one of them.
Such a scan is *ambiguous*: without the other places the best would be an answer.  They are left
out one by one, best first, until it is, and share what it is worth then.

What is left goes to the other fits, and to "somewhere else", in proportion to
``exp(rivalry * worth)``; "somewhere else" competes with a fixed score.  No fit gets more than
the best: what that would be is "somewhere else", too.

The coefficients come from ``anchorscan calibrate``, which fits them on some buildings and
reports on the others, in turn; what it gave stands on the calibration page of the
documentation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .covariance import held, inverses
from .verification import FEATURES, LARGEST_SCORE, Fits, worth

__all__ = [
    "Decision",
    "DecisionSettings",
    "beside",
    "covariance",
    "decide",
    "evidence",
    "worths",
]

_SCORE, _THROUGH = FEATURES.index("score"), FEATURES.index("through")
_SMALLEST_MARGIN = 0.003
_MANY_READINGS, _LUCKY_READINGS = 120, 10.0


class DecisionSettings(BaseModel):
    """Settings of the decision."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    constant: float = Field(-5.10, description="of the logistic function")
    log_margin: float = Field(1.35, description="weight of the logarithm of the margin")
    explained: float = Field(1.41, description="weight of -log(1 - score)")
    through: float = Field(
        -3.27, description="weight of the root of the share of rays that see through"
    )
    heading: float = Field(0.71, description="weight of the logarithm of what holds the heading")
    anchors: float = Field(1.03, description="weight of the logarithm of the anchor points")
    rivalry: float = Field(4.5, gt=0.0, description="of the fits for what the best leaves")
    elsewhere: float = Field(0.8, description="score with which 'somewhere else' competes")
    threshold: float = Field(0.96, gt=0.0, le=1.0, description="probability that is an answer")
    range_deviation: float = Field(
        0.03, gt=0.0, description="least standard deviation of a reading, metres"
    )
    readings_alike: float = Field(
        1.8, ge=1.0, description="readings that err together: so many count as one"
    )
    twins: float = Field(
        0.012, gt=0.0, description="how far the scores of equal places lie apart, root mean square"
    )
    both_ways: bool = Field(
        False,
        description="accept only what fits better than upside down, in a map; takes twice as long",
    )
    most_alike: int = Field(3, ge=1, description="places that an ambiguous answer names at most")
    widest_deviation: float = Field(
        5.0, gt=0.0, description="standard deviation where nothing holds the pose, metres, radians"
    )

    @property
    def weights(self) -> tuple[float, ...]:
        """Of the numbers of ``evidence``, in their order."""
        return (
            self.constant,
            self.log_margin,
            self.explained,
            self.through,
            self.heading,
            self.anchors,
        )


@dataclass(frozen=True, eq=False)
class Decision:
    """What the fits of one scan are worth.

    Args:
        probabilities: (F,) that each fit is right.
        elsewhere: Probability that none is.
        alike: How many of the first fits explain the scan alike, so that it was taken at one of
            them: 1 where the first is an answer, 2 or more where it is ambiguous, 0 where
            nothing is known.
        upside_down: Highest score of the mirror image of the scan; minus infinity where that was
            not asked.
    """

    probabilities: NDArray[np.float64]
    elsewhere: float
    alike: int
    upside_down: float = -math.inf

    @property
    def accepted(self) -> bool:
        """Whether the first is an answer."""
        return self.alike == 1

    def is_ambiguous(self, rank: int) -> bool:
        """Tell whether the fit of a rank is one of several that explain the scan alike."""
        return rank < self.alike and not self.accepted


def evidence(fits: Fits, anchors: int) -> NDArray[np.float64]:
    """Return the (6,) numbers that speak for the best fit: 1 and those of the module's text.

    A fit without a rival has a margin as if the rival scored half as much.

    Args:
        fits: At least one.
        anchors: How many anchor points the scan has.
    """
    counts = (fits.readings, anchors)
    numbers: NDArray[np.float64] = _evidence(fits.features, 1, fits.hessians[0, 2, 2], counts)
    return numbers


@kernel
def _evidence(features, second, heading, counts):  # type: ignore[no-untyped-def]
    """What speaks for the best fit against that of rank ``second`` and those behind it."""
    readings, anchors = counts
    score, through = features[0, _SCORE], features[0, _THROUGH]
    rival = worth(0.5 * score, 0.0)
    if len(features) > second:
        rival = worth(features[second, _SCORE], features[second, _THROUGH])
    margin = max(worth(score, through) - rival, _SMALLEST_MARGIN)
    rest = 1.0 - min(score, LARGEST_SCORE)
    rest += _LUCKY_READINGS * max(0.0, 1.0 / max(readings, 1) - 1.0 / _MANY_READINGS)
    return np.array(
        [
            1.0,
            math.log(margin),
            -math.log(rest),
            math.sqrt(through),
            math.log1p(heading),
            math.log1p(float(anchors)),
        ]
    )


def covariance(fits: Fits, settings: DecisionSettings) -> NDArray[np.float64]:
    """Return (F, 3, 3) covariances of x, y, theta in the set's frame.

    The inverse of the Hessian of the refinement, scaled by the residuals that were observed:
    wide along a plain corridor, where no reading holds the pose.
    """
    covariances: NDArray[np.float64] = _covariances(
        fits.hessians, fits.residuals, _deviations(settings)
    )
    return covariances


def _deviations(settings: DecisionSettings) -> tuple[float, float, float]:
    """Return least variance, readings that err together, and what is always known of a pose."""
    widest = 1.0 / settings.widest_deviation**2
    return settings.range_deviation**2, settings.readings_alike, widest


@kernel
def _covariances(hessians, residuals, deviations):  # type: ignore[no-untyped-def]
    """Inverse of each scaled Hessian plus a floor."""
    least, alike, floor = deviations
    information = np.empty(hessians.shape)
    for k in range(len(hessians)):
        scale = max(residuals[k], least) * alike
        for row in range(3):
            for column in range(3):
                information[k, row, column] = hessians[k, row, column] / scale
            information[k, row, row] += floor
    return inverses(information)


def decide(
    fits: Fits, anchors: int, settings: DecisionSettings, upside_down: float = -math.inf
) -> Decision:
    """Say how likely each fit is, best first, and whether the best is an answer.

    Args:
        fits: Of the scan.
        anchors: How many anchor points the scan has.
        settings: Of the decision.
        upside_down: Highest score of the mirror image of the scan, where that was asked.
    """
    if not len(fits):
        return Decision(np.empty(0), 1.0, 0)
    probabilities, elsewhere, alike = _decided(
        fits.features,
        fits.hessians,
        fits.residuals,
        (fits.readings, anchors),
        settings.weights,
        _deviations(settings),
        (settings.elsewhere, settings.rivalry),
        (settings.threshold, settings.most_alike, settings.twins, upside_down),
    )
    return Decision(probabilities, elsewhere, alike, upside_down)


def beside(fits: Fits, settings: DecisionSettings) -> float:
    """Return the most that the best fit can be worth beside the others, one of which may be a twin.

    Args:
        fits: At least one.
        settings: Of the decision.
    """
    return float(_beside(fits.features, 1, settings.twins, -math.inf))


@kernel
def _decided(features, hessians, residuals, counts, weights, deviations, others, answer):  # type: ignore[no-untyped-def]
    """Probability of each fit, of none of them, and how many of the first are alike."""
    known = held(_covariances(hessians[:1], residuals[:1], deviations)[0])
    threshold, most, twins, upside_down = answer
    told = (hessians[0, 2, 2], counts, weights, known, twins, upside_down)
    # Which places are alike, they say themselves; what fits upside down speaks against them all.
    best = _likely(features, 1, told)
    alone, alike = best, 1
    while (
        alone < threshold
        and alike < min(most, len(features))
        and _beside(features[: alike + 1], alike, twins, -np.inf) < threshold
    ):
        alike += 1
        alone = _likely(features, alike, told)
    if alone < threshold:
        alone, alike = best, 0
    shared, elsewhere = _shared(
        (best, alone, max(alike, 1)), _worths(features), worth(others[0], 0.0), others[1]
    )
    return shared, elsewhere, alike


@kernel
def _likely(features, second, told):  # type: ignore[no-untyped-def]
    """Probability of the best fit beside those from rank ``second`` on."""
    heading, counts, weights, known, twins, upside_down = told
    place = _place(_evidence(features, second, heading, counts), weights)
    return min(known * place, _beside(features, second, twins, upside_down))


@kernel
def _beside(features, second, twins, upside_down):  # type: ignore[no-untyped-def]
    """The most that the best fit can be worth beside those from rank ``second`` on."""
    margin = max(features[0, _SCORE] - upside_down, 0.0)
    for k in range(second, len(features)):
        margin = min(margin, max(features[0, _SCORE] - features[k, _SCORE], 0.0))
    return 1.0 - 0.5 * math.exp(-0.5 * (margin / twins) ** 2)


@kernel
def _place(numbers, weights):  # type: ignore[no-untyped-def]
    """Probability of the right place: the logistic function, which takes any value."""
    log_odds = 0.0
    for k in range(len(numbers)):
        log_odds += numbers[k] * weights[k]
    return 0.5 * (1.0 + math.tanh(0.5 * log_odds))


def worths(fits: Fits) -> NDArray[np.float64]:
    """Return (F,) what the fits are ordered by."""
    ordered_by: NDArray[np.float64] = _worths(fits.features)
    return ordered_by


@kernel
def _worths(features):  # type: ignore[no-untyped-def]
    out = np.empty(len(features))
    for k in range(len(features)):
        out[k] = worth(features[k, _SCORE], features[k, _THROUGH])
    return out


@kernel
def _shared(found, worths, elsewhere, rivalry):  # type: ignore[no-untyped-def]
    """What the best leaves, shared among those alike, and then the others and "somewhere else"."""
    best, together, alike = found
    probabilities = np.empty(len(worths))
    probabilities[0] = max(best, together / alike)
    for k in range(1, alike):
        probabilities[k] = (together - probabilities[0]) / (alike - 1)
    highest = elsewhere
    for value in worths[alike:]:
        highest = max(highest, value)
    total = math.exp(rivalry * (elsewhere - highest))
    for value in worths[alike:]:
        total += math.exp(rivalry * (value - highest))
    left = 1.0 - together
    for k in range(alike, len(worths)):
        share = (1.0 - together) * math.exp(rivalry * (worths[k] - highest)) / total
        probabilities[k] = min(share, probabilities[alike - 1])
        left -= probabilities[k]
    return probabilities, max(left, 0.0)
