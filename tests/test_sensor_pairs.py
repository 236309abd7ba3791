"""One set for lasers of all kinds: what one saw, another finds."""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchorscan import (
    Matcher,
    Pose2D,
    Reference,
    SensorModel,
    Settings,
    World,
    random_building,
    simulate,
)
from anchorscan.cli import main
from anchorscan.protocol import Answer
from anchorscan.sensor_pairs import SENSORS, Pair, compare, table
from anchorscan.simulator import random_poses

DEFAULT = Settings.preset("default")
MODELS = st.builds(
    SensorModel,
    field_of_view=st.sampled_from([math.radians(a) for a in (180, 240, 270, 360)]),
    resolution=st.sampled_from([math.radians(a) for a in (0.25, 0.5, 1.0, 2.0)]),
    range_max=st.sampled_from([4.0, 8.0, 30.0, 80.0]),
    clockwise=st.booleans(),
    upside_down=st.booleans(),
    dropout=st.sampled_from([0.0, 0.1]),
    dropout_value=st.sampled_from([math.nan, math.inf, 0.0]),
    no_return_value=st.sampled_from([math.inf, math.nan, 0.0, 1_000.0]),
    mounting=st.builds(
        Pose2D, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-math.pi, math.pi)
    ),
)


@pytest.fixture(scope="module")
def office() -> World:
    return random_building(3, length=20.0, depth=14.0)


@pytest.fixture(scope="module")
def places(office: World) -> Matcher:
    """References of an all-round laser, all over the building."""
    sensor = SensorModel(2.0 * math.pi, math.radians(0.5), range_max=30.0)
    rng = np.random.default_rng(0)
    poses = random_poses(office, 80, 1)
    scans = [simulate(office, pose, sensor, rng) for pose in poses]
    return Matcher([Reference(k, scans[k], poses[k]) for k in range(len(poses))], DEFAULT)


def is_right(found: Pose2D, truth: Pose2D) -> bool:
    return found.distance(truth) < 0.5 and found.turn(truth) < math.radians(10.0)


@given(seed=st.integers(0, 2**31 - 1), model=MODELS)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_whatever_the_laser_an_answer_that_is_believed_is_right(
    office: World, places: Matcher, seed: int, model: SensorModel
) -> None:
    truth = random_poses(office, 1, seed)[0] @ model.mounting
    scan = simulate(office, truth, model, np.random.default_rng(seed))
    found = places.locate(scan)
    assert bool(found) == bool(scan.is_return.any())
    for each in found:
        assert each.pose is not None
        assert each.pose.is_finite()
        assert np.isfinite(each.covariance).all()
        assert is_right(each.pose, truth) or not each.accepted


LASERS = {
    "narrow": SensorModel(math.pi, math.radians(0.5), range_max=30.0),
    "coarse": SensorModel(math.radians(240.0), math.radians(2.0), range_max=30.0),
    "fine, clockwise": SensorModel(math.radians(270.0), math.radians(0.25), clockwise=True),
    "upside down, aside": SensorModel(
        math.radians(270.0), upside_down=True, mounting=Pose2D(0.2, 0.1, 2.0)
    ),
    "near-sighted": SensorModel(2.0 * math.pi, range_max=4.0),
    "far-sighted": SensorModel(2.0 * math.pi, range_max=80.0, no_return_value=81.0),
    "losing NaN": SensorModel(2.0 * math.pi, dropout=0.1),
    "losing infinity": SensorModel(2.0 * math.pi, dropout=0.1, dropout_value=math.inf),
}


@pytest.mark.parametrize("name", LASERS)
def test_every_laser_finds_its_places_among_references_of_another(
    office: World, places: Matcher, name: str
) -> None:
    rng = np.random.default_rng(5)
    truths = [pose @ LASERS[name].mounting for pose in random_poses(office, 20, 6)]
    found = [places.locate(simulate(office, truth, LASERS[name], rng)) for truth in truths]
    right = [is_right(each[0].pose, truth) for each, truth in zip(found, truths, strict=True)]
    assert sum(right) >= 16


def test_a_reading_that_is_lost_as_nan_or_as_nothing_moves_no_answer(
    office: World, places: Matcher
) -> None:
    """Lost readings as NaN, infinity or out of the limits: the rest decides."""
    sensor = SensorModel(2.0 * math.pi)
    for truth in random_poses(office, 10, 8):
        scan = simulate(office, truth, sensor, np.random.default_rng(2))
        lost = np.random.default_rng(3).random(len(scan)) < 0.1
        best = [
            places.locate(replace(scan, ranges=np.where(lost, np.float32(value), scan.ranges)))[0]
            for value in (math.nan, -math.inf, 0.0, 1_000.0, math.inf)
        ]
        # No information is no information, however it is said; infinity says that all is free.
        assert best[0].pose == best[1].pose == best[2].pose
        if best[0].accepted and best[4].accepted:
            assert is_right(best[4].pose, best[0].pose)


def test_every_pair_is_asked_the_same_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("anchorscan.sensor_pairs._LENGTH", 30.0)
    building = random_building(2, length=20.0, depth=14.0)
    pairs = compare(building, 2, 6, DEFAULT)
    assert [(pair.references, pair.queries) for pair in pairs] == [
        (one, other) for one in SENSORS for other in SENSORS
    ]
    asked = {tuple(answer.query for answer in pair.answers) for pair in pairs}
    assert len(asked) == 1
    for name, sensor in SENSORS.items():
        robots = {
            str([each.truth @ sensor.mounting.inverse() for each in pair.answers if each.truth])
            for pair in pairs
            if pair.queries == name
        }
        assert len(robots) == 1
    # One that sees four metres is asked where it sees less.
    short, far = (
        [
            a.is_correct
            for pair in pairs
            if ("4 m" in pair.queries) == is_short
            for a in pair.answers
        ]
        for is_short in (True, False)
    )
    assert np.mean(short) >= 0.5
    assert np.mean(far) >= 0.8


def test_the_table_counts_what_was_right() -> None:
    right, wrong = Pose2D(1.0, 0.0, 0.0), Pose2D(9.0, 0.0, 0.0)
    answers = [
        Answer(0, right, right, 0.99, True, 0.0),
        Answer(1, wrong, right, 0.98, True, 0.0),
        Answer(2, right, right, 0.1, False, 0.0),
        Answer(3, None, right, 0.0, False, 0.0),
    ]
    lines = table([Pair("one", "one", tuple(answers)), Pair("one", "other", tuple(answers[:1]))])
    assert lines == [
        "| references \\ queries | one | other |",
        "| --- | ---: | ---: |",
        "| one | 0.500 (1 / 1 / 2) | 1.000 (1 / 0 / 0) |",
    ]


def test_the_command_prints_a_table(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("anchorscan.sensor_pairs._LENGTH", 15.0)
    monkeypatch.setattr(
        sys, "argv", ["anchorscan", "compare-sensors", "--buildings", "1", "--queries", "2"]
    )
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    out = capsys.readouterr().out.splitlines()
    assert len(out) == 2 + len(SENSORS)
