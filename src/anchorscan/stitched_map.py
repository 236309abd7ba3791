"""Beyond the paper: all references of a set as one map, searched by relations.

Joins the parts that need poses in a common frame: the landmarks and their relations, which
propose; the likelihood field, which sieves and refines; and the pose of every reference, so
that an answer can name the reference scan that it stands for.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from ._jit import kernel
from .anchors import AnchorPoints
from .angle_function import wrapped
from .field import FieldSettings, LikelihoodField
from .pose import Pose2D
from .proposal import Landmarks, Proposals, ProposalSettings, joined, landmarks, proposals
from .scan import LaserScan
from .verification import Fits, VerificationSettings, verify

__all__ = ["MapSettings", "Placed", "Search", "StitchedMap"]


class MapSettings(BaseModel):
    """Settings of the search in the map stitched from all references."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    proposal: ProposalSettings = ProposalSettings()
    field: FieldSettings = FieldSettings()
    verification: VerificationSettings = VerificationSettings()


@dataclass(frozen=True, eq=False)
class Placed:
    """A reference in the map.

    Args:
        identifier: Of the reference.
        scan: Its laser scan.
        pose: ``T_set_laser``.
        anchors: Its anchor points, scan frame.
        relations: Its own landmarks: a block for a search among few references.
    """

    identifier: int
    scan: LaserScan
    pose: Pose2D
    anchors: AnchorPoints
    relations: Landmarks


@dataclass(frozen=True, eq=False)
class Search:
    """What a search came through.

    Args:
        proposals: Alignments that passed the first check.
        fits: What is left after all sieves, best score first.
    """

    proposals: Proposals
    fits: Fits


class StitchedMap:
    """References in a common frame, as one map; one writer, many readers.

    Args:
        settings: Of the search.
        references: Identifier, scan, pose ``T_set_laser`` and anchor points of each.
    """

    def __init__(
        self,
        settings: MapSettings,
        references: Iterable[tuple[int, LaserScan, Pose2D, AnchorPoints]] = (),
    ) -> None:
        self._settings = settings
        self._weights = settings.field.weights()
        self._placed = {entry[0]: self._place(*entry) for entry in references}
        self._field = LikelihoodField(
            settings.field, ((each.scan, each.pose) for each in self._placed.values())
        )
        self._changed()

    def __len__(self) -> int:
        return len(self._placed)

    def add(self, identifier: int, scan: LaserScan, pose: Pose2D, anchors: AnchorPoints) -> None:
        """Add a reference."""
        placed = self._place(identifier, scan, pose, anchors)
        self._field.add(scan, pose)
        self._placed = {**self._placed, identifier: placed}
        self._changed()

    def remove(self, identifier: int) -> None:
        """Remove a reference.

        Raises:
            KeyError: There is no such reference.
        """
        placed = self._placed[identifier]
        self._field.remove(placed.scan, placed.pose)
        self._placed = {key: value for key, value in self._placed.items() if key != identifier}
        self._changed()

    def search(
        self,
        anchors: AnchorPoints,
        points: NDArray[np.float64],
        among: Sequence[int] | None = None,
    ) -> Search:
        """Find poses from which a scan may have been taken.

        Args:
            anchors: Of the scan.
            points: (N, 2) end points of its returns, metres, scan frame.
            among: References whose relations may propose; None for all.
        """
        settings = self._settings
        tiles = self._field.tiles
        known = self._all() if among is None else self._some(among)
        proposed = proposals(anchors, points, known, tiles, settings.proposal)
        if not len(proposed.poses):
            proposed = self._standing(among)
        fits = verify(proposed.poses, points, tiles, self._weights, settings.verification)
        return Search(proposed, fits)

    def nearest(self, poses: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the reference taken nearest to each of (N, 3) poses.

        A radian of turn counts as a metre; of equals the one with the lowest identifier.
        """
        return self._identifiers[_nearest(self._poses, poses)]

    def _changed(self) -> None:
        placed = sorted(self._placed.values(), key=lambda each: each.identifier)
        self._identifiers = np.array([each.identifier for each in placed], np.int64)
        self._poses = np.array(
            [(each.pose.x, each.pose.y, each.pose.theta) for each in placed]
        ).reshape(-1, 3)
        self._landmarks: Landmarks | None = None

    def _place(
        self, identifier: int, scan: LaserScan, pose: Pose2D, anchors: AnchorPoints
    ) -> Placed:
        relations = landmarks([(anchors, pose)], self._settings.proposal)
        return Placed(identifier, scan, pose, anchors, relations)

    def _all(self) -> Landmarks:
        if self._landmarks is None:
            placed = sorted(self._placed.values(), key=lambda each: each.identifier)
            self._landmarks = landmarks(
                [(each.anchors, each.pose) for each in placed], self._settings.proposal
            )
        return self._landmarks

    def _some(self, among: Sequence[int]) -> Landmarks:
        return joined([self._placed[identifier].relations for identifier in among])

    def _standing(self, among: Sequence[int] | None) -> Proposals:
        """Return the poses of the references: a scan without anchors may stand at any."""
        identifiers = self._placed if among is None else among
        poses = np.array(
            [
                (pose.x, pose.y, pose.theta + turn)
                for pose in (self._placed[identifier].pose for identifier in identifiers)
                for turn in (0.0, math.pi)
            ]
        ).reshape(-1, 3)
        return Proposals(poses, np.zeros(len(poses)), len(poses))


@kernel
def _nearest(references, poses):  # type: ignore[no-untyped-def]
    """Index of the reference pose nearest to each pose."""
    nearest = np.zeros(len(poses), np.int64)
    for p in range(len(poses)):
        best = np.inf
        for r in range(len(references)):
            distance = math.hypot(
                references[r, 0] - poses[p, 0], references[r, 1] - poses[p, 1]
            ) + abs(wrapped(references[r, 2] - poses[p, 2]))
            if distance < best:
                best = distance
                nearest[p] = r
    return nearest
