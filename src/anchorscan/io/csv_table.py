"""Tables of text: one scan a row, for those without ROS.

The first row may name the columns, in any order and in any case:

* readings: ``r0, r1, ..``, ``range0, ..``, ``ranges[0], ..``, ``field.ranges0, ..`` (the last
  is what ``rostopic echo -p`` writes);
* ``x, y, theta`` (or ``yaw``): the pose of the **laser** in the map;
* ``odom_x, odom_y, odom_theta``: the pose of the **laser** by odometry;
* ``stamp``, ``time`` or ``t``: seconds (nanoseconds where the number is that large);
* ``angle_min, angle_max, angle_increment, range_min, range_max``: as in a ROS ``LaserScan``;
  two of the three angles are enough, and one alone is refused.

Other columns are left out.  Without names every column is a reading.  Cells are separated by
commas, semicolons, tabs or spaces; an empty one is NaN, "no information".  Without angles the
geometry follows from the number of readings, as for a CARMEN log.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..errors import LogError, ScanError
from ..pose import Pose2D
from ..record import Record
from ..scan import LaserScan
from .geometry import RANGE_MAX, Angles, geometry_note, make_scan
from .log import Log, Report
from .text import TextFile, shown

__all__ = ["CsvLog", "is_table"]

_READING = re.compile(r"(?:r|ranges?)[_.\[]?(\d{1,6})\]?")
_NAMES = {
    "stamp": {"stamp", "time", "t", "timestamp", "%time", "__time", "header.stamp"},
    "x": {"x"},
    "y": {"y"},
    "theta": {"theta", "yaw"},
    "odom_x": {"odom_x"},
    "odom_y": {"odom_y"},
    "odom_theta": {"odom_theta", "odom_yaw"},
    "angle_min": {"angle_min"},
    "angle_max": {"angle_max"},
    "angle_increment": {"angle_increment"},
    "range_min": {"range_min"},
    "range_max": {"range_max"},
}
_NANOSECONDS = 1e14
_FEWEST_READINGS = 2


@dataclass(frozen=True)
class _Columns:
    """Which column holds what."""

    width: int
    readings: Sequence[int]
    named: dict[str, int] = field(default_factory=dict)
    first_missing: int | None = None

    def value(self, cells: Sequence[bytes], name: str) -> float | None:
        at = self.named.get(name)
        if at is None or not cells[at].strip():
            return None
        return _numbers([cells[at]])[0]

    def pose(self, cells: Sequence[bytes], prefix: str = "") -> Pose2D | None:
        values = [self.value(cells, prefix + name) for name in ("x", "y", "theta")]
        if None in values:
            return None
        pose = Pose2D(*(value for value in values if value is not None))
        return pose if pose.is_finite() else None


def is_table(line: bytes) -> bool:
    """Tell whether a line names columns of readings, or is a row of numbers."""
    cells = _cells(line, _delimiter(line))
    if _name_columns(cells).readings:
        return True
    return len(cells) >= _FEWEST_READINGS and not _first_word(cells)


class CsvLog(Log):
    """A table of text.

    Args:
        text: The table.
        field_of_view: Angle that the readings cover, radians, instead of the table's angles.
        range_max: From this range on a reading is no return, metres, instead of the table's.

    Raises:
        LogError: The table has no scan that can be read.
    """

    format = "CSV"

    def __init__(
        self,
        text: TextFile,
        *,
        field_of_view: float | None = None,
        range_max: float | None = None,
    ) -> None:
        super().__init__(text.path)
        self._text = text
        self._field_of_view = field_of_view
        self._range_max = range_max
        self._is_guessed = False  # of the latest scan
        first = next((record for record in self if record.scan is not None), None)
        if first is None:
            if self.problems:
                problem = self.problems[0]
                raise LogError(f"no readable laser scan: {problem.reason}", self.path, problem.line)
            raise LogError("a table without rows", self.path)
        assert first.scan is not None
        self.notes = (geometry_note(first.scan, is_guessed=self._is_guessed),)

    def _read(self, report: Report) -> Iterator[Record]:
        columns: _Columns | None = None
        delimiter: bytes | None = None
        index = 0
        for number, line in self._text.lines(report):
            if line.startswith(b"#"):
                continue
            if columns is None:
                delimiter = _delimiter(line)
                columns = _name_columns(_cells(line, delimiter))
                if columns.first_missing is not None:
                    raise LogError(
                        f"has no column of reading {columns.first_missing}: number the readings "
                        "without gaps, and leave cells empty",
                        self.path,
                        number,
                    )
                if columns.readings:
                    continue
                columns = _Columns(columns.width, range(columns.width))
            cells = _cells(line, delimiter)
            yield self._record(index, number, cells, columns, report)
            index += 1

    def _record(
        self, index: int, number: int, cells: list[bytes], columns: _Columns, report: Report
    ) -> Record:
        source = f"{self.path}:{number}"
        try:
            if len(cells) != columns.width:
                raise ValueError(f"the row has {len(cells)} cells instead of {columns.width}")
            stamp = columns.value(cells, "stamp")
            if stamp is not None and abs(stamp) > _NANOSECONDS:
                stamp *= 1e-9
            return Record(
                index,
                self._scan(cells, columns),
                columns.pose(cells),
                columns.pose(cells, "odom_"),
                stamp if stamp is None or math.isfinite(stamp) else None,
                source,
            )
        except (ValueError, ScanError) as error:
            report(number, str(error))
            return Record(index, None, source=source, problem=str(error))

    def _scan(self, cells: list[bytes], columns: _Columns) -> LaserScan:
        ranges = np.array(_numbers([cells[at] for at in columns.readings]))
        limit = columns.value(cells, "range_max")
        limit = limit if limit is not None and limit > 0.0 else RANGE_MAX
        angles = Angles(
            columns.value(cells, "angle_min"),
            columns.value(cells, "angle_max"),
            columns.value(cells, "angle_increment"),
        )
        geometry = angles.geometry(
            len(ranges),
            field_of_view=self._field_of_view,
            range_min=columns.value(cells, "range_min") or 0.0,
            range_max=limit,
        )
        self._is_guessed = geometry.is_guessed
        return make_scan(ranges, geometry, range_max=self._range_max)


def _delimiter(line: bytes) -> bytes | None:
    return next((one for one in (b",", b";", b"\t") if one in line), None)


def _cells(line: bytes, delimiter: bytes | None) -> list[bytes]:
    return [cell.strip(b' "') for cell in line.split(delimiter)]


def _name_columns(cells: Sequence[bytes]) -> _Columns:
    readings: dict[int, int] = {}
    named: dict[str, int] = {}
    for at, cell in enumerate(cells):
        name = cell.decode("utf-8", "replace").lower().rpartition("/")[2].removeprefix("field.")
        if match := _READING.fullmatch(name):
            readings.setdefault(int(match[1]), at)
            continue
        for meaning, names in _NAMES.items():
            if name in names and meaning not in named:
                named[meaning] = at
    if len(readings) < _FEWEST_READINGS:
        return _Columns(len(cells), (), named)
    numbers = sorted(readings)
    order = [readings[number] for number in numbers]
    missing = (number for number in range(numbers[0], numbers[-1]) if number not in readings)
    return _Columns(len(cells), order, named, next(missing, None))


def _numbers(words: Sequence[bytes]) -> list[float]:
    """Read cells as numbers, empty ones as NaN.

    Raises:
        ValueError: One is no number; the message names it.
    """
    try:
        return [float(word.strip() or b"nan") for word in words]
    except ValueError:
        raise ValueError(f"not a number: {shown(_first_word(words))}") from None


def _first_word(cells: Sequence[bytes]) -> bytes:
    """Return the first cell that is not a number, nothing where all are."""
    for cell in cells:
        try:
            float(cell.strip() or b"nan")
        except ValueError:
            return cell
    return b""
