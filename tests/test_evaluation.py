"""Synthetic scans and e_m against exact ray casting, and their properties."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from anchorscan import LaserScan, Pose2D, SensorModel, random_building, simulate
from anchorscan.angle_function import CONNECTED, AngleFunctionSettings, angle_function
from anchorscan.evaluation import (
    AcceptanceSettings,
    EvaluationSettings,
    clearance,
    evaluate,
    evaluate_all,
    outline,
    probability,
    stack_outlines,
    synthetic_scan,
)
from anchorscan.evaluation import _direction as direction
from anchorscan.simulator import random_poses

coordinates = st.floats(-1e6, 1e6).filter(lambda value: value == 0.0 or abs(value) > 1e-9)

SURFACES = AngleFunctionSettings()
SENSORS = (
    SensorModel(),
    SensorModel(resolution=math.radians(0.5), clockwise=True),
    SensorModel(field_of_view=math.radians(270.0), resolution=math.radians(0.75)),
    SensorModel(field_of_view=2.0 * math.pi, resolution=math.radians(1.0), range_max=6.0),
    SensorModel(
        field_of_view=2.0 * math.pi, resolution=2.0 * math.pi / 500, dropout=0.1, clockwise=True
    ),
)


def outline_of(scan):
    return outline(scan, angle_function(scan, SURFACES))


def scans(seed, count=2, sensors=SENSORS):
    rng = np.random.default_rng(seed)
    world = random_building(int(rng.integers(20)))
    places = random_poses(world, count, rng)
    chosen = [sensors[rng.integers(len(sensors))] for _ in range(count)]
    return places, [simulate(world, p, s, rng) for p, s in zip(places, chosen, strict=True)]


# --- The twin: every beam against every line, exactly ------------------------------------


def plain_render(overview, T_overview_front, front):
    """(N,) range per reading of the front scan's sensor; NaN where there is nothing."""
    angles = angle_function(overview, SURFACES)
    points = T_overview_front.inverse().apply(angles.points)
    joined = angles.gaps == CONNECTED
    nearest = np.full(len(front), math.inf)
    beams = front.angles
    u = np.column_stack((np.cos(beams), np.sin(beams)))
    for i in range(len(points)):
        a, e = points[i], points[(i + 1) % len(points)] - points[i]
        if joined[i]:
            cross = u[:, 0] * e[1] - u[:, 1] * e[0]
            with np.errstate(divide="ignore", invalid="ignore"):
                share = (a[0] * u[:, 1] - a[1] * u[:, 0]) / cross
                distance = (a[0] * e[1] - a[1] * e[0]) / cross
                hit = (share >= -1e-6) & (share <= 1.0 + 1e-6) & (distance > 0.0)
            nearest = np.where(hit, np.minimum(nearest, distance), nearest)
        if not (joined[i] and joined[i - 1]):
            # The margin of a surface reaches half a beam beyond its last reading.
            off = np.remainder(beams - math.atan2(a[1], a[0]) + math.pi, 2 * math.pi) - math.pi
            k = int(np.argmin(np.abs(off)))
            if abs(off[k]) < 0.5 * abs(front.angle_increment):
                nearest[k] = min(nearest[k], math.hypot(*a))
    return np.where(np.isinf(nearest), np.nan, nearest)


def plain_e_m(front, synthetic, s):
    seen, ranges = front.is_return, front.ranges.astype(float)
    tolerance = np.minimum(s.tolerance + s.relative_tolerance * ranges, s.largest_tolerance)
    with np.errstate(invalid="ignore"):
        agree = np.abs(ranges - synthetic) <= tolerance
    return float(np.sum(agree & seen) / max(np.sum(seen), 1))


def check_against_twin(overview, pose, front):
    expected = plain_render(overview, pose, front)
    got = synthetic_scan(overview, pose, front, SURFACES).ranges.astype(float)
    # An end of a line that lies on a beam to rounding may fall to either side.
    assert np.sum(np.isnan(expected) != np.isnan(got)) <= 2
    both = ~np.isnan(expected) & ~np.isnan(got)
    off = np.abs(got[both] - expected[both]) > 0.015 * expected[both] + 1e-4
    assert np.sum(off) <= 2


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000))
def test_synthetic_scans_are_those_of_exact_ray_casting(seed):
    (a, b), (overview, front) = scans(seed)
    near = Pose2D(*(0.1 * np.subtract((b.x, b.y), (a.x, a.y))), b.theta)
    check_against_twin(overview, near, front)
    # Not quite in place: there the beams of two sensors meet half-way to rounding.
    check_against_twin(overview, Pose2D(0.0, 0.0, 0.001), front)


def test_synthetic_scans_are_those_of_exact_ray_casting_on_real_scans(real_records):
    records = real_records("freiburg-101.log.gz")[40::100]
    for record in records:
        check_against_twin(record.scan, Pose2D(0.4, -0.3, 0.5), records[0].scan)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000))
def test_e_m_is_the_share_of_the_front_scan_that_agrees(seed):
    (a, b), (scan, reference) = scans(seed)
    pose = Pose2D(*(0.2 * np.subtract((b.x, b.y), (a.x, a.y))), b.theta - a.theta)
    tolerances = EvaluationSettings(tolerance=0.1, largest_tolerance=0.4)
    result = evaluate(scan, reference, pose, tolerances)
    front = scan if result.overview == "reference" else reference

    assert result.e_m == pytest.approx(
        plain_e_m(front, result.synthetic.ranges.astype(float), tolerances),
        abs=1.5 / max(len(front), 1),
    )


# --- Properties ------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000))
def test_a_scan_agrees_with_itself_fully(seed):
    _, (scan,) = scans(seed, 1)
    assert evaluate(scan, scan, Pose2D()).e_m == 1.0


def test_a_real_scan_agrees_with_itself_fully(real_records):
    for name in ("freiburg-101.log.gz", "intel.log.gz"):
        for record in real_records(name)[::60]:
            assert evaluate(record.scan, record.scan, Pose2D()).e_m == 1.0


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.floats(-math.pi, math.pi))
def test_a_full_turn_agrees_with_its_turned_copy(seed, turn):
    full = SensorModel(field_of_view=2.0 * math.pi, resolution=math.radians(1.0), noise=0.0)
    _, (scan,) = scans(seed, 1, (full,))
    turned = LaserScan(
        scan.ranges, scan.angle_min + turn, scan.angle_increment, scan.range_min, scan.range_max
    )
    assert evaluate(turned, scan, Pose2D(0.0, 0.0, -turn)).e_m > 0.99


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000))
def test_the_sense_of_rotation_does_not_matter(seed):
    (a, b), (scan, reference) = scans(seed, 2, SENSORS[:1])
    pose = Pose2D(*(0.2 * np.subtract((b.x, b.y), (a.x, a.y))), b.theta - a.theta)

    def reversed_(each):
        return LaserScan(
            each.ranges[::-1],
            each.angle_min + each.angle_increment * (len(each) - 1),
            -each.angle_increment,
            each.range_min,
            each.range_max,
        )

    straight = evaluate(scan, reference, pose)
    for ours, theirs in ((reversed_(scan), reference), (scan, reversed_(reference))):
        assert evaluate(ours, theirs, pose).e_m == pytest.approx(straight.e_m, abs=0.012)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000))
def test_many_alignments_at_once_are_those_of_each_alone(seed):
    places, each = scans(seed, 4)
    ours, theirs = outline_of(each[0]), [outline_of(scan) for scan in each[1:]]
    poses = np.array([(p.inverse() @ places[0]).to_array() for p in places[1:]])
    together = evaluate_all(ours, stack_outlines(theirs), np.arange(3), poses, EvaluationSettings())
    for k in range(3):
        alone = evaluate_all(
            ours,
            stack_outlines([theirs[k]]),
            np.zeros(1, np.int64),
            poses[k : k + 1],
            EvaluationSettings(),
        )
        assert together[k] == alone[0]


@given(coordinates, coordinates)
def test_directions_are_those_of_the_arc_tangent(x, y):
    assume(x or y)  # nowhere is in no direction
    off = direction(x, y) - math.atan2(y, x)
    assert abs(math.remainder(off, 2.0 * math.pi)) < 2e-15


def test_true_alignments_in_one_room_agree_and_wrong_ones_do_not():
    room = SensorModel(noise=0.01)
    world = random_building(3)
    rng = np.random.default_rng(8)
    right, wrong = [], []
    for place in random_poses(world, 30, rng):
        there = place @ Pose2D(0.3, 0.1, 0.2)
        reference, scan = simulate(world, place, room, rng), simulate(world, there, room, rng)
        right.append(evaluate(scan, reference, Pose2D(0.3, 0.1, 0.2)).e_m)
        wrong.append(evaluate(scan, reference, Pose2D(0.3, 0.1, 1.2)).e_m)
    assert np.median(right) > 0.85
    assert np.median(wrong) < 0.5


def box_scan(x, y):
    """Scan along +x inside the room |x| < 4, |y| < 3."""
    angles = np.linspace(-math.pi / 2, math.pi / 2, 181)
    c, s = np.cos(angles), np.sin(angles)
    with np.errstate(divide="ignore"):
        along_x = np.where(c > 0, (4 - x) / c, np.where(c < 0, (-4 - x) / c, np.inf))
        along_y = np.where(s > 0, (3 - y) / s, np.where(s < 0, (-3 - y) / s, np.inf))
    return LaserScan.from_field_of_view(np.minimum(along_x, along_y), math.pi)


def test_the_one_behind_has_the_overview():
    # Both look along +x; only from behind can the other's position be seen.
    front, behind = box_scan(1.0, 0.2), box_scan(-1.0, -0.2)
    T_behind_front = Pose2D(2.0, 0.4)
    assert evaluate(front, behind, T_behind_front).overview == "reference"
    assert evaluate(behind, front, T_behind_front.inverse()).overview == "scan"
    assert evaluate(front, behind, T_behind_front).e_m > 0.98
    assert evaluate(behind, front, T_behind_front.inverse()).e_m > 0.98


def test_what_is_nearer_hides_what_is_behind():
    scan = box_scan(0.0, 0.0)
    near = np.where(np.abs(np.degrees(scan.angles)) < 10.0, 1.5, scan.ranges)
    blocked = LaserScan.from_field_of_view(near, math.pi)
    synthetic = synthetic_scan(blocked, Pose2D(-1.0, 0.0), scan)
    ahead = np.abs(np.degrees(scan.angles)) < 4.0
    np.testing.assert_allclose(synthetic.ranges[ahead], 2.5, atol=0.05)


def test_clearance_is_the_free_way_behind_a_position():
    room = outline_of(box_scan(0.0, 0.0))
    assert clearance(room, 3.0, 0.0) == pytest.approx(1.0, abs=1e-3)
    assert clearance(room, 5.0, 0.0) == pytest.approx(-1.0, abs=1e-3)
    assert clearance(room, -1.0, 0.0) == -math.inf
    assert clearance(room, 0.0, 0.0) == math.inf
    nothing = LaserScan.from_field_of_view(np.full(181, np.inf), math.pi)
    assert clearance(outline_of(nothing), 1.0, 0.0) == -math.inf


@pytest.mark.parametrize("ranges", [[], [np.nan] * 10, [np.inf] * 181, [0.0] * 5, [2.0]])
def test_unusable_scans_have_no_agreement(ranges):
    empty = LaserScan.from_field_of_view(ranges, math.pi)
    room = box_scan(0.0, 0.0)
    for scan, reference in ((empty, room), (room, empty), (empty, empty)):
        result = evaluate(scan, reference, Pose2D(0.5, 0.2, 0.1))
        assert 0.0 <= result.e_m <= 0.1


def test_probability_grows_with_e_m():
    settings = AcceptanceSettings()
    values = np.array([probability(e_m, settings) for e_m in np.linspace(0.0, 1.0, 21)])
    assert np.all(np.diff(values) > 0.0)
    assert values[0] > 0.0
    assert values[-1] < 1.0
