"""What an answer is worth: never more than the readings can hold."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from anchorscan import (
    LaserScan,
    Pose2D,
    Record,
    ReferenceSet,
    SensorModel,
    Settings,
    drive,
    random_building,
    simulate,
)
from anchorscan.decision import (
    Decision,
    DecisionSettings,
    _shared,
    _worths,
    covariance,
    decide,
    evidence,
)
from anchorscan.verification import FEATURES, Fits
from anchorscan.world import World


@pytest.fixture(scope="module")
def places() -> ReferenceSet:
    lidar = SensorModel(2.0 * math.pi, math.radians(0.5), range_max=20.0)
    return ReferenceSet.build(
        drive(random_building(3, length=24.0, depth=16.0), lidar, seed=1, length=120.0)
    )


@settings(max_examples=40)
@given(
    count=st.integers(1, 12),
    start=st.floats(-math.pi, math.pi),
    distance=st.floats(0.3, 6.0),
    seed=st.integers(0, 1000),
    is_smooth=st.booleans(),
)
def test_a_few_readings_side_by_side_are_never_an_answer(
    places: ReferenceSet, count: int, start: float, distance: float, seed: int, is_smooth: bool
) -> None:
    ranges = np.full(count, distance)
    if not is_smooth:
        ranges *= np.random.default_rng(seed).uniform(0.5, 1.5, count)
    scan = LaserScan(ranges, start, math.radians(0.5), 0.05, 20.0)
    hypotheses = places.locate(scan)
    assert hypotheses
    assert not hypotheses[0].accepted


def test_between_two_endless_walls_nothing_is_an_answer() -> None:
    walls = np.array([[-60.0, 0.0, 60.0, 0.0], [-60.0, 2.5, 60.0, 2.5]])
    sensor = SensorModel(2.0 * math.pi, math.radians(1.0), range_max=15.0)
    poses = [Pose2D(x, 1.2, 0.3) for x in np.arange(-30.0, 30.0, 2.0)]
    scans = [simulate(World(walls), pose, sensor) for pose in poses]
    corridor = ReferenceSet.build(
        [Record(k, scan, pose) for k, (scan, pose) in enumerate(zip(scans, poses, strict=True))]
    )
    best = corridor.locate(simulate(World(walls), Pose2D(3.3, 1.0, -0.4), sensor))[0]
    assert not best.accepted


# Fits as the verification gives them, with only those numbers that the decision looks at.

SETTINGS = [Settings.preset(name).decision for name in ("default", "thorough")]
PRESETS = pytest.mark.parametrize("preset", SETTINGS, ids=["default", "thorough"])
SCORE, THROUGH = FEATURES.index("score"), FEATURES.index("through")
# As 72 readings of walls about 3 m away give, and as many anchor points.
FIRM = np.diag([40.0, 30.0, 600.0])
MANY = 10


def fits_of(
    scores: list[float],
    through: float = 0.0,
    hessian: NDArray[np.float64] = FIRM,
    readings: int = 120,
) -> Fits:
    features = np.full((len(scores), len(FEATURES)), math.nan)
    features[:, SCORE], features[:, THROUGH] = (
        scores,
        [through, *[0.0] * len(scores)][: len(scores)],
    )
    hessians = np.repeat(hessian[np.newaxis], len(scores), axis=0)
    return Fits(
        np.zeros((len(scores), 3)), features, hessians, np.full(len(scores), 1e-4), readings
    )


shares = st.floats(0.0, 1.0)
scores_of_fits = st.lists(st.floats(-0.7, 1.0), min_size=1, max_size=8).map(
    lambda scores: sorted(scores, reverse=True)
)


@PRESETS
@given(
    scores=scores_of_fits,
    through=shares,
    readings=st.integers(0, 500),
    anchors=st.integers(0, 60),
)
def test_probabilities_are_shared_out_in_order(
    preset: DecisionSettings, scores: list[float], through: float, readings: int, anchors: int
) -> None:
    decision = decide(fits_of(scores, through, readings=readings), anchors, preset)
    assert decision.probabilities.shape == (len(scores),)
    assert np.all(decision.probabilities >= 0.0)
    assert decision.elsewhere >= 0.0
    assert decision.probabilities.sum() + decision.elsewhere == pytest.approx(1.0)
    # Best first: no fit is likelier than one that is worth more.
    assert np.all(np.diff(decision.probabilities) <= 1e-15)
    assert decision.accepted == (decision.probabilities[0] >= preset.threshold)


@PRESETS
@given(a=shares, b=shares, rival=st.floats(-0.7, 1.0))
def test_a_better_score_is_never_less_likely(
    preset: DecisionSettings, a: float, b: float, rival: float
) -> None:
    low, high = sorted((max(a, rival), max(b, rival)))
    worse, better = (decide(fits_of([score, rival]), MANY, preset) for score in (low, high))
    assert better.probabilities[0] >= worse.probabilities[0]


@PRESETS
@given(score=shares, a=st.floats(-0.7, 1.0), b=st.floats(-0.7, 1.0))
def test_a_wider_margin_is_never_less_likely(
    preset: DecisionSettings, score: float, a: float, b: float
) -> None:
    low, high = sorted((min(a, score), min(b, score)))
    near, far = (decide(fits_of([score, rival]), MANY, preset) for rival in (high, low))
    assert far.probabilities[0] >= near.probabilities[0]
    assert far.elsewhere + far.probabilities[0] >= near.probabilities[0]


@PRESETS
@given(score=shares, a=shares, b=shares)
def test_seeing_through_walls_is_never_likelier(
    preset: DecisionSettings, score: float, a: float, b: float
) -> None:
    few, many = (decide(fits_of([score, 0.3], share), MANY, preset) for share in sorted((a, b)))
    assert few.probabilities[0] >= many.probabilities[0]


@PRESETS
@given(score=shares, a=st.integers(0, 400), b=st.integers(0, 400))
def test_more_readings_are_never_less_likely(
    preset: DecisionSettings, score: float, a: int, b: int
) -> None:
    low, high = (decide(fits_of([score, 0.2], readings=n), MANY, preset) for n in sorted((a, b)))
    assert high.probabilities[0] >= low.probabilities[0]


@PRESETS
def test_a_scan_that_one_place_explains_is_an_answer_and_one_that_two_do_is_none(
    preset: DecisionSettings,
) -> None:
    assert decide(fits_of([0.95, 0.45]), MANY, preset).accepted
    twins = decide(fits_of([0.95, 0.95]), MANY, preset)
    assert not twins.accepted
    assert twins.probabilities[0] == twins.probabilities[1] > 0.45
    assert not decide(fits_of([0.3, 0.1]), MANY, preset).accepted


@PRESETS
def test_what_fits_as_well_upside_down_is_no_answer(preset: DecisionSettings) -> None:
    fits = fits_of([0.95, 0.45])
    as_asked_one_way = decide(fits, MANY, preset).probabilities[0]
    assert decide(fits, MANY, preset, upside_down=0.7).probabilities[0] == as_asked_one_way
    assert not decide(fits, MANY, preset, upside_down=0.95).alike
    assert not decide(fits, MANY, preset, upside_down=0.99).alike  # and what fits better still
    places = fits_of([0.95, 0.95, 0.45])
    assert decide(places, MANY, preset).alike == 2
    assert not decide(places, MANY, preset, upside_down=0.95).alike


@PRESETS
def test_places_that_explain_a_scan_alike_are_counted(preset: DecisionSettings) -> None:
    def alike(*scores: float) -> int:
        return decide(fits_of(list(scores)), MANY, preset).alike

    assert alike(0.95, 0.45) == 1
    assert alike(0.95, 0.95, 0.45) == 2
    assert alike(0.95, 0.95, 0.95, 0.45) == 3
    assert alike(0.95, 0.95, 0.95, 0.95, 0.45) == 0  # more than can be told
    assert alike(0.95, 0.95) == 2  # and nothing else
    assert alike(0.3, 0.3, 0.1) == 0  # alike, and neither explains much


@PRESETS
@given(
    scores=scores_of_fits,
    apart=st.lists(st.floats(0.0, 0.05), max_size=4),
    through=shares,
    anchors=st.integers(0, 60),
)
def test_places_alike_are_those_without_which_the_best_is_an_answer(
    preset: DecisionSettings,
    scores: list[float],
    apart: list[float],
    through: float,
    anchors: int,
) -> None:
    scores = sorted([*scores, *(scores[0] - each for each in apart)], reverse=True)

    def without(others: int) -> Decision:
        left = [scores[0], *scores[1 + others :]]
        return decide(fits_of(left, through), anchors, preset)

    def is_near(rank: int) -> bool:
        apart = (scores[0] - scores[rank]) / preset.twins
        return 1.0 - 0.5 * math.exp(-0.5 * apart**2) < preset.threshold

    expected, alone = 0, without(0)
    for others in range(min(len(scores), preset.most_alike)):
        if others and not is_near(others):
            break
        alone = without(others)
        if alone.accepted:
            expected = others + 1
            break
    decision = decide(fits_of(scores, through), anchors, preset)
    assert decision.alike == expected
    if expected:  # it is at one of them, as surely as it would be at the only one
        together = decision.probabilities[:expected].sum()
        assert together == pytest.approx(alone.probabilities[0])


@PRESETS
def test_a_single_fit_stands_for_itself(preset: DecisionSettings) -> None:
    alone = decide(fits_of([0.9]), MANY, preset)
    assert alone.probabilities.shape == (1,)
    assert alone.elsewhere == pytest.approx(1.0 - alone.probabilities[0])
    # As if the rival scored half as much.
    rivalled = decide(fits_of([0.9, 0.45]), MANY, preset)
    assert alone.probabilities[0] == rivalled.probabilities[0]


@PRESETS
def test_without_a_fit_the_scan_is_from_elsewhere(preset: DecisionSettings) -> None:
    nothing = decide(fits_of([]), MANY, preset)
    assert nothing.probabilities.shape == (0,)
    assert nothing.elsewhere == 1.0
    assert not nothing.accepted


@given(
    constant=st.floats(-1e6, 1e6),
    elsewhere=st.floats(-1e3, 1e3),
    rivalry=st.floats(1e-3, 1e4),
    scores=scores_of_fits,
)
def test_settings_out_of_all_proportion_still_give_probabilities(
    constant: float, elsewhere: float, rivalry: float, scores: list[float]
) -> None:
    odd = DecisionSettings(constant=constant, elsewhere=elsewhere, rivalry=rivalry)
    decision = decide(fits_of(scores), MANY, odd)
    assert np.all((decision.probabilities >= 0.0) & (decision.probabilities <= 1.0))
    assert decision.probabilities.sum() + decision.elsewhere == pytest.approx(1.0)


@given(st.integers(0, 2**31 - 1), st.integers(0, 5))
@settings(max_examples=40)
def test_covariances_are_the_inverse_of_the_information(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    slopes = rng.normal(0.0, 10.0, (count, 20, 3))
    slopes[:, int(rng.integers(0, 20)) :] = 0.0  # some are held in one direction, or in none
    hessians = np.einsum("fni,fnj->fij", slopes, slopes)
    fits = Fits(
        np.zeros((count, 3)), np.zeros((count, 7)), hessians, rng.uniform(0.0, 0.01, count), 120
    )
    limits = SETTINGS[0]
    found = covariance(fits, limits)
    for ours, hessian, residual in zip(found, hessians, fits.residuals, strict=True):
        noise = max(residual, limits.range_deviation**2) * limits.readings_alike
        information = hessian / noise + np.eye(3) / limits.widest_deviation**2
        # What nothing holds is told to four digits: its determinant has no more.
        np.testing.assert_allclose(ours, np.linalg.inv(information), rtol=1e-4, atol=1e-12)
        np.testing.assert_array_equal(ours, ours.T)
        sizes = np.linalg.eigvalsh(ours)
        assert sizes[0] > 0.0
        assert sizes[-1] <= limits.widest_deviation**2 * (1.0 + 1e-4)


@PRESETS
def test_a_pose_that_nothing_holds_is_no_answer(preset: DecisionSettings) -> None:
    corridor = np.diag([0.0, 40.0, 600.0])
    assert decide(fits_of([0.99, 0.3]), MANY, preset).accepted
    assert not decide(fits_of([0.99, 0.3], hessian=corridor), MANY, preset).accepted
    assert not decide(fits_of([0.99, 0.3], hessian=np.zeros((3, 3))), MANY, preset).accepted


@PRESETS
@given(score=shares, a=st.integers(0, 100), b=st.integers(0, 100))
def test_a_scan_of_more_anchor_points_is_never_less_likely(
    preset: DecisionSettings, score: float, a: int, b: int
) -> None:
    few, many = (decide(fits_of([score, 0.2]), n, preset) for n in sorted((a, b)))
    assert many.probabilities[0] >= few.probabilities[0]


@PRESETS
@given(score=shares, a=st.floats(0.0, 1e7), b=st.floats(0.0, 1e7))
def test_a_wider_view_is_never_less_likely(
    preset: DecisionSettings, score: float, a: float, b: float
) -> None:
    narrow, wide = (
        decide(fits_of([score, 0.2], hessian=np.diag([40.0, 30.0, h])), MANY, preset)
        for h in sorted((a, b))
    )
    assert wide.probabilities[0] >= narrow.probabilities[0]


def test_evidence_is_what_the_text_says() -> None:
    numbers = evidence(fits_of([0.9, 0.7], 0.04), 7)
    margin = (math.log(10.0) - 0.2) - math.log(1.0 / 0.3)
    expected = [1.0, math.log(margin), math.log(10.0), 0.2, math.log(601.0), math.log(8.0)]
    np.testing.assert_allclose(numbers, expected)
    assert np.all(np.isfinite(evidence(fits_of([1.0, 1.0], readings=0), 0)))


@given(
    best=shares,
    scores=scores_of_fits,
    through=shares,
    rivalry=st.floats(0.1, 100.0),
    alike=st.integers(1, 3),
    more=shares,
)
def test_what_the_best_leaves_is_shared_as_the_text_says(
    best: float, scores: list[float], through: float, rivalry: float, alike: int, more: float
) -> None:
    fits = fits_of(scores, through)
    features = np.nan_to_num(fits.features)
    worths = _worths(features)
    expected = [
        -math.log(1.0 - min(score, 0.995)) - math.sqrt(ray)
        for score, ray in features[:, [SCORE, THROUGH]].tolist()
    ]
    np.testing.assert_allclose(worths, expected)
    alike = min(alike, len(scores))
    together = best if alike == 1 else best + more * (1.0 - best)
    given_to, elsewhere = _shared((best, together, alike), worths, 1.5, rivalry)
    first = max(best, together / alike)
    same = [(together - first) / (alike - 1)] * (alike - 1) if alike > 1 else []
    others = [*expected[alike:], 1.5]
    rivals = np.exp(rivalry * (np.array(others) - max(others)))
    plain = np.minimum((1.0 - together) * rivals[:-1] / rivals.sum(), [first, *same][-1])
    np.testing.assert_allclose(given_to, [first, *same, *plain], atol=1e-12)
    np.testing.assert_allclose(elsewhere, max(1.0 - together - plain.sum(), 0.0), atol=1e-12)
