"""What is answered where a building and its exact copy are one map.

    python examples/equal_places.py LOG [--later LOG] [--queries N] [--range-max M]

References and queries by protocol P1, or by P3 with a later drive; the same references once more,
carried off and turned.  Of the scans that are answered without the copy: how far apart the scores
of the two places are, in the root mean square; how many are answered with the copy, which nothing
can be sure of, for the width of noise that is shipped (``decision.twins``) and for others; how many
are ambiguous, and of how many both places are named.  Last, how many are lost without any copy,
compared with no width at all.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

from anchorscan import Hypothesis, LaserScan, Matcher, Pose2D, Reference, Settings
from anchorscan.benchmark import read_drives, tasks

AWAY = Pose2D(300.0, -150.0, 1.0)
NOTHING = 1e-9
NEAR = 0.5


@dataclass(frozen=True)
class Told:
    """What one width of noise makes of the scans.

    Args:
        alone: Answered without the copy.
        doubled: Of those that no width at all answers without the copy, answered with it.
        ambiguous: Of the same, ambiguous with it.
        both: Of these, with both places named.
        difference: Of the scores of the two places, root mean square.
    """

    alone: int
    doubled: int
    ambiguous: int
    both: int
    difference: float


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log")
    parser.add_argument("--later", help="an independent drive, which is asked")
    parser.add_argument("--queries", type=int, default=200)
    parser.add_argument("--range-max", type=float, help="metres that the laser sees")
    arguments = parser.parse_args()
    logs = [log for log in (arguments.log, arguments.later) if log]
    protocol = "P3" if arguments.later else "P1"
    (task,) = islice(tasks(read_drives(logs, arguments.range_max), (protocol,)), 1)
    asked = [scan for scan, _ in task.queries]
    asked = asked[:: max(1, len(asked) // arguments.queries)]
    print(" width  asked  alone  doubled  ambiguous  both named  difference")
    for width in (NOTHING, 0.005, 0.012, 0.018):
        told = measured(task.references, asked, width)
        print(
            f"{width:>6.3f} {len(asked):>6} {told.alone:>6} {told.doubled:>8} "
            f"{told.ambiguous:>10} {told.both:>11} {told.difference:>11.4f}"
        )


def measured(references: Sequence[Reference], asked: Sequence[LaserScan], width: float) -> Told:
    """Ask scans with and without a copy of the references."""
    loose = Matcher(references, with_width(NOTHING))
    once, twice = (Matcher(each, with_width(width)) for each in (references, doubled(references)))
    alone, answered, ambiguous, both, squares = 0, 0, 0, 0, []
    for scan in asked:
        without = once.locate(scan)
        alone += bool(without) and without[0].accepted
        best = loose.locate(scan)[:1]
        if not best or not best[0].accepted:
            continue
        found = twice.locate(scan)
        answered += found[0].accepted
        ambiguous += found[0].ambiguous
        named = [each for each in found if each.ambiguous]
        here, there = at(best[0].pose, found), at(copied(best[0].pose), found)
        both += here in named and there in named
        if here is not None and there is not None:
            squares.append((here.score - there.score) ** 2)
    difference = math.sqrt(sum(squares) / len(squares)) if squares else math.nan
    return Told(alone, answered, ambiguous, both, difference)


def with_width(width: float) -> Settings:
    """Return the shipped settings but for the noise of equal places."""
    return Settings.preset("default").changed({"decision": {"twins": width}})


def doubled(references: Sequence[Reference]) -> list[Reference]:
    """Return references and their copies."""
    first = 1 + max(reference.identifier for reference in references)
    copies = [
        Reference(first + n, each.scan, copied(each.pose)) for n, each in enumerate(references)
    ]
    return [*references, *copies]


def copied(pose: Pose2D | None) -> Pose2D:
    """Return where a pose is in the copy."""
    assert pose is not None
    return AWAY @ pose


def at(pose: Pose2D | None, found: Sequence[Hypothesis]) -> Hypothesis | None:
    """Return the first hypothesis at a place, if there is one."""
    assert pose is not None
    near = (each for each in found if each.pose is not None and each.pose.distance(pose) < NEAR)
    return next(near, None)


if __name__ == "__main__":
    main()
