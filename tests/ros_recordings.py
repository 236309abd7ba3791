"""Writes ROS recordings for the tests, in every storage, with rosbags' own writers."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

STORAGES = ("ros1", "sqlite3", "mcap")
NANO = 1_000_000_000

TRANSFORMS = """geometry_msgs/TransformStamped[] transforms
================================================================================
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
================================================================================
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""

Sample = tuple[Sequence[float], Sequence[float]]


def rotation(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> tuple[float, ...]:
    """Quaternion x y z w of roll, pitch and yaw (fixed axes), radians."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


@functools.cache
def type_store(is_ros1: bool) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if is_ros1:
        store.register(get_types_from_msg(TRANSFORMS, "tf2_msgs/msg/TFMessage"))
    return store


@dataclass
class Messages:
    """What is to be recorded, by storage-independent calls; write it with `write`."""

    storage: str
    entries: list[tuple[float, str, str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.is_ros1 = self.storage == "ros1"
        self.store = type_store(self.is_ros1)

    def make(self, kind: str, **values: Any) -> Any:
        return self.store.types[kind](**values)

    def add(self, time: float, topic: str, kind: str, message: Any) -> None:
        self.entries.append((time, topic, kind, message))

    def header(self, stamp: float, frame: str) -> Any:
        seconds = math.floor(stamp)
        time = self.make(
            "builtin_interfaces/msg/Time",
            sec=seconds,
            nanosec=min(round((stamp - seconds) * NANO), NANO - 1),
        )
        extra = {"seq": 0} if self.is_ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **extra)

    def scan(
        self,
        stamp: float,
        ranges: Iterable[float],
        *,
        topic: str = "/scan",
        frame: str = "laser",
        time: float | None = None,
        **geometry: float,
    ) -> None:
        values = {"angle_min": -1.0, "angle_max": 1.0, "angle_increment": 0.1}
        values |= {"time_increment": 0.0, "scan_time": 0.0, "range_min": 0.1, "range_max": 20.0}
        message = self.make(
            "sensor_msgs/msg/LaserScan",
            header=self.header(stamp, frame),
            ranges=np.array(list(ranges), dtype=np.float32),
            intensities=np.array([], dtype=np.float32),
            **(values | geometry),
        )
        self.add(stamp if time is None else time, topic, "sensor_msgs/msg/LaserScan", message)

    def echoes(self, stamp: float, bundles: Sequence[Sequence[float]]) -> None:
        kind = "sensor_msgs/msg/MultiEchoLaserScan"
        echo = [
            self.make("sensor_msgs/msg/LaserEcho", echoes=np.array(one, dtype=np.float32))
            for one in bundles
        ]
        values = {"angle_min": -1.0, "angle_max": 1.0, "angle_increment": 0.1}
        values |= {"time_increment": 0.0, "scan_time": 0.0, "range_min": 0.1, "range_max": 20.0}
        header = self.header(stamp, "laser")
        message = self.make(kind, header=header, ranges=echo, intensities=[], **values)
        self.add(stamp, "/echoes", kind, message)

    def pose(self, sample: Sample) -> Any:
        (x, y, z), (qx, qy, qz, qw) = sample
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )

    def posed(
        self,
        stamp: float,
        x: float,
        y: float,
        yaw: float,
        *,
        topic: str,
        kind: str = "Odometry",
        child: str = "base_link",
        frame: str = "odom",
    ) -> None:
        pose = self.pose(((x, y, 0.0), rotation(yaw=yaw)))
        header = self.header(stamp, frame)
        name = f"geometry_msgs/msg/{kind}"
        zeros = np.zeros(36)
        uncertain = "geometry_msgs/msg/PoseWithCovariance"
        if kind == "PoseStamped":
            message = self.make(name, header=header, pose=pose)
        elif kind == "PoseWithCovarianceStamped":
            covered = self.make(uncertain, pose=pose, covariance=zeros)
            message = self.make(name, header=header, pose=covered)
        else:
            name = "nav_msgs/msg/Odometry"
            vector = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
            twist = self.make("geometry_msgs/msg/Twist", linear=vector, angular=vector)
            moving = "geometry_msgs/msg/TwistWithCovariance"
            message = self.make(
                name,
                header=header,
                child_frame_id=child,
                pose=self.make(uncertain, pose=pose, covariance=zeros),
                twist=self.make(moving, twist=twist, covariance=zeros),
            )
        self.add(stamp, topic, name, message)

    def transform(
        self,
        stamp: float,
        parent: str,
        child: str,
        translation: Sequence[float] = (0.0, 0.0, 0.0),
        turn: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
        *,
        is_static: bool = False,
    ) -> None:
        (x, y, z), (qx, qy, qz, qw) = translation, turn
        motion = self.make(
            "geometry_msgs/msg/Transform",
            translation=self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=self.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )
        stamped = self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp, parent),
            child_frame_id=child,
            transform=motion,
        )
        message = self.make("tf2_msgs/msg/TFMessage", transforms=[stamped])
        topic = "/tf_static" if is_static else "/tf"
        self.add(stamp, topic, "tf2_msgs/msg/TFMessage", message)

    def write(self, folder: Path, name: str = "run", *, has_types: bool = True) -> Path:
        """Write the recording and give the path that a user would name."""
        from rosbags import rosbag1, rosbag2

        if self.is_ros1:
            path = folder / f"{name}.bag"
            with rosbag1.Writer(path) as writer:
                known: dict[tuple[str, str], Any] = {}
                for time, topic, kind, message in self.entries:
                    if (topic, kind) not in known:
                        known[topic, kind] = writer.add_connection(
                            topic, kind, typestore=self.store
                        )
                    data = self.store.serialize_ros1(message, kind)
                    writer.write(known[topic, kind], round(time * NANO), data)
            return path
        path = folder / name
        plugin = rosbag2.StoragePlugin[self.storage.upper()]
        with rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
            known = {}
            for time, topic, kind, message in self.entries:
                if (topic, kind) not in known:
                    known[topic, kind] = writer.add_connection(topic, kind, typestore=self.store)
                data = self.store.serialize_cdr(message, kind)
                writer.write(known[topic, kind], round(time * NANO), data)
        return path
