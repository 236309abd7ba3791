"""P5: where journeys begin, what odometry says of a kidnapping, and what counts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchorscan.journey import Journey, Recovery, journeys, odometry, recovery, summary
from anchorscan.pose import Pose2D
from anchorscan.protocol import Answer
from anchorscan.record import Record
from anchorscan.scan import LaserScan

SCAN = LaserScan(np.ones(3), 0.0, 0.1)


def line(count, *, odometry=None):
    """One metre a record along x; odometry in a frame of its own where wanted."""
    poses = [Pose2D(float(x), 0.0, 0.0) for x in range(count)]
    return [
        Record(i, SCAN, pose, None if odometry is None else odometry @ pose)
        for i, pose in enumerate(poses)
    ]


def reports(records, journey, told):
    """What a belief reports: by index, "right", a pose, or nothing."""
    made = []
    for index, position in enumerate(journey.positions):
        pose = told.get(index)
        truth = records[position].pose
        pose = truth if pose == "right" else pose
        made.append(Answer(position, pose, truth, 0.99, pose is not None, 0.001))
    return made


def test_every_twentieth_usable_record_is_a_start():
    records = [Record(0, None, Pose2D()), Record(1, SCAN, Pose2D(math.nan)), *line(50)]
    made = journeys(records)
    assert [journey.positions[0] for journey in made] == [2, 22, 42]
    assert made[1].positions == tuple(range(22, 52))


def test_a_kidnapped_robot_wakes_up_elsewhere_and_drives_on():
    records = line(100)
    made = journeys(records, 20, kidnap=True, seed=3)
    assert made == journeys(records, 20, kidnap=True, seed=3)
    assert made != journeys(records, 20, kidnap=True, seed=4)
    for journey in made:
        before = records[journey.positions[journey.jump - 1]].pose
        after = records[journey.positions[journey.jump]].pose
        assert before.distance(after) >= 10.0
        rest = journey.positions[journey.jump :]
        assert list(rest) == list(range(rest[0], rest[0] + len(rest)))
        assert len(rest) in (journey.jump, journey.jump + 1)


def test_a_place_too_small_to_be_kidnapped_in_has_no_journey():
    assert journeys(line(8), kidnap=True) == ()


@pytest.mark.parametrize("frame", [None, Pose2D(3.0, -2.0, 1.0)])
def test_odometry_begins_where_the_journey_does_and_misses_the_jump(frame):
    records = line(40, odometry=frame)
    journey = Journey((4, 5, 6, 30, 31), jump=3)
    told = odometry(records, journey)
    assert [round(pose.x, 9) for pose in told] == [0.0, 1.0, 2.0, 2.0, 3.0]
    assert all(abs(pose.y) < 1e-9 for pose in told)


def test_metres_count_until_the_first_confident_and_correct_report():
    records = line(10)
    journey = Journey(tuple(range(10)))
    found = recovery(records, journey, reports(records, journey, {3: "right", 4: "right"}))
    assert found.driven == 3.0
    assert not found.was_wrong
    assert math.isnan(found.withdrawn)
    never = recovery(records, journey, reports(records, journey, {}))
    assert never.driven == math.inf
    wrong = recovery(records, journey, reports(records, journey, {1: Pose2D(9.0), 2: "right"}))
    assert wrong.driven == 2.0
    assert wrong.was_wrong


def test_a_slip_is_told_from_another_place():
    records = line(10)
    journey = Journey(tuple(range(10)))
    slipped, away = (
        recovery(records, journey, reports(records, journey, {3: Pose2D(3.0 + off)}))
        for off in (1.5, 2.5)
    )
    assert (slipped.was_wrong, slipped.was_far) == (True, False)
    assert (away.was_wrong, away.was_far) == (True, True)
    assert summary([slipped, away]).was_far == 0.5


def test_after_a_kidnapping_the_old_pose_must_go_within_two_metres():
    records = line(60)
    journey = Journey((*range(5), *range(40, 50)), jump=5)
    before = {3: "right"}
    old = before | {index: Pose2D(float(4 + index - 5)) for index in range(5, 7)}
    right = {index: "right" for index in range(9, 15)}
    quick = recovery(records, journey, reports(records, journey, {**old, **right}))
    assert (quick.withdrawn, quick.driven, quick.was_wrong) == (2.0, 4.0, False)
    old = before | {index: Pose2D(float(4 + index - 5)) for index in range(5, 9)}
    slow = recovery(records, journey, reports(records, journey, {**old, **right}))
    assert (slow.withdrawn, slow.driven, slow.was_wrong) == (4.0, 4.0, True)
    old = before | {index: Pose2D(float(4 + index - 5)) for index in range(5, 15)}
    stuck = recovery(records, journey, reports(records, journey, old))
    assert stuck.withdrawn == math.inf
    old = before | {index: Pose2D(float(4 + index - 5)) for index in (5, 9)}
    back = recovery(records, journey, reports(records, journey, {**old, 12: "right"}))
    assert back.withdrawn == 5.0  # it came back after it was silent
    at_once = recovery(records, journey, reports(records, journey, {**before, **right}))
    assert at_once.withdrawn == 0.0
    never_located = recovery(records, journey, reports(records, journey, right))
    assert math.isnan(never_located.withdrawn)


def test_every_record_needs_a_report():
    records = line(3)
    with pytest.raises(ValueError, match="as many reports"):
        recovery(records, Journey((0, 1, 2)), [])


def test_summary_by_hand():
    found = summary(
        [
            Recovery(1.0, False, False, 1.0),
            Recovery(3.0, True, True, 5.0),
            Recovery(math.inf, False, False, math.inf),
        ]
    )
    assert found.journeys == 3
    assert found.found == pytest.approx(2 / 3)
    assert found.driven_median == 2.0
    assert found.driven_90 == pytest.approx(2.8)
    assert found.was_wrong == found.was_far == pytest.approx(1 / 3)
    assert found.withdrawn == pytest.approx(1 / 3)
    with pytest.raises(ValueError, match="no journeys"):
        summary([])
