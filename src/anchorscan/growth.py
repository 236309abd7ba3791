"""How the search for candidates grows with the set: from a hundred references to a million.

Real queries are asked for the references of their place (P1 and P3 of ``protocol``), alone and
among more and more *distractors*: references of other places, which must not take their rank.

Distractors are made from real scans and from scans of simulated buildings, half of each.  The
anchor points and readings of a scan, in the frame of its main walls, are stretched along each
wall by a factor from 0.74 to 1.35, by at least 5 % along one of them; half are mirrored; 15 % of
the anchor points and a sector of 15 % of the readings are lost and about as many come from
another scan; positions and directions get noise of 3 cm and 0.03 radians.
So the relations within a distractor are those of rooms and corridors, and no
distractor is the place itself.  For a query only distractors count that were not made from its
own building: those that were, about a twelfth, are passed over in the answer.

A query finds its place within the first *k* candidates when one of them is a reference within
the limits of the split (2 m and 45 degrees).  It is *located* with *k* candidates when the search
in the map, with those of them that belong to its place proposing, ends within 0.5 m and
10 degrees of the truth; distractors have no scan and cannot propose.
"""

from __future__ import annotations

import csv
import json
import math
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .anchors import AnchorPoints, AnchorStack, stack_anchors
from .array_file import read_arrays, write_arrays
from .database import RelationshipDatabase, Votes
from .description import Description, describe
from .errors import AnchorscanError, MissingExtraError
from .field import LikelihoodField
from .graph import AnchorGraph
from .panorama import DIRECTIONS, View, panorama, worth
from .pose import Pose2D
from .proposal import joined, landmarks, proposals
from .protocol import is_correct, thin
from .reference import Reference
from .scan import LaserScan
from .settings import Settings
from .simulator import SensorModel, random_building, random_poses, simulate
from .spacing import spacings
from .stitched_map import candidates
from .verification import verify

__all__ = ["RANKS", "SIZES", "Growth", "Place", "Scene", "Size", "distractors", "measure", "slope"]

RANKS = (1, 5, 20, 100)
SIZES = (100, 1_000, 10_000, 100_000, 1_000_000)

_STRETCH = math.log(1.35)
_LEAST_STRETCH = math.log(1.05)
_LOST = 0.15
_POSITION_NOISE, _DIRECTION_NOISE = 0.03, 0.03
_MIRRORED = np.array([1, 0, 2, 3, 4])
_FEWEST_ANCHORS = 3
# So many scans of a real building and of a simulated one are made into distractors.
_REAL_SCANS, _SIMULATED_SCANS = 400, 40
# Identifiers of distractors begin beyond those of any place.
_FIRST_DISTRACTOR = 1 << 40
_CHANGES = 400
# So many distractors are made to warm up.
_WARMING = 20
# So many distractors of the query's own building may have to be passed over.
_PASSED_OVER = 60


@dataclass(frozen=True, eq=False)
class Place:
    """What is known of one place, and what is asked.

    Args:
        name: What tables call it.
        building: Distractors from it do not count.
        references: With poses, in one frame.
        queries: Scans and their true poses in that frame.
        others: Further scans of the building, to make distractors from.
        spacing: Metres within which a reference is the right one.
        heading: Radians within which it is.
    """

    name: str
    building: str
    references: tuple[Reference, ...]
    queries: tuple[tuple[LaserScan, Pose2D], ...]
    others: tuple[LaserScan, ...]
    spacing: float = 2.0
    heading: float = math.radians(45.0)


@dataclass(frozen=True)
class Size:
    """What was measured among one number of distractors.

    Args:
        distractors: Their number.
        references: The mean number of references in the set, with those of the place.
        edges: Of the distractors, in the database.
        bytes: Of the file that holds the database.
        milliseconds: Median time of a search; as all times but ``opening``, of the processor
            for the thread.
        milliseconds_99: 99th percentile.
        milliseconds_changing: Median while another thread adds and removes.
        opening: Seconds from the file to the first answer.
        adding: Milliseconds to add a reference, amortised.
        removing: Milliseconds to remove one.
        hits: Share of queries with a right reference among the first of ``RANKS``.
        located: Share of queries located with so many candidates.
        places: The same hits for every place.
    """

    distractors: int
    references: int
    edges: int
    bytes: int
    milliseconds: float
    milliseconds_99: float
    milliseconds_changing: float
    opening: float
    adding: float
    removing: float
    hits: dict[int, float]
    located: dict[int, float]
    places: dict[str, dict[int, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Growth:
    """All sizes, smallest first."""

    sizes: tuple[Size, ...]
    queries: int
    seed: int

    @property
    def slope(self) -> float:
        """Exponent of the median time over the number of references; 1 is linear."""
        return slope([s.references for s in self.sizes], [s.milliseconds for s in self.sizes])

    def lines(self) -> list[str]:
        """Return a table for people, and the slope."""
        head = "distractors     index  open    search ms (99 %, changing)   add  remove ms"
        ranks = "  ".join(f"top {rank:>3}" for rank in RANKS)
        rows = [f"{head}   {ranks}   located with {', '.join(map(str, RANKS))}"]
        for s in self.sizes:
            hits = "  ".join(f"{s.hits[rank]:7.3f}" for rank in RANKS)
            located = "  ".join(f"{s.located[rank]:.3f}" for rank in RANKS)
            rows.append(
                f"{s.distractors:>11,} {s.bytes / 1e6:>6.0f} MB {s.opening:>4.2f} s "
                f"{s.milliseconds:>9.2f} ({s.milliseconds_99:>6.2f}, "
                f"{s.milliseconds_changing:>6.2f}) {s.adding:>9.2f}  {s.removing:>6.2f}     "
                f"{hits}   {located}"
            )
        last = self.sizes[-2:]
        end = slope([s.references for s in last], [s.milliseconds for s in last])
        return [
            *rows,
            f"time grows with the number of references to the power {self.slope:.2f} over all "
            f"sizes, {end:.2f} between the last two",
        ]

    def write(self, folder: Path) -> list[Path]:
        """Write growth.json and growth.csv, and return their paths.

        Raises:
            OSError: The folder cannot be written.
        """
        folder.mkdir(parents=True, exist_ok=True)
        files = [folder / "growth.json", folder / "growth.csv"]
        text = json.dumps({**asdict(self), "slope": self.slope}, indent=2)
        files[0].write_text(text + "\n", encoding="utf-8")
        with files[1].open("w", encoding="utf-8", newline="") as stream:
            writer = csv.DictWriter(stream, list(_row(self.sizes[0])), lineterminator="\n")
            writer.writeheader()
            writer.writerows(_row(size) for size in self.sizes)
        return files

    def draw(self, path: Path) -> None:
        """Draw time and hits over the number of references.

        Raises:
            MissingExtraError: matplotlib is not installed.
            OSError: The picture cannot be written.
        """
        try:
            from matplotlib.figure import Figure
        except ImportError:
            raise MissingExtraError("drawing pictures", "plot") from None
        figure = Figure(figsize=(10.0, 4.0), layout="constrained")
        times, hits = figure.subplots(1, 2)
        counts = [size.references for size in self.sizes]
        times.loglog(counts, [s.milliseconds for s in self.sizes], "o-", label="median")
        times.loglog(counts, [s.milliseconds_99 for s in self.sizes], "^--", label="99 of 100")
        times.set_ylabel("search for candidates, milliseconds")
        times.set_title(f"time grows with power {self.slope:.2f}")
        for rank in RANKS:
            hits.semilogx(counts, [s.hits[rank] for s in self.sizes], "o-", label=f"top {rank}")
        hits.set_ylim(0.0, 1.0)
        hits.set_ylabel("share of queries with a right candidate")
        for axes in (times, hits):
            axes.set_xlabel("references")
            axes.grid(visible=True, alpha=0.3)
            axes.legend()
        figure.savefig(path)


def measure(
    places: Sequence[Place],
    settings: Settings,
    *,
    sizes: Sequence[int] = SIZES,
    queries: int | None = None,
    seed: int = 0,
    buildings: int = 60,
    say: Callable[[str], None] = lambda line: None,
) -> Growth:
    """Search for the candidates of real queries among more and more distractors.

    Args:
        places: What is asked, and where.
        settings: Of all stages.
        sizes: Numbers of distractors; that without any is measured as well.
        queries: At most so many of each place, at equal steps.
        seed: Of the distractors and of the choice of queries.
        buildings: Simulated ones that half of the distractors are made from.
        say: Is told what has been measured.

    Raises:
        AnchorscanError: There is no query.
    """
    asked = [
        _Asked(place, settings, thin(range(len(place.queries)), queries, seed))
        for place in places
        if place.queries
    ]
    if not asked:
        raise AnchorscanError("no log visits a place twice: there is nothing to ask")
    say(f"{sum(len(each.queries) for each in asked)} queries in {len(asked)} places")
    pool = _pool(places, settings, buildings, seed)
    say(f"{len(pool)} scans to make distractors from")
    _warm_up(asked, settings, pool)
    measured = []
    for count in (0, *sizes):
        measured.append(_measured(count, asked, pool, settings, seed))
        say(json.dumps(asdict(measured[-1])))
    return Growth(tuple(measured), sum(len(each.queries) for each in asked), seed)


def _warm_up(asked: Sequence[_Asked], settings: Settings, pool: Sequence[Scene]) -> None:
    """Compile all that is timed."""
    _measured(_WARMING, [_Asked(asked[0].place, settings, [0])], pool, settings, 0)


def slope(counts: Sequence[float], milliseconds: Sequence[float]) -> float:
    """Fit a power to times over counts; NaN for fewer than two."""
    if len(counts) < 2:
        return math.nan
    return float(np.polyfit(np.log(counts), np.log(milliseconds), 1)[0])


@dataclass(frozen=True, eq=False)
class Scene:
    """Anchor points in the frame of their main walls, to make distractors from.

    Args:
        building: Empty for a simulated one.
        anchors: With the main angle zero.
        points: (N, 2) end points of its readings in the same frame.
    """

    building: str
    anchors: AnchorPoints
    points: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Seen:
    """What references are compared by.

    Args:
        anchors: Their anchor points.
        panoramas: (N, 180) uint8.
        bases: (N,) which scene each distractor was made from.
    """

    anchors: AnchorStack
    panoramas: NDArray[np.uint8]
    bases: NDArray[np.int32]


class _Asked:
    """The references and queries of a place, described once."""

    def __init__(self, place: Place, settings: Settings, chosen: Sequence[int]) -> None:
        self.place = place
        self.settings = settings
        self.known = [describe(each.scan, settings) for each in place.references]
        self.poses = np.array([_pose(each).to_array() for each in place.references])
        self.queries = [place.queries[k] for k in chosen]
        self.described = [describe(scan, settings) for scan, _ in self.queries]
        self.seen = _Seen(
            stack_anchors([known.anchors for known in self.known]),
            np.array([panorama(d.points, d.anchors.main_angle) for d in self.known]),
            np.empty(0, np.int32),
        )
        scans = ((each.scan, _pose(each)) for each in place.references)
        self._tiles = LikelihoodField(settings.field, scans).tiles
        self._weights = settings.field.weights()
        self._landmarks = [
            landmarks([(known.anchors, _pose(each))], settings.proposal)
            for known, each in zip(self.known, place.references, strict=True)
        ]

    def right(self, pose: Pose2D) -> NDArray[np.bool_]:
        """Say of every reference whether it lies within the limits of a pose."""
        off = self.poses - pose.to_array()
        turn = np.abs(np.mod(off[:, 2] + math.pi, 2.0 * math.pi) - math.pi)
        near = np.hypot(off[:, 0], off[:, 1]) <= self.place.spacing
        return np.asarray(near & (turn <= self.place.heading))

    def is_located(self, description: Description, truth: Pose2D, some: Sequence[int]) -> bool:
        """Say whether the search ends at the truth when only some references propose."""
        if not some:
            return False
        settings = self.settings
        seen = description.readings
        related = joined([self._landmarks[number] for number in some])
        proposed = proposals(description.anchors, seen, related, self._tiles, settings.proposal)
        fits = verify(proposed.poses, seen, self._tiles, self._weights, settings.verification)
        if not len(fits):
            return False
        return is_correct(Pose2D(*fits.poses[0].tolist()), truth)


def _pose(reference: Reference) -> Pose2D:
    if reference.pose is None:
        raise ValueError(f"reference {reference.identifier} has no pose")
    return reference.pose


def _pool(places: Sequence[Place], settings: Settings, buildings: int, seed: int) -> list[Scene]:
    """What distractors are made from: scans of all places and of simulated buildings."""
    found: list[tuple[str, LaserScan]] = []
    for place in {place.building: place for place in places}.values():
        step = max(len(place.others) // _REAL_SCANS, 1)
        found += [(place.building, scan) for scan in place.others[::step]]
    rng = np.random.default_rng(seed)
    sensor = SensorModel()
    for number in range(buildings):
        world = random_building(seed + number)
        for pose in random_poses(world, _SIMULATED_SCANS, seed + number):
            found.append(("", simulate(world, pose, sensor, rng)))
    scenes = [_scene(building, describe(scan, settings)) for building, scan in found]
    return [scene for scene in scenes if len(scene.anchors) >= _FEWEST_ANCHORS]


def _scene(building: str, description: Description) -> Scene:
    """Anchor points and readings in the frame of their main walls."""
    anchors = description.anchors
    main = anchors.main_angle if math.isfinite(anchors.main_angle) else 0.0
    c, s = math.cos(main), math.sin(main)
    upright = np.array([[c, -s], [s, c]])
    turned = AnchorPoints(anchors.positions @ upright, anchors.kinds, anchors.directions - main, 0)
    return Scene(building, turned, description.points @ upright)


def distractors(pool: Sequence[Scene], count: int, seed: int) -> Iterator[tuple[int, Scene]]:
    """Make references of other places; the first are the same whatever their number.

    Yields:
        Which scene of the pool each was made from, and what it has become.
    """
    rng = np.random.default_rng([seed, 1])
    halves = [
        [k for k, scene in enumerate(pool) if bool(scene.building) is real]
        for real in (True, False)
    ]
    halves = [half for half in halves if half]
    for number in range(count):
        half = halves[number % len(halves)]
        base, other = half[rng.integers(len(half))], half[rng.integers(len(half))]
        yield base, _perturbed(pool[base], pool[other], rng)


def _perturbed(scene: Scene, another: Scene, rng: np.random.Generator) -> Scene:
    """Make a place that is not the scene's, but as likely."""
    base, other = scene.anchors, another.anchors
    stretch = rng.uniform(-_STRETCH, _STRETCH, 2)
    if np.abs(stretch).max() < _LEAST_STRETCH:
        stretch[rng.integers(2)] = _LEAST_STRETCH
    kept = rng.random(len(base)) >= _LOST
    taken = rng.random(len(other)) < _LOST * len(base) / len(other)
    positions = np.concatenate([base.positions[kept] * np.exp(stretch), other.positions[taken]])
    kinds = np.concatenate([base.kinds[kept], other.kinds[taken]])
    directions = np.concatenate([base.directions[kept], other.directions[taken]])
    positions += rng.normal(0.0, _POSITION_NOISE, positions.shape)
    directions = directions + rng.normal(0.0, _DIRECTION_NOISE, len(directions))
    is_mirrored = rng.random() < 0.5
    points = _with_sector_of(another.points, scene.points * np.exp(stretch), rng)
    points += rng.normal(0.0, _POSITION_NOISE, 2)
    if is_mirrored:
        positions[:, 1] *= -1.0
        points[:, 1] *= -1.0
        directions, kinds = -directions, _MIRRORED[kinds]
    return Scene(scene.building, AnchorPoints(positions, kinds, directions, 0.0), points)


def _with_sector_of(
    others: NDArray[np.float64], points: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Replace some readings that lie side by side by as many of another scan."""
    lost = int(_LOST * len(points))
    taken = min(lost, len(others))
    first = int(rng.integers(len(points) - lost + 1))
    other = int(rng.integers(len(others) - taken + 1))
    return np.concatenate([points[:first], points[first + lost :], others[other : other + taken]])


def _graph(anchors: AnchorPoints) -> AnchorGraph:
    """A graph for a database that orders the edges by keys: it takes the anchor points alone."""
    return AnchorGraph(anchors, _NO_NODES, _NO_VALUES)


_NO_NODES, _NO_VALUES = np.empty((0, 2), np.int32), np.empty(0)


def _measured(
    count: int, asked: Sequence[_Asked], pool: Sequence[Scene], settings: Settings, seed: int
) -> Size:
    """Measure among one number of distractors."""
    made = _Made(count)
    database = RelationshipDatabase(
        settings.database,
        ((_FIRST_DISTRACTOR + n, _graph(a)) for n, a in made.all(distractors(pool, count, seed))),
        made.spacings(),
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "relations"
        arrays = database.arrays()
        write_arrays(path, arrays | made.arrays(), "growth")
        size, edges = path.stat().st_size, int(arrays["sizes"].sum())
        del database, arrays, made
        start = time.perf_counter()
        database, crowd = _opened(path, settings)
        _Search(database, crowd, asked[0]).votes(asked[0].described[0])
        opening = time.perf_counter() - start
        buildings = [scene.building for scene in pool]
        rounds = [_Round(database, each, crowd, buildings) for each in asked]
        changing = _while_changing(database, crowd, asked)
    times = np.concatenate([each.milliseconds for each in rounds])
    ranks = np.concatenate([each.ranks for each in rounds])
    located = np.concatenate([each.located for each in rounds])
    return Size(
        distractors=count,
        references=count + round(float(np.mean([len(each.known) for each in asked]))),
        edges=edges,
        bytes=size,
        milliseconds=float(np.median(times)),
        milliseconds_99=float(np.percentile(times, 99)),
        milliseconds_changing=changing,
        opening=opening,
        adding=float(np.mean([each.adding for each in rounds])),
        removing=float(np.mean([each.removing for each in rounds])),
        hits={rank: float(np.mean(ranks < rank)) for rank in RANKS},
        located={rank: float(np.mean(located[:, k])) for k, rank in enumerate(RANKS)},
        places={
            each.place.name: {rank: float(np.mean(found.ranks < rank)) for rank in RANKS}
            for each, found in zip(asked, rounds, strict=True)
        },
    )


class _Made:
    """What is kept of distractors: the database keeps the edges."""

    def __init__(self, count: int) -> None:
        self._bases = np.empty(count, np.int32)
        self._panoramas = np.empty((count, DIRECTIONS), np.uint8)
        self._anchors: list[tuple[NDArray[Any], ...]] = []

    def all(self, scenes: Iterator[tuple[int, Scene]]) -> Iterator[tuple[int, AnchorPoints]]:
        """Keep what each is compared by, and pass on its number and its anchor points."""
        for number, (base, scene) in enumerate(scenes):
            self._bases[number] = base
            self._panoramas[number] = panorama(scene.points, 0.0)
            anchors = scene.anchors
            self._anchors.append(
                (
                    anchors.positions.astype(np.float32),
                    anchors.kinds.astype(np.uint8),
                    anchors.directions.astype(np.float32),
                )
            )
            yield number, anchors

    def spacings(self) -> Iterator[NDArray[np.uint64]]:
        """Those of walls, once all are made."""
        yield from spacings(self._panoramas)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Plain arrays by name."""
        positions, kinds, directions = (
            np.concatenate([_NONE[k], *(each[k] for each in self._anchors)]) for k in range(3)
        )
        starts = np.cumsum([0, *(len(each[1]) for each in self._anchors)], dtype=np.int64)
        return {
            "seen.bases": self._bases,
            "seen.panoramas": self._panoramas,
            "seen.positions": positions,
            "seen.kinds": kinds,
            "seen.directions": directions,
            "seen.main_angles": np.zeros(len(self._bases), np.float32),
            "seen.starts": starts,
        }


_NONE = (np.empty((0, 2), np.float32), np.empty(0, np.uint8), np.empty(0, np.float32))


def _opened(path: Path, settings: Settings) -> tuple[RelationshipDatabase, _Seen]:
    arrays = read_arrays(path, "growth")
    if arrays is None:
        raise OSError(f"{path} was written and cannot be read")
    stack = ("positions", "kinds", "directions", "main_angles", "starts")
    crowd = _Seen(
        AnchorStack(*(arrays[f"seen.{name}"] for name in stack)),
        arrays["seen.panoramas"],
        arrays["seen.bases"],
    )
    return RelationshipDatabase.from_arrays(settings.database, arrays), crowd


class _Search:
    """The search for candidates as the stitched map does it, distractors included."""

    def __init__(self, database: RelationshipDatabase, crowd: _Seen, asked: _Asked) -> None:
        self._database, self._crowd, self._asked = database, crowd, asked

    def votes(self, description: Description) -> Votes:
        """The best candidates for a scan, best first."""
        most = RANKS[-1] + _PASSED_OVER

        def worths(
            seen: View, first: NDArray[np.int64], quality: NDArray[np.float64]
        ) -> NDArray[np.float64]:
            found = np.empty(len(first))
            of_crowd = first >= _FIRST_DISTRACTOR
            for known, those, begin in (
                (self._crowd, of_crowd, _FIRST_DISTRACTOR),
                (self._asked.seen, ~of_crowd, 0),
            ):
                asked = (first[those] - begin, quality[those], most)
                found[those] = worth(seen, known.anchors, known.panoramas, *asked)
            return found

        return candidates(description, self._database, self._asked.settings, most, worths)


class _Round:
    """The queries of one place: its references are added, asked for, and removed."""

    def __init__(
        self,
        database: RelationshipDatabase,
        asked: _Asked,
        crowd: _Seen,
        buildings: Sequence[str],
    ) -> None:
        start = time.thread_time()
        saw = spacings(asked.seen.panoramas)
        for number, known in enumerate(asked.known):
            database.add(number, known.graph, saw[number])
        self.adding = (time.thread_time() - start) * 1e3 / len(asked.known)
        own = np.array([building == asked.place.building for building in buildings])
        search = _Search(database, crowd, asked)
        times, ranks, located = [], [], []
        for description, (_, truth) in zip(asked.described, asked.queries, strict=True):
            start = time.thread_time()
            votes = search.votes(description)
            times.append((time.thread_time() - start) * 1e3)
            numbers = votes.references
            is_distractor = numbers >= _FIRST_DISTRACTOR
            passed_over = np.zeros(len(numbers), np.bool_)
            bases = crowd.bases[numbers[is_distractor] - _FIRST_DISTRACTOR]
            passed_over[is_distractor] = own[bases]
            numbers = numbers[~passed_over][: RANKS[-1]]
            right = np.flatnonzero(np.isin(numbers, np.flatnonzero(asked.right(truth))))
            ranks.append(int(right[0]) if len(right) else RANKS[-1])
            some = [numbers[:rank][numbers[:rank] < _FIRST_DISTRACTOR].tolist() for rank in RANKS]
            located.append([asked.is_located(description, truth, each) for each in some])
        start = time.thread_time()
        for number in range(len(asked.known)):
            database.remove(number)
        self.removing = (time.thread_time() - start) * 1e3 / len(asked.known)
        self.milliseconds = np.array(times)
        self.ranks = np.array(ranks)
        self.located = np.array(located)


def _while_changing(database: RelationshipDatabase, crowd: _Seen, asked: Sequence[_Asked]) -> float:
    """Median milliseconds of a search while another thread adds and removes."""
    graphs = [known.graph for each in asked for known in each.known]
    done = threading.Event()

    def change() -> None:
        number = 0
        while not done.is_set():
            database.add(number, graphs[number % len(graphs)])
            if number >= _CHANGES:
                database.remove(number - _CHANGES)
            number += 1

    writer = threading.Thread(target=change)
    writer.start()
    times = []
    try:
        for each in asked:
            # References that the writer has added are of all places: these are not compared.
            for description in islice(each.described, 10):
                start = time.thread_time()
                database.votes(description.graph, RANKS[-1])
                times.append((time.thread_time() - start) * 1e3)
    finally:
        done.set()
        writer.join()
    return float(np.median(times))


def _row(size: Size) -> dict[str, Any]:
    """One line of the table of values."""
    values = asdict(size)
    del values["places"]
    for name in ("hits", "located"):
        values |= {f"{name}_{rank}": share for rank, share in values.pop(name).items()}
    return values
