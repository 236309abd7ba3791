"""Section 4: the fully connected graph of a scan's anchor points.

A scan is represented by the relations between its anchor points: every pair of them is an
edge with a length, which does not depend on where the scan was taken from, and a direction,
which turns with the scan.  Edges are kept in order of length, because everything that
follows compares lengths.

The paper connects all anchor points.  Bounds on the edge length are settings; the ``paper``
preset has none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .anchors import AnchorPoints
from .ranking import ascending

__all__ = ["AnchorGraph", "GraphSettings", "GraphStack", "anchor_graph", "stack"]


class GraphSettings(BaseModel):
    """Settings of the anchor graph of section 4."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    minimal_length: float = Field(
        0.0, ge=0.0, description="shorter edges are left out: their direction is noise, metres"
    )
    maximal_length: float | None = Field(
        None, gt=0.0, description="longer edges are left out, metres; null for no bound"
    )


@dataclass(frozen=True, eq=False)
class AnchorGraph:
    """The anchor points of one scan and all relations between them.

    Args:
        anchors: The nodes.
        nodes: (E, 2) int32, the two nodes a < b of every edge.
        lengths: (E,) metres, ascending.
    """

    anchors: AnchorPoints
    nodes: NDArray[np.int32]
    lengths: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.lengths)

    @cached_property
    def directions(self) -> NDArray[np.float64]:
        """(E,) bearing from node a to node b, radians in (-pi, pi], scan frame."""
        directions: NDArray[np.float64] = bearings(self.anchors.positions, self.nodes)
        return directions

    @property
    def node_a(self) -> NDArray[np.int32]:
        """(E,) first node of every edge."""
        return self.nodes[:, 0]

    @property
    def node_b(self) -> NDArray[np.int32]:
        """(E,) second node of every edge."""
        return self.nodes[:, 1]


@dataclass(frozen=True, eq=False)
class GraphStack:
    """Several anchor graphs one behind the other, so that one kernel call handles all.

    Args:
        positions: (A, 2) metres, each in the frame of its own scan.
        nodes: (E, 2) int32, counted within each graph.
        lengths: (E,) metres, ascending within each graph.
        directions: (E,) radians.
        node_starts: (C + 1,) where the nodes of each graph begin.
        edge_starts: (C + 1,) where the edges of each graph begin.
    """

    positions: NDArray[np.float64]
    nodes: NDArray[np.int32]
    lengths: NDArray[np.float64]
    directions: NDArray[np.float64]
    node_starts: NDArray[np.int64]
    edge_starts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.edge_starts) - 1


def anchor_graph(anchors: AnchorPoints, settings: GraphSettings) -> AnchorGraph:
    """Connect every anchor point with every other (section 4)."""
    return AnchorGraph(anchors, *_edges(anchors.positions, edge_limits(settings)))


def edge_limits(settings: GraphSettings) -> tuple[float, float]:
    """Return the lengths, metres, between which edges are kept."""
    maximal = math.inf if settings.maximal_length is None else settings.maximal_length
    return settings.minimal_length, maximal


def stack(graphs: Sequence[AnchorGraph]) -> GraphStack:
    """Put graphs one behind the other; none at all gives an empty stack."""
    if not graphs:
        return GraphStack(_NO_POSITIONS, _NO_NODES, _NO_VALUES, _NO_VALUES, _NO_STARTS, _NO_STARTS)
    parts = [(g.anchors.positions, g.nodes, g.lengths, g.directions) for g in graphs]
    positions, nodes, lengths, directions = zip(*parts, strict=True)
    return GraphStack(
        np.concatenate(positions),
        np.concatenate(nodes),
        np.concatenate(lengths),
        np.concatenate(directions),
        np.array([0, *accumulate(map(len, positions))], np.int64),
        np.array([0, *accumulate(map(len, lengths))], np.int64),
    )


_NO_POSITIONS = np.empty((0, 2))
_NO_NODES = np.empty((0, 2), np.int32)
_NO_VALUES = np.empty(0)
_NO_STARTS = np.zeros(1, np.int64)


@kernel
def _edges(positions, limits):  # type: ignore[no-untyped-def]
    """All pairs of nodes within the limits: nodes and lengths, by length."""
    minimal, maximal = limits
    count = len(positions)
    most = count * (count - 1) // 2
    nodes = np.empty((most, 2), np.int32)
    lengths = np.empty(most)
    found = 0
    for a in range(count):
        for b in range(a + 1, count):
            length = math.sqrt(
                (positions[b, 0] - positions[a, 0]) ** 2 + (positions[b, 1] - positions[a, 1]) ** 2
            )
            if minimal <= length <= maximal:
                nodes[found, 0] = a
                nodes[found, 1] = b
                lengths[found] = length
                found += 1
    order = ascending(lengths[:found])
    return nodes[:found][order], lengths[:found][order]


@kernel
def bearings(positions, nodes):  # type: ignore[no-untyped-def]
    """Direction of every edge."""
    directions = np.empty(len(nodes))
    for e in range(len(nodes)):
        a, b = nodes[e, 0], nodes[e, 1]
        directions[e] = math.atan2(
            positions[b, 1] - positions[a, 1], positions[b, 0] - positions[a, 0]
        )
    return directions
