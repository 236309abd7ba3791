"""Landmarks and proposals against plain twins, and which poses must and must not be proposed."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scans import (
    BUILDINGS,
    FULL_TURN,
    PLACES,
    WIDE,
    building,
    seeds,
    seen_in_building,
    small_room,
)

from anchorscan import Pose2D, Settings, simulate
from anchorscan.anchors import AnchorKind, AnchorPoints, anchor_points
from anchorscan.field import LikelihoodField
from anchorscan.proposal import ProposalSettings, joined, landmarks, proposals
from anchorscan.proposal import _edge_proposals as edge_proposals
from anchorscan.proposal import _first_check as first_check
from anchorscan.proposal import _highest as highest
from anchorscan.proposal import _is_new as is_new
from anchorscan.proposal import _lone_proposals as lone_proposals
from anchorscan.proposal import _rotated as rotated
from anchorscan.tiles import coarse_score

LEFT, RIGHT, CONVEX, CONCAVE, VIRTUAL = AnchorKind
DEFAULT = Settings.preset("default")
LIMITS = DEFAULT.proposal
EDGES_ONLY = LIMITS.model_copy(update={"enough": 0})
UNIT = 2.0 * math.pi / (1 << 16)
# A proposal is told from others by its cell of position and its 256th of a turn.
CELL, HEADING = 0.12, 2.0 * math.pi / 256
# Angles are kept in 65,536ths of a turn, rotations in 4,096ths.
ROUNDING = 3.0 * UNIT


def turn_between(a, b):
    return np.abs((np.asarray(a) - b + math.pi) % (2.0 * math.pi) - math.pi)


def quarter_between(a, b):
    """Difference modulo 90 degrees, with its sign."""
    return (a - b + 0.25 * math.pi) % (0.5 * math.pi) - 0.25 * math.pi


def seen(number):
    """Anchors and end points of a scan of a building, and its true pose."""
    scan = seen_in_building(number, FULL_TURN)
    return (
        anchor_points(scan, DEFAULT.anchors),
        scan,
        building(number % BUILDINGS)[1][number // BUILDINGS % PLACES],
    )


def some_anchors(rng, count, main=None):
    return AnchorPoints(
        rng.uniform(-5.0, 5.0, (count, 2)),
        rng.integers(0, len(AnchorKind), count),
        rng.uniform(-math.pi, math.pi, count),
        rng.uniform(-1.0, 1.0) if main is None else main,
    )


def numbers_of(limits):
    """The settings as the kernels get them."""
    return (
        limits.shortest_edge,
        limits.longest_edge,
        limits.length_tolerance,
        int(limits.direction_tolerance / UNIT),
        int(limits.heading_tolerance / UNIT),
        int(limits.lone_heading_tolerance / UNIT),
        limits.most_edges,
    )


def query_of(anchors):
    return anchors.positions, anchors.kinds, anchors.directions, anchors.main_angle


# Landmarks.


def plain_landmarks(anchors, limits):
    """Groups of anchors that show one thing, and the pairs of groups that were seen together."""
    turn = 2.0 * math.pi / max(round(2.0 * math.pi / limits.landmark_turn), 1)
    groups, pairs = defaultdict(list), set()
    for found, pose in anchors:
        here = []
        for at, kind, direction in zip(
            pose.apply(found.positions).tolist(), found.kinds, found.directions, strict=True
        ):
            facing = direction + pose.theta
            cell = (
                math.floor(at[0] / limits.landmark_cell),
                math.floor(at[1] / limits.landmark_cell),
            )
            key = int(kind), *cell, math.floor(facing % (2.0 * math.pi) / turn)
            groups[key].append((*at, facing))
            here.append(key)
        pairs |= {frozenset(pair) for pair in itertools.combinations(here, 2)}
    return groups, {tuple(sorted(pair)) for pair in pairs if len(pair) == 2}


def check_landmarks(anchors, limits):
    known = landmarks(anchors, limits)
    groups, pairs = plain_landmarks(anchors, limits)
    kinds = np.repeat(np.arange(len(AnchorKind)), np.diff(known.starts[0]))
    assert len(known.positions) == len(groups) == known.starts[0, -1]
    of_group = {}
    for key, members in groups.items():
        x, y, facing = np.array(members).T
        off = np.hypot(known.positions[:, 0] - x.mean(), known.positions[:, 1] - y.mean())
        facing = math.atan2(np.sin(facing).sum(), np.cos(facing).sum())
        off += turn_between(known.directions[:, 0] * UNIT, facing) + 9.0 * (kinds != key[0])
        of_group[key] = int(np.argmin(off))
        assert off.min() < 2.0 * UNIT
    edges = {tuple(sorted((of_group[a], of_group[b]))) for a, b in pairs}
    lengths = {edge: math.dist(*known.positions[list(edge)]) for edge in edges}
    slack = 1e-9
    wanted = {
        edge
        for edge, length in lengths.items()
        if limits.shortest_edge - slack <= length <= limits.longest_edge + slack
    }
    assert {tuple(sorted(edge)) for edge in known.edges.tolist()} == wanted
    assert len(known.edges) == len(wanted)
    for k, (a, b) in enumerate(known.edges.tolist()):
        assert kinds[a] <= kinds[b]
        group = int(np.searchsorted(known.edge_starts[0], k, "right")) - 1
        assert group == kinds[a] * len(AnchorKind) + kinds[b]
        x, y = known.positions[b] - known.positions[a]
        assert known.lengths[k] == pytest.approx(math.hypot(x, y), rel=1e-6)
        bearing = math.atan2(y, x)
        assert turn_between(known.turns[k, 0] * UNIT, bearing) < ROUNDING
        for n, end in ((1, a), (2, b)):
            expected = known.directions[end, 0] * UNIT - bearing
            assert turn_between(known.turns[k, n] * UNIT, expected) < ROUNDING
    for group in itertools.pairwise(known.edge_starts[0].tolist()):
        assert np.all(np.diff(known.lengths[slice(*group)]) >= 0.0)


@pytest.mark.interpreted
def test_landmarks_of_a_building_are_the_twins():
    check_landmarks([(found, pose) for found, _, pose in map(seen, (0, 4, 8))], LIMITS)


@given(seeds, st.integers(0, 4), st.integers(0, 8))
@settings(max_examples=40)
def test_landmarks_of_any_anchors_are_the_twins(seed, references, count):
    rng = np.random.default_rng(seed)
    anchors = [
        (some_anchors(rng, count), Pose2D(*rng.uniform(-3.0, 3.0, 3))) for _ in range(references)
    ]
    check_landmarks(anchors, LIMITS)


def test_one_thing_seen_by_two_references_is_one_landmark():
    corner = AnchorPoints(
        np.array([[1.0, 0.5], [3.0, 2.0]]), np.array([2, 3]), np.array([0.3, 1.0])
    )
    here, there = Pose2D(0.13, 0.04, 0.0), Pose2D(2.0, 1.0, 2.0)
    move = there.inverse() @ here
    again = AnchorPoints(move.apply(corner.positions), corner.kinds, corner.directions + move.theta)
    known = landmarks([(corner, here), (again, there)], LIMITS)
    assert len(known.positions) == 2
    assert known.edges.tolist() == [[0, 1]]
    np.testing.assert_allclose(known.positions, here.apply(corner.positions), atol=1e-9)


def test_blocks_stand_side_by_side():
    parts = [landmarks([(found, pose)], LIMITS) for found, _, pose in map(seen, (0, 4, 1))]
    parts.insert(1, landmarks([], LIMITS))
    known = joined(parts)
    assert len(known.starts) == len(known.edge_starts) == 4
    for block, part in enumerate(parts):
        first, last = known.starts[block, 0], known.starts[block, -1]
        np.testing.assert_array_equal(known.positions[first:last], part.positions)
        begin, end = known.edge_starts[block, 0], known.edge_starts[block, -1]
        np.testing.assert_array_equal(known.edges[begin:end], part.edges + first)
        np.testing.assert_array_equal(known.turns[begin:end], part.turns)
        assert np.all(np.diff(known.starts[block]) >= 0)


# What edges and lone anchors propose.


def plain_edge_proposals(anchors, known, limits, slack):
    """Every pose that lays an edge of the scan on a known one of its kind, length and turn."""
    kinds = np.repeat(np.arange(len(AnchorKind)), np.diff(known.starts[0]))
    poses = []
    between = [math.dist(a, b) for a, b in itertools.combinations(anchors.positions, 2)]
    within = [d for d in between if limits.shortest_edge <= d <= limits.longest_edge]
    steps = sorted({0, *(int(64 * d) + 1 for d in within)})
    shortest = next(n for n in steps if sum(64 * d >= n for d in within) <= limits.most_edges) / 64
    for i, j in itertools.permutations(range(len(anchors)), 2):
        a, b = anchors.positions[i], anchors.positions[j]
        length, bearing = math.dist(a, b), math.atan2(*(b - a)[::-1])
        if not max(shortest, limits.shortest_edge) <= length <= limits.longest_edge:
            continue
        for e, (u, v) in enumerate(known.edges.tolist()):
            if (kinds[u], kinds[v]) != (anchors.kinds[i], anchors.kinds[j]):
                continue
            if abs(known.lengths[e] - length) > limits.length_tolerance + slack:
                continue
            theta = known.turns[e, 0] * UNIT - bearing
            if any(
                turn_between(known.directions[end, 0] * UNIT, direction + theta)
                > limits.direction_tolerance + slack
                for end, direction in ((u, anchors.directions[i]), (v, anchors.directions[j]))
            ):
                continue
            if known.turns[e, 3] != 1 << 14 and not math.isnan(anchors.main_angle):
                ours = quarter_between(bearing, anchors.main_angle)
                off = quarter_between(known.turns[e, 3] * UNIT, ours)
                if abs(off) > limits.heading_tolerance + slack:
                    continue
                theta -= off
            centre = 0.5 * (known.positions[u] + known.positions[v])
            poses.append((*(centre - Pose2D(0, 0, theta).apply([0.5 * (a + b)])[0]), theta))
    return poses


def plain_lone_proposals(anchors, known, limits, slack):
    kinds = np.repeat(np.arange(len(AnchorKind)), np.diff(known.starts[0]))
    poses = []
    for at, kind, direction in zip(
        anchors.positions, anchors.kinds, anchors.directions, strict=True
    ):
        for m in np.flatnonzero(kinds == kind):
            theta = known.directions[m, 0] * UNIT - direction
            if known.directions[m, 1] != 1 << 14 and not math.isnan(anchors.main_angle):
                ours = quarter_between(direction, anchors.main_angle)
                off = quarter_between(known.directions[m, 1] * UNIT, ours)
                if abs(off) > limits.lone_heading_tolerance + slack:
                    continue
                theta -= off
            poses.append((*(known.positions[m] - Pose2D(0, 0, theta).apply([at])[0]), theta))
    return poses


def among(poses, others):
    """Whether every pose is among the others, but for what rounding moves it."""
    others = np.reshape(others, (-1, 3))
    for x, y, theta in poses:
        near = np.hypot(others[:, 0] - x, others[:, 1] - y) < 0.015
        near &= turn_between(others[:, 2], theta) < 0.002
        if not near.any():
            return False
    return True


def same_proposals(kernel, twin, anchors, known, limits):
    """What the twin proposes with a little less slack is proposed, and nothing with more."""
    out = np.empty((4096, 3))
    found = kernel(query_of(anchors), known, numbers_of(limits), out, 0)
    ours = out[:found] * (1.0, 1.0, UNIT)
    sure = twin(anchors, known, limits, -1e-3)
    possible = twin(anchors, known, limits, 1e-3)
    assert len(sure) <= found <= len(possible)
    assert among(sure, ours)
    assert among(ours.tolist(), possible)
    return found


def planted(rng, count, main):
    """Landmarks, and the anchors of a scan that sees most of them, moved and a little off."""
    anchors = some_anchors(rng, count, main)
    pose, there = Pose2D(*rng.uniform(-3.0, 3.0, 3)), Pose2D(*rng.uniform(-3.0, 3.0, 3))
    known = landmarks([(anchors, there)], LIMITS)
    move = pose.inverse() @ there
    some = rng.permutation(count)[: max(count - 2, 2)]
    scan = AnchorPoints(
        move.apply(anchors.positions[some]) + rng.uniform(-0.02, 0.02, (len(some), 2)),
        anchors.kinds[some],
        anchors.directions[some] + move.theta + rng.uniform(-0.05, 0.05, len(some)),
        anchors.main_angle + move.theta + rng.uniform(-0.02, 0.02),
    )
    return scan, known, pose


@given(seeds, st.integers(2, 9), st.sampled_from([None, math.nan]))
@settings(max_examples=60)
def test_edges_propose_what_the_twin_proposes(seed, count, main):
    scan, known, _ = planted(np.random.default_rng(seed), count, main)
    same_proposals(edge_proposals, plain_edge_proposals, scan, known, LIMITS)


@given(seeds, st.integers(1, 30))
@settings(max_examples=40)
def test_of_very_many_edges_the_longest_propose(seed, most):
    scan, known, _ = planted(np.random.default_rng(seed), 9, None)
    limits = LIMITS.model_copy(update={"most_edges": most})
    some = same_proposals(edge_proposals, plain_edge_proposals, scan, known, limits)
    assert some <= same_proposals(edge_proposals, plain_edge_proposals, scan, known, LIMITS)


@given(seeds, st.integers(2, 9), st.sampled_from([None, math.nan]))
@settings(max_examples=60)
def test_lone_anchors_propose_what_the_twin_proposes(seed, count, main):
    scan, known, _ = planted(np.random.default_rng(seed), count, main)
    same_proposals(lone_proposals, plain_lone_proposals, scan, known, LIMITS)


@pytest.mark.interpreted
def test_a_building_proposes_what_the_twins_propose():
    (ours, _, _), (theirs, _, there) = seen(5), seen(9)
    known = landmarks([(theirs, there)], LIMITS)
    assert same_proposals(edge_proposals, plain_edge_proposals, ours, known, LIMITS)
    assert same_proposals(lone_proposals, plain_lone_proposals, ours, known, LIMITS)


def test_a_full_list_of_proposals_stays_full():
    anchors, _, pose = seen(5)
    known = landmarks([(anchors, pose)], LIMITS)
    arguments = query_of(anchors), known, numbers_of(LIMITS)
    assert edge_proposals(*arguments, np.empty((3, 3)), 0) == 3
    assert lone_proposals(*arguments, np.empty((3, 3)), 2) == 3
    assert lone_proposals(*arguments, np.empty((3, 3)), 3) == 3


@given(seeds)
@settings(max_examples=40)
def test_planted_edges_are_proposed(seed):
    scan, known, pose = planted(np.random.default_rng(seed), 6, None)
    out = np.empty((4096, 3))
    lengths = [math.dist(a, b) for a, b in itertools.combinations(scan.positions, 2)]
    within = [LIMITS.shortest_edge + 0.1 < d < LIMITS.longest_edge - 0.1 for d in lengths]
    found = edge_proposals(query_of(scan), known, numbers_of(LIMITS), out, 0)
    off = np.hypot(out[:found, 0] - pose.x, out[:found, 1] - pose.y) < 0.5
    off &= turn_between(out[:found, 2] * UNIT, pose.theta) < 0.15
    # Every edge of the scan that is not too short or too long finds its own.
    assert np.count_nonzero(off) >= sum(within)


def test_the_opposite_direction_is_no_correspondence():
    # Exactly half a turn is the smallest 16-bit number, which has no absolute value.
    rng = np.random.default_rng(0)
    for _ in range(50):
        anchors = some_anchors(rng, 2, math.nan)
        known = landmarks([(anchors, Pose2D())], LIMITS)
        if not len(known.edges):
            continue
        units = np.round(anchors.directions / UNIT)
        facing = AnchorPoints(anchors.positions, anchors.kinds, units * UNIT)
        away = AnchorPoints(anchors.positions, anchors.kinds, (units + (1 << 15)) * UNIT)
        known = landmarks([(facing, Pose2D())], LIMITS)
        out = np.empty((16, 3))
        assert edge_proposals(query_of(facing), known, numbers_of(LIMITS), out, 0) >= 1
        if anchors.kinds[0] != anchors.kinds[1]:
            assert edge_proposals(query_of(away), known, numbers_of(LIMITS), out, 0) == 0


def test_a_mirror_image_is_not_proposed():
    corners = np.array([[2.0, 1.0], [3.5, -1.0], [-1.0, 2.0], [-2.0, -1.5]])
    kinds = np.array([CONVEX, CONCAVE, LEFT, VIRTUAL])
    directions = np.array([2.0, 0.4, -1.0, 0.8])
    known = landmarks([(AnchorPoints(corners, kinds, directions), Pose2D(1.0, 2.0, 0.3))], LIMITS)
    swapped = np.array([RIGHT, LEFT, CONVEX, CONCAVE, VIRTUAL])[kinds]
    image = AnchorPoints(corners * (1.0, -1.0), swapped, -directions)
    out = np.empty((64, 3))
    itself = AnchorPoints(corners, kinds, directions)
    assert edge_proposals(query_of(itself), known, numbers_of(LIMITS), out, 0) == 6
    assert edge_proposals(query_of(image), known, numbers_of(LIMITS), out, 0) == 0


def test_mirror_images_of_scans_are_hardly_proposed():
    # A rectangle is its own mirror image, and so are the virtual edges of one.
    def real(anchors):
        some = anchors.kinds != VIRTUAL
        return AnchorPoints(
            anchors.positions[some], anchors.kinds[some], anchors.directions[some],
            anchors.main_angle,
        )  # fmt: skip

    own = others = 0
    out = np.empty((1 << 16, 3))
    for number in range(0, 40, 3):
        anchors, scan, pose = seen(number)
        known = landmarks([(real(anchors), pose)], LIMITS)
        image = anchor_points(scan.upside_down(), DEFAULT.anchors)
        own += edge_proposals(query_of(real(anchors)), known, numbers_of(LIMITS), out, 0)
        others += edge_proposals(query_of(real(image)), known, numbers_of(LIMITS), out, 0)
    assert others < 0.25 * own


# The whole stage.


@pytest.fixture(scope="module")
def known_building():
    """Anchors and poses of the references of a building, and their map."""
    references = [seen(number) for number in range(0, BUILDINGS * 12, BUILDINGS)]
    field = LikelihoodField(DEFAULT.field, [(scan, pose) for _, scan, pose in references])
    return references, field.tiles


def is_proposed(found, pose):
    """Whether a pose within the cell of the true one is among the proposals."""
    near = np.hypot(found.poses[:, 0] - pose.x, found.poses[:, 1] - pose.y) < 2.0 * CELL
    return bool(np.any(near & (turn_between(found.poses[:, 2], pose.theta) < 2.0 * HEADING)))


def test_the_scan_of_a_reference_proposes_its_own_pose(known_building):
    references, tiles = known_building
    merged = landmarks([(anchors, pose) for anchors, _, pose in references], LIMITS)
    for anchors, scan, pose in references:
        found = proposals(anchors, scan.points, merged, tiles, LIMITS)
        assert is_proposed(found, pose)
        assert len(found.poses) == len(found.scores) <= LIMITS.most
        assert found.proposed >= len(found.poses)
        assert np.all((found.scores >= 0.0) & (found.scores <= 1.0))


def test_a_scan_taken_nearby_proposes_its_pose(known_building):
    references, tiles = known_building
    merged = landmarks([(anchors, pose) for anchors, _, pose in references], LIMITS)
    world, _ = building(0)
    right = []
    for seed, (_, _, pose) in enumerate(references):
        there = pose @ Pose2D(0.3, -0.2, 0.7)
        scan = simulate(world, there, WIDE, np.random.default_rng(seed))
        found = proposals(anchor_points(scan, DEFAULT.anchors), scan.points, merged, tiles, LIMITS)
        right.append(is_proposed(found, there))
    assert np.mean(right) >= 0.9


def cells_of(found):
    rows = np.column_stack((found.poses[:, :2] / CELL, found.poses[:, 2] / HEADING))
    return {tuple(row) for row in np.floor(rows).astype(int).tolist()}


@given(seeds)
@settings(max_examples=15)
def test_blocks_and_merged_landmarks_propose_the_same(known_building, seed):
    # Far apart nothing is merged: then blocks and one block are two ways to say one thing.
    references, tiles = known_building
    rng = np.random.default_rng(seed)
    limits = EDGES_ONLY.model_copy(update={"most": 1 << 16})
    chosen = rng.choice(len(references), 4, replace=False)
    apart = [
        (references[k][0], Pose2D(60.0 * n, 0.0) @ references[k][2] if n else references[k][2])
        for n, k in enumerate(chosen)
    ]
    merged = landmarks(apart, limits)
    blocks = joined([landmarks([each], limits) for each in apart])
    anchors, scan, _ = references[int(rng.integers(len(references)))]
    ours = proposals(anchors, scan.points, merged, tiles, limits)
    theirs = proposals(anchors, scan.points, blocks, tiles, limits)
    assert ours.proposed == theirs.proposed
    # Of several poses in one cell the first stands for all, and that is another one at times.
    assert len(cells_of(ours) ^ cells_of(theirs)) <= 0.02 * len(cells_of(ours)) + 1


@given(seeds)
@settings(max_examples=15)
def test_the_order_of_the_anchors_does_not_matter(known_building, seed):
    references, tiles = known_building
    rng = np.random.default_rng(seed)
    limits = LIMITS.model_copy(update={"most": 1 << 16})
    merged = landmarks([(anchors, pose) for anchors, _, pose in references], limits)
    anchors, scan, _ = references[int(rng.integers(len(references)))]
    order = rng.permutation(len(anchors))
    shuffled = AnchorPoints(
        anchors.positions[order], anchors.kinds[order], anchors.directions[order],
        anchors.main_angle,
    )  # fmt: skip
    ours = proposals(anchors, scan.points, merged, tiles, limits)
    theirs = proposals(shuffled, scan.points, merged, tiles, limits)
    assert ours.proposed == theirs.proposed
    # Another pose is the first of its cell, and now and then one that fails the check.
    assert len(cells_of(ours) ^ cells_of(theirs)) <= 0.15 * len(cells_of(ours)) + 2


def test_few_edges_let_lone_anchors_propose(known_building):
    references, tiles = known_building
    merged = landmarks([(anchors, pose) for anchors, _, pose in references], LIMITS)
    found = []
    for anchors, scan, pose in references:
        for k in np.flatnonzero(anchors.kinds != VIRTUAL)[:3]:
            one = AnchorPoints(
                anchors.positions[k : k + 1], anchors.kinds[k : k + 1],
                anchors.directions[k : k + 1], anchors.main_angle,
            )  # fmt: skip
            found.append(is_proposed(proposals(one, scan.points, merged, tiles, LIMITS), pose))
            assert proposals(one, scan.points, merged, tiles, EDGES_ONLY).proposed == 0
    assert np.mean(found) > 0.9


# Checking and keeping.


@given(seeds, st.integers(0, 60))
def test_a_pose_in_the_same_cell_is_not_new(seed, count):
    rng = np.random.default_rng(seed)
    poses = rng.normal(0.0, 0.3, (count, 2)) + rng.choice([0.0, 1e4, -1e4])
    headings = rng.integers(0, 3, count)
    seen_before, told = set(), np.zeros(256, np.uint64)
    for (x, y), heading in zip(poses.tolist(), headings.tolist(), strict=True):
        cell = math.floor(x / CELL), math.floor(y / CELL), heading
        assert is_new(told, x, y, heading) == (cell not in seen_before)
        seen_before.add(cell)


@pytest.mark.interpreted
def test_readings_are_turned_to_every_heading():
    _, tiles = small_room(DEFAULT.field)
    points = np.array([[1.0, 0.0], [3.0, -2.0]])
    table = rotated(points, tiles)
    for heading in (0, 17, 128, 255):
        turn = Pose2D(0.0, 0.0, (heading + 0.5) * HEADING)
        cells = turn.apply(points) / (4.0 * tiles.resolution)
        np.testing.assert_allclose(table[heading], cells, atol=1e-4)


@given(seeds)
@settings(max_examples=30)
def test_the_first_check_adds_up_coarse_scores(known_building, seed):
    references, tiles = known_building
    rng = np.random.default_rng(seed)
    _, scan, pose = references[seed % len(references)]
    points = scan.points[rng.integers(len(scan.points), size=12)]
    table = rotated(points, tiles)
    heading = int(rng.integers(256))
    if seed % 2:
        heading = int(pose.theta % (2.0 * math.pi) / HEADING)
    x, y = pose.x + rng.normal(0.0, 0.5), pose.y + rng.normal(0.0, 0.5)
    size = 4.0 * tiles.resolution
    left = np.float32(x / size - tiles.column / 4)
    low = np.float32(y / size - tiles.row / 4)
    scores = [coarse_score(tiles, int(left + u), int(low + v)) for u, v in table[heading].tolist()]
    half = sum(scores[:6])
    expected = max(sum(scores), -1) if half >= 16 * 12 else -1
    given_score = first_check(table, heading, x, y, tiles)
    # A reading on the border of a cell falls to either side.
    assert given_score == expected or abs(half - 16 * 12) < 127 or abs(given_score - expected) < 127


@given(st.lists(st.integers(0, 20), max_size=60), st.integers(1, 30))
def test_the_highest_scores_are_kept_in_the_order_of_the_proposals(scores, most):
    poses = np.column_stack((np.arange(len(scores)), np.zeros((len(scores), 2)))).astype(float)
    best = sorted(range(len(scores)), key=lambda k: (-scores[k], k))[:most]
    kept, values = highest(poses, np.array(scores, np.int32), 20, most)
    assert kept[:, 0].tolist() == sorted(best)
    np.testing.assert_allclose(values, [scores[k] / 20 for k in sorted(best)])


def test_the_same_question_has_the_same_answer(known_building):
    references, tiles = known_building
    limits = LIMITS.model_copy(update={"most": 20})  # equals stand on both sides of the border
    merged = landmarks([(anchors, pose) for anchors, _, pose in references], limits)
    for anchors, scan, _ in references[:4]:
        ours = proposals(anchors, scan.points, merged, tiles, limits)
        theirs = proposals(anchors, scan.points, merged, tiles, limits)
        np.testing.assert_array_equal(ours.poses, theirs.poses)
        assert len(ours.poses) == 20
        more = proposals(anchors, scan.points, merged, tiles, LIMITS)
        assert np.sort(ours.scores)[::-1].tolist() == np.sort(more.scores)[::-1][:20].tolist()


# Bad input is normal input.

NO_ANCHORS = AnchorPoints(np.empty((0, 2)), np.empty(0, np.int64), np.empty(0))


@pytest.mark.interpreted
def test_nothing_proposes_nothing():
    _, tiles = small_room(DEFAULT.field)
    anchors, scan, pose = seen(0)
    known = landmarks([(anchors, pose)], LIMITS)
    nothing = landmarks([], LIMITS)
    assert landmarks([(NO_ANCHORS, pose)], LIMITS).positions.shape == (0, 2)
    for ours, theirs in ((NO_ANCHORS, known), (anchors, nothing), (NO_ANCHORS, nothing)):
        found = proposals(ours, scan.points, theirs, tiles, LIMITS)
        assert found.proposed == len(found.poses) == 0
        assert found.poses.shape == (0, 3)
    unknown = LikelihoodField(DEFAULT.field).tiles
    assert len(proposals(anchors, scan.points, known, unknown, LIMITS).poses) == 0


def test_a_scan_without_points_has_no_score(known_building):
    references, tiles = known_building
    anchors, _, pose = references[0]
    known = landmarks([(anchors, pose)], LIMITS)
    found = proposals(anchors, np.empty((0, 2)), known, tiles, LIMITS)
    assert np.all(found.scores == 0.0)


def test_settings_that_merge_everything_or_nothing_do_no_harm():
    anchors, _, pose = seen(2)
    for limits in (
        ProposalSettings(landmark_cell=100.0, landmark_turn=10.0),
        ProposalSettings(landmark_cell=1e-6, landmark_turn=1e-3),
        ProposalSettings(longest_edge=0.5),
    ):
        check_landmarks([(anchors, pose)], limits)
