"""Which references of a set contradict the others (``anchorscan check``), or would (``add``).

Every reference is taken out of the map, compared with what the others show at its own pose, and
located among them.  One that fits clearly better somewhere else was put into the set with a wrong
pose; so, in all likelihood, was one whose readings end where the others saw no surface.  A place
that no other reference has seen cannot be judged by them.  But references are taken on a way, one
after the other: one that lies far off the way from the one before it to the one after it, and that
the others do not bear out, was put there by mistake.

Wrong poses in a twentieth of the references do not make answers wrong, since the others outvote
them (figures in the documentation); they make them less sure.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import ReferenceSetError
from .matcher import Matcher
from .pose import Pose2D
from .progress import ProgressOf
from .record import Record
from .reference import Reference
from .reference_set import ReferenceSet
from .verification import FEATURES

__all__ = ["FrameCheck", "ReferenceCheck", "Verdict", "check", "frame_check", "run"]

Item = TypeVar("Item")
Verdict = Literal["sound", "misplaced", "contradicted", "astray", "alone"]

_NEAR, _UNKNOWN = FEATURES.index("near"), FEATURES.index("unknown")
# A pose that is off by less is no wrong one: what counts as correct, doubled in heading.
_AWAY, _TURNED = 0.5, math.radians(20.0)
# Shares of the readings; chosen on intel, freiburg-079 and wean, the others had no part in that.
_CLEARLY_BETTER = 0.2
_UNSEEN = 0.5
# Of the readings in places that others saw, if these are enough.
_TOO_FEW_NEAR, _FEWEST_SEEN = 0.5, 0.15
# By how much one reference makes the way longer, metres, and the share of its readings that bear
# it out.
_DETOUR, _BORNE_OUT = 3.0, 0.8
# References of which more than a quarter make the way longer by so much do not lie on one, metres;
# nor do two that are more of its usual steps apart, between which one is left out.
_ON_NO_WAY, _MOST_STEPS = 1.0, 3.0
# Of fewer, a quarter make the way longer where a single one is misplaced.
_SHORTEST_WAY = 12
# Scans of a log that are judged, of so many at its beginning; how many of these, and which share,
# have to be wrong for the frame to be.
_LOOKED_AT, _ASKED = 400, 24
_FEWEST, _WRONG_SHARE = 5, 0.7


@dataclass(frozen=True, eq=False)
class ReferenceCheck:
    """What the other references say of one.

    Args:
        reference: The reference.
        verdict: "sound"; "misplaced", it fits elsewhere; "contradicted", it does not fit where
            it is said to be, nor surely elsewhere; "astray", it lies off the way of those before
            and after it, and few of its readings agree with any other; "alone", no other has
            seen its place.
        near: Share of its readings that end within 10 cm of a surface that others saw.
        seen: Share of its readings that end in places that others saw.
        detour: By how much longer the way from the reference before it to the one after it gets
            by it, metres.
        elsewhere: ``T_set_laser`` where it fits, if it is misplaced.
        near_elsewhere: Share of the readings near a surface there; NaN if it is not misplaced.
    """

    reference: Reference
    verdict: Verdict
    near: float
    seen: float
    detour: float
    elsewhere: Pose2D | None = None
    near_elsewhere: float = math.nan

    @property
    def is_wrong(self) -> bool:
        """Whether its pose is, in all likelihood."""
        return self.verdict in ("misplaced", "contradicted", "astray")

    def __str__(self) -> str:
        """Say it in one line."""
        reference = self.reference
        name = f" ({reference.name})" if reference.name else ""
        pose = reference.pose
        assert pose is not None
        begin = f"reference {reference.identifier}{name} at {_place(pose)}: {self.verdict}"
        if self.verdict == "astray":
            begin += f", a detour of {self.detour:.1f} m"
        if self.elsewhere is None:
            return (
                f"{begin}; {100.0 * self.near:.0f} % of its readings agree with the others, "
                f"{100.0 * self.seen:.0f} % end in places that they saw"
            )
        away = pose.distance(self.elsewhere)
        return (
            f"{begin}; it fits at {_place(self.elsewhere)}, {away:.1f} m away: "
            f"{100.0 * self.near_elsewhere:.0f} % of its readings agree there, "
            f"{100.0 * self.near:.0f} % here"
        )


def check(
    places: ReferenceSet,
    progress: ProgressOf = lambda items, what, total=None: items,
) -> Iterator[ReferenceCheck]:
    """Compare every reference that has a pose with all others, in their order.

    Args:
        places: A set whose references are searched as one map.
        progress: Wraps what takes a while.

    Raises:
        ReferenceSetError: Fewer than two references have a pose, or the settings ask for the
            method of the paper, which has no map.
    """
    posed = [reference for reference in places.references if reference.pose is not None]
    matcher = Matcher(posed, places.settings)
    if len(posed) < 2 or not matcher.has_map:
        raise ReferenceSetError(
            f"{places.path or 'the set'}: only references with poses, searched as one map, can be "
            f"compared with each other; here are {len(posed)} with a pose"
        )
    detours = detours_of(np.array([[each.pose.x, each.pose.y] for each in posed if each.pose]))
    judged = zip(posed, detours.tolist(), strict=True)
    for reference, detour in progress(judged, "checking", len(posed)):
        matcher.remove(reference.identifier)
        yield _judge(reference, detour, matcher)
        matcher.add(reference)


def detours_of(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Say by how much each of some positions makes the way through all of them longer.

    Args:
        positions: (N, 2) in the order of the way, metres.

    Returns:
        (N,) metres; 0 for the ends and those next to them, which may make a detour because an end
        is misplaced, for one beside another that makes it longer still, for one whose neighbours
        are far apart, as where one log follows another, and for all where the order is no way:
        where more than a quarter make it longer by a metre, or where there are fewer than twelve.
    """
    lengths = np.hypot(*np.diff(positions, axis=0).T)
    straight = np.hypot(*(positions[2:] - positions[:-2]).T)
    detours = np.zeros(len(positions))
    detours[1:-1] = lengths[:-1] + lengths[1:] - straight
    if len(positions) < _SHORTEST_WAY or np.quantile(detours[1:-1], 0.75) > _ON_NO_WAY:
        return np.zeros(len(positions))
    detours[1:-1][straight > _MOST_STEPS * np.median(lengths)] = 0.0
    # The neighbours of one that is misplaced make a detour, too, and so does that of an end.
    before, after = np.append(0.0, detours[:-1]), np.append(detours[1:], 0.0)
    is_largest = (detours >= before) & (detours >= after)
    is_largest[[1, -2]] = False
    return np.where(is_largest, detours, 0.0)


@dataclass(frozen=True)
class FrameCheck:
    """What a set says of the poses of a log that is to be added to it.

    Args:
        agree: Scans that the set bears out at their poses.
        contradict: Scans that fit elsewhere, or do not fit where their poses say.
    """

    agree: int
    contradict: int

    def __str__(self) -> str:
        """As the middle of a message."""
        return (
            f"its scans do not fit the set where its poses say ({self.contradict} of "
            f"{self.agree + self.contradict} in places that the set knows)"
        )

    @property
    def is_another(self) -> bool:
        """Whether the poses are in another frame than the set, beyond reasonable doubt."""
        judged = self.agree + self.contradict
        return self.contradict >= _FEWEST and self.contradict >= _WRONG_SHARE * judged


def frame_check(places: ReferenceSet, records: Iterable[Record]) -> FrameCheck:
    """Judge some scans of the beginning of a log as references of a set are judged.

    Those in places that the set does not know say nothing, and so does a set that is not searched
    as one map.

    Args:
        places: The set.
        records: The log, from its beginning.
    """
    if not places.has_poses or places.settings.method != "map":
        return FrameCheck(0, 0)
    some = [
        Reference(record.index, record.scan, record.pose)
        for record in islice(records, _LOOKED_AT)
        if record.scan is not None and record.pose is not None and record.pose.is_finite()
    ]
    asked = some[:: max(1, len(some) // _ASKED)]
    found = Counter(_judge(each, 0.0, places).verdict for each in asked)
    return FrameCheck(found["sound"], found["misplaced"] + found["contradicted"])


def run(places: ReferenceSet, say: Callable[[str], None], progress: ProgressOf) -> int:
    """Name the references whose poses are wrong, the worst first.

    Returns:
        How many.
    """
    found = list(check(places, progress))
    bad = [each for each in found if each.is_wrong]
    for each in sorted(bad, key=lambda each: (each.verdict != "misplaced", each.near)):
        say(str(each))
    alone = sum(each.verdict == "alone" for each in found)
    say(
        f"{len(found)} references: {len(found) - len(bad) - alone} agree with the others, "
        f"{len(bad)} do not, {alone} cannot be judged because no other has seen their place"
    )
    return len(bad)


def _judge(reference: Reference, detour: float, others: Matcher | ReferenceSet) -> ReferenceCheck:
    pose = reference.pose
    assert pose is not None
    if not reference.scan.is_return.any():
        return ReferenceCheck(reference, "alone", math.nan, 0.0, detour)
    here = others.follow(reference.scan, pose.to_array()[None], np.zeros((1, 3, 3)))
    near, unknown = here.features[0, [_NEAR, _UNKNOWN]].tolist()
    seen = 1.0 - unknown
    trace = others.explain(reference.scan)
    best = trace.hypotheses[0] if trace.hypotheses else None
    if best is not None and best.accepted and best.pose is not None and trace.in_map is not None:
        near_there = float(trace.in_map.fits.features[0, _NEAR])
        is_away = best.pose.distance(pose) > _AWAY or best.pose.turn(pose) > _TURNED
        if is_away and near_there - near > _CLEARLY_BETTER:
            found = (near, seen, detour, best.pose, near_there)
            return ReferenceCheck(reference, "misplaced", *found)
    return ReferenceCheck(reference, _verdict_here(near, seen, detour), near, seen, detour)


def _verdict_here(near: float, seen: float, detour: float) -> Verdict:
    """Judge a reference that fits nowhere else."""
    if seen >= _FEWEST_SEEN and near < _TOO_FEW_NEAR * seen:
        return "contradicted"
    if detour > _DETOUR and near < _BORNE_OUT:
        return "astray"
    return "alone" if 1.0 - seen >= _UNSEEN else "sound"


def _place(pose: Pose2D) -> str:
    return f"x {pose.x:.2f} m, y {pose.y:.2f} m, {math.degrees(pose.theta):.0f} degrees"
