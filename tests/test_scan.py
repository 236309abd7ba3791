"""The laser scan: what is a reading, and when a sweep closes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scans import sweeps

from anchorscan import LaserScan, ScanError


@given(sweeps())
def test_a_reading_is_a_return_free_or_no_information(scan):
    with np.errstate(over="ignore"):
        shortest, longest = np.float32(scan.range_min), np.float32(scan.range_max)
    expected = [
        "return"
        if shortest <= r <= min(longest, 1e4) and r > 0.0
        else "free"
        if r > longest
        else ""
        for r in scan.ranges
    ]
    assert np.where(scan.is_return, "return", np.where(scan.is_free, "free", "")).tolist() == (
        expected
    )
    ranges = scan.ranges[scan.is_return].astype(np.float64)
    np.testing.assert_allclose(np.hypot(*scan.points.T), ranges, rtol=1e-12)


@pytest.mark.parametrize(
    ("count", "degrees", "closes"),
    [
        (360, 1.0, True),
        (361, 1.0, True),
        (359, 1.0, True),  # the reading that would complete the turn is left out
        (358, 1.0, False),
        (270, 1.0, False),
        (720, 0.4993046, True),  # an RPLidar: 720 readings, 359.5 degrees
        (1081, 0.25, False),
        (2, 180.0, False),
    ],
)
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_full_turn_closes(count, degrees, closes, sense):
    scan = LaserScan(np.ones(count), 0.3, sense * math.radians(degrees))
    assert scan.is_full_turn == closes


def test_the_turntable_of_a_real_sensor_closes(real_records):
    assert all(record.scan.is_full_turn for record in real_records("olin"))


@given(st.floats(-1e-9, 1e-9, exclude_min=True, exclude_max=True).filter(bool))
def test_an_increment_that_is_no_angle_is_refused(increment):
    with pytest.raises(ScanError, match="increment"):
        LaserScan(np.ones(3), 0.0, increment)


@given(
    st.integers(0, 400),
    st.floats(math.radians(0.02), math.radians(2.0)),
    st.sampled_from([1.0, -1.0]),
    st.floats(0.0, math.radians(3.0)),
)
def test_a_thinned_scan_has_readings_of_the_first_none_closer_than_asked(
    count, increment, sense, finest
):
    scan = LaserScan(1.0 + np.arange(count, dtype=np.float32) % 7, 0.3, sense * increment)
    thin = scan.thinned(finest)
    every = max(math.floor(finest / increment + 1e-4), 1) if count else 1
    assert thin.ranges.tolist() == scan.ranges[::every].tolist()
    np.testing.assert_allclose(thin.angles, scan.angles[::every], atol=1e-9)
    assert (thin is scan) == (every == 1)


def test_a_laser_of_many_readings_still_closes_when_they_are_thinned():
    scan = LaserScan(np.ones(3200), -math.pi, 2.0 * math.pi / 3200.0)
    thin = scan.thinned(math.radians(0.5))
    assert len(thin) == 800
    assert thin.is_full_turn


def test_a_scan_of_which_every_other_reading_is_lost_keeps_the_others_when_thinned():
    ranges = np.where(np.arange(1000) % 2 == 1, 2.0, np.nan)
    scan = LaserScan(ranges, -1.0, math.radians(0.25))
    thin = scan.thinned(math.radians(0.5))
    assert thin.is_return.all()
    np.testing.assert_allclose(thin.angles, scan.angles[1::2], atol=1e-9)


@given(sweeps(), st.floats(0.0, 1.0))
def test_a_thinned_scan_has_a_return_where_the_scan_has_one(scan, finest):
    assert scan.thinned(finest).is_return.any() == scan.is_return.any()


@given(sweeps())
def test_upside_down_a_laser_shows_the_mirror_image(scan):
    turned = scan.upside_down()
    np.testing.assert_allclose(turned.points, scan.points * (1.0, -1.0), atol=1e-9)
    assert turned.upside_down().ranges.tobytes() == scan.ranges.tobytes()
    assert turned.upside_down().angle_min == scan.angle_min
