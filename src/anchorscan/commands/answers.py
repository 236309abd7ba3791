"""``locate``, ``which`` and ``track``: where the scans of a log were taken, a line of JSON each."""

from __future__ import annotations

import signal
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from itertools import islice, tee
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import LogError, ReferenceSetError
from .console import refuse_overwriting, say, write_lines
from .logs import records_shown, refuse_mirrored
from .options import (
    CandidatesOption,
    LinesOption,
    LogArgument,
    LogOptions,
    ProcessesOption,
    SetArgument,
    SettingsOptions,
    SharingOptions,
)

if TYPE_CHECKING:
    from ..hypothesis import Hypothesis
    from ..io import Log
    from ..pose import Pose2D
    from ..record import Record
    from ..reference_set import ReferenceSet
    from ..settings import Settings
    from ..spread_fleet import SpreadFleet

__all__ = ["locate", "track", "which"]

# Digits that a user can use: a micrometre, a microradian, and six of a covariance.
_DECIMALS = 6
# Scans that a worker process takes at once, and how many such lots may wait for it.
_CHUNK = 16
_CHUNKS_AHEAD = 4


def locate(
    set_file: SetArgument,
    log: LogArgument,
    candidates: CandidatesOption = None,
    output: LinesOption = None,
    processes: ProcessesOption = 1,
    *,
    reading: LogOptions,
    settings: SettingsOptions,
) -> None:
    """Say where every scan of a log was taken, each on its own, with no prior.

    One JSON object a scan, in the order of the log, hypotheses best first; the poses are those
    of the laser in the frame of the set, in metres and radians.
    """
    refuse_overwriting([output], [set_file, log, settings.settings_file])
    opened = reading.open(log)
    chosen = settings.read()
    records = records_shown(opened, "locating", output)
    told: Counter[str] = Counter()
    lines = _located(records, set_file, chosen, candidates, processes, opened)
    for line in write_lines(lines, output):
        told["unusable" if "reason" in line else line["state"]] += 1
    say(
        f"{log}: {told.total()} scans: {told['located']} located, {told['ambiguous']} ambiguous, "
        f"{told['unknown']} not known, {told['unusable']} unusable"
    )


def which(
    sets: Annotated[
        list[Path],
        typer.Argument(
            metavar="SET... LOG", help="Reference sets, or folders of them; then a log."
        ),
    ],
    output: LinesOption = None,
    *,
    reading: LogOptions,
    settings: SettingsOptions,
    sharing: SharingOptions,
) -> None:
    """Say in which of many buildings every scan of a log was taken, and where in it.

    One JSON object a scan, as of locate; every hypothesis names its building: the file of its set
    without ".apr". A probability is that the building and the pose are right, among all sets.

    Workers, if there are any, share the sets: each holds a part of them.
    """
    from ..spread_fleet import SpreadFleet

    *places, log = sets
    if not places:
        raise typer.BadParameter("give reference sets, and a log after them")
    refuse_overwriting([output], [*sets, settings.settings_file])
    opened = reading.open(log)
    chosen = settings.read()
    records = records_shown(opened, "asking", output)
    accepted: dict[str, int] = {}
    count = ambiguous = 0
    with sharing.cluster() as spread:
        fleet = SpreadFleet(places, spread, chosen)
        for line in write_lines(_which_lines(fleet, records), output):
            count += 1
            ambiguous += line["state"] == "ambiguous"
            if line["accepted"]:
                building = line["hypotheses"][0]["building"]
                accepted[building] = accepted.get(building, 0) + 1
    told = ", ".join(f"{number} in {name}" for name, number in sorted(accepted.items()))
    say(f"{log}: {count} scans, {len(fleet)} sets: {told or 'none located'}, {ambiguous} ambiguous")


def track(
    set_file: SetArgument,
    log: LogArgument,
    output: LinesOption = None,
    tum: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write where the robot was located as a TUM trajectory, too."
        ),
    ] = None,
    window: Annotated[
        float,
        typer.Option(
            min=0.0,
            metavar="M",
            help="Search with the scans of the latest M metres joined into a view all around.",
        ),
    ] = 0.0,
    *,
    reading: LogOptions,
    settings: SettingsOptions,
) -> None:
    """Follow a robot through a log: scans and odometry in order, with no prior.

    One JSON object a scan; "accepted" says whether the robot is located. The poses are those
    of the laser in the frame of the set, in metres and radians.
    """
    from ..io import write_tum

    refuse_overwriting([output, tum], [set_file, log, settings.settings_file])
    opened = reading.open(log)
    chosen = settings.read()
    records = records_shown(opened, "tracking", output)
    accepted = count = 0
    trajectory: list[tuple[float, Pose2D]] = []
    lines = _tracked(records, set_file, chosen, opened, window)
    for line in write_lines(lines, output):
        count += 1
        accepted += line["accepted"]
        if line["accepted"] and line["stamp"] is not None:
            trajectory.append((line["stamp"], _pose_of(line)))
    say(f"{log}: located at {accepted} of {count} scans")
    if tum is not None:
        if accepted and not trajectory:
            raise LogError("has no times, and a trajectory in TUM format needs them", log)
        say(f"{tum}: {write_tum(tum, trajectory)} poses")


class _Locator:
    """Locates records in an opened set; one for every process."""

    def __init__(self, set_file: Path, settings: Settings | None, candidates: Any) -> None:
        from ..reference_set import ReferenceSet

        self.places: ReferenceSet = ReferenceSet.open(set_file, settings=settings)
        self._candidates = candidates
        self.places.prepare()

    def line(self, record: Record) -> dict[str, Any]:
        """Return the line of ``locate`` for a record."""
        from ..scan_message import state_values

        hypotheses: list[Hypothesis] = []
        start = time.perf_counter()
        if record.scan is not None:
            hypotheses = self.places.locate(record.scan, self._candidates)
        seconds = time.perf_counter() - start
        line: dict[str, Any] = {
            "scan": record.index,
            "stamp": record.stamp,
            "seconds": round(seconds, _DECIMALS + 1),
            **state_values(hypotheses),
            "hypotheses": [_hypothesis_line(hypothesis) for hypothesis in hypotheses],
        }
        if not hypotheses:
            line["reason"] = self._reason(record)
        return line

    def _reason(self, record: Record) -> str:
        if record.scan is None:
            return record.problem
        return "no reading is a return" if len(self.places) else "the set has no references"


def _located(
    records: Iterable[Record],
    set_file: Path,
    settings: Settings | None,
    candidates: Any,
    processes: int,
    log: Log,
) -> Iterator[dict[str, Any]]:
    """Yield the lines of ``locate`` in the order of the records."""
    locator = _Locator(set_file, settings, candidates)
    refuse_mirrored(locator.places, log)
    if processes == 1:
        yield from map(locator.line, records)
        return
    import multiprocessing
    from concurrent.futures import Future, ProcessPoolExecutor

    # The kernels are compiled by now, and the others load them from numba's cache.
    del locator
    # Spawned, because the thread that draws the progress must not be forked.
    with ProcessPoolExecutor(
        processes,
        multiprocessing.get_context("spawn"),
        _start_worker,
        (set_file, settings, candidates),
    ) as pool:
        pending: deque[Future[list[dict[str, Any]]]] = deque()
        remaining = iter(records)
        for chunk in iter(lambda: list(islice(remaining, _CHUNK)), []):
            pending.append(pool.submit(_work, chunk))
            if len(pending) > _CHUNKS_AHEAD * processes:
                yield from pending.popleft().result()
        for future in pending:
            yield from future.result()


_worker: _Locator | None = None


def _start_worker(set_file: Path, settings: Settings | None, candidates: Any) -> None:
    global _worker  # noqa: PLW0603 - a worker process holds nothing else
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is told, and ends the workers
    _worker = _Locator(set_file, settings, candidates)


def _work(records: list[Record]) -> list[dict[str, Any]]:
    assert _worker is not None
    return [_worker.line(record) for record in records]


def _which_lines(fleet: SpreadFleet, records: Iterable[Record]) -> Iterator[dict[str, Any]]:
    """Yield the line of ``which`` for every record; its time is that since the one before."""
    import numpy as np

    from ..scan import LaserScan
    from ..scan_message import state_values

    nothing = LaserScan(np.empty(0, np.float32), 0.0, 1.0)
    kept, asked = tee(records)
    start = time.perf_counter()
    scans = (record.scan or nothing for record in asked)
    for record, found in zip(kept, fleet.locate_all(scans), strict=True):
        line: dict[str, Any] = {
            "scan": record.index,
            "stamp": record.stamp,
            "seconds": round(time.perf_counter() - start, _DECIMALS + 1),
            **state_values([each.hypothesis for each in found]),
            "hypotheses": [
                {"building": each.building, **_hypothesis_line(each.hypothesis)} for each in found
            ],
        }
        if not found:
            line["reason"] = record.problem or "no reading is a return"
        yield line
        start = time.perf_counter()


def _tracked(
    records: Iterable[Record],
    set_file: Path,
    settings: Settings | None,
    log: Log,
    window: float,
) -> Iterator[dict[str, Any]]:
    """Yield the line of ``track`` for every record."""
    from ..localizer import Localizer
    from ..pose import Pose2D
    from ..reference_set import ReferenceSet

    places = ReferenceSet.open(set_file, settings=settings)
    localizer = Localizer(places, window)
    if not places.has_poses and all(each.pose is None for each in places.references):
        raise ReferenceSetError(
            f"{set_file} has no poses in a common frame, and a robot is followed by them: use "
            "locate, or in Python TopologicalLocalizer"
        )
    places.prepare()
    refuse_mirrored(places, log)
    localizer.prepare()
    for record in records:
        line: dict[str, Any] = {"scan": record.index, "stamp": record.stamp}
        if record.scan is None:
            yield {**line, "seconds": 0.0, "accepted": False, "reason": record.problem}
            continue
        start = time.perf_counter()
        mounting = record.T_base_laser or Pose2D()
        belief = localizer.update(record.scan, record.odometry, record.stamp, mounting)
        line["seconds"] = round(time.perf_counter() - start, _DECIMALS + 1)
        line["accepted"] = bool(belief.accepted)
        line |= _pose_line(belief.pose)
        spread = belief.covariance
        line["covariance"] = (
            None if spread is None else [[_significant(value) for value in row] for row in spread]
        )
        line["probability"] = round(belief.probability, _DECIMALS)
        line["state"] = belief.state
        yield line


def _hypothesis_line(hypothesis: Hypothesis) -> dict[str, Any]:
    return {
        "reference": hypothesis.reference,
        **_pose_line(hypothesis.pose),
        "covariance": [[_significant(value) for value in row] for row in hypothesis.covariance],
        "evaluation": round(hypothesis.evaluation, _DECIMALS),
        "quality": round(hypothesis.quality, _DECIMALS),
        "probability": round(hypothesis.probability, _DECIMALS),
        "ambiguous": hypothesis.ambiguous,
        "score": _significant(hypothesis.score),
        "pose_in_reference": _pose_line(hypothesis.pose_in_reference),
    }


def _pose_line(pose: Pose2D | None) -> dict[str, float | None]:
    if pose is None:  # the set has no common frame
        return {"x": None, "y": None, "theta": None}
    return {name: round(getattr(pose, name), _DECIMALS) for name in ("x", "y", "theta")}


def _pose_of(line: dict[str, Any]) -> Pose2D:
    from ..pose import Pose2D

    return Pose2D(line["x"], line["y"], line["theta"])


def _significant(value: float) -> float:
    return float(f"{value:.{_DECIMALS}g}")
