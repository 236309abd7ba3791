"""The demonstration: MIT Killian Court, located in a map made of its first visits.

The recording (1.9 km through corridors that look alike, 3,873 scans of 180 readings) comes with
the package ``rtb-data``.  References and queries are those of protocol P1: a reference per 2 m
and 45 degrees, and every scan taken near references from which the robot had driven 20 m or
more.  Each query is located by itself, among all references, with no prior.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .drawing import LIGHT, ruler
from .errors import MissingExtraError
from .hypothesis import Hypothesis
from .io import open_log
from .pose import Pose2D
from .progress import ProgressOf
from .protocol import Answer, Figures, Split, figures, revisit
from .record import Record
from .reference_set import ReferenceSet
from .scan import LaserScan
from .settings import Settings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

__all__ = ["Demonstration", "Located", "demonstrate", "draw", "killian_court", "run", "table"]

_PICTURE = "killian-court.png"
# Okabe and Ito's colours, told apart with any colour vision; the shapes differ as well.
_INK, _WALL = "#222222", "#8a8a8a"
_RIGHT, _WRONG, _UNKNOWN = "#0072b2", "#d55e00", "#cc79a7"
_MARGIN = 4.0
_NOSE = 1.5
# Farther off than this, metres, is another place.
_ANOTHER_PLACE = 5.0
_CUT = 2.0
_ASPECT = 1.35


@dataclass(frozen=True, eq=False)
class Located:
    """One query of the demonstration.

    Args:
        record: What was located; its pose is the truth.
        best: The best hypothesis, or None.
        answer: The same beside the truth.
    """

    record: Record
    best: Hypothesis | None
    answer: Answer


@dataclass(frozen=True, eq=False)
class Demonstration:
    """What the demonstration found.

    Args:
        records: All scans of the recording.
        split: Which of them are references and which queries.
        places: The reference set.
        located: Every query, in the order of the recording.
        building: Seconds for reading the recording and making the set.
    """

    records: tuple[Record, ...]
    split: Split
    places: ReferenceSet
    located: tuple[Located, ...]
    building: float

    @property
    def figures(self) -> Figures:
        """All figures of the protocol."""
        return figures(each.answer for each in self.located)


def run(
    folder: Path,
    settings: Settings | None,
    say: Callable[[str], None],
    progress: ProgressOf,
) -> None:
    """Do the whole demonstration.

    Args:
        folder: For the picture; made when it is missing.
        settings: Of the matcher; None for the default preset.
        say: Takes the lines of the table.
        progress: Wraps what takes a while.

    Raises:
        MissingExtraError: ``rtb-data`` or matplotlib is not installed.
        LogError: The recording cannot be read.
        OSError: The picture cannot be written.
    """
    recording = killian_court()
    _require_matplotlib()
    folder.mkdir(parents=True, exist_ok=True)
    outcome = demonstrate(recording, settings, progress)
    for line in table(outcome):
        say(line)
    picture = folder / _PICTURE
    _save(draw(outcome), picture)
    say(f"\n{picture}")


def killian_court() -> Path:
    """Return the file of the recording.

    Raises:
        MissingExtraError: The package that holds it is not installed.
    """
    try:
        import rtbdata
    except ImportError:
        raise MissingExtraError("the demo's recording", "demo") from None
    return Path(rtbdata.__file__).parent / "data" / "killian.g2o.zip"


def demonstrate(
    recording: Path,
    settings: Settings | None = None,
    progress: ProgressOf = lambda items, what, total=None: items,
) -> Demonstration:
    """Build the set from the first visits and locate the later ones.

    Args:
        recording: A log with poses.
        settings: Of the matcher; None for the default preset.
        progress: Wraps what takes a while.

    Raises:
        LogError: The recording cannot be read.
    """
    start = time.perf_counter()
    records = tuple(open_log(recording))
    split = revisit(records)
    places = ReferenceSet.build(
        (records[position] for position in split.references), keep_all=True, settings=settings
    )
    places.prepare()
    building = time.perf_counter() - start
    located = [
        _locate(places, records, position)
        for position in progress(split.queries, "locating", len(split.queries))
    ]
    return Demonstration(records, split, places, tuple(located), building)


def table(outcome: Demonstration) -> list[str]:
    """Return the lines of the table: correct, wrong, not known, milliseconds."""
    found = outcome.figures
    share = 100.0 / found.queries
    return [
        f"MIT Killian Court: {len(outcome.places)} references, {found.queries} scans of later "
        f"visits, each located on its own",
        "",
        f"{'correct':>12}{'wrong':>12}{'not known':>12}{'best guess right':>20}{'ms a scan':>12}",
        f"{found.correct:>12}{found.wrong:>12}{found.silent:>12}"
        f"{round(found.top_1 * found.queries):>20}{1e3 * found.time_median:>12.2f}",
        f"{found.correct * share:>11.1f}%{found.wrong * share:>11.1f}%"
        f"{found.silent * share:>11.1f}%{100.0 * found.top_1:>19.1f}%{'median':>12}",
        "",
        f"Correct is within 0.5 m and 10 degrees (median error {100.0 * found.position_median:.1f} "
        f"cm, {math.degrees(found.heading_median):.1f} degrees).",
    ]


def draw(outcome: Demonstration) -> Figure:
    """Draw the map with every answer, and two scans that were matched, one over the other."""
    _require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.4, 5.7), dpi=130, layout="constrained", facecolor="white")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.72, 1.0))
    _draw_map(figure.add_subplot(grid[:, 0]), outcome)
    for row, (one, title) in enumerate(_to_show(outcome)):
        _draw_match(figure.add_subplot(grid[row, 1]), outcome, one, title)
    return figure


def _locate(places: ReferenceSet, records: Sequence[Record], position: int) -> Located:
    record = records[position]
    assert record.scan is not None
    start = time.perf_counter()
    hypotheses = places.locate(record.scan)
    seconds = time.perf_counter() - start
    best = hypotheses[0] if hypotheses else None
    answer = Answer(
        query=position,
        pose=None if best is None else best.pose,
        truth=record.pose,
        probability=math.nan if best is None else best.probability,
        accepted=best is not None and best.accepted,
        seconds=seconds,
    )
    return Located(record, best, answer)


def _draw_map(axes: Axes, outcome: Demonstration) -> None:
    located = outcome.located
    right = [each for each in located if each.answer.accepted and each.answer.is_correct]
    wrong = [each for each in located if each.answer.accepted and not each.answer.is_correct]
    unknown = [each for each in located if not each.answer.accepted]
    poses = [each.pose for each in outcome.places.references if each.pose is not None]

    walls = np.concatenate([_walls(each.scan, each.pose) for each in outcome.places.references])
    axes.plot(*walls.T, ",", color=_WALL, alpha=0.35, zorder=1)
    axes.plot(*_places(unknown), "o", ms=2.6, mfc="none", mec=_UNKNOWN, mew=0.6, zorder=2)
    axes.plot(*_places(right), "o", ms=3.2, color=_RIGHT, mec="none", zorder=3)
    for each in wrong:
        ends = [pose for pose in (each.answer.truth, each.answer.pose) if pose is not None]
        x, y = [pose.x for pose in ends], [pose.y for pose in ends]
        axes.plot(x, y, "-", color=_WRONG, lw=0.8, alpha=0.7, zorder=4)
    axes.plot(*_places(wrong), "X", ms=7, color=_WRONG, mec="white", mew=0.5, zorder=5)

    x, y = [pose.x for pose in poses], [pose.y for pose in poses]
    axes.set_xlim(min(x) - _MARGIN, max(x) + _MARGIN)
    axes.set_ylim(min(y) - _MARGIN, max(y) + _MARGIN)
    _frame(axes)
    axes.set_title(
        f"{len(located)} scans of later visits, located one by one among {len(poses)} references",
        fontsize=9,
        loc="left",
    )
    handles = [
        _mark("o", _RIGHT, f"located and correct: {len(right)}", filled=True),
        _mark("X", _WRONG, f"located and wrong: {len(wrong)}", True),
        _mark("o", _UNKNOWN, f"“not known”: {len(unknown)}", filled=False),
    ]
    axes.legend(handles=handles, loc="upper left", fontsize=9, frameon=False)


def _draw_match(axes: Axes, outcome: Demonstration, shown: Located, title: str) -> None:
    """Draw a scan over the reference scan that it was matched with, in the reference's frame."""
    assert shown.best is not None
    assert shown.record.scan is not None
    reference = outcome.places[shown.best.reference]
    pose = shown.best.pose_in_reference
    below = reference.scan.points
    above = pose.apply(shown.record.scan.points)
    axes.plot(*below.T, "s", ms=3.4, color=_WALL, mec="none", zorder=1)
    axes.plot(*above.T, "o", ms=2.2, color=_RIGHT, mec="none", zorder=2)
    _draw_laser(axes, Pose2D(), _WALL)
    _draw_laser(axes, pose, _RIGHT)
    _zoom(axes, np.concatenate([below, above]))
    _frame(axes)
    axes.set_title(title, fontsize=9, loc="left")


def _to_show(outcome: Demonstration) -> list[tuple[Located, str]]:
    """Choose a scan that was located from a distance, and one that was rightly not believed."""
    hits = [each for each in outcome.located if each.answer.accepted and each.answer.is_correct]
    silent = [each for each in outcome.located if each.best and not each.answer.accepted]
    misses = [each for each in silent if each.answer.position_error > _ANOTHER_PLACE]
    chosen = []
    if hits:
        best = max(hits, key=_interest)
        chosen.append((best, "Located: the scan (blue) over its reference (grey)"))
    if misses:
        best = max(misses, key=lambda each: each.answer.probability)
        away = best.answer.position_error
        chosen.append((best, f"“Not known”: this look-alike is {away:.0f} m away"))
    return chosen


def _interest(one: Located) -> float:
    """Say how much there is to see in a match: far apart, turned, and yet in agreement."""
    assert one.best is not None
    assert one.record.scan is not None
    pose = one.best.pose_in_reference
    apart = math.hypot(pose.x, pose.y) + abs(pose.theta)
    extent = np.ptp(one.record.scan.points, axis=0)
    return float(one.best.evaluation**2 * apart * np.sqrt(np.min(extent)))


def _walls(scan: LaserScan, pose: Pose2D | None) -> NDArray[np.float64]:
    return (pose or Pose2D()).apply(scan.points)


def _places(located: Sequence[Located]) -> tuple[list[float], list[float]]:
    poses = [each.record.pose for each in located if each.record.pose is not None]
    return [pose.x for pose in poses], [pose.y for pose in poses]


def _draw_laser(axes: Axes, pose: Pose2D, color: str) -> None:
    """Draw where a laser stood and where it looked."""
    nose = pose.apply([[0.0, 0.0], [_NOSE, 0.0]])
    axes.plot(*nose.T, "-", color=_INK, lw=1.2, zorder=3)
    axes.plot(pose.x, pose.y, "o", ms=8, color=color, mec=_INK, mew=1.0, zorder=4)


def _mark(shape: str, color: str, text: str, filled: bool) -> Line2D:
    from matplotlib.lines import Line2D

    face = color if filled else "none"
    return Line2D([], [], ls="", marker=shape, ms=6, color=color, mfc=face, label=text)


def _zoom(axes: Axes, points: NDArray[np.float64]) -> None:
    """Show most of the points, since a few far ones must not shrink the rest, and both lasers."""
    low, high = np.percentile(points, (_CUT, 100.0 - _CUT), axis=0)
    low, high = np.minimum(low, 0.0) - 1.0, np.maximum(high, 0.0) + 1.0
    size = high - low
    wanted = np.maximum(size, (_ASPECT * size[1], size[0] / _ASPECT))
    low, high = low - 0.5 * (wanted - size), high + 0.5 * (wanted - size)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])


def _frame(axes: Axes) -> None:
    axes.set_aspect("equal")
    ruler(axes, LIGHT)


def _save(figure: Figure, path: Path) -> None:
    """Write the picture, whole or not at all."""
    draft = path.with_name(f".{path.name}.part")
    try:
        figure.savefig(draft, format="png", pil_kwargs={"optimize": True})
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def _require_matplotlib() -> None:
    try:
        import matplotlib  # noqa: F401 - only whether it is there
    except ImportError:
        raise MissingExtraError("the demo's picture", "demo") from None
