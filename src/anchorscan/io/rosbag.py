"""ROS recordings: ROS 1 bags, rosbag2 folders (sqlite3, MCAP), and bare ``.db3`` and ``.mcap``.

Reading them is left to ``rosbags`` (extra ``bags``); no ROS is needed.

**Scans** come from the one ``LaserScan`` or ``MultiEchoLaserScan`` topic (of every bundle of
echoes the first, as laser_proc takes it); where there are several, the caller chooses.  The
stamp is that of the header, the first ray; where that is zero, the time of recording.

**Two bodies, never confused.**  ROS speaks of the robot's base (``base_link``); a `Record`
speaks of the laser.  What lies between, ``T_base_laser``, is read from ``/tf_static`` and from
the frames of ``/tf`` that never move against each other.  Where it cannot be known, poses of
the base are not passed off as the laser's: odometry is left out, and asking for poses is an
error that says what to give.  Motions are composed in space and only then seen from above.
A laser that hangs upside down has its scan turned over: angles change sign, because the frame
of a `Record` always has z up.  One that is tilted is an error.

**Odometry** comes from the one ``Odometry`` topic, else from ``odom`` in ``/tf``.  **Poses**
come from the topic that the caller names, else from ``map`` in ``/tf``; a topic of goals or of
clicked guesses looks like one of poses, so none is taken by guess.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import LogError, ScanError
from ..pose import Pose2D
from ..record import Record
from ..scan import LaserScan
from .frames import Chain, FrameTree, frame_name
from .log import Log, Report
from .posed_log import Body
from .recording import ODOMETRY_TYPE, POSE_TYPES, SCAN_TYPES, Recording, stamp_of
from .scan_message import scan_from_message
from .spatial import from_pose, planar, tilt

__all__ = ["BagLog", "BagOptions", "find_bag"]

_ROS1_MAGIC = b"#ROSBAG V"
_STORAGE_MAGICS = {".db3": b"SQLite format 3\x00", ".mcap": b"\x89MCAP0\r\n"}
# Which application a SQLite file is of: a reference set says this.
_APPLICATION_AT, _SET_APPLICATION = slice(68, 72), b"APRS"
_TF = "/tf"
_USUAL_BASES = ("base_link", "base_footprint", "base")
_USUAL_ODOMETRY = ("odom", "odometry")
# A laser that tilts more than this does not see the walls of a plan, radians.
_LEVEL = math.radians(10.0)
_SHOWN_TOPICS = 12


@dataclass(frozen=True)
class BagOptions:
    """What the caller knows better than the recording.

    Args:
        topic: The scans.
        poses: Topic of poses, or "/tf".
        poses_of: Whose poses those are, unless the topic says.
        odometry_topic: Topic of odometry, or "/tf".
        T_base_laser: Where the laser sits on the robot.
        is_upside_down: Whether it hangs with its z axis down.
        base_frame_id: The robot's base in ``/tf``.
        global_frame_id: The map in ``/tf``.
        odom_frame_id: The frame of odometry in ``/tf``.
        field_of_view: Angle that the readings cover, radians.
        range_max: From this range on a reading is no return, metres.
    """

    topic: str | None = None
    poses: str | None = None
    poses_of: Body = "base"
    odometry_topic: str | None = None
    T_base_laser: Pose2D | None = None
    is_upside_down: bool | None = None
    base_frame_id: str | None = None
    global_frame_id: str = "map"
    odom_frame_id: str = "odom"
    field_of_view: float | None = None
    range_max: float | None = None


@dataclass(frozen=True)
class _Source:
    """Where ``T_frame_laser`` over time comes from."""

    name: str
    chain: Chain

    def at(self, stamp: float) -> Pose2D | None:
        motion = self.chain.at(stamp)
        return None if motion is None else planar(motion)


def find_bag(path: Path, magic: bytes) -> tuple[str, list[Path]] | None:
    """Return the format and the parts of a recording, or None where the path is none.

    Args:
        path: A file or folder.
        magic: The first bytes of the file, none of a folder.

    Raises:
        LogError: The file has the wrong ending for what it is, or is a reference set.
    """
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return "rosbag2", [path]
        parts = sorted(part for part in path.iterdir() if part.suffix in _STORAGE_MAGICS)
        return ("rosbag2", parts) if parts else None
    if magic.startswith(_ROS1_MAGIC):
        return "ROS 1 bag", [path]
    if magic.startswith(_STORAGE_MAGICS[".db3"]) and magic[_APPLICATION_AT] == _SET_APPLICATION:
        raise LogError(
            "is a reference set, not a log; a command names the set before the log", path
        )
    for ending, begin in _STORAGE_MAGICS.items():
        if magic.startswith(begin):
            if path.suffix != ending:
                raise LogError(f"its name must end in {ending} to be read as a recording", path)
            return ("MCAP" if ending == ".mcap" else "rosbag2"), [_whole(path)]
    return None


def _whole(path: Path) -> Path:
    """Return the folder of a storage file that is all of a recording: it tells of compression."""
    folder = path.absolute().parent
    try:
        storages = [part for part in folder.iterdir() if part.suffix in _STORAGE_MAGICS]
    except OSError:  # a folder that may not be listed
        return path
    return folder if (folder / "metadata.yaml").is_file() and len(storages) == 1 else path


class BagLog(Log):
    """A ROS recording.

    Args:
        path: What the user named.
        format: What it is, for messages.
        parts: What rosbags opens.
        options: What the caller knows better.

    Raises:
        LogError: The recording cannot be read, has no scans, or leaves a choice open.
        MissingExtraError: rosbags is not installed.
    """

    def __init__(self, path: Path, format: str, parts: list[Path], options: BagOptions) -> None:
        super().__init__(path)
        self.format = format
        self._parts = parts
        self._options = options
        self._is_flipped = False
        with Recording(path, parts) as recording:
            self._topic = self._choose_scans(recording)
            self.count = recording.count(self._topic)
            self._frame = self._first_frame(recording)
            setup = _Setup(path, recording, recording.frame_tree(), self._frame, options)
            self._T_base_laser = setup.planar_mounting
            self._is_flipped = setup.is_upside_down
            self._odometry = setup.odometry()
            self._poses = setup.poses()
        self.notes = tuple(self._say())

    def _choose_scans(self, recording: Recording) -> str:
        held = {topic for topic, kind in recording.topics.items() if kind in SCAN_TYPES}
        listed = ", ".join(f"{topic} ({recording.count(topic)} scans)" for topic in sorted(held))
        if self._options.topic is not None:
            topic = _absolute(self._options.topic)
            if topic in held:
                return topic
            raise LogError(f"no laser scans on {topic}; there are {listed or 'none'}", self.path)
        filled = [topic for topic in held if recording.count(topic)]
        if len(filled) == 1:
            return filled[0]
        if filled:
            raise LogError(
                f"several topics of laser scans: {listed}; choose one (topic, --topic)", self.path
            )
        others = ", ".join(sorted(recording.topics)[:_SHOWN_TOPICS])
        raise LogError(f"no laser scans; the topics are {others or 'none'}", self.path)

    def _first_frame(self, recording: Recording) -> str:
        """Return the frame of the first scan that can be read."""
        first_reason = ""

        def complain(number: int, reason: str) -> None:
            nonlocal first_reason
            first_reason = first_reason or f"message {number}: {reason}"

        for number, _, _, message in recording.messages([self._topic], complain):
            scan, reason = self._scan(message)
            if scan is not None:
                return frame_name(message.header.frame_id)
            complain(number, reason)
        reason = first_reason or "there are no messages"
        raise LogError(f"no readable laser scan on {self._topic}: {reason}", self.path)

    def _say(self) -> Iterator[str]:
        yield f"scans from {self._topic}, frame {self._frame or 'without a name'}"
        mounting = self._T_base_laser
        if mounting is None:
            yield "where the laser sits on the robot is not known (T_base_laser, --laser)"
        else:
            yield (
                f"the laser sits {mounting.x:.3f} m ahead and {mounting.y:.3f} m left on the "
                f"robot, turned by {math.degrees(mounting.theta):.1f} degrees"
                f"{', upside down' if self._is_flipped else ''}"
            )
        yield f"odometry from {self._odometry.name}" if self._odometry else "no odometry"
        yield f"poses from {self._poses.name}" if self._poses else "no poses"

    def _read(self, report: Report) -> Iterator[Record]:
        with Recording(self.path, self._parts) as recording:
            for number, time, _, message in recording.messages([self._topic], report):
                yield self._record(number, time, message, report)

    def _record(self, number: int, time: float, message: Any, report: Report) -> Record:
        source = f"{self.path}: {self._topic} message {number}"
        scan, problem = self._scan(message)
        if scan is None:
            report(number, problem)
        if isinstance(message, str):
            return Record(number - 1, None, None, None, time, source, problem)
        stamp = stamp_of(message.header, time)
        if frame_name(message.header.frame_id) != self._frame:
            # Another laser, which may hang where this one stands.
            other = f"the scan is of another frame, {message.header.frame_id!r}"
            if scan is not None:
                report(number, other)
            return Record(number - 1, None, None, None, stamp, source, problem or other)
        return Record(
            number - 1,
            scan,
            self._poses.at(stamp) if self._poses else None,
            self._odometry.at(stamp) if self._odometry else None,
            stamp,
            source,
            problem,
            self._T_base_laser,
        )

    def _scan(self, message: Any) -> tuple[LaserScan | None, str]:
        if isinstance(message, str):
            return None, message
        options = self._options
        try:
            return scan_from_message(
                message,
                field_of_view=options.field_of_view,
                range_max=options.range_max,
                is_upside_down=self._is_flipped,
            ), ""
        except ScanError as error:
            return None, str(error)


class _Setup:
    """Finds, once, where the laser sits and where odometry and poses come from."""

    def __init__(
        self,
        path: Path,
        recording: Recording,
        tree: FrameTree,
        laser: str,
        options: BagOptions,
    ) -> None:
        self._path = path
        self._recording = recording
        self._tree = tree
        self._laser = laser
        self._options = options
        self._odometry_topic = self._choose_odometry()
        child = recording.child_of(self._odometry_topic)
        named = options.base_frame_id
        self._bases = [frame_name(named)] if named else [child, *_USUAL_BASES]
        self._told_base, self._told_mounting = self._read_mounting()
        self._base, self._mounting = self._find_mounting()

    @property
    def planar_mounting(self) -> Pose2D | None:
        """``T_base_laser`` seen from above."""
        return None if self._mounting is None else planar(self._mounting)

    @property
    def is_upside_down(self) -> bool:
        """Whether the laser hangs with its z axis down.

        Raises:
            LogError: It does neither stand nor hang.
        """
        angle = 0.0 if self._told_mounting is None else tilt(self._told_mounting)
        is_given = self._options.T_base_laser is not None
        if _LEVEL < angle < math.pi - _LEVEL and not is_given:
            raise LogError(
                f"the laser ({self._laser}) is tilted by {math.degrees(angle):.0f} degrees, so "
                "its scans do not show the walls of a plan; if /tf is wrong, say where it sits "
                "(T_base_laser, --laser)",
                self._path,
            )
        if self._options.is_upside_down is not None:
            return self._options.is_upside_down
        # A place given in the plane does not say which way up.
        return angle > math.pi / 2.0

    def odometry(self) -> _Source | None:
        """Return ``T_odom_laser`` over time, or None where nothing tells."""
        topic = self._odometry_topic
        if topic is None or topic == _TF:
            return self._from_tree(self._options.odom_frame_id, is_wanted=topic == _TF)
        return self._from_topic(topic)

    def poses(self) -> _Source | None:
        """Return ``T_map_laser`` over time, or None where nobody asked and ``/tf`` has none.

        Raises:
            LogError: The poses asked for are not there, or say nothing of the laser.
        """
        options = self._options
        topic = None if options.poses is None else _absolute(options.poses)
        if topic is None or topic == _TF:
            return self._from_tree(options.global_frame_id, is_wanted=topic == _TF)
        held = sorted(one for one, kind in self._recording.topics.items() if kind in POSE_TYPES)
        if topic not in held:
            listed = ", ".join(held) or "none"
            raise LogError(f"no poses on {topic}, nor a file of that name; there are {listed}")
        source = self._from_topic(topic, is_laser=options.poses_of == "laser")
        if source is None:
            raise LogError(
                f"where the laser ({self._laser or 'without a frame'}) sits on the robot is not "
                f"in /tf, so the poses on {topic} say nothing of it; give it (T_base_laser, "
                "--laser), or say that they are the laser's (poses_of, --poses-of)",
                self._path,
            )
        return source

    def _choose_odometry(self) -> str | None:
        recording, wanted = self._recording, self._options.odometry_topic
        held = [topic for topic, kind in recording.topics.items() if kind == ODOMETRY_TYPE]
        if wanted is not None:
            topic = _absolute(wanted)
            if topic in held or topic == _TF:
                return topic
            listed = ", ".join(sorted(held)) or "none"
            raise LogError(f"no odometry on {topic}; there are {listed}", self._path)
        filled = [topic for topic in held if recording.count(topic)]
        usual = [topic for topic in filled if topic.rpartition("/")[2] in _USUAL_ODOMETRY]
        return next((choice[0] for choice in (filled, usual) if len(choice) == 1), None)

    def _find_mounting(self) -> tuple[str, NDArray[np.float64] | None]:
        """Return the name of the base and ``T_base_laser`` in space."""
        given = self._options.T_base_laser
        if given is not None:
            known = (base for base in self._bases if base and base in self._tree)
            return next(known, self._bases[0] or _USUAL_BASES[0]), from_pose(given)
        return self._told_base, self._told_mounting

    def _read_mounting(self) -> tuple[str, NDArray[np.float64] | None]:
        """Return the name of the base and ``T_base_laser`` in space, as ``/tf`` has them."""
        for base in self._bases:
            if base and self._laser:
                same = base == self._laser
                mounting = np.eye(4) if same else self._tree.fixed(base, self._laser)
                if mounting is not None:
                    return base, mounting
        return self._bases[0] or _USUAL_BASES[0], None

    def _from_topic(self, topic: str, *, is_laser: bool = False) -> _Source | None:
        """Return ``T_frame_laser`` over time from a topic of poses."""
        trajectory, child = self._recording.trajectory(topic)
        if is_laser or (child and child == self._laser):
            return _Source(topic, Chain(((trajectory, False),)))
        mounting = self._mounting
        if child and child != self._base and self._options.T_base_laser is None:
            mounting = self._tree.fixed(child, self._laser)
        if mounting is None:
            return None
        return _Source(topic, Chain(((trajectory, False), (mounting, False))))

    def _from_tree(self, frame: str, *, is_wanted: bool) -> _Source | None:
        """Return ``T_frame_laser`` over time from ``/tf``."""
        frame = frame_name(frame)
        given = self._options.T_base_laser is not None
        end = self._base if given else self._laser
        moving = self._tree.moving(frame, end)
        if moving is None or not (moving or is_wanted):
            if is_wanted:
                raise LogError(
                    f"/tf does not say where {end or 'the laser'} is in {frame}", self._path
                )
            return None
        self._recording.gather(self._tree, moving)
        chain = self._tree.chain(frame, end)
        if given and self._mounting is not None:
            chain = Chain((*chain.links, (self._mounting, False)))
        return _Source(f"{_TF} ({frame})", chain)


def _absolute(topic: str) -> str:
    return topic if topic.startswith("/") else f"/{topic}"
