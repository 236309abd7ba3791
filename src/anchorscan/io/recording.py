"""A ROS recording opened with rosbags: topics, messages, and what they say about frames.

Whatever rosbags raises on damaged files ends here, as a `LogError` or as a report.
"""

from __future__ import annotations

import functools
import heapq
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import LogError, MissingExtraError
from .bounded_file import BoundedPath
from .frames import FrameTree, frame_name
from .log import Report
from .trajectory import Trajectory

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

__all__ = ["POSE_TYPES", "SCAN_TYPES", "Recording", "stamp_of"]

SCAN_TYPES = ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan")
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    ODOMETRY_TYPE,
)
_TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_STATIC = "tf_static"
_NANO = 1e-9

# What is read of a message.  A recording brings its own definitions, which may be anything.
_HEADER = ("header.stamp.sec", "header.stamp.nanosec", "header.frame_id")
_LIMITS = ("angle_min", "angle_increment", "range_min", "range_max")
_POSITION = ("position.x", "position.y", "position.z")
_ROTATION = ("orientation.x", "orientation.y", "orientation.z", "orientation.w")
_TRANSLATION = ("translation.x", "translation.y", "translation.z")
_TURN = ("rotation.x", "rotation.y", "rotation.z", "rotation.w")
_TEXTS = ("frame_id", "child_frame_id")
_ARRAYS = ("ranges", "transforms")
_READ = {
    **dict.fromkeys(SCAN_TYPES, (*_HEADER, *_LIMITS, "ranges")),
    **dict.fromkeys(_TF_TYPES, ("transforms",)),
    POSE_TYPES[0]: (*_HEADER, *(f"pose.{name}" for name in (*_POSITION, *_ROTATION))),
    POSE_TYPES[1]: (*_HEADER, *(f"pose.pose.{name}" for name in (*_POSITION, *_ROTATION))),
    POSE_TYPES[2]: (
        *(*_HEADER, "child_frame_id"),
        *(f"pose.pose.{name}" for name in (*_POSITION, *_ROTATION)),
    ),
}
_READ_OF_TRANSFORM = (
    *(*_HEADER, "child_frame_id"),
    *(f"transform.{name}" for name in (*_TRANSLATION, *_TURN)),
)


class Recording:
    """A ROS 1 or ROS 2 recording, open within ``with``.

    Args:
        path: What the user named, for messages.
        parts: The bags, folders or storage files that make it up.

    Raises:
        LogError: It cannot be opened.
        MissingExtraError: rosbags is not installed.
    """

    def __init__(self, path: Path, parts: Iterable[Path]) -> None:
        self.path = path
        self._parts = [BoundedPath(part) for part in parts]
        self._is_ros1 = all(part.suffix not in ("", ".db3", ".mcap") for part in self._parts)
        self._is_ros1 = self._is_ros1 and not any(part.is_dir() for part in self._parts)
        self._stack = ExitStack()
        self._readers: list[Any] = []
        self._decoders: dict[str, Callable[[bytes], Any]] = {}

    def __enter__(self) -> Recording:
        try:
            from rosbags import rosbag1, rosbag2
        except ImportError:
            raise MissingExtraError("reading ROS recordings", "bags") from None
        make: Callable[[Path], Any] = rosbag1.Reader if self._is_ros1 else rosbag2.Reader
        try:
            self._readers = [self._stack.enter_context(make(part)) for part in self._parts]
            _check_connections(self._connections())
        except Exception as error:
            self._stack.close()
            raise LogError(
                f"cannot be read as a recording: {_first_line(error)}", self.path
            ) from None
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stack.close()

    @property
    def topics(self) -> dict[str, str]:
        """Every topic and its message type, in the spelling of ROS 2."""
        return {connection.topic: connection.msgtype for connection in self._connections()}

    def count(self, topic: str) -> int:
        """Return the number of messages on a topic."""
        return sum(connection.msgcount for connection in self._connections([topic]))

    def messages(
        self, topics: Iterable[str], report: Report
    ) -> Iterator[tuple[int, float, str, Any]]:
        """Yield the messages of some topics in the order of recording.

        Args:
            topics: Their names.
            report: Called with the number of the message where the recording breaks off.

        Yields:
            Number from one, time of recording (seconds), topic, and the message; a text that
            says why for one that cannot be decoded.
        """
        number = 0
        raw = self._raw(list(topics))
        while True:
            number += 1
            try:
                connection, time, data = next(raw)
            except StopIteration:
                return
            except Exception as error:
                report(number, f"the recording is damaged from here on: {_first_line(error)}")
                return
            yield number, time * _NANO, connection.topic, self._decoded(connection, data)

    def child_of(self, topic: str | None) -> str:
        """Return the frame that an odometry topic follows, "" where it does not say."""
        for *_, message in self.messages([topic] if topic else [], _ignore):
            if not isinstance(message, str):
                return frame_name(getattr(message, "child_frame_id", ""))
        return ""

    def trajectory(self, topic: str) -> tuple[Trajectory, str]:
        """Return the poses on a topic over time, and the frame that they are of ("" if unsaid).

        Only those in the frame of the first one count: two publishers on one topic are two
        trajectories.
        """
        trajectory = Trajectory()
        frames: tuple[str, str] | None = None
        for _, time, _, message in self.messages([topic], _ignore):
            if isinstance(message, str):
                continue
            found = (message.header.frame_id, getattr(message, "child_frame_id", ""))
            frames = frames or found
            if found == frames:
                pose = getattr(message.pose, "pose", message.pose)
                trajectory.add(
                    stamp_of(message.header, time), _sample(pose.position, pose.orientation)
                )
        return trajectory, frame_name(frames[1]) if frames else ""

    def frame_tree(self) -> FrameTree:
        """Return what ``/tf`` and ``/tf_static`` tell of frames that do not move."""
        tree = FrameTree()
        for topic, _, one in self._transforms():
            is_static = topic.rpartition("/")[2] == _STATIC
            values = _sample(one.transform.translation, one.transform.rotation)
            tree.add(one.header.frame_id, one.child_frame_id, values, is_static=is_static)
        return tree

    def gather(self, tree: FrameTree, frames: Iterable[str]) -> None:
        """Gather the samples of frames that move, into the tree."""
        tree.gather(frames)
        for _, time, one in self._transforms():
            values = _sample(one.transform.translation, one.transform.rotation)
            stamp = stamp_of(one.header, time)
            tree.sample(one.header.frame_id, one.child_frame_id, stamp, values)

    def _transforms(self) -> Iterator[tuple[str, float, Any]]:
        topics = [topic for topic, kind in self.topics.items() if kind in _TF_TYPES]
        for _, time, topic, message in self.messages(topics, _ignore):
            if not isinstance(message, str):
                for one in message.transforms:
                    yield topic, time, one

    def _connections(self, topics: Iterable[str] | None = None) -> list[Connection]:
        wanted = None if topics is None else set(topics)
        return [
            connection
            for reader in self._readers
            for connection in reader.connections
            if wanted is None or connection.topic in wanted
        ]

    def _raw(self, topics: list[str]) -> Iterator[tuple[Connection, int, bytes]]:
        streams = []
        for reader in self._readers:
            wanted = [one for one in reader.connections if one.topic in topics]
            if wanted:
                streams.append(reader.messages(connections=wanted))
        return heapq.merge(*streams, key=lambda message: message[1])

    def _decoded(self, connection: Connection, data: bytes) -> Any:
        try:
            message = self._decoder(connection)(data)
            _check_fields(message, _READ.get(connection.msgtype, ()))
            for transform in getattr(message, "transforms", ()):
                _check_fields(transform, _READ_OF_TRANSFORM)
            return message
        except Exception as error:
            return f"the message cannot be decoded: {_first_line(error)}"

    def _decoder(self, connection: Connection) -> Callable[[bytes], Any]:
        found = self._decoders.get(connection.msgtype)
        if found is None:
            from rosbags.interfaces import MessageDefinitionFormat

            definition = connection.msgdef
            is_given = definition.format == MessageDefinitionFormat.MSG
            text = definition.data if is_given else None
            found = _decoder(connection.msgtype, text, is_ros1=self._is_ros1)
            self._decoders[connection.msgtype] = found
        return found


@functools.lru_cache(maxsize=16)
def _decoder(kind: str, definition: str | None, *, is_ros1: bool) -> Callable[[bytes], Any]:
    """Return the decoder of a message type, by the definition in the recording if it is there.

    Only the types that are read are looked at: one definition that rosbags cannot parse
    must not hide the scans beside it.  Making one takes twenty milliseconds, and a recording is
    opened several times.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if definition is not None:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(definition, kind))
    else:
        # The messages that are read here have not changed since the first ROS 2.
        store = get_typestore(Stores.LATEST)
    if is_ros1:
        return lambda data: store.deserialize_ros1(data, kind)
    return lambda data: store.deserialize_cdr(data, kind)


def _check_connections(connections: Iterable[Connection]) -> None:
    """Check what a recording says of its topics, which rosbags takes as it is written.

    Raises:
        ValueError: It cannot be meant.
    """
    for connection in connections:
        if not (isinstance(connection.topic, str) and isinstance(connection.msgtype, str)):
            raise ValueError("a topic has no name or no type")
        if not isinstance(connection.msgcount, int):
            raise ValueError(f"it is not said how many messages are on {connection.topic[:60]!r}")


def _check_fields(message: Any, fields: Iterable[str]) -> None:
    """Check that a message has what is read of it.

    Raises:
        LogError: A field is missing, or holds something else.
    """
    for field in fields:
        value, name = message, field.rpartition(".")[2]
        for part in field.split("."):
            value = getattr(value, part, None)
        kinds: tuple[type, ...] = (int, float)
        if name in _TEXTS:
            kinds = (str,)
        elif name in _ARRAYS:
            kinds = (list, np.ndarray)
        if not isinstance(value, kinds):
            raise LogError(f"its definition has no {field} that can be read")


def stamp_of(header: Any, time: float) -> float:
    """Return a header's time in seconds, or the time of recording where it has none."""
    stamp = header.stamp.sec + header.stamp.nanosec * _NANO
    return float(stamp) if stamp else time


def _sample(translation: Any, rotation: Any) -> tuple[float, ...]:
    return (
        translation.x,
        translation.y,
        translation.z,
        rotation.x,
        rotation.y,
        rotation.z,
        rotation.w,
    )


def _ignore(number: int, reason: str) -> None:
    """Leave a report to the iteration over the scans."""


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
