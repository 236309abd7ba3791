"""A log whose poses come from somewhere else: a trajectory made later, by other software."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

from ..errors import LogError
from ..pose import Pose2D
from ..record import Record
from .log import Log, Report
from .spatial import planar
from .text import TextFile
from .tum import read_tum

__all__ = ["Body", "PosedLog"]

Body = Literal["base", "laser"]
"""Whose poses they are: of the robot's base or of the laser itself."""


class PosedLog(Log):
    """A log with the poses of a TUM file at the times of its scans, and no others.

    Args:
        log: The log; its scans must have times.
        text: The TUM file, on the same clock.
        body: Whose poses the file holds.
        T_base_laser: Where the laser sits on the robot, instead of what the log says.

    Raises:
        LogError: The file has no pose that can be read.
    """

    def __init__(
        self,
        log: Log,
        text: TextFile,
        body: Body,
        T_base_laser: Pose2D | None = None,
    ) -> None:
        super().__init__(log.path)
        self._T_base_laser = T_base_laser
        self._log = log
        self._text = text
        self._body = body
        self._trajectory, self._complaints = read_tum(text)
        self.format = log.format
        self.count = log.count
        self.notes = (*log.notes, f"poses of the {body} from {text.path}")

    def _read(self, report: Report) -> Iterator[Record]:
        for number, reason in self._complaints:
            report(number, f"in {self._text.name}: {reason}")
        count, first, last = 0, None, None
        for record in self._log.records(report):
            first, last = first if first is not None else record.stamp, record.stamp
            posed = self._posed(record)
            count += posed.pose is not None
            yield posed
        if not count:
            raise LogError(
                f"none of its poses (times {_times(self._trajectory.span)}) lies within "
                f"half a second of a scan (times {_times((first, last))})",
                self._text.path,
            )

    def _posed(self, record: Record) -> Record:
        if self._T_base_laser is not None:
            record = replace(record, T_base_laser=self._T_base_laser)
        motion = self._trajectory.at(record.stamp)
        if motion is None:
            return replace(record, pose=None)
        pose = planar(motion)
        if self._body == "base":
            if record.T_base_laser is None:
                raise LogError(
                    "where the laser sits on the robot is not known, so poses of the robot say "
                    "nothing of it; give it (T_base_laser, --laser), or say that they are the "
                    "laser's (poses_of, --poses-of)",
                    self._log.path,
                )
            pose = pose @ record.T_base_laser
        return replace(record, pose=pose)


def _times(span: tuple[float | None, float | None] | None) -> str:
    if span is None or None in span:
        return "not known"
    return f"{span[0]:.3f} to {span[1]:.3f}"
