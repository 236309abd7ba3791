"""What each part is worth: the same queries with one thing changed at a time.

Every change of `CHANGES` switches a part off, or moves a figure that was chosen, in otherwise
unchanged settings.  All changes are asked the same queries, and make one row of a table each:
the pooled figures of the protocol, the share of queries with the right pose among the fits
(what a perfect decision would make of them), the mean number of proposals, and processor time
against no change.

The coefficients of the decision stay those of the settings, which were fitted with every part
in place.  So a change can look a little worse than it would be with coefficients of its own;
the share with the right pose among the fits does not depend on them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .anchors import AnchorSettings
from .errors import AnchorscanError
from .matcher import Matcher
from .pose import Pose2D
from .protocol import Answer, Case, recall_at_precision, thin
from .scan import LaserScan
from .settings import Settings

__all__ = [
    "CHANGES",
    "Change",
    "Outcome",
    "attempt",
    "changes_named",
    "header",
    "row",
    "run",
]

_PRECISION = 0.99
_NO_CHANGE = "no change"
_TURN = math.radians(360.0)
_EIGHTH = math.radians(45.0)


@dataclass(frozen=True)
class Change:
    """One thing done differently.

    Args:
        name: What the table calls it.
        values: Settings, nested as the sections are.
        reason: What it shows, in a sentence.
    """

    name: str
    values: Mapping[str, Any]
    reason: str


def _change(name: str, section: str, reason: str, **values: Any) -> Change:
    return Change(name, MappingProxyType({section: values}), reason)


CHANGES: tuple[Change, ...] = (
    _change(
        "edges not oriented",
        "proposal",
        "Edges correspond by length and kinds alone, whatever the directions at their ends.",
        direction_tolerance=_TURN,
    ),
    _change(
        "no heading prior",
        "proposal",
        "The angle to the main angles rules nothing out.",
        heading_tolerance=_EIGHTH,
        lone_heading_tolerance=_EIGHTH,
    ),
    _change(
        "no lone anchors",
        "proposal",
        "Only edges propose, however few there are.",
        enough=0,
    ),
    _change(
        "lone anchors always",
        "proposal",
        "Lone anchors propose beside the edges, however many these propose.",
        enough=1 << 16,
    ),
    _change(
        "only lone anchors",
        "proposal",
        "No two lengths correspond, so that no edge proposes.",
        length_tolerance=1e-9,
    ),
    _change(
        "no virtual edges",
        "anchors",
        "Jump edges and angles alone: no crossings of walls.",
        most_walls=0,
    ),
    _change(
        "sides of a wall alike",
        "anchors",
        "A wall seen from both sides makes one peak, and virtual edges know no quadrant.",
        facing=False,
    ),
    Change(
        "strict extraction",
        MappingProxyType({"anchors": AnchorSettings().model_dump()}),
        "Anchor points as the sections have them by default: fewer, from larger surfaces.",
    ),
    _change(
        "surface angle of two readings",
        "anchors",
        "The angle function takes the pair of readings of the paper, not a line through all.",
        angle_function={"fitted": False},
    ),
    _change(
        "landmarks of 0.4 m",
        "proposal",
        "Anchors of different references are merged within twice the distance.",
        landmark_cell=0.4,
    ),
    _change(
        "100 proposals pass",
        "proposal",
        "Fewer proposals pass the first check.",
        most=100,
    ),
    _change(
        "600 proposals pass",
        "proposal",
        "More proposals pass the first check.",
        most=600,
    ),
    _change("4 fits", "verification", "Fewer poses are refined.", fits=4),
    _change("10 fits", "verification", "More poses are refined.", fits=10),
    _change(
        "20 fits", "verification", "As many poses are refined as the thorough preset.", fits=20
    ),
    _change("no refinement", "verification", "Fits stay where they were proposed.", iterations=0),
    _change("4 steps", "verification", "A shorter refinement.", iterations=4),
    _change("12 steps", "verification", "A longer refinement.", iterations=12),
    _change(
        "known free space costs nothing",
        "field",
        "A reading that ends in known free space is worth as little as one in the unknown.",
        free_penalty=0.0,
    ),
    _change(
        "rays through surfaces cost nothing",
        "decision",
        "The decision ignores rays that pass through known surfaces.",
        through=0.0,
    ),
    _change(
        "extent of the view ignored",
        "decision",
        "The decision ignores how firmly the explained readings hold the heading.",
        heading=0.0,
    ),
    _change(
        "anchor points ignored",
        "decision",
        "The decision ignores how many anchor points the scan has.",
        anchors=0.0,
    ),
    _change(
        "margin ignored",
        "decision",
        "The decision ignores how well the best other place fits.",
        log_margin=0.0,
    ),
    _change(
        "unknown worth nothing",
        "field",
        "A reading that ends where nobody looked is worth nothing.",
        unknown_score=0.0,
    ),
    _change(
        "unknown worth 0.2",
        "field",
        "A reading that ends where nobody looked is worth a fifth of one on a surface.",
        unknown_score=0.2,
    ),
    _change(
        "blunt field",
        "field",
        "A reading counts up to 0.4 m from a surface.",
        sharpness=0.4,
    ),
    _change(
        "1 candidate",
        "database",
        "Only relations of the reference of the highest quality propose.",
        candidates=1,
    ),
    _change(
        "5 candidates",
        "database",
        "Only relations of the five references of the highest quality propose.",
        candidates=5,
    ),
)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of the queries, in order.

    Args:
        groups: (N,) index into the groups of the table.
        right: (N,) whether the best hypothesis is correct.
        among: (N,) whether the right pose is among the fits.
        probability: (N,) of the best hypothesis, NaN for none.
        proposals: (N,) alignments proposed before any check.
        seconds: (N,) of processor time.
    """

    groups: NDArray[np.int64]
    right: NDArray[np.bool_]
    among: NDArray[np.bool_]
    probability: NDArray[np.float64]
    proposals: NDArray[np.float64]
    seconds: NDArray[np.float64]


def changes_named(names: Sequence[str]) -> tuple[Change, ...]:
    """Return the changes of these names; all if none is named.

    Raises:
        AnchorscanError: There is no change of a name.
    """
    known = {change.name: change for change in CHANGES}
    for name in names:
        if name not in known:
            raise AnchorscanError(f"unknown change {name!r}: there are {', '.join(known)}")
    return tuple(known[name] for name in names) or CHANGES


def run(
    cases: Sequence[Case],
    settings: Settings,
    queries: int,
    say: Callable[[str], None],
    changes: Sequence[Change] = CHANGES,
) -> list[Outcome]:
    """Measure every change and print a row for each, in Markdown.

    Args:
        cases: Splits of P1, P2 and P3.
        settings: That are changed; their method must be the map.
        queries: At most so many of each split, at equal steps.
        say: Told the rows, and at the end what the changes are.
        changes: To be measured.

    Returns:
        What became of the queries: without a change, then with each.

    Raises:
        AnchorscanError: There are no queries, or a change changes nothing in these settings.
    """
    variants = [settings.changed(change.values) for change in changes]
    for change, variant in zip(changes, variants, strict=True):
        if variant == settings:
            raise AnchorscanError(f"{change.name!r} changes nothing in these settings")
    usual = attempt(cases, settings, queries)
    if not len(usual.right):
        raise AnchorscanError("no split has a query: the drives visit no place twice")
    for line in (*header(), row(_NO_CHANGE, usual, usual)):
        say(line)
    outcomes = [usual]
    for change, variant in zip(changes, variants, strict=True):
        outcomes.append(attempt(cases, variant, queries))
        say(row(change.name, outcomes[-1], usual))
    say("")
    for change in changes:
        say(f"- {change.name}: {change.reason}")
    return outcomes


def attempt(cases: Sequence[Case], settings: Settings, queries: int) -> Outcome:
    """Ask the queries of every split with some settings.

    Args:
        cases: The splits.
        settings: Of the matcher.
        queries: At most so many of each split, at equal steps.
    """
    rows = []
    for case in cases:
        matcher = Matcher(case.references, settings)
        matcher.prepare()
        asked = list(case.queries)
        for scan, _ in asked[:1]:
            matcher.locate(scan)  # the first query relates the landmarks
        for index in thin(range(len(asked)), queries):
            rows.append((_group(case), *_ask(matcher, *asked[index])))
    groups, right, among, probability, proposed, seconds = (
        zip(*rows, strict=True) if rows else [()] * 6
    )
    return Outcome(
        np.array(groups, np.int64),
        np.array(right, bool),
        np.array(among, bool),
        np.array(probability, float),
        np.array(proposed, float),
        np.array(seconds, float),
    )


def header() -> tuple[str, str]:
    """Return the first two lines of the table."""
    figures = ("top-1", "among the fits", "recall at 99 %")
    cells = ["change"] + [f"{group}: {figure}" for group in _GROUPS for figure in figures]
    cells += ["proposals", "time"]
    return _line(cells), _line(["---"] + ["---:"] * (len(cells) - 1))


def row(name: str, outcome: Outcome, usual: Outcome) -> str:
    """Return the row of a change.

    Args:
        name: Of the change.
        outcome: With it.
        usual: Without it.
    """
    cells = [name]
    for group in range(len(_GROUPS)):
        member = outcome.groups == group
        cells += _figures(outcome, member) if member.any() else ["-"] * 3
    cells.append(f"{outcome.proposals.mean():.0f}")
    cells.append(f"{outcome.seconds.sum() / usual.seconds.sum():.2f}")
    return _line(cells)


_GROUPS = ("dense", "sparse", "look-alike")


def _group(case: Case) -> int:
    return 2 if case.looks_alike else int(case.protocol == "P2")


def _ask(
    matcher: Matcher, scan: LaserScan, truth: Pose2D | None
) -> tuple[bool, bool, float, int, float]:
    fresh = replace(scan)  # nothing derived may be left over in it
    start = time.process_time()
    trace = matcher.explain(fresh)
    seconds = time.process_time() - start
    search = trace.in_map
    if search is None or not trace.hypotheses:
        return False, False, math.nan, 0, seconds
    best = trace.hypotheses[0]
    among = any(_is_right(Pose2D.from_array(pose), truth) for pose in search.fits.poses)
    proposed = search.proposals.proposed
    return _is_right(best.pose, truth), among, best.probability, proposed, seconds


def _is_right(pose: Pose2D | None, truth: Pose2D | None) -> bool:
    return Answer(0, pose, truth, math.nan, False, 0.0).is_correct


def _figures(outcome: Outcome, member: NDArray[np.bool_]) -> list[str]:
    right = outcome.right[member]
    recall, _ = recall_at_precision(outcome.probability[member], right, _PRECISION)
    return [f"{value:.3f}" for value in (right.mean(), outcome.among[member].mean(), recall)]


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
