"""A trace as pictures: the paper's figures 1 to 5 drawn from any real scan, and what we add."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .anchors import AnchorKind, AnchorPoints, VirtualEdges
from .angle_function import AngleFunction
from .description import Description
from .drawing import (
    DARK,
    LIGHT,
    Bounds,
    Theme,
    anchor_marks,
    color_of,
    legend,
    line,
    mark,
    new_figure,
    nothing_to_draw,
    number_anchors,
    plot_anchor,
    plot_anchors,
    plot_edges,
    plot_map,
    plot_scan,
    plot_sensor,
    ramp,
    require_matplotlib,
    ruler,
    save,
    style,
    view,
)
from .explanation import (
    Comparison,
    Explanation,
    Pairing,
    Reading,
    bounds_of,
    ellipse,
    map_at,
    picture_of_map,
    wall_points,
)
from .hypothesis import state_of
from .pose import Pose2D
from .scan import LaserScan
from .stitched_map import MapSearch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

__all__ = ["FORMATS", "PICTURES", "THEMES", "draw", "save_all"]

FORMATS = ("png", "svg", "pdf")
THEMES = {theme.name: theme for theme in (LIGHT, DARK)}

_VERDICTS = {"located": "accepted", "ambiguous": "one of several alike", "unknown": "“not known”"}
_DASHED = (0, (4, 3))
_MOST_VOTES = 12
_MOST_FITS = 9
_MOST_NUMBERS = 30
# Percent of a scan's readings that may lie outside its picture, on each side.
_STRAY = 2.5
# Anchor points that an answer lays no farther apart are taken for the same, metres.
_ONE_THING = 0.3
# A reading so near to a surface of the map lies on it, metres.
_ON_SURFACE = 0.2
# Height of a map, inches, and how wide it may become.
_MAP_HEIGHT = 4.4
_MAP_WIDTH = (3.4, 8.0)
_PANEL_HEIGHT = (2.6, 5.0)
# A histogram of half a turn is shown around zero where its peak is this near to it, degrees.
_NEAR_ZERO = 30.0


def draw(explanation: Explanation, name: str, theme: Theme = LIGHT) -> Figure:
    """Draw one picture.

    Args:
        explanation: What to show.
        name: One of ``PICTURES``.
        theme: Colours.

    Raises:
        KeyError: There is no such picture.
        MissingExtraError: matplotlib is not installed.
    """
    require_matplotlib()
    import matplotlib

    with matplotlib.rc_context(style(theme)):
        return PICTURES[name](explanation, theme)


def save_all(
    explanation: Explanation,
    folder: Path,
    themes: Iterable[Theme] = (LIGHT,),
    file_format: str = "png",
) -> list[Path]:
    """Draw every picture that the trace has something for, and write them.

    Args:
        explanation: What to show.
        folder: Made when it is missing.
        themes: A picture in each; the name of a dark one ends in ``-dark``.
        file_format: One of ``FORMATS``.

    Returns:
        The files, in the order of the algorithm.

    Raises:
        MissingExtraError: matplotlib is not installed.
        OSError: A file cannot be written.
    """
    require_matplotlib()
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name in PICTURES:
        if name == _PROPOSALS and explanation.trace.in_map is None:
            continue
        for theme in themes:
            suffix = "" if theme.name == "light" else f"-{theme.name}"
            path = folder / f"{name}{suffix}.{file_format}"
            save(draw(explanation, name, theme), path)
            files.append(path)
    return files


# The pictures, in the order of the algorithm


def _draw_angle_function(explanation: Explanation, theme: Theme) -> Figure:
    """Figure 1 of the paper: the scan and its anchor points beside its angle function."""
    known = explanation.trace.description
    anchors = known.anchors
    bounds = bounds_of(known.angles.points, _with_sensor(anchors.positions), _STRAY)
    title = "Sections 2 and 3: angle function and anchor points"
    figure = new_figure((11.0, _height(bounds, 4.8) + 1.1), title)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.25))
    plot_scan(left, known, theme, theme.scan)
    plot_anchors(left, anchors, theme, directions=True)
    view(left, bounds)
    ruler(left, theme)
    left.set_title("the scan: what belongs to one large surface is joined")
    _plot_angle_function(right, known, theme)
    right.set_title("its angle function: a wall is level, a curve a ramp, an angle a step")
    legend(
        figure,
        [
            *anchor_marks([anchors], theme),
            line(theme.soft, "needle: towards the free space before it", width=1.0),
        ],
    )
    return figure


def _plot_angle_function(axes: Axes, known: Description, theme: Theme) -> None:
    """Draw the direction of the surface over that of the beam, with the anchor points above."""
    angles, anchors = known.angles, known.anchors
    bearing = np.degrees(angles.beams)
    surface = np.degrees(np.mod(angles.surface, math.pi))
    large = np.zeros(len(bearing), np.bool_)
    for first, last in zip(known.surfaces.first, known.surfaces.last, strict=True):
        large[first : last + 1] = True
    axes.plot(bearing[~large], surface[~large], ".", ms=3, color=theme.soft)
    axes.plot(bearing[large], surface[large], ".", ms=3.5, color=theme.scan)
    axes.set_ylim(-6.0, 196.0)
    axes.set_yticks(range(0, 181, 45))
    _over_beams(axes, bearing)
    axes.set_ylabel("direction of the surface, degrees")
    for kind, (x, y) in zip(anchors.kinds.tolist(), anchors.positions.tolist(), strict=True):
        if kind != AnchorKind.VIRTUAL_EDGE:
            at = math.degrees(_bearing(x, y, float(angles.beams[0])))
            axes.axvline(at, color=color_of(kind, theme), lw=0.8, alpha=0.7, zorder=0)
            plot_anchor(axes, at, 189.0, kind, theme)


def _draw_virtual_edges(explanation: Explanation, theme: Theme) -> Figure:
    """Figure 2 of the paper: x- and y-histograms, and the virtual edges that they make."""
    known = explanation.trace.description
    settings = explanation.trace.settings.anchors
    shown = known.edges[:2]
    title = "Section 3: virtual edge anchor points"
    if not shown:
        figure = new_figure((7.6, 3.0), title)
        nothing_to_draw(figure.subplots(), "No surface of this scan tells a main angle.", theme)
        return figure
    bounds = [_bounds_of_walls(known.angles, edges) for edges in shown]
    height = 1.25 * max(_height(each, 6.0) for each in bounds) + 1.2
    figure = new_figure((7.6 * len(shown), height), title)
    panels = np.atleast_1d(np.array(figure.subplots(1, len(shown)), dtype=object))
    for axes, edges, around in zip(panels, shown, bounds, strict=True):
        _plot_walls(axes, known.angles, edges, settings.wall_angle, theme)
        view(axes, around)
        ruler(axes, theme)
    sides = "; pale: seen from the other side" if settings.facing else ""
    legend(
        figure,
        [
            mark("s", theme.scan, "surface that runs across x"),
            mark("s", theme.reference, f"surface that runs across y{sides}"),
            mark("P", theme.virtual, "virtual edge"),
        ],
    )
    return figure


def _plot_walls(
    axes: Axes, angles: AngleFunction, edges: VirtualEdges, wall_angle: float, theme: Theme
) -> None:
    """Draw the scan in the frame of its walls, with a histogram along either axis."""
    T_wall_scan = Pose2D(0.0, 0.0, -edges.main_angle)
    points = T_wall_scan.apply(angles.points)
    with np.errstate(invalid="ignore"):
        normal = angles.surface + 0.5 * math.pi - edges.main_angle
        across_x = np.abs(np.cos(normal)) >= math.cos(wall_angle)
        across_y = np.abs(np.sin(normal)) >= math.cos(wall_angle)
    axes.plot(*points[~across_x & ~across_y].T, ".", ms=3, color=theme.soft)
    axes.plot(*points[across_x].T, ".", ms=4, color=theme.scan)
    axes.plot(*points[across_y].T, ".", ms=4, color=theme.reference)
    axes.plot(
        *_crossings(edges).T, "P", ms=9, color=theme.virtual, mec=theme.paper, mew=0.8, zorder=5
    )
    plot_sensor(axes, T_wall_scan, theme, theme.scan)
    above, aside = _plot_histograms(axes, edges, theme)
    for wall in edges.x_walls[:, 0]:
        for each in (axes, above):
            each.axvline(wall, ls=_DASHED, lw=0.9, color=theme.virtual, zorder=1)
    for wall in edges.y_walls[:, 0]:
        for each in (axes, aside):
            each.axhline(wall, ls=_DASHED, lw=0.9, color=theme.virtual, zorder=1)
    above.set_title(
        f"main angle {math.degrees(edges.main_angle):.1f} degrees; metres of surface over x and y"
    )


def _crossings(edges: VirtualEdges) -> NDArray[np.float64]:
    """(C, 2) virtual edges in the frame of the walls, metres."""
    x, y = np.meshgrid(edges.x_walls[:, 0], edges.y_walls[:, 0])
    return np.column_stack((x.ravel(), y.ravel()))


def _bounds_of_walls(angles: AngleFunction, edges: VirtualEdges) -> Bounds:
    points = Pose2D(0.0, 0.0, -edges.main_angle).apply(angles.points)
    return bounds_of(points, _with_sensor(_crossings(edges)), _STRAY)


def _plot_histograms(axes: Axes, edges: VirtualEdges, theme: Theme) -> tuple[Axes, Axes]:
    """Draw the x-histogram above a panel and the y-histogram beside it."""
    above = axes.inset_axes((0.0, 1.02, 1.0, 0.22), sharex=axes)
    aside = axes.inset_axes((1.02, 0.0, 0.22, 1.0), sharey=axes)
    centres = edges.origin + (np.arange(edges.histograms.shape[2]) + 0.5) * edges.bin_width
    for side, alpha in ((0, 1.0), (1, 0.55)):
        under = edges.histograms[:, :side].sum(axis=1)
        look: dict[str, Any] = {"alpha": alpha, "linewidth": 0.0}
        x, y = edges.histograms[0, side], edges.histograms[1, side]
        above.bar(centres, x, edges.bin_width, under[0], color=theme.scan, **look)
        aside.barh(centres, y, edges.bin_width, under[1], color=theme.reference, **look)
    above.tick_params(labelbottom=False)
    aside.tick_params(labelleft=False)
    return above, aside


def _draw_votes(explanation: Explanation, theme: Theme) -> Figure:
    """Section 4.1, on a map: how many relations each reference shares with the scan."""
    bounds = _bounds_of_set(explanation)
    wide = _map_width(bounds)
    title = "Section 4.1: votes of the relationship database"
    figure = new_figure((wide + 5.4, _MAP_HEIGHT + 1.1), title)
    left, right = figure.subplots(1, 2, width_ratios=(wide + 0.6, 4.0))
    if any(each.pose is not None for each in explanation.references):
        left.plot(
            *wall_points(explanation.references).T, ",", color=theme.soft, alpha=0.7, zorder=1
        )
        _plot_quality(figure, left, explanation, theme)
        _plot_answer(left, explanation, theme)
        view(left, bounds)
        ruler(left, theme)
        left.set_title("quality q of every reference scan, where it was taken")
        legend(figure, _answer_marks(explanation, theme))
    else:
        nothing_to_draw(left, "The references have no poses in a common frame.", theme)
    _plot_best_votes(right, explanation, theme)
    return figure


def _plot_quality(figure: Figure, axes: Axes, explanation: Explanation, theme: Theme) -> None:
    """Draw every reference at its pose, coloured by its quality."""
    votes = explanation.votes
    worth = dict(zip(votes.references.tolist(), votes.quality.tolist(), strict=True))
    placed = [
        (worth.get(each.identifier, 0.0), each.pose.x, each.pose.y)
        for each in explanation.references
        if each.pose is not None
    ]
    quality, x, y = np.array(sorted(placed)).T
    dots = axes.scatter(
        x,
        y,
        s=14.0 + 60.0 * quality / max(float(quality.max()), 1e-9),
        c=quality,
        cmap=ramp(theme),
        vmin=0.0,
        linewidths=0.4,
        edgecolors=theme.soft,
        zorder=3,
    )
    _plot_scale(figure, axes, dots, "q")


def _plot_best_votes(axes: Axes, explanation: Explanation, theme: Theme) -> None:
    """Bars of the references of the highest quality, and of that of the answer."""
    votes, answer = explanation.votes, explanation.trace.hypotheses[0].reference
    rank = np.flatnonzero(votes.references == answer)
    rows = list(range(min(len(votes), _MOST_VOTES)))
    if not rows:
        nothing_to_draw(axes, "No relation of this scan\nis in the database.", theme)
        return
    if len(rank) and rank[0] >= _MOST_VOTES:
        rows[-1] = int(rank[0])
    _plot_bars(
        axes,
        votes.quality[rows],
        [f"{row + 1}.  reference {votes.references[row]}" for row in rows],
        [f"n = {votes.counts[row]:.3g}" for row in rows],
        [int(votes.references[row]) == answer for row in rows],
        theme,
    )
    axes.margins(x=0.22)
    is_weighed = bool((votes.counts[rows] % 1.0).any())
    axes.set_xlabel(f"q (n: votes{', rare ones count more' if is_weighed else ''})")
    place = f"rank {rank[0] + 1} of {len(votes)}" if len(rank) else "no vote"
    axes.set_title(f"the answer's reference has {place}")


def _draw_graphs(explanation: Explanation, theme: Theme) -> Figure:
    """Figures 3 and 4 of the paper: both anchor graphs, with the edges that correspond."""
    pairing, ours = explanation.pairing, explanation.trace.description
    theirs = pairing.description
    bounds = bounds_of(
        np.concatenate([theirs.angles.points, ours.angles.points]),
        _with_sensor(np.concatenate([theirs.anchors.positions, ours.anchors.positions])),
        _STRAY,
    )
    title = "Section 4: two anchor graphs and the edges they share"
    figure = new_figure((11.0, _height(bounds, 5.2) + 1.2), title)
    left, right = figure.subplots(1, 2)
    name = f"reference {pairing.reference.identifier}"
    _plot_graph(left, theirs, pairing.edges[:, 0], name, theme.reference, theme)
    _plot_graph(right, ours, pairing.edges[:, 1], "scan", theme.scan, theme)
    for axes, anchors in ((left, theirs.anchors), (right, ours.anchors)):
        view(axes, bounds)
        number_anchors(axes, anchors, theme)
        ruler(axes, theme)
    _connect(figure, left, right, pairing, ours.anchors, theme)
    legend(
        figure,
        [
            *anchor_marks([theirs.anchors, ours.anchors], theme),
            line(theme.ink, "edges that the alignment lays on one another"),
            line(theme.angle, "the same thing, by the answer", width=0.8),
        ],
    )
    return figure


def _plot_graph(
    axes: Axes,
    known: Description,
    shared: NDArray[np.int64],
    name: str,
    color: str,
    theme: Theme,
) -> None:
    """Draw a scan and its anchor graph, the shared edges heavy."""
    shared = np.unique(shared)
    plot_scan(axes, known, theme, color)
    plot_edges(axes, known.graph, np.arange(len(known.graph)), theme.faint, 0.6)
    plot_edges(axes, known.graph, shared, theme.ink, 1.5)
    plot_anchors(axes, known.anchors, theme)
    axes.set_title(
        f"{name}: {len(known.anchors)} anchor points, {len(known.graph)} edges, "
        f"{len(shared)} shared"
    )


def _connect(
    figure: Figure, left: Axes, right: Axes, pairing: Pairing, anchors: AnchorPoints, theme: Theme
) -> None:
    """Join anchor points of both graphs that the answer lays on one another."""
    from matplotlib.patches import ConnectionPatch

    for theirs, ours in _same_things(pairing, anchors):
        joint = ConnectionPatch(
            tuple(pairing.description.anchors.positions[theirs]),
            tuple(anchors.positions[ours]),
            "data",
            "data",
            axesA=left,
            axesB=right,
            color=theme.angle,
            lw=0.8,
            alpha=0.7,
        )
        joint.set_in_layout(False)
        figure.add_artist(joint)


def _draw_matching_angles(explanation: Explanation, theme: Theme) -> Figure:
    """Figure 4 of the paper: the matching angle histogram."""
    pairing, settings = explanation.pairing, explanation.trace.settings.alignment
    steps = pairing.alignment.steps
    counts = steps.histograms[0]
    width = 180.0 / len(counts)
    centres = (np.arange(len(counts)) + 0.5) * width
    peak = math.degrees(steps.peaks[0, 0])
    off = np.abs(centres - peak)
    chosen = np.minimum(off, 180.0 - off) <= math.degrees(settings.turn_tolerance)
    turn = math.degrees(pairing.hypothesis.pose_in_reference.theta) % 180.0
    # The half turn is cut open where the peak is not.
    low = -90.0 if min(peak, 180.0 - peak) < _NEAR_ZERO else 0.0
    centres, turn = low + (centres - low) % 180.0, low + (turn - low) % 180.0

    figure = new_figure((8.0, 4.2), "Section 4.2: matching angle histogram")
    axes = figure.subplots()
    axes.bar(centres[~chosen], counts[~chosen], width, color=theme.soft)
    axes.bar(centres[chosen], counts[chosen], width, color=theme.scan)
    axes.axvline(turn, color=theme.angle, ls=_DASHED, lw=1.6)
    axes.set_xlim(low, low + 180.0)
    axes.set_xticks(np.arange(low, low + 181.0, 30.0))
    _whole_numbers(axes)
    axes.set_xlabel("angle between corresponding edges, modulo 180 degrees")
    axes.set_ylabel("pairs of edges")
    axes.set_title(
        f"{len(steps.correspondences)} pairs correspond in length, "
        f"{int(counts[chosen].sum())} of them at the peak; the others are ruled out"
    )
    legend(
        figure,
        [
            mark("s", theme.scan, "at the peak"),
            mark("s", theme.soft, "ruled out"),
            line(theme.angle, "turn of the answer", dashed=True),
        ],
    )
    return figure


def _draw_matrix(explanation: Explanation, theme: Theme) -> Figure:
    """Figure 3 of the paper: the node correspondence matrix."""
    pairing, anchors = explanation.pairing, explanation.trace.description.anchors
    figure = new_figure((7.4, 6.4), "Section 4.2: node correspondence matrix")
    axes = figure.subplots()
    if not len(pairing.description.anchors) or not len(anchors):
        nothing_to_draw(axes, "One of the two scans has no anchor point.", theme)
        return figure
    matrix = pairing.alignment.steps.matrix(0)
    image = axes.imshow(matrix, cmap=ramp(theme), vmin=0, interpolation="nearest", aspect="equal")
    _plot_scale(figure, axes, image, "pairs of edges")
    size = min(18.0, 260.0 / max(matrix.shape))
    for theirs, ours in _same_things(pairing, anchors):
        axes.plot(ours, theirs, "o", ms=size, mfc="none", mec=theme.angle, mew=2.0)
    if pairing.maximum is not None:
        row, column, _ = pairing.maximum
        axes.plot(column, row, "s", ms=size + 5, mfc="none", mec=theme.jump, mew=2.2)
    if max(matrix.shape) <= _MOST_NUMBERS:
        _number_cells(axes, matrix, theme)
    _whole_numbers(axes, x=True)
    axes.set_xlabel("anchor point of the scan")
    axes.set_ylabel(f"anchor point of reference {pairing.reference.identifier}")
    is_tall = matrix.shape[0] > 1.5 * matrix.shape[1]
    axes.set_title(
        "how many pairs of edges would lay one on the other", loc="right" if is_tall else "left"
    )
    legend(
        figure,
        [
            mark("s", theme.jump, "maximum", hollow=True),
            mark("o", theme.angle, "the same thing, by the answer", hollow=True),
        ],
    )
    return figure


def _number_cells(axes: Axes, matrix: NDArray[np.int32], theme: Theme) -> None:
    """Write the counts into the cells, light on dark and dark on light."""
    half = 0.5 * matrix.max()
    for row, column in np.argwhere(matrix > 0).tolist():
        color = theme.paper if matrix[row, column] > half else theme.ink
        axes.text(
            column, row, str(matrix[row, column]), ha="center", va="center", fontsize=7, color=color
        )


def _draw_overlay(explanation: Explanation, theme: Theme) -> Figure:
    """Section 5: both scans after alignment, the synthetic scan, and what agrees."""
    comparison = explanation.comparison
    e_m, overview = comparison.evaluation.e_m, comparison.evaluation.overview
    front = "scan" if overview == "reference" else "reference"
    bounds = _bounds_of_both(explanation)
    height = _height(bounds, 5.2) + 1.2
    figure = new_figure((11.0, height), "Section 5: evaluation by a synthetic scan")
    left, right = figure.subplots(1, 2)
    _plot_both_scans(left, explanation, theme)
    view(left, bounds)
    ruler(left, theme)
    left.set_title(f"squares: the {overview}, with the better overview\ndots: the {front}")
    _plot_ranges(right, comparison, theme)
    right.set_title(f"beams of the {front}: a share e = {e_m:.2f} of its readings agrees")
    counts = np.bincount(comparison.readings, minlength=len(Reading))
    legend(
        figure,
        [
            *(
                mark(shape, color, f"{words}: {counts[kind]}")
                for kind, (shape, color, words) in _reading_marks(theme).items()
                if counts[kind]
            ),
            line(theme.ink, "synthetic scan", width=1.0),
        ],
    )
    return figure


def _plot_both_scans(axes: Axes, explanation: Explanation, theme: Theme) -> None:
    """Draw the overview and, over it, the readings of the front scan by what they say."""
    comparison, best = explanation.comparison, explanation.trace.hypotheses[0]
    below = _overview_points(explanation)
    axes.plot(*below.T, "s", ms=4.5, color=theme.faint, mec=theme.soft, mew=0.5, zorder=1)
    ends = _ends(comparison.front, comparison.T_reference_front)
    made = _ends(comparison.evaluation.synthetic, comparison.T_reference_front)
    # A ray that sees through, from the surface that should have stopped it.
    for n in np.flatnonzero(comparison.readings == Reading.THROUGH):
        axes.plot(*np.stack([made[n], ends[n]]).T, "-", color=theme.virtual, lw=0.6, zorder=2)
    _plot_readings(axes, ends, comparison.readings, theme)
    plot_sensor(axes, Pose2D(), theme, theme.reference, f"reference {best.reference}", below=True)
    plot_sensor(axes, best.pose_in_reference, theme, theme.scan, "scan")


def _overview_points(explanation: Explanation) -> NDArray[np.float64]:
    """(V, 2) points of the scan with the better overview, metres, reference's frame."""
    best = explanation.trace.hypotheses[0]
    if explanation.comparison.evaluation.overview == "reference":
        return explanation.trace.reference(best.reference).scan.points
    return best.pose_in_reference.apply(explanation.trace.scan.points)


def _bounds_of_both(explanation: Explanation) -> Bounds:
    """Give the rectangle that both scans lie in, in the reference's frame."""
    front, T_reference_front = (
        explanation.comparison.front,
        explanation.comparison.T_reference_front,
    )
    both = np.concatenate([_overview_points(explanation), T_reference_front.apply(front.points)])
    T_reference_scan = explanation.trace.hypotheses[0].pose_in_reference
    lasers = _with_sensor(np.array([[T_reference_scan.x, T_reference_scan.y]]))
    return bounds_of(both, lasers, _STRAY)


def _plot_ranges(axes: Axes, comparison: Comparison, theme: Theme) -> None:
    """Draw the front scan's readings over their directions, and the synthetic scan."""
    bearing = np.degrees(comparison.front.angles)
    ranges = comparison.front.ranges.astype(np.float64)
    axes.plot(bearing, comparison.evaluation.synthetic.ranges, "-", color=theme.ink, lw=1.0)
    _plot_readings(axes, np.column_stack((bearing, ranges)), comparison.readings, theme)
    shown = ranges[comparison.front.is_return]
    if len(shown):
        axes.set_ylim(0.0, 1.15 * float(np.percentile(shown, 98.0)))
    _over_beams(axes, bearing)
    axes.set_ylabel("range, metres")


def _plot_readings(
    axes: Axes, where: NDArray[np.float64], readings: NDArray[np.int64], theme: Theme
) -> None:
    """Draw readings by what they say."""
    for kind, (shape, color, _) in _reading_marks(theme).items():
        size = 4.8 if shape == "X" else 3.6
        axes.plot(*where[readings == kind].T, shape, ms=size, color=color, mec="none", zorder=3)


def _reading_marks(theme: Theme) -> dict[Reading, tuple[str, str, str]]:
    return {
        Reading.AGREES: ("o", theme.angle, "agrees"),
        Reading.NEARER: ("X", theme.jump, "something is nearer"),
        Reading.THROUGH: ("D", theme.virtual, "sees through"),
        Reading.UNSEEN: (".", theme.soft, "not in the overview"),
    }


_PROPOSALS = "8-proposals"


def _draw_proposals(explanation: Explanation, theme: Theme) -> Figure:
    """Beyond the paper: proposals and fits on the map stitched from all references."""
    title = "Beyond the paper: proposals and fits in the stitched map"
    if explanation.trace.in_map is None or explanation.field is None:
        figure = new_figure((7.0, 3.0), title)
        words = "This scan was not searched in a stitched map."
        nothing_to_draw(figure.subplots(), words, theme)
        return figure
    bounds = _bounds_of_set(explanation)
    wide = _map_width(bounds)
    figure = new_figure((wide + 7.6, _MAP_HEIGHT + 1.0), title)
    left, middle, right = figure.subplots(1, 3, width_ratios=(wide, 4.4, 2.4))
    plot_map(left, picture_of_map(explanation.field, bounds), theme)
    _plot_search(left, explanation.trace.in_map, theme)
    _plot_truth(left, explanation, theme)
    view(left, bounds)
    ruler(left, theme)
    _plot_fit(middle, explanation, theme)
    _plot_worth(right, explanation.trace.in_map, theme)
    handles = [
        mark("o", theme.virtual, "proposal that passed the first check"),
        mark("^", theme.reference, "best fit"),
        mark("^", theme.ink, "other fits", hollow=True),
        mark("o", theme.angle, "reading on a surface"),
        mark("X", theme.jump, "reading in free space"),
    ]
    if explanation.truth is not None:
        handles.append(mark("o", theme.angle, "pose in the log", hollow=True))
    legend(figure, handles)
    return figure


def _plot_search(axes: Axes, search: MapSearch, theme: Theme) -> None:
    """Draw proposals, and the best fits by rank."""
    kept = search.proposals.poses
    axes.plot(kept[:, 0], kept[:, 1], "o", ms=2.8, color=theme.virtual, mec="none", zorder=3)
    for rank, values in reversed(list(enumerate(search.fits.poses[:_MOST_FITS].tolist(), start=1))):
        pose = Pose2D(*values)
        plot_sensor(axes, pose, theme, theme.reference if rank == 1 else theme.paper, str(rank))
    axes.set_title(f"{search.proposals.proposed:,} proposals, {len(kept)} passed the first check")


def _plot_fit(axes: Axes, explanation: Explanation, theme: Theme) -> None:
    """Draw the scan at the best fit over the map around it."""
    assert explanation.field is not None
    best = explanation.trace.hypotheses[0]
    pose = best.pose or Pose2D()
    points = pose.apply(explanation.trace.description.angles.points)
    bounds = bounds_of(points, np.array([[pose.x, pose.y]]), _STRAY)
    plot_map(axes, picture_of_map(explanation.field, bounds), theme, shaded=True)
    distance, is_free = map_at(explanation.field, points)
    near = distance <= _ON_SURFACE
    contrary = ~near & is_free
    unknown = ~near & ~is_free
    for chosen, shape, color in (
        (near, "o", theme.angle),
        (contrary, "X", theme.jump),
        (unknown, "s", theme.soft),
    ):
        axes.plot(*points[chosen].T, shape, ms=4, color=color, mec=theme.paper, mew=0.3, zorder=4)
    axes.plot(*ellipse(pose, best.covariance).T, "-", color=theme.scan, lw=1.4, zorder=5)
    plot_sensor(axes, pose, theme, theme.reference)
    _plot_truth(axes, explanation, theme)
    view(axes, bounds)
    ruler(axes, theme)
    axes.set_title("the scan at the best fit")
    axes.set_xlabel(
        f"readings: {near.sum()} on surfaces, {contrary.sum()} in free space, "
        f"{unknown.sum()} unknown",
        fontsize=8,
    )


def _plot_worth(axes: Axes, search: MapSearch, theme: Theme) -> None:
    """Bars of the fits' scores, with what they are worth."""
    scores = search.fits.features[:_MOST_FITS, 0]
    _plot_bars(
        axes,
        np.maximum(scores, 0.0),
        [str(rank) for rank in range(1, len(scores) + 1)],
        [f"p = {worth:.3f}" for worth in search.decision.probabilities[: len(scores)]],
        [rank == 0 for rank in range(len(scores))],
        theme,
    )
    axes.set_xlim(0.0, 1.45)
    axes.set_xticks([0.0, 0.5, 1.0])
    axes.set_xlabel("score of the fit")
    verdict = _VERDICTS[state_of(search.hypotheses)]
    axes.set_title(f"{verdict}\np elsewhere = {search.decision.elsewhere:.3f}")


PICTURES: Mapping[str, Callable[[Explanation, Theme], Figure]] = {
    "1-angle-function": _draw_angle_function,
    "2-virtual-edges": _draw_virtual_edges,
    "3-votes": _draw_votes,
    "4-anchor-graphs": _draw_graphs,
    "5-matching-angles": _draw_matching_angles,
    "6-correspondence-matrix": _draw_matrix,
    "7-overlay": _draw_overlay,
    _PROPOSALS: _draw_proposals,
}


# What several pictures share


def _plot_bars(
    axes: Axes,
    values: NDArray[np.float64],
    names: Sequence[str],
    notes: Sequence[str],
    chosen: Sequence[bool],
    theme: Theme,
) -> None:
    """Draw named bars, the first on top, the chosen ones in colour, a note behind each."""
    rows = range(len(names))
    colors = [theme.scan if own else theme.soft for own in chosen]
    axes.barh(rows, values, color=colors, height=0.7)
    axes.set_yticks(rows, names)
    axes.invert_yaxis()
    for row in rows:
        axes.annotate(
            notes[row],
            (float(values[row]), row),
            (4, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=theme.ink if chosen[row] else theme.soft,
        )


def _plot_scale(figure: Figure, axes: Axes, shown: Any, words: str) -> None:
    """Draw the scale of what is coloured."""
    from matplotlib.ticker import MaxNLocator

    bar = figure.colorbar(
        shown, ax=axes, shrink=0.6, pad=0.02, aspect=30, ticks=MaxNLocator(6, integer=True)
    )
    for spine in bar.ax.spines.values():
        spine.set_visible(False)
    bar.set_label(words)


def _plot_answer(axes: Axes, explanation: Explanation, theme: Theme) -> None:
    pose = explanation.trace.hypotheses[0].pose
    if pose is not None:
        plot_sensor(axes, pose, theme, theme.reference)
    _plot_truth(axes, explanation, theme)


def _plot_truth(axes: Axes, explanation: Explanation, theme: Theme) -> None:
    if explanation.truth is not None:
        x, y = explanation.truth.x, explanation.truth.y
        axes.plot(x, y, "o", ms=17, mfc="none", mec=theme.angle, mew=2.0, zorder=7)


def _answer_marks(explanation: Explanation, theme: Theme) -> list[Line2D]:
    verdict = _VERDICTS[state_of(explanation.trace.hypotheses)]
    marks = [mark("^", theme.reference, f"best answer ({verdict})")]
    if explanation.truth is not None:
        marks.append(mark("o", theme.angle, "pose in the log", hollow=True))
    return marks


def _same_things(pairing: Pairing, anchors: AnchorPoints) -> list[tuple[int, int]]:
    """Anchor points of both graphs that the answer lays on one another: theirs and ours."""
    theirs = pairing.description.anchors
    moved = pairing.hypothesis.pose_in_reference.apply(anchors.positions)
    apart = np.linalg.norm(theirs.positions[:, np.newaxis] - moved[np.newaxis], axis=2)
    return [(row, column) for row, column in np.argwhere(apart <= _ONE_THING).tolist()]


def _ends(scan: LaserScan, pose: Pose2D) -> NDArray[np.float64]:
    """(N, 2) end points of all readings; not finite where there is none."""
    angles, ranges = scan.angles, scan.ranges.astype(np.float64)
    with np.errstate(invalid="ignore"):
        return pose.apply(np.column_stack((ranges * np.cos(angles), ranges * np.sin(angles))))


def _bounds_of_set(explanation: Explanation) -> Bounds:
    """Give the rectangle that all references and the answer lie in."""
    poses = [each.pose for each in explanation.references]
    poses += [*(each.pose for each in explanation.trace.hypotheses), explanation.truth]
    always = np.array([(pose.x, pose.y) for pose in poses if pose is not None])
    return bounds_of(wall_points(explanation.references, 0.5), always)


def _map_width(bounds: Bounds) -> float:
    """Width of a map of a given height, inches."""
    wide = _MAP_HEIGHT * (bounds[1] - bounds[0]) / (bounds[3] - bounds[2])
    return min(max(wide, _MAP_WIDTH[0]), _MAP_WIDTH[1])


def _height(bounds: Bounds, width: float) -> float:
    """Height of a panel of a given width, inches, so that what it shows fills it."""
    tall = width * (bounds[3] - bounds[2]) / (bounds[1] - bounds[0])
    return min(max(tall, _PANEL_HEIGHT[0]), _PANEL_HEIGHT[1])


def _with_sensor(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Add the sensor's own position."""
    return np.concatenate([np.zeros((1, 2)), points])


def _bearing(x: float, y: float, first: float) -> float:
    """Direction of a point, radians, in the turn that begins at the first beam."""
    return first + math.fmod(math.atan2(y, x) - first + 4.0 * math.pi, 2.0 * math.pi)


def _over_beams(axes: Axes, bearing: NDArray[np.float64]) -> None:
    """Prepare the x axis for the directions of beams, degrees."""
    from matplotlib.ticker import MultipleLocator

    span = float(np.ptp(bearing)) if len(bearing) else 0.0
    axes.xaxis.set_major_locator(MultipleLocator(30.0 if span < 200.0 else 60.0))
    axes.set_xlabel("direction of the beam, degrees")


def _whole_numbers(axes: Axes, *, x: bool = False) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    if x:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
