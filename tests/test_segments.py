"""Large connected surfaces against their plain twin and drawn rooms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scans import box, drawn, reversed_sweep, scans, seen_in_building, sweeps, wild_scans

from anchorscan import LaserScan
from anchorscan.angle_function import CONNECTED, AngleFunctionSettings, angle_function
from anchorscan.segments import SegmentSettings, is_small, segments

SURFACES = AngleFunctionSettings()
PRESETS = [SegmentSettings(), SegmentSettings(smallest_extent=0.2, fewest_readings=2)]


def plain_segments(angles, limits):
    """Runs without a gap, as lists; those that are long and dense enough."""
    runs, run = [], []
    for i in range(len(angles.ranges)):
        if run and angles.gaps[i - 1] != CONNECTED:
            runs.append(run)
            run = []
        run.append(i)
    runs.append(run)
    rows = []
    for run in runs:
        length = angles.way[run[-1]] - angles.way[run[0]] if run else 0.0
        if len(run) >= limits.fewest_readings and length >= limits.smallest_extent - 1e-9:
            rows.append((run[0], run[-1]))
    return rows


def check_against_twin(scan, limits):
    angles = angle_function(scan, SURFACES)
    found = segments(angles, limits)
    assert list(zip(found.first, found.last, strict=True)) == plain_segments(angles, limits)
    assert len(found) == len(found.first)


@pytest.mark.parametrize("limits", PRESETS)
@pytest.mark.interpreted
def test_a_building_gives_what_the_twin_gives(limits):
    check_against_twin(seen_in_building(5), limits)


@pytest.mark.parametrize("limits", PRESETS)
def test_real_scans_give_what_the_twin_gives(limits, real_scans):
    for scan in real_scans:
        check_against_twin(scan, limits)


@given(st.one_of(wild_scans(), sweeps()), st.sampled_from(PRESETS))
def test_surfaces_and_nonsense_give_what_the_twin_gives(scan, limits):
    check_against_twin(scan, limits)


def test_a_table_leg_is_no_large_surface_and_the_wall_behind_it_is_two():
    scan = drawn(box(-3.0, -2.0, 4.0, 2.5), pillars=[(1.5, 0.3, 0.05)])
    angles = angle_function(scan, SURFACES)
    found = segments(angles, SegmentSettings())
    # The wall all around begins on one side of the shadow and ends on the other.
    assert len(found) == 1
    ends = angles.points[[found.first[0], found.last[0]]]
    np.testing.assert_allclose(ends[:, 0], 4.0, atol=1e-5)
    assert np.hypot(*(ends[0] - ends[1])) < 0.6


@given(scans())
def test_the_sense_of_rotation_does_not_matter(scan):
    here = angle_function(scan, SURFACES)
    there = angle_function(reversed_sweep(scan), SURFACES)
    ours, theirs = segments(here, PRESETS[0]), segments(there, PRESETS[0])
    np.testing.assert_array_equal(ours.first, theirs.first)
    np.testing.assert_array_equal(ours.last, theirs.last)


@pytest.mark.parametrize("ranges", [[], [2.0], [math.nan] * 9, [math.inf] * 9, [0.0] * 9])
@pytest.mark.interpreted
def test_a_scan_with_nothing_to_tell_has_no_large_surface(ranges):
    scan = LaserScan.from_field_of_view(ranges, math.pi)
    assert len(segments(angle_function(scan, SURFACES), PRESETS[1])) == 0


@given(wild_scans(), st.floats(0.01, 5.0))
def test_small_things_are_runs_that_are_short_along_their_way(scan, extent):
    angles = angle_function(scan, SURFACES)
    expected, run = [], []
    for i in range(len(angles.ranges)):
        run.append(i)
        if i + 1 == len(angles.ranges) or angles.gaps[i] != CONNECTED:
            expected += [angles.way[run[-1]] - angles.way[run[0]] < extent] * len(run)
            run = []
    assert is_small(angles.runs, angles.way, extent).tolist() == expected
