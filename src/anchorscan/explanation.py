"""What a trace means, in the values that people look at: pictures, pages and viewers draw these.

A trace holds what the matcher computed.  To see why an answer came out one needs a little
more: how all references were voted for, how the scan's anchor graph lies on that of the
reference that the answer names, which readings agree, and what the map around looks like.
All of it is computed here with the functions of the stages, and nothing is decided.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .alignment import Alignment, align
from .database import RelationshipDatabase, Votes
from .description import Description, describe
from .errors import AnchorscanError
from .evaluation import Evaluation
from .field import LikelihoodField
from .graph import AnchorGraph, stack
from .hypothesis import Hypothesis
from .matcher import Trace
from .pose import Pose2D
from .reference import Reference
from .scan import LaserScan
from .score import Weights, field_scores
from .tiles import Tiles

__all__ = [
    "Comparison",
    "Explanation",
    "MapPicture",
    "Pairing",
    "Reading",
    "bounds_of",
    "centres_of_cells",
    "compare",
    "ellipse",
    "map_at",
    "picture_of_map",
    "wall_points",
]

_FAR, _FREE, _SURFACE = 63, 64, 128
# Long readings through doors and windows must not shrink the rest of a picture.
_OUTLIERS = 0.5
_MARGIN = 1.0
# Rows that are looked up at once, so that a large map needs no large memory.
_ROWS = 256


class Reading(IntEnum):
    """What a reading of the front scan says when it is held against the synthetic scan.

    ``THROUGH`` ends behind the surface that the overview saw: it sees through it.
    ``NEARER`` ends before it: something stands there that the overview did not see.
    """

    AGREES = 0
    NEARER = 1
    THROUGH = 2
    UNSEEN = 3
    NO_RETURN = 4


@dataclass(frozen=True, eq=False)
class Comparison:
    """The front scan beside the synthetic scan, reading by reading (section 5).

    Args:
        evaluation: e_m and the synthetic scan.
        front: The front scan: the scan, or the reference scan where the scan has the overview.
        T_reference_front: Pose of the front scan in the reference's frame.
        readings: (N,) of ``Reading``, one for each reading of the front scan.
    """

    evaluation: Evaluation
    front: LaserScan
    T_reference_front: Pose2D
    readings: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Pairing:
    """The scan's anchor graph laid on that of one reference, as in section 4.2.

    Args:
        hypothesis: The answer whose reference this is.
        reference: The reference.
        description: What was derived from its scan.
        alignment: Of the scan's graph with this one candidate.
        edges: (P, 2) edge of the reference and edge of the scan of every correspondence whose
            edges the best alignment lays on one another, end on end.
    """

    hypothesis: Hypothesis
    reference: Reference
    description: Description
    alignment: Alignment
    edges: NDArray[np.int64]

    @property
    def aligned(self) -> Pose2D | None:
        """``T_reference_scan`` by the graphs alone; None where no edges correspond."""
        return _aligned(self.alignment)

    @property
    def maximum(self) -> tuple[int, int, int] | None:
        """Reference's anchor, scan's anchor and count at the maximum of the matrix."""
        maxima = self.alignment.steps.maxima
        if not len(maxima) or maxima[:, 2].max() == 0:
            return None
        row, column, value = maxima[np.argmax(maxima[:, 2])].tolist()
        return row, column, value


class Explanation:
    """A trace and what else is needed to see why the answer came out.

    Args:
        trace: Of one scan.
        references: All references of the set that it was located in.
        truth: ``T_set_laser`` where it is known.

    Raises:
        AnchorscanError: There is nothing to explain: the scan has no return, or the set has no
            reference.
    """

    def __init__(
        self, trace: Trace, references: Sequence[Reference], truth: Pose2D | None = None
    ) -> None:
        if not trace.hypotheses:
            nothing = "no reading is a return" if references else "the set has no references"
            raise AnchorscanError(f"there is nothing to explain: {nothing}")
        self.trace = trace
        self.references = tuple(references)
        self.truth = truth

    @cached_property
    def votes(self) -> Votes:
        """Votes of all references, whether or not the search went by them (section 4.1)."""
        settings = self.trace.settings
        graphs = (
            (each.identifier, describe(each.scan, settings).graph) for each in self.references
        )
        database = RelationshipDatabase(settings.database, graphs)
        return database.votes(self.trace.description.graph, None)

    @cached_property
    def pairing(self) -> Pairing:
        """The scan beside the reference of the best hypothesis."""
        return self.pair(self.trace.hypotheses[0])

    def pair(self, hypothesis: Hypothesis) -> Pairing:
        """Align the scan with the reference of one hypothesis (section 4.2).

        Raises:
            ValueError: The hypothesis is not one of the trace.
        """
        settings, ours = self.trace.settings, self.trace.description.graph
        reference = self.trace.reference(hypothesis.reference)
        theirs = describe(reference.scan, settings)
        alignment = align(ours, stack([theirs.graph]), settings.alignment)
        edges = _laid_on(alignment, theirs.graph, ours, settings.alignment.cluster_distance)
        return Pairing(hypothesis, reference, theirs, alignment, edges)

    @cached_property
    def comparison(self) -> Comparison:
        """The best hypothesis, reading by reading."""
        return compare(self.trace, self.trace.hypotheses[0])

    @cached_property
    def field(self) -> LikelihoodField | None:
        """The map stitched from the references that have a pose; None without any."""
        placed = [(each.scan, each.pose) for each in self.references if each.pose is not None]
        return LikelihoodField(self.trace.settings.field, placed) if placed else None


def compare(trace: Trace, hypothesis: Hypothesis) -> Comparison:
    """Hold the front scan against the synthetic scan, reading by reading (section 5).

    Raises:
        ValueError: The hypothesis is not one of the trace.
    """
    evaluation = trace.evaluation(hypothesis)
    if evaluation.overview == "reference":
        front, T_reference_front = trace.description.scan, hypothesis.pose_in_reference
    else:
        front, T_reference_front = trace.reference_scan(hypothesis), Pose2D()
    seen = front.ranges.astype(np.float64)
    made = evaluation.synthetic.ranges.astype(np.float64)
    rule = trace.settings.evaluation
    tolerance = np.minimum(rule.tolerance + rule.relative_tolerance * seen, rule.largest_tolerance)
    with np.errstate(invalid="ignore"):
        off = seen - made
        readings = np.select(
            [~front.is_return, np.isnan(made), off > tolerance, off < -tolerance],
            [Reading.NO_RETURN, Reading.UNSEEN, Reading.THROUGH, Reading.NEARER],
            Reading.AGREES,
        )
    return Comparison(evaluation, front, T_reference_front, readings.astype(np.int64))


def _aligned(alignment: Alignment) -> Pose2D | None:
    return Pose2D(*alignment.poses[0].tolist()) if len(alignment) else None


def _laid_on(
    alignment: Alignment, theirs: AnchorGraph, ours: AnchorGraph, apart: float
) -> NDArray[np.int64]:
    """(P, 2) corresponding edges whose ends the alignment lays no farther apart than that."""
    T_reference_scan = _aligned(alignment)
    edges = alignment.steps.correspondences.edges.astype(np.int64)
    if T_reference_scan is None:
        return edges[:0]
    there = theirs.anchors.positions[theirs.nodes[edges[:, 0]]]
    here = T_reference_scan.apply(ours.anchors.positions[ours.nodes[edges[:, 1]]])
    straight = np.linalg.norm(there - here, axis=2).max(axis=1)
    crossed = np.linalg.norm(there - here[:, ::-1], axis=2).max(axis=1)
    return np.asarray(edges[np.minimum(straight, crossed) <= apart])


@dataclass(frozen=True, eq=False)
class MapPicture:
    """A stretch of the stitched map as images; row 0 is the lowest y.

    Args:
        distance: (H, W) metres to the nearest surface, at most the field's reach.
        is_free: (H, W) whether rays passed.
        is_surface: (H, W) whether there is a surface.
        extent: Smallest x, largest x, smallest y, largest y, metres, set frame.
    """

    distance: NDArray[np.float32]
    is_free: NDArray[np.bool_]
    is_surface: NDArray[np.bool_]
    extent: tuple[float, float, float, float]


def picture_of_map(
    field: LikelihoodField, bounds: tuple[float, float, float, float], most: int = 900
) -> MapPicture:
    """Look the stitched map up on a raster.

    Args:
        field: The map.
        bounds: Smallest x, largest x, smallest y, largest y, metres, set frame.
        most: Pixels on the longer side at most; where the map has more cells, a pixel shows
            what is nearest to a surface in it.
    """
    tiles = field.tiles
    cell = tiles.resolution
    low = np.floor(np.array([bounds[0], bounds[2]]) / cell).astype(np.int64)
    high = np.ceil(np.array([bounds[1], bounds[3]]) / cell).astype(np.int64)
    step = max(1, math.ceil(int((high - low).max()) / most))
    columns, rows = (np.ceil((high - low) / step).astype(np.int64) * step).tolist()
    codes = np.empty((rows, columns), np.uint8)
    x = (low[0] + np.arange(columns) + 0.5) * cell
    for begin in range(0, rows, _ROWS):
        y = (low[1] + np.arange(begin, min(begin + _ROWS, rows)) + 0.5) * cell
        points = np.column_stack((np.tile(x, len(y)), np.repeat(y, columns)))
        codes[begin : begin + len(y)] = _codes(tiles, points).reshape(-1, columns)
    blocks = codes.reshape(rows // step, step, columns // step, step)
    x0, y0 = (low * cell).tolist()
    return MapPicture(
        (blocks & _FAR).min(axis=(1, 3)).astype(np.float32) * (tiles.reach / _FAR),
        np.asarray(((blocks & _FREE) > 0).any(axis=(1, 3))),
        np.asarray(((blocks & _SURFACE) > 0).any(axis=(1, 3))),
        (x0, x0 + columns * cell, y0, y0 + rows * cell),
    )


def map_at(
    field: LikelihoodField, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Look the stitched map up at (N, 2) points (metres, set frame).

    Returns:
        (N,) metres to the nearest surface, infinite beyond the field's reach; (N,) whether
        rays passed there.
    """
    codes = _codes(field.tiles, points)
    far = codes & _FAR
    distance = np.where(far == _FAR, np.inf, far * (field.tiles.reach / _FAR))
    return distance, np.asarray((codes & _FREE) > 0)


def _codes(tiles: Tiles, points: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Byte of the cell at each point: what a map scores that scores a cell by its byte."""
    poses = np.zeros((len(points), 3))
    poses[:, :2] = points
    weights = Weights(np.arange(256, dtype=np.float32), np.zeros(256, np.bool_), 1.0, 1.0)
    return np.asarray(field_scores(poses, np.zeros((1, 3)), tiles, weights)).astype(np.uint8)


def wall_points(references: Iterable[Reference], cell: float = 0.05) -> NDArray[np.float64]:
    """Stitch the readings of all references that have a pose, one point a cell.

    Args:
        references: With or without poses.
        cell: Width of a cell, metres.

    Returns:
        (N, 2) centres of the cells in which readings end, metres, set frame.
    """
    ends = [each.pose.apply(each.scan.points) for each in references if each.pose is not None]
    return centres_of_cells(np.concatenate([np.empty((0, 2)), *ends]), cell)


def centres_of_cells(points: NDArray[np.float64], cell: float) -> NDArray[np.float64]:
    """Give the (N, 2) centres of all cells of a raster in which one of the points lies.

    Args:
        points: (P, 2) metres.
        cell: Width of a cell, metres; the raster has a corner at the origin.
    """
    if not len(points):
        return points
    cells = np.floor(points / cell).astype(np.int64)
    low = cells.min(axis=0)
    height = int(cells[:, 1].max() - low[1]) + 1
    # One number a cell: finding each pair once takes ten times as long.
    keys = np.unique((cells[:, 0] - low[0]) * height + (cells[:, 1] - low[1]))
    both = np.column_stack((keys // height, keys % height)) + low
    return np.asarray((both + 0.5) * cell)


def bounds_of(
    points: NDArray[np.float64],
    always: NDArray[np.float64] | None = None,
    stray: float = _OUTLIERS,
) -> tuple[float, float, float, float]:
    """Give the rectangle that holds nearly all of (N, 2) points, and all of some others.

    Args:
        points: Metres; a few far ones may be left out.
        always: (M, 2) metres, all inside.
        stray: Percent of the points that may be left out on each side.

    Returns:
        Smallest x, largest x, smallest y, largest y, metres.
    """
    corners = [np.empty((0, 2)) if always is None else always.reshape(-1, 2)]
    if len(points):
        corners.append(np.percentile(points, (stray, 100.0 - stray), axis=0))
    both = np.concatenate(corners)
    if not len(both):
        return -1.0, 1.0, -1.0, 1.0
    low, high = both.min(axis=0) - _MARGIN, both.max(axis=0) + _MARGIN
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def ellipse(
    pose: Pose2D, covariance: NDArray[np.float64], deviations: float = 2.0, count: int = 48
) -> NDArray[np.float64]:
    """Give the (count, 2) outline of a pose's uncertainty in position.

    Args:
        pose: In the frame of the covariance.
        covariance: (3, 3) of x, y (metres) and theta (radians).
        deviations: Standard deviations that the outline stands for.
        count: Points of the outline.
    """
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    around = np.linspace(0.0, 2.0 * math.pi, count)
    circle = np.column_stack((np.cos(around), np.sin(around)))
    return np.asarray(
        (pose.x, pose.y) + deviations * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    )
