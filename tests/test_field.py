"""The stitched map against a plain twin, cell by cell, and what may not change it."""

from __future__ import annotations

import itertools
import math
import threading
import zlib
from collections import Counter, defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scans import EXACT, WIDE, box, building, drawn, places, seeds, sweeps

from anchorscan import (
    AnchorscanError,
    LaserScan,
    Pose2D,
    SensorModel,
    Settings,
    evidence,
    simulate,
)
from anchorscan import field as field_module
from anchorscan.evidence import SIDE
from anchorscan.field import FieldSettings, LikelihoodField
from anchorscan.rays import passed_through
from anchorscan.refinement import _solved as solved
from anchorscan.refinement import normal_equations, put_hessian, refined
from anchorscan.score import field_scores
from anchorscan.tiles import cell_code, coarse_score, room_for

FAR, FREE, SURFACE = 63, 64, 128
DEFAULT = Settings.preset("default").field
# Cells of a decimetre: a room is a tile or two, and the twin keeps up.
COARSE = FieldSettings(resolution=0.1, reach=0.5, sharpness=0.4)
SPARSE = SensorModel(field_of_view=2.0 * math.pi, resolution=math.radians(6.0))
# A map far from the origin is as good as any.
poses = st.builds(Pose2D, st.floats(-30, 30), st.floats(-30, 30), st.floats(-3.1, 3.1))


# The twin: a dictionary of cells.


class PlainMap:
    """Every hit and every pass by itself."""

    def __init__(self, limits, scans=()):
        self.limits = limits
        self.hits = defaultdict(list)
        self.passes = Counter()
        self.told = set()
        for scan, pose in scans:
            self.add(scan, pose)

    def add(self, scan, pose):
        limits, size = self.limits, self.limits.resolution
        for point in scan.points:
            length = math.hypot(*point)
            if length > limits.farthest:
                continue
            end = pose.apply(point[np.newaxis])[0]
            before = None
            for k in range(math.floor((length - limits.margin) / size)):
                x = pose.x + k * size * (end[0] - pose.x) / length
                y = pose.y + k * size * (end[1] - pose.y) / length
                cell = math.floor(x / size), math.floor(y / size)
                self.passes[cell] += cell != before
                before = cell
            cell = math.floor(end[0] / size), math.floor(end[1] / size)
            within = [math.floor((end[n] / size - cell[n]) * 256) for n in range(2)]
            self.hits[cell].append(within)

    def code(self, cx, cy):
        """The byte of a cell, as the module's text says."""
        limits = self.limits
        near = math.ceil(limits.reach / limits.resolution)
        distance = limits.reach
        for u, v in itertools.product(
            range(cx - near, cx + near + 1), range(cy - near, cy + near + 1)
        ):
            if (u, v) in self.hits:
                mean = np.mean(self.hits[u, v], axis=0) / 256 + 0.5 / 256
                off = math.dist((u + mean[0], v + mean[1]), (cx + 0.5, cy + 0.5))
                distance = min(distance, off * limits.resolution)
        code = int(distance / limits.reach * FAR)
        hits, passes = len(self.hits.get((cx, cy), ())), self.passes[cx, cy]
        code += FREE * (passes >= limits.fewest_passes)
        return code + SURFACE * (hits > 0 and passes <= limits.passes_per_hit * hits)


def code_at(tiles, cx, cy):
    """The byte of a cell, counted from the origin of the set's frame."""
    return int(cell_code(tiles, cx - tiles.column, cy - tiles.row))


def same_codes(ours, theirs):
    """Hold bytes equal; distances are truncated, so that rounding may move them by one."""
    ours, theirs = np.array(ours), np.array(theirs)
    np.testing.assert_array_equal(ours & ~FAR, theirs & ~FAR)
    off = np.abs((ours & FAR) - (theirs & FAR))
    assert off.max(initial=0) <= 1
    assert np.count_nonzero(off) <= 1 + 0.002 * len(off)


def check_against_twin(limits, scans, cells):
    tiles = LikelihoodField(limits, scans).tiles
    plain = PlainMap(limits, scans)
    same_codes([code_at(tiles, *cell) for cell in cells], [plain.code(*cell) for cell in cells])


def cells_around(scans, limits, count, seed=0):
    """Cells on the way, at the ends and beyond the rays of scans, and some where none went."""
    rng = np.random.default_rng(seed)
    ends = np.concatenate([pose.apply(scan.points) for scan, pose in scans])
    eyes = np.concatenate([np.full((len(scan.points), 2), (p.x, p.y)) for scan, p in scans])
    chosen = rng.integers(len(ends), size=count)
    share = rng.choice([0.3, 0.8, 1.0, 1.0, 1.1], (count, 1))
    at = eyes[chosen] + share * (ends[chosen] - eyes[chosen]) + rng.normal(0.0, 0.15, (count, 2))
    at[: count // 10] += 40.0
    return sorted({(int(cx), int(cy)) for cx, cy in np.floor(at / limits.resolution).tolist()})


@pytest.mark.interpreted
def test_a_small_room_is_the_twins_in_every_cell():
    limits = FieldSettings(resolution=0.25, reach=0.6, sharpness=0.5)
    scans = [
        (drawn(box(-2.0, -1.0, 2.0, 1.0), at=Pose2D(x, 0.1, h), sensor=SPARSE), Pose2D(x, 0.1, h))
        for x, h in ((-1.0, 0.0), (0.6, 2.0))
    ]
    check_against_twin(limits, scans, list(itertools.product(range(-13, 13), range(-9, 9))))


@given(seeds, poses, st.sampled_from([COARSE, DEFAULT]))
@settings(max_examples=25)
def test_bytes_are_the_twins(seed, motion, limits):
    world, at = building(seed % 4)
    rng = np.random.default_rng(seed)
    scans = [
        (simulate(world, place, SPARSE, rng), motion @ place)
        for place in (at[k] for k in rng.integers(len(at), size=3))
    ]
    check_against_twin(limits, scans, cells_around(scans, limits, 150, seed))


def test_real_scans_give_the_bytes_of_the_twin(real_records):
    records = [r for r in real_records("freiburg-101.log.gz") if r.scan is not None][:40:10]
    scans = [(record.scan, record.pose) for record in records]
    check_against_twin(DEFAULT, scans, cells_around(scans, DEFAULT, 400))


# What is seen of it.


@pytest.fixture(scope="module")
def room():
    """Some exact scans of a room with a wall in it, and the map of them."""
    walls = [*box(-4.0, -3.0, 5.0, 3.5), (0.5, -3.0, 0.5, 0.5), *box(2.5, 1.0, 3.3, 2.0)]
    at = [Pose2D(-2.0, 0.5, 0.3), Pose2D(2.0, -1.0, 2.0), Pose2D(-1.0, 2.0, -1.0), Pose2D(4.2, 2.5)]
    scans = [(drawn(walls, at=pose), pose) for pose in at]
    return scans, LikelihoodField(DEFAULT, scans)


def plain_scores(tiles, readings, at, weights):
    all_of_it, believed, shares = [], [], []
    ends = Pose2D(*at).apply(readings[:, :2]).tolist()
    for (x, y), small in zip(ends, readings[:, 2].astype(bool), strict=True):
        code = code_at(tiles, math.floor(x / tiles.resolution), math.floor(y / tiles.resolution))
        is_new = small and weights.is_new[code]
        all_of_it.append(weights.scores[code])
        believed.append(0.0 if is_new else weights.scores[code])
        shares.append(weights.share if is_new else 1.0)
    left_unexplained = 1.0 - sum(believed) / sum(shares)
    price = weights.price if any(share != 1.0 for share in shares) else 1.0
    return max(np.mean(all_of_it), 1.0 - price * left_unexplained)


@given(seeds)
@settings(max_examples=30)
def test_scores_are_the_twins(room, seed):
    rng = np.random.default_rng(seed)
    tiles, weights = room[1].tiles, DEFAULT.weights()
    at = rng.uniform((-8.0, -8.0, -4.0), (8.0, 8.0, 4.0), (3, 3))
    readings = np.column_stack((rng.uniform(-6.0, 6.0, (20, 2)), rng.integers(0, 2, 20)))
    expected = [plain_scores(tiles, readings, each, weights) for each in at.tolist()]
    np.testing.assert_allclose(field_scores(at, readings, tiles, weights), expected, atol=1e-6)
    assert field_scores(at, np.empty((0, 3)), tiles, weights).tolist() == [0.0] * 3


def test_new_things_are_believed_where_they_explain_enough(room):
    tiles, weights = room[1].tiles, DEFAULT.weights()
    seen = room[0][0][0].points
    at = room[0][0][1].to_array()[np.newaxis]

    def score(blocked, small):
        readings = np.column_stack((seen, np.zeros(len(seen))))
        readings[:blocked, :2] *= 0.5  # in known free space
        readings[:blocked, 2] = small
        return float(field_scores(at, readings, tiles, weights)[0])

    few, half = len(seen) // 10, len(seen) // 2
    assert score(0, 0.0) > score(few, 1.0) > score(half, 1.0) > 0.4
    assert score(few, 1.0) > score(few, 0.0) + 0.05
    assert score(half, 0.0) < 0.3


@pytest.mark.interpreted
def test_a_coarse_cell_has_the_best_score_of_its_cells():
    walls = box(-1.0, -0.7, 1.0, 0.7)
    scan = drawn(walls, sensor=SPARSE)
    limits = FieldSettings(resolution=0.2, reach=0.5)
    tiles = LikelihoodField(limits, [(scan, Pose2D(0.3, 0.2))]).tiles
    scores = limits.weights().scores
    for row in range(16 * tiles.height):
        for column in range(16 * tiles.width):
            best = max(
                scores[cell_code(tiles, 4 * column + a, 4 * row + b)]
                for a in range(4)
                for b in range(4)
            )
            assert coarse_score(tiles, column, row) == round(127.0 * max(float(best), -1.0))


def test_beyond_the_table_nothing_is_known(room):
    tiles = room[1].tiles
    right, top = 64 * tiles.width, 64 * tiles.height
    for cx, cy in ((-1, 5), (5, -1), (right, 5), (5, top), (-(10**9), 10**9), (10**12, 0)):
        assert cell_code(tiles, cx, cy) == FAR
        assert coarse_score(tiles, cx // 4, cy // 4) == round(127.0 * DEFAULT.unknown_score)
    nothing = LikelihoodField(DEFAULT).tiles
    assert cell_code(nothing, 0, 0) == cell_code(nothing, 3, -7) == FAR


def test_weights_fall_with_the_distance_and_more_so_in_free_space():
    for limits in (DEFAULT, COARSE, FieldSettings(), FieldSettings(sharpness=0.2)):
        weights = limits.weights()
        scores = weights.scores
        assert scores.shape == weights.is_new.shape == (256,)
        unknown, free = scores[: FAR + 1], scores[FREE : FREE + FAR + 1]
        assert unknown[0] == free[0] == 1.0
        assert np.all(np.diff(unknown) <= 0.0)
        assert np.all(np.diff(free) <= 0.0)
        assert np.all(free <= unknown)
        assert unknown[FAR] == pytest.approx(limits.unknown_score)
        assert free[FAR] == pytest.approx(-limits.free_penalty)
        # A thing may be new where nothing was, and only there.
        assert weights.is_new[FREE + FAR]
        assert np.all(weights.is_new.nonzero()[0] & FREE)
        assert not np.any(weights.is_new & (scores > 0.5))
        # Whether the cell itself is a surface makes no difference to who ends near one.
        np.testing.assert_array_equal(scores[SURFACE:], scores[:SURFACE])
        np.testing.assert_array_equal(weights.is_new[SURFACE:], weights.is_new[:SURFACE])


# Gauss-Newton on it.


def plain_distance(tiles, x, y):
    """Distance to the nearest surface, between the centres of four cells."""
    u, v = x / tiles.resolution - 0.5, y / tiles.resolution - 0.5
    left, low = math.floor(u), math.floor(v)
    total = 0.0
    for cx, cy in itertools.product((left, left + 1), (low, low + 1)):
        share = (1.0 - abs(u - cx)) * (1.0 - abs(v - cy))
        total += share * (code_at(tiles, cx, cy) & FAR) / FAR * tiles.reach
    return total


def plain_normal_equations(at, points, tiles, scale):
    hessian, gradient, squares, total = np.zeros((3, 3)), np.zeros(3), 0.0, 0.0
    for point in points:

        def distance(pose, point=point):
            return plain_distance(tiles, *Pose2D(*pose).apply(point[np.newaxis])[0])

        here = distance(at)
        if here >= 0.9 * tiles.reach:
            continue
        slope = np.array([(distance(at + e) - distance(at - e)) / 2e-6 for e in 1e-6 * np.eye(3)])
        weight = (1.0 + (here / scale) ** 2) ** -2
        hessian += weight * np.outer(slope, slope)
        gradient += weight * here * slope
        squares += weight * here**2
        total += weight
    return hessian, gradient, squares, total


@given(seeds)
@settings(max_examples=15)
def test_normal_equations_are_those_of_the_slopes(room, seed):
    rng = np.random.default_rng(seed)
    (scan, pose), *_ = room[0]
    at = pose.to_array() + rng.normal(0.0, (0.1, 0.1, 0.03))
    points = scan.points[rng.integers(len(scan.points), size=14)]
    # Some lie on the borders of tiles, whatever the surface: these look cells up one by one.
    tile = 64 * DEFAULT.resolution
    ends = Pose2D(*at).apply(points[:6])
    k = np.arange(6) % 2
    ends[range(6), k] = np.round(ends[range(6), k] / tile) * tile + rng.uniform(-0.03, 0.03, 6)
    points[:6] = Pose2D(*at).inverse().apply(ends)
    triangle, gradient, *sums = normal_equations(at, room_for(points), room[1].tiles, 0.1)
    hessian = np.empty((3, 3))
    put_hessian(triangle, hessian)
    ours = (hessian, gradient, *sums)
    theirs = plain_normal_equations(at, points, room[1].tiles, 0.1)
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5, rtol=1e-5)


@given(seeds)
def test_the_damped_system_is_solved(seed):
    rng = np.random.default_rng(seed)
    slopes = rng.normal(0.0, 3.0, (int(rng.integers(0, 5)), 3))
    hessian, gradient = slopes.T @ slopes, rng.normal(0.0, 1.0, 3)
    expected = np.linalg.solve(hessian + 0.7 * np.eye(3), gradient)
    triangle = tuple(hessian[np.triu_indices(3)])
    np.testing.assert_allclose(
        solved(triangle, tuple(gradient), 0.7), expected, rtol=1e-9, atol=1e-9
    )


def test_the_truth_is_a_fixed_point_of_the_refinement(room):
    scans, field = room
    for scan, pose in scans:
        points = scan.points[::10]
        moved = Pose2D(*refined(pose.to_array(), room_for(points), field.tiles, 12))
        assert moved.distance(pose) < 0.02
        assert moved.turn(pose) < math.radians(0.5)


@given(seeds)
@settings(max_examples=40)
def test_a_pose_nearby_is_drawn_to_the_truth(room, seed):
    rng = np.random.default_rng(seed)
    scans, field = room
    scan, pose = scans[seed % len(scans)]
    start = pose @ Pose2D(*rng.uniform(-0.12, 0.12, 2), rng.uniform(-0.05, 0.05))
    moved = Pose2D(*refined(start.to_array(), room_for(scan.points[::10]), field.tiles, 12))
    assert moved.distance(pose) < 0.03
    assert moved.turn(pose) < math.radians(0.7)


def test_where_nothing_is_near_nothing_moves(room):
    far = np.array([200.0, -100.0, 0.5])
    for points in (room[0][0][0].points, np.empty((0, 2))):
        np.testing.assert_array_equal(refined(far, room_for(points), room[1].tiles, 8), far)


# Rays through surfaces.


@pytest.fixture(scope="module")
def wall():
    """The map of a wall along y = 2, seen from both sides."""
    line = [(-6.0, 2.0, 6.0, 2.0)]
    at = [Pose2D(x, y, 0.2) for x in (-2.0, 0.0, 2.0) for y in (0.0, 4.0)]
    return LikelihoodField(DEFAULT, [(drawn(line, at=pose), pose) for pose in at]).tiles


def ray(tiles, begin, end, margin=0.3):
    """Whether one ray counts as passing through."""
    pose = np.array([*begin, 0.7])
    point = Pose2D(*pose).inverse().apply(np.array([end]))
    return passed_through(pose, point, tiles, margin)


@pytest.mark.parametrize(
    ("begin", "end", "through"),
    [
        ((0.0, 0.5), (0.0, 3.5), True),  # straight through
        ((0.0, 3.5), (0.3, 0.5), True),  # from behind
        ((-1.0, 1.0), (1.0, 3.0), True),  # slanted
        ((0.0, 0.5), (0.0, 2.0), False),  # it ends on the wall
        ((0.0, 0.5), (0.0, 2.2), False),  # it ends hardly behind it
        ((0.0, 0.5), (0.0, 1.5), False),  # it ends before it
        ((-4.0, 1.97), (4.0, 2.0), False),  # it grazes the wall
        ((-4.0, 2.05), (4.0, 1.95), False),
        ((-5.0, 1.6), (5.0, 2.4), False),  # so flat that it is hard to say
        ((0.0, 4.5), (0.0, 9.0), False),  # nothing is there
        ((30.0, 0.5), (30.0, 3.5), False),
    ],
)
def test_a_ray_passes_through_a_surface_or_not(wall, begin, end, through):
    assert ray(wall, begin, end) == through


def test_the_share_of_rays_that_pass_through(wall):
    pose = np.array([0.0, 0.5, 0.0])
    ends = np.array([(0.0, 3.0), (0.5, 3.5), (0.0, 1.0), (1.0, 0.5)]) - pose[:2]
    assert passed_through(pose, ends, wall, 0.3) == 0.5
    assert passed_through(pose, np.empty((0, 2)), wall, 0.3) == 0.0


@pytest.mark.parametrize("length", [1e6, 1e12, 1e300, math.inf])
def test_a_ray_of_any_length_is_followed_no_farther_than_lasers_see(wall, length):
    pose = np.array([0.0, 0.5, 0.0])
    ends = np.array([(1.0, 0.5), (0.0, length)])
    assert passed_through(pose, ends, wall, 0.3) == (0.5 if math.isfinite(length) else 0.0)


def test_a_scan_sees_through_nothing_where_it_was_taken(room):
    scans, field = room
    for scan, pose in scans:
        share = passed_through(pose.to_array(), scan.points, field.tiles, 0.3)
        assert share < 0.03  # the end of a wall is as thick as a cell


# What may not change it.


def all_bytes(field):
    """Every byte and every piece of evidence, by the tile's place; of tiles that have any."""
    arrays = field.arrays()
    ends = arrays.evidence_starts.tolist()
    return {
        tuple(square): (
            arrays.codes[k].tobytes(),
            arrays.coarse[k].tobytes(),
            arrays.evidence[ends[k - 1] : ends[k]].tobytes(),
        )
        for k, square in enumerate(arrays.squares.tolist(), 1)
    }


def placed(count, seed, motion=Pose2D()):  # noqa: B008
    world, at = building(seed % 4)
    rng = np.random.default_rng(seed)
    return [
        (simulate(world, at[k], SPARSE, rng), motion @ at[k])
        for k in rng.choice(len(at), count, replace=False)
    ]


@given(seeds, st.permutations(range(5)))
@settings(max_examples=15)
def test_the_order_of_references_is_irrelevant(seed, order):
    scans = placed(5, seed)
    at_once = LikelihoodField(COARSE, scans)
    one_by_one = LikelihoodField(COARSE)
    for k in order:
        one_by_one.add(*scans[k])
    shuffled = LikelihoodField(COARSE, [scans[k] for k in order])
    assert all_bytes(at_once) == all_bytes(one_by_one) == all_bytes(shuffled)


@given(seeds, poses)
@settings(max_examples=15)
def test_adding_and_removing_are_exact_opposites(seed, motion):
    scans = placed(3, seed)
    field = LikelihoodField(DEFAULT, scans)
    before, snapshot = all_bytes(field), field.tiles
    kept = [layer.copy() for layer in snapshot[:4]]
    others = placed(2, seed + 1, motion)
    for scan, pose in others:
        field.add(scan, pose)
    anew = all_bytes(LikelihoodField(DEFAULT, [*scans, *others]))
    assert all_bytes(field).items() ^ before.items()
    assert not all_bytes(field).items() ^ anew.items()
    for scan, pose in others:
        field.remove(scan, pose)
    assert not all_bytes(field).items() ^ before.items()
    # Who reads meanwhile reads on in what there was.
    for layer, copy in zip(snapshot[:4], kept, strict=True):
        np.testing.assert_array_equal(layer, copy)


def test_a_map_that_changes_for_long_stays_what_it_is_and_small():
    scans, others = placed(3, 5), placed(2, 6, Pose2D(90.0, -150.0, 0.4))
    field = LikelihoodField(COARSE, scans)
    before = all_bytes(field)
    largest = 0
    for k in range(150):
        snapshot = field.tiles
        kept = [layer.copy() for layer in snapshot[:4]]
        scan, pose = others[k % 2]
        field.add(scan, pose)
        field.remove(scan, pose)
        largest = max(largest, len(field.tiles.codes) // 4096)
        if k % 10 == 0:
            assert all_bytes(field) == before
            for layer, copy in zip(snapshot[:4], kept, strict=True):
                np.testing.assert_array_equal(layer, copy)
    assert largest < 4000  # outlived versions of tiles make room for others


@pytest.mark.parametrize("x", [-60.0, 0.0, 60.0])
@pytest.mark.parametrize("y", [-60.0, 0.0, 60.0])
def test_the_map_grows_in_any_direction(x, y):
    here, there = placed(1, 3), placed(1, 7, Pose2D(x, y, 1.0))
    field = LikelihoodField(COARSE, here)
    field.add(*there[0])
    assert all_bytes(field) == all_bytes(LikelihoodField(COARSE, [*there, *here]))
    for scan, pose in (*here, *there):
        ends = np.floor(pose.apply(scan.points) / COARSE.resolution).astype(int)
        assert all(code_at(field.tiles, *end) & FAR <= 15 for end in ends.tolist())


@given(places, st.integers(0, 200), st.integers(0, 200))
@settings(max_examples=25)
def test_where_tiles_begin_does_not_matter(place, right, up):
    # Moved by whole cells, every cell keeps its byte, whatever tile it falls into.
    world, at = building(place % 4)
    pose = at[place // 4]
    scan = simulate(world, pose, WIDE, np.random.default_rng(place))
    size = 2.0**-4  # exact in floating point
    limits = FieldSettings(resolution=size, reach=0.5)
    pose = Pose2D(round(pose.x * 64) / 64, round(pose.y * 64) / 64, pose.theta)
    moved = Pose2D(pose.x + right * size, pose.y + up * size, pose.theta)
    ours, theirs = LikelihoodField(limits, [(scan, pose)]), LikelihoodField(limits, [(scan, moved)])
    cells = cells_around([(scan, pose)], limits, 300, place)
    a = [code_at(ours.tiles, *cell) for cell in cells]
    b = [code_at(theirs.tiles, cx + right, cy + up) for cx, cy in cells]
    assert np.count_nonzero(np.array(a) != b) <= 2  # rounding at the border of a cell


# Bad input is normal input.


@given(st.lists(sweeps(), max_size=3), poses)
def test_anything_a_message_may_hold_makes_a_map(scans, pose):
    field = LikelihoodField(COARSE, [(scan, pose) for scan in scans])
    before = all_bytes(field)
    for scan in scans:
        field.add(scan, pose)
    for scan in scans:
        field.remove(scan, pose)
    assert all_bytes(field) == before


def test_longer_readings_are_left_out():
    scan = LaserScan(np.array([5.0, 45.0]), 0.0, 0.5)
    tiles = LikelihoodField(DEFAULT, [(scan, Pose2D())]).tiles
    assert code_at(tiles, 100, 0) & SURFACE
    assert len(tiles.pages) <= 4
    assert np.count_nonzero(tiles.table) < 20


def test_references_on_two_continents_are_an_error_that_says_so():
    scan = drawn(box(-2.0, -1.0, 2.0, 1.0), sensor=EXACT)
    field = LikelihoodField(DEFAULT, [(scan, Pose2D())])
    before = all_bytes(field)
    with pytest.raises(AnchorscanError, match="km apart"):
        field.add(scan, Pose2D(5e5, 5e6))
    with pytest.raises(AnchorscanError, match="not finite"):
        field.add(scan, Pose2D(math.nan, 0.0))
    assert all_bytes(field) == before
    # Far away, but together, is all right.
    together = LikelihoodField(DEFAULT, [(scan, Pose2D(5e5, 5e6)), (scan, Pose2D(5e5 + 3.0, 5e6))])
    assert len(together.tiles.pages) <= 4


@pytest.mark.parametrize("x", [2e8, -6.97e41, 1e308])
def test_a_reference_beyond_the_earth_is_an_error_that_says_so(x):
    scan = drawn(box(-2.0, -1.0, 2.0, 1.0), sensor=EXACT)
    with pytest.raises(AnchorscanError, match="km away; is its pose wrong"):
        LikelihoodField(DEFAULT, [(scan, Pose2D(x, 0.0))])


def test_what_several_changes_touch_is_derived_once_and_who_reads_first_has_it(monkeypatch):
    scans, others = placed(2, 7), placed(4, 8)
    derived = []
    derive = field_module._derive

    def counted(tiles, *rest):
        derived.append(len(tiles))
        derive(tiles, *rest)

    lazy = LikelihoodField(COARSE, scans)
    monkeypatch.setattr(field_module, "_derive", counted)
    for scan, pose in others:
        lazy.add(scan, pose)
    lazy.remove(*others[0])
    assert not derived
    assert all_bytes(lazy) == all_bytes(LikelihoodField(COARSE, [*scans, *others[1:]]))
    assert derived
    # Very much is derived by the writer, so that no reader waits for it.
    monkeypatch.setattr(field_module, "_MOST_WAITING", 1)
    derived.clear()
    lazy.add(*others[0])
    assert derived
    derived.clear()
    assert all_bytes(lazy) == all_bytes(LikelihoodField(COARSE, [*scans, *others])) or derived


def test_readers_see_whole_changes_while_a_writer_goes_on():
    scans, others = placed(2, 9), placed(1, 10)
    field = LikelihoodField(COARSE, scans)
    scan, pose = others[0]
    ends = (pose.apply(scan.points[::7]) / COARSE.resolution).astype(int).tolist()

    def seen_by(tiles):
        return tuple(code_at(tiles, *end) for end in ends)

    without = seen_by(field.tiles)
    having = seen_by(LikelihoodField(COARSE, [*scans, *others]).tiles)
    assert without != having
    seen, done = set(), threading.Event()

    def read():
        while not done.is_set():
            seen.add(seen_by(field.tiles))

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(60):
        field.add(scan, pose)
        field.remove(scan, pose)
    done.set()
    reader.join()
    assert seen <= {without, having}
    assert seen_by(field.tiles) == without


def test_evidence_that_is_packed_and_opened_again_is_the_same(monkeypatch):
    scans, others = placed(3, 11), placed(2, 12, Pose2D(60.0, 10.0, 0.3))
    expected = all_bytes(LikelihoodField(COARSE, [*scans, *others]))
    monkeypatch.setattr(evidence, "_MOST_OPEN", 6)
    field = LikelihoodField(COARSE, scans)
    for _ in range(3):
        for scan, pose in others:
            field.add(scan, pose)
            assert field.tiles
        for scan, pose in [*others, scans[0]]:
            field.remove(scan, pose)
        field.add(*scans[0])
    for scan, pose in others:
        field.add(scan, pose)
    assert all_bytes(field) == expected


def layers_of(rng, most):
    """Evidence of a tile: few cells with readings that ended there, passes up to a number."""
    hits, x, y = np.zeros((3, SIDE * SIDE), np.int32)
    at = rng.choice(SIDE * SIDE, 200, replace=False)
    hits[at] = rng.integers(0, 9, 200)
    x[at], y[at] = rng.integers(0, 2000, (2, 200))
    return hits, x, y, rng.integers(0, most + 1, SIDE * SIDE).astype(np.int32)


@pytest.mark.parametrize("most", [0, 1, 255, 256, 1 << 20])
def test_packed_evidence_is_unpacked_to_the_number(most):
    layers = layers_of(np.random.default_rng(most), most)
    again = np.zeros((4, SIDE * SIDE), np.int32)
    evidence._unpack(evidence._packed(*layers), *again)
    np.testing.assert_array_equal(again, layers)


def test_a_cell_with_every_number_in_it_is_packed():
    extremes = np.array([-(1 << 31), -1, 0, 1, (1 << 31) - 1], np.int32)
    layers = np.random.default_rng(3).choice(extremes, (4, SIDE * SIDE)).astype(np.int32)
    again = np.zeros_like(layers)
    evidence._unpack(evidence._packed(*layers), *again)
    np.testing.assert_array_equal(again, layers)


def test_evidence_of_nothing_takes_nothing():
    assert evidence._packed(*np.zeros((4, SIDE * SIDE), np.int32)) == b""


def damaged_evidence():
    hit = np.arange(3, dtype="<u2").tobytes() + bytes(36)
    passes = bytes(SIDE * SIDE)
    yield "cut", zlib.compress(b"\3\0" + hit + passes)[:-2]
    yield "short", zlib.compress(b"\3\0" + hit + passes[1:])
    yield "long", zlib.compress(b"\3\0" + hit + passes + b"\0")
    yield "more cells than there are", zlib.compress(b"\xff\xff" + hit + passes)
    yield "a cell beyond the tile", zlib.compress(b"\1\0\0\x10" + bytes(12) + passes)
    yield "a cell twice", zlib.compress(b"\2\0\5\0\5\0" + bytes(24) + passes)
    yield "a bomb", zlib.compress(bytes(1 << 24))


@pytest.mark.parametrize("data", [pytest.param(d, id=what) for what, d in damaged_evidence()])
def test_damaged_evidence_is_said(data):
    layers = np.zeros((4, SIDE * SIDE), np.int32)
    with pytest.raises(AnchorscanError, match="damaged"):
        evidence._unpack(data, *layers)
    assert not layers.any()


def test_damaged_evidence_is_said_again_when_it_is_opened_again():
    square = np.zeros((1, 2), np.int64)
    stored = np.frombuffer(b"no evidence", np.uint8)
    tiles = evidence.TileEvidence(square.astype(np.int32), stored, np.array([0, len(stored)]))
    for _ in range(2):
        with pytest.raises(AnchorscanError, match="damaged"):
            tiles.rows(square, make=True)
