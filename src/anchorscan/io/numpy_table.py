"""NumPy files: ``.npy`` with (N, K) ranges, or ``.npz`` with more.

Arrays of an ``.npz`` archive, all metres, radians and seconds:

* ``ranges`` (N, K): the scans, a row each; the only one that must be there;
* ``poses`` (N, 3): ``T_map_laser`` as x, y, theta; NaN where unknown;
* ``odometry`` (N, 3): ``T_odom_laser`` as x, y, theta; NaN where unknown;
* ``stamps`` (N,);
* ``angle_min``, ``angle_max``, ``angle_increment``, ``range_min``, ``range_max``: one number,
  or (N,); two of the three angles are enough, and one alone is refused;
* ``T_base_laser`` (3,): where the laser sits on the robot.

Ranges are read a row at a time, and nothing is set aside because a header promises it.
Without angles the geometry follows from the number of readings, as for a CARMEN log.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError, ScanError
from ..pose import Pose2D
from ..record import Record
from ..scan import LaserScan
from .archive import BROKEN, ZIP_MAGIC, member_names, open_member
from .bounded_file import BoundedPath
from .geometry import RANGE_MAX, Angles, geometry_note, make_scan
from .log import Log, Report

__all__ = ["NumpyLog", "is_numpy"]

_MAGIC = b"\x93NUMPY"
_POSE_LENGTH = 3
_DIMENSIONS = 2
_CHUNK = 1 << 20
_MOST_READINGS = 1 << 20
_SIDE_ARRAYS = (
    "poses",
    "odometry",
    "stamps",
    "angle_min",
    "angle_max",
    "angle_increment",
    "range_min",
    "range_max",
    "T_base_laser",
)


def is_numpy(path: Path, magic: bytes) -> bool:
    """Tell whether a file is ``.npy``, or a zip archive of such files."""
    if magic.startswith(_MAGIC):
        return True
    if not magic.startswith(ZIP_MAGIC):
        return False
    names = member_names(path)
    return bool(names) and all(name.endswith(".npy") for name in names)


@dataclass(frozen=True)
class _Header:
    shape: tuple[int, ...]
    is_fortran: bool
    dtype: np.dtype[Any]


class NumpyLog(Log):
    """A NumPy file.

    Args:
        path: The file.
        field_of_view: Angle that the readings cover, radians, instead of the file's angles.
        range_max: From this range on a reading is no return, metres, instead of the file's.

    Raises:
        LogError: The file is damaged, or has no scan that can be read.
    """

    format = "NumPy"

    def __init__(
        self, path: Path, *, field_of_view: float | None = None, range_max: float | None = None
    ) -> None:
        super().__init__(path)
        self._field_of_view = field_of_view
        self._range_max = range_max
        self._is_archive = not _begins(path)
        with self._stream("ranges") as stream:
            header = self._header(stream, "ranges")
        rows = header.shape[0] if len(header.shape) > 1 else 1
        if not 1 <= len(header.shape) <= _DIMENSIONS or min(header.shape) < 1:
            raise LogError(f"ranges must be (scans, readings), not {header.shape}", path)
        if header.shape[-1] > _MOST_READINGS:
            raise LogError(f"ranges promise {header.shape[-1]} readings a scan", path)
        self.count = rows
        self._sides = self._read_sides(rows) if self._is_archive else {}
        self._is_guessed = False  # of the latest scan
        first = next((record.scan for record in self if record.scan is not None), None)
        if first is None:
            problem = self.problems[0].reason if self.problems else "it has no rows"
            raise LogError(f"no readable laser scan: {problem}", path)
        self.notes = (geometry_note(first, is_guessed=self._is_guessed),)

    def _read(self, report: Report) -> Iterator[Record]:
        mounting = self._pose("T_base_laser", None)
        for index, row in enumerate(self._rows(report)):
            scan, problem = self._scan(index, row)
            if scan is None:
                report(index + 1, problem)
            stamp = self._number("stamps", index)
            yield Record(
                index,
                scan,
                self._pose("poses", index),
                self._pose("odometry", index),
                stamp if stamp is not None and math.isfinite(stamp) else None,
                f"{self.path}: row {index}",
                problem,
                mounting,
            )

    def _scan(self, index: int, row: NDArray[np.float64]) -> tuple[LaserScan | None, str]:
        try:
            limit = self._number("range_max", index)
            limit = RANGE_MAX if limit is None else limit
            angles = Angles(
                self._number("angle_min", index),
                self._number("angle_max", index),
                self._number("angle_increment", index),
            )
            geometry = angles.geometry(
                len(row),
                field_of_view=self._field_of_view,
                range_min=self._number("range_min", index) or 0.0,
                range_max=limit,
            )
            self._is_guessed = geometry.is_guessed
            return make_scan(row, geometry, range_max=self._range_max), ""
        except (ValueError, ScanError) as error:
            return None, str(error)

    def _number(self, name: str, index: int) -> float | None:
        values = self._sides.get(name)
        if values is None:
            return None
        return float(values) if values.ndim == 0 else float(values[index])

    def _pose(self, name: str, index: int | None) -> Pose2D | None:
        values = self._sides.get(name)
        if values is None:
            return None
        pose = Pose2D.from_array(values if index is None else values[index])
        return pose if pose.is_finite() else None

    def _read_sides(self, rows: int) -> dict[str, NDArray[np.float64]]:
        allowed: dict[str, tuple[tuple[int, ...], ...]] = {
            name: ((), (rows,)) for name in _SIDE_ARRAYS
        }
        allowed |= dict.fromkeys(("poses", "odometry"), ((rows, _POSE_LENGTH),))
        allowed |= {"stamps": ((rows,),), "T_base_laser": ((_POSE_LENGTH,),)}
        sides = {}
        for name in self._members() & set(_SIDE_ARRAYS):
            with self._stream(name) as stream:
                header = self._header(stream, name)
                if header.shape not in allowed[name]:
                    shapes = " or ".join(str(shape) for shape in allowed[name])
                    raise LogError(f"{name} must be {shapes}, not {header.shape}", self.path)
                data = _read_all(stream, math.prod(header.shape) * header.dtype.itemsize)
            try:
                flat = np.frombuffer(data, header.dtype).astype(np.float64)
                order = "F" if header.is_fortran else "C"
                sides[name] = flat.reshape(header.shape, order=order)  # type: ignore[call-overload]
            except ValueError:
                raise LogError(f"{name} is cut off", self.path) from None
        return sides

    def _rows(self, report: Report) -> Iterator[NDArray[np.float64]]:
        with self._stream("ranges") as stream:
            header = self._header(stream, "ranges")
            readings = header.shape[-1]
            rows = header.shape[0] if len(header.shape) > 1 else 1
            if header.is_fortran and rows > 1:
                yield from self._columns_first(stream, header)
                return
            size = readings * header.dtype.itemsize
            for index in range(rows):
                try:
                    data = _read_all(stream, size)
                except BROKEN as error:
                    report(index + 1, f"the file is damaged from here on: {error}")
                    return
                if len(data) < size:
                    report(index + 1, f"the file ends here instead of after {rows} scans")
                    return
                yield np.frombuffer(data, header.dtype).astype(np.float64)

    def _columns_first(self, stream: IO[bytes], header: _Header) -> Iterator[NDArray[np.float64]]:
        """Yield the rows of an array stored column by column, which needs all of it at once."""
        data = _read_all(stream, math.prod(header.shape) * header.dtype.itemsize)
        try:
            flat = np.frombuffer(data, header.dtype)
            table = flat.reshape(header.shape, order="F")
        except ValueError:
            raise LogError("ranges are cut off", self.path) from None
        for row in table:
            yield row.astype(np.float64)

    def _members(self) -> set[str]:
        return {name.removesuffix(".npy") for name in member_names(self.path)}

    @contextmanager
    def _stream(self, name: str) -> Iterator[IO[bytes]]:
        try:
            if not self._is_archive:
                with BoundedPath(self.path).open("rb") as stream:
                    yield stream
                return
            held = member_names(self.path)
            if f"{name}.npy" not in held:
                listed = ", ".join(sorted(held)[:8]) or "nothing"
                raise LogError(f"no array named {name!r}; it holds {listed}", self.path)
            with open_member(self.path, f"{name}.npy") as member:
                yield member
        except BROKEN as error:
            raise LogError(f"cannot be read: {error}", self.path) from None

    def _header(self, stream: IO[bytes], name: str) -> _Header:
        try:
            version = np.lib.format.read_magic(stream)
            read = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }[version]
            shape, is_fortran, dtype = read(stream)
        except BROKEN as error:
            raise LogError(f"{name} is no NumPy array: {_first_line(error)}", self.path) from None
        except Exception:  # NumPy parses the header as Python, which raises anything
            raise LogError(f"{name} has no NumPy header that can be read", self.path) from None
        if dtype.kind not in "fiu":
            raise LogError(f"{name} must hold numbers, not {dtype}", self.path)
        return _Header(shape, is_fortran, dtype)


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


def _begins(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(len(_MAGIC)) == _MAGIC


def _read_all(stream: IO[bytes], size: int) -> bytes:
    """Read at most ``size`` bytes, piece by piece: the file may hold fewer than it promises."""
    data = bytearray()
    while len(data) < size and (piece := stream.read(min(_CHUNK, size - len(data)))):
        data += piece
    return bytes(data)
