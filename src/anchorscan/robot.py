"""The robot between its messages and the belief: time, odometry, and where the laser sits.

A belief over time wants scans in order, each with the laser's pose by odometry.  A robot
delivers both at rates of their own, late or twice, with clocks that jump, wheels that start
again from zero, and a laser that sits somewhere on its base.  What stands between is here, and
knows nothing of ROS:

- odometry is interpolated to the time of the scan;
- a clock that jumps back (a simulation or a recording that begins again) starts everything
  over, a scan that is merely late is left out;
- odometry that jumps farther than a robot can drive ends the belief, not the announcement;
- answers are those of the robot's base: ``T_map_base = T_map_laser @ T_laser_base``, with the
  covariance carried along, since a laser ahead of the base turns a doubt about the heading
  into one about the position;
- scans that fit the map as their mirror images are of a laser upside down: then nothing is
  located.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from .localizer import Belief
from .plausibility import MirrorWatch
from .pose import Pose2D, wrap_angle
from .reference_set import ReferenceSet
from .scan import LaserScan

__all__ = ["Odometry", "Report", "Robot", "SingleScans", "State", "Tracker", "of_base"]

State = Literal["located", "ambiguous", "lost"]

# A clock that goes back farther than this was set; a message that is older than the newest one
# by less is late, seconds.
_CLOCK_JUMP = 1.0
# Odometry is kept for this long, and held to be true for so long before and after, seconds.
_MEMORY = 10.0
_REACH = 0.25
# Odometry this much older than a scan has stopped, and what was between two messages farther
# apart is not known, seconds.
_LATE = 1.0
# Farther than this and faster than this no robot drives between two messages, metres, and a
# second; nor does it turn more than this, radians, and a second.
_JUMP, _SPEED = 0.5, 5.0
_TURN_JUMP, _TURN_SPEED = 1.0, 6.0


class Tracker(Protocol):
    """A belief over time, as a `Localizer` is; poses are those of the laser, set's frame."""

    def update(
        self, scan: LaserScan, odometry: Pose2D | None, stamp: float, T_base_laser: Pose2D
    ) -> Belief:
        """Take a scan, ``T_odom_laser`` where known, the time in seconds, and the mounting."""

    def reset(self) -> None:
        """Know nothing."""


class SingleScans:
    """A tracker without memory: every scan is located on its own.

    Args:
        places: The reference set.
    """

    def __init__(self, places: ReferenceSet) -> None:
        self._places = places

    def update(
        self, scan: LaserScan, odometry: Pose2D | None, stamp: float, T_base_laser: Pose2D
    ) -> Belief:
        """Locate the scan."""
        hypotheses = tuple(self._places.locate(scan))
        elsewhere = max(0.0, 1.0 - sum(each.probability for each in hypotheses))
        accepted = bool(hypotheses) and hypotheses[0].accepted
        return Belief(hypotheses, elsewhere, accepted)

    def reset(self) -> None:
        """Forget nothing."""


@dataclass(frozen=True, eq=False)
class Report:
    """What is known after a scan.

    Args:
        stamp: Of the scan, seconds.
        state: Whether the robot is located; else whether several places explain the scans
            alike, or none does.
        T_map_base: The best guess, to be acted on only when located; None without any.
        covariance: (3, 3) of its x, y (metres) and theta (radians), map frame.
        probability: That it is right.
        hypotheses: Places of the base and their probabilities, best first.
        T_map_odom: What carries odometry into the map, where odometry is known.
    """

    stamp: float
    state: State
    T_map_base: Pose2D | None
    covariance: NDArray[np.float64]
    probability: float
    hypotheses: tuple[tuple[Pose2D, float], ...]
    T_map_odom: Pose2D | None


class Odometry:
    """``T_odom_base`` over the last seconds; one thread may add while another asks."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, Pose2D]] = deque()
        self._lock = threading.Condition()
        self.breaks = 0

    def add(self, stamp: float, T_odom_base: Pose2D) -> None:
        """Take the pose of the base at a time in seconds; what jumped begins anew."""
        if not (math.isfinite(stamp) and T_odom_base.is_finite()):
            return
        with self._lock:
            if self._samples:
                last, before = self._samples[-1]
                passed = stamp - last
                jumped = before.distance(T_odom_base) > _JUMP + _SPEED * abs(passed)
                jumped |= before.turn(T_odom_base) > _TURN_JUMP + _TURN_SPEED * abs(passed)
                if -_CLOCK_JUMP < passed <= 0.0 and not jumped:
                    return
                if passed <= -_CLOCK_JUMP or jumped:
                    self._samples.clear()
                    self.breaks += 1
            self._samples.append((stamp, T_odom_base))
            while self._samples[0][0] < stamp - _MEMORY:
                self._samples.popleft()
            self._lock.notify_all()

    def wait_until(self, stamp: float, seconds: float) -> None:
        """Wait until odometry has come as far as a time, but no longer than so many seconds.

        What was measured before a scan may be delivered after it.  Odometry that has never
        come, or has stopped, is not waited for.
        """
        with self._lock:
            if self._samples and 0.0 < stamp - self._samples[-1][0] < _LATE:
                self._lock.wait_for(
                    lambda: not self._samples or self._samples[-1][0] >= stamp, seconds
                )

    def at(self, stamp: float) -> Pose2D | None:
        """Return the pose of the base at a time, None where no message near it tells."""
        with self._lock:
            samples = tuple(self._samples)
        after = next((k for k, sample in enumerate(samples) if sample[0] >= stamp), len(samples))
        beside = samples[max(after - 1, 0) : after + 1]
        if len(beside) == 2 and beside[1][0] - beside[0][0] <= _LATE:
            return _between(beside[0], beside[1], stamp)
        nearest = min(beside, key=lambda sample: abs(sample[0] - stamp), default=None)
        is_near = nearest is not None and abs(nearest[0] - stamp) <= _REACH
        return nearest[1] if nearest is not None and is_near else None

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._samples.clear()


class Robot:
    """Feeds a belief with what a robot measures, and reports where its base is.

    ``odometry`` may be fed from another thread than the one that takes scans.

    Args:
        tracker: The belief.
        odometry: History to go on with; a new one if None.
        mirror: What asks whether the laser hangs upside down; nobody does if None.

    Attributes:
        odometry: Where the base is by odometry.
        is_announced: For the caller to note that the pose was told to others; starting over
            takes it back.
        late: Scans left out because a newer one had been taken.
    """

    def __init__(
        self,
        tracker: Tracker,
        odometry: Odometry | None = None,
        mirror: MirrorWatch | None = None,
    ) -> None:
        self._tracker = tracker
        self._mirror = mirror
        self.odometry = odometry or Odometry()
        self._breaks = self.odometry.breaks
        self._last = self._newest = -math.inf  # stamps: of scans taken, and of scans seen
        self.is_announced = False
        self.late = 0

    def take(self, scan: LaserScan, stamp: float, T_base_laser: Pose2D = Pose2D()) -> Report | None:
        """Take a scan and say where the robot is.

        Args:
            scan: Seen from above.
            stamp: Seconds.
            T_base_laser: Where the laser sits.

        Returns:
            None for a scan that came too late or twice, or at no time.
        """
        # Not by the newest seen: a scan may have waited while others were seen.
        if math.isfinite(stamp) and stamp <= self._last - _CLOCK_JUMP:
            self.start_over()
        if not (math.isfinite(stamp) and self._last < stamp):
            self.late += 1
            return None
        self._last, self._newest = stamp, max(self._newest, stamp)
        if self.odometry.breaks != self._breaks:
            self._breaks = self.odometry.breaks
            self._tracker.reset()
        T_odom_base = self.odometry.at(stamp)
        T_odom_laser = None if T_odom_base is None else T_odom_base @ T_base_laser
        belief = self._tracker.update(scan, T_odom_laser, stamp, T_base_laser)
        report = _report(belief, stamp, T_base_laser, T_odom_base)
        if self._mirror is not None:
            self._mirror.add(scan, T_odom_base)
        is_withheld = report.state == "located" and bool(self.doubt)
        return replace(report, state="ambiguous") if is_withheld else report

    @property
    def doubt(self) -> str:
        """Why nothing is located though a place was found, "" where nothing speaks against it."""
        if self._mirror is None or not self._mirror.is_doubtful:
            return ""
        return f"may hang upside down without anybody having said so: {self._mirror.found}"

    def watch_clock(self, stamp: float) -> None:
        """Start over when the time of a scan, taken or not, shows that the clock went back."""
        if not math.isfinite(stamp):
            return
        if stamp <= self._newest - _CLOCK_JUMP:
            self.start_over()
        self._newest = max(self._newest, stamp)

    def start_over(self) -> None:
        """Forget where the robot is, and that anybody was told."""
        self._tracker.reset()
        if self._mirror is not None:
            self._mirror.reset()
        self._last = self._newest = -math.inf
        self.is_announced = False


def of_base(
    T_map_laser: Pose2D, covariance: NDArray[np.float64], T_base_laser: Pose2D
) -> tuple[Pose2D, NDArray[np.float64]]:
    """Carry pose and (3, 3) covariance from the laser to the base that it sits on."""
    T_laser_base = T_base_laser.inverse()
    T_map_base = T_map_laser @ T_laser_base
    arm = T_map_base.to_array()[:2] - T_map_laser.to_array()[:2]
    jacobian = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]])
    return T_map_base, jacobian @ covariance @ jacobian.T


def _report(
    belief: Belief, stamp: float, T_base_laser: Pose2D, T_odom_base: Pose2D | None
) -> Report:
    T_map_base, covariance = None, np.full((3, 3), math.nan)
    if belief.pose is not None and belief.covariance is not None:
        T_map_base, covariance = of_base(belief.pose, belief.covariance, T_base_laser)
    T_laser_base = T_base_laser.inverse()
    places = tuple(
        (each.pose @ T_laser_base, each.probability)
        for each in belief.hypotheses
        if each.pose is not None
    )
    known = T_map_base is not None and T_odom_base is not None
    return Report(
        stamp=stamp,
        state=belief.state,
        T_map_base=T_map_base,
        covariance=covariance,
        probability=belief.probability,
        hypotheses=places,
        T_map_odom=T_map_base @ T_odom_base.inverse() if known else None,  # type: ignore[operator, union-attr]
    )


def _between(
    earlier: tuple[float, Pose2D], later: tuple[float, Pose2D], stamp: float
) -> Pose2D | None:
    share = (stamp - earlier[0]) / (later[0] - earlier[0])
    a, b = earlier[1], later[1]
    return Pose2D(
        a.x + share * (b.x - a.x),
        a.y + share * (b.y - a.y),
        a.theta + share * wrap_angle(b.theta - a.theta),
    )
