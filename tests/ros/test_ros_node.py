"""The node on the wire: it and a player are processes, and nothing but messages passes between.

Run by ``make ros-test``, in an environment of its own with ROS 2; skipped elsewhere.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anchorscan import (
    OccupancyGrid,
    Pose2D,
    Record,
    ReferenceSet,
    SensorModel,
    drive,
    load_map,
    open_log,
    random_building,
    reference_scans,
)
from anchorscan.simulator import rasterise

if not os.environ.get("ANCHORSCAN_REQUIRE_ROS"):
    pytest.importorskip("rclpy", reason="needs ROS 2; run by make ros-test")

# A domain of one's own, and no packet that leaves the machine.
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

sys.path.insert(0, str(Path(__file__).parent))

import rclpy
from stand_ins.tf2_ros import LASER
from wire import Observer, Process, node, observing, player

START = 1_700_000_000.0
MOUNTING = Pose2D(0.2, 0.05, math.radians(90.0))
LIDAR = SensorModel(
    math.radians(270.0), math.radians(0.5), range_max=20.0, noise=0.01, mounting=MOUNTING
)
OTHER = SensorModel(
    2.0 * math.pi, math.radians(1.0), range_max=12.0, noise=0.02, clockwise=True, mounting=MOUNTING
)
LASER_POSE = [MOUNTING.x, MOUNTING.y, MOUNTING.theta]


class Recording:
    """A drive in a file that the player reads, and the truth about it."""

    def __init__(
        self, path: Path, records: list[Record], T_base_laser: Pose2D, begin: float = START
    ) -> None:
        self.path = str(path)
        self.stamps = np.array([begin + float(record.stamp or 0.0) for record in records])
        self.truth = [
            None if record.pose is None else record.pose @ T_base_laser.inverse()
            for record in records
        ]
        scans = [record.scan for record in records]
        first = scans[0]
        assert first is not None
        moved = [
            [math.nan] * 3
            if record.odometry is None
            else (record.odometry @ T_base_laser.inverse()).to_array()
            for record in records
        ]
        np.savez(
            path,
            ranges=np.array([scan.ranges for scan in scans if scan is not None]),
            geometry=[first.angle_min, first.angle_increment, first.range_min, first.range_max],
            stamps=self.stamps,
            odometry=np.array(moved),
        )

    def is_right(self, message: Any, offset: float = 0.0) -> bool:
        """Tell whether a pose is that of the base at its time."""
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec - offset
        nearest = int(np.argmin(np.abs(self.stamps - stamp)))
        truth = self.truth[nearest]
        assert truth is not None
        assert abs(self.stamps[nearest] - stamp) < 1e-3
        pose = plane(message.pose.pose)
        return pose.distance(truth) < 0.5 and pose.turn(truth) < math.radians(10.0)


def plane(pose: Any) -> Pose2D:
    turn = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
    return Pose2D(pose.position.x, pose.position.y, turn)


def save_map(path: Path, grid: OccupancyGrid) -> str:
    np.savez(path, data=grid.data, resolution=grid.resolution, origin=grid.origin.to_array())
    return str(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("ros")


@pytest.fixture(scope="module")
def office(folder: Path) -> OccupancyGrid:
    return rasterise(random_building(3, length=24.0, depth=16.0), 0.05)


@pytest.fixture(scope="module")
def map_file(folder: Path, office: OccupancyGrid) -> str:
    return save_map(folder / "office.npz", office)


@pytest.fixture(scope="module")
def recording(folder: Path) -> Recording:
    building = random_building(3, length=24.0, depth=16.0)
    records = drive(building, LIDAR, seed=1, length=30.0, step=0.25)
    return Recording(folder / "drive.npz", records, MOUNTING)


@pytest.fixture(scope="module")
def other_recording(folder: Path) -> Recording:
    building = random_building(3, length=24.0, depth=16.0)
    records = drive(building, OTHER, seed=2, length=15.0, step=0.25)
    return Recording(folder / "other.npz", records, MOUNTING)


@pytest.fixture(scope="module")
def ros() -> Iterator[None]:
    # Compile once here, without a limit of time, what the nodes then take from the cache.
    with ReferenceSet() as places:
        places.prepare()
    rclpy.init()
    yield
    rclpy.shutdown()


@pytest.fixture
def observer(ros: None) -> Iterator[Observer]:
    with observing() as opened:
        yield opened


Start = Callable[..., Process]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start nodes and players that end with the test."""
    started: list[Process] = []

    def begin(make: Callable[..., Process] = node, **options: Any) -> Process:
        started.append(make(tmp_path, **options))
        return started[-1]

    yield begin
    for process in started:
        process.close()
    for process in started:
        log = process.log.read_text(encoding="utf-8")
        assert "Traceback" not in log, log


def awake(observer: Observer) -> None:
    assert observer.change("configure")
    assert observer.change("activate")


def play_until_told(
    observer: Observer,
    robot: Process,
    recording: Recording,
    count: int,
    *,
    first: int = 0,
    **options: Any,
) -> None:
    """Play on until so many poses were told: a busy machine loses most of the scans."""
    for begin in range(first, len(recording.stamps), 10):
        robot.tell(do="play", file=recording.path, first=begin, last=begin + 10, **options)
        if len(observer.heard["initialpose"]) >= count:
            return
    observer.wait(lambda: len(observer.heard["initialpose"]) >= count, f"no pose {count}")


def test_a_lifecycle_from_birth_to_death(observer: Observer, start: Start) -> None:
    process = start(laser_pose=LASER_POSE)
    assert observer.state() == "unconfigured"
    observer.set_parameter("laser_pose", [1.0])
    assert not observer.change("configure")
    assert observer.state() == "unconfigured"
    observer.set_parameter("laser_pose", LASER_POSE)
    observer.set_parameter("tf_broadcast", True)
    assert not observer.change("configure"), "a transform cannot be told without tf2"
    observer.set_parameter("tf_broadcast", False)
    for expected, transition in (
        ("inactive", "configure"),
        ("active", "activate"),
        ("inactive", "deactivate"),
        ("active", "activate"),
        ("inactive", "deactivate"),
        ("unconfigured", "cleanup"),
        ("inactive", "configure"),
        ("unconfigured", "cleanup"),
        ("finalized", "shutdown"),
    ):
        assert observer.change(transition), transition
        assert observer.state() == expected
    assert process.end() == 0


def test_a_set_that_is_none_keeps_the_node_from_being_configured(
    observer: Observer, start: Start, tmp_path: Path
) -> None:
    (tmp_path / "office.apr").write_text("no set")
    process = start(set_file=str(tmp_path / "office.apr"))
    assert not observer.change("configure")
    assert observer.state() == "unconfigured"
    assert "not configured" in process.log.read_text(encoding="utf-8")


def test_a_robot_finds_itself_when_the_map_comes_late(
    observer: Observer, start: Start, recording: Recording, map_file: str
) -> None:
    start(laser_pose=LASER_POSE, base_frame_id="base_footprint")
    robot = start(player)
    observer.listen()
    awake(observer)
    robot.tell(do="play", file=recording.path, last=10)
    observer.says("waiting for a map")
    assert observer.trigger("locate") == (False, "there is no map yet")
    assert robot.tell(do="map", file=map_file) == 1
    observer.wait(lambda: observer.values()["references"] != "0", "no references")
    play_until_told(observer, robot, recording, 1, first=10)

    told = observer.heard["initialpose"][0]
    assert told.header.frame_id == "map"
    assert recording.is_right(told)
    covariance = np.reshape(told.pose.covariance, (6, 6))
    assert np.allclose(covariance, covariance.T)
    deviations = np.sqrt(np.diag(covariance)[[0, 1, 5]])
    assert (deviations > 1e-4).all()
    assert (deviations < 0.5).all()
    assert not covariance[[2, 3, 4]].any()
    hypotheses = next(
        each for each in observer.heard["hypotheses"] if each.header.stamp == told.header.stamp
    )
    assert hypotheses.header.frame_id == "map"
    assert plane(hypotheses.poses[0]).distance(plane(told.pose.pose)) < 1e-6

    # Once is once, until somebody asks.
    observer.says("located and told")
    robot.tell(do="play", file=recording.path, first=70, last=90)
    assert len(observer.heard["initialpose"]) == 1
    success, words = observer.trigger("locate")
    assert success
    assert "located at" in words
    observer.wait(lambda: len(observer.heard["initialpose"]) == 2, "no second pose")
    assert observer.trigger("start_over")[0]
    play_until_told(observer, robot, recording, 3, first=90)
    assert all(recording.is_right(message) for message in observer.heard["initialpose"])


def test_nothing_is_told_before_anybody_listens(
    observer: Observer, start: Start, recording: Recording, map_file: str
) -> None:
    start(laser_pose=LASER_POSE)
    robot = start(player)
    robot.tell(do="map", file=map_file)
    awake(observer)
    observer.wait(lambda: observer.values().get("references", "0") != "0", "no references")
    robot.tell(do="play", file=recording.path, last=20)
    observer.says("located at")
    assert observer.values()["told"] == "False"
    observer.listen()
    time.sleep(1.0)
    play_until_told(observer, robot, recording, 1, first=20)
    assert recording.is_right(observer.heard["initialpose"][0])


def test_what_is_in_the_wrong_frame_is_refused_and_named(
    observer: Observer, start: Start, recording: Recording, map_file: str
) -> None:
    start(laser_pose=LASER_POSE, global_frame_id="floor_2", continuous=True)
    robot = start(player)
    observer.listen()
    awake(observer)
    robot.tell(do="map", file=map_file, frame="map")
    observer.says("'map', not in global_frame_id 'floor_2'")
    robot.tell(do="play", file=recording.path, last=5)
    assert observer.heard["initialpose"] == []
    robot.tell(do="map", file=map_file, frame="floor_2", resolution=-1.0)
    observer.says("resolution must be positive")
    robot.tell(do="map", file=map_file, frame="floor_2", width=7)
    observer.says("cells with")
    robot.tell(do="map", file=map_file, frame="floor_2")
    observer.wait(lambda: observer.values()["references"] != "0", "no references")
    robot.tell(do="play", file=recording.path, first=5, last=20, odom_frame="wheels")
    observer.wait(lambda: "problem: odometry" in observer.values(), "nothing about odometry")
    assert "'wheels'" in observer.values()["problem: odometry"]
    robot.tell(do="garbage_odometry", offset=START)
    robot.tell(do="play", file=recording.path, first=20, last=30, frame="another_laser")
    observer.says("'another_laser'")
    robot.tell(do="play", file=recording.path, first=30, last=50)
    observer.says("located at")
    assert "problem: odometry" not in observer.values()
    assert observer.values()["odometry"] == "True"
    assert {message.header.frame_id for message in observer.heard["pose"]} == {"floor_2"}
    assert all(recording.is_right(message) for message in observer.heard["pose"])


def test_garbage_is_counted_named_and_survived(
    observer: Observer, start: Start, recording: Recording, map_file: str
) -> None:
    from player import GARBAGE

    start(laser_pose=LASER_POSE)
    robot = start(player)
    observer.listen()
    robot.tell(do="map", file=map_file)
    awake(observer)
    observer.wait(lambda: observer.values().get("references", "0") != "0", "no references")
    refused = set()
    for number, kind in enumerate(GARBAGE):
        # Best effort loses messages: tell it again until it is heard.
        for attempt in range(20):
            before = observer.values()
            stamp = -1000.0 + 20.0 * number + attempt
            robot.tell(do="garbage", file=recording.path, kind=kind, offset=stamp)
            time.sleep(0.4)
            if observer.values()["scans scans"] != before["scans scans"]:
                break
        else:
            raise AssertionError(f"{kind!r} is not heard")
        if observer.values()["scans unusable"] != before["scans unusable"]:
            assert observer.values()["problem: scan"]
            refused.add(kind)
    # These two are scans, if strange ones.
    assert set(GARBAGE) - refused <= {"one reading", "fifteen thousand readings"}
    assert observer.heard["initialpose"] == []
    play_until_told(observer, robot, recording, 1)
    assert recording.is_right(observer.heard["initialpose"][0])


def test_a_laser_upside_down_is_named_and_nothing_is_told(
    observer: Observer, start: Start, recording: Recording, map_file: str
) -> None:
    start(laser_pose=LASER_POSE, laser_is_upside_down=True)  # it stands
    robot = start(player)
    observer.listen()
    robot.tell(do="map", file=map_file)
    awake(observer)
    observer.wait(lambda: observer.values().get("references", "0") != "0", "no references")
    robot.tell(do="play", file=recording.path, first=0, last=len(recording.stamps))
    observer.wait(lambda: "mirror" in observer.values().get("problem: laser", ""), "no complaint")
    assert observer.heard["initialpose"] == []


def test_another_sensor_and_a_clock_that_goes_back(
    observer: Observer,
    start: Start,
    recording: Recording,
    other_recording: Recording,
    map_file: str,
) -> None:
    start(laser_pose=LASER_POSE)
    robot = start(player)
    observer.listen()
    robot.tell(do="map", file=map_file)
    awake(observer)
    observer.wait(lambda: observer.values().get("references", "0") != "0", "no references")
    play_until_told(observer, robot, recording, 1)
    # A robot that is killed, and another that begins again, earlier and with another sensor.
    robot.kill()
    robot = start(player)
    robot.tell(do="map", file=map_file)
    play_until_told(observer, robot, other_recording, 2, offset=-5_000.0)
    first, second = observer.heard["initialpose"]
    assert recording.is_right(first)
    assert other_recording.is_right(second, offset=-5_000.0)


def test_a_killed_node_comes_back_and_finds_the_map(
    observer: Observer, start: Start, recording: Recording, map_file: str
) -> None:
    process = start(laser_pose=LASER_POSE)
    robot = start(player)
    observer.listen()
    robot.tell(do="map", file=map_file)
    awake(observer)
    play_until_told(observer, robot, recording, 1)
    process.kill()
    observer.heard["diagnostics"].clear()
    # Started as a user does, it needs nobody to wake it.
    process = start(command=True, laser_pose=LASER_POSE)
    observer.says("no scan")
    assert observer.state() == "active"
    observer.wait(lambda: observer.values().get("references", "0") != "0", "no references")
    play_until_told(observer, robot, recording, 2, first=40)
    assert all(recording.is_right(message) for message in observer.heard["initialpose"])
    assert process.end() == 0


def test_a_new_map_is_used_and_the_same_one_is_not_made_twice(
    observer: Observer, start: Start, recording: Recording, map_file: str, folder: Path
) -> None:
    process = start(laser_pose=LASER_POSE, continuous=True)
    robot = start(player)
    observer.listen()
    other = rasterise(random_building(4, length=24.0, depth=16.0), 0.05)
    robot.tell(do="map", file=save_map(folder / "other-map.npz", other))
    awake(observer)
    observer.wait(lambda: observer.values().get("references", "0") != "0", "no references")
    robot.tell(do="play", file=recording.path, last=15)
    assert observer.heard["initialpose"] == []
    before = observer.values()["references"]
    robot.tell(do="map", file=map_file)
    observer.wait(lambda: observer.values()["references"] != before, "the old map is used")
    robot.tell(do="map", file=map_file)
    play_until_told(observer, robot, recording, 1, first=15)
    assert recording.is_right(observer.heard["initialpose"][0])
    assert process.log.read_text(encoding="utf-8").count("locating in a map") == 2


def test_a_flood_of_scans_builds_up_no_delay(
    observer: Observer, start: Start, recording: Recording, map_file: str
) -> None:
    start(laser_pose=LASER_POSE, continuous=True, preset="thorough")
    robot = start(player)
    robot.tell(do="map", file=map_file)
    awake(observer)
    observer.wait(lambda: observer.values().get("references", "0") != "0", "no references")
    length = float(recording.stamps[-1] - recording.stamps[0]) + 1.0
    for turn in range(3):
        last = robot.tell(
            do="play", file=recording.path, rate=2_000.0, offset=length * turn, odometry=False
        )
    begin = time.monotonic()

    def is_answered() -> bool:
        stamp = observer.heard["hypotheses"][-1].header.stamp
        return abs(stamp.sec + 1e-9 * stamp.nanosec - last) < 1.0

    observer.wait(is_answered, "the newest scan is not answered", 3.0)
    assert time.monotonic() - begin < 3.0
    assert len(observer.heard["hypotheses"]) < 3 * len(recording.stamps)


def test_a_set_file_takes_the_place_of_a_map(
    observer: Observer,
    start: Start,
    recording: Recording,
    office: OccupancyGrid,
    tmp_path: Path,
) -> None:
    path = tmp_path / "office.apr"
    ReferenceSet.build(reference_scans(office), keep_all=True, path=path).close()
    start(laser_pose=LASER_POSE, set_file=str(path), scan_topic="front/scan")
    # The same topics by other names, as a launch file would give them.
    robot = start(player)
    observer.listen()
    awake(observer)
    robot.tell(do="play", file=recording.path, last=5, heard=False)
    assert observer.values()["scans scans"] == "0"
    robot.kill()
    assert observer.change("deactivate")
    assert observer.change("cleanup")
    observer.set_parameter("scan_topic", "scan")
    awake(observer)
    robot = start(player)
    play_until_told(observer, robot, recording, 1, first=5)
    assert recording.is_right(observer.heard["initialpose"][0])


def test_where_tf2_is_the_mounting_and_the_transform_to_odom_are_its_own(
    observer: Observer, start: Start, office: OccupancyGrid, map_file: str, folder: Path
) -> None:
    """With a stand-in for tf2_ros, which has no wheels; the laser hangs upside down."""
    hanging = SensorModel(
        math.radians(240.0), math.radians(0.5), range_max=20.0, noise=0.01, mounting=Pose2D(*LASER)
    )
    building = random_building(3, length=24.0, depth=16.0)
    records = drive(building, hanging, seed=7, length=15.0)
    recording = Recording(folder / "hanging.npz", records, hanging.mounting)
    kept = dict(np.load(recording.path))
    # Seen from below, the sense of rotation is the other one.
    kept["geometry"][:2] *= -1.0
    np.savez(recording.path, **kept)
    start(tf2=True, continuous=True, tf_broadcast=True, transform_tolerance=0.5)
    robot = start(player)
    observer.listen()
    robot.tell(do="map", file=map_file)
    awake(observer)
    observer.wait(lambda: observer.values().get("references", "0") != "0", "no references")
    robot.tell(do="play", file=recording.path, last=5, frame="leaning_laser")
    observer.says("tilted by 34 deg")
    robot.tell(do="play", file=recording.path, first=5, last=8, frame="unknown_laser")
    observer.says("where 'unknown_laser' sits on 'base_link' is not known: /tf does not tell")
    robot.tell(do="play", file=recording.path, first=8, last=40, frame="hanging_laser")
    observer.wait(lambda: observer.heard["tf"], "no transform")
    assert recording.is_right(observer.heard["initialpose"][0])
    poses = {time_of(message): plane(message.pose.pose) for message in observer.heard["pose"]}
    told = 0
    for message in observer.heard["tf"]:
        assert (message.header.frame_id, message.child_frame_id) == ("map", "odom")
        shift, turn = message.transform.translation, message.transform.rotation
        T_map_odom = Pose2D(shift.x, shift.y, 2.0 * math.atan2(turn.z, turn.w))
        stamp = time_of(message) - 0.5
        moment = int(np.argmin(np.abs(recording.stamps - stamp)))
        T_odom_base = Pose2D(*kept["odometry"][moment])
        base = min(poses.items(), key=lambda each: abs(each[0] - stamp))[1]
        told += (T_map_odom @ T_odom_base).distance(base) < 0.02
    assert told >= 0.9 * len(observer.heard["tf"])


def time_of(message: Any) -> float:
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)


def test_a_turtlebot_finds_itself_on_a_college_floor(
    observer: Observer, start: Start, tmp_path: Path
) -> None:
    """A real drive, played to the node with the map that others made on another day."""
    data = Path(
        os.environ.get(
            "ANCHORSCAN_DATA", Path(__file__).resolve().parents[2] / ".." / "shared" / "data"
        )
    )
    folder = data / "olin"
    if not folder.exists():
        pytest.skip(f"olin is not in {data}")
    records = [record for record in open_log(folder) if record.odometry is not None]
    mounting = records[0].T_base_laser
    assert mounting is not None
    recording = Recording(tmp_path / "olin.npz", records, mounting, begin=0.0)
    map_file = save_map(tmp_path / "map.npz", load_map(folder / "mac_1st_floor_final.yaml"))
    laser_pose = [mounting.x, mounting.y, mounting.theta]
    start(laser_pose=laser_pose, continuous=True)
    robot = start(player)
    observer.listen()
    robot.tell(do="map", file=map_file)
    awake(observer)
    observer.wait(lambda: observer.values().get("references", "0") != "0", "no references")
    robot.tell(do="play", file=recording.path, rate=25.0)
    hypotheses = list(observer.heard["hypotheses"])
    assert len(hypotheses) >= 100
    from anchorscan.map_check import rigid_track

    stamps = [time_of(message) for message in hypotheses]
    moments = [int(np.argmin(np.abs(recording.stamps - stamp))) for stamp in stamps]
    moved = np.load(recording.path)["odometry"]
    T_map_odom, agrees = rigid_track(
        [plane(message.poses[0]) for message in hypotheses],
        [Pose2D(*moved[moment]) for moment in moments],
    )
    assert T_map_odom is not None
    assert agrees.mean() >= 0.9
    for told in (*observer.heard["initialpose"], *observer.heard["pose"]):
        T_odom_base = Pose2D(*moved[int(np.argmin(np.abs(recording.stamps - time_of(told))))])
        assert plane(told.pose.pose).distance(T_map_odom @ T_odom_base) < 1.0
    assert len(observer.heard["initialpose"]) == 1


def test_without_ros_the_command_says_what_to_install() -> None:
    hidden = "import sys; sys.modules['rclpy'] = None; from anchorscan.cli import main; "
    done = subprocess.run(
        [sys.executable, "-c", hidden + "sys.argv = ['anchorscan', 'ros']; main()"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("error: the node needs ROS 2")
    assert len(done.stderr.splitlines()) == 1
