"""Scans without anchor points: where they may stand, and that they are found there."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scans import FULL_TURN, box, building, drawn, seeds

from anchorscan import Matcher, Pose2D, Reference, Settings, simulate
from anchorscan.anchors import AnchorPoints
from anchorscan.description import describe
from anchorscan.field import FieldSettings, LikelihoodField
from anchorscan.pairwise import Known
from anchorscan.proposal import ProposalSettings
from anchorscan.standing import Places, places, standing
from anchorscan.standing import _cells_around as cells_around
from anchorscan.stitched_map import StitchedMap

ROOM = box(-3.0, -2.0, 5.0, 2.0)
AT = (Pose2D(0.3, 0.2, 0.4), Pose2D(3.2, -0.5, -1.0), Pose2D(-1.5, 1.0, 2.0))
SETTINGS = ProposalSettings()


def tiles_of(walls, at=AT):
    scans = [(drawn(walls, at=pose), pose) for pose in at]
    return LikelihoodField(FieldSettings(), scans).tiles


@pytest.fixture(scope="module")
def known() -> Places:
    poses = np.array([pose.to_array() for pose in AT])
    return places(poses, -poses[:, 2], tiles_of(ROOM))


def test_places_are_those_of_references_and_then_free_ones_clear_of_walls(known):
    assert known.positions[: len(AT)].tolist() == [[pose.x, pose.y] for pose in AT]
    free = known.positions[len(AT) :]
    assert len(free) > 200
    assert np.all(np.abs(free - (1.0, 0.0)) <= (3.9, 1.9))
    steps = free / 0.3
    assert np.allclose(steps, np.round(steps))
    apart = np.array([np.hypot(*(free - (pose.x, pose.y)).T) for pose in AT])
    assert apart.min(axis=0).max() <= 4.0
    # Every place of the grid that is well inside the room is there.
    wanted = [
        (x, y)
        for x in np.arange(-9, 16)
        for y in np.arange(-5, 6)
        if min(math.hypot(0.3 * x - p.x, 0.3 * y - p.y) for p in AT) < 3.9
        and abs(0.3 * x - 1.0) < 3.6
    ]
    assert {(round(x), round(y)) for x, y in steps.tolist()} >= set(wanted)


@given(order=st.permutations(range(len(AT))))
def test_free_places_are_the_same_in_any_order_of_references(order, known):
    poses = np.array([AT[k].to_array() for k in order])
    again = places(poses, -poses[:, 2], tiles_of(ROOM))
    assert np.array_equal(again.positions[len(AT) :], known.positions[len(AT) :])
    assert np.allclose(again.main_angles, 0.0)


def test_a_place_has_the_walls_of_the_nearest_reference():
    poses = np.array([pose.to_array() for pose in AT])
    walls = np.array([0.1, 0.2, math.nan])
    told = places(poses, walls - poses[:, 2], tiles_of(ROOM))
    far = np.array([np.hypot(*(told.positions - (p.x, p.y)).T) for p in AT])
    assert np.allclose(told.main_angles, walls[np.argmin(far, axis=0)], equal_nan=True)


@pytest.mark.parametrize("main_angle", [0.3, math.nan])
def test_the_pose_is_proposed_whether_or_not_main_walls_are_known(known, main_angle):
    truth = Pose2D(1.1, 0.8, -0.3)
    points = drawn(ROOM, at=truth).points
    proposed = standing(known, main_angle, points, tiles_of(ROOM), SETTINGS)
    free = len(known.positions)
    assert proposed.proposed == free * (4 if math.isfinite(main_angle) else 36)
    near = [
        score
        for (x, y, theta), score in zip(proposed.poses, proposed.scores, strict=True)
        if Pose2D(x, y, theta).distance(truth) < 0.25
        and Pose2D(x, y, theta).turn(truth) < math.radians(6.0)
    ]
    assert near
    assert max(near) >= np.quantile(proposed.scores, 0.8)


def test_a_scan_that_fits_nowhere_may_stand_where_references_were_taken(known):
    # Every reading ends deep in known free space.
    points = np.array([[0.3 * math.cos(a), 0.3 * math.sin(a)] for a in range(20)])
    inside = Places(known.positions[:1] * 0.0 + (1.0, 0.0), np.zeros(1))
    proposed = standing(inside, 0.0, points, tiles_of(ROOM), SETTINGS)
    assert np.all(proposed.scores == 0.0)
    assert proposed.poses[:, :2].tolist() == [[1.0, 0.0]] * 4


@pytest.mark.parametrize("number", range(4))
def test_what_shows_no_anchor_points_is_found_nearly_as_well_as_what_does(number):
    """Its anchor points are taken away, so that nothing but the search of this file is left."""
    world, at = building(number)
    known = [
        Known(Reference(k, scan, pose), describe(scan, Settings()))
        for k, pose in enumerate(at[:12])
        for scan in [simulate(world, pose, FULL_TURN, np.random.default_rng(k))]
    ]
    found = StitchedMap(Settings(), known)
    right = [0, 0]
    for truth in [near_by(pose, k) for k, pose in enumerate(at[:12])]:
        shown = describe(simulate(world, truth, FULL_TURN, np.random.default_rng(99)), Settings())
        for k, anchors in enumerate((shown.anchors, without_points(shown.anchors))):
            best = found.search(replace(shown, anchors=anchors), None).hypotheses[0].pose
            right[k] += best.distance(truth) < 0.1 and best.turn(truth) < math.radians(3.0)
    assert right[1] >= max(right[0] - 2, 8)


def near_by(pose: Pose2D, k: int) -> Pose2D:
    return pose @ Pose2D(0.2, 0.15, 0.3 * k)


def without_points(anchors: AnchorPoints) -> AnchorPoints:
    """Only the main walls are left."""
    none = slice(0, 0)
    return AnchorPoints(
        anchors.positions[none], anchors.kinds[none], anchors.directions[none], anchors.main_angle
    )


def test_without_references_there_is_no_place():
    wall = drawn([(3.0, -0.03, 3.0, 0.03)])
    matcher = Matcher([Reference(0, wall, Pose2D())])
    assert matcher.locate(wall)
    matcher.remove(0)
    assert matcher.locate(wall) == []


def test_two_ends_of_a_plain_corridor_are_no_answer():
    corridor = [(-12.0, -1.0, 12.0, -1.0), (-12.0, 1.2, 12.0, 1.2)]
    sensor = replace(FULL_TURN, range_max=4.0)
    at = [Pose2D(x, 0.0, 0.1 * x) for x in np.arange(-10.0, 10.5, 2.0).tolist()]
    matcher = Matcher(
        [Reference(k, drawn(corridor, at=p, sensor=sensor), p) for k, p in enumerate(at)]
    )
    scan = drawn(corridor, at=Pose2D(0.9, 0.1, 0.2), sensor=sensor)
    assert len(describe(scan, Settings()).anchors) == 0
    best = matcher.locate(scan)[0]
    assert abs(best.pose.y - 0.1) < 0.05
    assert not best.accepted


@given(seeds, st.integers(1, 6))
def test_cells_around_are_what_the_twin_finds(seed, count):
    rng = np.random.default_rng(seed)
    poses, reach = rng.uniform(-9.0, 9.0, (count, 3)), rng.uniform(0.5, 5.0)
    cells, nearest = cells_around(poses, reach)
    wanted = {}
    for u, v in itertools.product(range(-16, 17), repeat=2):
        far = np.hypot(u - poses[:, 0], v - poses[:, 1])
        if far.min() <= reach:
            wanted[u, v] = int(np.argmin(far))
    found = zip(map(tuple, cells.tolist()), nearest.tolist(), strict=True)
    assert dict(found) == wanted
    assert len(cells) == len(wanted)
