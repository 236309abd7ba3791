"""``anchorscan check-map``: how well a map serves, judged with a drive and without truth.

The scans of a drive are located in the map one by one.  Nobody knows where they were taken, but
odometry knows how the laser moved, and one rigid transform must carry all of it into the map:
the *track* is the transform that carries most of it within half a metre and 10 degrees of the
answers.  Wrong answers do not move as the odometry does, unless all are wrong together, as in
a mirrored or repeated building: that is for the eye, hence the picture.  Odometry drifts, so
this is a check for a drive of some tens of metres.

Where few scans are located they are tried longer and shorter: a map whose ``resolution`` is not
that of its cells is silent, and says so then.

Where the map has changed since it was made, readings end in its free space and rays pass
through its surfaces; both shares are told for the scans on the track.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import LogError, MissingExtraError
from .hypothesis import Hypothesis
from .io import Log
from .map_file import load_map
from .occupancy import MAP_SENSOR, OccupancyGrid, reference_scans
from .plausibility import ScaleCheck, scale_check
from .pose import Pose2D
from .progress import ProgressOf
from .record import Record
from .reference_set import ReferenceSet
from .scan import LaserScan
from .sensor import SensorModel
from .settings import Settings
from .verification import FEATURES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Located", "MapCheck", "check", "draw", "rigid_track", "run", "table"]

Item = TypeVar("Item")

_NEAR, _ALIKE = 0.5, math.radians(10.0)
_NEAR_SURFACE, _FREE, _THROUGH = (FEATURES.index(name) for name in ("near", "free", "through"))
_PICTURE = "map-check.png"
# Okabe and Ito's colours, told apart with any colour vision; the shapes differ as well.
_ON_TRACK, _OFF_TRACK, _UNSURE = "#0072b2", "#d55e00", "#cc79a7"
_FAINT = "#8a8a8a"
_FRAME = 1.5


@dataclass(frozen=True, eq=False)
class Located:
    """One scan of the drive.

    Args:
        scan: The scan.
        odometry: ``T_odom_laser``, where known.
        best: The best hypothesis, or None.
        fit: (7,) of ``verification.FEATURES`` of the best fit, NaN where there is none.
        seconds: Processor time that locating took.
    """

    scan: LaserScan
    odometry: Pose2D | None
    best: Hypothesis | None
    fit: NDArray[np.float64]
    seconds: float


@dataclass(frozen=True, eq=False)
class MapCheck:
    """What a drive tells of a map.

    Args:
        grid: The map.
        places: Its references.
        building: Processor time from the map's cells to the finished set, seconds.
        located: Every usable scan of the drive.
        scale: Whether map and scans are of one scale.
    """

    grid: OccupancyGrid
    places: ReferenceSet
    building: float
    located: tuple[Located, ...]
    scale: ScaleCheck

    @cached_property
    def track(self) -> tuple[Pose2D | None, NDArray[np.bool_]]:
        """``T_map_odom`` and (N,) whether each best answer is on the track."""
        return rigid_track(
            [None if each.best is None else each.best.pose for each in self.located],
            [each.odometry for each in self.located],
        )

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """(N,) whether each best answer is believed."""
        return np.array([each.best is not None and each.best.accepted for each in self.located])

    @property
    def has_odometry(self) -> NDArray[np.bool_]:
        """(N,) whether the place of the scan on the track is known."""
        return np.array([each.odometry is not None for each in self.located])

    @property
    def consistent(self) -> float:
        """Share of the scans with odometry whose best answer is on the track."""
        return float(self.track[1].sum() / max(self.has_odometry.sum(), 1))

    @property
    def consistent_accepted(self) -> float:
        """The same of the answers that are believed; NaN when none is."""
        known = self.accepted & self.has_odometry
        return float(self.track[1][known].mean()) if known.any() else math.nan


def run(
    map_path: Path,
    log: Log,
    folder: Path | None,
    settings: Settings | None,
    say: Callable[[str], None],
    progress: ProgressOf,
) -> MapCheck:
    """Check a map, say what was found, and draw it.

    Args:
        map_path: YAML file of the map.
        log: Recording of a drive in it.
        folder: For the picture, made when it is missing; None for no picture.
        settings: Of the matcher; None for the default preset.
        say: Takes the lines of the table.
        progress: Wraps what takes a while.

    Raises:
        LogError: Map or recording cannot be read, or the recording has no usable scan.
        MissingExtraError: A picture is wanted and matplotlib is not installed.
        OSError: The picture cannot be written.
    """
    if folder is not None:
        _require_matplotlib()
    outcome = check(load_map(map_path), log, settings, progress=progress)
    for line in table(outcome):
        say(line)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        draw(outcome).savefig(folder / _PICTURE, format="png")
        say(f"{folder / _PICTURE}")
    return outcome


def check(
    grid: OccupancyGrid,
    records: Iterable[Record],
    settings: Settings | None = None,
    sensor: SensorModel = MAP_SENSOR,
    progress: ProgressOf = lambda items, what, total=None: items,
) -> MapCheck:
    """Locate the scans of a drive in a map, each on its own.

    Args:
        grid: The map.
        records: The drive.
        settings: Of the matcher; None for the default preset.
        sensor: Takes the reference scans.
        progress: Wraps what takes a while.

    Raises:
        LogError: The robot fits nowhere in the map, or no scan is usable.
    """
    ReferenceSet(settings=settings).prepare()  # compiling is no part of building
    start = time.process_time()
    places = ReferenceSet.build(reference_scans(grid, sensor), keep_all=True, settings=settings)
    places.prepare()
    building = time.process_time() - start
    located = tuple(
        _locate(places, record.scan, record.odometry)
        for record in progress(records, "locating")
        if record.scan is not None
    )
    if not located:
        raise LogError("the recording has no usable scan")
    scale = scale_check(places, (each.scan for each in located))
    return MapCheck(grid, places, building, located, scale)


def rigid_track(
    poses: Sequence[Pose2D | None], odometry: Sequence[Pose2D | None]
) -> tuple[Pose2D | None, NDArray[np.bool_]]:
    """Find the rigid transform of the odometry that most answers agree with.

    Args:
        poses: ``T_map_laser`` as answered, None for no answer.
        odometry: ``T_odom_laser`` at the same times, None where it is not known.

    Returns:
        ``T_map_odom``, or None where no answer has odometry, and (N,) whether each answer lies
        within half a metre and 10 degrees of the transformed odometry.
    """
    known = [
        index
        for index, (pose, moved) in enumerate(zip(poses, odometry, strict=True))
        if pose is not None and moved is not None
    ]
    agrees = np.zeros(len(poses), dtype=bool)
    if not known:
        return None, agrees
    answers = np.array([_values(poses[index]) for index in known])
    moved = np.array([_values(odometry[index]) for index in known])
    best, most = None, -1
    for index in known:
        pose, at = poses[index], odometry[index]
        assert pose is not None
        assert at is not None
        T_map_odom = pose @ at.inverse()
        near = _is_near(T_map_odom, answers, moved)
        if near.sum() > most:
            best, most = T_map_odom, int(near.sum())
            agrees[known] = near
    return best, agrees


def table(outcome: MapCheck) -> list[str]:
    """Return the lines that say what was found."""
    grid, located = outcome.grid, outcome.located
    count, accepted = len(located), int(outcome.accepted.sum())
    free = float(grid.is_free.sum()) * grid.resolution**2
    milliseconds = 1.0e3 * np.array([each.seconds for each in located])
    rows, columns = grid.data.shape
    lines = [
        f"map:       {columns} x {rows} cells of {100.0 * grid.resolution:g} cm, {free:.0f} square "
        f"metres free; {len(outcome.places)} references in {outcome.building:.1f} s",
        f"scans:     {count}, a query takes {np.median(milliseconds):.1f} ms of processor time "
        f"(median; 99 of 100 at most {np.percentile(milliseconds, 99):.1f} ms)",
        f"located:   {accepted}, not known {count - accepted}",
        *_of_scale(outcome.scale, grid.resolution),
    ]
    if not outcome.has_odometry.any():
        return [*lines, "track:     no odometry to check the answers with"]
    fits = np.array([each.fit for each in located])[outcome.track[1]]
    near, empty, through = 100.0 * np.median(fits[:, (_NEAR_SURFACE, _FREE, _THROUGH)], axis=0)
    lines.append(
        f"track:     {100.0 * outcome.consistent:.1f} % of the best answers move as the odometry "
        f"does{_of_accepted(outcome)}"
    )
    lines.append(
        f"change:    {near:.0f} % of the readings end within 10 cm of a surface of the map, "
        f"{empty:.0f} % in its free space; {through:.0f} % of the rays pass through surfaces"
    )
    return lines


def _of_scale(scale: ScaleCheck, resolution: float) -> list[str]:
    """Say by how much the map is too large or too small, if it is."""
    if not scale.is_scaled:
        return []
    off = 100.0 * abs(scale.scale - 1.0)
    size = "large" if scale.scale > 1.0 else "small"
    return [
        f"scale:     the map looks {off:.0f} % too {size}: of {scale.asked} scans {scale.scaled} "
        f"are located with readings {scale.scale:.2f} times as long, {scale.as_given} as they are; "
        f"is its resolution {resolution / scale.scale:.3g} m, not {resolution:g} m?"
    ]


def draw(outcome: MapCheck) -> Figure:
    """Draw the map with all answers, and the worst, a middling and the best fit at large."""
    _require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 7.0), dpi=110, layout="constrained", facecolor="white")
    cells = figure.add_gridspec(2, 3, width_ratios=(1.5, 1.0, 1.0))
    _draw_all(figure.add_subplot(cells[:, 0]), outcome)
    shown = sorted((each for each in outcome.located if each.best), key=lambda each: each.fit[0])
    chosen = [shown[round(share * (len(shown) - 1))] for share in (0.0, 0.33, 0.67, 1.0) if shown]
    for number, each in enumerate(chosen):
        _draw_one(figure.add_subplot(cells[number // 2, 1 + number % 2]), outcome.grid, each)
    return figure


def _locate(places: ReferenceSet, scan: LaserScan, odometry: Pose2D | None) -> Located:
    start = time.process_time()
    trace = places.explain(scan)
    seconds = time.process_time() - start
    best = trace.hypotheses[0] if trace.hypotheses else None
    fit = np.full(len(FEATURES), np.nan)
    if best is not None and trace.in_map is not None:
        fit = trace.in_map.fits.features[0]
    return Located(scan, odometry, best, fit, seconds)


def _values(pose: Pose2D | None) -> NDArray[np.float64]:
    assert pose is not None
    return pose.to_array()


def _is_near(
    T_map_odom: Pose2D, answers: NDArray[np.float64], moved: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(N,) whether (N, 3) answers lie on the (N, 3) transformed odometry."""
    off = T_map_odom.apply(moved[:, :2]) - answers[:, :2]
    turn = T_map_odom.theta + moved[:, 2] - answers[:, 2]
    is_near: NDArray[np.bool_] = np.hypot(off[:, 0], off[:, 1]) <= _NEAR
    return is_near & (np.cos(turn) >= math.cos(_ALIKE))


def _of_accepted(outcome: MapCheck) -> str:
    share = outcome.consistent_accepted
    return "" if math.isnan(share) else f", and {100.0 * share:.1f} % of those that are believed"


def _draw_all(axes: Axes, outcome: MapCheck) -> None:
    _draw_map(axes, outcome.grid)
    T_map_odom, agrees = outcome.track
    if T_map_odom is not None:
        way = [T_map_odom @ each.odometry for each in outcome.located if each.odometry is not None]
        axes.plot([pose.x for pose in way], [pose.y for pose in way], "-", color="#222222", lw=0.8)
    accepted, moved = outcome.accepted, outcome.has_odometry
    kinds = (
        (agrees & accepted, "o", _ON_TRACK, "located, moves as the odometry"),
        (agrees & ~accepted, ".", _UNSURE, "not known, moves as the odometry"),
        (~agrees & accepted & moved, "X", _OFF_TRACK, "located, does not"),
        (~agrees & ~accepted & moved, "x", _OFF_TRACK, "not known, does not"),
        (~moved, "+", _FAINT, "without odometry"),
    )
    for which, shape, color, text in kinds:
        poses = [outcome.located[index].best for index in np.flatnonzero(which)]
        at = [each.pose for each in poses if each is not None and each.pose is not None]
        axes.plot(
            [pose.x for pose in at],
            [pose.y for pose in at],
            shape,
            ms=5,
            color=color,
            label=f"{text}: {int(which.sum())}",
        )
    axes.legend(loc="upper left", fontsize=8)


def _draw_one(axes: Axes, grid: OccupancyGrid, located: Located) -> None:
    """Draw the readings of one scan over the map, where the best hypothesis has them."""
    assert located.best is not None
    pose = located.best.pose
    assert pose is not None
    _draw_map(axes, grid)
    points = pose.apply(located.scan.points)
    axes.plot(points[:, 0], points[:, 1], ".", ms=2.0, color=_OFF_TRACK)
    nose = pose.apply([[0.0, 0.0], [1.0, 0.0]])
    axes.plot(nose[:, 0], nose[:, 1], "-", color=_ON_TRACK, lw=2.0)
    axes.plot(pose.x, pose.y, "o", ms=6, color=_ON_TRACK)
    low, high = np.percentile(points, (5.0, 95.0), axis=0)
    axes.set_xlim(low[0] - _FRAME, high[0] + _FRAME)
    axes.set_ylim(low[1] - _FRAME, high[1] + _FRAME)
    axes.set_title(
        f"score {located.fit[0]:.2f}, probability {located.best.probability:.2f}", fontsize=8
    )


def _draw_map(axes: Axes, grid: OccupancyGrid) -> None:
    from matplotlib.transforms import Affine2D

    shade = np.where(grid.is_occupied, 0, np.where(grid.is_free, 255, 200))
    rows, columns = shade.shape
    extent = (0.0, columns * grid.resolution, 0.0, rows * grid.resolution)
    image = axes.imshow(shade, cmap="gray", vmin=0, vmax=255, origin="lower", extent=extent)
    turned = Affine2D().rotate(grid.origin.theta).translate(grid.origin.x, grid.origin.y)
    image.set_transform(turned + axes.transData)
    corners = grid.origin.apply([[x, y] for x in extent[:2] for y in extent[2:]])
    axes.set_xlim(corners[:, 0].min(), corners[:, 0].max())
    axes.set_ylim(corners[:, 1].min(), corners[:, 1].max())
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7)


def _require_matplotlib() -> None:
    try:
        import matplotlib  # noqa: F401 - only whether it is there
    except ImportError:
        raise MissingExtraError("the picture of a map check", "plot") from None
