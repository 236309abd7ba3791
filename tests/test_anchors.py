"""Anchor points against plain twins, drawn geometry, and the senses of a sweep."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scans import (
    FULL_TURN,
    box,
    drawn,
    places,
    reversed_sweep,
    rolled,
    scans,
    seen_in_building,
    sweeps,
    turned,
    wild_scans,
)

from anchorscan import LaserScan, Pose2D, SensorModel, Settings, World, simulate
from anchorscan.anchors import (
    AnchorKind,
    AnchorPoints,
    anchor_points,
    angle_anchors,
    gather,
    jump_edge_anchors,
    virtual_edges,
)
from anchorscan.angle_function import FREE, TO_FAR, TO_NEAR, angle_function
from anchorscan.segments import segments

LEFT, RIGHT, CONVEX, CONCAVE, VIRTUAL = AnchorKind
PAPER = Settings.preset("paper").anchors
DEFAULT = Settings.preset("default").anchors
PRESETS = pytest.mark.parametrize("preset", [PAPER, DEFAULT], ids=["paper", "default"])
presets = st.sampled_from([PAPER, DEFAULT])


def turn_between(a, b):
    return np.abs((np.asarray(a) - b + math.pi) % (2.0 * math.pi) - math.pi)


# The twins.


def plain_line(points):
    """Centre, unit vector from first to last, and rms error of the line of least squares."""
    centre = points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(points - centre)
    along = axes[0] if axes[0] @ (points[-1] - points[0]) >= 0.0 else -axes[0]
    return centre, along, sizes[-1] / math.sqrt(len(points)) if len(points) > 2 else 0.0


def plain_jump_edges(angles, surfaces, limits):
    """At each end of each large surface: is it an edge, and does the ray not graze it?"""
    rows = []
    for first, last in zip(surfaces.first, surfaces.last, strict=True):
        for kind, within in ((LEFT, range(last, first - 1, -1)), (RIGHT, range(first, last + 1))):
            margin = within[0]
            away = [abs(angles.way[k] - angles.way[margin]) for k in within]
            arm = [k for k, d in zip(within, away, strict=True) if d < limits.arm]
            arm += list(within[len(arm) :][:1])  # and the first that is an arm away
            gap = angles.gaps[margin if kind == LEFT else margin - 1]
            if gap not in (TO_FAR if kind == LEFT else TO_NEAR, FREE):
                continue
            if away[len(arm) - 1] < limits.shortest_arm:
                continue
            _, along, error = plain_line(angles.points[sorted(arm)])
            at = angles.points[margin]
            incidence = turn_between(angles.surface[margin], math.atan2(at[1], at[0]))
            incidence = min(incidence, math.pi - incidence)
            if error > limits.flatness or not incidence >= limits.smallest_rim_angle:
                continue
            if gap == FREE:
                # Two readings on, would the wall still be in reach?
                onward = at + 2.0 * along * (along @ (at - angles.points[arm[1]]))
                if np.hypot(*onward) > angles.reach:
                    continue
            else:
                # Does the wall go on behind the gap?
                behind = angles.points[(margin + (1 if kind == LEFT else -1)) % len(angles.points)]
                if abs(np.linalg.det([along, behind - at])) <= limits.flatness:
                    continue
            rows.append((*at, math.atan2(along[1], along[0]) + 0.5 * math.pi, kind))
    return rows


def plain_angle_anchors(angles, surfaces, limits):
    """Wherever lines fitted before and behind a gap between readings cross near it."""
    rows = []
    for first, last in zip(surfaces.first, surfaces.last, strict=True):
        way, at = angles.way, angles.points
        of_surface = []
        for i in range(first, last):
            j = i + 1
            begin = max(
                (k for k in range(first, i) if way[i] - way[k] >= limits.arm), default=first
            )
            end = min((k for k in range(j, last) if way[k] - way[j] >= limits.arm), default=last)
            if min(way[i] - way[begin], way[end] - way[j]) < limits.shortest_arm:
                continue
            if min(end - j, i - begin) < 2:
                continue
            centre, before, error = plain_line(at[begin : i + 1])
            other, after, other_error = plain_line(at[j : end + 1])
            turn = math.atan2(np.linalg.det([before, after]), before @ after)
            if max(error, other_error) > limits.flatness:
                continue
            if not limits.smallest_turn <= abs(turn) <= 0.95 * math.pi:
                continue
            share, _ = np.linalg.solve(np.column_stack((before, -after)), other - centre)
            corner = centre + share * before
            chord = np.linspace(at[i], at[j], 2001)
            off = np.hypot(*(chord - corner).T).min()
            if off > limits.farthest_corner:
                continue
            strength = abs(turn) / limits.smallest_turn - off / limits.farthest_corner
            strength -= (error + other_error) / limits.flatness
            free = math.atan2(before[1], before[0]) + 0.5 * turn + 0.5 * math.pi
            row = (strength, *corner, free, CONCAVE if turn > 0.0 else CONVEX)
            if of_surface and math.dist(corner, of_surface[-1][1:3]) < limits.arm:
                of_surface[-1] = max(of_surface[-1], row, key=lambda each: each[0])
            else:
                of_surface.append(row)
        rows += [row[1:] for row in of_surface]
    return rows


def plain_main_angles(angles, limits):
    """Peaks of the histogram of directions modulo 90 degrees, at least 15 degrees apart."""
    quarter = 0.5 * math.pi
    bins = limits.angle_function.bins // 2
    known = ~np.isnan(angles.surface)
    turns, weights = angles.surface[known] / quarter % 1.0, angles.extents[known]
    raw = np.bincount(np.minimum((turns * bins).astype(int), bins - 1), weights, bins)
    smooth = sum((4 - abs(j)) * np.roll(raw, -j) for j in range(-3, 4))
    strongest = smooth.max()
    found = []
    while len(found) < limits.most_main_angles:
        peak = int(np.argmax(smooth))
        if smooth[peak] <= 0.0 or smooth[peak] < limits.smallest_main_share * strongest:
            break
        centre = (peak + 0.5) * quarter / bins
        off = (angles.surface[known] - centre + 0.5 * quarter) % quarter - 0.5 * quarter
        near = np.abs(off) < math.radians(6.0)
        mean = np.average(off[near], weights=weights[near]) if weights[near].sum() > 0.0 else 0.0
        found.append(centre + mean)
        for k in range(bins):
            apart = abs((k - peak + bins // 2) % bins - bins // 2)
            if apart <= math.ceil(math.radians(15.0) / quarter * bins):
                smooth[k] = 0.0
    return found


def plain_walls(angles, main, limits):
    """Rows (axis, side, coordinate, length) of the walls that run across the axes of a frame."""
    width = limits.histogram_bin
    bins = {}
    for (x, y), direction, weight in zip(
        angles.points, angles.surface, angles.extents, strict=True
    ):
        if math.isnan(direction):
            continue
        u = (
            x * math.cos(main) + y * math.sin(main),
            y * math.cos(main) - x * math.sin(main),
        )
        for quarter in range(4):
            facing = main + quarter * 0.5 * math.pi  # +x, +y, -x, -y of the wall frame
            if turn_between(direction + 0.5 * math.pi, facing) <= limits.wall_angle:
                axis, side = quarter % 2, (1.0 if quarter < 2 else -1.0) if limits.facing else 0.0
                at = u[axis] / width - 0.5
                k = math.floor(at)
                wall = bins.setdefault((axis, side), {})
                wall[k] = wall.get(k, 0.0) + weight * (1.0 - (at - k))
                wall[k + 1] = wall.get(k + 1, 0.0) + weight * (at - k)
                break
    walls = {0: [], 1: []}
    for (axis, side), h in bins.items():
        for k, here in h.items():
            before, after = h.get(k - 1, 0.0), h.get(k + 1, 0.0)
            total = before + here + after
            if total >= limits.smallest_wall and here >= before and here > after:
                centre = (k - 1) * before + k * here + (k + 1) * after
                walls[axis].append((-total, (centre / total + 0.5) * width, side))
    return [sorted(walls[axis])[: limits.most_walls] for axis in (0, 1)]


def check_against_twins(scan, limits):
    angles = angle_function(scan, limits.angle_function)
    surfaces = segments(angles, limits.segments)
    same_rows(
        jump_edge_anchors(angles, surfaces, limits), plain_jump_edges(angles, surfaces, limits)
    )
    same_rows(
        angle_anchors(angles, surfaces, limits), plain_angle_anchors(angles, surfaces, limits)
    )

    edges = virtual_edges(angles, limits)
    mains = plain_main_angles(angles, limits)
    np.testing.assert_allclose([each.main_angle for each in edges], mains, atol=1e-9)
    for each in edges:
        across = plain_walls(angles, each.main_angle, limits)
        for axis, walls in enumerate((each.x_walls, each.y_walls)):
            np.testing.assert_allclose(walls[:, 2], [-length for length, _, _ in across[axis]])
            for row in walls:
                assert (
                    min(
                        abs(row[0] - u) + abs(row[1] - side) + abs(row[2] + length)
                        for length, u, side in across[axis]
                    )
                    < 1e-6
                )
    crossings = [
        (x * math.cos(e.main_angle) - y * math.sin(e.main_angle),
         x * math.sin(e.main_angle) + y * math.cos(e.main_angle),
         e.main_angle + math.atan2(seen_y, seen_x), VIRTUAL)
        for e in edges for x, seen_x, _ in e.x_walls for y, seen_y, _ in e.y_walls
    ]  # fmt: skip
    all_anchors = gather(np.empty((0, 4)), np.empty((0, 4)), edges)
    same_rows(as_rows(all_anchors), crossings)


def as_rows(anchors):
    return np.column_stack((anchors.positions, anchors.directions, anchors.kinds))


def same_rows(ours, theirs, tolerance=1e-4):
    """Hold rows x, y, direction, kind equal, in order."""
    theirs = np.reshape(np.array(theirs, dtype=float), (-1, 4))
    assert len(ours) == len(theirs)
    np.testing.assert_allclose(ours[:, :2], theirs[:, :2], atol=tolerance)
    assert np.all(turn_between(ours[:, 2], theirs[:, 2]) < tolerance)
    np.testing.assert_array_equal(ours[:, 3], theirs[:, 3])


@PRESETS
@pytest.mark.interpreted
def test_a_building_gives_what_the_twins_give(preset):
    check_against_twins(seen_in_building(11), preset)
    check_against_twins(seen_in_building(4, SensorModel()), preset)


@PRESETS
def test_real_scans_give_what_the_twins_give(preset, real_scans):
    for scan in real_scans:
        check_against_twins(scan, preset)


@given(st.one_of(scans(), wild_scans()), presets)
def test_surfaces_and_nonsense_give_what_the_twins_give(scan, preset):
    check_against_twins(scan, preset)


# What geometry says.


def of_kind(anchors, *kinds):
    """Rows x, y, direction of the anchors of some kinds."""
    return as_rows(anchors)[np.isin(anchors.kinds, kinds), :3]


def nearest_to(rows, x, y, within=0.02):
    """The one row at a position."""
    near = rows[np.hypot(rows[:, 0] - x, rows[:, 1] - y) < within]
    assert len(near) == 1, f"{len(near)} anchors at {x}, {y} among {rows.tolist()}"
    return near[0]


headings = st.floats(-math.pi, math.pi)
inside = st.builds(Pose2D, st.floats(-1.5, 2.5), st.floats(-1.0, 1.5), headings)


def seen(walls, sensor):
    """A noisy scan of what is drawn."""
    return simulate(World(np.array(walls)), Pose2D(), sensor, np.random.default_rng(0))


def in_world(anchors, pose):
    rows = as_rows(anchors)
    rows[:, :2] = pose.apply(rows[:, :2])
    rows[:, 2] += pose.theta
    return rows


@PRESETS
@given(inside)
def test_the_corners_of_a_room_are_where_its_walls_meet(preset, pose):
    anchors = anchor_points(drawn(box(-3.0, -2.0, 4.0, 2.5), at=pose), preset)
    rows = in_world(anchors, pose)
    concave = rows[anchors.kinds == CONCAVE]
    assert len(concave) == 4
    for x, y in ((-3.0, -2.0), (4.0, -2.0), (4.0, 2.5), (-3.0, 2.5)):
        _, _, direction, _ = nearest_to(concave, x, y, 1e-3)
        into_the_room = math.atan2(-np.sign(y), -np.sign(x))
        assert turn_between(direction, into_the_room) < 0.01
    assert not np.isin(anchors.kinds, (LEFT, RIGHT, CONVEX)).any()
    # The crossings of the walls are the same four places; nothing else is one.
    virtual = rows[anchors.kinds == VIRTUAL]
    assert len(virtual) == 4
    for x, y in ((-3.0, -2.0), (4.0, -2.0), (4.0, 2.5), (-3.0, 2.5)):
        nearest_to(virtual, x, y, 0.5 * preset.histogram_bin)


@PRESETS
def test_the_corner_of_a_square_pillar_is_convex_and_faces_the_sensor(preset):
    pillar = [*box(-6.0, -5.0, 6.0, 5.0), *box(1.2, 1.4, 2.0, 2.2)]
    anchors = anchor_points(drawn(pillar), preset)
    _, _, direction = nearest_to(of_kind(anchors, CONVEX), 1.2, 1.4, 1e-3)
    assert turn_between(direction, -0.75 * math.pi) < 1e-3
    # Its outer margins are jump edges, left and right as the sensor sees them.
    assert turn_between(nearest_to(of_kind(anchors, LEFT), 1.2, 2.2, 0.05)[2], math.pi) < 1e-3
    assert turn_between(nearest_to(of_kind(anchors, RIGHT), 2.0, 1.4, 0.05)[2], -1.5708) < 1e-3
    assert len(of_kind(anchors, LEFT, RIGHT, CONVEX)) == 3
    # The fitted lines are better than a reading: a coarse and noisy sensor sees the corner, too.
    coarse = SensorModel(field_of_view=2.0 * math.pi, resolution=math.radians(1.0), noise=0.005)
    rough = anchor_points(seen(pillar, coarse), preset)
    nearest_to(of_kind(rough, CONVEX), 1.2, 1.4, 0.02)


@PRESETS
def test_a_jump_edge_stands_at_the_near_surface_only(preset):
    screen, wall = (-0.6, 1.5, 0.9, 1.5), (-6.0, 4.0, 6.0, 4.0)
    for walls in ([screen], [screen, wall]):
        anchors = anchor_points(drawn(walls), preset)
        edges = of_kind(anchors, LEFT, RIGHT)
        assert nearest_to(of_kind(anchors, LEFT), -0.6, 1.5)[2] == pytest.approx(-0.5 * math.pi)
        assert nearest_to(of_kind(anchors, RIGHT), 0.9, 1.5)[2] == pytest.approx(-0.5 * math.pi)
        # Where the screen's shadow falls on the wall is no place of the wall.
        for x in (-0.6 * 4.0 / 1.5, 0.9 * 4.0 / 1.5):
            assert np.hypot(edges[:, 0] - x, edges[:, 1] - 4.0).min() > 1.0


@pytest.mark.parametrize(("preset", "radius"), [(PAPER, 1.2), (PAPER, 3.0), (DEFAULT, 3.0)])
def test_the_visibility_rim_of_a_round_pillar_is_no_anchor(preset, radius):
    fine = SensorModel(field_of_view=2.0 * math.pi, resolution=math.radians(0.1), noise=0.0)
    for x, y in ((4.0, 0.5), (3.2, -2.0), (-4.0, 1.0)):
        scan = drawn(box(-8.0, -7.0, 9.0, 7.0), pillars=[(x, y, radius)], sensor=fine)
        anchors = anchor_points(scan, preset)
        assert len(of_kind(anchors, CONCAVE)) >= 1
        assert not len(of_kind(anchors, LEFT, RIGHT, CONVEX))


@PRESETS
@pytest.mark.parametrize("behind", [[], [(-5.0, 6.0, 8.0, 6.0)]], ids=["nothing", "wall"])
def test_a_slanted_margin_that_the_ray_does_not_graze_is_an_anchor(preset, behind):
    screen = (0.3, 1.5, 1.8, 1.9)
    anchors = anchor_points(drawn([screen, *behind]), preset)
    nearest_to(of_kind(anchors, LEFT), 0.3, 1.5, 0.05)
    nearest_to(of_kind(anchors, RIGHT), 1.8, 1.9, 0.05)


@PRESETS
@given(headings)
def test_walls_that_do_not_meet_cross_in_virtual_edges(preset, turn):
    walls = [(2.0, -1.5, 2.0, 1.0), (-3.0, -1.5, -3.0, 1.0), (-2.0, 3.0, 1.0, 3.0)]
    anchors = anchor_points(turned(drawn(walls), turn), preset)
    rows = in_world(anchors, Pose2D(0.0, 0.0, -turn))
    virtual = rows[anchors.kinds == VIRTUAL]
    assert len(virtual) == 2
    for x in (2.0, -3.0):
        _, _, direction, _ = nearest_to(virtual, x, 3.0, 0.5 * preset.histogram_bin)
        if preset.facing:  # it looks at the space in front of both walls
            assert turn_between(direction, math.atan2(-1.0, -np.sign(x))) < 0.01
    assert not np.isin(anchors.kinds, (CONVEX, CONCAVE)).any()


def test_the_two_sides_of_a_wall_are_told_apart():
    # Two rooms with a door between them; the wall's faces are 0.1 m apart: one bin, two sides.
    walls = [*box(-4.0, -2.0, 4.0, 2.0), (0.0, -2.0, 0.0, 0.3), (0.1, -2.0, 0.1, 0.3)]
    here = drawn(walls, at=Pose2D(-1.0, 1.2))
    there = drawn(walls, at=Pose2D(1.1, 1.2))
    seen_from = [
        virtual_edges(angle_function(scan, DEFAULT.angle_function), DEFAULT)[0]
        for scan in (here, there)
    ]
    for edges, x, at in zip(seen_from, (0.0, 0.1), (-1.0, 1.1), strict=True):
        axes = [edges.x_walls, edges.y_walls]
        along_x = axes[int(round(edges.main_angle / (0.5 * math.pi))) % 2]
        found = [(u, side) for u, side, _ in along_x if abs(abs(u) - abs(x - at)) < 0.05]
        assert len(found) == 1
        u, side = found[0]
        assert u * side < 0.0  # it faces the sensor


@PRESETS
@pytest.mark.parametrize("degrees", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_plain_corridor_has_no_anchor(preset, degrees, noise):
    sensor = SensorModel(field_of_view=2.0 * math.pi, resolution=math.radians(degrees), noise=noise)
    for width in (1.5, 2.0, 3.0, 4.0):
        for aside in (0.0, 0.4):
            y1, y2 = -0.5 * width - aside, 0.5 * width - aside
            scan = seen([(-50.0, y1, 50.0, y1), (-50.0, y2, 50.0, y2)], sensor)
            found = as_rows(anchor_points(turned(scan, 0.2), preset))
            assert len(found) <= (0 if noise == 0.0 else 1), (width, aside, found.tolist())


@PRESETS
def test_where_a_wall_leaves_the_reach_of_the_sensor_is_no_anchor(preset):
    short = SensorModel(
        field_of_view=2.0 * math.pi, resolution=math.radians(1.0), range_max=3.5, noise=0.01
    )
    for distance in (1.0, 1.7, 2.5):
        endless = [(-20.0, distance, 20.0, distance)]
        assert not len(anchor_points(seen(endless, short), preset))
        ends = [(-20.0, distance, 1.0, distance)]
        (only,) = as_rows(anchor_points(seen(ends, short), preset)).tolist()
        assert math.dist(only[:2], (1.0, distance)) < 0.08
        assert only[3] == RIGHT


# Senses and beginnings of a sweep.


def folds(kind):
    return 4.0 if kind == VIRTUAL else 1.0


def same_anchors(ours, theirs, tolerance=1e-5, turn=0.0):
    """Hold two sets of anchors equal, in whatever order.

    Virtual edges that do not tell the sides of a wall apart have a direction modulo 90 degrees.
    """
    c, s = math.cos(turn), math.sin(turn)
    a, b = as_rows(ours), as_rows(theirs)
    a[:, :2] = a[:, :2] @ np.array([[c, s], [-s, c]])
    a[:, 2] += turn
    assert len(a) == len(b)
    left = list(range(len(b)))
    for row in a:
        off = [
            math.dist(row[:2], b[k, :2])
            + turn_between(folds(row[3]) * row[2], folds(row[3]) * b[k, 2])
            + 9.0 * (row[3] != b[k, 3])
            for k in left
        ]
        best = int(np.argmin(off))
        assert off[best] <= tolerance, (row, b.tolist())
        left.pop(best)


@PRESETS
@given(scans())
def test_the_sense_of_rotation_does_not_matter(preset, scan):
    same_anchors(anchor_points(scan, preset), anchor_points(reversed_sweep(scan), preset))


@PRESETS
@given(places, st.integers(0, 719))
def test_where_a_full_turn_begins_does_not_matter(preset, place, count):
    scan = seen_in_building(place, FULL_TURN)
    same_anchors(anchor_points(scan, preset), anchor_points(rolled(scan, count), preset))


@PRESETS
@given(inside, st.integers(0, 719))
def test_where_a_full_turn_of_a_closed_room_begins_does_not_matter(preset, pose, count):
    scan = drawn(box(-3.0, -2.0, 4.0, 2.5), at=pose)
    same_anchors(anchor_points(scan, preset), anchor_points(rolled(scan, count), preset), 0.01)


def test_where_a_real_full_turn_begins_does_not_matter(real_records):
    for record in real_records("olin")[::30]:
        for preset in (PAPER, DEFAULT):
            scan = record.scan
            for count in (1, 200, 719):
                # It lacks one reading: rolled, the turn begins at another angle.
                step = scan.angle_increment
                whole = LaserScan(
                    np.append(scan.ranges, math.nan), scan.angle_min, step, scan.range_min,
                    scan.range_max,
                )  # fmt: skip
                same_anchors(
                    anchor_points(whole, preset), anchor_points(rolled(whole, count), preset), 0.02
                )


@PRESETS
@given(scans(), st.integers(0, 359))
def test_anchors_turn_with_the_sensor(preset, scan, degrees):
    # By whole bins of the angle histogram, so that they hold the same readings.
    turn = math.radians(degrees)
    same_anchors(anchor_points(scan, preset), anchor_points(turned(scan, turn), preset), 1e-5, turn)


@PRESETS
@given(inside, st.floats(-3.0, 3.0))
def test_anchors_turn_with_the_sensor_by_any_angle(preset, pose, turn):
    scan = drawn([*box(-3.0, -2.0, 4.0, 2.5), *box(-9.0, -8.0, 9.0, 9.0)], at=pose)
    same_anchors(anchor_points(scan, preset), anchor_points(turned(scan, turn), preset), 0.02, turn)


def mirror_image(anchors):
    """The anchors of a scan, mirrored at the x axis."""
    swapped = np.array([RIGHT, LEFT, CONVEX, CONCAVE, VIRTUAL])
    return AnchorPoints(
        anchors.positions * (1.0, -1.0), swapped[anchors.kinds], -anchors.directions
    )


def chosen(anchors, *kinds):
    some = np.isin(anchors.kinds, kinds)
    return AnchorPoints(anchors.positions[some], anchors.kinds[some], anchors.directions[some])


@PRESETS
@given(scans())
def test_the_edges_of_a_mirror_image_are_mirrored(preset, scan):
    ours = anchor_points(scan, preset)
    theirs = mirror_image(anchor_points(scan.upside_down(), preset))
    same_anchors(chosen(ours, LEFT, RIGHT), chosen(theirs, LEFT, RIGHT))


@PRESETS
@given(inside)
def test_the_corners_of_a_mirror_image_are_mirrored(preset, pose):
    scan = drawn([*box(-5.0, -4.0, 6.0, 5.0), *box(3.2, 2.0, 4.0, 2.6)], at=pose)
    ours = anchor_points(scan, preset)
    theirs = mirror_image(anchor_points(scan.upside_down(), preset))
    # Seen nearly along one of its sides, the pillar has no corner that can be told.
    assume(len(chosen(ours, CONVEX)) >= 1)
    same_anchors(chosen(ours, CONVEX, CONCAVE), chosen(theirs, CONVEX, CONCAVE))


# Bad input is normal input.


@given(sweeps(), presets)
@settings(max_examples=300)
def test_anything_a_message_may_hold_has_anchors_or_none(scan, preset):
    anchors = anchor_points(scan, preset)
    assert anchors.positions.shape == (len(anchors), 2)
    assert anchors.positions.flags.c_contiguous
    assert len(anchors.directions) == len(anchors.kinds) == len(anchors)
    assert np.all(np.isfinite(anchors.positions))
    assert np.all(np.isfinite(anchors.directions))
    assert set(anchors.kinds.tolist()) <= set(AnchorKind)


@PRESETS
@pytest.mark.parametrize("ranges", [[], [2.0], [math.nan] * 9, [math.inf] * 9, [0.0] * 9])
@pytest.mark.interpreted
def test_a_scan_with_nothing_to_tell_has_no_anchor(preset, ranges):
    anchors = anchor_points(LaserScan.from_field_of_view(ranges, math.pi), preset)
    assert len(anchors) == 0
    assert anchors.positions.shape == (0, 2)
    assert math.isnan(anchors.main_angle)


def test_a_wall_beyond_all_buildings_fills_no_memory():
    # Readings of one surface, a kilometre and more away, by a sensor of a millionth of a degree.
    for distance in (1e3, 1e6, 1e7):
        scan = LaserScan(np.full(300, distance), 0.0, 0.01 / distance, 0.0, math.inf)
        anchors = anchor_points(scan, DEFAULT)
        assert len(anchors) == 0
