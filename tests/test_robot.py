"""The robot between its messages and the belief, its mailbox and its parameters; no ROS needed."""

from __future__ import annotations

import math
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anchorscan import (
    Hypothesis,
    LaserScan,
    Pose2D,
    ReferenceSet,
    SensorModel,
    SettingsError,
    drive,
    random_building,
    reference_scans,
)
from anchorscan.localizer import Belief
from anchorscan.mailbox import Closed, Mailbox
from anchorscan.robot import Odometry, Robot, SingleScans, of_base
from anchorscan.robot_parameters import RobotParameters
from anchorscan.simulator import rasterise

ROOT = Path(__file__).resolve().parents[1]
SCAN = LaserScan.from_field_of_view([1.0, 2.0, 3.0], math.pi)
metres = st.floats(-50.0, 50.0)
angles = st.floats(-3.0, 3.0)
poses = st.builds(Pose2D, metres, metres, angles)


class Fixed:
    """A tracker that believes what it is told, and notes what it is fed."""

    def __init__(self, *probabilities: float, accepted: bool = False) -> None:
        self.fed: list[tuple[Pose2D | None, float]] = []
        self.resets = 0
        hypotheses = tuple(
            Hypothesis(0, Pose2D(), Pose2D(5.0 * n, 2.0, 0.5), np.eye(3), 0, 0, 0, p, accepted)
            for n, p in enumerate(probabilities)
        )
        self.belief = Belief(hypotheses, 1.0 - sum(probabilities), accepted)

    def update(
        self, scan: LaserScan, odometry: Pose2D | None, stamp: float, T_base_laser: Pose2D
    ) -> Belief:
        self.fed.append((odometry, stamp))
        return self.belief

    def reset(self) -> None:
        self.resets += 1


# Odometry


@given(start=poses, turn=angles, share=st.floats(0.0, 1.0))
def test_odometry_between_two_messages_lies_between_them(
    start: Pose2D, turn: float, share: float
) -> None:
    odometry = Odometry()
    odometry.add(10.0, start)
    odometry.add(11.0, start @ Pose2D(1.0, 0.5, turn))
    found = odometry.at(10.0 + share)
    assert found is not None
    line = start @ Pose2D(share, 0.5 * share, 0.0)
    assert found.distance(line) < 1e-6
    assert found.turn(Pose2D(0.0, 0.0, start.theta + share * turn)) < 1e-6


def test_odometry_far_from_every_message_is_not_known() -> None:
    odometry = Odometry()
    assert odometry.at(0.0) is None
    odometry.add(10.0, Pose2D(1.0))
    assert odometry.at(9.9) == Pose2D(1.0)
    assert odometry.at(10.2) == Pose2D(1.0)
    assert odometry.at(11.0) is None
    assert odometry.at(9.0) is None


def test_between_messages_far_apart_odometry_is_not_known() -> None:
    odometry = Odometry()
    odometry.add(0.0, Pose2D())
    odometry.add(9.9, Pose2D(9.0))
    assert odometry.at(5.0) is None
    assert odometry.at(0.2) == Pose2D()
    assert odometry.at(9.8) == Pose2D(9.0)
    assert odometry.at(9.9) == Pose2D(9.0)


def test_a_heading_that_jumps_breaks_the_odometry_and_a_fast_turn_does_not() -> None:
    odometry = Odometry()
    odometry.add(0.0, Pose2D(0.2, 0.0, 3.0))
    for k in range(1, 40):  # 4 rad/s, on through the other side
        odometry.add(0.05 * k, Pose2D(0.2, 0.0, 3.0 + 0.2 * k))
    assert odometry.breaks == 0
    before = odometry.at(0.05 * 39)
    assert before is not None
    odometry.add(2.0, Pose2D(0.2, 0.0, before.theta + 3.0))
    assert odometry.breaks == 1


def test_wheels_that_begin_again_from_zero_break_the_odometry() -> None:
    odometry = Odometry()
    odometry.add(10.0, Pose2D(20.0))
    odometry.add(10.1, Pose2D(20.1))
    odometry.add(10.2, Pose2D(0.0))
    assert odometry.breaks == 1
    assert odometry.at(10.1) == Pose2D(0.0)
    # What is late or told twice does no harm, nor does what is no pose.
    odometry.add(10.15, Pose2D(0.05))
    odometry.add(math.nan, Pose2D())
    odometry.add(10.3, Pose2D(math.nan))
    assert odometry.breaks == 1
    # A clock that was set back breaks it as well.
    odometry.add(5.0, Pose2D(0.1))
    assert odometry.breaks == 2
    assert odometry.at(5.0) == Pose2D(0.1)


def test_odometry_forgets_in_bounded_memory() -> None:
    odometry = Odometry()
    for k in range(20_000):
        odometry.add(0.01 * k, Pose2D(0.001 * k))
    assert len(odometry._samples) <= 1_002
    assert odometry.at(1.0) is None
    assert odometry.at(199.0) is not None


# The base


@given(pose=poses, mounting=st.builds(Pose2D, st.floats(-1, 1), st.floats(-1, 1), angles))
def test_a_pose_of_the_laser_becomes_that_of_the_base_with_its_covariance(
    pose: Pose2D, mounting: Pose2D
) -> None:
    root = np.array([[0.05, 0.0, 0.0], [0.02, 0.03, 0.0], [0.004, -0.006, 0.01]])
    T_map_base, covariance = of_base(pose, root @ root.T, mounting)
    assert (T_map_base @ mounting).distance(pose) < 1e-9
    assert (T_map_base @ mounting).turn(pose) < 1e-9
    # The same by small steps, without a formula.
    step = 1e-5
    columns = []
    for axis in np.eye(3):
        moved = Pose2D(*(pose.to_array() + step * axis)) @ mounting.inverse()
        difference = moved.to_array() - T_map_base.to_array()
        difference[2] = math.remainder(difference[2], math.tau)
        columns.append(difference / step)
    slope = np.array(columns).T
    assert covariance == pytest.approx(slope @ root @ root.T @ slope.T, abs=1e-6)


def test_a_robot_with_a_laser_off_its_centre_is_told_where_its_base_is() -> None:
    building = random_building(3, length=24.0, depth=16.0)
    mounting = Pose2D(0.3, -0.1, math.radians(-90.0))
    lidar = SensorModel(math.radians(270.0), math.radians(0.5), mounting=mounting)
    records = drive(building, lidar, seed=5, length=8.0, step=0.4, odometry_noise=0.0)
    places = ReferenceSet.build(reference_scans(rasterise(building)), keep_all=True)
    robot = Robot(SingleScans(places))
    located = 0
    for record in records:
        assert record.scan is not None
        assert record.pose is not None
        assert record.odometry is not None
        assert record.stamp is not None
        T_odom_base = record.odometry @ mounting.inverse()
        robot.odometry.add(record.stamp, T_odom_base)
        report = robot.take(record.scan, record.stamp, mounting)
        assert report is not None
        if report.state != "located":
            continue
        located += 1
        T_map_base = record.pose @ mounting.inverse()
        assert report.T_map_base is not None
        assert report.T_map_odom is not None
        assert report.T_map_base.distance(T_map_base) < 0.1
        assert report.hypotheses[0][0].distance(T_map_base) < 0.1
        assert (report.T_map_odom @ T_odom_base).distance(report.T_map_base) < 1e-9
    assert located >= 0.9 * len(records)


# Reports


@pytest.mark.parametrize(
    ("probabilities", "accepted", "state"),
    [
        ((0.99, 0.01), True, "located"),
        ((0.5, 0.45), False, "ambiguous"),
        ((0.6, 0.05), False, "lost"),
        ((0.3,), False, "lost"),
        ((), False, "lost"),
    ],
)
def test_what_is_believed_has_a_name(
    probabilities: tuple[float, ...], accepted: bool, state: str
) -> None:
    report = Robot(Fixed(*probabilities, accepted=accepted)).take(SCAN, 1.0)
    assert report is not None
    assert report.state == state
    assert len(report.hypotheses) == len(probabilities)
    assert report.T_map_odom is None
    if not probabilities:
        assert report.T_map_base is None
        assert np.isnan(report.covariance).all()


def test_scans_that_come_late_or_twice_are_left_out() -> None:
    tracker = Fixed(0.9)
    robot = Robot(tracker)
    assert robot.take(SCAN, 10.0) is not None
    assert robot.take(SCAN, 10.0) is None
    assert robot.take(SCAN, 9.5) is None
    assert robot.take(SCAN, 10.1) is not None
    assert robot.late == 2
    assert [stamp for _, stamp in tracker.fed] == [10.0, 10.1]
    assert tracker.resets == 0


@pytest.mark.parametrize(
    ("taken", "newest", "late", "back"),
    [
        pytest.param(1000.0, 1000.2, 999.5, 3.0, id="while scans are taken"),
        # An idle node takes scans no more, and a recording begins again.
        pytest.param(10.0, 221.0, 220.5, 12.0, id="while no scan is taken"),
    ],
)
def test_a_clock_that_goes_back_starts_over(
    taken: float, newest: float, late: float, back: float
) -> None:
    tracker = Fixed(0.9)
    robot = Robot(tracker)
    robot.take(SCAN, taken)
    robot.is_announced = True
    robot.watch_clock(newest)
    robot.watch_clock(late)
    assert robot.is_announced
    robot.watch_clock(back)
    assert not robot.is_announced
    assert tracker.resets == 1
    assert robot.take(SCAN, back) is not None


def test_a_scan_that_waited_while_others_were_seen_is_taken() -> None:
    tracker = Fixed(0.9)
    robot = Robot(tracker)
    for stamp in (10.0, 11.0, 12.0, 13.0):
        robot.watch_clock(stamp)
    assert all(robot.take(SCAN, stamp) is not None for stamp in (10.0, 11.0, 12.0, 13.0))
    assert tracker.resets == 0


@pytest.mark.parametrize("stamp", [-math.inf, math.inf, math.nan])
def test_a_scan_at_no_time_is_left_out(stamp: float) -> None:
    tracker = Fixed(0.9)
    robot = Robot(tracker)
    robot.take(SCAN, 10.0)
    robot.is_announced = True
    robot.watch_clock(stamp)
    assert robot.take(SCAN, stamp) is None
    assert robot.take(SCAN, 10.1) is not None
    assert robot.is_announced
    assert tracker.resets == 0
    assert robot.late == 1


def test_broken_odometry_ends_the_belief_but_not_the_announcement() -> None:
    tracker = Fixed(0.9)
    robot = Robot(tracker)
    robot.odometry.add(1.0, Pose2D(7.0))
    robot.take(SCAN, 1.0, Pose2D(0.5))
    robot.is_announced = True
    robot.odometry.add(1.1, Pose2D(0.0))
    robot.take(SCAN, 1.1, Pose2D(0.5))
    assert tracker.resets == 1
    assert robot.is_announced
    assert [moved for moved, _ in tracker.fed] == [Pose2D(7.5), Pose2D(0.5)]


def test_the_belief_is_told_which_laser_took_a_scan() -> None:
    mountings = [Pose2D(0.2), Pose2D(-0.4, 0.0, math.pi)]
    tracker = mock.MagicMock()
    tracker.update.return_value = Fixed(0.9).belief
    robot = Robot(tracker)
    robot.odometry.add(10.0, Pose2D(7.0))
    robot.odometry.add(10.2, Pose2D(7.0))
    for number, mounting in enumerate(mountings):
        robot.take(SCAN, 10.0 + 0.1 * number, mounting)
        assert tracker.update.call_args.args[3] == mounting
        assert tracker.update.call_args.args[1] == Pose2D(7.0) @ mounting


# The mailbox


def test_of_scans_the_newest_wait_and_of_maps_the_last() -> None:
    box = Mailbox(2)
    for scan in range(5):
        box.put_scan(scan)
    box.put_map("old")
    box.put_map("new")
    assert box.dropped == 3
    assert [box.take(), box.take(), box.take()] == ["new", 3, 4]
    box.put_scan(5)
    box.forget_scans()
    box.put_scan(6)
    assert box.take() == 6


def test_a_mailbox_that_is_closed_ends_the_work_at_once() -> None:
    box = Mailbox(1)
    done = []

    def work() -> None:
        try:
            for item in box.while_open(range(10**9)):
                done.append(item)
                time.sleep(0.001)
        except Closed:
            done.append("closed")

    worker = threading.Thread(target=work)
    worker.start()
    time.sleep(0.05)
    box.close()
    worker.join(5.0)
    assert not worker.is_alive()
    assert done[-1] == "closed"
    with pytest.raises(Closed):
        box.take()


# Parameters


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("global_frame_id", ""),
        ("base_frame_id", "/"),
        ("scan_topic", ""),
        ("laser_pose", [1.0, 2.0]),
        ("laser_pose", [1.0, 2.0, math.nan]),
        ("map_spacing", 0.0),
        ("map_spacing", math.inf),
        ("robot_radius", -0.1),
        ("queue_size", 0),
        ("scan_timeout", -1.0),
        ("tf_broadcast", True),
    ],
)
def test_impossible_parameters_are_named(name: str, value: object) -> None:
    with pytest.raises(SettingsError, match=name):
        RobotParameters(**{name: value})  # type: ignore[arg-type]


def test_settings_come_from_a_preset_or_a_file(tmp_path: Path) -> None:
    assert RobotParameters().settings() is None
    thorough = RobotParameters(preset="thorough").settings()
    assert thorough is not None
    path = tmp_path / "settings.json"
    path.write_text(thorough.to_json(), encoding="utf-8")
    assert RobotParameters(settings_file=str(path)).settings() == thorough
    path.write_text('{"nothing": 1}', encoding="utf-8")
    with pytest.raises(SettingsError, match="nothing"):
        RobotParameters(settings_file=str(path)).settings()
    with pytest.raises(SettingsError, match="unknown preset"):
        RobotParameters(preset="sloppy").settings()


def test_the_file_on_the_page_about_robots_is_understood() -> None:
    page = (ROOT / "docs" / "robot.md").read_text(encoding="utf-8")
    yaml = pytest.importorskip("yaml")
    (text,) = re.findall(r"```yaml\n(anchorscan:.*?)```", page, re.DOTALL)
    given = yaml.safe_load(text)["anchorscan"]["ros__parameters"]
    RobotParameters(**given)


def test_a_scan_waits_for_odometry_that_is_on_its_way_and_for_no_other() -> None:
    def waited(odometry: Odometry, stamp: float, seconds: float) -> bool:
        """Whether it was waited for something, found out without a clock."""
        with mock.patch.object(odometry._lock, "wait_for") as wait_for:
            odometry.wait_until(stamp, seconds)
        return bool(wait_for.called)

    odometry = Odometry()
    assert not waited(odometry, 5.0, 60.0), "there is none"
    odometry.add(5.0, Pose2D())
    assert not waited(odometry, 5.0, 60.0), "it is there"
    assert not waited(odometry, 4.0, 60.0)
    assert not waited(odometry, 7.0, 60.0), "it has stopped"
    assert waited(odometry, 5.5, 60.0)
    odometry.wait_until(5.5, 0.01)  # no longer than that
    later = threading.Timer(0.05, odometry.add, (5.6, Pose2D(1.0, 0.0, 0.0)))
    later.start()
    odometry.wait_until(5.5, 60.0)
    assert odometry.at(5.6) == Pose2D(1.0, 0.0, 0.0)
    later.join()


def test_what_is_prepared_compiles_nothing_with_its_first_scans() -> None:
    """In a process of its own: here other tests have compiled everything."""
    code = """
import sys
import anchorscan
from numba.core.dispatcher import Dispatcher
from anchorscan import Matcher, Reference, drive, random_building
from anchorscan.localizer import Localizer

def compiled():
    modules = [module for name, module in sys.modules.items() if name.startswith("anchorscan.")]
    kernels = [each for m in modules for each in vars(m).values() if isinstance(each, Dispatcher)]
    return sum(len(kernel.signatures) for kernel in kernels)

records = drive(random_building(3, length=20.0, depth=14.0), seed=1, length=4.0)
places = Matcher([Reference(r.index, r.scan, r.pose) for r in records[::4]])
places.prepare()
localizer = Localizer(places)
localizer.prepare()
before = compiled()
derive = anchorscan.stitched_map.landmarks
anchorscan.stitched_map.landmarks = None  # derived already, or this would be called
for record in records:
    localizer.update(record.scan, record.odometry, record.stamp)
assert len(localizer.mixture)
assert places.locate(anchorscan.LaserScan([2.0, 2.0], 0.0, 0.01))  # of no anchor point
print(before, compiled())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, after = done.stdout.split()
    assert int(before) > 20
    assert before == after
