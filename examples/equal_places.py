"""What is answered where a building and its exact copy are one map.

    python examples/equal_places.py LOG [--later LOG] [--queries N] [--range-max M]

References and queries by protocol P1, or by P3 with a later drive; the same references once more,
carried off and turned.  For the width of noise that is shipped (``decision.twins``) and for others:
how many scans are answered alone, without the copy, which is fewer than without any width by what
the width costs.  Of those that are answered alone without any width: how many are answered with
the copy, which nothing can be sure of; how many are ambiguous then, and of how many both places
are named; and how far apart the scores of the two places are, in the root mean square.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import numpy as np

from anchorscan import LaserScan, Matcher, Pose2D, Reference, Settings
from anchorscan.benchmark import read_drives, tasks
from anchorscan.decision import Decision, decide
from anchorscan.description import describe
from anchorscan.verification import FEATURES, Fits

AWAY = Pose2D(300.0, -150.0, 1.0)
NOTHING = 1e-9
WIDTHS = (NOTHING, 0.005, 0.012, 0.018)
NEAR = 0.5
SETTINGS = Settings.preset("default")


@dataclass(frozen=True)
class Asked:
    """What was found for one scan.

    Args:
        anchors: How many anchor points it has.
        once: Fits in the map.
        twice: Fits in the map with the copy.
    """

    anchors: int
    once: Fits
    twice: Fits

    def alone(self, width: float) -> Decision:
        """Decide without the copy."""
        return decided(self.once, self.anchors, width)

    def doubled(self, width: float) -> Decision:
        """Decide with the copy."""
        return decided(self.twice, self.anchors, width)

    @cached_property
    def places(self) -> list[int]:
        """Ranks with the copy of the place that is best without it, and of its copy."""
        best = Pose2D(*self.once.poses[0])
        found = [Pose2D(*pose) for pose in self.twice.poses]
        near = (
            [k for k, p in enumerate(found) if p.distance(at) < NEAR] for at in (best, AWAY @ best)
        )
        return [ranks[0] for ranks in near if ranks]


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
    scans = [scan for scan, _ in task.queries]
    scans = scans[:: max(1, len(scans) // arguments.queries)]
    asked = searched(task.references, scans)
    sure = [each for each in asked if each.alone(NOTHING).accepted]
    both = [each for each in sure if len(each.places) == 2]
    apart = [np.diff(each.twice.features[each.places, FEATURES.index("score")]) for each in both]
    difference = math.sqrt(float(np.mean(np.square(apart)))) if apart else math.nan
    print(" width  asked  alone  doubled  ambiguous  both named  difference")
    for width in WIDTHS:
        alone = sum(each.alone(width).accepted for each in asked)
        told = [(each, each.doubled(width)) for each in sure]
        answered = sum(decision.accepted for _, decision in told)
        ambiguous = sum(decision.is_ambiguous(0) for _, decision in told)
        named = sum(
            len(each.places) == 2 and all(map(decision.is_ambiguous, each.places))
            for each, decision in told
        )
        print(
            f"{width:>6.3f} {len(scans):>6} {alone:>6} {answered:>8} "
            f"{ambiguous:>10} {named:>11} {difference:>11.4f}"
        )


def searched(references: Sequence[Reference], scans: Sequence[LaserScan]) -> list[Asked]:
    """Search for scans with and without a copy of the references."""
    once, twice = Matcher(references, SETTINGS), Matcher(doubled(references), SETTINGS)
    asked = []
    for scan in scans:
        description = describe(scan, SETTINGS)
        alone, both = once.fits(description), twice.fits(description)
        if alone and both:
            asked.append(Asked(len(description.anchors), alone, both))
    return asked


def decided(fits: Fits, anchors: int, width: float) -> Decision:
    """Decide as shipped, but for the noise of equal places."""
    return decide(fits, anchors, SETTINGS.decision.model_copy(update={"twins": width}))


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


if __name__ == "__main__":
    main()
