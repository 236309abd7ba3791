"""References searched as one map: what may not change the answer, and that there is one."""

from __future__ import annotations

import math
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from scans import BUILDINGS, FULL_TURN, WIDE, box, building, drawn, seeds, sweeps, turned

from anchorscan import (
    AnchorscanError,
    LaserScan,
    Matcher,
    Pose2D,
    Reference,
    SensorModel,
    Settings,
    match,
    simulate,
)
from anchorscan.anchors import stack_anchors
from anchorscan.description import describe
from anchorscan.pairwise import Known
from anchorscan.panorama import panorama, view, worth
from anchorscan.placed import lot_of, nearest, tidied
from anchorscan.stitched_map import StitchedMap

DEFAULT = Settings.preset("default")
numbers = st.integers(0, BUILDINGS - 1)
motions = st.builds(Pose2D, st.floats(-40.0, 40.0), st.floats(-40.0, 40.0), st.floats(-3.1, 3.1))


def references_of(number, count=12):
    """References in a building, and scans of it taken elsewhere with their true poses."""
    world, at = building(number)
    rng = np.random.default_rng(number)
    references = [
        Reference(3 * k, simulate(world, at[k], FULL_TURN, rng), at[k]) for k in range(count)
    ]
    theirs = [pose @ Pose2D(0.3, -0.2, 0.8) for pose in at[:count]]
    return references, [(simulate(world, pose, WIDE, rng), pose) for pose in theirs]


BUILT = {number: references_of(number) for number in range(BUILDINGS)}
PLACES = {number: Matcher(references) for number, (references, _) in BUILT.items()}


def same_answers(ours, theirs):
    """Hold two answers equal to the last bit."""
    assert len(ours) == len(theirs)
    for a, b in zip(ours, theirs, strict=True):
        assert (a.reference, a.pose, a.pose_in_reference) == (
            b.reference,
            b.pose,
            b.pose_in_reference,
        )
        numbers_of_a = a.evaluation, a.quality, a.score, a.probability, a.accepted
        assert numbers_of_a == (b.evaluation, b.quality, b.score, b.probability, b.accepted)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def is_right(hypothesis, pose):
    return hypothesis.pose.distance(pose) <= 0.5 and hypothesis.pose.turn(pose) <= math.radians(10)


# The answer itself.


def test_scans_taken_nearby_are_located():
    right, near = [], []
    for number, (_, asked) in BUILT.items():
        for scan, pose in asked:
            best = PLACES[number].locate(scan)[0]
            right.append(is_right(best, pose))
            assert right[-1] or not best.accepted
            if right[-1]:
                near.append((best.pose.distance(pose), best.pose.turn(pose)))
    assert np.mean(right) >= 0.95
    assert np.all(np.median(near, axis=0) < (0.03, math.radians(0.4)))


@pytest.mark.parametrize("number", BUILT)
def test_a_hypothesis_says_the_same_in_both_frames(number):
    references = {reference.identifier: reference for reference in BUILT[number][0]}
    for scan, _ in BUILT[number][1][:5]:
        answer = PLACES[number].locate(scan)
        assert [h.probability for h in answer] == sorted(h.probability for h in answer)[::-1]
        for hypothesis in answer:
            there = references[hypothesis.reference].pose @ hypothesis.pose_in_reference
            assert there.distance(hypothesis.pose) < 1e-9
            assert there.turn(hypothesis.pose) < 1e-9
            assert 0.0 <= hypothesis.evaluation <= 1.0
            assert np.all(np.linalg.eigvalsh(hypothesis.covariance) > 0.0)


@pytest.mark.parametrize("number", BUILT)
def test_a_scan_matched_with_itself_is_where_it_is(number):
    for reference in BUILT[number][0]:
        best = match(reference.scan, reference.scan)[0]
        assert best.pose.distance(Pose2D()) < 0.02
        assert best.pose.turn(Pose2D()) < math.radians(0.3)
        assert best.pose == best.pose_in_reference


@given(numbers, st.integers(0, 11), st.floats(-3.1, 3.1))
@examples(max_examples=15)
def test_a_turned_sensor_gives_the_turned_pose(number, k, turn):
    scan = BUILT[number][1][k][0]
    straight = PLACES[number].locate(scan)[0]
    if not straight.accepted:
        return  # of several that explain little, another may come first
    around = PLACES[number].locate(turned(scan, turn))[0]
    expected = straight.pose @ Pose2D(0.0, 0.0, -turn)
    # Few steps of refinement end a little apart where they begin apart.
    assert around.pose.distance(expected) < 0.05
    assert around.pose.turn(expected) < math.radians(0.5)


def test_expected_poses_take_steps_of_their_own():
    references, asked = BUILT[0]
    scan, truth = asked[0]
    expected = (truth @ Pose2D(0.25, 0.1, 0.05)).to_array()[None]
    loose = np.zeros((1, 3, 3))
    moved = {}
    for steps, own in ((0, 8), (6, 8), (6, 0)):
        changed = {"verification": {"iterations": steps, "follow_iterations": own}}
        matcher = Matcher(references, Settings.preset("default").changed(changed))
        moved[steps, own] = matcher.follow(scan, expected, loose).poses[0]
    assert np.array_equal(moved[0, 8], moved[6, 8])
    assert Pose2D.from_array(moved[6, 8]).distance(truth) < 0.05
    assert np.allclose(moved[6, 0], expected[0])


# What may not change it.


@given(numbers, motions)
@examples(max_examples=8)
def test_the_answer_moves_with_the_set(number, motion):
    references, asked = BUILT[number]
    moved = Matcher([Reference(r.identifier, r.scan, motion @ r.pose) for r in references], DEFAULT)
    off, sizes = [], []
    for scan, _ in asked:
        ours, theirs = PLACES[number].locate(scan)[0], moved.locate(scan)[0]
        if not ours.accepted:
            continue
        expected = motion @ ours.pose
        assert is_right(theirs, expected)
        off.append((theirs.pose.distance(expected), theirs.pose.turn(expected)))
        sizes.append([np.linalg.eigvalsh(h.covariance[:2, :2]) for h in (ours, theirs)])
    # Cells lie otherwise in the moved set, so single scans may be off by one.
    assert np.all(np.median(off, axis=0) < (0.02, math.radians(0.3)))
    assert np.all(np.max(off, axis=0) < (0.15, math.radians(2.0)))
    ratios = np.sqrt(np.divide(*np.swapaxes(sizes, 0, 1)))
    np.testing.assert_allclose(np.median(ratios, axis=0), 1.0, atol=0.6)


@given(numbers, st.permutations(range(12)))
@examples(max_examples=8)
def test_the_order_of_the_references_does_not_matter(number, order):
    references, asked = BUILT[number]
    shuffled = Matcher([references[k] for k in order], DEFAULT)
    for scan, _ in asked[:4]:
        for candidates in (None, 3):
            ours = PLACES[number].locate(scan, candidates)
            same_answers(ours, shuffled.locate(scan, candidates))


@pytest.mark.parametrize("asked_before", [False, True])
@pytest.mark.parametrize("candidates", [None, 3])
def test_adding_and_removing_is_as_good_as_building_anew(asked_before, candidates):
    references, asked = BUILT[1]
    others = BUILT[2][0]
    changed = Matcher(references[:5], DEFAULT)
    if asked_before:
        changed.locate(asked[0][0], candidates)
    for reference in references[5:]:
        changed.add(reference)
    for reference in others[:4]:
        changed.add(Reference(1000 + reference.identifier, reference.scan, reference.pose))
        changed.locate(asked[0][0], candidates)
    for reference in others[:4]:
        changed.remove(1000 + reference.identifier)
    assert len(changed) == len(references)
    for scan, _ in asked:
        same_answers(changed.locate(scan, candidates), PLACES[1].locate(scan, candidates))


def test_a_reference_taken_back_and_put_in_again_at_another_place_is_there():
    references, asked = BUILT[0]
    places = Matcher(references[:6], DEFAULT)
    places.locate(asked[0][0], 2)
    move = Pose2D(100.0, 50.0, 0.4)
    for reference in references[:6]:
        places.remove(reference.identifier)
        places.add(Reference(reference.identifier, reference.scan, move @ reference.pose))
    for candidates in (None, 2):
        for reference in references[:6]:
            best = places.locate(reference.scan, candidates)[0]
            assert best.pose.distance(move @ reference.pose) < 0.1


def test_threads_give_the_answers_of_one():
    references, asked = BUILT[3]
    places = Matcher(references, DEFAULT)
    many = [scan for scan, _ in asked] * 3
    with ThreadPoolExecutor(4) as threads:  # the first searches race to derive what they share
        answers = list(threads.map(places.locate, many))
        voted = list(threads.map(lambda scan: places.locate(scan, 3), many))
    for scan, answer, by_votes in zip(many, answers, voted, strict=True):
        same_answers(answer, PLACES[3].locate(scan))
        same_answers(by_votes, PLACES[3].locate(scan, 3))


@pytest.mark.parametrize("candidates", [None, 3])
def test_searches_go_on_while_references_come_and_go(candidates):
    references, asked = BUILT[2]
    others = [
        Reference(1000 + r.identifier, r.scan, Pose2D(70.0, 0.0) @ r.pose) for r in BUILT[1][0][:6]
    ]
    places = Matcher(references, DEFAULT)
    done, answers = threading.Event(), []

    def search():
        while not done.is_set():
            for scan, pose in asked[:4]:
                answers.append((places.explain(scan, candidates), pose))

    with ThreadPoolExecutor(3) as threads:
        searches = [threads.submit(search) for _ in range(3)]
        try:
            for _ in range(8):
                for reference in others:
                    places.add(reference)
                for reference in others:
                    places.remove(reference.identifier)
        finally:
            done.set()
        for each in searches:
            each.result()  # raises what the thread raised
    assert len(answers) > 8
    known = {r.identifier: r for r in (*references, *others)}
    settled = {id(scan): PLACES[2].locate(scan, candidates)[0] for scan, _ in asked[:4]}
    for trace, _ in answers:
        best = trace.hypotheses[0]
        # Every answer belongs to one state of the set, whichever that was.
        there = known[best.reference].pose @ best.pose_in_reference
        assert there.distance(best.pose) < 1e-9
        assert trace.reference(best.reference).identifier == best.reference
        if settled[id(trace.scan)].accepted:
            assert best.pose.distance(settled[id(trace.scan)].pose) < 0.1


# How many may propose.


def test_the_best_voted_references_propose():
    references, asked = BUILT[0]
    identifiers = {reference.identifier for reference in references}
    for scan, _ in asked[:4]:
        everything = PLACES[0].explain(scan).in_map
        assert everything.votes is None
        few = PLACES[0].explain(scan, 3).in_map
        assert len(few.votes) == 3
        assert set(few.votes.references.tolist()) <= identifiers
        assert few.proposals.proposed <= everything.proposals.proposed
        all_of_them = PLACES[0].explain(scan, len(references)).in_map
        assert set(all_of_them.votes.references.tolist()) == identifiers


def test_a_lot_that_was_emptied_goes_and_the_one_before_it_stays_as_it_is():
    known = [Known(each, describe(each.scan, DEFAULT)) for each in BUILT[0][0]]
    many = lot_of(known[:-1], 0, DEFAULT.proposal)
    one = lot_of(known[-1:], len(many), DEFAULT.proposal)
    (left,) = tidied([many, one.without(0)])
    assert left is many
    (empty,) = tidied([lot_of(known[:1], 0, DEFAULT.proposal).without(0)])
    assert len(empty) == 0


@given(numbers, st.integers(0, 11), st.integers(1, 12))
@examples(max_examples=20)
def test_those_that_saw_what_the_scan_sees_propose_first(number, k, most):
    references, asked = BUILT[number]
    known = [Known(each, describe(each.scan, DEFAULT)) for each in references]
    description = describe(asked[k][0], DEFAULT)
    places = StitchedMap(DEFAULT, known)
    places.remove(references[3].identifier)
    places.add(Known(Reference(100, references[3].scan, references[3].pose), known[3].description))
    left = [*known[:3], *known[4:], known[3]]
    voted = DEFAULT.changed({"database": {"compared": 0}})
    votes = StitchedMap(voted, known).search(description, 12).votes
    quality = dict(zip(votes.references.tolist(), votes.quality.tolist(), strict=True))
    worths = {
        each.reference.identifier: worth(
            view(description.angles.points, description.anchors),
            stack_anchors([each.description.anchors]),
            panorama(each.description.angles.points, each.description.anchors.main_angle)[None],
            np.array([0]),
            np.array([quality[each.reference.identifier]]),
            1,
        )[0]
        for each in left
    }
    worths[100] = worths.pop(references[3].identifier)
    expected = sorted(worths.values(), reverse=True)[:most]
    chosen = places.search(description, most).votes.references.tolist()
    # Equal ones may come in any order.
    assert [worths[each] for each in chosen] == pytest.approx(expected)


def test_references_one_by_one_find_what_they_find_together():
    right = []
    for number, (references, asked) in BUILT.items():
        for scan, pose in asked:
            together = PLACES[number].locate(scan)[0]
            one_by_one = PLACES[number].locate(scan, len(references))[0]
            if together.accepted:
                right.append(one_by_one.pose.distance(together.pose) < 0.05)
            assert is_right(one_by_one, pose) or not one_by_one.accepted
    assert np.mean(right) > 0.95


# There is always an answer.


def test_a_scan_without_anchors_has_an_answer():
    scan = drawn([(3.0, -0.03, 3.0, 0.03)])
    trace = Matcher([Reference(0, scan, Pose2D(1.0, 2.0, 0.3))]).explain(scan)
    assert len(trace.description.anchors) == 0
    assert trace.hypotheses
    assert not trace.hypotheses[0].accepted
    corridor = drawn([(-40.0, -1.0, 40.0, -1.0), (-40.0, 1.2, 40.0, 1.2)])
    for number in BUILT:
        answer = PLACES[number].locate(corridor)
        assert answer
        assert not answer[0].accepted


@given(numbers, sweeps())
@examples(max_examples=40)
def test_anything_a_message_may_hold_has_an_answer_or_no_return(number, scan):
    answer = PLACES[number].locate(scan)
    assert bool(answer) == bool(scan.is_return.any())
    for hypothesis in answer:
        assert hypothesis.pose.is_finite()
        assert np.all(np.isfinite(hypothesis.covariance))
        assert 0.0 <= hypothesis.probability <= 1.0
        assert not hypothesis.accepted


@given(st.lists(sweeps(), min_size=1, max_size=3))
@examples(max_examples=25)
def test_anything_a_message_may_hold_may_be_a_reference(scans):
    references, asked = BUILT[0]
    odd = [Reference(500 + k, scan, Pose2D(k, 0.0)) for k, scan in enumerate(scans)]
    alone = Matcher(odd).locate(asked[0][0])
    assert alone
    assert not alone[0].accepted
    scan, pose = asked[1]
    assert is_right(Matcher([*references, *odd]).locate(scan)[0], pose)


def test_references_without_a_pose_are_searched_one_by_one():
    references, asked = BUILT[1]
    topological = Matcher([Reference(r.identifier, r.scan) for r in references], DEFAULT)
    found = 0
    for scan, pose in asked:
        trace = topological.explain(scan)
        assert trace.in_map is None
        assert trace.decision is None
        best = trace.hypotheses[0]
        assert all(hypothesis.pose is None for hypothesis in trace.hypotheses)
        there = next(r.pose for r in references if r.identifier == best.reference)
        found += (there @ best.pose_in_reference).distance(pose) < 0.5
    assert found >= 8  # of 12


def test_references_with_and_without_a_pose_are_searched_together():
    references, asked = BUILT[1]
    mixed = [
        Reference(r.identifier, r.scan, r.pose if k % 2 else None) for k, r in enumerate(references)
    ]
    places = Matcher(mixed, DEFAULT)
    poses = {reference.identifier: reference.pose for reference in mixed}
    for scan, _ in asked[:6]:
        trace = places.explain(scan)
        assert trace.in_map is not None
        assert trace.pairwise is not None
        for hypothesis in trace.hypotheses:
            assert (hypothesis.pose is None) == (poses[hypothesis.reference] is None)
        worth = [hypothesis.probability for hypothesis in trace.hypotheses]
        assert worth == sorted(worth, reverse=True)


# Who stands for a pose.


def plain_stand_for(references, poses):
    rows = []
    for pose in (Pose2D(*row) for row in poses.tolist()):
        costs = [pose.distance(Pose2D(*r)) + pose.turn(Pose2D(*r)) for r in references.tolist()]
        best = int(np.argmin(costs))
        rows.append((best, Pose2D(*references[best]).inverse() @ pose))
    return rows


NOTHING_SEEN = LaserScan(np.full(3, np.inf), 0.0, 0.1)


@given(seeds, st.integers(1, 40), st.integers(0, 4), st.sampled_from([4.0, 60.0, 2000.0]))
def test_the_nearest_reference_stands_for_a_pose(seed, references, poses, wide):
    rng = np.random.default_rng(seed)
    known = rng.normal(0.0, (wide, wide, 3.0), (references, 3))
    asked = rng.normal(0.0, (wide, wide, 3.0), (poses, 3))
    described = describe(NOTHING_SEEN, DEFAULT)
    lots = [
        lot_of(
            [
                Known(Reference(k, NOTHING_SEEN, Pose2D(*known[k])), described)
                for k in some.tolist()
            ],
            0,
            DEFAULT.proposal,
        )
        for some in np.array_split(np.arange(references), 3)
    ]
    gone = set(rng.choice(references, references // 4, replace=False).tolist())
    for lot in lots:
        lot.is_there[:] = [k not in gone for k in lot.identifiers.tolist()]
    known[sorted(gone)] = math.nan
    left = np.flatnonzero(~np.isnan(known[:, 0]))
    numbers, places, relative = nearest(lots, asked)
    for n, k, row, (best, expected) in zip(
        numbers.tolist(),
        places.tolist(),
        relative,
        plain_stand_for(known[left], asked),
        strict=True,
    ):
        assert lots[n].identifiers[k] == left[best]
        assert Pose2D(*row).distance(expected) < 1e-9
        assert Pose2D(*row).turn(expected) < 1e-9


# Errors leave everything as it was.


def test_a_reference_that_cannot_be_is_refused_and_leaves_the_set_as_it_was():
    references, asked = BUILT[0]
    places = Matcher(references[:6], DEFAULT)
    scan = references[6].scan
    before = [places.locate(each, n) for each, _ in asked[:3] for n in (None, 2)]
    for pose, error in (
        (Pose2D(5e6, 5e6), AnchorscanError),
        (Pose2D(math.nan, 0.0), AnchorscanError),
    ):
        with pytest.raises(error):
            places.add(Reference(77, scan, pose))
        assert len(places) == 6
        assert 77 not in [reference.identifier for reference in places.references]
    with pytest.raises(ValueError, match="already"):
        places.add(Reference(references[0].identifier, scan, Pose2D()))
    with pytest.raises(KeyError):
        places.remove(77)
    after = [places.locate(each, n) for each, _ in asked[:3] for n in (None, 2)]
    for a, b in zip(before, after, strict=True):
        same_answers(a, b)
    places.add(Reference(77, scan, references[6].pose))
    assert len(places) == 7


def test_a_map_takes_only_references_with_a_pose():
    reference = BUILT[0][0][0]
    known = Known(Reference(5, reference.scan), describe(reference.scan, DEFAULT))
    with pytest.raises(ValueError, match="5 has no pose"):
        StitchedMap(DEFAULT, [known])
    places = StitchedMap(DEFAULT)
    with pytest.raises(ValueError, match="5 has no pose"):
        places.add(known)
    assert len(places) == 0


def test_one_reading_and_one_reference():
    scan = LaserScan(np.array([2.0]), 0.0, 0.0)
    best = match(scan, scan)[0]
    assert best.pose.is_finite()
    assert not best.accepted
    room = drawn(box(-2.0, -1.5, 3.0, 1.5), sensor=SensorModel())
    assert not match(scan, room)[0].accepted
