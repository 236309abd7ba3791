"""One process changes a reference set, another reads it and locates; either is killed at random.

As a script it goes on for as long as it is asked to::

    python tests/reference_set_two_processes.py --minutes 10 --seed 7

and ends with what was done, or with the first thing that was lost or wrong.

What the writer does next follows from what is stored: seven references are added to a set of few,
the oldest is removed from a set of many.  So whatever was killed when, what is stored is a row of
numbers without a gap that ends with a whole batch, and only ever moves on.
"""

from __future__ import annotations

import argparse
import queue
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from reference_set_kills import check_sound, say

from anchorscan import LaserScan, Pose2D
from anchorscan.reference_set import ReferenceSet

BATCH = 7
MANY = 40
DRAWN = 150
LONGEST_WAIT = 1.0
PATIENCE = 300.0
_NEAR = 0.5


@dataclass(frozen=True)
class Scans:
    """What every reference must hold, by its number."""

    ranges: np.ndarray
    poses: np.ndarray

    @classmethod
    def draw(cls, path: Path) -> Scans:
        """See a simulated building from many places, and keep that in a file."""
        from anchorscan import SensorModel, random_building, simulate
        from anchorscan.simulator import random_poses

        rng = np.random.default_rng(0)
        world = random_building(5)
        poses = random_poses(world, DRAWN, rng)
        seen = [simulate(world, pose, SensorModel(), rng).ranges for pose in poses]
        np.savez(path, ranges=np.array(seen), poses=np.array([pose.to_array() for pose in poses]))
        return cls.load(path)

    @classmethod
    def load(cls, path: Path) -> Scans:
        with np.load(path, allow_pickle=False) as kept:
            return cls(kept["ranges"], kept["poses"])

    def scan(self, number: int) -> LaserScan:
        return LaserScan.from_field_of_view(
            self.ranges[number % DRAWN], np.pi, range_min=0.05, range_max=30.0
        )

    def pose(self, number: int) -> Pose2D:
        return Pose2D.from_array(self.poses[number % DRAWN])


def write(path: Path, scans: Scans) -> None:
    """Add and remove until killed; say what is stored."""
    say("ready")
    with ReferenceSet.open(path) if path.exists() else ReferenceSet(path=path) as places:
        while True:
            if len(places) < MANY:
                first = places.info().next_identifier
                numbers = range(first, first + BATCH)
                places.add_batch([scans.scan(n) for n in numbers], [scans.pose(n) for n in numbers])
            else:
                places.remove(places.references[0].identifier)
            say("{} {}".format(*state(places)))
            time.sleep(0.002)


def read(path: Path, scans: Scans) -> None:
    """Follow the file and locate until killed; whatever is wrong ends it at once."""
    while not path.exists():
        time.sleep(0.01)
    places = ReferenceSet.open(path)
    places.prepare()
    say("ready")
    before = (0, 0)
    while True:
        places.refresh()
        now = check(places, scans)
        assert now >= before, f"the set went back from {before} to {now}"
        before = now
        if len(places):
            newest = places.references[-1]
            best = places.locate(newest.scan)[0]
            assert best.reference in places
            assert not best.accepted or best.pose.distance(newest.pose) <= _NEAR
        say("{} {}".format(*now))


def state(places: ReferenceSet) -> tuple[int, int]:
    """The number that comes next, and the number of the first that is there."""
    following = places.info().next_identifier
    return following, places.references[0].identifier if len(places) else following


def check(places: ReferenceSet, scans: Scans) -> tuple[int, int]:
    """The set holds a row without a gap that ends with a whole batch, to the bit."""
    following, first = state(places)
    assert following % BATCH == 0
    assert [each.identifier for each in places.references] == list(range(first, following))
    assert len(places) < MANY + BATCH
    for each in places.references:
        assert each.scan.ranges.tobytes() == scans.scan(each.identifier).ranges.tobytes()
        assert each.pose == scans.pose(each.identifier)
    return following, first


def after(told: tuple[int, int]) -> tuple[int, int]:
    """What the next change makes of a state."""
    following, first = told
    return (following + BATCH, first) if following - first < MANY else (following, first + 1)


@dataclass
class Child:
    """A process, and what it has said; its pipe is emptied all the time."""

    role: str
    path: Path
    scans: Path
    said: list[str] = field(default_factory=list)
    lines: queue.SimpleQueue[str] = field(default_factory=queue.SimpleQueue)

    def __post_init__(self) -> None:
        words = [sys.executable, __file__, "--role", self.role, str(self.path), str(self.scans)]
        self.process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        self.reader = threading.Thread(target=self._listen, daemon=True)
        self.reader.start()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.put(line.strip())

    def wait_for_a_state(self) -> None:
        """Wait until it has begun and has told of a state at least once."""
        while len(self.said) < 2:
            self.said.append(self.lines.get(timeout=PATIENCE))

    def kill(self) -> list[tuple[int, int]]:
        """Kill it; return the states that it told of."""
        assert self.process.poll() is None, f"the {self.role} ended by itself"
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        self.reader.join()
        assert self.process.stdout is not None
        self.process.stdout.close()
        while not self.lines.empty():
            self.said.append(self.lines.get())
        assert self.process.returncode == -signal.SIGKILL, f"the {self.role} failed by itself"
        # The last line may be cut off in the middle.
        words = [line.split() for line in self.said if line != "ready"]
        return [(int(line[0]), int(line[1])) for line in words if len(line) == 2]


@dataclass
class Done:
    """What a run did."""

    kills: int = 0
    changes: int = 0
    located: int = 0


def disturb(folder: Path, seed: int, kills: int | None = None, seconds: float = 0.0) -> Done:
    """Kill writer, reader or both, again and again, so often or for so long."""
    path, drawn = folder / "shared.apr", folder / "scans.npz"
    scans = Scans.draw(drawn)
    ReferenceSet().prepare()  # who is killed while it compiles would compile for ever
    children = {role: Child(role, path, drawn) for role in ("write", "read")}
    try:
        done = _disturb(children, scans, random.Random(seed), kills, seconds)
    finally:
        for child in children.values():
            child.process.kill()
            child.process.wait()
    check(ReferenceSet.open(path), scans)
    check_sound(path)
    return done


def _disturb(
    children: dict[str, Child],
    scans: Scans,
    rng: random.Random,
    kills: int | None,
    seconds: float,
) -> Done:
    path, drawn = children["read"].path, children["read"].scans
    done, stored = Done(), (0, 0)
    end = time.monotonic() + seconds
    while done.kills < kills if kills is not None else time.monotonic() < end:
        victims = rng.choice((("write",), ("read",), ("write", "read")))
        if rng.random() < 0.8:  # let it come to something
            for role in victims:
                children[role].wait_for_a_state()
        time.sleep(rng.uniform(0.0, LONGEST_WAIT))
        told = {role: children[role].kill() for role in victims}
        done.kills += len(victims)
        done.located += len(told.get("read", ()))
        for seen in told.get("read", ()):
            # The reader may be behind, but has seen nothing that was never stored.
            assert "write" not in told or seen <= after(max(told["write"], default=stored))
        if "write" in told and path.exists():
            now = check(ReferenceSet.open(path), scans)
            last = max(told["write"], default=stored)
            assert now in (last, after(last)), f"told of {last}, found {now}"
            done.changes += len(told["write"])
            stored = now
        for role in victims:
            children[role] = Child(role, path, drawn)
    for child in children.values():
        assert child.process.poll() is None, f"the {child.role} ended by itself"
    return done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--role", nargs=3, metavar=("ROLE", "SET", "SCANS"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.role:
        role, path, drawn = given.role
        (write if role == "write" else read)(Path(path), Scans.load(Path(drawn)))
        return
    folder = Path(tempfile.mkdtemp())
    try:
        done = disturb(folder, given.seed, seconds=60.0 * given.minutes)
    except (AssertionError, queue.Empty):
        print(f"what was left is in {folder}", file=sys.stderr)
        raise
    print(
        f"{given.minutes:g} minutes: {done.kills} kills, {done.changes} changes told of by killed "
        f"writers, {done.located} reads by killed readers, nothing lost and nothing wrong"
    )
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
