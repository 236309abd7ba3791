"""Splits and figures against naive twins, hand-made cases with ties, and real logs."""

from __future__ import annotations

import gzip
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchorscan.pose import Pose2D
from anchorscan.protocol import (
    Answer,
    choose_references,
    figures,
    precision_recall,
    recall_at_precision,
    reliability,
    revisit,
    sparse,
    thin,
    two_sessions,
    unknown_place,
)
from anchorscan.record import Record
from anchorscan.scan import LaserScan

SCAN = LaserScan(np.ones(3), 0.0, 0.1)


def near(a: Pose2D, b: Pose2D, spacing: float, heading: float) -> bool:
    return a.distance(b) <= spacing and a.turn(b) <= heading


def usable(record: Record) -> bool:
    return record.scan is not None and record.pose is not None and record.pose.is_finite()


def naive_references(records, spacing, heading):
    chosen = []
    for i, record in enumerate(records):
        if usable(record) and not any(
            near(records[j].pose, record.pose, spacing, heading) for j in chosen
        ):
            chosen.append(i)
    return chosen


def naive_revisit(records, spacing, heading, gap):
    driven, total, last = {}, 0.0, None
    for i, record in enumerate(records):
        if record.pose is not None and record.pose.is_finite():
            total += 0.0 if last is None else last.distance(record.pose)
            last, driven[i] = record.pose, total
    chosen = naive_references(records, spacing, heading)
    queries = []
    for i, record in enumerate(records):
        if not usable(record):
            continue
        close = [j for j in chosen if near(records[j].pose, record.pose, spacing, heading)]
        if close and all(abs(driven[i] - driven[j]) >= gap for j in close):
            queries.append(i)
    return chosen, queries


@st.composite
def drives(draw):
    """Random walks that come back to where they were, with gaps as logs have them."""
    generator = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(0, 80))
    steps = np.cumsum(generator.normal(0.0, 1.5, (count, 2)), axis=0) % 9.0
    records = []
    for i, (x, y) in enumerate(steps):
        kind = generator.integers(0, 12)
        pose = Pose2D(x, y, generator.uniform(-4.0, 4.0))
        pose = None if kind == 0 else Pose2D(math.nan, 0.0, 0.0) if kind == 1 else pose
        records.append(Record(i, None if kind == 2 else SCAN, pose))
    return records


@settings(max_examples=100, deadline=None)
@given(drives(), st.floats(0.3, 4.0), st.floats(0.1, 3.2), st.floats(0.0, 30.0))
def test_revisit_equals_its_plain_twin(records, spacing, heading, gap):
    split = revisit(records, spacing, heading, gap)
    references, queries = naive_revisit(records, spacing, heading, gap)
    assert list(split.references) == references
    assert list(split.queries) == queries


@settings(max_examples=50, deadline=None)
@given(drives(), drives(), st.floats(0.3, 4.0), st.floats(0.1, 3.2))
def test_two_sessions_equals_its_plain_twin(first, second, spacing, heading):
    split = two_sessions(first, second, spacing, heading)
    references = naive_references(first, spacing, heading)
    assert list(split.references) == references
    assert list(split.queries) == [
        i
        for i, record in enumerate(second)
        if usable(record)
        and any(near(first[j].pose, record.pose, spacing, heading) for j in references)
    ]


@settings(max_examples=50, deadline=None)
@given(drives(), st.integers(1, 20))
def test_sparse_takes_the_spacing_nearest_to_the_count(records, count):
    split = sparse(records, count)
    left = len(split.references)
    references, queries = naive_revisit(records, split.spacing, math.radians(90.0), 20.0)
    assert (list(split.references), list(split.queries)) == (references, queries)
    wider = len(naive_references(records, split.spacing + 0.5, math.radians(90.0)))
    if left > count and len(naive_references(records, 20.0, math.radians(90.0))) > count:
        assert split.spacing > 9.0 or wider <= left
    elif left > count:
        assert wider <= count
        assert left - count < count - wider
    elif split.spacing > 2.0:
        tighter = len(naive_references(records, split.spacing - 0.5, math.radians(90.0)))
        assert tighter > count
        assert count - left <= tighter - count


def test_limits_are_inclusive():
    poses = [Pose2D(0, 0, 0), Pose2D(2.0, 0, 0), Pose2D(0, 0, 0.5), Pose2D(0, 2.0001, 0)]
    records = [Record(i, SCAN, pose) for i, pose in enumerate(poses)]
    assert choose_references(records, 2.0, 0.5) == (0, 3)


def test_heading_wraps_around():
    poses = [Pose2D(0, 0, math.pi - 0.1), Pose2D(0, 0, -math.pi + 0.1)]
    records = [Record(i, SCAN, pose) for i, pose in enumerate(poses)]
    assert choose_references(records, 1.0, 0.25) == (0,)


def test_a_query_needs_the_whole_gap_to_every_near_reference():
    there = [Pose2D(float(x), 0, 0) for x in range(12)]
    back = [Pose2D(float(x), 0, 0) for x in range(11, -1, -1)]
    records = [Record(i, SCAN, pose) for i, pose in enumerate(there + back)]
    split = revisit(records, spacing=2.0, gap=20.0)
    assert split.references == (0, 3, 6, 9)
    # At x = 1 the only near references are 0 and 3: 21 - 0 and 21 - 3 metres driven.
    assert split.queries == (23,)


def test_unknown_place_asks_every_usable_scan_posed_or_not():
    known = [Record(0, SCAN, Pose2D())]
    other = [Record(0, SCAN), Record(1, None, Pose2D()), Record(2, SCAN, Pose2D())]
    split = unknown_place(known, other)
    assert (split.references, split.queries) == ((0,), (0, 2))


@given(st.integers(0, 200), st.integers(0, 250), st.integers(0, 5))
def test_thinning_keeps_order_and_count(total, count, seed):
    taken = thin(range(total), count, seed)
    assert len(taken) == min(total, count)
    assert list(taken) == sorted(set(taken))
    assert set(taken) <= set(range(total))
    assert taken == thin(range(total), count, seed)


def test_thinning_without_a_count_keeps_everything():
    assert thin((3, 5, 8), None) == (3, 5, 8)
    with pytest.raises(ValueError, match="-1"):
        thin((3, 5, 8), -1)


def naive_recall(probability, correct, precision):
    best = 0
    for threshold in {p for p in probability if not math.isnan(p)}:
        given_answers = [c for p, c in zip(probability, correct, strict=True) if p >= threshold]
        wrong = given_answers.count(False)
        if wrong <= round((1 - precision) * 100) * len(given_answers) / 100:
            best = max(best, given_answers.count(True))
    return best / len(probability)


@settings(max_examples=300, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from([0.1, 0.5, 0.5, 0.9, 1.0, math.nan]), st.booleans()),
        min_size=1,
        max_size=250,
    ),
    st.sampled_from([1.0, 0.99, 0.95]),
)
def test_recall_equals_trying_every_threshold(pairs, precision):
    probability, correct = (list(values) for values in zip(*pairs, strict=True))
    correct = [c and not math.isnan(p) for p, c in pairs]
    recall, threshold = recall_at_precision(probability, correct, precision)
    assert recall == naive_recall(probability, correct, precision)
    hits = sum(c for p, c in zip(probability, correct, strict=True) if p >= threshold)
    assert hits == round(recall * len(pairs))


def test_ties_at_the_threshold_count_together():
    # One wrong answer among the ties at 0.8 withholds all of them.
    probability = [0.9, 0.8, 0.8, 0.8, 0.7]
    correct = [True, True, False, True, True]
    assert recall_at_precision(probability, correct) == (0.2, 0.9)


@given(
    st.lists(
        st.tuples(st.sampled_from([0.1, 0.5, 0.9, math.nan]), st.booleans()),
        min_size=1,
        max_size=40,
    )
)
def test_the_curve_holds_every_threshold_once(pairs):
    probability, correct = (list(values) for values in zip(*pairs, strict=True))
    thresholds, precision, recall = precision_recall(probability, correct)
    assert thresholds.tolist() == sorted(
        {p for p in probability if not math.isnan(p)}, reverse=True
    )
    for threshold, p, r in zip(thresholds, precision, recall, strict=True):
        given_answers = [c for q, c in pairs if q >= threshold]
        assert p == given_answers.count(True) / len(given_answers)
        assert r == given_answers.count(True) / len(pairs)


def test_one_wrong_of_a_hundred_is_one_per_cent():
    probability = [0.9] * 100
    correct = [True] * 99 + [False]
    assert recall_at_precision(probability, correct, 0.99) == (0.99, 0.9)
    assert recall_at_precision([*probability, 0.9], [*correct, False], 0.99) == (0.0, math.inf)


def test_silence_is_never_an_answer():
    assert recall_at_precision([math.nan, math.nan], [False, False]) == (0.0, math.inf)
    assert recall_at_precision([0.5, math.nan], [True, False]) == (0.5, 0.5)


def test_reliability_by_hand():
    probability = [0.05, 0.05, 0.95, 1.0, math.nan]
    correct = [False, True, True, True, False]
    diagram = reliability(probability, correct)
    assert diagram.counts.tolist() == [2, 0, 0, 0, 0, 0, 0, 0, 0, 2]
    # |0.05 - 0.5| * 2 / 4 + |0.975 - 1| * 2 / 4
    assert diagram.error == pytest.approx(0.2375)
    assert diagram.accuracy[0] == 0.5
    assert math.isnan(diagram.probability[4])


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.floats(0.0, 1.0), st.booleans()), min_size=1, max_size=60))
def test_reliability_equals_its_plain_twin(pairs):
    expected = 0.0
    for k in range(10):
        inside = [(p, c) for p, c in pairs if min(int(p * 10), 9) == k]
        if inside:
            mean = sum(p for p, _ in inside) / len(inside)
            share = sum(c for _, c in inside) / len(inside)
            expected += abs(mean - share) * len(inside) / len(pairs)
    assert reliability(*zip(*pairs, strict=True)).error == pytest.approx(expected, abs=1e-12)


def answer(pose, probability, *, accepted=True, truth=Pose2D(), seconds=0.001, covariance=None):
    return Answer(0, pose, truth, probability, accepted, seconds, covariance)


def test_correct_is_half_a_metre_and_ten_degrees_both():
    assert answer(Pose2D(0.5, 0, math.radians(9.9)), 1.0).is_correct
    assert not answer(Pose2D(0.501, 0, 0), 1.0).is_correct
    assert not answer(Pose2D(0, 0, math.radians(10.1)), 1.0).is_correct
    assert answer(Pose2D(0, 0, math.pi), 1.0, truth=Pose2D(0, 0, -math.pi + 0.1)).is_correct
    assert not answer(None, math.nan).is_correct
    assert not answer(Pose2D(math.nan, 0, 0), 1.0).is_correct


def test_every_answer_of_an_unknown_place_is_wrong():
    result = figures([answer(Pose2D(), 0.99, truth=None), answer(None, math.nan, accepted=False)])
    assert (result.correct, result.wrong, result.silent) == (0, 1, 1)
    assert result.top_1 == 0.0


def test_figures_by_hand():
    covariance = np.diag([0.01, 0.01, 0.01])
    result = figures(
        [
            answer(Pose2D(0.1, 0, 0), 0.9, seconds=0.001, covariance=covariance),
            answer(Pose2D(0.4, 0, 0), 0.8, accepted=False, seconds=0.002, covariance=covariance),
            answer(Pose2D(5.0, 0, 0), 0.7, seconds=0.003),
            answer(None, math.nan, accepted=False, seconds=0.010),
        ]
    )
    assert (result.queries, result.correct, result.wrong, result.silent) == (4, 1, 1, 2)
    assert result.top_1 == 0.5
    assert result.recall_at_full_precision == 0.5
    assert result.time_median == pytest.approx(0.0025)
    assert result.time_mean == pytest.approx(0.004)
    assert result.time_maximum == 0.010
    assert result.position_median == pytest.approx(0.25)
    # Squared errors of 1 and 16 against a bound of 7.81.
    assert result.honest_covariance == 0.5


def test_an_ambiguous_answer_names_the_right_place_or_does_not():
    far, near = Pose2D(9.0, 0, 0), Pose2D(0.1, 0, 0)
    unsure = [
        replace(answer(best, 0.5, accepted=False), others=others)
        for best, others in ((near, (far,)), (far, (far, near)), (far, (far,)), (near, ()))
    ]
    result = figures(unsure)
    assert (result.silent, result.ambiguous, result.named) == (4, 3, 2)


def test_figures_of_nothing_are_refused():
    with pytest.raises(ValueError, match="no answers"):
        figures([])


def read_poses(path):
    """Poses of a corrected CARMEN log, with a scan that says nothing."""
    records = []
    with gzip.open(path, "rt") as lines:
        for line in lines:
            if line.startswith("FLASER"):
                words = line.split()
                count = int(words[1])
                pose = Pose2D(*map(float, words[2 + count : 5 + count]))
                records.append(Record(len(records), SCAN, pose))
    return records


@pytest.mark.parametrize(
    ("name", "references", "queries"),
    [("intel", 216, 224), ("freiburg-101", 92, 24), ("csail", 191, 15)],
)
def test_revisit_on_real_logs(data_file, name, references, queries):
    split = revisit(read_poses(data_file(f"{name}.log.gz")))
    assert (len(split.references), len(split.queries)) == (references, queries)


def test_sparse_on_the_real_log(data_file):
    records = read_poses(data_file("freiburg-079.log.gz"))
    at_5 = revisit(records, 5.0, math.radians(90.0))
    assert (len(at_5.references), len(at_5.queries)) == (35, 1792)
    assert len(revisit(records, 6.0, math.radians(90.0)).references) == 26
    assert sparse(records).spacing == 5.5


def test_two_sessions_on_real_logs(data_file):
    drives_of_one_place = [read_poses(data_file(f"wean-{i}.log.gz")) for i in (2, 3)]
    split = two_sessions(*drives_of_one_place)
    assert (len(split.references), len(split.queries)) == (51, 1085)
