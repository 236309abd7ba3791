"""All that is derived from one scan: the stages one by one, and never an exception."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from scans import scans, sweeps

from anchorscan import LaserScan, Settings
from anchorscan.anchors import AnchorKind, anchor_points, virtual_edges
from anchorscan.angle_function import angle_function
from anchorscan.description import describe, looks
from anchorscan.evaluation import outline
from anchorscan.graph import anchor_graph
from anchorscan.segments import segments
from anchorscan.verification import readings

PRESETS = {name: Settings.preset(name) for name in ("paper", "default", "thorough")}
presets = st.sampled_from(list(PRESETS.values()))


def same(ours, theirs):
    """Hold two values with arrays equal, field by field."""
    for name in ours.__dataclass_fields__:
        a, b = getattr(ours, name), getattr(theirs, name)
        if hasattr(a, "__dataclass_fields__"):
            same(a, b)
        else:
            np.testing.assert_array_equal(a, b, err_msg=name)


def check_stages(scan, settings):
    whole = describe(scan, settings)
    scan = scan.thinned(settings.anchors.finest_increment)
    angles = angle_function(scan, settings.anchors.angle_function)
    same(whole.angles, angles)
    same(whole.surfaces, segments(angles, settings.anchors.segments))
    edges = virtual_edges(angles, settings.anchors)
    assert len(whole.edges) == len(edges)
    for ours, theirs in zip(whole.edges, edges, strict=True):
        same(ours, theirs)
    anchors = anchor_points(scan, settings.anchors)
    same(whole.anchors, anchors)
    same(whole.graph, anchor_graph(anchors, settings.graph))
    same(whole.outline, outline(scan, angles))
    np.testing.assert_array_equal(whole.readings, readings(angles, settings.verification))
    np.testing.assert_array_equal(whole.points, angles.points)
    return whole


@given(scans(), presets)
def test_a_description_is_what_the_stages_give_one_by_one(scan, settings):
    check_stages(scan, settings)


@pytest.mark.parametrize("name", PRESETS)
def test_a_real_scan_is_described_by_its_stages(name, real_scans):
    anchors = [len(check_stages(scan, PRESETS[name]).anchors) for scan in real_scans]
    assert np.median(anchors) >= 3


@given(scans(), presets)
@examples(max_examples=30)
def test_virtual_edges_are_the_crossings_of_the_walls_that_are_told(scan, settings):
    whole = describe(scan, settings)
    crossings = sum(len(each.x_walls) * len(each.y_walls) for each in whole.edges)
    assert np.count_nonzero(whole.anchors.kinds == AnchorKind.VIRTUAL_EDGE) == crossings
    if whole.edges:
        assert whole.anchors.main_angle == whole.edges[0].main_angle
    assert len(whole.edges) <= settings.anchors.most_main_angles


def room_between(normals, distances):
    """Give a scan of a room between walls of these directions and distances."""
    bearings = np.arange(360) * math.pi / 180.0
    toward = np.cos(bearings[:, None] - np.radians(normals))
    with np.errstate(divide="ignore"):
        ranges = np.where(toward > 0.01, np.array(distances) / toward, np.inf).min(axis=1)
    return LaserScan(ranges, 0.0, math.pi / 180.0, 0.05, 60.0)


def test_a_room_that_is_no_rectangle_is_looked_for_in_both_frames():
    settings = Settings.preset()
    for normals, angles in (([0, 90, 180, 270], [0]), ([0, 70, 180, 250], [0, 70])):
        whole = describe(room_between(normals, [3.0, 2.0, 3.0, 2.0]), settings)
        seen = looks(whole, settings)
        assert seen[0].graph is whole.graph
        mains = sorted(round(math.degrees(look.graph.anchors.main_angle)) % 90 for look in seen)
        assert mains == angles


@given(scans())
@examples(max_examples=30)
def test_another_frame_has_other_virtual_edges_and_all_else_the_same(scan):
    settings = Settings.preset()
    whole = describe(scan, settings)
    first, *others = looks(whole, settings)
    same(first.graph, whole.graph)
    assert len(others) <= 1
    for other in others:
        anchors = other.graph.anchors
        off = math.remainder(anchors.main_angle - whole.anchors.main_angle, 0.5 * math.pi)
        assert abs(off) > math.radians(1.0)  # each is the mean around peaks 7 degrees apart
        for name in ("positions", "kinds", "directions"):
            ours, theirs = (
                getattr(each, name)[each.kinds != AnchorKind.VIRTUAL_EDGE]
                for each in (whole.anchors, anchors)
            )
            np.testing.assert_array_equal(ours, theirs)


def test_the_default_takes_more_anchors_than_the_paper(real_scans):
    taken = {
        name: sum(len(describe(scan, settings).anchors) for scan in real_scans)
        for name, settings in PRESETS.items()
    }
    # False anchors cost little where every proposal is checked, so extraction is generous.
    assert taken["default"] > taken["paper"]
    assert taken["thorough"] == taken["default"]


@given(sweeps(), presets)
def test_anything_a_message_may_hold_has_a_description(scan, settings):
    whole = describe(scan, settings)
    assert len(whole.readings) <= scan.is_return.sum()
    assert np.all(whole.surfaces.last < len(whole.readings))
    assert np.all(np.isfinite(whole.graph.lengths))


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("ranges", [[], [2.0], [math.nan] * 181, [math.inf] * 181, [0.0] * 181])
def test_a_scan_with_nothing_to_tell_is_described_as_such(name, ranges):
    whole = describe(LaserScan.from_field_of_view(ranges, math.pi), PRESETS[name])
    assert len(whole.surfaces) == len(whole.anchors) == len(whole.graph) == 0
    assert len(whole.readings) == sum(math.isfinite(r) and r > 0.0 for r in ranges)
