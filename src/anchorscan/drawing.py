"""What all pictures share: a light and a dark theme, and how scans, sensors and maps look.

The colours are those of Okabe and Ito, which are told apart with any colour vision; what
differs in colour differs in shape or place as well.  matplotlib is imported by the functions
that need it, so that importing this costs nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .anchors import AnchorKind, AnchorPoints
from .description import Description
from .errors import MissingExtraError
from .explanation import MapPicture
from .graph import AnchorGraph
from .pose import Pose2D

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

__all__ = [
    "DARK",
    "LIGHT",
    "Bounds",
    "Theme",
    "anchor_marks",
    "color_of",
    "legend",
    "line",
    "mark",
    "new_figure",
    "nothing_to_draw",
    "number_anchors",
    "plot_anchor",
    "plot_anchors",
    "plot_edges",
    "plot_map",
    "plot_scan",
    "plot_sensor",
    "ramp",
    "require_matplotlib",
    "ruler",
    "save",
    "style",
    "view",
]

Bounds = tuple[float, float, float, float]

_DPI = 130
# Of the picture, what the number of an anchor point takes.
_NUMBER_SIZE = 0.04
_MOST_NUMBERS = 30
_MOST_IN_A_ROW = 6
# Nearer to a surface than this, metres, the map is shaded.
_SHADE = 0.25
_RULERS = (100.0, 50.0, 20.0, 10.0, 5.0, 2.0, 1.0)


@dataclass(frozen=True)
class Theme:
    """The colours of a picture, by what they stand for.

    Args:
        name: "light" or "dark".
        paper: Background.
        ink: Text, and what matters most.
        soft: What matters less.
        faint: Grids and frames.
        scan: The scan that is to be located.
        reference: The reference scan.
        jump: Jump edge anchor points, and what disagrees.
        angle: Angle anchor points, and what agrees.
        virtual: Virtual edge anchor points, and what sees through.
        free: Known free space of the map.
        surface: Surfaces of the map.
        ramp: From little to much.
    """

    name: str
    paper: str
    ink: str
    soft: str
    faint: str
    scan: str
    reference: str
    jump: str
    angle: str
    virtual: str
    free: str
    surface: str
    ramp: tuple[str, ...]


LIGHT = Theme(
    name="light",
    paper="#ffffff",
    ink="#1a1a1a",
    soft="#808080",
    faint="#dcdcdc",
    scan="#0072b2",
    reference="#e69f00",
    jump="#d55e00",
    angle="#009e73",
    virtual="#cc79a7",
    free="#f0f0f0",
    surface="#4d4d4d",
    ramp=("#dfe9f0", "#56b4e9", "#0072b2", "#00263b"),
)
DARK = Theme(
    name="dark",
    paper="#14181d",
    ink="#f2f2f2",
    soft="#8b949e",
    faint="#353c45",
    scan="#56b4e9",
    reference="#e69f00",
    jump="#d55e00",
    angle="#009e73",
    virtual="#cc79a7",
    free="#242a32",
    surface="#c9d1d9",
    ramp=("#2c3642", "#0072b2", "#56b4e9", "#eaf6ff"),
)

# How a direction is drawn: a needle without a head, a quarter of an inch long.
_NEEDLE: dict[str, Any] = {
    **{"angles": "xy", "scale_units": "inches", "scale": 4.0, "units": "dots", "width": 1.6},
    **{"headwidth": 0.0, "headlength": 0.0, "headaxislength": 0.0, "zorder": 5},
}
_MARKERS = {
    AnchorKind.JUMP_EDGE_LEFT: ("<", "jump edge, left margin"),
    AnchorKind.JUMP_EDGE_RIGHT: (">", "jump edge, right margin"),
    AnchorKind.CONVEX_ANGLE: ("^", "convex angle"),
    AnchorKind.CONCAVE_ANGLE: ("v", "concave angle"),
    AnchorKind.VIRTUAL_EDGE: ("P", "virtual edge"),
}


# Figures


def style(theme: Theme) -> Any:
    """Return a theme as matplotlib's settings, for its ``rc_context``."""
    return {
        "figure.facecolor": theme.paper,
        "axes.facecolor": theme.paper,
        "axes.edgecolor": theme.faint,
        "axes.labelcolor": theme.ink,
        "axes.titlecolor": theme.ink,
        "axes.titlelocation": "left",
        "axes.titlesize": 9,
        "axes.labelsize": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "text.color": theme.ink,
        "xtick.color": theme.soft,
        "ytick.color": theme.soft,
        "xtick.labelcolor": theme.ink,
        "ytick.labelcolor": theme.ink,
        "xtick.labelsize": 8,
        "ytick.labelsize": 8,
        "legend.frameon": False,
        "legend.fontsize": 8.5,
        "font.family": "DejaVu Sans",
    }


def new_figure(size: tuple[float, float], title: str) -> Figure:
    """Return a figure of a size in inches with a title."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    figure.suptitle(title, x=0.012, ha="left", fontsize=12, fontweight="bold")
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a picture, whole or not at all; the same figure gives the same file.

    Raises:
        OSError: It cannot be written.
    """
    import matplotlib

    kind = path.suffix[1:]
    # What would make two files of one figure differ is left out.
    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
    draft = path.with_name(f".{path.name}.part")
    try:
        with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "anchorscan"}):
            figure.savefig(draft, format=kind, facecolor="auto", metadata=metadata)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def require_matplotlib() -> None:
    """Make sure that pictures can be drawn.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        import matplotlib  # noqa: F401 - only whether it is there
    except ImportError:
        raise MissingExtraError("drawing pictures", "plot") from None


def nothing_to_draw(axes: Axes, words: str, theme: Theme) -> None:
    """Say in place of a panel why there is nothing to draw."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, words, ha="center", color=theme.soft, transform=axes.transAxes)


def view(axes: Axes, bounds: Bounds) -> None:
    """Show a rectangle (smallest and largest x, smallest and largest y, metres) undistorted."""
    axes.set_aspect("equal")
    axes.set_xlim(bounds[0], bounds[1])
    axes.set_ylim(bounds[2], bounds[3])


def ruler(axes: Axes, theme: Theme) -> None:
    """Draw a scale instead of axes: only lengths mean something to the reader."""
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(True)
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    length = next((n for n in _RULERS if n < 0.4 * (right - left)), 0.5)
    x, y = left + 0.04 * (right - left), bottom + 0.04 * (top - bottom)
    axes.plot(
        [x, x + length], [y, y], "-", color=theme.ink, lw=2.0, solid_capstyle="butt", zorder=9
    )
    axes.annotate(
        f"{length:g} m",
        (x + 0.5 * length, y),
        (0, 3),
        textcoords="offset points",
        ha="center",
        fontsize=8,
        zorder=9,
        bbox=_plate(theme),
    )


def ramp(theme: Theme) -> Colormap:
    """Return the colour map from little to much."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list(f"anchorscan-{theme.name}", list(theme.ramp))


def _plate(theme: Theme) -> dict[str, Any]:
    """What lies below text, so that it can be read on anything."""
    return {"boxstyle": "round,pad=0.12", "fc": theme.paper, "ec": "none", "alpha": 0.75}


# Legends


def legend(figure: Figure, handles: Sequence[Line2D]) -> None:
    """Explain the marks of a whole figure below it."""
    rows = math.ceil(len(handles) / _MOST_IN_A_ROW)
    columns = math.ceil(len(handles) / max(rows, 1))
    figure.legend(handles=handles, loc="outside lower left", ncols=max(columns, 1))


def mark(shape: str, color: str, text: str, *, hollow: bool = False) -> Line2D:
    """Return the entry of a legend for a mark."""
    from matplotlib.lines import Line2D

    face = "none" if hollow else color
    return Line2D([], [], ls="", marker=shape, ms=7, mfc=face, mec=color, label=text)


def line(color: str, text: str, *, dashed: bool = False, width: float = 1.6) -> Line2D:
    """Return the entry of a legend for a line."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=color, lw=width, ls=(0, (4, 3)) if dashed else "-", label=text)


def anchor_marks(anchors: Sequence[AnchorPoints], theme: Theme) -> list[Line2D]:
    """Return the entries of a legend for the kinds of anchor points that are there."""
    there = {kind for each in anchors for kind in each.kinds.tolist()}
    return [
        mark(shape, color_of(kind, theme), words)
        for kind, (shape, words) in _MARKERS.items()
        if kind in there
    ]


# Marks


def color_of(kind: int, theme: Theme) -> str:
    """Return the colour of a kind of anchor points."""
    if kind in (AnchorKind.JUMP_EDGE_LEFT, AnchorKind.JUMP_EDGE_RIGHT):
        return theme.jump
    return theme.virtual if kind == AnchorKind.VIRTUAL_EDGE else theme.angle


def plot_anchor(axes: Axes, x: float, y: float, kind: int, theme: Theme) -> None:
    """Draw the mark of one anchor point."""
    shape, color = _MARKERS[AnchorKind(kind)][0], color_of(kind, theme)
    axes.plot(x, y, shape, ms=8, color=color, mec=theme.paper, mew=0.8, zorder=6, clip_on=False)


def plot_anchors(
    axes: Axes, anchors: AnchorPoints, theme: Theme, *, directions: bool = False
) -> None:
    """Draw all anchor points, and where the free space before them lies."""
    for kind, (x, y), direction in zip(
        anchors.kinds.tolist(),
        anchors.positions.tolist(),
        anchors.directions.tolist(),
        strict=True,
    ):
        plot_anchor(axes, x, y, kind, theme)
        if directions:
            u, v = math.cos(direction), math.sin(direction)
            axes.quiver(x, y, u, v, color=color_of(kind, theme), **_NEEDLE)


def number_anchors(axes: Axes, anchors: AnchorPoints, theme: Theme) -> None:
    """Number anchor points, where there are not too many and no number stands already."""
    if len(anchors) > _MOST_NUMBERS:
        return
    apart = _NUMBER_SIZE * max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()))
    numbered: list[tuple[float, float]] = []
    for n, (x, y) in enumerate(anchors.positions.tolist()):
        if any(abs(x - u) < apart and abs(y - v) < 0.8 * apart for u, v in numbered):
            continue
        numbered.append((x, y))
        axes.annotate(
            str(n),
            (x, y),
            (6, 5),
            textcoords="offset points",
            fontsize=8,
            zorder=7,
            bbox=_plate(theme),
        )


def plot_edges(
    axes: Axes, graph: AnchorGraph, edges: NDArray[np.int64], color: str, width: float
) -> None:
    """Draw some edges of an anchor graph."""
    from matplotlib.collections import LineCollection

    lines = graph.anchors.positions[graph.nodes[edges]]
    axes.add_collection(
        LineCollection(list(lines), colors=color, linewidths=width, zorder=2), autolim=False
    )


def plot_scan(axes: Axes, known: Description, theme: Theme, color: str) -> None:
    """Draw a scan in its own frame: what belongs to one large surface is joined."""
    points, large = known.angles.points, known.surfaces
    axes.plot(*points.T, ".", ms=3, color=theme.soft, zorder=1)
    for first, last in zip(large.first, large.last, strict=True):
        axes.plot(*points[first : last + 1].T, ".-", ms=3.5, lw=1.4, color=color, zorder=1)
    plot_sensor(axes, Pose2D(), theme, color)


def plot_sensor(
    axes: Axes, pose: Pose2D, theme: Theme, color: str, label: str = "", below: bool = False
) -> None:
    """Draw a sensor: a triangle that points where it looks."""
    axes.plot(
        pose.x,
        pose.y,
        marker=(3, 0, math.degrees(pose.theta) - 90.0),
        ms=12,
        color=color,
        mec=theme.ink,
        mew=0.8,
        zorder=6,
    )
    if label:
        axes.annotate(
            label,
            (pose.x, pose.y),
            (6, -15 if below else 8),
            textcoords="offset points",
            fontsize=8,
            zorder=7,
            bbox=_plate(theme),
        )


def plot_map(axes: Axes, picture: MapPicture, theme: Theme, *, shaded: bool = False) -> None:
    """Draw the stitched map: surfaces, free space, the unknown, and what is near to surfaces."""
    from matplotlib.colors import to_rgb

    paper, free, surface = (np.array(to_rgb(c)) for c in (theme.paper, theme.free, theme.surface))
    image = np.where(picture.is_free[..., np.newaxis], free, paper)
    if shaded:
        near = np.clip(1.0 - picture.distance / _SHADE, 0.0, 1.0)[..., np.newaxis] * 0.55
        image = image * (1.0 - near) + surface * near
    image[picture.is_surface] = surface
    axes.imshow(image, extent=picture.extent, origin="lower", interpolation="antialiased", zorder=0)
