"""The alignment against a plain twin of every step, and its properties."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchorscan.alignment import AlignmentSettings, align, correspondences
from anchorscan.anchors import AnchorPoints, AnchorSettings, anchor_points
from anchorscan.graph import GraphSettings, anchor_graph, stack
from anchorscan.pose import Pose2D, wrap_angle

SETTINGS = AlignmentSettings(histogram_peaks=2, matrix_peaks=3)


def graph_at(positions):
    positions = np.asarray(positions, dtype=np.float64).reshape(-1, 2)
    count = len(positions)
    return anchor_graph(
        AnchorPoints(positions, np.zeros(count, np.int64), np.zeros(count)), GraphSettings()
    )


def random_graph(rng, count=None):
    return graph_at(rng.uniform(-8.0, 8.0, (rng.integers(0, 9) if count is None else count, 2)))


# --- The twin: one candidate, one step after the other, in plain Python ------------------


def plain_pairs(graph, reference, tolerance):
    return [
        (e, f, (reference.directions[e] - graph.directions[f]) % math.pi)
        for e in range(len(reference))
        for f in range(len(graph))
        if abs(reference.lengths[e] - graph.lengths[f]) <= tolerance
    ]


def plain_histogram(pairs, bins):
    histogram = [0] * bins
    for _, _, turn in pairs:
        histogram[min(int(turn / math.pi * bins), bins - 1)] += 1
    return histogram


def plain_peaks(histogram, most, tolerance):
    left, bins = list(histogram), len(histogram)
    reach = min(round(tolerance * bins / math.pi), (bins - 1) // 2)
    offsets = range(-reach, reach + 1)
    peaks = []
    while len(peaks) < most:
        sums = [sum(left[(k + o) % bins] for o in offsets) for k in range(bins)]
        at = sums.index(max(sums))
        if sums[at] == 0:
            break
        mean = sum(o * left[(at + o) % bins] for o in offsets) / sums[at]
        peaks.append((at + 0.5 + mean) * math.pi / bins % math.pi)
        for o in offsets:
            left[(at + o) % bins] = 0
    return peaks


def plain_matrix(pairs, graph, reference):
    matrix = np.zeros((len(reference.anchors), len(graph.anchors)), int)
    for e, f, _ in pairs:
        for i in reference.nodes[e]:
            for j in graph.nodes[f]:
                matrix[i, j] += 1
    return matrix


def plain_contributions(pairs, graph, reference, row, column):
    poses = []
    for e, f, _ in pairs:
        ends, others = reference.nodes[e].tolist(), graph.nodes[f].tolist()
        if row not in ends or column not in others:
            continue
        a, b = ends if ends[0] == row else ends[::-1]
        v, w = others if others[0] == column else others[::-1]
        p, q = reference.anchors.positions, graph.anchors.positions
        theta = math.atan2(*(p[b] - p[a])[::-1]) - math.atan2(*(q[w] - q[v])[::-1])
        middle = Pose2D(0.0, 0.0, theta).apply([(q[v] + q[w]) / 2.0])[0]
        poses.append(((p[a] + p[b]) / 2.0 - middle, theta))
    return [Pose2D(x, y, theta) for (x, y), theta in poses]


def apart(a, b, s):
    """Squared distance in units of the cluster's size."""
    return (a.distance(b) / s.cluster_distance) ** 2 + (a.turn(b) / s.cluster_turn) ** 2


def plain_mean(poses):
    return Pose2D(
        np.mean([p.x for p in poses]),
        np.mean([p.y for p in poses]),
        math.atan2(sum(math.sin(p.theta) for p in poses), sum(math.cos(p.theta) for p in poses)),
    )


def close_to(mean, poses, s):
    """What belongs to a centre, less what is far off for how close most of it is."""
    close = [p for p in poses if apart(p, mean, s) <= 1.0]
    limit = min(9.0 * np.median([apart(p, mean, s) for p in close]) + 1e-12, 1.0)
    return [p for p in close if apart(p, mean, s) <= limit]


def plain_cluster(poses, s):
    density = [sum(max(0.0, 1.0 - apart(a, b, s)) for b in poses) for a in poses]
    mean = poses[density.index(max(density))]
    cluster = []
    for _ in range(2):
        cluster = close_to(mean, poses, s)
        mean = plain_mean(cluster)
    return mean, len(cluster)


def plain_unified(centre, pairs, graph, reference, s):
    """Centre of gravity of all correspondences that mean an alignment, and their number."""
    hypotheses = []
    for e, f, turn in pairs:
        for row in reference.nodes[e]:
            hypotheses += plain_contributions(
                [(e, f, turn)], graph, reference, row, graph.nodes[f][0]
            )
    group = [p for p in hypotheses if apart(p, centre, s) <= 1.0]
    if not group:
        return centre, 0
    turns = [centre.theta + wrap_angle(p.theta - centre.theta) for p in group]
    mean = Pose2D(
        np.median([p.x for p in group]), np.median([p.y for p in group]), np.median(turns)
    )
    cluster = []
    for _ in range(2):
        cluster = close_to(mean, group, s)
        mean = plain_mean(cluster)
    return mean, len(cluster)


def check_against_twin(graph, references, s=SETTINGS):
    result = align(graph, stack(references), s)
    pairs = result.steps.correspondences
    for c, reference in enumerate(references):
        expected = plain_pairs(graph, reference, s.length_tolerance)
        begin, end = pairs.starts[c : c + 2]
        offset = sum(len(r) for r in references[:c])
        got = pairs.edges[begin:end] - (offset, 0)
        assert got.tolist() == [[e, f] for e, f, _ in expected]
        np.testing.assert_allclose(pairs.turns[begin:end], [t for *_, t in expected], atol=1e-9)
        assert pairs.nodes[begin:end].tolist() == [
            [*reference.nodes[e], *graph.nodes[f]] for e, f, _ in expected
        ]
        histogram = plain_histogram(
            [(e, f, t) for (e, f, _), t in zip(expected, pairs.turns[begin:end], strict=True)],
            s.histogram_bins,
        )
        assert result.steps.histograms[c].tolist() == histogram
        peaks = plain_peaks(histogram, s.histogram_peaks, s.turn_tolerance)
        found = result.steps.peaks[c][~np.isnan(result.steps.peaks[c])]
        np.testing.assert_allclose(found, peaks, atol=1e-9)
        for p, peak in enumerate(found):
            branch = c * s.histogram_peaks + p
            turns = pairs.turns[begin:end]
            off = np.abs(turns - peak)
            near = np.flatnonzero(np.minimum(off, math.pi - off) <= s.turn_tolerance)
            kept = result.steps.kept[slice(*result.steps.kept_starts[branch : branch + 2])] - begin
            assert kept.tolist() == near.tolist()
            left = [expected[k] for k in near]
            matrix = plain_matrix(left, graph, reference)
            np.testing.assert_array_equal(result.steps.matrix(branch), matrix)
            groups = range(branch * s.matrix_peaks, (branch + 1) * s.matrix_peaks)
            values = sorted(matrix.ravel(), reverse=True)[: s.matrix_peaks]
            assert [result.steps.maxima[g, 2] for g in groups][: len(values)] == values
            for g in groups:
                check_group(result, g, left, graph, reference, s)


def check_group(result, g, pairs, graph, reference, s):
    row, column, value = result.steps.maxima[g].tolist()
    if value == 0:
        return
    hypotheses = plain_contributions(pairs, graph, reference, row, column)
    got = result.steps.contributions[slice(*result.steps.contribution_starts[g : g + 2])]
    assert len(hypotheses) == value == len(got)
    for pose, (x, y, theta) in zip(hypotheses, got, strict=True):
        assert (pose.x, pose.y) == pytest.approx((x, y), abs=1e-9)
        assert wrap_angle(pose.theta - theta) == pytest.approx(0.0, abs=1e-9)
    centre, size = plain_cluster([Pose2D(*p) for p in got], s)
    inside = result.steps.in_cluster[slice(*result.steps.contribution_starts[g : g + 2])]
    assert inside.sum() == size
    mean, support = plain_unified(centre, pairs, graph, reference, s)
    c = g // (s.histogram_peaks * s.matrix_peaks)
    # The group's alignment is in the answer, or one as well supported that is like it.
    like = [
        n
        for n in np.flatnonzero(result.candidates == c)
        if apart(Pose2D(*result.poses[n]), mean, s) < 1e-9 and result.support[n] == support
    ]
    merged = [
        n
        for n in np.flatnonzero(result.candidates == c)
        if min(apart(Pose2D(*result.poses[n]), other, s) for other in (mean, centre)) <= 4.0
    ]
    assert like or merged or support == 0


@settings(deadline=None)
@given(st.integers(0, 10_000))
def test_every_step_is_that_of_the_plain_twin(seed):
    rng = np.random.default_rng(seed)
    references = [random_graph(rng) for _ in range(rng.integers(0, 4))]
    check_against_twin(random_graph(rng), references)


def test_every_step_is_that_of_the_plain_twin_on_real_scans(real_records):
    records = real_records("freiburg-101.log.gz")[::70]
    graphs = [
        anchor_graph(anchor_points(record.scan, AnchorSettings()), GraphSettings())
        for record in records
    ]
    check_against_twin(graphs[0], graphs)


# --- Properties ------------------------------------------------------------------------

poses = st.builds(Pose2D, st.floats(-20, 20), st.floats(-20, 20), st.floats(-math.pi, math.pi))


@settings(deadline=None)
@given(st.integers(0, 10_000), poses)
def test_a_moved_copy_is_aligned_by_its_motion(seed, motion):
    positions = np.random.default_rng(seed).uniform(-8.0, 8.0, (9, 2))
    reference = graph_at(motion.apply(positions))
    result = align(graph_at(positions), stack([reference]), AlignmentSettings())

    # The strongest alignment of graphs that agree throughout has eight edges behind it.
    assert result.support[0] >= 7
    x, y, theta = result.poses[0]
    assert math.hypot(x - motion.x, y - motion.y) < 0.15
    assert abs(wrap_angle(theta - motion.theta)) < 0.05


@settings(deadline=None)
@given(st.integers(0, 10_000))
def test_candidates_do_not_influence_one_another(seed):
    rng = np.random.default_rng(seed)
    graph = random_graph(rng, 7)
    references = [random_graph(rng, 6) for _ in range(4)]
    together = align(graph, stack(references), SETTINGS)
    for c, reference in enumerate(references):
        alone = align(graph, stack([reference]), SETTINGS)
        mine = together.candidates == c
        np.testing.assert_array_equal(together.poses[mine], alone.poses)
        np.testing.assert_array_equal(together.support[mine], alone.support)
        np.testing.assert_array_equal(together.scatter[mine], alone.scatter)


def test_a_subgraph_is_found_and_an_accidental_correspondence_is_ruled_out():
    # As in figure 3: the small graph is part of the large one, and one edge of the large
    # one has by accident the length of another.
    large = graph_at(
        [(0.0, 0.0), (3.0, 0.0), (3.0, 4.0), (3.0 + 4.0 * math.cos(2.0), 4.0 * math.sin(2.0))]
    )
    motion = Pose2D(1.0, -2.0, math.radians(30.0))
    small = graph_at(motion.inverse().apply([(3.0, 0.0), (3.0, 4.0), (0.0, 0.0)]))
    result = align(small, stack([large]), AlignmentSettings())

    assert Pose2D(*result.poses[0]).distance(motion) < 1e-6
    assert Pose2D(*result.poses[0]).turn(motion) < 1e-6
    assert len(result.steps.kept) < len(correspondences(small, stack([large]), 0.1))
    assert np.degrees(result.steps.peaks[0, 0]) == pytest.approx(30.0, abs=2.0)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000))
def test_one_maximum_gives_the_centre_of_gravity_of_the_twin(seed):
    rng = np.random.default_rng(seed)
    s = AlignmentSettings()
    positions = rng.uniform(-6.0, 6.0, (8, 2))
    reference = graph_at(positions)
    graph = graph_at(positions + rng.normal(0.0, 0.02, positions.shape))
    result = align(graph, stack([reference]), s)

    pairs = [
        (e, f, turn)
        for e, f, turn in plain_pairs(graph, reference, s.length_tolerance)
        if (off := abs(turn - result.steps.peaks[0, 0])) <= s.turn_tolerance
        or math.pi - off <= s.turn_tolerance
    ]
    centre, _ = plain_cluster([Pose2D(*p) for p in result.steps.contributions], s)
    mean, support = plain_unified(centre, pairs, graph, reference, s)

    assert apart(Pose2D(*result.poses[0]), mean, s) < 1e-9
    assert result.support.tolist() == [support]


def test_the_scatter_is_the_covariance_of_what_is_behind_an_alignment():
    rng = np.random.default_rng(3)
    positions = rng.uniform(-6.0, 6.0, (8, 2))
    still = align(graph_at(positions), stack([graph_at(positions)]), AlignmentSettings())
    np.testing.assert_allclose(still.scatter[0], 0.0, atol=1e-15)
    for noise in (0.01, 0.03):
        noisy = graph_at(positions + rng.normal(0.0, noise, positions.shape))
        result = align(noisy, stack([graph_at(positions)]), AlignmentSettings())
        deviations = np.sqrt(np.diag(result.scatter[0]))
        assert np.all(deviations[:2] > 0.3 * noise)
        assert np.all(deviations[:2] < 5.0 * noise)
        np.testing.assert_array_equal(result.scatter[0], result.scatter[0].T)


def test_graphs_without_edges_have_no_alignment():
    empty, one = graph_at([]), graph_at([(1.0, 2.0)])
    full = random_graph(np.random.default_rng(0), 6)
    for graph, references in ((empty, [full]), (one, [full]), (full, [empty, one]), (full, [])):
        assert len(align(graph, stack(references), SETTINGS)) == 0
