"""How well a robot is followed in a map of places that have neighbours, but no poses.

    python examples/places_without_poses.py LOG [--starts N] [--longest M] [--seed N]

Protocol P5 on one drive, odometry with 5 % of noise, in references whose poses are taken away;
references nearer than 3 m are neighbours.  A step counts where a reference lies within 2 m and 45
degrees.  A named reference is right within 3 m and 90 degrees.  Who is confident says that the
robot is at the named reference or at one of its neighbours: that is right where one of these is
among those within 2 m and 45 degrees.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from anchorscan import Matcher, Pose2D, Record, Reference, TopologicalLocalizer
from anchorscan.benchmark import read_drives
from anchorscan.lost_robot import Course, Departure, departures

_BESIDE = 3.0


@dataclass(frozen=True)
class Step:
    """What was named, whether it was right, and whether the confident claim was."""

    right: bool
    alone: bool
    confident: bool
    kept: bool
    seconds: float


def main() -> None:
    """Print what all steps say."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("log")
    parser.add_argument("--starts", type=int, help="at most so many")
    parser.add_argument("--longest", type=float, default=100.0, help="metres")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    (drive,) = read_drives([arguments.log])
    course = Course(drive.name, drive, drive)
    made = departures(
        course, "noise", arguments.starts, longest=arguments.longest, seed=arguments.seed
    )
    journeys = [steps(drive.records, one) for one in made if one is not None]
    told = [step for journey in journeys for step in journey]
    sure = [step for step in told if step.confident]
    misled = sum(any(s.confident and not s.kept for s in journey) for journey in journeys)
    print(
        f"{len(journeys)} journeys, {len(told)} steps: right {share([s.right for s in told])}, "
        f"single scans {share([s.alone for s in told])}; confident {len(sure)}, of them right "
        f"{share([s.kept for s in sure])}, wrong some time on {misled} journeys; "
        f"{1e3 * sorted(s.seconds for s in told)[len(told) // 2]:.0f} ms a step"
    )


def share(values: Sequence[bool]) -> str:
    """Share that is true, two digits."""
    return f"{sum(values) / len(values):.2f}" if values else "-"


def steps(records: Sequence[Record], departure: Departure) -> list[Step]:
    """Follow one journey."""
    poses = {r.identifier: r.pose for r in departure.references}
    beside = [(a, b) for a, b in combinations(poses, 2) if poses[a].distance(poses[b]) <= _BESIDE]
    matcher = Matcher(Reference(r.identifier, r.scan) for r in departure.references)
    around = {identifier: {identifier} for identifier in poses}
    for a, b in beside:
        around[a].add(b)
        around[b].add(a)
    localizer = TopologicalLocalizer(matcher, beside)
    single = TopologicalLocalizer(matcher, [])
    told = []
    for position, odometry in zip(departure.journey.positions, departure.odometry, strict=True):
        record = records[position]
        begin = time.process_time()
        belief = localizer.update(record.scan, odometry, record.stamp)
        seconds = time.process_time() - begin
        single.reset()
        alone = single.update(record.scan)
        truth = record.pose
        here = {each for each, pose in poses.items() if is_near(pose, truth, 2.0, 45.0)}
        if here:
            right, by_itself = (
                one.reference is not None and is_near(poses[one.reference], truth, _BESIDE, 90.0)
                for one in (belief, alone)
            )
            kept = not here.isdisjoint(around.get(belief.reference, ()))
            told.append(Step(right, by_itself, belief.accepted, kept, seconds))
    return told


def is_near(named: Pose2D, truth: Pose2D, metres: float, degrees: float) -> bool:
    """Whether a reference was taken so near to where the robot is, and turned so little."""
    return named.distance(truth) <= metres and named.turn(truth) <= math.radians(degrees)


if __name__ == "__main__":
    main()
