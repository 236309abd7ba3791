"""All that is derived from one scan by itself: sections 2 to 4 in one value."""

from __future__ import annotations

from dataclasses import dataclass

from .anchors import (
    AnchorPoints,
    VirtualEdges,
    angle_anchors,
    gather,
    jump_edge_anchors,
    virtual_edges,
)
from .angle_function import AngleFunction, angle_function
from .evaluation import Outline, outline
from .graph import AnchorGraph, anchor_graph
from .scan import LaserScan
from .segments import Segments, segments
from .settings import Settings

__all__ = ["Description", "describe"]


@dataclass(frozen=True, eq=False)
class Description:
    """All that is derived from one scan by itself.

    Args:
        angles: Angle function (section 2).
        surfaces: Large connected surfaces (section 3).
        edges: Walls behind the virtual edges, per main angle (section 3).
        anchors: Anchor points (section 3).
        graph: Anchor graph (section 4).
        outline: What it saw, for the evaluation (section 5).
    """

    angles: AngleFunction
    surfaces: Segments
    edges: tuple[VirtualEdges, ...]
    anchors: AnchorPoints
    graph: AnchorGraph
    outline: Outline


def describe(scan: LaserScan, settings: Settings) -> Description:
    """Derive from one scan all that the matching needs (sections 2 to 4)."""
    angles = angle_function(scan, settings.anchors.angle_function)
    surfaces = segments(angles, settings.anchors.segments)
    edges = virtual_edges(angles, settings.anchors)
    anchors = gather(
        jump_edge_anchors(angles, surfaces, settings.anchors),
        angle_anchors(angles, surfaces, settings.anchors),
        edges,
    )
    graph = anchor_graph(anchors, settings.graph)
    return Description(angles, surfaces, tuple(edges), anchors, graph, outline(scan, angles))
