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
    drive,
    random_building,
    simulate,
)
from anchorscan.decision import held
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


@given(
    deviations=st.tuples(*[st.floats(0.01, 3.0)] * 3),
    turn=st.floats(-3.0, 3.0),
)
@settings(max_examples=25)
def test_what_is_held_is_the_share_of_the_covariance_that_counts_as_correct(
    deviations: tuple[float, float, float], turn: float
) -> None:
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    spread: NDArray[np.float64] = np.diag(np.square(deviations))
    samples = np.random.default_rng(0).standard_normal((20_000, 3)) * deviations
    limits = (0.5, 0.5, math.radians(10.0))
    expected = float(np.mean((np.abs(samples) <= limits).all(axis=1)))
    assert held(rotation @ spread @ rotation.T) == pytest.approx(expected, abs=0.015)


def test_a_pose_that_is_exact_is_held_and_one_that_is_not_is_not() -> None:
    assert held(np.zeros((3, 3))) == 1.0
    assert held(np.diag([25.0, 1e-4, 1e-6])) < 0.1
    assert held(np.diag([1e-4, 1e-4, 1.0])) < 0.2
