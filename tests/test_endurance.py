"""A day in fast motion: what grows is found, and nothing does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anchorscan import AnchorscanError, Record, ReferenceSet, drive, random_building
from anchorscan.endurance import day, run, trend
from anchorscan.localizer import Localizer

RATE = 6.0
LAPS = 5


@pytest.fixture(scope="module")
def course() -> tuple[ReferenceSet, list[list[Record]]]:
    world = random_building(2)
    first, second = (drive(world, seed=seed, length=6.0) for seed in (1, 2))
    return ReferenceSet.build(first, spacing=1.0), [first, second]


def hours(drives: Sequence[Sequence[Record]], laps: float) -> float:
    return laps * sum(map(len, drives)) / RATE / 3600.0


def test_a_lap_leaves_no_object_behind(course) -> None:
    places, drives = course
    laps = day(places, drives, hours(drives, LAPS - 0.5), RATE)
    assert len(laps) == LAPS
    assert laps[-1].hours == pytest.approx(hours(drives, LAPS))
    # The garbage collector follows as many after the last lap as after the second.
    assert abs(laps[-1].objects - laps[1].objects) < 10
    assert laps[-1].located == laps[0].located > 0.5
    assert laps[-1].wrong == laps[0].wrong


def test_what_is_left_behind_at_every_step_is_found(course, monkeypatch) -> None:
    places, drives = course
    left: list[list[int]] = []
    update = Localizer.update

    def leaky(self, *args):
        left.append([])
        return update(self, *args)

    monkeypatch.setattr(Localizer, "update", leaky)
    said: list[str] = []
    run(places, drives, hours(drives, 4), RATE, said.append, lambda items, *_: items)
    assert [line for line in said if line.startswith("objects") and line.endswith("GROWS")]


def test_too_few_laps_make_no_line(course) -> None:
    places, drives = course
    with pytest.raises(AnchorscanError, match=r"2 laps .* make no line"):
        day(places, drives, hours(drives, 2), RATE)


@given(
    slope=st.floats(-10.0, 10.0),
    start=st.floats(-100.0, 100.0),
    count=st.integers(3, 40),
)
def test_a_line_is_found_as_it_is(slope: float, start: float, count: int) -> None:
    at = np.arange(count) / 7.0
    found = trend(at, start + slope * at)
    assert found.slope == pytest.approx(slope, abs=1e-9)
    assert found.error == pytest.approx(0.0, abs=1e-9)


def test_the_error_of_a_slope_is_that_of_the_textbook() -> None:
    at, values = np.array([1.0, 2.0, 3.0, 4.0]), np.array([1.0, 3.0, 2.0, 5.0])
    found = trend(at, values)
    # By hand: slope 1.1; residuals -0.1, 0.8, -1.3, 0.6, their squares 2.7; 2.7 / 2 / 5 = 0.27.
    assert found.slope == pytest.approx(1.1)
    assert found.error == pytest.approx(np.sqrt(0.27))
    assert not found.grows


def test_noise_alone_seldom_counts_as_growth() -> None:
    rng = np.random.default_rng(0)
    grown = [trend(np.arange(50), rng.normal(size=50)).grows for _ in range(400)]
    assert np.mean(grown) < 0.01
