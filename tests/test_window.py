"""Scans joined into a view all around: what was seen stays, what nobody saw is not made up."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scans import FULL_TURN, HALF_TURN, building

from anchorscan import LaserScan, Pose2D, Record, drive, joined_scan, random_building, simulate
from anchorscan.window import _see_again

headings = st.floats(-math.pi, math.pi)


def plain_see_again(ranges, points, seen, increment):
    """The same, reading by reading."""
    count = len(ranges)
    step = 2.0 * math.pi / count
    for i, first in enumerate(points):
        last = first
        if (
            i + 1 < len(points)
            and math.dist(points[i + 1], first) < 0.3 + 2.0 * increment * seen[i]
        ):
            last = points[i + 1]
        turn = math.atan2(last[1], last[0]) - math.atan2(first[1], first[0])
        turn = (turn + math.pi) % (2.0 * math.pi) - math.pi
        pieces = max(math.ceil(abs(turn) / step), 1)
        for share in np.arange(pieces) / pieces:
            x, y = first + share * (last - first)
            k = math.floor((math.atan2(y, x) + math.pi) / step + 0.5) % count
            r = math.hypot(x, y)
            if r > 0.0 and (math.isnan(ranges[k]) or r < ranges[k]):
                ranges[k] = r
    return ranges


@given(seed=st.integers(0, 2**32 - 1))
def test_seeing_again_is_the_nearest_at_each_angle(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2.0, 2.0, (12, 2))
    points[6:] = points[5] + 0.1 * np.arange(6)[:, None]
    seen = np.hypot(points[:, 0], points[:, 1])
    ranges = np.full(90, np.nan)
    _see_again(ranges, points, seen, 0.02)
    wanted = plain_see_again(np.full(90, np.nan), points, seen, 0.02)
    assert np.allclose(ranges, wanted, equal_nan=True)


def test_one_scan_joined_is_that_scan():
    world, at = building(0)
    scan = simulate(world, at[3], HALF_TURN, np.random.default_rng(0))
    joined = joined_scan([Record(0, scan, odometry=Pose2D(3.0, 2.0, 1.0))])
    assert joined.is_full_turn
    behind = np.abs(joined.angles) > math.pi / 2 + 0.1
    assert not joined.is_return[behind].any()
    for angle, distance in zip(
        scan.angles[scan.is_return], scan.ranges[scan.is_return], strict=True
    ):
        k = int(np.argmin(np.abs(joined.angles - angle)))
        assert joined.ranges[k] <= distance + 1e-3


@pytest.fixture(scope="module")
def records():
    return drive(random_building(2), seed=3, length=12.0, odometry_noise=0.0)


@settings(max_examples=20)
@given(frame=st.builds(Pose2D, st.floats(-50, 50), st.floats(-50, 50), headings))
def test_where_odometry_began_does_not_matter(records, frame):
    records = records[:12]
    moved = [Record(r.index, r.scan, odometry=frame @ r.odometry) for r in records]
    here, there = joined_scan(records), joined_scan(moved)
    same = np.isfinite(here.ranges) & np.isfinite(there.ranges)
    assert same.sum() > 0.9 * np.isfinite(here.ranges).sum()
    assert np.median(np.abs(here.ranges[same] - there.ranges[same])) < 1e-3


def test_a_window_sees_what_a_scanner_that_looks_all_around_sees(records):
    world = random_building(2)
    joined = joined_scan(records[-40:], 6.0, readings=FULL_TURN.count)
    around = simulate(world, records[-1].pose, FULL_TURN, np.random.default_rng(0))
    both = joined.is_return & around.is_return
    assert both.mean() > 0.6
    single = np.mean(records[-1].scan.is_return) * 0.5
    assert both.mean() > single
    assert np.median(np.abs(joined.ranges[both] - around.ranges[both])) < 0.1


def test_only_the_latest_metres_are_joined():
    scan = LaserScan(np.full(19, 1.0), -0.09, 0.01)
    records = [Record(n, scan, odometry=Pose2D(float(n), 0.0, 0.0)) for n in range(6)]
    joined = joined_scan(records, 2.0)
    farthest = joined.ranges[np.abs(joined.angles) > 3.0]
    assert np.nanmax(farthest) == pytest.approx(1.0, abs=0.01)
    assert joined_scan(records, 10.0).is_return.sum() >= joined.is_return.sum()


def test_nothing_to_join_is_an_error():
    with pytest.raises(ValueError, match="no record has a scan"):
        joined_scan([Record(0, None), Record(1, LaserScan(np.ones(3), 0.0, 0.1))])
