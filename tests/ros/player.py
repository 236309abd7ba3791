"""A robot without a brain: publishes what it is told to, from a recording.

Reads one JSON object a line from stdin, does it, and answers with a line.  Run as a process of
its own, so that it can be killed.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import Pose
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Player:
    """Publishes scan, odom and map."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("player")
        self.scan = self.node.create_publisher(LaserScan, "scan", qos_profile_sensor_data)
        self.odom = self.node.create_publisher(Odometry, "odom", 10)
        self.map = self.node.create_publisher(OccupancyGrid, "map", LATCHED)

    def do(self, task: dict[str, Any]) -> object:
        return getattr(self, "do_" + task.pop("do"))(**task)

    def do_map(self, file: str, frame: str = "map", **changes: Any) -> int:
        """Publish a map, with some fields changed."""
        kept = np.load(file)
        message = OccupancyGrid()
        message.header.frame_id = frame
        message.info.height, message.info.width = kept["data"].shape
        message.info.resolution = float(kept["resolution"])
        message.info.origin = planar(*kept["origin"])
        message.data = kept["data"].astype(np.int8).reshape(-1)
        for name, value in changes.items():
            setattr(message.info, name, value)
        self.map.publish(message)
        return self.map.get_subscription_count()

    def do_play(
        self,
        file: str,
        first: int = 0,
        last: int | None = None,
        rate: float = 20.0,
        offset: float = 0.0,
        frame: str = "laser",
        odom_frame: str = "odom",
        jump: float = 0.0,
        odometry: bool = True,
        heard: bool = True,
    ) -> float:
        """Publish scans and odometry of a recording; gives the time of the last scan."""
        kept = np.load(file)
        end = time.monotonic() + 30.0
        while heard and not self.scan.get_subscription_count() and time.monotonic() < end:
            time.sleep(0.05)
        stamp = math.nan
        for k in range(*slice(first, last).indices(len(kept["stamps"]))):
            stamp = float(kept["stamps"][k]) + offset
            if odometry and np.isfinite(kept["odometry"][k]).all():
                x, y, theta = kept["odometry"][k]
                # As a robot does: before and after the scan.
                for moment in (stamp - 0.01, stamp + 0.01):
                    self.odom.publish(self._odometry(moment, (x + jump, y, theta), odom_frame))
            self.scan.publish(scan_message(kept, kept["ranges"][k], stamp, frame))
            time.sleep(1.0 / rate)
        return stamp

    def do_garbage(self, file: str, kind: str, offset: float = 0.0, frame: str = "laser") -> str:
        """Publish a scan that is none."""
        kept = np.load(file)
        message = scan_message(kept, kept["ranges"][0], float(kept["stamps"][0]) + offset, frame)
        GARBAGE[kind](message)
        self.scan.publish(message)
        return kind

    def do_garbage_odometry(self, offset: float = 0.0) -> str:
        message = self._odometry(offset, (math.nan, 0.0, 0.0), "odom")
        message.pose.pose.orientation.w = message.pose.pose.orientation.z = 0.0
        self.odom.publish(message)
        return "published"

    def _odometry(self, stamp: float, pose: tuple[float, ...], frame: str) -> Odometry:
        message = Odometry()
        message.header.frame_id, message.child_frame_id = frame, "base_link"
        set_time(message.header.stamp, stamp)
        message.pose.pose = planar(*pose)
        return message


def _change(**values: Any) -> Any:
    return lambda message: [setattr(message, name, value) for name, value in values.items()]


GARBAGE = {
    "empty": _change(ranges=[]),
    "nothing seen": _change(ranges=[math.inf] * 100),
    "not a number": _change(ranges=[math.nan] * 100),
    "zero increment": _change(angle_increment=0.0),
    "increment in degrees": _change(angle_increment=0.5),
    "infinite increment": _change(angle_increment=math.inf),
    "no angle": _change(angle_min=math.nan),
    "limits out of order": _change(range_min=10.0, range_max=1.0),
    "no limits": _change(range_max=math.nan),
    "one reading": _change(ranges=[1.0]),
    "negative": _change(ranges=[-1.0] * 100),
    # More than any sensor has, and yet one datagram: best effort loses what needs several.
    "fifteen thousand readings": _change(ranges=[1.0] * 15_000, angle_increment=4.0e-4),
}


def scan_message(kept: Any, ranges: Any, stamp: float, frame: str) -> LaserScan:
    message = LaserScan()
    message.header.frame_id = frame
    set_time(message.header.stamp, stamp)
    message.angle_min, message.angle_increment, message.range_min, message.range_max = (
        float(value) for value in kept["geometry"]
    )
    message.angle_max = message.angle_min + message.angle_increment * (len(ranges) - 1)
    message.ranges = ranges.astype(np.float32)
    return message


def set_time(message: Any, stamp: float) -> None:
    message.sec = int(stamp)
    message.nanosec = round((stamp - int(stamp)) * 1e9) % 1_000_000_000


def planar(x: float, y: float, theta: float) -> Pose:
    pose = Pose()
    pose.position.x, pose.position.y = float(x), float(y)
    pose.orientation.z, pose.orientation.w = math.sin(0.5 * theta), math.cos(0.5 * theta)
    return pose


def main() -> None:
    rclpy.init()
    player = Player()
    print(json.dumps(str(Path(__file__).name)), flush=True)
    for line in sys.stdin:
        print(json.dumps(player.do(json.loads(line))), flush=True)
    player.node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
