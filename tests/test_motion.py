"""Steps between scans: odometry as far as it can be trusted, a bound where there is none."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anchorscan import Pose2D
from anchorscan.motion import MotionSettings, Odometer, motion

SETTINGS = MotionSettings()
metres = st.floats(-3.0, 3.0)
headings = st.floats(-math.pi, math.pi)
poses = st.builds(Pose2D, metres, metres, headings)


@given(before=poses, step=st.builds(Pose2D, st.floats(-2, 2), st.floats(-2, 2), headings))
def test_a_step_of_the_odometry_is_told_in_the_frame_of_the_laser(before, step):
    told = motion(before, before @ step, 0.1, SETTINGS)
    assert told.measured
    assert told.step.distance(step) < 1e-9
    assert told.step.turn(step) < 1e-9
    assert told.driven == pytest.approx(math.hypot(step.x, step.y), abs=1e-9)


@given(frame=poses, before=poses, now=poses)
def test_where_odometry_began_does_not_matter(frame, before, now):
    here, there = (
        motion(before, now, 0.1, SETTINGS),
        motion(frame @ before, frame @ now, 0.1, SETTINGS),
    )
    assert here.measured == there.measured
    assert np.allclose(here.covariance, there.covariance)


def test_the_spread_grows_with_the_way_and_with_the_turn():
    spreads = [
        np.diag(motion(Pose2D(), Pose2D(way, 0.0, turn), 0.1, SETTINGS).covariance)
        for way, turn in ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))
    ]
    assert (spreads[0] > 0.0).all()
    assert (spreads[1] > spreads[0]).all()
    assert (spreads[2] > spreads[1]).all()


@pytest.mark.parametrize(
    ("before", "now"),
    [
        (None, Pose2D()),
        (Pose2D(), None),
        (Pose2D(), Pose2D(math.nan, 0.0, 0.0)),
        (Pose2D(0.0, math.inf, 0.0), Pose2D()),
        (Pose2D(), Pose2D(SETTINGS.longest_step + 0.1, 0.0, 0.0)),
    ],
    ids=["first", "lost", "not a number", "infinite", "jumped"],
)
def test_what_is_no_odometry_says_nothing_about_the_direction(before, now):
    told = motion(before, now, 1.0, SETTINGS)
    assert not told.measured
    assert told.step == Pose2D()
    assert told.driven == pytest.approx(SETTINGS.speed)
    assert np.sqrt(told.covariance[0, 0]) > SETTINGS.speed


@given(elapsed=st.one_of(st.none(), st.floats()))
def test_without_odometry_any_clock_gives_a_bounded_step(elapsed):
    told = motion(None, None, elapsed, SETTINGS)
    assert 0.0 <= told.driven <= SETTINGS.speed * SETTINGS.longest_interval
    assert 0.0 <= told.turned <= SETTINGS.turn_speed * SETTINGS.longest_interval
    assert np.isfinite(told.covariance).all()
    assert (np.diag(told.covariance) > 0.0).all()


mountings = st.builds(Pose2D, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), headings)


@given(base=poses, front=mountings, rear=mountings)
def test_another_laser_of_a_robot_at_rest_is_no_motion_and_moves_the_pose(base, front, rear):
    odometer = Odometer(SETTINGS)
    odometer.step(base @ front, 0.0, front)
    told = odometer.step(base @ rear, 0.1, rear)
    assert told.measured
    assert told.driven < 1e-9
    assert told.turned < 1e-9
    still = motion(Pose2D(), Pose2D(), 0.1, SETTINGS)
    assert np.allclose(told.covariance, still.covariance)
    assert (base @ front @ told.step).distance(base @ rear) < 1e-9
    assert (base @ front @ told.step).turn(base @ rear) < 1e-9
    # Nor is it one where odometry is silent.
    told = odometer.step(None, 0.2, front)
    assert not told.measured
    assert (base @ rear @ told.step).distance(base @ front) < 1e-9


@given(before=poses, now=poses)
def test_a_laser_at_the_origin_moves_as_its_odometry_does_to_the_last_bit(before, now):
    odometer = Odometer(SETTINGS)
    odometer.step(before, 0.0)
    told, plain = odometer.step(now, 0.1), motion(before, now, 0.1, SETTINGS)
    assert (told.step, told.driven, told.turned) == (plain.step, plain.driven, plain.turned)
    assert (told.covariance == plain.covariance).all()
