"""The ROS node by itself, without ROS: its messages and what carries them are stand-ins.

What passes between processes is tested in ``tests/ros``; here is what a player cannot time.
"""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest

import anchorscan
from anchorscan import Hypothesis, LaserScan, Pose2D
from anchorscan.localizer import Belief
from anchorscan.robot import Robot
from anchorscan.robot_parameters import RobotParameters

SCAN = LaserScan.from_field_of_view([1.0, 2.0, 3.0], math.pi)
# What ros_node imports of ROS; everything in it is a mock but what is needed below.
MODULES = [
    *("rclpy", "rclpy.clock", "rclpy.executors", "rclpy.lifecycle", "rclpy.parameter"),
    *("rclpy.qos", "rclpy.time", "tf2_ros"),
    *("diagnostic_msgs", "diagnostic_msgs.msg", "geometry_msgs", "geometry_msgs.msg"),
    *("nav_msgs", "nav_msgs.msg", "rcl_interfaces", "rcl_interfaces.msg"),
    *("sensor_msgs", "sensor_msgs.msg", "std_srvs", "std_srvs.srv"),
]


class Node:
    """In place of rclpy's node: it keeps its parameters, and publishes into mocks."""

    def __init__(self, name: str, **options: Any) -> None:
        self.parameters: dict[str, Any] = {}
        self.logger = mock.MagicMock()

    def declare_parameter(self, name: str, value: Any, descriptor: Any) -> None:
        self.parameters[name] = None if isinstance(value, mock.Mock) else value

    def get_parameter_or(self, name: str, alternative: Any) -> Any:
        return SimpleNamespace(value=self.parameters[name])

    def get_logger(self) -> Any:
        return self.logger

    def get_name(self) -> str:
        return "anchorscan"

    def on_activate(self, state: Any) -> str:
        return "success"

    on_deactivate = on_activate

    def _made(self, *what: Any, **options: Any) -> Any:
        return mock.MagicMock()

    get_clock = create_publisher = create_lifecycle_publisher = _made
    create_subscription = create_service = create_timer = _made


class Frames:
    """In place of tf2: the laser sits on the base, and odometry is what a test says."""

    def __init__(self) -> None:
        self.odometry: Callable[[float | None], Pose2D | None] = lambda when: None
        self.heard = -math.inf

    def motion(self, target: str, source: str, when: Any = None) -> Any:
        from anchorscan.io.spatial import from_pose

        if source == "laser":
            return np.eye(4)
        pose = self.odometry(when)
        return None if pose is None else from_pose(pose)

    def newest(self, target: str, source: str) -> float:
        return self.heard


class Places:
    """A map in which single scans are located as a test says."""

    def __init__(self) -> None:
        self.found: list[Hypothesis] = []

    def locate(self, scan: LaserScan) -> list[Hypothesis]:
        return self.found

    def __len__(self) -> int:
        return 1


class Sure:
    """A belief that is always sure of the same place, and notes what it is fed."""

    def __init__(self) -> None:
        self.fed: list[tuple[float, Pose2D | None]] = []

    def update(
        self, scan: LaserScan, odometry: Pose2D | None, stamp: float, T_base_laser: Pose2D
    ) -> Belief:
        self.fed.append((stamp, odometry))
        return Belief((hypothesis(Pose2D(5.0, 2.0, 0.5)),), 0.0, True)

    def reset(self) -> None:
        pass


def hypothesis(pose: Pose2D) -> Hypothesis:
    return Hypothesis(0, Pose2D(), pose, np.eye(3), 0.0, 0.0, 0.0, 0.999, True)


def header(stamp: float, frame: str) -> Any:
    seconds = math.floor(stamp)
    nanoseconds = round(1e9 * (stamp - seconds))
    return SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds), frame_id=frame)


def scan_message(stamp: float) -> Any:
    return SimpleNamespace(
        header=header(stamp, "laser"),
        ranges=SCAN.ranges,
        angle_min=SCAN.angle_min,
        angle_increment=SCAN.angle_increment,
        range_min=SCAN.range_min,
        range_max=SCAN.range_max,
    )


def odometry_message(stamp: float, pose: Pose2D) -> Any:
    place = SimpleNamespace(x=pose.x, y=pose.y, z=0.0)
    turn = SimpleNamespace(x=0.0, y=0.0, z=math.sin(pose.theta / 2), w=math.cos(pose.theta / 2))
    return SimpleNamespace(
        header=header(stamp, "odom"),
        pose=SimpleNamespace(pose=SimpleNamespace(position=place, orientation=turn)),
    )


@pytest.fixture(scope="module")
def ros_node() -> Iterator[Any]:
    """The module, with stand-ins for what it imports; of them nothing stays behind."""
    stand_ins: dict[str, Any] = {name: mock.MagicMock() for name in MODULES}
    stand_ins["rclpy.lifecycle"].LifecycleNode = Node
    stand_ins["rclpy.time"].Time.from_msg = lambda stamp: stamp.sec + 1e-9 * stamp.nanosec
    stand_ins["nav_msgs.msg"].OccupancyGrid = type("OccupancyGrid", (), {})
    stand_ins["geometry_msgs.msg"].PoseWithCovarianceStamped = mock.MagicMock
    stand_ins["rclpy.lifecycle"].TransitionCallbackReturn.FAILURE = "failure"
    stand_ins["diagnostic_msgs.msg"].KeyValue = SimpleNamespace
    name = "anchorscan.ros_node"
    # Not by mock.patch.dict, which would also forget what else is imported for the first time.
    hidden = {each: sys.modules.pop(each, None) for each in (*stand_ins, name)}
    sys.modules.update(stand_ins)
    try:
        yield importlib.import_module(name)
    finally:
        for each, module in hidden.items():
            del sys.modules[each]
            if module is not None:
                sys.modules[each] = module
        del anchorscan.ros_node  # type: ignore[attr-defined]


@pytest.fixture
def make(ros_node: Any) -> Callable[..., Any]:
    """Make an active node whose belief is always sure, in a map that knows no single scan."""

    def made(**options: Any) -> Any:
        node = ros_node.LocalizationNode()
        node._options = RobotParameters(**options)
        node._mailbox = mock.MagicMock(dropped=0)
        node._connect(node._options)
        node._frames = Frames()
        node._places = Places()
        node._robot = Robot(Sure())
        node._is_active = True
        return node

    return made


def hear(node: Any, stamp: float) -> None:
    """Let a scan come, and be worked on where it is wanted."""
    message = scan_message(stamp)
    node._take_scan(message)
    if node._wants_scans():
        node._use_scan(message)


def told(node: Any) -> list[Any]:
    return [call.args[0] for call in node._initial_pose.publish.call_args_list]


def seconds(message: Any) -> float:
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)


# What is told when somebody asks


def test_an_idle_node_does_not_tell_where_the_robot_was_long_ago(make: Callable[..., Any]) -> None:
    node = make()
    hear(node, 10.0)
    assert len(told(node)) == 1
    hear(node, 221.0)
    success, words = node._located_now()
    assert not success
    assert "not known where" in words
    assert len(told(node)) == 1


def test_a_belief_as_new_as_the_scan_is_told_with_its_own_time(make: Callable[..., Any]) -> None:
    node = make(continuous=True)
    hear(node, 10.0)
    node._take_scan(scan_message(10.3))  # which waits to be worked on
    assert node._located_now()[0]
    assert [seconds(message) for message in told(node)] == [10.0, 10.0]


def test_a_scan_from_before_the_node_was_activated_is_not_located(
    make: Callable[..., Any],
) -> None:
    node = make()
    node._take_scan(scan_message(10.0))
    node.on_deactivate(None)
    node._places.found = [hypothesis(Pose2D(1.0, 2.0, 0.3))]
    node.on_activate(None)
    assert not node._located_now()[0]
    assert told(node) == []


def test_a_pose_that_was_asked_for_is_not_told_once_more(make: Callable[..., Any]) -> None:
    node = make()
    node._take_scan(scan_message(10.0))
    node._places.found = [hypothesis(Pose2D(1.0, 2.0, 0.3))]
    assert node._located_now()[0]
    hear(node, 10.1)
    assert [seconds(message) for message in told(node)] == [10.0]
    # Where nobody listens, nobody was told.
    node = make()
    node._initial_pose.get_subscription_count.return_value = 0
    node._take_scan(scan_message(10.0))
    node._places.found = [hypothesis(Pose2D(1.0, 2.0, 0.3))]
    assert node._located_now()[0]
    node._initial_pose.get_subscription_count.return_value = 1
    hear(node, 10.1)
    assert [seconds(message) for message in told(node)] == [10.0, 10.1]


# Where odometry comes from


def driven(when: float | None) -> Pose2D:
    """A robot that drives half a metre and turns 0.8 rad in a second."""
    assert when is not None
    return Pose2D(0.5 * (when - 10.0), 0.0, 0.8 * (when - 10.0))


def test_odometry_of_tf_is_that_of_the_time_of_every_scan_and_not_waited_for(
    make: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    node = make(continuous=True)
    node._frames.odometry = driven
    waited = mock.MagicMock()
    monkeypatch.setattr(node._robot.odometry, "wait_until", waited)
    stamps = [10.0 + 0.125 * k for k in range(12)]
    for stamp in stamps:
        hear(node, stamp)
    for (stamp, odometry), expected in zip(node._robot._tracker.fed, stamps, strict=True):
        assert stamp == expected
        assert odometry is not None
        assert odometry.distance(driven(stamp)) < 1e-9
        assert odometry.turn(driven(stamp)) < 1e-9
    assert not waited.called


def test_odometry_of_tf_that_is_on_its_way_is_waited_for_and_no_other(
    make: Callable[..., Any], ros_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = make(continuous=True)
    frames, pauses = node._frames, []
    frames.odometry = lambda when: driven(when) if when <= frames.heard else None

    def pause(seconds: float) -> None:
        pauses.append(seconds)
        frames.heard += 0.05

    monkeypatch.setattr(ros_node.time, "sleep", pause)
    frames.heard = 9.875
    hear(node, 10.0)
    assert node._robot._tracker.fed[-1][1] is not None
    assert len(pauses) == 3
    hear(node, 20.0)  # it has stopped
    assert node._robot._tracker.fed[-1] == (20.0, None)
    assert len(pauses) == 3


def test_where_the_topic_tells_the_odometry_tf_is_not_asked(make: Callable[..., Any]) -> None:
    node = make(continuous=True)
    node._frames.odometry = mock.MagicMock(return_value=Pose2D(7.0))
    node._take_odometry(odometry_message(10.0, Pose2D(1.0)))
    node._take_odometry(odometry_message(10.2, Pose2D(1.1)))
    hear(node, 10.1)
    moved = node._robot._tracker.fed[-1][1]
    assert moved is not None
    assert moved.distance(Pose2D(1.05)) < 1e-9
    assert not node._frames.odometry.called
    # A topic that has gone silent is replaced.
    node._odometry_heard -= 5.0
    hear(node, 15.0)
    assert node._robot._tracker.fed[-1][1] == Pose2D(7.0)


# What diagnostics say


class Meddling(str):
    """A topic or a reason that another thread mends in the very moment in which it is told."""

    node: Any = None

    def __format__(self, how: str) -> str:
        if self.node is not None:
            self.node._mend("scan")
            self.node._mend("map")
        return str(self)


def test_a_complaint_that_changes_while_it_is_told_does_not_end_the_node(
    make: Callable[..., Any],
) -> None:
    node = make()
    reason, topic = Meddling("is unusable"), Meddling("scan")
    node._heard = math.inf
    node._complain(topic, reason)
    node._complain("map", "is unusable")
    reason.node = topic.node = node
    node._diagnose()
    (array,) = node._diagnostics.publish.call_args.args
    (status,) = array.status
    assert status.message == "the scan is unusable"
    said = {each.key: each.value for each in status.values}
    assert {key for key in said if key.startswith("problem")} == {"problem: scan", "problem: map"}
    node._diagnose()
    (array,) = node._diagnostics.publish.call_args.args
    assert not [each.key for each in array.status[0].values if each.key.startswith("problem")]


# What it is not configured with


def test_settings_that_make_no_map_keep_it_from_being_configured(ros_node: Any) -> None:
    node = ros_node.LocalizationNode()
    node.parameters["preset"] = "paper"
    assert node.on_configure(None) == "failure"
    (words,) = node.logger.error.call_args.args
    assert "not configured" in words
    assert "use those of the preset default" in words
