"""The tree of frames that ``/tf`` and ``/tf_static`` tell about (REP-105).

Two looks: the first keeps, for every frame, its parent and whether it ever moves against it,
which is all that the laser's place on the robot needs; the second gathers the samples of the
few frames that move between the robot and the map, when somebody asks for those.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .spatial import inverse, matrix_of
from .trajectory import Trajectory

__all__ = ["Chain", "FrameTree", "frame_name"]

# A mounting that is published over and over again may differ in its last digits.
_STILL = 1e-4

Link = tuple["NDArray[np.float64] | Trajectory", bool]
"""A motion, fixed or over time, and whether it is to be inverted."""


def frame_name(name: str) -> str:
    """Return a frame's name without the leading slash that ROS 1 allowed."""
    return name.strip().lstrip("/")


@dataclass(frozen=True)
class Chain:
    """Motions one after the other: ``T_first_last`` at any time."""

    links: tuple[Link, ...]

    def at(self, stamp: float | None) -> NDArray[np.float64] | None:
        """Return the (4, 4) motion at a time in seconds, None where a link does not tell."""
        motion = np.eye(4)
        for link, is_inverted in self.links:
            step = link.at(stamp) if isinstance(link, Trajectory) else link
            if step is None:
                return None
            motion = motion @ (inverse(step) if is_inverted else step)
        return motion


@dataclass
class _Edge:
    parent: str
    sample: NDArray[np.float64]
    is_static: bool
    moves: bool = False
    trajectory: Trajectory | None = None


class FrameTree:
    """What is known of the frames of a recording."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}

    def __contains__(self, frame: str) -> bool:
        return frame in self._edges or any(edge.parent == frame for edge in self._edges.values())

    def add(self, parent: str, child: str, sample: tuple[float, ...], *, is_static: bool) -> None:
        """Take note of one transform, ``T_parent_child`` as ``x y z qx qy qz qw``."""
        parent, child = frame_name(parent), frame_name(child)
        values = np.array(sample)
        if not parent or not child or parent == child or matrix_of(values) is None:
            return
        edge = self._edges.get(child)
        # Of two static ones the later holds, as in tf2; of a static and another the static.
        if edge is None or is_static:
            self._edges[child] = _Edge(parent, values, is_static)
        elif not edge.is_static and edge.parent == parent and not edge.moves:
            edge.moves = bool(np.abs(edge.sample - values).max() > _STILL)

    def fixed(self, target: str, source: str) -> NDArray[np.float64] | None:
        """Return the (4, 4) ``T_target_source`` of two frames that never move, else None."""
        path = self._path(target, source)
        if path is None or any(self._edges[child].moves for child, _ in path):
            return None
        return self.chain(target, source).at(None)

    def moving(self, target: str, source: str) -> set[str] | None:
        """Return the frames whose samples a chain needs; None where there is no chain."""
        path = self._path(target, source)
        if path is None:
            return None
        return {child for child, _ in path if self._edges[child].moves}

    def gather(self, frames: Iterable[str]) -> None:
        """Prepare for the second look, at these frames."""
        for frame in frames:
            self._edges[frame].trajectory = Trajectory()

    def sample(self, parent: str, child: str, stamp: float, sample: tuple[float, ...]) -> None:
        """Keep one sample in the second look."""
        edge = self._edges.get(frame_name(child))
        if edge and edge.trajectory is not None and edge.parent == frame_name(parent):
            edge.trajectory.add(stamp, sample)

    def chain(self, target: str, source: str) -> Chain:
        """Return ``T_target_source`` over time, of frames that `moving` found connected."""
        links: list[Link] = []
        for child, is_inverted in self._path(target, source) or ():
            edge = self._edges[child]
            fixed = matrix_of(edge.sample)
            link = edge.trajectory if edge.trajectory is not None else fixed
            if link is not None:
                links.append((link, is_inverted))
        return Chain(tuple(links))

    def _ancestors(self, frame: str) -> list[str]:
        found = [frame]
        while (edge := self._edges.get(found[-1])) and edge.parent not in found:
            found.append(edge.parent)
        return found

    def _path(self, target: str, source: str) -> list[tuple[str, bool]] | None:
        """Return the edges, by their child, from target to source."""
        down, up = self._ancestors(source), self._ancestors(target)
        meeting = next((frame for frame in up if frame in down), None)
        if meeting is None:
            return None
        ascent = [(frame, True) for frame in up[: up.index(meeting)]]
        descent = [(frame, False) for frame in reversed(down[: down.index(meeting)])]
        return ascent + descent
