"""The ROS 2 node: a robot that finds itself in its map at power-up, without a click.

``anchorscan ros`` or ``python -m anchorscan.ros_node --ros-args ...``.  A managed node
(lifecycle) around the same belief as ``anchorscan track``.  Frames, topics, services and
parameters are the contract of ``docs/robot.md``; parameters that mean the same as in nav2_amcl
have its names.

Messages are taken by the executor's thread and answered by one worker: scans wait in a short
queue from which the oldest falls out, so that a slow machine loses scans and never gains delay;
of maps only the newest waits.  While a new map is prepared, the old one goes on answering.
"""

from __future__ import annotations

import hashlib
import math
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import AnchorscanError, LogError, ScanError, SettingsError
from .io.frames import frame_name
from .io.scan_message import scan_from_message
from .io.spatial import matrix_of, planar, tilt
from .localizer import Localizer
from .mailbox import Closed, Mailbox
from .occupancy import OccupancyGrid, reference_scans
from .plausibility import MirrorWatch
from .pose import Pose2D
from .reference_set import ReferenceSet
from .robot import Report, Robot, SingleScans
from .robot_parameters import RobotParameters
from .scan import LaserScan
from .settings import Settings

try:
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from geometry_msgs.msg import (
        Pose,
        PoseArray,
        PoseWithCovarianceStamped,
        TransformStamped,
    )
    from nav_msgs.msg import OccupancyGrid as OccupancyGridMessage
    from nav_msgs.msg import Odometry as OdometryMessage
    from rcl_interfaces.msg import ParameterDescriptor
    from rclpy.clock import Clock, ClockType
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
    from rclpy.parameter import Parameter
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
    from rclpy.time import Duration, Time
    from sensor_msgs.msg import LaserScan as LaserScanMessage
    from std_srvs.srv import Trigger
except ImportError as error:
    _REASON = (
        f"the node needs ROS 2 ({error.name or error} is missing): source "
        "/opt/ros/DISTRO/setup.bash where ROS 2 is installed, else see docs/robot.md for wheels"
    )
    if __name__ == "__main__":
        raise SystemExit(f"error: {_REASON}") from None
    raise AnchorscanError(_REASON) from None

try:  # part of every ROS 2 installation, but not of the wheels on PyPI
    import tf2_ros
except ImportError:
    tf2_ros = None

__all__ = ["LocalizationNode", "main"]

# A laser that tilts more than this does not see the walls of a plan, radians.
_LEVEL = math.radians(10.0)
_ODOMETRY_DEPTH = 100
# So long a scan waits for odometry that is on its way, seconds, and so often it looks for it.
_PATIENCE, _PAUSE = 0.1, 0.01
# Odometry this much older than now or than a scan has stopped, seconds.
_STOPPED = 1.0
# A report of a scan this much older than the newest one is not where the robot is now, seconds.
_FRESH = 1.0
_NANO = 1e-9
_NAMED_HYPOTHESES = 3

_LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


class _Frames:
    """Where frames are, as tf2 tells; without tf2 nobody tells."""

    def __init__(self, node: LifecycleNode, options: RobotParameters) -> None:
        self._buffer = self._listener = self._broadcaster = None
        if tf2_ros is not None:
            self._buffer = tf2_ros.Buffer()
            self._listener = tf2_ros.TransformListener(self._buffer, node)
            if options.tf_broadcast:
                self._broadcaster = tf2_ros.TransformBroadcaster(node)

    def motion(self, target: str, source: str, when: Any = None) -> NDArray[np.float64] | None:
        """Return the (4, 4) ``T_target_source`` at a time (the latest if None), if known."""
        found = self._found(target, source, when)
        if found is None:
            return None
        place, turn = found.transform.translation, found.transform.rotation
        return matrix_of(np.array([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]))

    def newest(self, target: str, source: str) -> float:
        """Return the time of the latest motion, seconds; minus infinity if none is known."""
        found = self._found(target, source, None)
        return -math.inf if found is None else _seconds(found.header.stamp)

    def _found(self, target: str, source: str, when: Any) -> Any:
        if self._buffer is None:
            return None
        try:
            return self._buffer.lookup_transform(target, source, when or Time())
        except tf2_ros.TransformException:
            return None

    def broadcast(self, transform: Any) -> None:
        if self._broadcaster is not None:
            self._broadcaster.sendTransform(transform)

    def close(self) -> None:
        if self._listener is not None and hasattr(self._listener, "unregister"):
            self._listener.unregister()
        self._buffer = self._listener = self._broadcaster = None


class LocalizationNode(LifecycleNode):  # type: ignore[misc]
    """Tells where the robot's base is in the map, once or all the time.

    Args:
        autostart: Default of the parameter of that name.
        options: Passed on to the node.
    """

    _newest: Any  # message of a scan

    def __init__(self, *, autostart: bool = False, **options: Any) -> None:
        super().__init__("anchorscan", **options)
        for name, (default, meaning) in RobotParameters.meanings().items():
            value = autostart if name == "autostart" else default
            # The one without a default is a list of numbers.
            value = Parameter.Type.DOUBLE_ARRAY if value is None else value
            self.declare_parameter(name, value, ParameterDescriptor(description=meaning))
        self._options: RobotParameters | None = None
        self._settings: Settings | None = None
        self._mailbox: Mailbox | None = None
        self._worker: threading.Thread | None = None
        self._is_active = False
        self._lock = threading.Lock()  # of robot, report and places
        self._complaining = threading.Lock()  # of changes to complaints
        self._forget()

    # Transitions

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, open the set or wait for a map, and compile everything."""
        self._forget()
        try:
            options = self._read_parameters()
            settings = options.settings()
            if options.set_file:
                places = ReferenceSet.open(options.set_file, settings=settings)
                if not len(places):
                    raise SettingsError(f"{options.set_file} holds no references")
                if all(each.pose is None for each in places.references):
                    raise SettingsError(f"{options.set_file} has no poses in a common frame")
            else:
                places = ReferenceSet(settings=settings)
            localizer = Localizer(places)  # refuses settings that make no map
            places.prepare()
            localizer.prepare()
            if options.set_file:
                self._adopt(places)
        except AnchorscanError as error:
            self.get_logger().error(f"not configured: {error}")
            return TransitionCallbackReturn.FAILURE
        self._options = options
        self._settings = settings
        self._connect(options)
        self._mailbox = Mailbox(options.queue_size)
        self._worker = threading.Thread(target=self._work, args=(self._mailbox,), daemon=True)
        self._worker.start()
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to locate, as if nothing had been known before."""
        result = super().on_activate(state)
        with self._lock:
            self._start_over()
        self._is_active = True
        self._newest = None  # heard before, and the robot may have been carried away meanwhile
        self._activated = self._heard = time.monotonic()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop locating; the map is kept."""
        self._is_active = False
        if self._mailbox is not None:
            self._mailbox.forget_scans()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of everything."""
        self._disconnect()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of everything for good."""
        self._disconnect()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of everything, so that the node can be configured anew."""
        self._disconnect()
        return TransitionCallbackReturn.SUCCESS

    def destroy_node(self) -> None:
        """End the worker before what it publishes with."""
        self._disconnect()
        super().destroy_node()

    def _forget(self) -> None:
        """Know nothing, as before the first configuration."""
        self._places: ReferenceSet | None = None
        self._robot: Robot | None = None
        self._report: Report | None = None
        self._report_stamp: Any = None  # of the report, as the message of its scan gave it
        self._frames: _Frames | None = None
        self._map_digest = b""
        self._laser_frame = ""
        self._newest = None
        self._activated = self._heard = self._odometry_heard = -math.inf
        self._seconds = math.nan
        self._counts = {"scans": 0, "located": 0, "unusable": 0}
        # What is wrong with a topic, by its name; mended by the next good message.  Never changed
        # but replaced: one thread changes what another goes through.
        self._complaints: Mapping[str, str] = {}

    def _read_parameters(self) -> RobotParameters:
        values: dict[str, Any] = {}
        for name in RobotParameters.meanings():
            parameter = self.get_parameter_or(name, None)
            values[name] = None if parameter is None else parameter.value
        options = RobotParameters(**values)
        if options.tf_broadcast and tf2_ros is None:
            raise SettingsError("tf_broadcast needs tf2_ros, which is not installed")
        return options

    def _connect(self, options: RobotParameters) -> None:
        best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        many = QoSProfile(depth=_ODOMETRY_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._frames = _Frames(self, options)
        publisher = self.create_lifecycle_publisher
        self._initial_pose = publisher(PoseWithCovarianceStamped, options.initial_pose_topic, 1)
        self._hypotheses = publisher(PoseArray, "~/hypotheses", 1)
        self._pose = publisher(PoseWithCovarianceStamped, "~/pose", 1)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 1)
        self._subscriptions_here = [
            # First odometry: of messages that wait, those of the first subscription come first.
            self.create_subscription(
                OdometryMessage, options.odom_topic, self._take_odometry, many
            ),
            self.create_subscription(
                LaserScanMessage, options.scan_topic, self._take_scan, best_effort
            ),
        ]
        if not options.set_file:
            self._subscriptions_here.append(
                self.create_subscription(
                    OccupancyGridMessage, options.map_topic, self._take_map, _LATCHED
                )
            )
        self._services_here = [
            self.create_service(Trigger, "~/locate", self._locate_now),
            self.create_service(Trigger, "~/start_over", self._start_over_now),
        ]
        # The robot's clock may stand still, and just then diagnostics are wanted.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(options.diagnostics_period, self._diagnose, clock=steady)

    def _disconnect(self) -> None:
        self._is_active = False
        if self._options is None:
            return
        self._options = None
        if self._mailbox is not None and self._worker is not None:
            self._mailbox.close()
            self._worker.join()
        self._mailbox = self._worker = None
        self.destroy_timer(self._timer)
        for service in self._services_here:
            self.destroy_service(service)
        for subscription in self._subscriptions_here:
            self.destroy_subscription(subscription)
        for publisher in (self._initial_pose, self._hypotheses, self._pose):
            self.destroy_lifecycle_publisher(publisher)
        self.destroy_publisher(self._diagnostics)
        if self._frames is not None:
            self._frames.close()
        if self._places is not None:
            self._places.close()
        self._forget()

    # Messages, in the executor's thread

    def _take_scan(self, message: Any) -> None:
        if not self._is_active or self._mailbox is None:
            return
        self._heard = time.monotonic()
        self._newest = message
        self._counts["scans"] += 1
        with self._lock:
            if self._robot is not None:
                self._robot.watch_clock(self._stamp(message))
        if self._wants_scans():
            self._mailbox.put_scan(message)

    def _wants_scans(self) -> bool:
        options, robot = self._options, self._robot
        return options is not None and (
            options.continuous or robot is None or not robot.is_announced
        )

    def _take_odometry(self, message: Any) -> None:
        options, robot = self._options, self._robot
        if options is None or robot is None:
            return
        frame = frame_name(message.header.frame_id)
        if frame != frame_name(options.odom_frame_id):
            self._complain(
                "odometry", f"is in frame {frame!r}, not in odom_frame_id {options.odom_frame_id!r}"
            )
            return
        T_odom_base = _planar_pose(message.pose.pose)
        if T_odom_base is None:
            self._complain("odometry", "holds no pose")
            return
        self._mend("odometry")
        self._odometry_heard = time.monotonic()
        robot.odometry.add(_seconds(message.header.stamp), T_odom_base)

    def _take_map(self, message: Any) -> None:
        if self._mailbox is not None:
            self._mailbox.put_map(message)

    def _locate_now(self, request: Any, response: Any) -> Any:
        """Locate the newest scan by itself, and tell the pose if it can be trusted."""
        response.success, response.message = self._located_now()
        return response

    def _located_now(self) -> tuple[bool, str]:
        options, places, message = self._options, self._places, self._newest
        if not self._is_active or options is None:
            return False, "the node is not active"
        if places is None:
            return False, f"there is no map yet{self._reason('map')}"
        age = time.monotonic() - self._heard
        if message is None or age > options.scan_timeout:
            return False, f"no scan on {options.scan_topic} for {options.scan_timeout:g} s"
        try:
            scan, T_base_laser = self._scan(message)
        except ScanError as error:
            return False, f"the newest scan is unusable: {error}"
        with self._lock:
            robot, last, last_stamp = self._robot, self._report, self._report_stamp
            doubt = "" if robot is None else robot.doubt
        if doubt:
            return False, f"the laser {doubt}"
        odometry, stamp = None if robot is None else robot.odometry, message.header.stamp
        report = Robot(SingleScans(places), odometry).take(scan, self._stamp(message), T_base_laser)
        assert report is not None
        # An idle node takes no scans: then the last report is of a place left long ago.
        is_fresh = last is not None and abs(report.stamp - last.stamp) <= _FRESH
        if report.state != "located" and last is not None and last.state == "located" and is_fresh:
            report, stamp = last, last_stamp
        if report.state == "located":
            self._announce(robot, report, stamp)
        return report.state == "located", _in_words(report)

    def _start_over_now(self, request: Any, response: Any) -> Any:
        """Forget where the robot is, and tell its pose again when it is known again."""
        with self._lock:
            self._start_over()
        response.success, response.message = True, "starting over"
        return response

    def _start_over(self) -> None:
        self._report = None
        self._laser_frame = ""
        if self._robot is not None:
            self._robot.odometry.clear()
            self._robot.start_over()

    # Work, in the worker's thread

    def _work(self, mailbox: Mailbox) -> None:
        while True:
            try:
                message = mailbox.take()
                if isinstance(message, OccupancyGridMessage):
                    self._use_map(message, mailbox)
                elif self._is_active and self._wants_scans():
                    self._use_scan(message)
            except Closed:
                return
            except Exception:  # a robot must not stand still for a mistake of ours
                self.get_logger().error(traceback.format_exc())
                self._complain("node", "met an error of its own; its log tells")

    def _use_map(self, message: Any, mailbox: Mailbox) -> None:
        """Prepare to locate in a map, unless it is the one that is used already."""
        options = self._options
        if options is None or (options.first_map_only and self._places is not None):
            return
        frame = frame_name(message.header.frame_id)
        if frame != frame_name(options.global_frame_id):
            self._complain(
                "map", f"is in frame {frame!r}, not in global_frame_id {options.global_frame_id!r}"
            )
            return
        digest = _digest(message)
        if digest == self._map_digest:
            self._mend("map")
            return
        begin = time.monotonic()
        try:
            scans = reference_scans(
                _grid(message), spacing=options.map_spacing, radius=options.robot_radius
            )
            places = ReferenceSet.build(
                mailbox.while_open(scans), keep_all=True, settings=self._settings
            )
        except AnchorscanError as error:
            self._complain("map", f"is unusable: {error}")
            return
        places.prepare()
        self._map_digest = digest
        self._mend("map")
        self._adopt(places)
        self.get_logger().info(
            f"locating in a map of {message.info.width} x {message.info.height} cells by "
            f"{len(places)} references, made in {time.monotonic() - begin:.1f} s"
        )

    def _adopt(self, places: ReferenceSet) -> None:
        """Locate among other references from now on, with nothing known in them."""
        with self._lock:
            odometry = None if self._robot is None else self._robot.odometry
            self._places = places
            self._robot = Robot(Localizer(places), odometry, MirrorWatch(places))
            self._report = None

    def _use_scan(self, message: Any) -> None:
        try:
            scan, T_base_laser = self._scan(message)
        except ScanError as error:
            self._counts["unusable"] += 1
            self._complain("scan", f"is unusable: {error}")
            return
        self._mend("scan")
        if (waiting := self._robot) is not None:
            self._await_odometry(waiting, message)
        begin = time.perf_counter()
        with self._lock:
            robot = self._robot
            if robot is None:
                return
            report = robot.take(scan, self._stamp(message), T_base_laser)
            self._seconds = time.perf_counter() - begin
            if report is None:
                return
            self._report, self._report_stamp = report, message.header.stamp
            doubt = robot.doubt
        if doubt:
            self._complain("laser", f"{doubt}; see /tf, or laser_is_upside_down")
        else:
            self._mend("laser")
        self._tell(robot, report, message.header.stamp)

    def _scan(self, message: Any) -> tuple[LaserScan, Pose2D]:
        """Return the scan seen from above, and where its laser sits on the base.

        Raises:
            ScanError: The message is no scan, or where the laser sits is not known.
        """
        options = self._options
        if options is None:
            raise ScanError("the node is not configured")
        T_base_laser, is_upside_down = self._mounting(frame_name(message.header.frame_id), options)
        scan = scan_from_message(
            message,
            range_min=options.laser_min_range if options.laser_min_range >= 0.0 else None,
            range_max=options.laser_max_range if options.laser_max_range > 0.0 else None,
            is_upside_down=is_upside_down,
        )
        if not scan.is_return.any():
            raise ScanError("no reading is a return")
        return scan, T_base_laser

    def _mounting(self, frame: str, options: RobotParameters) -> tuple[Pose2D, bool]:
        base = frame_name(options.base_frame_id)
        motion = None if self._frames is None else self._frames.motion(base, frame)
        if motion is None and frame == base:
            motion = np.eye(4)
        if motion is not None:
            angle = tilt(motion)
            if _LEVEL < angle < math.pi - _LEVEL:
                raise ScanError(f"the laser ({frame}) is tilted by {math.degrees(angle):.0f} deg")
            return planar(motion), angle > 0.5 * math.pi
        if options.laser_pose is None:
            where = "/tf does not tell" if tf2_ros else "tf2_ros is not installed; set laser_pose"
            raise ScanError(f"where {frame!r} sits on {base!r} is not known: {where}")
        # The parameter speaks of one laser, the first that is heard.
        self._laser_frame = self._laser_frame or frame
        if frame != self._laser_frame:
            raise ScanError(
                f"it is of frame {frame!r}; laser_pose is that of {self._laser_frame!r}"
            )
        return Pose2D(*options.laser_pose), options.laser_is_upside_down

    def _await_odometry(self, robot: Robot, message: Any) -> None:
        """Have odometry come as far as a scan: by its topic or, where that is silent, by tf2.

        Never by both: what filters tell tf2 drifts otherwise than the wheels do.
        """
        stamp = self._stamp(message)
        if time.monotonic() - self._odometry_heard < _STOPPED:
            robot.odometry.wait_until(stamp, _PATIENCE)
            return
        motion = self._motion_from_tf(message.header.stamp, stamp)
        if motion is not None:
            robot.odometry.add(stamp, planar(motion))
        elif self._odometry_heard > -math.inf:  # the topic was silent, and may go on just now
            robot.odometry.wait_until(stamp, _PATIENCE)

    def _motion_from_tf(self, when: Any, stamp: float) -> NDArray[np.float64] | None:
        """Return the (4, 4) ``T_odom_base`` at the time of a scan, if tf2 comes to know it."""
        options, frames = self._options, self._frames
        if frames is None or options is None:
            return None
        odom, base = options.odom_frame_id, options.base_frame_id
        end = time.monotonic() + _PATIENCE
        while True:
            motion = frames.motion(odom, base, Time.from_msg(when))
            if motion is not None or time.monotonic() > end:
                return motion
            if not 0.0 < stamp - frames.newest(odom, base) < _STOPPED:
                return None  # it is not on its way
            time.sleep(_PAUSE)

    def _stamp(self, message: Any) -> float:
        """Seconds of a message; of one without a time the node's own."""
        stamp = _seconds(message.header.stamp)
        return stamp if stamp else self.get_clock().now().nanoseconds * _NANO

    # What is told

    def _tell(self, robot: Robot, report: Report, stamp: Any) -> None:
        options = self._options
        if not self._is_active or options is None:
            return
        if report.hypotheses:
            array = PoseArray()
            array.header.frame_id, array.header.stamp = options.global_frame_id, stamp
            array.poses = [_pose_message(place) for place, _ in report.hypotheses]
            self._hypotheses.publish(array)
        if report.state != "located":
            return
        self._counts["located"] += 1
        if not robot.is_announced and self._initial_pose.get_subscription_count():
            self._announce(robot, report, stamp)
        if options.continuous:
            self._pose.publish(_pose_with_covariance(report, options.global_frame_id, stamp))
            self._broadcast(report, stamp, options)

    def _announce(self, robot: Robot | None, report: Report, stamp: Any) -> None:
        options = self._options
        if options is None:
            return
        self._initial_pose.publish(_pose_with_covariance(report, options.global_frame_id, stamp))
        if robot is not None and self._initial_pose.get_subscription_count():
            robot.is_announced = True
        self.get_logger().info(f"told {options.initial_pose_topic}: {_in_words(report)}")

    def _broadcast(self, report: Report, stamp: Any, options: RobotParameters) -> None:
        if self._frames is None or report.T_map_odom is None or not options.tf_broadcast:
            return
        ahead = Time.from_msg(stamp) + Duration(seconds=options.transform_tolerance)
        transform = TransformStamped()
        transform.header.stamp = ahead.to_msg()
        transform.header.frame_id = options.global_frame_id
        transform.child_frame_id = options.odom_frame_id
        pose = _pose_message(report.T_map_odom)
        transform.transform.translation.x = pose.position.x
        transform.transform.translation.y = pose.position.y
        transform.transform.rotation = pose.orientation
        self._frames.broadcast(transform)

    def _complain(self, topic: str, reason: str) -> None:
        """Say what is wrong with a topic: in the log when it is new, else in diagnostics."""
        with self._complaining:
            is_new = self._complaints.get(topic) != reason
            self._complaints = {**self._complaints, topic: reason}
        if is_new:
            self.get_logger().warning(f"{topic}: {reason}")

    def _mend(self, topic: str) -> None:
        with self._complaining:
            is_mended = topic in self._complaints
            if is_mended:
                left = {each: why for each, why in self._complaints.items() if each != topic}
                self._complaints = left
        if is_mended:
            self.get_logger().info(f"{topic}: all right again")

    def _reason(self, topic: str) -> str:
        reason = self._complaints.get(topic)
        return "" if reason is None else f": the {topic} {reason}"

    def _diagnose(self) -> None:
        options, mailbox = self._options, self._mailbox
        if options is None or mailbox is None:
            return
        complaints = self._complaints
        status = DiagnosticStatus()
        status.name = f"{self.get_name()}: localization"
        status.hardware_id = options.base_frame_id
        status.level, status.message = next(self._summary(options, complaints))
        values: dict[str, Any] = {
            "references": 0 if self._places is None else len(self._places),
            **{f"scans {what}": count for what, count in self._counts.items()},
            "scans dropped": mailbox.dropped,
            "scans late": 0 if self._robot is None else self._robot.late,
            "told": self._robot is not None and self._robot.is_announced,
            "query milliseconds": f"{1e3 * self._seconds:.2f}",
            **{f"problem: {topic}": reason for topic, reason in complaints.items()},
        }
        report = self._report
        if report is not None:
            values["state"] = report.state
            values["probability"] = f"{report.probability:.4f}"
            values["odometry"] = report.T_map_odom is not None
            for number, (place, share) in enumerate(report.hypotheses[:_NAMED_HYPOTHESES]):
                values[f"hypothesis {number}"] = f"{_place_in_words(place)}, {share:.4f}"
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        array = DiagnosticArray()
        array.header.stamp = self.get_clock().now().to_msg()
        array.status = [status]
        self._diagnostics.publish(array)

    def _summary(
        self, options: RobotParameters, complaints: Mapping[str, str]
    ) -> Iterator[tuple[bytes, str]]:
        """Yield levels and messages; the first is what keeps the robot from being located."""
        ok, warning, error = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
        if not self._is_active:
            yield ok, "inactive"
        if "node" in complaints:
            yield error, f"the node {complaints['node']}"
        if self._places is None and "map" in complaints:
            yield error, f"no map: the map {complaints['map']}"
        if self._places is None:
            yield warning, f"waiting for a map on {options.map_topic}"
        silence = time.monotonic() - self._heard
        if silence > options.scan_timeout:
            yield error, f"no scan on {options.scan_topic} for {silence:.0f} s"
        if "scan" in complaints:
            yield warning, f"the scan {complaints['scan']}"
        if "laser" in complaints:
            yield error, f"the laser {complaints['laser']}"
        if "map" in complaints:
            yield warning, f"the map {complaints['map']}; the old one is used"
        if self._robot is not None and self._robot.is_announced and not options.continuous:
            yield ok, "located and told; idle until asked"
        report = self._report
        if report is None:
            yield warning, "no scan located yet"
        else:
            yield ok if report.state == "located" else warning, _in_words(report)


def main(arguments: Sequence[str] | None = None, *, autostart: bool = False) -> None:
    """Run the node until it is told to end.

    Args:
        arguments: Words of the command line, those of ROS among them; the process's own if None.
        autostart: Default of the parameter of that name.
    """
    rclpy.init(args=None if arguments is None else ["anchorscan", *arguments])
    node = LocalizationNode(autostart=autostart)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        if node.get_parameter("autostart").value:
            if node.trigger_configure() != TransitionCallbackReturn.SUCCESS:
                raise SystemExit(1)
            node.trigger_activate()
        else:
            node.get_logger().info("waiting to be configured and activated")
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


# Conversions


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + stamp.nanosec * _NANO)


def _planar_pose(pose: Any) -> Pose2D | None:
    """Return a pose in space seen from above, None where it is none."""
    place, turn = pose.position, pose.orientation
    motion = matrix_of(np.array([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]))
    return None if motion is None else planar(motion)


def _grid(message: Any) -> OccupancyGrid:
    """Return the map that a message holds.

    Raises:
        LogError: It holds none.
    """
    origin = _planar_pose(message.info.origin)
    if origin is None:
        raise LogError("its origin is no pose")
    info = message.info
    return OccupancyGrid.from_message(
        np.asarray(message.data), info.width, info.height, float(info.resolution), origin
    )


def _digest(message: Any) -> bytes:
    """Tell one map from another, not by its time."""
    info, place, turn = message.info, message.info.origin.position, message.info.origin.orientation
    shape = (info.width, info.height, info.resolution, place.x, place.y, turn.z, turn.w)
    return hashlib.blake2b(bytes(message.data) + repr(shape).encode(), digest_size=16).digest()


def _pose_message(pose: Pose2D) -> Any:
    message = Pose()
    message.position.x, message.position.y = pose.x, pose.y
    message.orientation.z = math.sin(0.5 * pose.theta)
    message.orientation.w = math.cos(0.5 * pose.theta)
    return message


def _pose_with_covariance(report: Report, frame: str, stamp: Any) -> Any:
    assert report.T_map_base is not None
    message = PoseWithCovarianceStamped()
    message.header.frame_id, message.header.stamp = frame, stamp
    message.pose.pose = _pose_message(report.T_map_base)
    spread = np.zeros((6, 6))
    of_plane = np.ix_((0, 1, 5), (0, 1, 5))
    spread[of_plane] = report.covariance
    message.pose.covariance = spread.reshape(-1)
    return message


def _in_words(report: Report) -> str:
    if report.state == "located" and report.T_map_base is not None:
        deviation = np.sqrt(np.diag(report.covariance))
        return (
            f"located at {_place_in_words(report.T_map_base)}, probability "
            f"{report.probability:.3f}, within {deviation[0]:.2f} m, {deviation[1]:.2f} m, "
            f"{math.degrees(deviation[2]):.1f} deg"
        )
    places = "; ".join(
        f"{_place_in_words(place)} ({share:.3f})"
        for place, share in report.hypotheses[:_NAMED_HYPOTHESES]
    )
    meaning = "several places look alike" if report.state == "ambiguous" else "not known where"
    return f"{report.state}: {meaning}; best guesses: {places or 'none'}"


def _place_in_words(pose: Pose2D) -> str:
    return f"{pose.x:.2f} m, {pose.y:.2f} m, {math.degrees(pose.theta):.1f} deg"


if __name__ == "__main__":
    main(sys.argv[1:])
