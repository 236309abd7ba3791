"""All that is derived from one scan by itself: sections 2 to 4 in one value."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .anchors import (
    AnchorPoints,
    AnchorSettings,
    VirtualEdges,
    all_anchors,
    anchor_limits,
    in_other_frame,
    virtual_edges,
)
from .angle_function import (
    AngleFunction,
    _angle_function,
    angle_function,
    surface_limits,
    sweep,
)
from .evaluation import Outline, _outline
from .graph import AnchorGraph, _edges, anchor_graph, edge_limits
from .panorama import View, panorama, view
from .scan import LaserScan
from .segments import Segments, _segments, segment_limits, segments
from .settings import Settings
from .spacing import spacings
from .verification import _readings

__all__ = ["Description", "Look", "describe", "looks"]


@dataclass(frozen=True, eq=False)
class Description:
    """All that is derived from one scan by itself.

    What the matching does not ask for again is derived anew for whoever looks at it.

    Args:
        scan: The scan, thinned where a laser looks closer than ``finest_increment``.
        anchors: Anchor points (section 3).
        graph: Anchor graph (section 4).
        outline: What it saw, for the evaluation (section 5).
        readings: (V, 3) the returns, see ``verification.readings``.
        settings: Of the anchor points.
    """

    scan: LaserScan
    anchors: AnchorPoints
    graph: AnchorGraph
    outline: Outline
    readings: NDArray[np.float64]
    settings: AnchorSettings

    @property
    def points(self) -> NDArray[np.float64]:
        """(V, 2) end points of the returns, counter-clockwise, metres, scan frame."""
        return np.ascontiguousarray(self.readings[:, :2])

    @cached_property
    def angles(self) -> AngleFunction:
        """Angle function (section 2)."""
        return angle_function(self.scan, self.settings.angle_function)

    @cached_property
    def surfaces(self) -> Segments:
        """Large connected surfaces (section 3)."""
        return segments(self.angles, self.settings.segments)

    @cached_property
    def edges(self) -> tuple[VirtualEdges, ...]:
        """Walls behind the virtual edges, per main angle (section 3), for whoever looks at them."""
        return tuple(virtual_edges(self.angles, self.settings))


@dataclass(frozen=True, eq=False)
class Look:
    """What a scan is looked for by, in one frame of main walls.

    Args:
        graph: Its anchor points and their relations.
        view: What it is compared by.
        spacings: (3,) uint64 of the walls that it saw.
    """

    graph: AnchorGraph
    view: View
    spacings: NDArray[np.uint64]


def looks(description: Description, settings: Settings) -> tuple[Look, ...]:
    """Say what a scan is looked for by: one look, or two where two main angles are about as strong.

    Args:
        description: Of the scan.
        settings: Of all stages.
    """
    points, graph = description.points, description.graph
    graphs = [graph]
    other = in_other_frame(description.angles, description.anchors, settings.anchors)
    if other is not None:
        graphs.append(anchor_graph(other, settings.graph))
    return tuple(_look(points, graph) for graph in graphs)


def _look(points: NDArray[np.float64], graph: AnchorGraph) -> Look:
    saw = spacings(panorama(points, graph.anchors.main_angle)[None])[0]
    return Look(graph, view(points, graph.anchors), saw)


def describe(scan: LaserScan, settings: Settings) -> Description:
    """Derive from one scan all that the matching needs (sections 2 to 4).

    It is what the functions of the stages give one by one, in one kernel: to call ten of them
    from Python took longer than what they do, and so does every array that is handed back.

    A laser that looks closer than the finest increment shows no more of a place, only more often:
    some of its readings are left out.  The paper, whose scans had a degree, says nothing of that.
    """
    scan = scan.thinned(settings.anchors.finest_increment)
    anchors, edges, outline, readings = _described(
        scan.ranges,
        sweep(scan),
        surface_limits(settings.anchors.angle_function),
        segment_limits(settings.anchors.segments),
        anchor_limits(settings.anchors),
        edge_limits(settings.graph),
        settings.verification.small_extent,
    )
    nodes = AnchorPoints(*anchors)
    graph = AnchorGraph(nodes, *edges)
    return Description(scan, nodes, graph, Outline(*outline), readings, settings.anchors)


@kernel
def _described(ranges, sweep, surface_limits, segment_limits, anchor_limits, edge_limits, extent):  # type: ignore[no-untyped-def]
    """What every part of a description is made of."""
    angles = _angle_function(ranges, sweep, surface_limits)
    points, distances, beams, gaps, runs, way, _, _, _, _ = angles
    surfaces = _segments(runs, way, segment_limits)
    anchors = all_anchors(angles, surfaces, anchor_limits)
    edges = _edges(anchors[0], edge_limits)
    outline = _outline((points, distances, beams, gaps), len(ranges), sweep)
    return anchors, edges, outline, _readings(points, runs, way, extent)
