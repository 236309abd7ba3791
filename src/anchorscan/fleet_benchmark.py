"""``anchorscan bench-fleet``: which building, how surely, how fast, as buildings grow in number.

Every real drive gives a set and later scans of the same building (P1 and P3 of ``protocol.py``);
simulated buildings give sets as many as wanted, some of them queries as well, taken on
another drive after furniture was moved and doors were turned.  Every query is asked of N sets
that hold its building (*known*), and of N sets that do not (*unknown*, where every answer is
wrong).  The sets are searched one after the other and let go, so that a thousand need the memory
of one; the time for N sets is the sum over them.

The one number of ``fleet.py``, how fast the odds fall with the number of sets, is fitted on the
simulated queries and scored on the real ones, and the other way round; unknown places weigh
0.3, as for the decision of one set.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from .building import random_building
from .covariance import held
from .decision import DecisionSettings, beside, covariance, evidence
from .description import Description, describe
from .errors import AnchorscanError
from .fleet import LOOK_ALIKES, TWINS, BuildingFits, Fleet, decide_over, ranked, search
from .pose import Pose2D
from .progress import ProgressOf
from .protocol import Case, is_correct, recall_at_precision, reliability, thin
from .reference_set import ReferenceSet
from .scan import LaserScan
from .sensor import SensorModel
from .settings import Settings
from .simulator import drive, random_poses, simulate
from .verification import FEATURES
from .world import World, move_furniture, turn_doors

__all__ = [
    "Asked",
    "Outcome",
    "Twins",
    "fitted",
    "log_loss",
    "outcomes",
    "run",
    "table",
    "together",
    "twins",
]

Item = TypeVar("Item")

_STYLES = ("office", "hall", "lookalike")
_REFERENCES = 48
_DRIVE, _SECOND_DRIVE = 60.0, 40.0
_MOVED, _TURNED = 0.3, 0.3
_KEPT_FITS = 3
_TOGETHER = 16
_SCORE = FEATURES.index("score")
_TWIN_AT = Pose2D(1000.0, -500.0, 1.0)
_UNKNOWN_WEIGHT = 0.3
_TRIED = np.arange(0.0, 2.01, 0.05)


@dataclass(frozen=True, eq=False)
class Asked:
    """A query.

    Args:
        building: Name of the set that holds its place.
        scan: The scan.
        truth: ``T_set_laser`` in that set.
        is_real: Whether a real sensor took it.
    """

    building: str
    scan: LaserScan
    truth: Pose2D
    is_real: bool


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one query came to among N sets.

    Args:
        asked: The query.
        sets: N.
        is_known: Whether its building was among them.
        evidence: (6,) of the best fit of all.
        held: How likely a pose of its covariance is to be near enough.
        most: That the decision lets it be worth beside the others.
        is_right_building: Whether that fit is in the right building.
        is_correct: Whether building and pose are right.
        seconds: All searches and the decision; not the description of the scan, which is made once.
    """

    asked: Asked
    sets: int
    is_known: bool
    evidence: NDArray[np.float64]
    held: float
    most: float
    is_right_building: bool
    is_correct: bool
    seconds: float


def run(
    cases: Sequence[Case],
    others: Sequence[tuple[str, ReferenceSet]],
    settings: Settings,
    sizes: Sequence[int] = (1, 10, 100, 1000),
    queries: int = 20,
    simulated: int = 10,
    seed: int = 0,
    folder: Path | None = None,
    say: Callable[[str], None] = lambda line: None,
    progress: ProgressOf = lambda items, what, total=None: items,
) -> list[Outcome]:
    """Measure, and say what was found.

    Args:
        cases: Real buildings with sets and queries.
        others: Sets that are asked as well, and have no queries.
        settings: Of all sets.
        sizes: Numbers of sets.
        queries: At most so many of each building, at equal steps.
        simulated: So many of the simulated buildings have queries.
        seed: Of the simulated buildings.
        folder: Where to write all sets with their indexes, to ask them once more as one fleet.
        say: Takes the lines of the tables.
        progress: Wraps what takes a while.

    Raises:
        AnchorscanError: There is no query.
    """
    asked = _questions(cases, queries, simulated, seed)
    if not asked:
        raise AnchorscanError("there is no building to ask for")
    for line in twins(_twins(cases, settings, simulated, queries, seed), settings):
        say(line)
    described = [describe(each.scan, settings) for each in asked]
    largest = max(sizes) + 1
    shards = _shards(cases, others, settings, seed, max(simulated, largest))
    needed = len(cases) + simulated
    total = max(needed, largest)
    found: list[list[tuple[str, BuildingFits | None, float]]] = [[] for _ in asked]
    for number, (name, places) in enumerate(progress(shards, "asking sets", total)):
        if number >= total:
            break
        places.locate(asked[0].scan)  # derives the index
        if folder is not None:
            _keep(folder / f"{name}.apr", places, settings)
        for description, so_far in zip(described, found, strict=True):
            so_far.append((name, *_timed(name, places, description)))
        for size in sizes:
            if number == max(size, needed) - 1 + (size >= needed):
                say(f"{size} sets:")
                for line in _brief(_all_outcomes(asked, found, size, settings), settings):
                    say(line)
    results = [outcome for size in sizes for outcome in _all_outcomes(asked, found, size, settings)]
    for line in table(results, settings.decision):
        say(line)
    if folder is not None:
        del found
        for line in together(folder, [each.scan for each in asked], settings):
            say(line)
    return results


def together(folder: Path, scans: Sequence[LaserScan], settings: Settings) -> Iterator[str]:
    """Open all sets of a folder in this process, ask them, and tell what that takes.

    Args:
        folder: With the files of sets.
        scans: To ask with; some of them, at equal steps.
        settings: Of all sets.
    """
    before, start = _memory(), time.perf_counter()
    fleet = Fleet.open([folder], settings=settings)
    opened = time.perf_counter() - start
    fleet.prepare()
    prepared = time.perf_counter() - start - opened
    scans = scans[:: -(-len(scans) // _TOGETHER)]
    for scan in scans:
        fleet.locate(scan)  # maps what it reads
    own, mapped = (after - at for after, at in zip(_memory(), before, strict=True))
    yield (
        f"{len(fleet)} sets opened in {opened:.1f} s and prepared in {prepared:.1f} s; they take "
        f"{own:.0f} MB of memory and {mapped:.0f} MB of mapped files"
    )
    spent, used = [], time.process_time()
    for scan in scans:
        start = time.perf_counter()
        fleet.locate(scan)
        spent.append(time.perf_counter() - start)
    used = (time.process_time() - used) / len(scans)
    middle, late = (1e3 * float(np.percentile(spent, q)) for q in (50, 99))
    yield (
        f"a query: median {middle:.0f} ms, 99 % {late:.0f} ms, "
        f"{1e3 * used:.0f} ms of processor time"
    )


def _keep(path: Path, places: ReferenceSet, settings: Settings) -> None:
    """Write a set and its index, if it is not there."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        places.save(path)
        with ReferenceSet.open(path, settings=settings) as stored:
            stored.save_index()


def _memory() -> tuple[float, float]:
    """Return the megabytes of this process, its own and of files; NaN where nobody tells."""
    try:
        text = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        return math.nan, math.nan
    told = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    own, mapped = (float(told[name].split()[0]) / 1024 for name in ("RssAnon", "RssFile"))
    return own, mapped


def _questions(cases: Sequence[Case], queries: int, simulated: int, seed: int) -> list[Asked]:
    """Give the queries of real and of simulated buildings."""
    asked = [
        Asked(case.place, scan, truth, True)
        for case in cases
        for scan, truth in _thinned(case, queries, seed)
    ]
    for number in range(simulated):
        asked += _simulated_queries(number, seed, queries)
    return asked


def _all_outcomes(
    asked: Sequence[Asked],
    found: Sequence[Sequence[tuple[str, BuildingFits | None, float]]],
    size: int,
    settings: Settings,
) -> list[Outcome]:
    return [
        outcome
        for each, so_far in zip(asked, found, strict=True)
        for outcome in outcomes(each, so_far, size, settings.decision)
    ]


def _brief(results: Sequence[Outcome], settings: Settings) -> Iterator[str]:
    """Give the rows of one size, as soon as they are known: a thousand sets take their time."""
    for is_real in (True, False):
        some = [each for each in results if each.asked.is_real == is_real]
        if some:
            yield "real" if is_real else "simulated"
            yield from _rows(some, LOOK_ALIKES, settings.decision)


def twins(buildings: Mapping[str, Iterable[Twins]], settings: Settings) -> Iterator[str]:
    """Ask every building together with its copy, and tell what comes of it, a line each.

    Args:
        buildings: By their kind; what one kind says of the width is tried on the others.
        settings: Of all sets.
    """
    found = {
        kind: [pair for each in some for pair in each.asked(settings)]
        for kind, some in buildings.items()
    }
    widths = {kind: _width(pairs) for kind, pairs in found.items() if pairs}
    for kind, width in widths.items():
        others = {other: widths[other] for other in widths if other != kind}
        tried = {"shipped": TWINS, **others}
        told = [
            f"{_answered(found[kind], value, settings)} answered with {value:.4f} ({label})"
            for label, value in tried.items()
        ]
        yield (
            f"twins, {kind}: {len(found[kind])} scans, scores differ by {width:.4f} in the root "
            f"mean square; half of all answers are wrong: {', '.join(told)}"
        )


@dataclass(frozen=True, eq=False)
class Twins:
    """A building, its copy elsewhere, and scans of it.

    Args:
        places: Set of the one.
        copy: Set of the other.
        scans: To ask both with.
    """

    places: ReferenceSet
    copy: ReferenceSet
    scans: Sequence[LaserScan]

    def asked(self, settings: Settings) -> Iterator[list[BuildingFits]]:
        """Give what both find for every scan, where both find something."""
        for scan in self.scans:
            both = [("one", self.places), ("twin", self.copy)]
            found = list(search(both, describe(scan, settings)))
            if len(found) == len(both):
                yield found


def _width(pairs: Sequence[Sequence[BuildingFits]]) -> float:
    scores = [[float(each.fits.features[0, _SCORE]) for each in pair] for pair in pairs]
    return math.sqrt(float(np.mean([(one - twin) ** 2 for one, twin in scores])))


def _answered(pairs: Sequence[Sequence[BuildingFits]], width: float, settings: Settings) -> int:
    return sum(
        decide_over(pair, len(pair), settings.decision, twins=width)[0].accepted for pair in pairs
    )


def _twins(
    cases: Sequence[Case], settings: Settings, simulated: int, queries: int, seed: int
) -> dict[str, Iterator[Twins]]:
    """Give real and simulated buildings with their copies, one after the other."""
    real = (
        Twins(
            _set_of(case, Pose2D(), settings),
            _set_of(case, _TWIN_AT, settings),
            [scan for scan, _ in _thinned(case, queries, seed)],
        )
        for case in cases
    )
    invented = (
        Twins(
            _simulated_set(number, seed, settings),
            _simulated_set(number, seed, settings, _TWIN_AT),
            [each.scan for each in _simulated_queries(number, seed, queries)],
        )
        for number in range(simulated)
    )
    return {"real": real, "simulated": invented}


def _set_of(case: Case, T_set_case: Pose2D, settings: Settings) -> ReferenceSet:
    places = ReferenceSet(settings=settings)
    known = [(each.scan, each.pose) for each in case.references if each.pose is not None]
    places.add_batch([scan for scan, _ in known], [T_set_case @ pose for _, pose in known])
    return places


def outcomes(
    asked: Asked,
    found: Sequence[tuple[str, BuildingFits | None, float]],
    size: int,
    settings: DecisionSettings,
) -> Iterator[Outcome]:
    """Give what a query comes to among ``size`` sets with its building, and without it.

    Args:
        asked: The query.
        found: Name, fits and seconds of every set, in one order for all queries.
        size: How many sets are asked.
        settings: Of the decision.
    """
    own = [each for each in found if each[0] == asked.building]
    others = [each for each in found if each[0] != asked.building]
    for is_known, chosen in ((True, own + others[: size - 1]), (False, others[:size])):
        if len(chosen) != size:
            continue
        start = time.perf_counter()
        given = [fits for _, fits, _ in chosen if fits is not None]
        seconds = sum(each[2] for each in chosen)
        if not given:
            continue
        best, fits = ranked(given)
        within = held(covariance(fits[:1], settings)[0])
        speaks = evidence(fits, best[0][0].anchors)
        right = is_known and best[0][0].building == asked.building
        near = is_correct(Pose2D.from_array(fits.poses[0]), asked.truth)
        most = beside(fits, settings.model_copy(update={"twins": TWINS}))
        seconds += time.perf_counter() - start
        yield Outcome(asked, size, is_known, speaks, within, most, right, right and near, seconds)


def probabilities(
    results: Sequence[Outcome], look_alikes: float, settings: DecisionSettings
) -> NDArray[np.float64]:
    """Return (R,) what the decision over N sets says of each best fit."""
    speaks = np.array([each.evidence for each in results]) @ np.array(settings.weights)
    speaks -= look_alikes * np.log([each.sets for each in results])
    likely: NDArray[np.float64] = np.array([each.held for each in results])
    likely /= 1.0 + np.exp(-speaks)
    return np.minimum(likely, [each.most for each in results])


def log_loss(results: Sequence[Outcome], look_alikes: float, settings: DecisionSettings) -> float:
    """Return the mean of -log of the probability given to what happened; unknown weighs less."""
    p = np.clip(probabilities(results, look_alikes, settings), 1e-6, 1.0 - 1e-6)
    right = np.array([each.is_correct for each in results])
    weights = np.array([1.0 if each.is_known else _UNKNOWN_WEIGHT for each in results])
    return float(np.average(-np.log(np.where(right, p, 1.0 - p)), weights=weights))


def fitted(results: Sequence[Outcome], settings: DecisionSettings) -> float:
    """Return how fast the odds should fall with the number of sets: where the loss is least."""
    losses = [log_loss(results, float(tried), settings) for tried in _TRIED]
    return float(_TRIED[int(np.argmin(losses))])


def table(results: Sequence[Outcome], settings: DecisionSettings) -> list[str]:
    """Return the lines that say what was found."""
    real = [each for each in results if each.asked.is_real]
    simulated = [each for each in results if not each.asked.is_real]
    lines = []
    for name, some, rest in (("real", real, simulated), ("simulated", simulated, real)):
        if not some:
            continue
        shown = [("0 (margin alone)", 0.0), (f"{LOOK_ALIKES} (shipped)", LOOK_ALIKES)]
        if rest:
            value = fitted(rest, settings)
            shown.append((f"{value:.2f} (fitted on the others)", value))
        for label, look_alikes in shown:
            lines += ["", f"{name} scans, look-alikes {label}", *_rows(some, look_alikes, settings)]
    lines += ["", "fitted on all: " + f"{fitted(results, settings):.2f}"]
    return lines


def _rows(
    results: Sequence[Outcome], look_alikes: float, settings: DecisionSettings
) -> Iterator[str]:
    yield (
        "| sets | queries | right building | and pose | recall at 99 % | correct | wrong | silent "
        "| calibration error | unknown answered | median ms |"
    )
    yield "| --- " * 11 + "|"
    for size in sorted({each.sets for each in results}):
        known = [each for each in results if each.sets == size and each.is_known]
        unknown = [each for each in results if each.sets == size and not each.is_known]
        if not known:
            continue
        p = probabilities(known, look_alikes, settings)
        right = np.array([each.is_correct for each in known])
        accepted = p >= settings.threshold
        lost = probabilities(unknown, look_alikes, settings) if unknown else np.empty(0)
        cells = [
            f"{size}",
            f"{len(known)}",
            f"{np.mean([each.is_right_building for each in known]):.3f}",
            f"{right.mean():.3f}",
            f"{recall_at_precision(p, right, 0.99)[0]:.3f}",
            f"{int(np.sum(accepted & right))}",
            f"{int(np.sum(accepted & ~right))}",
            f"{int(np.sum(~accepted))}",
            f"{reliability(p, right).error:.3f}",
            f"{int(np.sum(lost >= settings.threshold))} of {len(lost)}",
            f"{1e3 * float(np.median([each.seconds for each in known])):.1f}",
        ]
        yield "| " + " | ".join(cells) + " |"


def _timed(
    name: str, places: ReferenceSet, description: Description
) -> tuple[BuildingFits | None, float]:
    """Search one set, and keep of its fits what an order over all sets can need."""
    start = time.perf_counter()
    found = next(search([(name, places)], description), None)
    seconds = time.perf_counter() - start
    if found is None:
        return None, seconds
    return BuildingFits(name, found.anchors, found.fits[:_KEPT_FITS]), seconds


def _thinned(case: Case, queries: int, seed: int) -> Iterator[tuple[LaserScan, Pose2D]]:
    known = [(scan, truth) for scan, truth in case.queries if truth is not None]
    for position in thin(range(len(known)), queries, seed):
        yield known[position]


def _shards(
    cases: Sequence[Case],
    others: Sequence[tuple[str, ReferenceSet]],
    settings: Settings,
    seed: int,
    count: int,
) -> Iterator[tuple[str, ReferenceSet]]:
    """Give the sets one after the other, those with queries first."""
    for case in cases:
        yield case.place, _set_of(case, Pose2D(), settings)
    for number in range(count):
        if number == _BEFORE_OTHERS:
            yield from others
        yield _simulated_name(number), _simulated_set(number, seed, settings)


# The others stand behind the first simulated buildings, which may have queries.
_BEFORE_OTHERS = 10


def _seed(seed: int, number: int, stream: int = 0) -> int:
    """Give every building, and everything random in it, a seed of its own."""
    return 10 * (1_000_000 * seed + number) + stream


def _simulated_name(number: int) -> str:
    return f"simulated-{number:04d}"


def _simulated_building(number: int, seed: int) -> World:
    return random_building(
        _seed(seed, number),
        style=_STYLES[number % len(_STYLES)],
        length=30.0 + 5.0 * (number % 4),
        depth=20.0 + 2.0 * (number % 3),
    )


def _simulated_set(
    number: int, seed: int, settings: Settings, T_set_world: Pose2D | None = None
) -> ReferenceSet:
    """Scans at random places of a simulated building."""
    world, rng = _simulated_building(number, seed), np.random.default_rng(_seed(seed, number, 1))
    poses = random_poses(world, _REFERENCES, _seed(seed, number, 2))
    places = ReferenceSet(settings=settings)
    scans = [simulate(world, pose, SensorModel(), rng) for pose in poses]
    moved = poses if T_set_world is None else [T_set_world @ pose for pose in poses]
    places.add_batch(scans, moved)
    return places


def _simulated_queries(number: int, seed: int, queries: int) -> list[Asked]:
    """Scans of a later visit, within 2 m and 45 degrees of a reference."""
    world = _simulated_building(number, seed)
    known = random_poses(world, _REFERENCES, _seed(seed, number, 2))
    later = turn_doors(move_furniture(world, number, share=_MOVED), number, share=_TURNED)
    near = [
        (record.scan, record.pose)
        for record in drive(later, seed=_seed(seed, number, 3), length=_SECOND_DRIVE)
        if record.scan is not None and record.pose is not None
        if any(
            record.pose.distance(pose) <= 2.0 and record.pose.turn(pose) <= math.pi / 4
            for pose in known
        )
    ]
    chosen = thin(range(len(near)), queries, seed)
    return [Asked(_simulated_name(number), *near[position], False) for position in chosen]
