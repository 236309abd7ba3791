"""Loop closures for SLAM: from a log's raw odometry to a map, with anchorscan and gtsam.

    python examples/loop_closures.py LOG -o FOLDER

needs ``pip install 'anchorscan[slam,plot]'``.  What it does, in the order of the drive:

1. A scan becomes a *keyframe* when the robot has moved half a metre or turned 20 degrees.
2. Each keyframe is matched with the one before it (``anchorscan.match``); the hypothesis that
   the odometry confirms becomes an edge of the pose graph.
3. Each keyframe is located among those that are ten metres of driving older
   (``anchorscan.Matcher``), with no prior.  Two accepted hypotheses in a row that the odometry
   joins are *loop closures*: edges to the keyframes that they name, with the covariances that
   they state.  One alone is not enough: much of what a robot sees in a new place looks like
   something it has seen before.
4. gtsam optimises the graph; references get their new poses, and the drive goes on.

Corrected poses in the log, where there are any, are only used to say how far off the result is.
It prints a table and writes a picture of before and after.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, starmap
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

import anchorscan
from anchorscan import Hypothesis, Matcher, Pose2D, Record, Reference, Settings

STEP, TURN = 0.5, math.radians(20.0)  # between keyframes
AGE = 10.0  # metres of driving that make a keyframe an earlier visit
BATCH = 25  # keyframes between two optimisations
# How far the odometry of one step may be off: a share of the step, and a fixed part.
ODOMETRY = (0.1, math.radians(5.0))
NEAR, NEAR_TURN = 0.3, math.radians(15.0)  # a match that the odometry confirms
FLOOR = (0.02, 0.02, math.radians(0.5))  # what no scan match is better than
RIGHT, RIGHT_TURN = 0.5, math.radians(10.0)  # a closure counts as right


@dataclass(frozen=True)
class Closure:
    """An earlier keyframe that a keyframe was located at: the pose is ``T_earlier_later``."""

    earlier: int
    later: int
    pose: Pose2D
    probability: float


@dataclass
class PoseGraph:
    """Keyframes and what relates them; poses are ``T_map_laser``, the first is the origin."""

    poses: list[Pose2D] = field(default_factory=list)
    graph: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)

    def begin(self) -> None:
        """Put the first keyframe at the origin."""
        self.poses.append(Pose2D())
        exact = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-6))
        self.graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), exact))

    def relate(
        self, earlier: int, later: int, pose: Pose2D, deviations: ArrayLike, robust: bool
    ) -> None:
        """Add an edge ``T_earlier_later`` with standard deviations along x, y, theta of later."""
        noise: gtsam.noiseModel.Base
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.asarray(deviations, dtype=float))
        if robust:  # a wrong edge must not bend the map
            kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(1.0)
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        between = gtsam.Pose2(pose.x, pose.y, pose.theta)
        self.graph.add(gtsam.BetweenFactorPose2(earlier, later, between, noise))

    def optimise(self) -> None:
        """Move all keyframes to where the edges agree best."""
        begin = gtsam.Values()
        for number, pose in enumerate(self.poses):
            begin.insert(number, gtsam.Pose2(pose.x, pose.y, pose.theta))
        found = gtsam.LevenbergMarquardtOptimizer(self.graph, begin).optimize()
        for number in range(len(self.poses)):
            moved = found.atPose2(number)
            self.poses[number] = Pose2D(moved.x(), moved.y(), moved.theta())


def keyframes(records: Iterable[Record]) -> list[Record]:
    """Keep a scan when the robot has moved or turned far enough since the last that was kept."""
    kept: list[Record] = []
    for record in records:
        if record.scan is None or record.odometry is None:
            continue
        if kept:
            move = step(kept[-1], record)
            if math.hypot(move.x, move.y) < STEP and abs(move.theta) < TURN:
                continue
        kept.append(record)
    return kept


def step(before: Record, after: Record) -> Pose2D:
    """What the odometry says of the way between two records."""
    assert before.odometry is not None
    assert after.odometry is not None
    return before.odometry.inverse() @ after.odometry


def confirmed(hypotheses: Iterable[Hypothesis], odometry: Pose2D) -> Hypothesis | None:
    """Return the first hypothesis that the odometry does not contradict."""
    for hypothesis in hypotheses:
        found = hypothesis.pose_in_reference
        if found.distance(odometry) < NEAR and found.turn(odometry) < NEAR_TURN:
            return hypothesis
    return None


def deviations(hypothesis: Hypothesis) -> NDArray[np.float64]:
    """Standard deviations of a hypothesis along x, y and theta of the scan itself."""
    pose = hypothesis.pose or hypothesis.pose_in_reference
    c, s = math.cos(pose.theta), math.sin(pose.theta)
    turned = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    covariance = turned @ hypothesis.covariance @ turned.T
    return np.asarray(np.sqrt(np.diag(covariance) + np.square(FLOOR)))


def relate_to_the_one_before(
    graph: PoseGraph, frames: Sequence[Record], number: int, settings: Settings
) -> None:
    """Add the edges between a keyframe and the one before: odometry, and a match where it fits."""
    before, now = frames[number - 1], frames[number]
    odometry = step(before, now)
    share, turn = ODOMETRY
    off = share * math.hypot(odometry.x, odometry.y) + 0.02
    graph.relate(number - 1, number, odometry, (off, off, turn), robust=False)
    best = odometry
    assert now.scan is not None
    assert before.scan is not None
    match = confirmed(anchorscan.match(now.scan, before.scan, settings), odometry)
    if match is not None:
        graph.relate(number - 1, number, match.pose_in_reference, deviations(match), robust=True)
        best = match.pose_in_reference
    graph.poses.append(graph.poses[-1] @ best)


def located(places: Matcher, frame: Record) -> Hypothesis | None:
    """Locate a keyframe among the earlier ones, with no prior; None where it is not known."""
    assert frame.scan is not None
    hypotheses = places.locate(frame.scan)  # none while there are no earlier ones
    return hypotheses[0] if hypotheses and hypotheses[0].accepted else None


def agree(before: Hypothesis, now: Hypothesis, odometry: Pose2D) -> bool:
    """Tell whether two answers in a row are as far apart as the odometry says."""
    assert before.pose is not None
    assert now.pose is not None
    expected = before.pose @ odometry
    return expected.distance(now.pose) < NEAR and expected.turn(now.pose) < NEAR_TURN


def references(
    graph: PoseGraph, frames: Sequence[Record], begin: int, end: int
) -> Iterator[Reference]:
    """Give keyframes as references, at the poses that the graph has for them now."""
    for number in range(begin, end):
        scan = frames[number].scan
        assert scan is not None
        yield Reference(number, scan, graph.poses[number])


def build_map(
    frames: Sequence[Record], settings: Settings, *, with_closures: bool = True
) -> tuple[list[Pose2D], list[Closure]]:
    """Go through a drive and return the poses of all keyframes, and the closures found."""
    graph, places = PoseGraph(), Matcher((), settings)
    closures: dict[int, Closure] = {}
    moves = list(starmap(step, pairwise(frames)))
    driven = np.cumsum([0.0, *(math.hypot(move.x, move.y) for move in moves)])
    known = optimised = 0
    before: Hypothesis | None = None
    graph.begin()
    for number in range(1, len(frames)):
        relate_to_the_one_before(graph, frames, number, settings)
        if not with_closures:
            continue
        if number % BATCH == 0:
            old = int(np.searchsorted(driven, driven[number] - AGE))
            if len(closures) > optimised:
                graph.optimise()
                places = Matcher(references(graph, frames, 0, old), settings)
                optimised = len(closures)
                before = None  # what it said was in the map as it was
            else:
                for reference in references(graph, frames, known, old):
                    places.add(reference)
            known = old
        now = located(places, frames[number])
        if now is not None and before is not None and agree(before, now, moves[number - 1]):
            for hypothesis, later in ((before, number - 1), (now, number)):
                if later not in closures:
                    closures[later] = close(graph, hypothesis, later)
        before = now
    graph.optimise()
    return graph.poses, list(closures.values())


def close(graph: PoseGraph, hypothesis: Hypothesis, later: int) -> Closure:
    """Relate a keyframe to the earlier one that it was located at."""
    pose, earlier = hypothesis.pose_in_reference, hypothesis.reference
    graph.relate(earlier, later, pose, deviations(hypothesis), robust=True)
    return Closure(earlier, later, pose, hypothesis.probability)


def by_odometry(frames: Sequence[Record]) -> list[Pose2D]:
    """Poses of the keyframes by odometry alone."""
    poses = [Pose2D()]
    for before, after in pairwise(frames):
        poses.append(poses[-1] @ step(before, after))
    return poses


def errors(poses: Sequence[Pose2D], frames: Sequence[Record]) -> NDArray[np.float64]:
    """Return the distance of every keyframe to its corrected pose, metres.

    The frames are laid on one another first, by the rotation and translation with the least
    squared distances: where the drive began is nobody's error.
    """
    pairs = [(p, f.pose) for p, f in zip(poses, frames, strict=True) if f.pose is not None]
    ours = np.array([(pose.x, pose.y) for pose, _ in pairs])
    theirs = np.array([(pose.x, pose.y) for _, pose in pairs])
    a, b = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    cosine, sine = np.sum(a * b), np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    turned = Pose2D(0.0, 0.0, math.atan2(sine, cosine)).apply(a)
    return np.asarray(np.linalg.norm(turned - b, axis=1))


def is_right(closure: Closure, frames: Sequence[Record]) -> bool:
    """Tell whether the corrected poses of the log confirm a closure."""
    earlier, later = frames[closure.earlier].pose, frames[closure.later].pose
    if earlier is None or later is None:
        return False
    truth = earlier.inverse() @ later
    return closure.pose.distance(truth) <= RIGHT and closure.pose.turn(truth) <= RIGHT_TURN


def draw(
    path: Path,
    frames: Sequence[Record],
    before: Sequence[Pose2D],
    after: Sequence[Pose2D],
    closures: Sequence[Closure],
) -> None:
    """Draw all scans at the poses of the odometry, and at those of the optimised graph."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 5.6), dpi=130, layout="constrained")
    for axes, poses, title in zip(
        figure.subplots(1, 2),
        (before, after),
        ("raw odometry", f"with {len(closures)} loop closures"),
        strict=True,
    ):
        scans = [frame.scan for frame in frames if frame.scan is not None]
        points = [pose.apply(scan.points) for pose, scan in zip(poses, scans, strict=True)]
        axes.plot(*np.concatenate(points).T, ",", color="#4d4d4d", alpha=0.25)
        axes.plot([p.x for p in poses], [p.y for p in poses], "-", color="#0072b2", lw=1.0)
        if poses is after:
            for one in closures:
                ends = poses[one.earlier], poses[one.later]
                axes.plot([p.x for p in ends], [p.y for p in ends], "-", color="#d55e00", lw=0.7)
        low, high = np.percentile(np.concatenate(points), (0.5, 99.5), axis=0)
        axes.set_xlim(low[0] - 1.0, high[0] + 1.0)
        axes.set_ylim(low[1] - 1.0, high[1] + 1.0)
        axes.set_aspect("equal")
        axes.set_title(title, loc="left")
        axes.set_xlabel("x, metres")
        axes.set_ylabel("y, metres")
    figure.savefig(path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Read a log, build the map with and without closures, print the table, draw."""
    parser = argparse.ArgumentParser(description="Loop closures for SLAM with gtsam.")
    parser.add_argument("log", help="a log with odometry; corrected poses give the errors")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the picture")
    parser.add_argument("--odometry", metavar="TOPIC", help="of a ROS recording that has several")
    options = parser.parse_args(arguments)

    settings = Settings.preset("default")
    log = anchorscan.open_log(options.log, odometry_topic=options.odometry)
    frames = keyframes(log)
    if len(frames) < 2:
        print(f"error: {options.log}: no odometry, or it stands still", file=sys.stderr)
        return 1
    raw = by_odometry(frames)
    matched, _ = build_map(frames, settings, with_closures=False)
    closed, closures = build_map(frames, settings)

    print(f"{len(frames)} keyframes, {len(closures)} loop closures", end="")
    if all(frame.pose is not None for frame in frames):
        right = sum(is_right(closure, frames) for closure in closures)
        print(f", {right} of them right\n")
        print(f"{'':28}{'rms':>9}{'median':>9}{'largest':>9}   metres off")
        for name, poses in (
            ("raw odometry", raw),
            ("matched with the one before", matched),
            ("with loop closures", closed),
        ):
            off = errors(poses, frames)
            rms = math.sqrt(float(np.mean(off**2)))
            print(f"{name:28}{rms:9.2f}{np.median(off):9.2f}{off.max():9.2f}")
    print()
    options.output.mkdir(parents=True, exist_ok=True)
    picture = options.output / "loop-closures.png"
    draw(picture, frames, raw, closed, closures)
    print(picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
