"""What the node uses of tf2_ros, which has no wheels: the same calls, with one robot's frames.

A laser that hangs upside down ahead of the base and one that leans over; transforms that are
broadcast go out on a topic of their own.
"""

from __future__ import annotations

import math
from typing import Any

from geometry_msgs.msg import TransformStamped

LASER = (0.3, 0.1, math.radians(60.0))


class TransformException(Exception):  # noqa: N818 - the name is that of tf2
    pass


class Buffer:
    def lookup_transform(self, target: str, source: str, time: Any) -> TransformStamped:
        transform = TransformStamped()
        transform.header.frame_id, transform.child_frame_id = target, source
        rotation = transform.transform.rotation
        if (target, source) == ("base_link", "hanging_laser"):
            transform.transform.translation.x, transform.transform.translation.y = LASER[:2]
            # Half a turn about x, then the yaw: its z axis points down.
            rotation.x, rotation.y = math.cos(0.5 * LASER[2]), math.sin(0.5 * LASER[2])
            rotation.w = 0.0
        elif (target, source) == ("base_link", "leaning_laser"):
            rotation.x, rotation.w = math.sin(0.3), math.cos(0.3)
        else:
            raise TransformException(f"no transform from {source} to {target}")
        return transform


class TransformListener:
    def __init__(self, buffer: Buffer, node: Any) -> None:
        assert isinstance(buffer, Buffer)


class TransformBroadcaster:
    def __init__(self, node: Any) -> None:
        self._publisher = node.create_publisher(TransformStamped, "/stand_in_for_tf", 10)

    def sendTransform(self, transform: TransformStamped) -> None:  # noqa: N802
        self._publisher.publish(transform)
