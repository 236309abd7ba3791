"""The mixture: kernels against plain twins, and what must hold for every belief."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anchorscan import Pose2D
from anchorscan.belief import (
    BeliefSettings,
    Claim,
    Found,
    Mixture,
    _certain,
    _moved,
    _new,
    _owners,
    admitted,
    claimed,
    has_stood,
    log_odds,
    moved,
    nothing_known,
    probabilities,
    tidied,
    together,
    weighed,
)
from anchorscan.motion import motion
from anchorscan.verification import FEATURES, Fits

SETTINGS = BeliefSettings()
PLACED = ("poses", "covariances", "weights", "support", "record", "answered")
seeds = st.integers(0, 2**32 - 1)


def some_poses(rng, count, size=3.0):
    return np.column_stack(
        [rng.uniform(-size, size, (count, 2)), rng.uniform(-math.pi, math.pi, count)]
    )


def some_covariances(rng, count):
    roots = rng.normal(0.0, 0.3, (count, 3, 3))
    return roots @ roots.transpose(0, 2, 1) + 0.01 * np.eye(3)


def some_mixture(rng, count):
    """A belief in order: weights sum to one."""
    mixture = Mixture(
        some_poses(rng, count, 20.0),
        some_covariances(rng, count),
        rng.normal(-2.0, 2.0, count),
        rng.uniform(-6.0, 4.0, count),
        rng.uniform(-6.0, 4.0, count),
        rng.uniform(0.0, 4.0, count),
        float(rng.normal(-2.0, 2.0)),
        float(rng.normal(-2.0, 2.0)),
    )
    return tidied(mixture, SETTINGS)


def some_fits(rng, poses, **features):
    values = rng.uniform(0.0, 1.0, (len(poses), len(FEATURES)))
    values[:, FEATURES.index("free")] *= 1.0 - values[:, FEATURES.index("close")]
    for name, value in features.items():
        values[:, FEATURES.index(name)] = value
    hessians = some_covariances(rng, len(poses))
    return Fits(poses, values, hessians, np.full(len(poses), 0.01), 120)


def fit(score=0.97, close=0.99, free=0.0, unknown=0.0, through=0.0):
    """One fit at the origin."""
    values = {"score": score, "close": close, "free": free, "unknown": unknown, "through": through}
    row = [values.get(name, 0.0) for name in FEATURES]
    return Fits(np.zeros((1, 3)), np.array([row]), np.eye(3)[None], np.array([0.01]), 120)


def total(mixture):
    others = math.exp(mixture.unsearched) + math.exp(mixture.nowhere)
    return float(probabilities(mixture, SETTINGS).sum()) + others


# The twins


@given(seed=seeds, spurious=st.floats(0.0, 0.5))
def test_what_walls_pretend_along_them_is_taken_off_each_axis(seed, spurious):
    for hessian in some_covariances(np.random.default_rng(seed), 4):
        values, axes = np.linalg.eigh(hessian[:2, :2])
        left = np.sqrt(np.maximum(values - spurious * values[1], 0.0) / values)
        shrink = np.eye(3)
        shrink[:2, :2] = axes @ np.diag(left) @ axes.T
        out = _certain(hessian[None], spurious)[0]
        assert np.allclose(out, shrink @ hessian @ shrink)


@given(seed=seeds)
def test_moving_a_place_is_composing_its_pose_and_carrying_the_covariance(seed):
    rng = np.random.default_rng(seed)
    poses, spread = some_poses(rng, 5), some_covariances(rng, 5)
    step, noise = some_poses(rng, 1)[0], some_covariances(rng, 1)[0]
    out, carried = _moved(poses, spread, step, noise)
    for k in range(5):
        now = Pose2D(*poses[k]) @ Pose2D(*step)
        assert Pose2D(*out[k]).distance(now) < 1e-9
        assert Pose2D(*out[k]).turn(now) < 1e-9
        x, y = now.x - poses[k, 0], now.y - poses[k, 1]
        c, s = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        of_pose = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
        of_step = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        wanted = of_pose @ spread[k] @ of_pose.T + of_step @ noise @ of_step.T
        assert np.allclose(carried[k], wanted)


def are_one(a, b, distance, turn):
    a, b = Pose2D(*a), Pose2D(*b)
    return a.distance(b) < distance and a.turn(b) < turn


@given(seed=seeds)
def test_every_place_belongs_to_the_first_owner_that_it_is_one_with(seed):
    poses = some_poses(np.random.default_rng(seed), 12, 1.0)
    poses[:, 2] *= 0.2
    wanted = []
    for k in range(12):
        same = [j for j in range(k) if wanted[j] == j and are_one(poses[k], poses[j], 0.6, 0.4)]
        wanted.append(same[0] if same else k)
    assert _owners(poses, 0.6, 0.4).tolist() == wanted


@given(seed=seeds)
def test_new_places_are_those_that_no_known_one_is_and_come_from_the_heaviest_within_reach(seed):
    rng = np.random.default_rng(seed)
    known, found = some_poses(rng, 6, 1.5), some_poses(rng, 9, 1.5)
    spread, weights = some_covariances(rng, 6), rng.normal(size=6)
    spread_found = 0.1 * some_covariances(rng, 9)
    new, parents = _new((known, spread, weights), (found, spread_found), (0.5, 0.5), 2.0)
    wanted = []
    for n, pose in enumerate(found):
        if any(are_one(pose, each, 0.5, 0.5) for each in known):
            continue
        near = []
        for k, each in enumerate(known):
            off = pose - each
            off[2] = math.remainder(off[2], 2.0 * math.pi)
            if off @ np.linalg.solve(spread[k] + spread_found[n], off) < 4.0:
                near.append(k)
        wanted.append((n, max(near, key=lambda k: weights[k], default=-1)))
    assert list(zip(new.tolist(), parents.tolist(), strict=True)) == wanted


# What must hold


def test_a_robot_just_switched_on_may_be_anywhere():
    assert len(nothing_known()) == 0
    assert total(nothing_known()) == pytest.approx(1.0)


@given(seed=seeds, way=st.floats(0.0, 4.0), turn=st.floats(-3.0, 3.0))
def test_probability_is_neither_lost_nor_made_on_the_way(seed, way, turn):
    rng = np.random.default_rng(seed)
    mixture = some_mixture(rng, int(rng.integers(0, 9)))
    step = motion(Pose2D(), Pose2D(way, 0.0, turn), None, SETTINGS.motion)
    after = moved(mixture, step, SETTINGS)
    assert total(mixture) == pytest.approx(1.0)
    assert total(after) == pytest.approx(1.0)


@given(seed=seeds, share=st.floats(0.0, 1.0))
def test_a_step_keeps_places_bounded_apart_and_summing_to_one(seed, share):
    rng = np.random.default_rng(seed)
    mixture = some_mixture(rng, 20)
    found = Found(some_poses(rng, 30, 20.0), float(rng.uniform()), bool(rng.integers(2)))
    mixture, origin = admitted(mixture, found, SETTINGS)
    claim = claimed(mixture, found, SETTINGS)
    fits = some_fits(rng, mixture.poses)
    after = tidied(weighed(mixture, fits, origin, share, SETTINGS, claim), SETTINGS)
    assert len(after) <= SETTINGS.places
    assert total(after) == pytest.approx(1.0)
    assert np.isfinite(after.covariances).all()
    assert (np.linalg.eigvalsh(after.covariances) > 0.0).all()
    owners = _owners(after.poses, SETTINGS.same_distance, SETTINGS.same_turn)
    assert owners.tolist() == list(range(len(after)))
    fields = (after.poses, after.covariances, after.weights, after.support, after.record)
    fields += (after.answered,)
    assert {len(each) for each in fields} == {len(after)}


def test_poses_a_hand_apart_are_followed_apart_and_reported_together():
    shares = np.array([0.395, 0.6, 0.005])
    poses = np.array([[0.2, 0.0, 0.0], [0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
    none = np.zeros(3)
    mixture = Mixture(
        poses, np.tile(0.01 * np.eye(3), (3, 1, 1)), np.log(shares), none, none, none, -1e3
    )
    assert len(tidied(mixture, SETTINGS)) == 3
    places, worth = together(mixture, SETTINGS)
    assert places.tolist() == [1, 2]
    assert worth == pytest.approx([0.995, 0.005])


@given(seed=seeds)
def test_what_is_reported_together_takes_nothing_away_and_counts_nothing_twice(seed):
    mixture = some_mixture(np.random.default_rng(seed), 20)
    places, worth = together(mixture, SETTINGS)
    each = probabilities(mixture, SETTINGS)
    assert worth.sum() == pytest.approx(each.sum())
    assert (worth >= each[places] - 1e-12).all()
    owners = _owners(mixture.poses[places], SETTINGS.together, SETTINGS.same_turn)
    assert owners.tolist() == list(range(len(places)))


@given(seed=seeds)
def test_the_order_of_places_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    mixture = some_mixture(rng, 8)
    order = rng.permutation(len(mixture))
    turned = replace(
        mixture,
        poses=mixture.poses[order],
        covariances=mixture.covariances[order],
        weights=mixture.weights[order],
        support=mixture.support[order],
        record=mixture.record[order],
        answered=mixture.answered[order],
    )
    one, other = tidied(mixture, SETTINGS), tidied(turned, SETTINGS)
    assert np.allclose(one.poses, other.poses)
    assert np.allclose(one.weights, other.weights)


@given(low=st.floats(0.0, 0.98), more=st.floats(0.0, 0.5), through=st.floats(0.0, 1.0))
def test_a_better_score_never_speaks_against_a_place_and_seeing_through_never_for_it(
    low, more, through
):
    high = min(low + more, 1.0)
    worse, better = (log_odds(fit(score, max(score, 0.5)), SETTINGS)[0] for score in (low, high))
    assert better >= worse - 1e-9
    seen = log_odds(fit(high, through=through), SETTINGS)[0]
    assert seen <= log_odds(fit(high), SETTINGS)[0]


def test_a_view_that_people_block_is_not_taken_against_a_place_that_explains_the_rest():
    blocked = fit(score=0.60, close=0.66, free=0.12)
    as_bad = fit(score=0.60, close=0.95)
    assert log_odds(blocked, SETTINGS)[0] > 0.0
    assert log_odds(as_bad, SETTINGS)[0] < -2.0


def test_a_scan_of_what_nobody_mapped_says_little():
    away = log_odds(fit(score=0.0, close=0.0, unknown=1.0), SETTINGS)[0]
    missed = log_odds(fit(score=0.4, close=0.9), SETTINGS)[0]
    assert abs(away) < 1.5
    assert missed < -3.0


def test_standing_still_proves_nothing():
    rng = np.random.default_rng(0)
    mixture, origin = admitted(
        nothing_known(), Found(np.array([[0.0, 0, 0], [9.0, 0, 0]])), SETTINGS
    )
    fits = some_fits(rng, mixture.poses, score=[0.95, 0.9], close=1.0, unknown=0.0, through=0.0)
    mixture = tidied(weighed(mixture, fits, origin, SETTINGS.still, SETTINGS), SETTINGS)
    first = probabilities(mixture, SETTINGS)
    for _ in range(5):
        mixture = weighed(mixture, fits, np.arange(2), 0.0, SETTINGS)
    assert np.allclose(probabilities(tidied(mixture, SETTINGS), SETTINGS), first)


def test_a_scan_that_fits_badly_holds_the_pose_less():
    rng = np.random.default_rng(0)
    mixture, _ = admitted(nothing_known(), Found(np.zeros((1, 3))), SETTINGS)
    spreads = []
    for score in (0.97, 0.3):
        fits = some_fits(rng, mixture.poses, score=score, close=1.0, unknown=0.0, through=0.0)
        fits = replace(fits, hessians=30.0 * np.eye(3)[None])
        after = weighed(mixture, fits, np.arange(1), 0.2, SETTINGS)
        spreads.append(np.trace(after.covariances[0]))
    assert spreads[0] < 0.5 * spreads[1]


def test_a_place_that_lately_fits_badly_or_much_worse_than_another_has_not_stood():
    def records(*values):
        count = len(values)
        covariances = np.repeat(np.eye(3)[None], count, axis=0)
        zeros = np.zeros(count)
        return Mixture(np.zeros((count, 3)), covariances, zeros, zeros, np.array(values), zeros)

    assert has_stood(records(3.0), 0, SETTINGS)
    assert not has_stood(records(-1.0), 0, SETTINGS)
    assert has_stood(records(2.0, 4.0), 0, SETTINGS)
    assert not has_stood(records(0.2, 4.0), 0, SETTINGS)


# Answers of a search


TWO = np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
MOVED_FURNITURE = {"score": [0.78, 0.7], "close": 1.0, "unknown": 0.0, "through": 0.0}


def driven(probability, metres=2.0, step=0.1, **features):
    """What is believed after a drive at the first of two places, searched each half metre."""
    rng, mixture = np.random.default_rng(0), nothing_known()
    accepted = probability >= 0.96
    for number in range(round(metres / step)):
        on = motion(Pose2D(), Pose2D(step, 0.0, 0.0), None, SETTINGS.motion)
        mixture, claim = moved(mixture, on, SETTINGS), None
        origin = np.arange(len(mixture))
        if number % 5 == 0:
            found = Found(TWO + np.array([number * step, 0.0, 0.0]), probability, accepted)
            mixture, origin = admitted(mixture, found, SETTINGS)
            claim = claimed(mixture, found, SETTINGS)
        shares = {**MOVED_FURNITURE, **features}
        values = {name: np.resize(value, len(mixture)) for name, value in shares.items()}
        fits = some_fits(rng, mixture.poses, **values)
        share = step / SETTINGS.way_alike
        mixture = tidied(weighed(mixture, fits, origin, share, SETTINGS, claim), SETTINGS)
    return mixture


def test_sure_answers_make_sure_of_a_place_that_explains_too_little_by_itself():
    unsure, sure = (probabilities(driven(p), SETTINGS).max(initial=0.0) for p in (0.1, 0.99))
    assert unsure < 0.1
    assert sure > 0.9
    first = np.argmax(probabilities(driven(0.99), SETTINGS))
    assert abs(driven(0.99).poses[first, 0] - 2.0) < 0.2
    assert has_stood(driven(0.99), int(first), SETTINGS)
    assert not has_stood(driven(0.1), 0, SETTINGS)


def test_an_answer_that_is_not_sure_is_not_taken_against_its_place():
    """Two places that look alike make every answer unsure; that is no sign of elsewhere."""
    good = {"score": [0.97, 0.97]}
    unsure, sure = driven(0.05, **good), driven(0.4, **good)
    assert np.allclose(probabilities(unsure, SETTINGS), probabilities(sure, SETTINGS), atol=0.05)
    assert math.exp(unsure.nowhere) < 0.1


@given(odds=st.floats(-6.0, 6.0))
def test_a_sure_answer_is_taken_against_every_other_place_and_an_unsure_one_is_not(odds):
    known, _ = admitted(nothing_known(), Found(TWO), SETTINGS)
    known = replace(known, weights=np.log([0.5, 0.5]), unsearched=-9.0, nowhere=-9.0)
    fits = some_fits(np.random.default_rng(0), known.poses, score=0.97, close=1.0, unknown=0.0)
    plain = weighed(known, fits, np.arange(2), 0.1, SETTINGS)
    after = weighed(known, fits, np.arange(2), 0.1, SETTINGS, Claim(0, odds))
    lost = plain.support[1] - after.support[1]
    assert lost == pytest.approx(min(max(odds, 0.0), SETTINGS.answered_against))
    assert after.support[0] >= plain.support[0]


@given(p=st.floats(0.0, 1.0), more=st.floats(0.0, 1.0))
def test_a_surer_answer_gives_its_place_no_less_and_never_more_than_the_most(p, more):
    mixture, _ = admitted(nothing_known(), Found(TWO), SETTINGS)
    claims = [claimed(mixture, Found(TWO, min(q, 1.0)), SETTINGS) for q in (p, p + more)]
    assert all(claim is not None and claim.place == 0 for claim in claims)
    assert claims[0].odds <= claims[1].odds <= SETTINGS.most_answered


def test_an_answer_is_claimed_for_the_nearest_place_that_is_one_with_it():
    near = np.array([[0.2, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 1.0]])
    mixture, _ = admitted(nothing_known(), Found(near), SETTINGS)
    claim = claimed(mixture, Found(np.zeros((1, 3)), 0.99), SETTINGS)
    assert claim is not None
    assert claim.place == 1
    assert claimed(mixture, Found(np.empty((0, 3))), SETTINGS) is None


def test_what_an_answer_added_fades_on_the_way_and_ends_with_the_next():
    mixture = driven(0.99, metres=0.1)
    before = mixture.answered.max()
    on = motion(Pose2D(), Pose2D(SETTINGS.answer_fades, 0.0, 0.0), None, SETTINGS.motion)
    after = moved(mixture, on, SETTINGS)
    assert before > 3.0
    assert after.answered.max() == pytest.approx(before * math.exp(-1.0), rel=0.01)
    assert not admitted(mixture, Found(np.empty((0, 3))), SETTINGS)[0].answered.any()


def test_an_answer_at_a_new_place_soon_outweighs_a_place_that_fits_no_more():
    """After a kidnapping; an answer at the known place changes nothing."""
    rng = np.random.default_rng(0)
    known, origin = admitted(nothing_known(), Found(TWO[:1]), SETTINGS)
    good = some_fits(rng, known.poses, score=0.97, close=1.0, unknown=0.0, through=0.0)
    known = tidied(weighed(known, good, origin, 1.0, SETTINGS), SETTINGS)
    known = replace(known, unsearched=math.log(1e-4))
    shares = {"close": 1.0, "unknown": 0.0, "through": 0.0}
    worth = []
    for claim in (None, Claim(1, 6.0)):
        mixture, origin = admitted(known, Found(TWO[1:]), SETTINGS)
        fits = some_fits(rng, mixture.poses, score=[0.6, 0.95], **shares)
        after = tidied(weighed(mixture, fits, origin, 0.1, SETTINGS, claim), SETTINGS)
        worth.append(probabilities(after, SETTINGS)[np.argmax(after.poses[:, 0])])
    assert worth[1] > 10.0 * worth[0]


def test_an_answer_takes_up_a_place_again_that_had_been_given_up():
    rng = np.random.default_rng(0)
    mixture, _ = admitted(nothing_known(), Found(TWO), SETTINGS)
    mixture = replace(mixture, weights=np.array([-10.0, -12.0]), unsearched=-3.0, nowhere=-0.1)
    fits = some_fits(rng, mixture.poses, score=0.95, close=1.0, unknown=0.0, through=0.0)
    worth = []
    for claim in (None, Claim(1, 5.0)):
        after = weighed(mixture, fits, np.arange(2), 0.1, SETTINGS, claim)
        worth.append(probabilities(tidied(after, SETTINGS), SETTINGS).max())
    assert worth[0] < 0.01
    assert worth[1] > 0.5


def test_only_an_accepted_answer_tells_the_position_more_closely():
    spreads = [
        admitted(nothing_known(), Found(TWO, 0.97, accepted), SETTINGS)[0].covariances
        for accepted in (False, True)
    ]
    assert np.sqrt(spreads[0][0, 0, 0]) == pytest.approx(SETTINGS.found_deviation)
    assert np.sqrt(spreads[1][0, 0, 0]) == pytest.approx(SETTINGS.answer_deviation)
    assert np.array_equal(spreads[0][1], spreads[1][1])


# Poses that slipped


def slipped(ahead, scores, **found):
    """A located robot whose place is ``ahead`` of where a search finds it; after that scan."""
    rng = np.random.default_rng(0)
    shares = {"close": 1.0, "unknown": 0.0, "through": 0.0}
    known, origin = admitted(nothing_known(), Found(np.array([[ahead, 0.0, 0.0]])), SETTINGS)
    fits = some_fits(rng, known.poses, score=0.97, **shares)
    known = tidied(weighed(known, fits, origin, 1.0, SETTINGS), SETTINGS)
    known = replace(known, covariances=0.07**2 * np.eye(3)[None], unsearched=-9.0, nowhere=-9.0)
    found = Found(np.zeros((1, 3)), **found)
    mixture, origin = admitted(known, found, SETTINGS)
    fits = some_fits(rng, mixture.poses, score=scores[: len(mixture)], **shares)
    claim = claimed(mixture, found, SETTINGS)
    return tidied(weighed(mixture, fits, origin, 0.25, SETTINGS, claim), SETTINGS)


def test_a_search_corrects_the_pose_of_a_place_where_the_scan_speaks_for_it():
    for off, left in ((0.12, 1), (0.2, 2)):
        after = slipped(off, [0.72, 0.97])
        assert after.poses[0, 0] == 0.0
        assert len(after) == left
        assert slipped(off, [0.95, 0.96]).poses[0, 0] == off


def test_a_sure_answer_is_no_witness_of_the_pose_that_it_contradicts():
    after = slipped(0.2, [0.72, 0.97], probability=0.999, accepted=True)
    assert after.poses[0, 0] == 0.0


def test_a_slip_further_than_a_place_is_followed_as_a_rival_and_silences_both():
    after = slipped(0.6, [0.93, 0.95])
    assert len(after) == len(together(after, SETTINGS)[0]) == 2
    worth = np.sort(probabilities(after, SETTINGS))
    assert worth[0] > 0.05
    assert worth[1] < SETTINGS.threshold


def test_all_but_the_same_pose_needs_no_second_look():
    known, _ = admitted(nothing_known(), Found(np.zeros((1, 3))), SETTINGS)
    again, origin = admitted(known, Found(np.array([[0.05, 0.0, 0.01]])), SETTINGS)
    assert len(again) == 1
    assert origin.tolist() == [0]


@given(seed=seeds)
def test_what_a_place_hands_on_is_taken_off_it(seed):
    """Scans that say nothing leave the probability of all places together as it was."""
    rng = np.random.default_rng(seed)
    known = some_mixture(rng, 5)
    near = known.poses[rng.integers(0, len(known), 4)] + rng.normal(0.0, 0.2, (4, 3))
    mixture, origin = admitted(known, Found(near), SETTINGS)
    keep = np.flatnonzero(origin >= 0)
    mixture = replace(
        mixture,
        **{name: getattr(mixture, name)[keep] for name in PLACED},
        unsearched=known.unsearched,
    )
    fits = some_fits(rng, mixture.poses)
    after = weighed(mixture, fits, origin[keep], 0.0, SETTINGS)
    assert np.exp(after.weights).sum() == pytest.approx(np.exp(known.weights).sum())


def test_a_pose_is_held_by_what_the_map_explains_and_not_by_an_answer():
    rng = np.random.default_rng(0)
    mixture, _ = admitted(nothing_known(), Found(np.zeros((1, 3))), SETTINGS)
    spreads = []
    for unknown, claim in ((0.0, None), (0.6, None), (0.6, Claim(0, 6.0))):
        score = 0.97 * (1.0 - unknown)
        fits = some_fits(rng, mixture.poses, score=score, close=1.0, unknown=unknown, through=0.0)
        fits = replace(fits, hessians=30.0 * np.eye(3)[None])
        after = weighed(mixture, fits, np.arange(1), 0.2, SETTINGS, claim)
        spreads.append(np.trace(after.covariances[0]))
    assert spreads[0] < 0.8 * spreads[1]
    assert spreads[1] == spreads[2]
