"""The angle function against its plain twin, exact surfaces, and the senses of a sweep."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scans import (
    EXACT,
    FULL_TURN,
    box,
    drawn,
    places,
    reversed_sweep,
    rolled,
    scans,
    seeds,
    seen_in_building,
    sweeps,
    turned,
    wild_scans,
)

from anchorscan import LaserScan
from anchorscan.angle_function import (
    CONNECTED,
    FREE,
    TO_FAR,
    TO_NEAR,
    UNKNOWN,
    AngleFunctionSettings,
    angle_function,
    angle_histogram,
    line_through,
    main_angle,
    wrapped,
)

CHORD = AngleFunctionSettings()
FITTED = AngleFunctionSettings(baseline=0.3, fitted=True)
PRESETS = pytest.mark.parametrize("preset", [CHORD, FITTED], ids=["chord", "fitted"])
# So many readings without a return, and not free, may lie between two of one surface.
MOST_MISSING = 3


def turn_between(a, b):
    return np.abs((np.asarray(a) - b + math.pi) % (2.0 * math.pi) - math.pi)


# The twin: one reading after the other, with nothing carried along.


def plain_sweep(scan):
    """Rows of step, direction and range of the returns, the free steps, and the sweep's length."""
    count = len(scan)
    step = abs(scan.angle_increment)
    while count > 2 and (count - 0.5) * step > 2.0 * math.pi:
        count -= 1
    rows, free = [], set()
    order = range(count) if scan.angle_increment > 0.0 else range(count - 1, -1, -1)
    for k, i in enumerate(order):
        if scan.is_return[i]:
            rows.append((k, scan.angles[i], float(scan.ranges[i])))
        elif scan.is_free[i]:
            free.add(k)
    return rows, free, count


def plain_gap(a, b, steps, free_between, step, limits):
    missing = steps - 1 - free_between
    if free_between:
        return FREE if missing <= MOST_MISSING else UNKNOWN
    if missing > MOST_MISSING:
        return UNKNOWN
    near, far = min(a, b), max(a, b)
    apart = math.dist((near, 0.0), (far * math.cos(steps * step), far * math.sin(steps * step)))
    flattest = limits.grazing_angle - steps * step
    on_surface = near * math.sin(steps * step) / math.sin(flattest) if flattest > 0.0 else math.inf
    if apart <= min(on_surface + limits.noise, max(limits.largest_gap, 2.0 * limits.noise)):
        return CONNECTED
    if far - near < limits.smallest_jump:
        return UNKNOWN
    return TO_FAR if b > a else TO_NEAR


def plain_gaps(scan, limits):
    rows, free, count = plain_sweep(scan)
    step = abs(scan.angle_increment)
    gaps = []
    for n, (k, _, r) in enumerate(rows):
        if n + 1 < len(rows):
            k_next, _, r_next = rows[n + 1]
            between = free & set(range(k + 1, k_next))
        elif scan.is_full_turn and len(rows) > 1:
            k_next, _, r_next = rows[0]
            between = {f for f in free if f > k or f < k_next}
            k_next += max(count, round(2.0 * math.pi / step))
        else:
            gaps.append(UNKNOWN)
            continue
        gaps.append(plain_gap(r, r_next, k_next - k, len(between), step, limits))
    return gaps


def plain_step(points, ranges, run, i, step, noise):
    """Way from return ``i - 1`` to ``i`` of a run, by the shortest chord longer than the noise."""
    before, after = i - 1, i
    between = min(ranges[before], ranges[after]) * step
    while (after - before) * between < noise and before > run[0] and after < run[-1]:
        before, after = before - 1, after + 1
    return math.dist(points[before], points[after]) / (after - before)


def plain_line(points):
    """Centre, unit vector and rms error of the line with the least squared distances."""
    centre = points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(points - centre)
    error = math.sqrt(sizes[1] ** 2 / len(points)) if len(points) > 1 else 0.0
    return centre, axes[0], error


def plain_surface(angles, i, limits):
    """Direction of the surface at return ``i``, or NaN."""
    run = np.flatnonzero(angles.runs == angles.runs[i])
    way = angles.way - angles.way[i]
    half = 0.5 * limits.baseline
    behind = [j for j in run if j <= i and way[j] < -half]
    ahead = [j for j in run if j >= i and way[j] >= half]
    begin = max(behind, default=run[0])
    end = min(ahead, default=run[-1])
    x, y = angles.points[end] - angles.points[begin]
    if math.hypot(x, y) < 0.25 * limits.baseline:
        return math.nan
    if limits.fitted and end - begin >= 2:
        _, (u, v), _ = plain_line(angles.points[begin : end + 1])
        x, y = (u, v) if u * x + v * y >= 0.0 else (-u, -v)
    return math.atan2(y, x)


def check_against_twin(scan, limits):
    angles = angle_function(scan, limits)
    rows, _, _ = plain_sweep(scan)
    gaps = plain_gaps(scan, limits)
    begin = 0
    if scan.is_full_turn and rows:
        # A closed sweep begins behind a gap; one without a gap on a straight stretch.
        breaks = [n for n, gap in enumerate(gaps) if gap != CONNECTED]
        if breaks:
            begin = (breaks[0] + 1) % len(rows)
        else:
            begin = int(np.argmin([turn_between(angles.beams[0], beam) for _, beam, _ in rows]))
    rows, gaps = rows[begin:] + rows[:begin], gaps[begin:] + gaps[:begin]

    assert angles.gaps.tolist() == gaps
    assert angles.ranges.tolist() == [r for _, _, r in rows]
    assert np.all(turn_between(angles.beams, [beam for _, beam, _ in rows]) < 1e-9)
    np.testing.assert_allclose(
        angles.points,
        [(r * math.cos(b), r * math.sin(b)) for _, b, r in rows] or np.empty((0, 2)),
        rtol=1e-9,
        atol=1e-9,
    )
    assert np.all(np.diff(angles.beams) > 0.0)

    runs = []
    for i in range(len(rows)):
        runs.append(runs[-1] if i > 0 and gaps[i - 1] == CONNECTED else i)
    steps = [
        plain_step(angles.points, angles.ranges, [n for n, r in enumerate(runs) if r == runs[i]],
                   i, abs(scan.angle_increment), limits.noise) if runs[i] == runs[i - 1] else 0.0
        for i in range(1, len(rows))
    ]  # fmt: skip
    way = np.cumsum([0.0, *steps])[: len(rows)]
    extents = 0.5 * np.array([*steps, 0.0][: len(rows)]) + 0.5 * np.array(
        [0.0, *steps][: len(rows)]
    )
    assert angles.runs.tolist() == runs
    np.testing.assert_allclose(angles.way, way, rtol=1e-9)
    np.testing.assert_allclose(angles.extents, extents, rtol=1e-9)

    expected = np.array([plain_surface(angles, i, limits) for i in range(len(rows))])
    np.testing.assert_array_equal(np.isnan(angles.surface), np.isnan(expected))
    known = ~np.isnan(expected)
    assert np.all(turn_between(angles.surface[known], expected[known]) < 1e-5)


@PRESETS
@pytest.mark.interpreted
def test_a_building_gives_what_the_twin_gives(preset):
    for sensor_seed in (3, 47):
        check_against_twin(seen_in_building(sensor_seed), preset)
    check_against_twin(seen_in_building(8, FULL_TURN), preset)


@PRESETS
def test_real_scans_give_what_the_twin_gives(preset, real_scans):
    for scan in real_scans:
        check_against_twin(scan, preset)


@given(wild_scans(), st.sampled_from([CHORD, FITTED]))
def test_surfaces_and_nonsense_give_what_the_twin_gives(scan, preset):
    check_against_twin(scan, preset)


# The parts on which the anchor points stand, too.


@given(seeds, st.integers(2, 30), st.floats(-40.0, 40.0))
def test_the_line_through_a_stretch_is_the_one_of_least_squares(seed, count, offset):
    rng = np.random.default_rng(seed)
    points = rng.normal((offset, 3.0), (0.5, 0.02), (count, 2))
    moments = np.zeros((count + 1, 5))
    products = [points[:, 0] ** 2, points[:, 0] * points[:, 1], points[:, 1] ** 2]
    moments[1:] = np.cumsum(np.column_stack((points, *products)), axis=0)
    x, y, u, v, error = line_through(moments, 0, count - 1, -1.0, 0.0)
    centre, axis, expected = plain_line(points)
    np.testing.assert_allclose((x, y), centre, atol=1e-9)
    assert math.hypot(u, v) == pytest.approx(1.0)
    assert u <= 0.0  # in the sense that was asked for
    assert error == pytest.approx(expected, abs=1e-5)
    if count > 2:
        assert abs(u * axis[0] + v * axis[1]) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.interpreted
def test_a_line_through_one_place_has_some_direction():
    moments = np.zeros((4, 5))
    moments[1:] = np.cumsum(np.tile([1.0, 2.0, 1.0, 2.0, 4.0], (3, 1)), axis=0)
    x, y, u, v, error = line_through(moments, 0, 2, 0.0, 0.0)
    assert (x, y, error) == (1.0, 2.0, 0.0)
    assert math.hypot(u, v) == 1.0


@given(st.floats(-1e4, 1e4))
def test_wrapped_angles_are_the_same_direction(angle):
    assert -math.pi <= wrapped(angle) <= math.pi
    assert turn_between(wrapped(angle), angle) < 1e-9


# The angle histogram.


def plain_histogram(angles, bins):
    raw = np.zeros(bins)
    for direction, weight in zip(angles.surface, angles.extents, strict=True):
        if not math.isnan(direction):
            raw[min(int((direction / math.pi) % 1.0 * bins), bins - 1)] += weight
    return 0.5 * raw + 0.25 * np.roll(raw, 1) + 0.25 * np.roll(raw, -1)


@given(scans(), st.sampled_from([8, 90, 180]))
def test_the_histogram_is_the_twins(scan, bins):
    limits = AngleFunctionSettings(bins=bins)
    angles = angle_function(scan, limits)
    histogram = angle_histogram(angles, limits)
    np.testing.assert_allclose(histogram, plain_histogram(angles, bins), atol=1e-9)
    known = ~np.isnan(angles.surface)
    assert histogram.sum() == pytest.approx(angles.extents[known].sum())


@given(st.floats(-math.pi, math.pi), st.floats(2.0, 4.0))
def test_the_main_angle_is_that_of_the_longest_walls(turn, width):
    room = drawn(box(-7.0, -0.5 * width, 7.0, 0.5 * width))
    histogram = angle_histogram(angle_function(turned(room, turn), CHORD), CHORD)
    off = (main_angle(histogram) - turn + 0.5 * math.pi) % math.pi - 0.5 * math.pi
    assert abs(off) < math.radians(1.0)
    assert 0.0 <= main_angle(histogram) < math.pi


def test_without_a_surface_there_is_no_main_angle():
    assert math.isnan(main_angle(np.zeros(180)))
    flat = main_angle(np.ones(8))
    assert 0.0 <= flat < math.pi


# What geometry says.


@PRESETS
def test_walls_are_walked_with_the_free_space_on_the_left(preset):
    angles = angle_function(drawn(box(-3.0, -2.0, 4.0, 2.5)), preset)
    at = angles.points
    ways = {math.pi: at[:, 1] > 2.49, 0.0: at[:, 1] < -1.99}
    ways |= {-0.5 * math.pi: at[:, 0] < -2.99, 0.5 * math.pi: at[:, 0] > 3.99}
    for direction, on_wall in ways.items():
        inside = on_wall & (np.abs(at).min(axis=1) < 1.5)  # away from the corners
        assert inside.sum() > 40
        assert np.all(turn_between(angles.surface[inside], direction) < 1e-5)
    assert np.all(angles.gaps == CONNECTED)
    assert angles.extents.sum() == pytest.approx(2 * (7.0 + 4.5), abs=0.2)


def test_round_surfaces_are_a_ramp():
    scan = drawn(pillars=[(0.0, 0.0, 3.0)])
    angles = angle_function(scan, CHORD)
    inside = slice(20, -20)
    assert np.all(turn_between(angles.surface, angles.beams + 0.5 * math.pi)[inside] < 0.01)


@PRESETS
def test_pairs_are_a_baseline_apart_near_and_far(preset):
    for distance in (0.5, 2.0, 6.0):
        # A wall with a bend right ahead, which is seen half a baseline to either side of it.
        walls = [(6.0, distance, 0.0, distance), (0.0, distance, -6.0, distance + 1.0)]
        angles = angle_function(drawn(walls), preset)
        bent = (turn_between(angles.surface, math.pi) > 1e-4) & (angles.points[:, 0] > 0.0)
        step = distance * EXACT.resolution
        reach = angles.points[bent, 0].max()
        assert 0.5 * preset.baseline - 2.0 * step <= reach <= 0.5 * preset.baseline + 2.0 * step


@PRESETS
def test_noise_makes_no_surface_longer(preset):
    for distance in (0.5, 1.0, 3.0):
        room = drawn(box(-distance, -distance, distance, distance))
        rough = np.random.default_rng(0).normal(0.0, 0.01, len(room)).astype(np.float32)
        noisy = LaserScan(room.ranges + rough, room.angle_min, room.angle_increment, 0.0, 30.0)
        length = angle_function(noisy, preset).extents.sum()
        assert length == pytest.approx(8.0 * distance, rel=0.07)


def test_what_lies_between_returns():
    ranges = np.full(40, 2.0)
    ranges[5:10] = 4.0  # a jump to far, and back to near
    ranges[15:20] = math.inf  # free
    ranges[24] = math.nan  # a lost reading, bridged
    ranges[28:34] = math.nan  # too many
    ranges[36] = math.inf  # a free reading beside a lost one
    ranges[37] = math.nan
    angles = angle_function(LaserScan(ranges, 0.0, math.radians(1.0), 0.0, 10.0), CHORD)
    beams = np.round(np.degrees(angles.beams)).astype(int).tolist()
    found = {k: gap for k, gap in zip(beams, angles.gaps.tolist(), strict=True) if gap != CONNECTED}
    assert found == {4: TO_FAR, 9: TO_NEAR, 14: FREE, 27: UNKNOWN, 35: FREE, 39: UNKNOWN}


def test_an_edge_too_small_for_a_jump_is_neither():
    ranges = np.full(40, 2.0)
    ranges[20:] = 2.29  # more than a surface makes here, less than a jump
    angles = angle_function(LaserScan(ranges, 0.0, math.radians(1.0)), CHORD)
    assert angles.gaps[19] == UNKNOWN
    assert angles.runs[20] == 20


# Senses and beginnings of a sweep.


def same_surfaces(ours, theirs, turn=0.0):
    """Hold two angle functions equal, reading by reading, in whatever order."""
    assert len(ours.ranges) == len(theirs.ranges)
    if not len(ours.ranges):
        return
    a = np.argsort(np.round((ours.beams + turn) % (2.0 * math.pi), 6) % round(2.0 * math.pi, 6))
    b = np.argsort(np.round(theirs.beams % (2.0 * math.pi), 6) % round(2.0 * math.pi, 6))
    assert np.all(turn_between(ours.beams[a] + turn, theirs.beams[b]) < 1e-6)
    np.testing.assert_array_equal(ours.ranges[a], theirs.ranges[b])
    np.testing.assert_array_equal(ours.gaps[a], theirs.gaps[b])
    np.testing.assert_array_equal(np.isnan(ours.surface[a]), np.isnan(theirs.surface[b]))
    known = ~np.isnan(ours.surface[a])
    off = turn_between(ours.surface[a][known] + turn, theirs.surface[b][known])
    assert np.all(off < 1e-5)
    np.testing.assert_allclose(ours.extents[a], theirs.extents[b], atol=1e-6)


@PRESETS
@given(scans())
def test_the_sense_of_rotation_does_not_matter(preset, scan):
    same_surfaces(angle_function(scan, preset), angle_function(reversed_sweep(scan), preset))


@PRESETS
@given(places, st.integers(0, 719))
def test_where_a_full_turn_begins_does_not_matter(preset, seed, count):
    scan = seen_in_building(seed, FULL_TURN)
    same_surfaces(angle_function(scan, preset), angle_function(rolled(scan, count), preset))


@given(scans(), st.floats(-10.0, 10.0))
def test_a_turned_sensor_sees_turned_surfaces(scan, turn):
    same_surfaces(angle_function(scan, CHORD), angle_function(turned(scan, turn), CHORD), turn)


@pytest.mark.parametrize("leave_out", [0, 1])
def test_the_seam_of_a_full_turn_lies_within_a_surface(leave_out):
    whole = drawn(box(-3.0, -2.0, 4.0, 2.5))
    for count in range(0, 720, 45):
        scan = rolled(whole, count)
        scan = LaserScan(
            scan.ranges[: len(scan) - leave_out], scan.angle_min, scan.angle_increment, 0.0, 30.0
        )
        angles = angle_function(scan, CHORD)
        assert np.all(angles.gaps == CONNECTED)
        assert angles.extents.sum() == pytest.approx(23.0, abs=0.15)


def test_the_seam_of_a_real_turntable_is_mostly_no_gap(real_records):
    gaps = []
    for record in real_records("olin")[::10]:
        scan = record.scan
        if not (scan.is_return[:2].all() and scan.is_return[-2:].all()):
            continue
        if abs(scan.ranges[0] - scan.ranges[-1]) > 0.05:
            continue  # a true edge may lie there
        angles = angle_function(scan, CHORD)
        seam = np.argmin(turn_between(angles.beams, scan.angles[-1]))
        gaps.append(angles.gaps[seam] == CONNECTED)
    assert len(gaps) >= 10
    assert np.mean(gaps) > 0.9


def test_a_second_look_at_the_same_direction_is_dropped():
    once = drawn(box(-3.0, -2.0, 4.0, 2.5))
    twice = LaserScan(
        np.concatenate((once.ranges, once.ranges[:3])), once.angle_min, once.angle_increment,
        once.range_min, once.range_max,
    )  # fmt: skip
    same_surfaces(angle_function(once, CHORD), angle_function(twice, CHORD))


# Bad input is normal input.


@PRESETS
@given(sweeps())
@settings(max_examples=200)
def test_anything_a_message_may_hold_has_an_angle_function(preset, scan):
    angles = angle_function(scan, preset)
    assert len(angles.ranges) == len(angles.surface) == len(angles.way) == len(angles.runs)
    assert len(angles.moments) == len(angles.ranges) + 1
    assert set(angles.gaps.tolist()) <= {CONNECTED, TO_FAR, TO_NEAR, FREE, UNKNOWN}
    assert np.all(
        (angles.surface >= -math.pi) & (angles.surface <= math.pi) | np.isnan(angles.surface)
    )
    histogram = angle_histogram(angles, preset)
    assert np.all(histogram >= 0.0)


@pytest.mark.parametrize(
    "ranges", [[], [2.0], [math.nan] * 181, [math.inf] * 181, [-math.inf] * 9, [0.0] * 181]
)
@pytest.mark.interpreted
def test_scans_with_nothing_to_tell_have_no_surface(ranges):
    angles = angle_function(LaserScan.from_field_of_view(ranges, math.pi), FITTED)
    assert np.all(np.isnan(angles.surface))
    assert np.all(angle_histogram(angles, FITTED) == 0.0)


@pytest.mark.parametrize("increment", [4.5, 5.5, 6.2, -5.5])
def test_of_two_readings_the_second_is_no_second_look(increment):
    scan = LaserScan([0.0, 5.0], 0.0, increment)
    expected = (5.0 * math.cos(increment), 5.0 * math.sin(increment))
    np.testing.assert_allclose(angle_function(scan, CHORD).points, [expected], atol=1e-6)
