"""Answers as a Rerun recording: live while they are made, or saved to be looked at later.

Map, scan, anchor points, hypotheses with covariance ellipses and the belief over time, on the
recording's own clock (timeline ``recording``) and by the number of the scan (``scan``).  The map
lies in the plane z = 0, seen from above.

Rerun sends usage statistics unless it is told not to.  It does not when it runs unattended,
which it takes from the environment variable ``CI``; that is set whenever Rerun is loaded or its
window is opened from here, and nothing is written into anybody's home directory.
"""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .answers import Guess, ScanAnswer
from .description import describe
from .drawing import DARK, color_of
from .errors import AnchorscanError, MissingExtraError
from .explanation import bounds_of, ellipse, wall_points
from .pose import Pose2D
from .record import Record
from .reference import Reference
from .settings import Settings

if TYPE_CHECKING:
    from types import TracebackType

__all__ = ["Viewer"]

_APPLICATION = "anchorscan"
_TRAIL = 300
_NOSE = 0.8
_CLOCK, _NUMBER = "recording", "scan"


class Viewer:
    """A Rerun recording of answers; a context manager.

    Args:
        references: Of the set: they make the map.
        settings: By which anchor points are taken from the scans.
        path: File to save to (``.rrd``); None opens Rerun's window.

    Raises:
        MissingExtraError: ``rerun-sdk`` is not installed.
        AnchorscanError: The file cannot be written, or no window can be opened.
    """

    def __init__(
        self, references: Sequence[Reference], settings: Settings, path: Path | None = None
    ) -> None:
        self._rerun = _load()
        self._settings = settings
        self._trails: dict[str, deque[tuple[float, float, float]]] = {
            name: deque(maxlen=_TRAIL) for name in ("answer", "log")
        }
        walls = wall_points(references)
        poses = [each.pose for each in references if each.pose is not None]
        places = np.array([(pose.x, pose.y) for pose in poses]).reshape(-1, 2)
        self._stream = self._rerun.RecordingStream(_APPLICATION)
        self._open(path, self._blueprint(bounds_of(walls, places)))
        self._show_map(walls, poses)

    def __enter__(self) -> Viewer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Write what is left and let go of file or window."""
        self._stream.flush()
        self._stream.disconnect()

    def show(self, record: Record, answer: ScanAnswer) -> None:
        """Show one scan and what was said to it.

        Args:
            record: The scan, with stamp, and the log's pose where it has one.
            answer: To this scan.
        """
        self._stream.set_time(_NUMBER, sequence=record.index)
        if record.stamp is not None:
            self._stream.set_time(_CLOCK, duration=record.stamp)
        placed = [guess for guess in answer.guesses if guess.pose is not None]
        best = placed[0] if placed else None
        self._show_scan(record, best)
        self._show_guesses(placed, answer.accepted)
        self._show_trail("answer", best.pose if best and answer.accepted else None, DARK.scan)
        self._show_trail("log", record.pose, DARK.angle)
        self._show_numbers(answer)

    def _open(self, path: Path | None, blueprint: Any) -> None:
        if path is None:
            with _unattended():
                try:
                    self._stream.spawn(default_blueprint=blueprint)
                except RuntimeError as error:
                    raise AnchorscanError(f"Rerun's window cannot be opened: {error}") from None
            return
        if not path.parent.is_dir():
            raise AnchorscanError(f"{path}: there is no such folder")
        try:
            self._stream.save(path, default_blueprint=blueprint)
        except RuntimeError as error:
            raise AnchorscanError(f"{path}: cannot be written: {error}") from None

    def _blueprint(self, bounds: tuple[float, float, float, float]) -> Any:
        """What is shown where: the map from above, and time series beside it."""
        from rerun import blueprint as views

        left, right, bottom, top = bounds
        x, y, far = 0.5 * (left + right), 0.5 * (bottom + top), max(right - left, top - bottom)
        seen = views.Spatial3DView(
            origin="world",
            name="Map",
            line_grid=views.LineGrid3D(visible=False),
            eye_controls=views.EyeControls3D(
                position=(x, y, 1.1 * far), look_target=(x, y, 0.0), eye_up=(0.0, 1.0, 0.0)
            ),
        )
        return views.Blueprint(
            views.Horizontal(
                seen,
                views.Vertical(
                    views.TextLogView(origin="words", name="Answers"),
                    views.TimeSeriesView(origin="belief", name="Probability"),
                    views.TimeSeriesView(origin="time", name="Milliseconds"),
                ),
                column_shares=[2.2, 1.0],
            ),
            views.TimePanel(timeline=_CLOCK, state="collapsed"),
            views.BlueprintPanel(state="collapsed"),
            views.SelectionPanel(state="collapsed"),
        )

    def _show_map(self, walls: NDArray[np.float64], poses: Sequence[Pose2D]) -> None:
        rerun = self._rerun
        self._stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        points = rerun.Points3D(_flat(walls), radii=0.03, colors=_color(DARK.soft))
        self._stream.log("world/walls", points, static=True)
        self._stream.log(
            "world/references", self._arrows(poses, _color(DARK.faint), 0.02), static=True
        )
        for name, color in (("probability", DARK.scan), ("elsewhere", DARK.soft)):
            self._stream.log(
                f"belief/{name}", rerun.SeriesLines(colors=_color(color), names=name), static=True
            )

    def _show_scan(self, record: Record, best: Guess | None) -> None:
        """Show readings and anchor points where the best guess says that they are."""
        rerun = self._rerun
        if record.scan is None or best is None or best.pose is None:
            self._stream.log("world/scan", rerun.Clear(recursive=True))
            return
        points = rerun.Points3D(
            _flat(best.pose.apply(record.scan.points), 0.02), radii=0.05, colors=_color(DARK.scan)
        )
        self._stream.log("world/scan", points)
        anchors = describe(record.scan, self._settings).anchors
        self._stream.log(
            "world/scan/anchors",
            rerun.Points3D(
                _flat(best.pose.apply(anchors.positions), 0.06),
                radii=0.12,
                colors=[_color(color_of(kind, DARK)) for kind in anchors.kinds.tolist()],
            ),
        )

    def _show_guesses(self, guesses: Sequence[Guess], accepted: bool) -> None:
        """Show hypotheses with their ellipses, the fainter the less likely."""
        rerun = self._rerun
        if not guesses:
            self._stream.log("world/hypotheses", rerun.Clear(recursive=True))
            return
        colors = [
            _color(DARK.reference if n or not accepted else DARK.scan, guess.probability)
            for n, guess in enumerate(guesses)
        ]
        poses = [guess.pose for guess in guesses if guess.pose is not None]
        labels = [f"{guess.probability:.2f}" for guess in guesses]
        self._stream.log("world/hypotheses", self._arrows(poses, colors, 0.06, labels))
        outlines = [
            _flat(ellipse(guess.pose, guess.covariance), 0.04)
            for guess in guesses
            if guess.pose is not None and guess.covariance is not None
        ]
        self._stream.log(
            "world/hypotheses/covariance",
            rerun.LineStrips3D(outlines, radii=0.02, colors=colors[: len(outlines)]),
        )

    def _show_trail(self, name: str, pose: Pose2D | None, color: str) -> None:
        trail = self._trails[name]
        if pose is None:
            return
        trail.append((pose.x, pose.y, 0.03))
        entity = self._rerun.Points3D(list(trail), radii=0.05, colors=_color(color))
        self._stream.log(f"world/trail/{name}", entity)

    def _show_numbers(self, answer: ScanAnswer) -> None:
        rerun = self._rerun
        best = answer.guesses[0] if answer.guesses else None
        probability = 0.0 if best is None else best.probability
        self._stream.log("belief/probability", rerun.Scalars(probability))
        left = 1.0 - sum(guess.probability for guess in answer.guesses)
        self._stream.log("belief/elsewhere", rerun.Scalars(max(left, 0.0)))
        if math.isfinite(answer.seconds):
            self._stream.log("time/milliseconds", rerun.Scalars(1e3 * answer.seconds))
        level = "INFO" if answer.accepted else "WARN"
        self._stream.log("words", rerun.TextLog(_words(answer), level=level))

    def _arrows(
        self, poses: Sequence[Pose2D], colors: Any, radius: float, labels: Sequence[str] = ()
    ) -> Any:
        """Arrows at poses, along their headings."""
        origins = np.array([(pose.x, pose.y, 0.05) for pose in poses]).reshape(-1, 3)
        vectors = np.array(
            [(_NOSE * math.cos(pose.theta), _NOSE * math.sin(pose.theta), 0.0) for pose in poses]
        ).reshape(-1, 3)
        return self._rerun.Arrows3D(
            origins=origins,
            vectors=vectors,
            radii=radius,
            colors=colors,
            labels=list(labels) or None,
        )


def _load() -> Any:
    """Import Rerun without its usage statistics.

    Raises:
        MissingExtraError: It is not installed.
    """
    with _unattended():
        try:
            import rerun
        except ImportError:
            raise MissingExtraError("the viewer", "view") from None
    return rerun


@contextmanager
def _unattended() -> Iterator[None]:
    """Let Rerun, and what it starts, see that it must send nothing."""
    before = os.environ.get("CI")
    os.environ["CI"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["CI"]
        else:
            os.environ["CI"] = before


def _flat(points: NDArray[np.float64], height: float = 0.0) -> NDArray[np.float64]:
    """(N, 3) points above the plane of the map."""
    return np.column_stack((points, np.full(len(points), height)))


def _color(name: str, share: float = 1.0) -> tuple[int, int, int, int]:
    """Red, green, blue and how opaque, of 255; a small share is faint but can be seen."""
    red, green, blue = (int(name[k : k + 2], 16) for k in (1, 3, 5))
    known = share if math.isfinite(share) else 0.0
    return red, green, blue, int(60 + 195 * min(max(known, 0.0), 1.0))


def _words(answer: ScanAnswer) -> str:
    """Say what an answer amounts to."""
    if not answer.guesses:
        return f"scan {answer.scan}: {answer.reason or 'not known'}"
    best = answer.guesses[0]
    where = f"near reference {best.reference}" if best.pose is None else _where(best.pose)
    verdict = "located" if answer.accepted else "not known; best guess"
    if best.ambiguous:
        verdict = "at one of several places alike; best guess"
    return f"scan {answer.scan}: {verdict} {where}, probability {best.probability:.3f}"


def _where(pose: Pose2D) -> str:
    return f"x {pose.x:.2f} m, y {pose.y:.2f} m, {math.degrees(pose.theta):.0f} degrees"
