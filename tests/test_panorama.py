"""What scans saw, compared: against plain comparing, and what must not change it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from anchorscan import panorama
from anchorscan.anchors import AnchorPoints, stack_anchors
from anchorscan.database import Votes
from anchorscan.description import describe
from anchorscan.panorama import DIRECTIONS, reordered, view, worth
from anchorscan.settings import Settings


def random_scan(seed, count=None):
    """Give anchor points and end points of a scan of a random room."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 9)) if count is None else count
    anchors = AnchorPoints(
        rng.uniform(-6.0, 6.0, (count, 2)),
        rng.integers(0, 5, count),
        rng.uniform(-math.pi, math.pi, count),
        rng.uniform(0.0, 0.5 * math.pi),
    )
    bearings = np.arange(360) * math.pi / 180.0
    wide, high = rng.uniform(2.0, 6.0, 2)
    with np.errstate(divide="ignore"):
        ranges = np.minimum(wide / np.abs(np.cos(bearings)), high / np.abs(np.sin(bearings)))
    points = np.column_stack([np.cos(bearings), np.sin(bearings)]) * ranges[:, None]
    return anchors, points[rng.random(360) < 0.8]


def moved(scan, x, y, turn):
    """Give the same scan taken from a pose ``(x, y, turn)`` in its old frame."""
    anchors, points = scan
    c, s = math.cos(turn), math.sin(turn)
    back = np.array([[c, -s], [s, c]])
    return AnchorPoints(
        (anchors.positions - (x, y)) @ back,
        anchors.kinds,
        anchors.directions - turn,
        (anchors.main_angle - turn) % (0.5 * math.pi),
    ), (points - (x, y)) @ back


# A plain twin.


def code_of(distance):
    return min(1 + math.floor(math.log(distance / 0.08) / math.log(1000.0) * 254 + 0.5), 255)


def distance_of(code):
    return 0.08 * 1000.0 ** ((code - 1) / 254) if code else 0.0


def direction_of(x, y):
    return panorama._direction(np.float32(x), np.float32(y))


def turned(points, angle):
    c, s = math.cos(angle), math.sin(angle)
    return points @ np.array([[c, s], [-s, c]])


def plain_panorama(points):
    seen = [0] * DIRECTIONS
    for x, y in points.tolist():
        if 0.1 <= math.hypot(x, y) <= 80.0:
            at, code = direction_of(x, y), code_of(math.hypot(x, y))
            seen[at] = min(seen[at] or 255, code)
    return seen


def plain_agreement(points, seen):
    total = 0
    for x, y in points.tolist():
        at, distance = direction_of(x, y), math.hypot(x, y)
        near = [seen[(at + k) % DIRECTIONS] for k in (-1, 0, 1)]
        if not near[1]:
            continue
        ranges = [distance_of(code) for code in near if code]
        tolerance = 0.07 + 0.015 * distance
        if distance < min(ranges) - tolerance:
            total -= 1
        elif distance <= max(ranges) + tolerance:
            total += 1
    return total / max(len(points), 1)


def plain_shifts(anchors, others):
    """All shifts that pairs of anchor points agree on: turn, shift, how many."""
    for turn in range(4):
        positions = turned(anchors.positions, 0.5 * math.pi * turn)
        pairs = []
        for i in range(len(anchors)):
            for j in range(len(others)):
                off = others.directions[j] - anchors.directions[i] - 0.5 * math.pi * turn
                off = abs(math.remainder(off, 2.0 * math.pi))
                shift = others.positions[j] - positions[i]
                if anchors.kinds[i] == others.kinds[j] and off <= 0.5 and np.hypot(*shift) <= 5.0:
                    pairs.append((i, j, shift))
        for _, _, middle in pairs:
            had_i, had_j, shifts = set(), set(), []
            for i, j, shift in pairs:
                near = np.hypot(*(shift - middle)) <= 0.2
                if near and i not in had_i and j not in had_j:
                    had_i.add(i)
                    had_j.add(j)
                    shifts.append(shift)
            yield turn, np.mean(shifts, axis=0), len(shifts)


def upright(scan):
    anchors, points = scan
    main = anchors.main_angle
    return AnchorPoints(
        turned(anchors.positions, -main), anchors.kinds, anchors.directions - main, 0.0
    ), turned(points, -main)


def plain_worths(scan, reference):
    """What shifts are worth, by how many pairs agree on them."""
    anchors, points = upright(scan)
    others, seen = upright(reference)
    own, theirs = plain_panorama(points), plain_panorama(seen)
    some = points[np.linspace(0, len(points) - 1, min(40, len(points))).astype(int)]
    back = np.array(
        [
            [distance_of(theirs[k]) * f((k + 0.5) * math.pi / 90.0 - math.pi) for f in
             (math.cos, math.sin)]
            for k in range(0, DIRECTIONS, 4)
            if theirs[k]
        ]
    ).reshape(-1, 2)  # fmt: skip
    found = {}
    for turn, shift, count in plain_shifts(anchors, others):
        angle = 0.5 * math.pi * turn
        there = plain_agreement(turned(some, angle) + shift, theirs)
        return_way = plain_agreement(turned(back - shift, -angle), own)
        found.setdefault(count, []).append(there + return_way + 0.05 * count)
    return found


def worth_of(scan, references, quality=1.0, most=100):
    panoramas = [panorama.panorama(points, anchors.main_angle) for anchors, points in references]
    return worth(
        view(scan[1], scan[0]),
        stack_anchors([anchors for anchors, _ in references]),
        np.array(panoramas, np.uint8).reshape(-1, DIRECTIONS),
        np.arange(len(references)),
        np.full(len(references), quality),
        most,
    )


@given(st.floats(-math.pi, math.pi), st.floats(0.1, 60.0))
def test_the_direction_of_a_point_is_that_of_its_angle(angle, distance):
    at = direction_of(distance * math.cos(angle), distance * math.sin(angle))
    off = (angle + math.pi) * 90.0 / math.pi - (at + 0.5)
    assert abs(math.remainder(off, DIRECTIONS)) <= 0.5 + 0.15


@given(st.integers(0, 1 << 30))
def test_a_panorama_has_the_nearest_reading_of_each_direction(seed):
    _, points = random_scan(seed)
    seen = panorama.panorama(points, 0.0)
    assert np.abs(seen.astype(int) - plain_panorama(points)).max() <= 1  # by rounding
    assert len(panorama.panorama(points[:0], math.nan)) == DIRECTIONS
    assert not panorama.panorama(np.zeros((3, 2)), 0.0).any()


@given(st.integers(0, 1 << 30), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-3.0, 3.0))
def test_worth_is_that_of_plain_comparing(seed, x, y, turn):
    scan = random_scan(seed, 6)
    reference = moved(scan, x, y, turn) if seed % 2 else random_scan(seed + 1, 6)
    found = plain_worths(scan, reference)
    (got,) = worth_of(scan, [reference])
    if not found:
        assert got == pytest.approx(-2.0, abs=1e-5)
        return
    # Two shifts are tried, of those that equally many agree on any; readings at the border of a
    # direction or a tolerance may fall to either side.
    counts = sorted(found, reverse=True)
    candidates = [value for count in counts[:2] for value in found[count]]
    assert min(abs(got - value) for value in candidates) <= 0.15
    if len(found[counts[0]]) == 1:
        assert got >= found[counts[0]][0] - 0.15


@given(st.integers(0, 1 << 30), st.integers(2, 14), st.sampled_from([0.1, 0.5, 2.5]))
def test_the_shift_that_most_pairs_agree_on_is_tried(seed, count, spread):
    rng = np.random.default_rng(seed)
    scan, reference = (
        AnchorPoints(
            rng.uniform(-spread, spread, (count, 2)),
            rng.integers(0, 5, count),
            rng.integers(0, 4, count) * 0.5 * math.pi,
            0.0,
        )
        for _ in range(2)
    )
    plain = list(plain_shifts(scan, reference))
    turns = [sum(turn == each for each, _, _ in plain) for turn in range(4)]
    assume(plain and max(turns) <= 48)
    own, stack = view(np.zeros((0, 2)), scan), stack_anchors([reference])
    positions, directions = np.empty((20, 2), np.float32), np.empty(20, np.float32)
    starts, cells = np.empty(panorama._KINDS + 2, np.int64), panorama._CELLS
    panorama._upright((stack.positions, stack.kinds, stack.directions, stack.main_angles,
                       stack.starts), 0, positions, directions, starts)  # fmt: skip
    pairs, tried = np.empty((4, 48, 4), np.float32), np.zeros((2, 4), np.float32)
    lying = np.zeros(cells * cells, np.uint64)
    known = (panorama._turned(own.positions), positions, directions, starts)
    found = panorama._shifts(own, *known, pairs, lying, tried)
    most = max(number for _, _, number in plain)
    # What is just as far apart as may be agrees or not, by rounding.
    assert abs(tried[:found, 3].max() - most) <= 1
    turn, x, y, number = tried[tried[:found, 3].argmax()].tolist()
    assert (
        any(
            turn == each and number == agreeing and np.hypot(*(shift - (x, y))) < 1e-3
            for each, shift, agreeing in plain
        )
        or abs(number - most) == 1
    )
    assert not lying.any()


@given(st.integers(0, 1 << 30), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-3.0, 3.0))
def test_a_scan_of_the_place_is_worth_more_than_others(seed, x, y, turn):
    scan = random_scan(seed, 8)
    others = [random_scan(seed + k, 8) for k in (1, 2, 3)]
    worths = worth_of(moved(scan, x, y, turn), [*others, scan])
    assert worths.argmax() == 3
    assert worths[3] > 1.2


@given(st.integers(0, 1 << 30), st.integers(1, 12))
def test_the_best_are_the_same_however_many_are_asked_for(seed, most):
    scan = random_scan(seed, 6)
    references = [moved(scan, 0.1 * k, -0.2 * k, k) if k % 3 else random_scan(seed + k, 6)
                  for k in range(12)]  # fmt: skip
    everything, few = worth_of(scan, references), worth_of(scan, references, most=most)
    assert np.all(few <= everything)
    best = np.argsort(-everything, kind="stable")[:most]
    assert np.sort(few[best]).tolist() == np.sort(everything[best]).tolist()
    assert np.sort(-few)[:most].tolist() == np.sort(-everything)[:most].tolist()


@given(st.integers(0, 1 << 30))
def test_of_two_that_saw_the_same_votes_decide(seed):
    scan = random_scan(seed, 7)
    assume(plain_worths(scan, scan))
    low, high = (worth_of(scan, [scan], quality)[0] for quality in (0.1, 0.2))
    assert high - low == pytest.approx(0.2 * math.log(2.0), abs=1e-3)


def test_scans_without_anchor_points_or_readings_have_no_agreement():
    nothing = random_scan(1, 0)[0], np.zeros((0, 2))
    full = random_scan(2, 6)
    assert worth_of(nothing, [full, nothing]) == pytest.approx(-2.0, abs=1e-5)
    assert worth_of(full, [nothing]) == pytest.approx(-2.0, abs=1e-5)
    assert worth_of(full, []).shape == (0,)


def test_votes_are_put_in_order_and_those_not_compared_come_last():
    votes = Votes(np.array([7, 5, 9, 4]), np.arange(4, dtype=np.float32), np.array([4.0, 3, 2, 1]))
    order = reordered([(votes, np.array([0.1, 0.5, 0.1]))], 4)
    assert order.references.tolist() == [5, 7, 9, 4]
    assert order.quality.tolist() == [3.0, 4.0, 2.0, 1.0]
    assert reordered([(votes, np.array([0.1, 0.5, 0.1]))], 1).references.tolist() == [5]


def test_of_two_looks_a_reference_counts_by_the_better_one():
    counts = np.arange(3, dtype=np.float32)
    one = Votes(np.array([7, 5, 9]), counts, np.array([4.0, 3, 2])), np.array([0.1, 0.5])
    two = Votes(np.array([5, 7, 3]), counts, np.array([1.0, 0.5, 0.2])), np.array([0.2, 0.7])
    order = reordered([one, two], 9)
    assert order.references.tolist() == [7, 5, 9, 3]
    assert order.quality.tolist() == [0.5, 3.0, 2.0, 0.2]
    assert reordered([two, one], 9).references.tolist() == [7, 5, 9, 3]
    assert reordered([one, two], 1).references.tolist() == [7]


def test_real_scans_agree_most_with_their_neighbours(real_records):
    records = [record for record in real_records("intel.log.gz")[::10] if record.pose is not None]
    settings = Settings.preset()
    known = [describe(record.scan, settings) for record in records]
    scans = [(each.anchors, each.angles.points) for each in known]
    near = 0
    for k in range(0, len(scans), 4):
        others = [n for n in range(len(scans)) if n != k]
        best = others[int(worth_of(scans[k], [scans[n] for n in others]).argmax())]
        near += records[best].pose.distance(records[k].pose) < 3.0
    # Without any votes: a guess would be right for one in twenty.
    assert near >= 0.4 * len(range(0, len(scans), 4))
