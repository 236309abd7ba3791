"""What CARMEN logs and g2o files share: scan lines in, records out."""

from __future__ import annotations

from abc import abstractmethod
from collections import defaultdict
from collections.abc import Iterator

from ..errors import LogError, ScanError
from ..record import Record
from ..scan import LaserScan
from .geometry import geometry_note
from .log import Log, Report
from .scan_line import BadLine, ScanLine
from .survey import Survey
from .text import TextFile

__all__ = ["LineLog"]


class LineLog(Log):
    """A log of text lines, looked through once when it is opened.

    Args:
        text: The log.
        range_max: From this range on a reading is no return, metres, instead of the log's.
        has_corrected_poses: Whether the pose column is corrected; else it is the odometry.

    Raises:
        LogError: The log has no scan that can be read.
    """

    def __init__(
        self, text: TextFile, *, range_max: float | None, has_corrected_poses: bool = True
    ) -> None:
        super().__init__(text.path)
        self._text = text
        self._range_max = range_max
        self._has_corrected_poses = has_corrected_poses
        self._is_guessed = False
        self._surveys: dict[bytes, tuple[int, Survey]] = {}
        self.count, first = self._look_through()
        self.notes = tuple(self._say(first))

    @abstractmethod
    def _scan_lines(self, report: Report) -> Iterator[ScanLine | BadLine]:
        """Yield the scan lines in order; report malformed lines of other kinds."""

    def _look_through(self) -> tuple[int, LaserScan]:
        # A log writes all lines of a kind alike; the few that are shorter were cut off.
        surveys: dict[bytes, dict[int, Survey]] = defaultdict(lambda: defaultdict(Survey))
        first_problem: tuple[int, str] | None = None
        count = 0
        first: LaserScan | None = None

        def complain(number: int, reason: str) -> None:
            nonlocal first_problem
            first_problem = first_problem or (number, reason)

        for line in self._scan_lines(complain):
            count += 1
            if isinstance(line, BadLine):
                complain(line.number, line.reason)
                continue
            surveys[line.kind][line.tail_length].add(line)
            if first is None:
                self._is_guessed = line.geometry.is_guessed
                first, reason = self._scan(line)
                complain(line.number, reason)
        if first is None:
            if first_problem is None:
                raise LogError(f"holds no laser scan that a {self.format} reader knows", self.path)
            number, reason = first_problem
            raise LogError(f"no readable laser scan: {reason}", self.path, number)
        for kind, by_length in surveys.items():
            length = max(by_length, key=lambda length: by_length[length].count)
            self._surveys[kind] = (length, by_length[length])
        return count, first

    def _say(self, scan: LaserScan) -> Iterator[str]:
        yield geometry_note(scan, is_guessed=self._is_guessed)
        for kind, (_, survey) in sorted(self._surveys.items()):
            name = kind.decode()
            poses = "poses" if self._has_corrected_poses else "odometry"
            held = [poses] if survey.has_poses else []
            held += ["odometry"] if survey.has_odometry and self._has_corrected_poses else []
            held += ["times"] if survey.has_stamps else []
            yield f"{survey.count} {name} lines with {', '.join(held) or 'scans alone'}"
            if survey.has_poses and survey.is_one_trajectory and self._has_corrected_poses:
                yield f"both pose columns of {name} are one trajectory, taken to be corrected"

    def _read(self, report: Report) -> Iterator[Record]:
        for index, line in enumerate(self._scan_lines(report)):
            if isinstance(line, ScanLine):
                yield self._record(index, line, report)
            else:
                report(line.number, line.reason)
                yield self._unusable(index, line)

    def _unusable(self, index: int, line: BadLine) -> Record:
        return Record(index, None, source=f"{self.path}:{line.number}", problem=line.reason)

    def _record(self, index: int, line: ScanLine, report: Report) -> Record:
        tail_length, survey = self._surveys[line.kind]
        if line.tail_length != tail_length:
            reason = f"has {line.tail_length} words behind the readings, not {tail_length}"
            report(line.number, reason)
            return self._unusable(index, BadLine(line.number, reason))
        scan, problem = self._scan(line)
        if scan is None:
            report(line.number, problem)
        pose = line.laser if survey.has_poses else None
        if survey.has_poses and pose is None:
            report(line.number, "the scan has no pose, or it is not finite")
        mounting = line.mounting or survey.relative
        odometry = None
        if not self._has_corrected_poses:
            pose, odometry = None, pose
        elif survey.has_odometry and line.robot is not None:
            odometry = line.robot if mounting is None else line.robot @ mounting
        return Record(
            index,
            scan,
            pose,
            odometry,
            line.stamp if survey.has_stamps else None,
            f"{self.path}:{line.number}",
            problem,
            mounting,
        )

    def _scan(self, line: ScanLine) -> tuple[LaserScan | None, str]:
        try:
            return line.scan(self._range_max), ""
        except (ValueError, ScanError) as error:
            return None, str(error)
