"""Finding a lost robot on the move: scans and odometry in, a belief out, one scan at a time.

The paper recommends its hypotheses for probabilistic localization with the ability to recover
from arbitrary errors.  The localizer starts without any prior: hypotheses of the whole map become
places of a mixture, odometry moves them, every scan weighs and refines them, and the map is
searched again every now and then, so that a robot which was carried away is found again.

A search may look with a window of the latest scans, joined by odometry into a view all around,
which finds places that were mapped from the opposite direction; every scan is still weighed alone.

Every step costs a bounded number of look-ups and at most one search; memory is bounded; nothing
is random and nothing runs beside.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from .belief import (
    Found,
    Mixture,
    admitted,
    claimed,
    has_stood,
    moved,
    nothing_known,
    stiffness,
    tidied,
    together,
    weighed,
)
from .covariance import held
from .errors import ReferenceSetError, SettingsError
from .hypothesis import Hypothesis
from .matcher import _ROOM, Candidates, Matcher, Trace
from .motion import Motion, Odometer, new_share
from .pose import Pose2D
from .record import Record
from .reference import Reference
from .scan import LaserScan
from .settings import Settings
from .verification import Fits
from .window import joined_scan

__all__ = ["Belief", "Localizer"]

# How many places a belief names, and how much likelier than the next the best must be.
_NAMED = 5
_ALIKE = 0.3
# So many scans of a window are kept, at equal steps.
_KEPT = 32


class Places(Protocol):
    """What a localizer asks of a map: a `Matcher` or a `ReferenceSet`."""

    @property
    def settings(self) -> Settings: ...
    def explain(self, scan: LaserScan, candidates: Candidates = None) -> Trace: ...
    def follow(
        self, scan: LaserScan, poses: NDArray[np.float64], stiffness: NDArray[np.float64]
    ) -> Fits: ...
    def nearest(
        self, poses: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]: ...


@dataclass(frozen=True, eq=False)
class Belief:
    """Where the robot is believed to be after a scan.

    Args:
        hypotheses: The likeliest places of the laser, best first; their ``evaluation`` and
            ``quality`` are NaN, their ``score`` is the log odds that the latest scan gave.
        elsewhere: Probability that it is at none of all places.
        accepted: Whether the best is to be acted on.
    """

    hypotheses: tuple[Hypothesis, ...]
    elsewhere: float
    accepted: bool

    @property
    def pose(self) -> Pose2D | None:
        """``T_set_laser``, the best guess; None without any."""
        return self.hypotheses[0].pose if self.hypotheses else None

    @property
    def covariance(self) -> NDArray[np.float64] | None:
        """(3, 3) of its x, y (metres) and theta (radians), set's frame."""
        return self.hypotheses[0].covariance if self.hypotheses else None

    @property
    def probability(self) -> float:
        """That the best guess is within 0.5 m and 10 degrees of the truth."""
        return self.hypotheses[0].probability if self.hypotheses else 0.0

    @property
    def state(self) -> Literal["located", "ambiguous", "lost"]:
        """Whether the robot is located, at one of several places alike, or anywhere."""
        if self.accepted:
            return "located"
        first, second = (*(each.probability for each in self.hypotheses[:2]), 0.0, 0.0)[:2]
        both = first + second
        return "ambiguous" if second >= _ALIKE * first and both > self.elsewhere else "lost"


class Localizer:
    """Keeps a belief over time in a set whose references have poses.

    Args:
        places: A reference set or a matcher; references may come and go meanwhile.
        window: Metres of driving whose scans are joined for a search, where odometry is known;
            zero searches with single scans.

    Raises:
        SettingsError: The settings search references one by one, and so there is no map.
    """

    def __init__(self, places: Places, window: float = 0.0) -> None:
        if places.settings.method != "map":
            raise SettingsError(
                "a robot is followed in the map of all references, and these settings (preset "
                "paper) search them one by one: use those of the preset default or thorough"
            )
        self._places = places
        self._window = window
        self._settings = places.settings.belief
        self._knew_poses = False
        self.reset()

    def reset(self) -> None:
        """Know nothing."""
        self._mixture = nothing_known()
        self._odometer = Odometer(self._settings.motion)
        self._recent: deque[Record] = deque(maxlen=_KEPT)
        self._since_search = math.inf
        self._since_located = 0.0
        self._belief = Belief((), 1.0, False)

    def prepare(self) -> None:
        """Compile everything, so that the first real scan does not pay for it."""
        other = Localizer(Matcher((Reference(0, _ROOM, Pose2D()),), self._places.settings))
        for x in (0.0, 0.1):
            other.update(_ROOM, Pose2D(x, 0.0, 0.0), x)

    @property
    def mixture(self) -> Mixture:
        """All places and their weights."""
        return self._mixture

    def update(
        self,
        scan: LaserScan,
        odometry: Pose2D | None = None,
        stamp: float | None = None,
        T_base_laser: Pose2D = Pose2D(),
    ) -> Belief:
        """Take the next scan.

        Args:
            scan: In the frame of the laser.
            odometry: ``T_odom_laser`` when it was taken, where known.
            stamp: Seconds on any clock, where known; needed only where odometry is not.
            T_base_laser: Where the laser sits; needed only where scans come from several lasers,
                which see the same from a robot at rest.

        Returns:
            What is believed now.

        Raises:
            ReferenceSetError: There are references, and no reference ever had a pose.
        """
        settings = self._settings
        step = self._odometer.step(odometry, stamp, T_base_laser)
        self._remember(scan, step)
        if not scan.is_return.any():
            self._mixture = moved(self._mixture, step, settings)
            return self._report()
        expected = moved(self._mixture, step, settings)
        mixture, origin, claim = expected, np.arange(len(expected)), None
        if self._is_due(step):
            found = self._search(scan)
            mixture, origin = admitted(expected, found, settings)
            claim = claimed(mixture, found, settings)
        if len(mixture):
            fits = self._places.follow(scan, mixture.poses, stiffness(mixture, settings))
            share = self._share(step, expected, fits)
            mixture = tidied(weighed(mixture, fits, origin, share, settings, claim), settings)
        self._mixture = mixture
        return self._report()

    def _is_due(self, step: Motion) -> bool:
        """Whether the whole map is to be searched for this scan."""
        way = step.driven + 0.5 * step.turned
        self._since_located = 0.0 if self._belief.accepted else self._since_located + way
        self._since_search += way
        spacing = self._spacing()
        due = self._since_search >= spacing or not len(self._mixture)
        if due:
            self._since_search = 0.0
        return due

    def _spacing(self) -> float:
        """Way between searches: short while there is doubt, longer again where none has helped."""
        settings, belief = self._settings, self._belief
        if belief.accepted and belief.hypotheses[0].score >= settings.least_record:
            return settings.check_spacing
        longer = settings.search_less * self._since_located
        return min(max(settings.search_spacing, longer), settings.check_spacing)

    def _remember(self, scan: LaserScan, step: Motion) -> None:
        """Keep the scan for the window if the robot went on a bit; what went before a gap goes."""
        if self._window <= 0.0 or self._odometer.latest is None:
            return
        if not step.measured:
            self._recent.clear()
        kept = self._recent[-1].odometry if self._recent else None
        if kept is None or kept.distance(self._odometer.latest) >= self._window / _KEPT:
            self._recent.append(Record(0, scan, odometry=self._odometer.latest))

    def _search(self, scan: LaserScan) -> Found:
        if self._recent and self._odometer.latest is not None:
            latest = Record(0, scan, odometry=self._odometer.latest)
            scan = joined_scan([*self._recent, latest], self._window)
        trace = self._places.explain(scan)
        in_map = trace.in_map
        self._knew_poses |= in_map is not None
        if trace.pairwise is not None and not self._knew_poses:
            raise ReferenceSetError(
                "a robot is followed by the poses of the references, and none of these has one: "
                "use TopologicalLocalizer, which follows it from neighbour to neighbour"
            )
        if in_map is None or not len(in_map.fits):
            return Found(np.empty((0, 3)))
        decision = in_map.decision
        return Found(in_map.fits.poses, float(decision.probabilities[0]), decision.accepted)

    def _share(self, step: Motion, expected: Mixture, fits: Fits) -> float:
        """How much of a scan's evidence is new; by the motion seen, where none was measured."""
        driven, turned = step.driven, step.turned
        if not step.measured and len(expected):
            before, now = Pose2D(*expected.poses[0].tolist()), Pose2D(*fits.poses[0].tolist())
            driven, turned = min(driven, before.distance(now)), min(turned, before.turn(now))
        return new_share(driven, turned, self._settings)

    def _report(self) -> Belief:
        """Name the likeliest places."""
        mixture, settings = self._mixture, self._settings
        order, worth = together(mixture, settings)
        right = worth[:_NAMED] * [held(mixture.covariances[k]) for k in order[:_NAMED]]
        best = np.argsort(-right, kind="stable")
        order, right = order[best], right[best]
        references, T_reference_laser = self._places.nearest(mixture.poses[order])
        if len(references) < len(order):
            # The last reference went: nothing is left to be anywhere in.
            self._mixture, self._belief = nothing_known(), Belief((), 1.0, False)
            return self._belief
        accepted = (
            bool(len(order))
            and bool(right[0] >= settings.threshold)
            and has_stood(mixture, int(order[0]), settings)
        )
        hypotheses = tuple(
            Hypothesis(
                reference=int(references[n]),
                pose_in_reference=Pose2D(*T_reference_laser[n].tolist()),
                pose=Pose2D(*mixture.poses[k].tolist()),
                covariance=mixture.covariances[k],
                evaluation=math.nan,
                quality=math.nan,
                score=float(mixture.support[k]),
                probability=float(right[n]),
                accepted=accepted and n == 0,
            )
            for n, k in enumerate(order)
        )
        self._belief = Belief(hypotheses, max(1.0 - float(worth.sum()), 0.0), accepted)
        return self._belief
