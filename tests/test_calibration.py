"""The fit of the decision on samples whose answer is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from anchorscan import Pose2D, Reference, SensorModel, Settings, random_building, simulate
from anchorscan.calibration import Sample, fit, gather, rotate, weigh
from anchorscan.decision import DecisionSettings
from anchorscan.simulator import random_poses

TRUE = np.array([-3.0, 1.5, 2.0, -4.0, 0.5, 0.7])
NAMES = ("constant", "log_margin", "explained", "through", "heading", "anchors")


def drawn(building, count, seed, coefficients=TRUE):
    rng = np.random.default_rng(seed)
    numbers = np.column_stack(
        (
            np.ones(count),
            np.log(rng.uniform(0.002, 0.5, count)),
            rng.uniform(0.5, 4.0, count),
            np.sqrt(rng.uniform(0.0, 0.3, count)),
            np.log(rng.uniform(5.0, 5000.0, count)),
            np.log1p(rng.integers(0, 20, count)),
        )
    )
    probability = 1.0 / (1.0 + np.exp(-(numbers @ coefficients)))
    right = rng.random(count) < probability
    return Sample("P1", building, (building, building), 0.0, numbers, np.ones(count), right)


def test_the_fit_finds_the_coefficients_that_made_the_samples():
    found = weigh([drawn("a", 20_000, 0), drawn("b", 20_000, 1)])
    assert set(found) <= set(DecisionSettings.model_fields)
    np.testing.assert_allclose([found[name] for name in NAMES], TRUE, atol=0.25)


def test_a_building_is_scored_by_the_others_alone():
    odd = drawn("odd", 3000, 2, -TRUE)
    usual = [drawn("a", 3000, 3), drawn("b", 3000, 4)]
    scored = {each.place: each for each in rotate([odd, *usual], 0.9)}
    by_others = fit(odd, np.array(list(weigh(usual).values())), 0.9)
    assert scored["odd"] == by_others
    assert scored["odd"].calibration_error > 0.3


def test_separable_samples_do_not_run_away():
    sample = drawn("a", 200, 5)
    clear = replace(sample, correct=sample.evidence[:, 2] > 2.0)
    assert all(math.isfinite(value) and abs(value) < 1e3 for value in weigh([clear]).values())


class Simulated:
    protocol = "P1"
    place = "simulated"
    buildings = ("simulated", "simulated")

    def __init__(self):
        rng = np.random.default_rng(7)
        world = random_building(3)
        sensor = SensorModel(field_of_view=math.radians(270.0))
        places = random_poses(world, 12, rng)
        self.references = [
            Reference(k, simulate(world, place, sensor, rng), place)
            for k, place in enumerate(places)
        ]
        near = [place @ Pose2D(0.2, 0.1, 0.2) for place in places]
        self.queries = [(simulate(world, place, sensor, rng), place) for place in near]


def test_evidence_is_gathered_and_judged_by_the_truth():
    said: list[str] = []
    case = Simulated()
    alone, few, many = gather([case], Settings.preset("default"), 100, said.append)
    assert alone.evidence.shape == few.evidence.shape == many.evidence.shape == (12, 6)
    assert alone.correct.mean() > 0.8
    assert said[0] == f"P1 simulated, 0% occluded: {alone.correct.sum()} of 12"
    # People hide what the map explains.
    assert alone.evidence[:, 2].mean() > few.evidence[:, 2].mean() > many.evidence[:, 2].mean()
    case.queries = [(scan, None) for scan, _ in case.queries]
    for sample in gather([case], Settings.preset("default"), 100, said.append):
        assert not sample.correct.any()


@pytest.mark.parametrize("threshold", [0.5, 0.99])
def test_answers_are_counted_at_the_threshold(threshold):
    sample = drawn("a", 500, 9)
    scored = fit(sample, TRUE, threshold)
    probability = 1.0 / (1.0 + np.exp(-(sample.evidence @ TRUE)))
    assert scored.accepted == np.sum(probability >= threshold)
    assert scored.accepted_wrong == np.sum((probability >= threshold) & ~sample.correct)
