"""Section 4.2: the alignment of two anchor graphs.

Every length correspondence of two edges says how the graphs may lie on one another, in two
ways: a on v and b on w, or a on w and b on v.  Which of them are true is decided by counting:

1. The *matching angle histogram* counts the angle differences, modulo 180 degrees, of all
   corresponding edges.  Correspondences away from its peak are ruled out.
2. The *node correspondence matrix* counts, for those left, every pair of nodes that they
   would lay on one another; both assignments of an edge pair count.
3. Each edge correspondence behind the matrix's maximum gives one alignment hypothesis.
   The maximum says which assignment is meant.
4. A clustering step eliminates the false ones, and the centre of gravity of the true ones (mean
   translation, circular mean rotation) is the alignment.

Several peaks of the histogram and of the matrix give several alignments.  All steps handle
all candidate references in one call, over arrays laid one behind the other.

The paper leaves the clustering open.  Here the hypothesis around which the others lie most
densely is the first centre; what is farther from it than three times the median distance of
what is close is false; and the same once more around the mean.

We depart from the paper in one point: the centre of gravity is taken over all edge
correspondences that mean the alignment, not only over those behind the maximum.  These all
share one pair of nodes, and with it that pair's error: where two anchor points of a corner lie
a few centimetres apart the maximum may name the wrong one, and one scan in thirty was not laid
exactly on itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from ._jit import kernel
from .graph import AnchorGraph, GraphStack, bearings
from .ranking import best_first

__all__ = [
    "Alignment",
    "AlignmentSettings",
    "AlignmentSteps",
    "Correspondences",
    "align",
    "correspondences",
]


class AlignmentSettings(BaseModel):
    """Settings of the alignment of section 4.2."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    length_tolerance: float = Field(
        0.1, gt=0.0, description="edges correspond when their lengths differ no more, metres"
    )
    histogram_bins: int = Field(
        90, ge=4, le=3600, description="bins of the matching angle histogram over 180 degrees"
    )
    turn_tolerance: float = Field(
        math.radians(6.0), gt=0.0, description="largest distance from a histogram peak, radians"
    )
    histogram_peaks: int = Field(1, ge=1, description="peaks of the histogram that are followed")
    matrix_peaks: int = Field(1, ge=1, description="maxima of each matrix that are followed")
    cluster_distance: float = Field(
        0.3, gt=0.0, description="translations that belong together, metres"
    )
    cluster_turn: float = Field(
        math.radians(6.0), gt=0.0, description="rotations that belong together, radians"
    )
    position_deviation: float = Field(
        0.05, gt=0.0, description="least standard deviation of an alignment, metres"
    )
    heading_deviation: float = Field(
        math.radians(1.0), gt=0.0, description="least standard deviation of an alignment, radians"
    )


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Pairs of edges that correspond in length, candidate after candidate.

    Args:
        edges: (P, 2) int32, edge of the stack and edge of the query graph.
        nodes: (P, 4) int32, their nodes a, b (within the reference graph) and v, w.
        turns: (P,) direction of the reference's edge minus the query's, radians in [0, pi).
        starts: (C + 1,) where the pairs of each candidate begin.
    """

    edges: NDArray[np.int32]
    nodes: NDArray[np.int32]
    turns: NDArray[np.float64]
    starts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.turns)


@dataclass(frozen=True, eq=False)
class Alignment:
    """The alignments of one graph with several candidates.

    Args:
        candidates: (N,) candidate of every alignment; the strongest first in each candidate.
        poses: (N, 3) ``T_reference_scan`` as x, y, theta, metres and radians.
        support: (N,) edge correspondences that mean it.
        scatter: (N, 3, 3) covariance of x, y, theta among their hypotheses.
        asked: The graph, the candidates and the settings.
    """

    candidates: NDArray[np.int64]
    poses: NDArray[np.float64]
    support: NDArray[np.int64]
    scatter: NDArray[np.float64]
    asked: tuple[AnchorGraph, GraphStack, AlignmentSettings]

    def __len__(self) -> int:
        return len(self.support)

    @cached_property
    def steps(self) -> AlignmentSteps:
        """All that led to them, derived anew for whoever looks at it."""
        pairs, branches, hypotheses, _ = _steps(*_arguments(*self.asked))
        return AlignmentSteps(Correspondences(*pairs), *branches, *hypotheses)


@dataclass(frozen=True, eq=False)
class AlignmentSteps:
    """All that led to the alignments of one graph with several candidates.

    With C candidates, ``histogram_peaks`` K and ``matrix_peaks`` L there are B = C K
    branches and G = B L groups of hypotheses; group g belongs to candidate g // (K L).

    Args:
        correspondences: Of all candidates.
        histograms: (C, bins) matching angle histograms.
        peaks: (C, K) their peaks, radians in [0, pi); NaN where there are fewer.
        kept: (Q,) correspondences near a peak, branch after branch.
        kept_starts: (B + 1,) where those of each branch begin.
        matrices: All node correspondence matrices, row by row, branch after branch.
        matrix_starts: (B + 1,) where each matrix begins.
        matrix_columns: Nodes of the query graph.
        maxima: (G, 3) row, column and value of the maxima; value 0 where there are fewer.
        contributions: (H, 3) x, y, theta of every hypothesis before clustering.
        contribution_starts: (G + 1,) where those of each group begin.
        in_cluster: (H,) whether the clustering step kept it for the centre of its group.
    """

    correspondences: Correspondences
    histograms: NDArray[np.int32]
    peaks: NDArray[np.float64]
    kept: NDArray[np.int64]
    kept_starts: NDArray[np.int64]
    matrices: NDArray[np.int32]
    matrix_starts: NDArray[np.int64]
    matrix_columns: int
    maxima: NDArray[np.int32]
    contributions: NDArray[np.float64]
    contribution_starts: NDArray[np.int64]
    in_cluster: NDArray[np.bool_]

    def matrix(self, branch: int) -> NDArray[np.int32]:
        """Return the (n, m) node correspondence matrix of a branch."""
        begin, end = self.matrix_starts[branch : branch + 2]
        return self.matrices[begin:end].reshape(-1, max(self.matrix_columns, 1))


def correspondences(
    graph: AnchorGraph, references: GraphStack, tolerance: float
) -> Correspondences:
    """Find all pairs of edges whose lengths differ by at most ``tolerance`` (metres)."""
    return Correspondences(
        *_correspondences(
            (references.lengths, references.directions, references.nodes, references.positions),
            references.edge_starts,
            (graph.lengths, graph.directions, graph.nodes, graph.anchors.positions),
            tolerance,
        )
    )


def align(graph: AnchorGraph, references: GraphStack, settings: AlignmentSettings) -> Alignment:
    """Align a graph with every candidate reference (section 4.2)."""
    candidates, poses, support, scatter = _aligned(*_arguments(graph, references, settings))
    return Alignment(candidates, poses, support, scatter, (graph, references, settings))


def _arguments(
    graph: AnchorGraph, references: GraphStack, settings: AlignmentSettings
) -> tuple[Any, ...]:
    """What the kernels ask for."""
    return (
        (graph.lengths, graph.nodes, graph.anchors.positions),
        (references.lengths, references.directions, references.nodes, references.positions),
        references.edge_starts,
        references.node_starts,
        (settings.length_tolerance, settings.turn_tolerance),
        (settings.histogram_bins, settings.histogram_peaks, settings.matrix_peaks),
        (settings.cluster_distance, settings.cluster_turn),
    )


# Squared distance, in units of the cluster's size, that is nothing but rounding.
_ROUNDING = 1e-12


@kernel
def _steps(graph, references, edge_starts, node_starts, tolerances, counts, size):  # type: ignore[no-untyped-def]
    """All steps: what ``AlignmentSteps`` and ``Alignment`` hold, in their order."""
    length_tolerance, turn_tolerance = tolerances
    bins, histogram_peaks, matrix_peaks = counts
    lengths, ends, points = graph
    positions = references[3]
    graph_with_directions = (lengths, bearings(points, ends), ends, points)
    pairs = _correspondences(references, edge_starts, graph_with_directions, length_tolerance)
    _, all_nodes, turns, starts = pairs
    histograms = _histograms(turns, starts, bins)
    peaks = _peaks(histograms, histogram_peaks, turn_tolerance)
    kept, kept_starts = _near_peaks(turns, starts, peaks, turn_tolerance)
    nodes = all_nodes[kept]
    columns = len(points)
    matrices, matrix_starts = _matrices(nodes, kept_starts, node_starts, columns, histogram_peaks)
    maxima = _maxima(matrices, matrix_starts, columns, matrix_peaks)
    contributions, group_starts = _contributions(
        nodes, kept_starts, maxima, positions, node_starts, points
    )
    centres, in_cluster = _clusters(contributions, group_starts, size)
    branches = np.arange(len(maxima)) // matrix_peaks
    sizes = group_starts[1:] - group_starts[:-1]
    distinct = _distinct(centres, sizes, branches // histogram_peaks, size)
    branches = branches[distinct]
    poses, support, scatter = _unified(
        nodes,
        kept_starts,
        positions,
        node_starts,
        points,
        centres[distinct],
        branches,
        size,
    )
    candidates = branches // histogram_peaks
    distinct = _distinct(poses, support, candidates, size)
    return (
        pairs,
        (histograms, peaks, kept, kept_starts, matrices, matrix_starts, columns),
        (maxima, contributions, group_starts, in_cluster),
        (candidates[distinct], poses[distinct], support[distinct], scatter[distinct]),
    )


@kernel
def _aligned(graph, references, edge_starts, node_starts, tolerances, counts, size):  # type: ignore[no-untyped-def]
    """What ``Alignment`` holds: each array that is handed back costs a microsecond."""
    return _steps(graph, references, edge_starts, node_starts, tolerances, counts, size)[3]


@kernel
def _correspondences(references, starts, graph, tolerance):  # type: ignore[no-untyped-def]
    """Pairs of edges of similar length: edges, nodes, turns modulo pi, start per candidate."""
    lengths, directions, nodes, _ = references
    others, bearings, ends, _ = graph
    pair_starts = np.zeros(len(starts), np.int64)
    pairs = np.int64(0)
    for c in range(len(starts) - 1):
        low = 0
        high = 0
        for e in range(starts[c], starts[c + 1]):
            while high < len(others) and others[high] - lengths[e] <= tolerance:
                high += 1
            while low < high and lengths[e] - others[low] > tolerance:
                low += 1
            pairs += high - low
        pair_starts[c + 1] = pairs
    edges = np.empty((pairs, 2), np.int32)
    both = np.empty((pairs, 4), np.int32)
    turns = np.empty(pairs)
    pair = 0
    for c in range(len(starts) - 1):
        low = 0
        for e in range(starts[c], starts[c + 1]):
            while low < len(others) and lengths[e] - others[low] > tolerance:
                low += 1
            f = low
            while f < len(others) and others[f] - lengths[e] <= tolerance:
                edges[pair, 0] = e
                edges[pair, 1] = f
                both[pair, 0] = nodes[e, 0]
                both[pair, 1] = nodes[e, 1]
                both[pair, 2] = ends[f, 0]
                both[pair, 3] = ends[f, 1]
                turns[pair] = _half_turn(directions[e] - bearings[f])
                pair += 1
                f += 1
    return edges, both, turns, pair_starts


@kernel
def _half_turn(angle):  # type: ignore[no-untyped-def]
    """Wrap an angle into [0, pi)."""
    angle -= math.pi * math.floor(angle / math.pi)
    return angle if angle < math.pi else 0.0


@kernel
def _histograms(turns, starts, bins):  # type: ignore[no-untyped-def]
    """(C, bins) frequencies of the angle differences of each candidate."""
    histograms = np.zeros((len(starts) - 1, bins), np.int32)
    for c in range(len(starts) - 1):
        for pair in range(starts[c], starts[c + 1]):
            histograms[c, min(int(turns[pair] / math.pi * bins), bins - 1)] += 1
    return histograms


@kernel
def _peaks(histograms, most, tolerance):  # type: ignore[no-untyped-def]
    """(C, most) centres of the fullest windows of twice the tolerance, fullest first."""
    candidates, bins = histograms.shape
    width = math.pi / bins
    reach = min(int(tolerance / width + 0.5), (bins - 1) // 2)
    peaks = np.full((candidates, most), np.nan)
    left = np.empty(bins, np.int64)
    for c in range(candidates):
        for k in range(bins):
            left[k] = histograms[c, k]
        for p in range(most):
            fullest = 0
            at = -1
            total = 0
            for k in range(-reach, reach + 1):
                total += left[k % bins]
            for k in range(bins):
                if total > fullest:
                    fullest = total
                    at = k
                total += left[(k + reach + 1) % bins] - left[(k - reach) % bins]
            if at < 0:
                break
            moment = 0.0
            for k in range(-reach, reach + 1):
                moment += k * left[(at + k) % bins]
            peaks[c, p] = _half_turn((at + 0.5 + moment / fullest) * width)
            for k in range(-reach, reach + 1):
                left[(at + k) % bins] = 0
    return peaks


@kernel
def _near_peaks(turns, starts, peaks, tolerance):  # type: ignore[no-untyped-def]
    """Correspondences within the tolerance of each peak, and where each branch begins."""
    candidates, most = peaks.shape
    kept = np.empty(len(turns) * most, np.int64)
    kept_starts = np.zeros(candidates * most + 1, np.int64)
    found = 0
    for c in range(candidates):
        for p in range(most):
            if peaks[c, p] == peaks[c, p]:
                for pair in range(starts[c], starts[c + 1]):
                    off = abs(turns[pair] - peaks[c, p])
                    if min(off, math.pi - off) <= tolerance:
                        kept[found] = pair
                        found += 1
            kept_starts[c * most + p + 1] = found
    return kept[:found].copy(), kept_starts


@kernel
def _matrices(nodes, kept_starts, node_starts, columns, most):  # type: ignore[no-untyped-def]
    """Node correspondence matrices: both assignments of every edge pair count."""
    branches = len(kept_starts) - 1
    matrix_starts = np.zeros(branches + 1, np.int64)
    for b in range(branches):
        rows = node_starts[b // most + 1] - node_starts[b // most]
        matrix_starts[b + 1] = matrix_starts[b] + rows * columns
    matrices = np.zeros(matrix_starts[branches], np.int32)
    for b in range(branches):
        matrix = matrices[matrix_starts[b] : matrix_starts[b + 1]]
        for pair in range(kept_starts[b], kept_starts[b + 1]):
            for row in (nodes[pair, 0], nodes[pair, 1]):
                matrix[row * columns + nodes[pair, 2]] += 1
                matrix[row * columns + nodes[pair, 3]] += 1
    return matrices, matrix_starts


@kernel
def _maxima(matrices, matrix_starts, columns, most):  # type: ignore[no-untyped-def]
    """(branches * most, 3) row, column and value of the largest elements of each matrix."""
    branches = len(matrix_starts) - 1
    maxima = np.zeros((branches * most, 3), np.int32)
    for b in range(branches):
        begin = b * most
        found = 0
        for element in range(matrix_starts[b], matrix_starts[b + 1]):
            value = matrices[element]
            if value == 0 or (found == most and value <= maxima[begin + most - 1, 2]):
                continue
            k = begin + min(found, most - 1)
            while k > begin and maxima[k - 1, 2] < value:
                for column in range(3):
                    maxima[k, column] = maxima[k - 1, column]
                k -= 1
            at = element - matrix_starts[b]
            maxima[k, 0] = at // columns
            maxima[k, 1] = at % columns
            maxima[k, 2] = value
            found = min(found + 1, most)
    return maxima


@kernel
def _contributions(nodes, kept_starts, maxima, positions, node_starts, points):  # type: ignore[no-untyped-def]
    """The alignment that each edge pair behind a maximum means, and where each group begins."""
    groups = len(maxima)
    branches = len(kept_starts) - 1
    starts = np.zeros(groups + 1, np.int64)
    for g in range(groups):
        starts[g + 1] = starts[g] + maxima[g, 2]
    poses = np.empty((starts[groups], 3))
    for g in range(groups):
        b = g * branches // groups
        offset = node_starts[b * (len(node_starts) - 1) // branches]
        row, column, value = maxima[g, 0], maxima[g, 1], maxima[g, 2]
        at = starts[g]
        if value == 0:
            continue
        for pair in range(kept_starts[b], kept_starts[b + 1]):
            i, k = nodes[pair, 0], nodes[pair, 1]
            j, l = nodes[pair, 2], nodes[pair, 3]  # noqa: E741
            if row not in (i, k) or column not in (j, l):
                continue
            if i != row:
                i, k = k, i
            if j != column:
                j, l = l, j  # noqa: E741
            poses[at, 0], poses[at, 1], poses[at, 2] = _lay(
                positions[offset + i], positions[offset + k], points[j], points[l]
            )
            at += 1
    return poses, starts


@kernel
def _lay(a, b, v, w):  # type: ignore[no-untyped-def]
    """The motion that lays the direction of v-w on that of a-b, and middle on middle."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    ex, ey = w[0] - v[0], w[1] - v[1]
    c, s = ex * dx + ey * dy, ex * dy - ey * dx
    norm = math.sqrt(c * c + s * s)
    if norm > 0.0:
        c, s = c / norm, s / norm
    else:
        c, s = 1.0, 0.0
    mx, my = 0.5 * (v[0] + w[0]), 0.5 * (v[1] + w[1])
    x = 0.5 * (a[0] + b[0]) - c * mx + s * my
    y = 0.5 * (a[1] + b[1]) - s * mx - c * my
    return x, y, math.atan2(s, c)


@kernel
def _turn(angle):  # type: ignore[no-untyped-def]
    """Wrap an angle into [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@kernel
def _clusters(poses, starts, size):  # type: ignore[no-untyped-def]
    """Cluster the hypotheses of each group: centre, and membership of the hypotheses."""
    groups = len(starts) - 1
    centres = np.zeros((groups, 3))
    member = np.zeros(len(poses), np.bool_)
    for g in range(groups):
        group = poses[starts[g] : starts[g + 1]]
        inside = member[starts[g] : starts[g + 1]]
        if len(group) > 0:
            densest = _densest(group, size)
            for k in range(3):
                centres[g, k] = group[densest, k]
            for _ in range(2):
                _gather(group, centres[g], size, inside)
                _centre(group, inside, centres[g])
    return centres, member


@kernel
def _unified(nodes, kept_starts, positions, node_starts, points, centres, branches, size):  # type: ignore[no-untyped-def]
    """Centre of gravity of all correspondences that mean each alignment; number, scatter."""
    peaks = max((len(kept_starts) - 1) // max(len(node_starts) - 1, 1), 1)
    unified = centres.copy()
    support = np.zeros(len(centres), np.int64)
    scatter = np.zeros((len(centres), 3, 3))
    for n in range(len(centres)):
        begin, end = kept_starts[branches[n]], kept_starts[branches[n] + 1]
        offset = node_starts[branches[n] // peaks]
        group = _agreeing(nodes[begin:end], positions[offset:], points, centres[n], size)
        if len(group) == 0:
            continue
        inside = np.zeros(len(group), np.bool_)
        mean = unified[n]
        for k in range(3):
            mean[k] = np.median(group[:, k])
        for _ in range(2):
            _gather(group, mean, size, inside)
            support[n] = _centre(group, inside, mean)
        _spread(group, inside, mean, scatter[n])
        mean[2] = _turn(mean[2])
    return unified, support, scatter


@kernel
def _agreeing(nodes, positions, points, centre, size):  # type: ignore[no-untyped-def]
    """The hypotheses of edge pairs that are close to a centre; theta not wrapped, near its."""
    group = np.empty((len(nodes), 3))
    found = 0
    cos, sin = math.cos(centre[2]), math.sin(centre[2])
    for pair in range(len(nodes)):
        a, b = positions[nodes[pair, 0]], positions[nodes[pair, 1]]
        v, w = points[nodes[pair, 2]], points[nodes[pair, 3]]
        # Of the two assignments only the one that turns about as the centre can be close.
        dx, dy, ex, ey = b[0] - a[0], b[1] - a[1], w[0] - v[0], w[1] - v[1]
        along = cos * (ex * dx + ey * dy) + sin * (ex * dy - ey * dx)
        x, y, theta = _lay(a, b, v, w) if along >= 0.0 else _lay(a, b, w, v)
        group[found, 0] = x
        group[found, 1] = y
        group[found, 2] = centre[2] + _turn(theta - centre[2])
        if _apart(group[found], centre, size) <= 1.0:
            found += 1
    return group[:found]


@kernel
def _apart(pose, other, size):  # type: ignore[no-untyped-def]
    """Squared distance of two alignments; one is the border of what belongs together."""
    dx, dy = (pose[0] - other[0]) / size[0], (pose[1] - other[1]) / size[0]
    dt = _turn(pose[2] - other[2]) / size[1]
    return dx * dx + dy * dy + dt * dt


@kernel
def _densest(group, size):  # type: ignore[no-untyped-def]
    """Index of the hypothesis around which the others lie most densely."""
    highest = 0.0
    densest = 0
    for i in range(len(group)):
        density = 0.0
        for j in range(len(group)):
            density += max(0.0, 1.0 - _apart(group[j], group[i], size))
        if density > highest:
            highest = density
            densest = i
    return densest


@kernel
def _gather(group, mean, size, inside):  # type: ignore[no-untyped-def]
    """Mark what belongs to a centre, less what is far off for how close most of it is."""
    apart = np.empty(len(group))
    near = 0
    for i in range(len(group)):
        off = _apart(group[i], mean, size)
        inside[i] = off <= 1.0
        if inside[i]:
            apart[near] = off
            near += 1
    if near == 0:
        return
    # Three times the median distance; squared, with some slack for rounding.
    limit = 9.0 * np.median(apart[:near]) + _ROUNDING
    for i in range(len(group)):
        inside[i] = _apart(group[i], mean, size) <= min(limit, 1.0)


@kernel
def _centre(group, inside, mean):  # type: ignore[no-untyped-def]
    """Move ``mean`` to the centre of gravity of those inside, and count them."""
    size = 0
    x, y, t = 0.0, 0.0, 0.0
    for i in range(len(group)):
        if inside[i]:
            x += group[i, 0]
            y += group[i, 1]
            t += _turn(group[i, 2] - mean[2])
            size += 1
    if size > 0:
        mean[0] = x / size
        mean[1] = y / size
        mean[2] = _turn(mean[2] + t / size)
    return size


@kernel
def _spread(group, inside, mean, scatter):  # type: ignore[no-untyped-def]
    """Add the covariance of those inside to ``scatter``."""
    size = np.sum(inside)
    for i in range(len(group)):
        if inside[i]:
            d = group[i] - mean
            d[2] = _turn(d[2])
            for m in range(3):
                for n in range(3):
                    scatter[m, n] += d[m] * d[n] / size


@kernel
def _distinct(poses, support, candidates, size):  # type: ignore[no-untyped-def]
    """Alignments that differ, candidate after candidate, the best supported of equals."""
    chosen = np.empty(len(poses), np.int64)
    found = 0
    end = 0
    while end < len(poses):
        begin, first = end, found
        while end < len(poses) and candidates[end] == candidates[begin]:
            end += 1
        for k in best_first(support[begin:end], end - begin):
            n = begin + k
            new = support[n] > 0
            for other in chosen[first:found]:
                if _apart(poses[n], poses[other], size) <= 1.0:
                    new = False
            if new:
                chosen[found] = n
                found += 1
    return chosen[:found].copy()
