"""Recordings: every format comes in as one iterator of records, and poses go out as TUM.

>>> for record in open_log("intel.log.gz"):    # doctest: +SKIP
...     record.scan, record.pose, record.odometry, record.stamp
"""

from __future__ import annotations

import math
import stat
from pathlib import Path

from ..errors import LogError
from ..pose import Pose2D
from . import carmen, g2o
from .carmen import CarmenLog, PoseColumns
from .csv_table import CsvLog, is_table
from .g2o import G2oLog
from .log import Log, Problem
from .numpy_table import NumpyLog, is_numpy
from .posed_log import Body, PosedLog
from .rosbag import BagLog, BagOptions, find_bag
from .text import TextFile, find_text
from .tum import write_tum
from .turned_log import TurnedLog

__all__ = ["Log", "Problem", "open_log", "write_tum"]

_HEAD = 1 << 20
_MAGIC_LENGTH = 72
_FIELD_OF_VIEW_LIMIT = 2.0 * math.pi + 1e-4


def open_log(
    path: str | Path,
    *,
    field_of_view: float | None = None,
    range_max: float | None = None,
    topic: str | None = None,
    poses: str | Path | None = None,
    poses_of: Body = "base",
    odometry_topic: str | None = None,
    T_base_laser: Pose2D | None = None,
    is_upside_down: bool | None = None,
    base_frame_id: str | None = None,
    global_frame_id: str = "map",
    odom_frame_id: str = "odom",
    pose_columns: PoseColumns = "corrected",
) -> Log:
    """Open a recording of laser scans; its format is told from the path and the content.

    Read are CARMEN logs and g2o files (plain, gzipped or in a zip archive), tables (CSV, NumPy),
    and ROS recordings (ROS 1 bags, rosbag2 folders, bare ``.db3`` and ``.mcap``).  What was
    guessed is told in `Log.notes`.

    Args:
        path: The recording.
        field_of_view: Angle that the readings cover, radians, instead of what the recording
            says or suggests.
        range_max: The sensor's limit, metres, instead of the recording's: from this range on
            a reading means "no return".
        topic: Topic of the scans, of a ROS recording; guessed when there is one.
        poses: Where the poses come from instead of the recording's own: a topic of it, "/tf",
            or a TUM file on the clock of the scans.
        poses_of: Whether ``poses`` are the robot's base's or the laser's, where the topic does
            not say; those of the base need ``T_base_laser``, from /tf or given.
        odometry_topic: Topic of odometry, or "/tf", of a ROS recording; guessed when there is
            one.
        T_base_laser: Where the laser sits on the robot, instead of what a ROS recording or a
            CARMEN log says; for ``poses`` of the base, of any log.  Without ``poses`` other logs
            have no use for it, which is an error.
        is_upside_down: Whether the laser hangs with its z axis down, instead of what a ROS
            recording says in /tf; all others hold scans as if it stood.
        base_frame_id: Name of the robot's base in /tf; else that of the odometry, or the usual
            ones.
        global_frame_id: Name of the map in /tf.
        odom_frame_id: Name of the frame of odometry in /tf.
        pose_columns: For CARMEN logs: whether ``x y theta`` is the corrected pose of the laser
            or, in a raw log, its pose by odometry.

    Returns:
        The log, to be iterated over as often as wanted.

    Raises:
        LogError: The path cannot be read, is no recording, or holds no readable scan; it leaves
            a choice open; or an argument is impossible.
        MissingExtraError: A ROS recording, and rosbags is not installed.
    """
    path = Path(path)
    _check(field_of_view, range_max)
    magic = _magic(path)
    try:
        found = find_bag(path, magic)
    except OSError as error:
        raise LogError(f"cannot be read: {error.strerror}", path) from None
    if found:
        tum = _tum_file(poses, path)
        options = BagOptions(
            topic=topic,
            poses=None if poses is None or tum else str(poses),
            poses_of=poses_of,
            odometry_topic=odometry_topic,
            T_base_laser=T_base_laser,
            is_upside_down=is_upside_down,
            base_frame_id=base_frame_id,
            global_frame_id=global_frame_id,
            odom_frame_id=odom_frame_id,
            field_of_view=field_of_view,
            range_max=range_max,
        )
        log: Log = BagLog(path, *found, options)
        return PosedLog(log, tum, poses_of) if tum else log
    if path.is_dir():
        raise LogError("is a folder without a recording in it", path)
    log = _open_file(path, magic, field_of_view, range_max, pose_columns, T_base_laser)
    log = TurnedLog(log) if is_upside_down else log
    if poses is None:
        if T_base_laser is not None and log.format != CarmenLog.format:
            raise LogError(
                f"the poses of a {log.format} file are the laser's, so where it sits on the robot "
                "(T_base_laser, --laser) would change nothing; leave it out, or give poses of the "
                "robot (poses, --poses)",
                path,
            )
        return log
    tum = _tum_file(poses, path)
    if tum is None:
        raise LogError("no such file of poses, and the log has no topics", poses)
    return PosedLog(log, tum, poses_of, T_base_laser)


def _open_file(
    path: Path,
    magic: bytes,
    field_of_view: float | None,
    range_max: float | None,
    pose_columns: PoseColumns,
    mounting: Pose2D | None,
) -> Log:
    if is_numpy(path, magic):
        return NumpyLog(path, field_of_view=field_of_view, range_max=range_max)
    text = find_text(path, magic)
    kind = _kind_of_text(text)
    if kind == G2oLog.format:
        return G2oLog(text, field_of_view=field_of_view, range_max=range_max)
    if kind == CsvLog.format:
        return CsvLog(text, field_of_view=field_of_view, range_max=range_max)
    return CarmenLog(
        text,
        field_of_view=field_of_view,
        range_max=range_max,
        pose_columns=pose_columns,
        T_base_laser=mounting,
    )


def _check(field_of_view: float | None, range_max: float | None) -> None:
    if field_of_view is not None and not 0.0 < field_of_view <= _FIELD_OF_VIEW_LIMIT:
        raise LogError(
            f"field_of_view must lie in (0, 2 pi] radians, --field-of-view in (0, 360] degrees, "
            f"not {field_of_view:g} radians"
        )
    if range_max is not None and not 0.0 < range_max < math.inf:
        raise LogError(
            f"range_max (--range-max) must be a positive length in metres, not {range_max:g}"
        )


def _magic(path: Path) -> bytes:
    """Return the first bytes of a file that has some, none of a folder."""
    try:
        if path.is_dir():
            return b""
        if not stat.S_ISREG(path.stat().st_mode):
            # It is read more than once, and a pipe would give every reader another part.
            raise LogError("is no file, but a pipe or a device: write it to a file first", path)
        with path.open("rb") as stream:
            magic = stream.read(_MAGIC_LENGTH)
    except FileNotFoundError:
        raise LogError("no such file", path) from None
    except OSError as error:
        raise LogError(f"cannot be read: {error.strerror}", path) from None
    except ValueError as error:  # a zero byte in the path
        raise LogError(f"cannot be read: {error}", path) from None
    if not magic:
        raise LogError("the file is empty", path)
    return magic


def _tum_file(poses: str | Path | None, log: Path) -> TextFile | None:
    """Return the file that ``poses`` names, or None where it names a topic or nothing."""
    if poses is None:
        return None
    try:
        if not Path(poses).exists() or Path(poses).is_dir():
            return None
    except OSError as error:
        raise LogError(f"cannot be read: {error.strerror}", poses) from None
    if Path(poses).absolute() == log.absolute():
        raise LogError("is the log itself, not a trajectory", poses)
    return find_text(Path(poses), _magic(Path(poses)))


def _kind_of_text(text: TextFile) -> str:
    """Return the format whose lines the text begins with.

    Raises:
        LogError: There is none in the first megabyte.
    """
    head = text.head(_HEAD)
    lines = [line for line in head.removeprefix(b"\xef\xbb\xbf").splitlines() if line.strip()]
    if not lines:
        raise LogError("the file is empty", text.path)
    for line in lines:
        word = line.split(maxsplit=1)[0]
        if word in carmen.KINDS:
            return CarmenLog.format
        if word in g2o.KINDS:
            return G2oLog.format
    first = next((line for line in lines if not line.startswith(b"#")), b"")
    if is_table(first):
        return CsvLog.format
    raise LogError(
        "not a recording of laser scans (no CARMEN log, g2o file, table, or ROS bag)", text.path
    )
