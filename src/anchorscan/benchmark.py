"""``anchorscan bench``: every protocol, every preset and the baselines on the same scans.

The protocols and the figures are in ``protocol.py``, tables and files in ``scoreboard.py``.
Every method is a function from a scan to poses, best first, made for one set of references; the
matcher, with each preset and number of candidates, is one, and so are the baselines:

* "exhaustive": branch and bound on the stitched map, ordered by the score of the best place;
* "exhaustive, margin": the same, ordered by that score less three quarters of the score of the
  best other place, which has to be proved as well and costs time;
* "karto": Karto's correlative matcher on the candidates of the relationship database.

Scores of baselines are no probabilities, so they have neither a shipped threshold nor a
calibration error.  Times are those of one call on one core, after warm-up, and hold for
comparison within a run.
"""

from __future__ import annotations

import hashlib
import importlib.util
import math
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import metadata
from itertools import permutations
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from . import __version__
from .cluster import Spread
from .errors import AnchorscanError, LogError, MissingExtraError
from .exhaustive_search import ExhaustiveSearch
from .hypothesis import Hypothesis
from .io import open_log
from .karto_matcher import KartoMatcher
from .matcher import Matcher
from .pose import Pose2D
from .progress import ProgressOf
from .protocol import Answer, Split, revisit, sparse, thin, two_sessions, unknown_place
from .record import Record
from .reference import Reference
from .scan import LaserScan
from .scoreboard import Score, Scoreboard, StageTimes, compared, pooled
from .settings import Settings
from .stage_times import stage_times

__all__ = [
    "BASELINES",
    "PROTOCOLS",
    "Drive",
    "Estimate",
    "Method",
    "Task",
    "default_drives",
    "default_logs",
    "measure",
    "preset_methods",
    "read_drives",
    "run",
    "tasks",
]

PROTOCOLS = ("P1", "P2", "P3", "P4")
BASELINES = ("exhaustive", "karto")

Candidates = int | Literal["all"] | None
Item = TypeVar("Item")

# What is known of public logs: the building, so that two drives of it are no unknown place; and
# the recording, so that one drive published twice is no independent visit.
_SAME_BUILDING = {
    "wean-2": "wean",
    "wean-3": "wean",
    "intel-dense": "intel",
}
_SAME_RECORDING = {"intel-dense": "intel"}
_LEFT_OUT = {
    "intel-dense": "the same recording as intel",
    "orebro": "its poses are too rough to score by",
}
# Corridors that look alike, where no single scan can be sure: measured, but not pooled.
_LOOK_ALIKE = {"killian"}
# Drives on which a robot gets lost (P5): with odometry, or so long that made odometry will do.
_LOST = ("intel-dense", "wean-2", "wean-3", "killian")

# How far the poses of public logs are from the truth, metres, as those say who made them; and
# how far two solutions of one recording are turned against each other, radians.
_TRUTH_DEVIATION = {
    "csail": 0.03,
    "freiburg-079": 0.05,
    "freiburg-101": 0.02,
    "intel": 0.03,
    "intel-dense": 0.03,
    "killian": 0.04,
    "wean-2": 0.01,
    "wean-3": 0.01,
}
_TRUTH_TURN = math.radians(0.3)

_DATA = "../shared/data"
_SUFFIXES = (".log", ".clf", ".g2o", ".log.gz", ".clf.gz", ".g2o.gz", ".g2o.zip")
_WARM_UP = 3
# Queries that a worker takes at once.
_CHUNK = 64
_STAGE_QUERIES = 200
_MARGIN_WEIGHT = 0.75
_KARTO_CANDIDATES = 5


class Answering(Protocol):
    """What a method says of one scan: a pose, and how sure it is; a `Hypothesis` is one."""

    @property
    def pose(self) -> Pose2D | None: ...
    @property
    def probability(self) -> float: ...
    @property
    def accepted(self) -> bool: ...
    @property
    def covariance(self) -> NDArray[np.float64] | None: ...


Locate = Callable[[LaserScan], Sequence[Answering]]


@dataclass(frozen=True, eq=False)
class Drive:
    """One log, read.

    Args:
        name: What tables call it.
        records: All of its records, in order.
        building: Drives of the same building are no unknown place to each other.
        recording: Drives from the same recording are no independent visits.
        path: The file, for the record.
    """

    name: str
    records: tuple[Record, ...]
    building: str
    recording: str
    path: Path | None = None


@dataclass(frozen=True, eq=False)
class Task:
    """A split to be measured.

    Args:
        protocol: "P1" to "P4".
        place: What tables call it.
        known: Drive that the references come from.
        asked: Drive that the queries come from.
        split: Positions in the records of both.
    """

    protocol: str
    place: str
    known: Drive
    asked: Drive
    split: Split

    @cached_property
    def references(self) -> tuple[Reference, ...]:
        """The references, numbered from zero."""
        records = (self.known.records[position] for position in self.split.references)
        return tuple(
            Reference(number, record.scan, record.pose)
            for number, record in enumerate(records)
            if record.scan is not None
        )

    @property
    def buildings(self) -> tuple[str, str]:
        """Buildings of the references and of the queries."""
        return self.known.building, self.asked.building

    @property
    def looks_alike(self) -> bool:
        """Whether no single scan can be sure there."""
        return self.known.name in _LOOK_ALIKE

    @property
    def queries(self) -> Iterator[tuple[LaserScan, Pose2D | None]]:
        """The scans of the queries, each with its true pose; None in an unknown place."""
        for position in self.split.queries:
            record = self.asked.records[position]
            if record.scan is not None:
                yield record.scan, None if self.protocol == "P4" else record.pose


@dataclass(frozen=True)
class Estimate:
    """The answer of a method that has no `Hypothesis` to give.

    Args:
        pose: ``T_set_laser``.
        probability: What its answers are ordered by.
        accepted: Whether it stands by the answer.
        covariance: (3, 3) of the pose, or None.
    """

    pose: Pose2D | None
    probability: float
    accepted: bool = False
    covariance: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Method:
    """A way to locate scans.

    Args:
        name: What tables call it.
        prepare: Makes, for a set of references, the function that locates a scan.
        calibrated: Whether it reports probabilities and decides by itself.
        protocols: Those that it takes part in.
        queries: At most so many queries of a split, at equal steps; None for all.
        preset: The preset behind it; None for a baseline.
    """

    name: str
    prepare: Callable[[Sequence[Reference]], Locate]
    calibrated: bool = True
    protocols: tuple[str, ...] = PROTOCOLS
    queries: int | None = None
    preset: str | None = None


def run(
    logs: Sequence[str | Path] = (),
    presets: Sequence[str] = ("default",),
    protocols: Sequence[str] = PROTOCOLS,
    candidates: Sequence[Candidates] = (None, 1, 5, "all"),
    output_folder: str | Path | None = None,
    queries: int | None = None,
    seed: int = 0,
    baselines: Sequence[str] = BASELINES,
    baseline_queries: int | None = 136,
    say: Callable[[str], None] = lambda line: None,
    progress: ProgressOf = lambda items, what, total=None: items,
    spread: Spread | None = None,
    range_max: float | None = None,
) -> Scoreboard:
    """Measure presets and baselines by the protocols, and keep what was found.

    Args:
        logs: Logs with poses, each a path or "BUILDING=PATH"; drives of one building that are
            given after each other make two sessions (P3).  Without any: those of
            `default_logs`.
        presets: Names of presets.
        protocols: Of "P1" to "P4".
        candidates: References that may be searched: numbers, "all", None for the preset's own.
        output_folder: For results, settings and pictures; None writes nothing.
        queries: At most so many queries of each split, at equal steps; None for all.
        seed: Moves where the steps begin.
        baselines: Of "exhaustive" and "karto".
        baseline_queries: At most so many queries of each split for the baselines, among those
            of the presets; None for as many.
        say: Takes the lines of the tables and messages.
        progress: Wraps what takes a while.
        spread: Shares the queries among workers, which must find the logs under the same paths;
            None asks them all here.  The answers are the same, but for their times.
        range_max: From this range on, metres, a reading of a query or a reference means "no
            return", as if a laser that sees no farther had been there; None for the logs' own.

    A log that cannot be read is named, and the others are measured.

    Raises:
        AnchorscanError: There are no logs, none can be read, a name is unknown, or no split
            has a query.
        OSError: The folder cannot be written.
    """
    arguments = {
        "presets": list(presets),
        "protocols": list(protocols),
        "candidates": list(candidates),
        "queries": queries,
        "seed": seed,
        "baselines": list(baselines),
        "baseline_queries": baseline_queries,
        "range_max": range_max,
    }
    _check(protocols, PROTOCOLS, "protocol")
    _check(baselines, BASELINES, "baseline")
    settings = {name: Settings.preset(name) for name in presets}
    methods = [
        *preset_methods(settings, candidates),
        *_baseline_methods(baselines, baseline_queries, say),
    ]
    paths = list(logs) or default_logs(say)
    drives, unread = _readable(progress(paths, "reading", len(paths)), len(paths), range_max)
    todo = tasks(drives, protocols)
    for drive in drives:
        if not any(drive in (task.known, task.asked) for task in todo):
            say(f"{drive.name}: no protocol finds a query in it")
    if not todo:
        raise AnchorscanError("no split has a query: the drives visit no place twice")
    start = time.perf_counter()
    if spread is None or not spread.workers:
        scores = [each for task in todo for each in measure(task, methods, queries, seed, progress)]
    else:
        known = [_from_anywhere(path) for path in paths if str(path) not in unread]
        plan = _Plan(
            tuple(known),
            tuple(protocols),
            tuple((name, preset.to_json()) for name, preset in settings.items()),
            tuple(candidates),
            tuple(baselines),
            baseline_queries,
            range_max,
        )
        scores = _measure_spread(plan, todo, methods, queries, seed, progress, spread)
    if spread is not None:
        count = sum(len(score.answers) for score in scores)
        by = f"{spread.workers} workers" if spread.workers else "this process"
        say(f"{count} questions answered in {time.perf_counter() - start:.1f} s by {by}")
    stages = [
        each
        for task in todo
        if task.protocol in ("P1", "P3")
        for each in _stages(task, methods, queries, seed)
    ]
    board = Scoreboard(
        scores=(*scores, *pooled([s for s in scores if _is_pooled(s)])),
        comparisons=tuple(compared([s for s in scores if s.protocol != "P4"], "exhaustive")),
        stages=tuple(stages),
        settings=_circumstances(drives, arguments),
        presets={name: preset.to_json() for name, preset in settings.items()},
    )
    for line in board.lines():
        say(line)
    if output_folder is not None:
        _keep(board, Path(output_folder), say)
    for reason in unread.values():
        say(f"not read: {reason}")
    return board


def default_logs(say: Callable[[str], None] = lambda line: None) -> list[Path]:
    """Find the logs of the data folder, and MIT Killian Court where ``rtb-data`` is installed.

    The folder is named by the environment variable ANCHORSCAN_DATA, ``../shared/data`` if unset.

    Raises:
        AnchorscanError: There are none.
    """
    paths = _logs(say)
    for path in paths:
        if reason := _LEFT_OUT.get(_name(path)):
            say(f"{_name(path)} is left out: {reason}")
    return _some([path for path in paths if _name(path) not in _LEFT_OUT])


def default_drives(say: Callable[[str], None] = lambda line: None) -> list[Path]:
    """Find the logs on which P5 is measured, as `default_logs` does.

    Raises:
        AnchorscanError: There are none.
    """
    return _some([path for path in _logs(say) if _name(path) in _LOST])


def _logs(say: Callable[[str], None]) -> list[Path]:
    folder = Path(os.environ.get("ANCHORSCAN_DATA", _DATA))
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    kept = [path for path in found if path.name.endswith(_SUFFIXES)]
    package = importlib.util.find_spec("rtbdata")
    if package is not None and package.origin is not None:
        kept += [p for p in (Path(package.origin).parent / "data").glob("killian.g2o.zip")]
    else:
        say("killian is left out: pip install 'anchorscan[bench]' brings it")
    return kept


def _some(paths: list[Path]) -> list[Path]:
    if not paths:
        folder = Path(os.environ.get("ANCHORSCAN_DATA", _DATA))
        raise AnchorscanError(
            f"no logs in {folder}: name some, or set ANCHORSCAN_DATA to their folder"
        )
    return paths


def read_drives(logs: Iterable[str | Path], range_max: float | None = None) -> list[Drive]:
    """Read logs, each a path or "BUILDING=PATH".

    Args:
        logs: The logs.
        range_max: From this range on, metres, a reading means "no return"; None for the logs' own.

    Raises:
        LogError: A log cannot be read.
        AnchorscanError: Two logs have the same name.
    """
    drives: dict[str, Drive] = {}
    for log in logs:
        building, path = _building_and_path(log)
        name = _name(path)
        if name in drives:
            raise AnchorscanError(f"two logs are called {name}: rename one of them")
        drives[name] = Drive(
            name,
            tuple(open_log(path, range_max=range_max)),
            building or _SAME_BUILDING.get(name, name),
            _SAME_RECORDING.get(name, name),
            path,
        )
    return list(drives.values())


def _readable(
    logs: Iterable[str | Path], count: int, range_max: float | None
) -> tuple[list[Drive], dict[str, str]]:
    """Read the logs that can be read; give the reasons for the others by their names.

    Raises:
        LogError: There is but one log, and it cannot be read.
        AnchorscanError: None can be read, or two have the same name.
    """
    drives: list[Drive] = []
    unread: dict[str, str] = {}
    for log in logs:
        try:
            (drive,) = read_drives([log], range_max)
        except LogError as error:
            if count == 1:
                raise
            unread[str(log)] = str(error)
            continue
        if any(drive.name == other.name for other in drives):
            raise AnchorscanError(f"two logs are called {drive.name}: rename one of them")
        drives.append(drive)
    if unread and not drives:
        raise AnchorscanError(f"no log can be read: {next(iter(unread.values()))}")
    return drives, unread


def tasks(drives: Sequence[Drive], protocols: Sequence[str] = PROTOCOLS) -> list[Task]:
    """Make the splits of all protocols, those without a query left out.

    A drive that is one of two sessions (P3) is not measured against itself (P1, P2) as well, so
    that no place counts twice; in unknown places (P4) every building counts once.
    """
    sessions = [
        (first, second)
        for i, first in enumerate(drives)
        for second in drives[i + 1 :]
        if first.building == second.building and first.recording != second.recording
    ]
    paired = {drive.name for pair in sessions for drive in pair}
    alone = [drive for drive in drives if drive.name not in paired]
    buildings = list({drive.building: drive for drive in reversed(drives)}.values())[::-1]
    made = []
    if "P1" in protocols:
        made += [Task("P1", d.name, d, d, revisit(d.records)) for d in alone]
    if "P2" in protocols:
        usual = [drive for drive in alone if drive.name not in _LOOK_ALIKE]
        made += [Task("P2", d.name, d, d, sparse(d.records)) for d in usual]
    if "P3" in protocols:
        made += [
            Task("P3", f"{a.name} -> {b.name}", a, b, two_sessions(a.records, b.records))
            for a, b in sessions
        ]
    if "P4" in protocols:
        made += [
            Task("P4", f"{a.name} -> {b.name}", a, b, unknown_place(a.records, b.records))
            for a, b in permutations(buildings, 2)
        ]
    return [task for task in made if task.split.queries and task.split.references]


def preset_methods(presets: dict[str, Settings], candidates: Sequence[Candidates]) -> list[Method]:
    """Make a method of every preset with every number of candidates.

    A number that is the preset's own is not measured twice.
    """
    methods = []
    for name, settings in presets.items():
        matchers = _Matchers(settings)
        own = settings.database.candidates or "all"
        for number in dict.fromkeys(candidates):
            if number == own and None in candidates:
                continue
            shown = {None: "", "all": ", all", 1: ", 1 candidate"}
            label = name + shown.get(number, f", {number} candidates")
            methods.append(Method(label, _Preparing(matchers, number), preset=name))
    return methods


def measure(
    task: Task,
    methods: Sequence[Method],
    queries: int | None = None,
    seed: int = 0,
    progress: ProgressOf = lambda items, what, total=None: items,
) -> list[Score]:
    """Ask every method every query of a split.

    Args:
        task: The split.
        methods: Those that do not take part in the protocol are passed over.
        queries: At most so many, at equal steps; None for all.
        seed: Moves where the steps begin.
        progress: Wraps the queries.
    """
    scores = []
    for method in methods:
        asked = _asked(task, method, queries, seed)
        if not asked:
            continue
        locate = method.prepare(task.references)
        for position in asked[:_WARM_UP]:
            locate(_scan(task, position))
        what = f"{task.protocol} {task.place}: {method.name}"
        answers = tuple(
            _ask(task, locate, position) for position in progress(asked, what, len(asked))
        )
        scores.append(_score(task, method, answers))
    return scores


def _asked(task: Task, method: Method, queries: int | None, seed: int) -> tuple[int, ...]:
    """Give the positions of the queries that a method is asked."""
    if task.protocol not in method.protocols:
        return ()
    return thin(thin(task.split.queries, queries, seed), method.queries, seed)


def _score(task: Task, method: Method, answers: tuple[Answer, ...]) -> Score:
    number = len(task.references)
    return Score(task.protocol, task.place, method.name, number, answers, method.calibrated)


@dataclass(frozen=True)
class _Plan:
    """From which another process makes the same splits and methods."""

    logs: tuple[str, ...]
    protocols: tuple[str, ...]
    presets: tuple[tuple[str, str], ...]
    candidates: tuple[Candidates, ...]
    baselines: tuple[str, ...]
    baseline_queries: int | None
    range_max: float | None


@dataclass(frozen=True)
class _Piece:
    """Some queries of one split for one method, by their numbers in the plan."""

    plan: _Plan
    task: int
    method: int
    queries: tuple[int, ...]


def _measure_spread(
    plan: _Plan,
    todo: Sequence[Task],
    methods: Sequence[Method],
    queries: int | None,
    seed: int,
    progress: ProgressOf,
    spread: Spread,
) -> list[Score]:
    """Do as ``measure`` for all splits, in pieces."""
    pieces = [
        _Piece(plan, t, m, asked[start : start + _CHUNK])
        for t, task in enumerate(todo)
        for m, method in enumerate(methods)
        for asked in [_asked(task, method, queries, seed)]
        for start in range(0, len(asked), _CHUNK)
    ]
    answers: dict[tuple[int, int], list[Answer]] = {}
    for done in progress(spread.map(_answers, pieces), "asking", len(pieces)):
        if done.value is None:
            raise AnchorscanError(str(done.error))
        answers.setdefault((done.item.task, done.item.method), []).extend(done.value)
    return [_score(todo[t], methods[m], tuple(given)) for (t, m), given in answers.items()]


@lru_cache(maxsize=1)
def _planned(plan: _Plan) -> tuple[list[Task], list[Method]]:
    """Read the logs once in every process."""
    settings = {name: Settings.from_json(text) for name, text in plan.presets}
    methods = [
        *preset_methods(settings, plan.candidates),
        *_baseline_methods(plan.baselines, plan.baseline_queries, lambda line: None),
    ]
    return tasks(read_drives(plan.logs, plan.range_max), plan.protocols), methods


@lru_cache(maxsize=2)
def _ready(plan: _Plan, task: int, method: int) -> Locate:
    todo, methods = _planned(plan)
    return methods[method].prepare(todo[task].references)


def _answers(piece: _Piece) -> list[Answer]:
    """Answer the queries of a piece, in a worker."""
    task = _planned(piece.plan)[0][piece.task]
    locate = _ready(piece.plan, piece.task, piece.method)
    for position in piece.queries[:_WARM_UP]:
        locate(_scan(task, position))
    return [_ask(task, locate, position) for position in piece.queries]


def _ask(task: Task, locate: Locate, position: int) -> Answer:
    scan = _scan(task, position)
    start = time.perf_counter()
    found = locate(scan)
    seconds = time.perf_counter() - start
    known = task.protocol != "P4"
    truth = task.asked.records[position].pose if known else None
    if not found:
        return Answer(position, None, truth, math.nan, False, seconds)
    best = found[0]
    covariance = None
    if known and best.covariance is not None:
        covariance = best.covariance + _truth_covariance(task.asked)
    return Answer(
        position,
        best.pose,
        truth,
        best.probability,
        best.accepted,
        seconds,
        covariance,
        _others(found),
    )


def _others(found: Sequence[Answering]) -> tuple[Pose2D, ...]:
    """Poses of the places that explain an ambiguous scan as the best one does."""
    alike = [each.pose for each in found if isinstance(each, Hypothesis) and each.ambiguous]
    return tuple(pose for pose in alike[1:] if pose is not None)


def _truth_covariance(drive: Drive) -> NDArray[np.float64]:
    """Return what is known of the error of a drive's poses; zeros for logs of others."""
    deviation = _TRUTH_DEVIATION.get(drive.name)
    if deviation is None:
        return np.zeros((3, 3))
    return np.diag(np.square((deviation, deviation, _TRUTH_TURN)))


def _scan(task: Task, position: int) -> LaserScan:
    """Give the scan of a query, as a new value: nothing derived may be left over in it."""
    scan = task.asked.records[position].scan
    assert scan is not None
    return LaserScan(
        scan.ranges, scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max
    )


def _stages(
    task: Task, methods: Sequence[Method], queries: int | None, seed: int
) -> Iterator[StageTimes]:
    """Measure where the time of each preset goes, after all its kernels have run."""
    for method in methods:
        if method.preset is None:
            continue
        asked = thin(thin(task.split.queries, queries, seed), _STAGE_QUERIES, seed)
        locate = method.prepare(task.references)
        scans = [_scan(task, position) for position in asked]
        locate(scans[0])
        with stage_times() as seconds:
            start = time.perf_counter()
            for scan in scans:
                locate(scan)
            total = time.perf_counter() - start
        means = {stage: spent / len(scans) for stage, spent in seconds.items()}
        means["rest"] = total / len(scans) - sum(means.values())
        yield StageTimes(task.protocol, task.place, method.name, len(scans), means)


class _Matchers:
    """Keeps the matcher of the latest references, since several methods ask for it."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._references: Sequence[Reference] | None = None
        self._matcher: Matcher | None = None

    def of(self, references: Sequence[Reference]) -> Matcher:
        if self._matcher is None or self._references is not references:
            self._matcher = Matcher(references, self._settings)
            self._matcher.prepare()
            self._references = references
        return self._matcher


@dataclass(frozen=True)
class _Preparing:
    """Prepares one preset with one number of candidates."""

    matchers: _Matchers
    candidates: Candidates

    def __call__(self, references: Sequence[Reference]) -> Locate:
        matcher = self.matchers.of(references)
        return lambda scan: matcher.locate(scan, self.candidates)


def _baseline_methods(
    names: Sequence[str], queries: int | None, say: Callable[[str], None]
) -> list[Method]:
    methods = []
    protocols = ("P1", "P2", "P3")
    if "exhaustive" in names:
        methods += [
            Method("exhaustive", _prepare_exhaustive, False, protocols, queries),
            Method("exhaustive, margin", _prepare_margin, False, protocols, queries),
        ]
    if "karto" in names:
        try:
            KartoMatcher(lambda scan: ())
            methods.append(Method("karto", _prepare_karto, False, protocols, queries))
        except MissingExtraError as error:
            say(f"karto is left out: {error}")
    return methods


def _prepare_exhaustive(references: Sequence[Reference]) -> Locate:
    search = ExhaustiveSearch(references)

    def locate(scan: LaserScan) -> list[Estimate]:
        return [Estimate(place.pose, place.score) for place in search.locate(scan, 1)]

    return locate


def _prepare_margin(references: Sequence[Reference]) -> Locate:
    search = ExhaustiveSearch(references)

    def locate(scan: LaserScan) -> list[Estimate]:
        places = search.locate(scan, 2)
        rival = places[1].score if len(places) > 1 else 0.0
        return [Estimate(place.pose, place.score - _MARGIN_WEIGHT * rival) for place in places[:1]]

    return locate


def _prepare_karto(references: Sequence[Reference]) -> Locate:
    matcher = Matcher(references, Settings.preset("paper"))
    matcher.prepare()
    by_identifier = {reference.identifier: reference for reference in references}

    def candidates(scan: LaserScan) -> list[Reference]:
        search = matcher.explain(scan, _KARTO_CANDIDATES).pairwise
        voted = [] if search is None else search.votes.references.tolist()
        return [by_identifier[identifier] for identifier in voted]

    karto = KartoMatcher(candidates)
    return lambda scan: [Estimate(one.pose, one.response) for one in karto.locate(scan)]


def _is_pooled(score: Score) -> bool:
    return score.protocol in ("P1", "P3") and score.place not in _LOOK_ALIKE


def _check(names: Sequence[str], known: Sequence[str], what: str) -> None:
    for name in names:
        if name not in known:
            raise AnchorscanError(f"unknown {what} {name!r}: there are {', '.join(known)}")


def _building_and_path(log: str | Path) -> tuple[str, Path]:
    """Take "BUILDING=PATH" apart, unless a file is called so."""
    building, separator, path = str(log).partition("=")
    if isinstance(log, str) and separator and not Path(log).exists():
        return building, Path(path)
    return "", Path(log)


def _from_anywhere(log: str | Path) -> str:
    """Name a log so that a process in another working directory finds it."""
    building, path = _building_and_path(log)
    return f"{building}={path.absolute()}" if building else str(path.absolute())


def _name(path: Path) -> str:
    """Return the name of a log without its endings."""
    name = path.name
    for suffix in sorted(_SUFFIXES, key=len, reverse=True):
        name = name.removesuffix(suffix)
    return name


def _circumstances(drives: Sequence[Drive], arguments: dict[str, Any]) -> dict[str, Any]:
    """Say what was run, where, and on what, so that it can be run again."""
    return {
        "anchorscan": __version__,
        "arguments": arguments,
        "machine": {
            "system": platform.platform(),
            "processor": _processor(),
            "python": platform.python_version(),
            **{package: metadata.version(package) for package in ("numpy", "numba")},
        },
        "logs": [
            {
                "name": drive.name,
                "building": drive.building,
                "records": len(drive.records),
                "sha256": "" if drive.path is None else _digest(drive.path),
            }
            for drive in drives
        ],
    }


def _processor() -> str:
    """Return the name of the processor where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _digest(path: Path) -> str:
    if not path.is_file():
        return ""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _keep(board: Scoreboard, folder: Path, say: Callable[[str], None]) -> None:
    files = board.write(folder)
    try:
        files += board.draw(folder)
    except MissingExtraError as error:
        say(f"no pictures: {error}")
    say("")
    for path in files:
        say(str(path))
