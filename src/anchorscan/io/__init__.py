"""Recordings: every format comes in as one iterator of records, and poses go out as TUM.

>>> for record in open_log("intel.log.gz"):    # doctest: +SKIP
...     record.scan, record.pose, record.odometry, record.stamp
"""

from __future__ import annotations

import math
from pathlib import Path

from ..errors import LogError
from . import carmen, g2o
from .carmen import CarmenLog, PoseColumns
from .g2o import G2oLog
from .log import Log, Problem
from .text import TextFile, find_text
from .tum import write_tum

__all__ = ["Log", "Problem", "open_log", "write_tum"]

_HEAD = 1 << 20
_FIELD_OF_VIEW_LIMIT = 2.0 * math.pi + 1e-4


def open_log(
    path: str | Path,
    *,
    field_of_view: float | None = None,
    range_max: float | None = None,
    pose_columns: PoseColumns = "corrected",
) -> Log:
    """Open a recording of laser scans; its format is told from the path and the content.

    Args:
        path: A CARMEN log or a g2o file, plain, gzipped or in a zip archive.
        field_of_view: Angle that the readings cover, radians, instead of what the recording
            says or suggests.
        range_max: The sensor's limit, metres, instead of the recording's: from this range on
            a reading means "no return".
        pose_columns: For CARMEN logs: whether ``x y theta`` is the corrected pose of the laser
            or, in a raw log, its pose by odometry.

    Returns:
        The log, to be iterated over as often as wanted.

    Raises:
        LogError: The path cannot be read, is no recording, or holds no readable scan; or an
            argument is impossible.
    """
    path = Path(path)
    if field_of_view is not None and not 0.0 < field_of_view <= _FIELD_OF_VIEW_LIMIT:
        raise LogError(f"field_of_view must lie in (0, 2 pi] radians, not {field_of_view:g}")
    if range_max is not None and not 0.0 < range_max < math.inf:
        raise LogError(f"range_max must be a positive length in metres, not {range_max:g}")
    text = find_text(path, _magic(path))
    first_word = _first_known_word(text)
    if first_word in g2o.KINDS:
        return G2oLog(text, field_of_view=field_of_view, range_max=range_max)
    return CarmenLog(
        text, field_of_view=field_of_view, range_max=range_max, pose_columns=pose_columns
    )


def _magic(path: Path) -> bytes:
    """Return the first bytes of a file that has some."""
    try:
        if path.is_dir():
            raise LogError("is a folder, not a log", path)
        with path.open("rb") as stream:
            magic = stream.read(16)
    except FileNotFoundError:
        raise LogError("no such file", path) from None
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the path
        raise LogError(f"cannot be read: {error}", path) from None
    if not magic:
        raise LogError("the file is empty", path)
    return magic


def _first_known_word(text: TextFile) -> bytes:
    """Return the first word that begins a line of a known format.

    Raises:
        LogError: There is none in the first megabyte.
    """
    known = carmen.KINDS | g2o.KINDS
    head = text.head(_HEAD)
    if not head.strip():
        raise LogError("the file is empty", text.path)
    for line in head.splitlines():
        words = line.split(maxsplit=1)
        if words and words[0].removeprefix(b"\xef\xbb\xbf") in known:
            return words[0].removeprefix(b"\xef\xbb\xbf")
    raise LogError("not a recording of laser scans (neither CARMEN nor g2o)", text.path)
