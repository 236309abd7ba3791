"""The anchor graph against its plain twin."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anchorscan.anchors import AnchorPoints
from anchorscan.graph import GraphSettings, anchor_graph, stack


def anchors_at(positions):
    positions = np.asarray(positions, dtype=np.float64).reshape(-1, 2)
    count = len(positions)
    return AnchorPoints(positions, np.zeros(count, np.int64), np.zeros(count))


def plain_edges(positions, minimal, maximal):
    edges = []
    for a, b in itertools.combinations(range(len(positions)), 2):
        x, y = positions[b] - positions[a]
        length = math.hypot(x, y)
        if minimal <= length <= maximal:
            edges.append((length, a, b, math.atan2(y, x)))
    return sorted(edges)


coordinates = st.floats(-30.0, 30.0, allow_nan=False)
point_sets = st.lists(st.tuples(coordinates, coordinates), max_size=14)


@given(point_sets, st.sampled_from([(0.0, None), (0.5, None), (0.0, 10.0), (1.0, 20.0)]))
def test_every_pair_within_the_bounds_is_an_edge_in_order_of_length(points, bounds):
    minimal, maximal = bounds
    anchors = anchors_at(points)
    graph = anchor_graph(anchors, GraphSettings(minimal_length=minimal, maximal_length=maximal))

    expected = plain_edges(anchors.positions, minimal, maximal or math.inf)

    assert np.all(np.diff(graph.lengths) >= 0.0)
    np.testing.assert_allclose(graph.lengths, [edge[0] for edge in expected], atol=1e-12)
    got = {
        (a, b): (d, t)
        for (a, b), d, t in zip(graph.nodes.tolist(), graph.lengths, graph.directions, strict=True)
    }
    assert got.keys() == {(a, b) for _, a, b, _ in expected}
    for length, a, b, direction in expected:
        assert got[a, b] == pytest.approx((length, direction), abs=1e-12)


@given(point_sets, st.floats(-math.pi, math.pi), coordinates, coordinates)
def test_lengths_do_not_depend_on_where_the_scan_was_taken(points, theta, x, y):
    positions = anchors_at(points).positions
    c, s = math.cos(theta), math.sin(theta)
    moved = positions @ np.array([[c, s], [-s, c]]) + (x, y)

    here = anchor_graph(anchors_at(positions), GraphSettings())
    there = anchor_graph(anchors_at(moved), GraphSettings())

    np.testing.assert_allclose(here.lengths, there.lengths, atol=1e-9)


def test_a_stack_holds_each_graph_where_its_starts_say():
    rng = np.random.default_rng(5)
    graphs = [
        anchor_graph(anchors_at(rng.normal(size=(n, 2))), GraphSettings()) for n in (4, 0, 1, 6)
    ]
    stacked = stack(graphs)

    assert len(stacked) == 4
    for c, graph in enumerate(graphs):
        edges = slice(*stacked.edge_starts[c : c + 2])
        nodes = slice(*stacked.node_starts[c : c + 2])
        np.testing.assert_array_equal(stacked.lengths[edges], graph.lengths)
        np.testing.assert_array_equal(stacked.directions[edges], graph.directions)
        np.testing.assert_array_equal(stacked.nodes[edges], graph.nodes)
        np.testing.assert_array_equal(stacked.positions[nodes], graph.anchors.positions)
        np.testing.assert_array_equal(graph.node_a, graph.nodes[:, 0])
        np.testing.assert_array_equal(graph.node_b, graph.nodes[:, 1])


def test_no_graphs_make_an_empty_stack():
    assert len(stack([])) == 0
    assert len(stack([]).lengths) == 0
