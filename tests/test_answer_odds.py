"""What an answer tells the belief: the fit on samples of known odds, and the samples."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchorscan import (
    Record,
    Reference,
    SensorModel,
    Settings,
    random_building,
    simulate,
)
from anchorscan.answer_odds import Answers, fit, gather, rotate, unmapped
from anchorscan.belief import BeliefSettings
from anchorscan.simulator import random_poses


def drawn(building, apart, seed, count=4000):
    """Normal log odds of variance one: the odds of a sample are linear in them."""
    rng = np.random.default_rng(seed)
    right = Answers("right", building, (building,), rng.normal(1.0 + apart, 1.0, count))
    wrong = (
        Answers(kind, building, (building,), rng.normal(1.0, 1.0, count))
        for kind in ("elsewhere", "unmapped")
    )
    return [right, *wrong]


def test_the_fit_finds_the_odds_that_the_samples_were_drawn_with():
    """Two normals of one variance, d apart: the weight is d, and they are even half way."""
    found = fit([*drawn("a", 2.0, 0), *drawn("b", 2.0, 1)])
    assert found.weight == pytest.approx(2.0, abs=0.15)
    assert -found.constant / found.weight == pytest.approx(2.0, abs=0.05)
    assert found.right > 5.0 * found.unmapped
    assert {"answer_constant", "answer_weight"} <= set(BeliefSettings.model_fields)


def test_a_place_of_many_answers_weighs_as_much_as_one_of_few():
    few, many = drawn("few", 3.0, 2, 2000), drawn("many", 1.0, 3, 2000)
    even = fit([*few, *many])
    repeated = [
        Answers(each.kind, each.place, each.buildings, np.tile(each.log_odds, 9)) for each in many
    ]
    uneven = fit([*few, *repeated])
    assert uneven.constant == pytest.approx(even.constant, abs=1e-6)
    assert uneven.weight == pytest.approx(even.weight, abs=1e-6)


def test_a_building_left_out_changes_nothing_and_is_what_is_scored():
    samples, odd = drawn("a", 2.0, 4), drawn("odd", -3.0, 5)
    found = {each.without: each for each in rotate([*samples, *odd])}
    assert found["odd"].weight == pytest.approx(fit(samples).weight)
    assert found["odd"].right < found["odd"].unmapped
    assert math.isnan(fit([*samples, odd[0]], "odd").unmapped)


def test_answers_of_one_sort_alone_tell_nothing():
    with pytest.raises(ValueError, match="right answers and others"):
        fit(drawn("a", 2.0, 6)[1:])


def records():
    """Two rooms' worth of scans of one building, in the order of the way."""
    rng, world = np.random.default_rng(7), random_building(3)
    sensor = SensorModel(field_of_view=math.radians(270.0))
    places = sorted(random_poses(world, 60, rng), key=lambda pose: pose.x)
    return [Record(k, simulate(world, at, sensor, rng), at) for k, at in enumerate(places)]


def test_what_is_around_a_region_is_taken_out_of_its_map():
    drive = records()
    by_index = {record.index: record.pose for record in drive}
    maps = list(unmapped(drive))
    assert maps
    for references, region in maps:
        assert region
        for reference in references:
            assert reference.pose == by_index[reference.identifier]
            assert all(pose.distance(reference.pose) > 10.0 - 1e-9 for _, pose in region)


class Simulated:
    protocol, place, looks_alike = "P1", "simulated", False
    buildings = ("simulated", "simulated")

    def __init__(self, drive):
        self.references = [Reference(r.index, r.scan, r.pose) for r in drive[::2]]
        self.queries = [(r.scan, r.pose) for r in drive[::2]]


class Drive:
    name = building = "simulated"

    def __init__(self, drive):
        self.records = tuple(drive)


def test_right_answers_are_surer_than_those_where_the_map_has_ended():
    drive, said = records(), []
    samples = gather(
        [Simulated(drive)], [Drive(drive)], Settings.preset("default"), 40, said.append
    )
    assert [sample.kind for sample in samples] == ["right", "unmapped"]
    assert len(said) == 2
    right, wrong = (np.median(sample.log_odds) for sample in samples)
    assert right > wrong + 2.0
    assert fit(samples).weight > 0.0
