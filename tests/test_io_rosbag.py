"""ROS recordings in every storage: scans, and where the laser was when they were taken."""

from __future__ import annotations

import math
import shutil
import sqlite3
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchorscan import LogError, Pose2D, Record, open_log

pytest.importorskip("rosbags", reason="reading ROS recordings needs the extra 'bags'")

from ros_recordings import NANO, STORAGES, Messages, rotation

RANGES = [1.0 + 0.1 * i for i in range(21)]


def near(a: Pose2D | None, b: Pose2D, tolerance: float = 1e-6) -> bool:
    return a is not None and a.distance(b) < tolerance and a.turn(b) < tolerance


def read(path: Path, **options: object) -> list[Record]:
    log = open_log(path, **options)  # type: ignore[arg-type]
    records = list(log)
    assert log.problems == ()
    return records


@pytest.fixture(params=STORAGES)
def messages(request: pytest.FixtureRequest) -> Messages:
    return Messages(request.param)


@pytest.fixture
def ros2() -> Messages:
    return Messages("mcap")


@settings(max_examples=15, deadline=None)
@given(
    storage=st.sampled_from(STORAGES),
    scans=st.lists(
        st.lists(st.floats(0, 30, width=32) | st.just(math.nan) | st.just(math.inf), min_size=2),
        min_size=1,
        max_size=4,
    ),
    start=st.floats(-3, 3, width=32),
    increment=st.floats(0.0078125, 0.0625, width=32),
)
def test_what_is_recorded_is_read_back(
    tmp_path_factory: pytest.TempPathFactory,
    storage: str,
    scans: list[list[float]],
    start: float,
    increment: float,
) -> None:
    messages = Messages(storage)
    for i, ranges in enumerate(scans):
        messages.scan(100.0 + i, ranges, angle_min=start, angle_increment=-increment)
    log = open_log(messages.write(tmp_path_factory.mktemp("bag")))
    assert log.count == len(scans)
    records = list(log)
    assert [record.index for record in records] == list(range(len(scans)))
    for i, (record, ranges) in enumerate(zip(records, scans, strict=True)):
        assert record.scan is not None
        expected = np.array(ranges, dtype=np.float32)
        expected[expected >= 20.0] = np.inf
        np.testing.assert_array_equal(record.scan.ranges, expected)
        assert record.scan.angle_min == start
        assert record.scan.angle_increment == -increment
        assert (record.scan.range_min, record.scan.range_max) == (pytest.approx(0.1), 20)
        assert record.stamp == 100.0 + i
        assert (record.pose, record.odometry, record.T_base_laser) == (None, None, None)


def test_a_recording_may_be_named_in_several_ways(tmp_path: Path) -> None:
    for storage, ending in (("sqlite3", ".db3"), ("mcap", ".mcap")):
        messages = Messages(storage)
        messages.scan(1.0, RANGES)
        folder = messages.write(tmp_path, storage)
        (part,) = folder.glob(f"*{ending}")
        bare = tmp_path / f"bare{ending}"
        shutil.copy(part, bare)
        lost = tmp_path / f"lost-{storage}"
        lost.mkdir()
        shutil.copy(part, lost)
        for path in (folder, part, bare, lost):
            (record,) = read(path)
            assert record.scan is not None
            assert len(record.scan) == 21
        wrong = tmp_path / "recording"
        shutil.copy(part, wrong)
        with pytest.raises(LogError, match=f"its name must end in {ending}"):
            open_log(wrong)


def test_a_recording_in_several_files_is_one(tmp_path: Path) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    for i in (1, 0):
        messages = Messages("mcap")
        messages.scan(1.0 + i, RANGES)
        (part,) = messages.write(tmp_path, f"part{i}").glob("*.mcap")
        shutil.copy(part, folder)
    assert [record.stamp for record in read(folder)] == [1.0, 2.0]


def test_the_only_topic_with_scans_is_taken(messages: Messages, tmp_path: Path) -> None:
    messages.posed(0.5, 0, 0, 0, topic="/odom")
    messages.scan(1.0, RANGES, topic="/front/scan")
    log = open_log(messages.write(tmp_path))
    assert "scans from /front/scan, frame laser" in log.notes


def test_of_several_topics_the_caller_chooses(messages: Messages, tmp_path: Path) -> None:
    messages.scan(1.0, RANGES, topic="/front")
    messages.scan(1.1, RANGES[:11], topic="/rear")
    messages.scan(1.2, RANGES[:11], topic="/rear")
    path = messages.write(tmp_path)
    with pytest.raises(LogError, match=r"several.*: /front \(1 scans\), /rear \(2 scans\)"):
        open_log(path)
    assert len(read(path, topic="rear")) == 2
    with pytest.raises(LogError, match=r"no laser scans on /side; there are /front .*, /rear"):
        open_log(path, topic="/side")


def test_a_recording_without_scans_lists_what_it_has(messages: Messages, tmp_path: Path) -> None:
    messages.posed(0.5, 0, 0, 0, topic="/odom")
    with pytest.raises(LogError, match="no laser scans; the topics are /odom"):
        open_log(messages.write(tmp_path))


def test_of_several_echoes_the_first_counts(messages: Messages, tmp_path: Path) -> None:
    messages.echoes(1.0, [[2.0, 3.0], [], [4.0]])
    (record,) = read(messages.write(tmp_path))
    assert record.scan is not None
    np.testing.assert_array_equal(record.scan.ranges, [2.0, math.nan, 4.0])


def test_a_stamp_of_zero_gives_way_to_the_time_of_recording(
    messages: Messages, tmp_path: Path
) -> None:
    messages.scan(0.0, RANGES, time=77.5)
    messages.scan(80.25, RANGES, time=78.5)
    assert [record.stamp for record in read(messages.write(tmp_path))] == [77.5, 80.25]


def drive(messages: Messages, *, child: str = "base_link") -> None:
    """One second of driving ahead along y, with scans in between."""
    for i in range(11):
        messages.posed(10 + 0.1 * i, 1.0, 0.1 * i, math.pi / 2, topic="/odom", child=child)
    for i in range(5):
        messages.scan(10.05 + 0.2 * i, RANGES)


@pytest.mark.parametrize("is_static", [True, False])
def test_odometry_is_carried_to_the_laser(
    messages: Messages, tmp_path: Path, is_static: bool
) -> None:
    messages.transform(9.9, "/base_footprint", "/base_link", (0, 0, 0.1), is_static=is_static)
    turn = rotation(yaw=math.pi / 2)
    messages.transform(9.9, "base_link", "laser", (0.2, 0.1, 0.3), turn, is_static=is_static)
    messages.transform(11.0, "base_link", "laser", (0.2, 0.1, 0.3), turn, is_static=is_static)
    drive(messages)
    for i, record in enumerate(read(messages.write(tmp_path))):
        assert record.T_base_laser is not None
        assert near(record.T_base_laser, Pose2D(0.2, 0.1, math.pi / 2))
        assert near(record.odometry, Pose2D(0.9, 0.05 + 0.2 * i + 0.2, math.pi))
        assert record.pose is None


def test_odometry_of_another_frame_finds_its_way_to_the_laser(
    messages: Messages, tmp_path: Path
) -> None:
    messages.transform(9.9, "base_footprint", "base_link", (0.5, 0, 0), is_static=True)
    messages.transform(9.9, "base_link", "laser", (0.2, 0, 0), is_static=True)
    drive(messages, child="base_footprint")
    path = messages.write(tmp_path)
    first = read(path)[0]
    assert near(first.T_base_laser, Pose2D(0.7))
    assert near(first.odometry, Pose2D(1, 0.05 + 0.7, math.pi / 2))
    # The same odometry, the laser's place told of another base.
    first = read(path, base_frame_id="base_link")[0]
    assert near(first.T_base_laser, Pose2D(0.2))
    assert near(first.odometry, Pose2D(1, 0.05 + 0.7, math.pi / 2))


def test_without_a_mounting_there_is_no_odometry_of_the_laser(
    messages: Messages, tmp_path: Path
) -> None:
    drive(messages)
    path = messages.write(tmp_path)
    log = open_log(path)
    assert "where the laser sits on the robot is not known (T_base_laser, --laser)" in log.notes
    assert "no odometry" in log.notes
    assert all(record.odometry is None and record.T_base_laser is None for record in log)
    first = read(path, T_base_laser=Pose2D(0.3, 0, 1))[0]
    assert near(first.odometry, Pose2D(1, 0.05 + 0.3, math.pi / 2 + 1))
    assert first.T_base_laser == Pose2D(0.3, 0, 1)


def test_a_laser_that_moves_on_the_robot_has_no_mounting(
    messages: Messages, tmp_path: Path
) -> None:
    for i in range(11):
        messages.transform(10 + 0.1 * i, "base_link", "laser", turn=rotation(yaw=0.1 * i))
    drive(messages)
    assert all(record.T_base_laser is None for record in open_log(messages.write(tmp_path)))


def test_odometry_that_follows_the_laser_is_taken_as_it_is(
    messages: Messages, tmp_path: Path
) -> None:
    drive(messages, child="laser")
    first = read(messages.write(tmp_path))[0]
    assert near(first.odometry, Pose2D(1, 0.05, math.pi / 2))


@pytest.mark.parametrize(
    ("roll", "pitch", "yaw"),
    [(math.pi, 0, 0), (0, math.pi, 0), (math.pi, 0, 1.0), (math.pi - 0.05, 0.02, -2.0)],
)
def test_a_hanging_laser_has_its_scan_turned_over(
    tmp_path: Path, ros2: Messages, roll: float, pitch: float, yaw: float
) -> None:
    turn = rotation(roll, pitch, yaw)
    ros2.transform(9.9, "base_link", "laser", (0.2, 0.1, 0.3), turn, is_static=True)
    drive(ros2)
    record = read(ros2.write(tmp_path))[0]
    assert record.scan is not None
    assert record.T_base_laser is not None
    assert record.scan.angle_min == pytest.approx(1.0)
    assert record.scan.angle_increment == pytest.approx(-0.1)
    # Where the points lie on the robot does not depend on how that is written.
    angles = -1.0 + 0.1 * np.arange(21)
    points = np.column_stack([RANGES * np.cos(angles), RANGES * np.sin(angles), 0 * angles])
    x, y, z, w = turn
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        ]
    )
    expected = points @ matrix.T + (0.2, 0.1)
    level = 1e-5 if math.pi in {roll, pitch} else 0.02
    np.testing.assert_allclose(record.T_base_laser.apply(record.scan.points), expected, atol=level)


def test_a_place_in_the_plane_does_not_turn_a_hanging_laser_up(
    tmp_path: Path, ros2: Messages
) -> None:
    turn = rotation(roll=math.pi)
    ros2.transform(9.9, "base_link", "laser", (0.2, 0.1, 0.3), turn, is_static=True)
    drive(ros2)
    path = ros2.write(tmp_path)
    log = open_log(path, T_base_laser=Pose2D(0.25))
    record = next(iter(log))
    assert record.scan is not None
    assert record.scan.angle_increment == pytest.approx(-0.1)
    assert record.T_base_laser == Pose2D(0.25)
    assert any(note.endswith("upside down") for note in log.notes)
    record = read(path, T_base_laser=Pose2D(0.25), is_upside_down=False)[0]
    assert record.scan is not None
    assert record.scan.angle_increment == pytest.approx(0.1)


def test_the_scans_of_a_second_laser_on_the_topic_are_counted_and_left_out(
    tmp_path: Path, ros2: Messages
) -> None:
    turn = rotation(roll=math.pi)
    ros2.transform(9.9, "base_link", "front", is_static=True)
    ros2.transform(9.9, "base_link", "rear", (-0.2, 0, 0.3), turn, is_static=True)
    for number, frame in enumerate(["front", "rear", "front"]):
        ros2.scan(10.0 + number, RANGES, frame=frame)
    log = open_log(ros2.write(tmp_path))
    assert [record.scan is None for record in log] == [False, True, False]
    (problem,) = log.problems
    assert problem.reason == "the scan is of another frame, 'rear'"
    assert [record.problem for record in log] == ["", problem.reason, ""]


def test_the_caller_may_say_that_the_laser_hangs(tmp_path: Path, ros2: Messages) -> None:
    drive(ros2)
    path = ros2.write(tmp_path)
    record = read(path, is_upside_down=True, T_base_laser=Pose2D(0.2))[0]
    assert record.scan is not None
    assert record.scan.angle_increment == pytest.approx(-0.1)
    assert near(record.odometry, Pose2D(1, 0.25, math.pi / 2))


def test_a_laser_that_looks_at_the_floor_is_refused(tmp_path: Path, ros2: Messages) -> None:
    turn = rotation(pitch=math.radians(30))
    ros2.transform(9.9, "base_link", "laser", (0, 0, 1), turn, is_static=True)
    drive(ros2)
    path = ros2.write(tmp_path)
    with pytest.raises(LogError, match="tilted by 30 degrees"):
        open_log(path)
    assert len(read(path, T_base_laser=Pose2D())) == 5


@pytest.mark.parametrize("kind", ["PoseStamped", "PoseWithCovarianceStamped", "Odometry"])
def test_poses_come_from_the_topic_that_the_caller_names(
    messages: Messages, tmp_path: Path, kind: str
) -> None:
    drive(messages)
    for i in range(11):
        messages.posed(10 + 0.1 * i, 5 + 0.1 * i, 7, 0, topic="/where", kind=kind, frame="map")
    path = messages.write(tmp_path)
    options = {"odometry_topic": "/odom"}
    assert all(record.pose is None for record in read(path, **options))
    with pytest.raises(LogError, match=r"/where say nothing.*T_base_laser.*poses_of"):
        open_log(path, poses="/where", **options)
    first = read(path, poses="/where", T_base_laser=Pose2D(0.3, 0, 1), **options)[0]
    assert near(first.pose, Pose2D(5.35, 7, 1))
    first = read(path, poses="where", poses_of="laser", **options)[0]
    assert near(first.pose, Pose2D(5.05, 7, 0))
    with pytest.raises(LogError, match=r"no poses on /nowhere, nor a file.*/where"):
        open_log(path, poses="/nowhere", **options)


def test_a_goal_is_not_taken_for_a_pose(messages: Messages, tmp_path: Path) -> None:
    drive(messages)
    messages.transform(9.9, "base_link", "laser", is_static=True)
    for i in range(11):
        messages.posed(10 + 0.1 * i, 50, 70, 0, topic="/goal_pose", kind="PoseStamped", frame="map")
    assert all(record.pose is None for record in read(messages.write(tmp_path)))


def test_the_tree_of_frames_gives_poses_and_odometry(messages: Messages, tmp_path: Path) -> None:
    messages.transform(9.9, "base_link", "laser", (0.5, 0, 0), is_static=True)
    for i in range(11):
        stamp = 10 + 0.1 * i
        messages.transform(stamp, "map", "odom", (100, 0, 0), rotation(yaw=math.pi / 2))
        messages.transform(stamp, "odom", "base_link", (0.1 * i, 0, 0))
        messages.transform(stamp, "base_link", "wheel", turn=rotation(pitch=0.3 * i))
    for i in range(5):
        messages.scan(10.05 + 0.2 * i, RANGES)
    for i, record in enumerate(read(messages.write(tmp_path))):
        ahead = 0.05 + 0.2 * i + 0.5
        assert near(record.odometry, Pose2D(ahead, 0, 0))
        assert near(record.pose, Pose2D(100, ahead, math.pi / 2))


def test_a_tree_that_does_not_reach_the_laser_is_said_so(
    messages: Messages, tmp_path: Path
) -> None:
    messages.transform(9.9, "map", "base_link")
    drive(messages)
    with pytest.raises(LogError, match="/tf does not say where laser is in map"):
        open_log(messages.write(tmp_path), poses="/tf")


def test_poses_come_from_a_file_made_later(messages: Messages, tmp_path: Path) -> None:
    from anchorscan import write_tum

    drive(messages)
    messages.transform(9.9, "base_link", "laser", (0.5, 0, 0), is_static=True)
    tum = tmp_path / "slam.tum"
    write_tum(tum, [(10 + 0.1 * i, Pose2D(i, 0, math.pi / 2)) for i in range(11)])
    records = read(messages.write(tmp_path), poses=tum)
    assert near(records[0].pose, Pose2D(0.5, 0.5, math.pi / 2), 1e-5)
    assert near(records[4].odometry, Pose2D(1, 0.85 + 0.5, math.pi / 2))


def test_scans_far_from_any_odometry_have_none(messages: Messages, tmp_path: Path) -> None:
    messages.transform(9.9, "base_link", "laser", is_static=True)
    for stamp in (10.0, 10.1, 12.0):
        messages.posed(stamp, stamp, 0, 0, topic="/odom")
    for stamp in (9.0, 10.05, 11.0, 13.0):
        messages.scan(stamp, RANGES)
    found = [record.odometry for record in read(messages.write(tmp_path))]
    assert [one is None for one in found] == [True, False, True, True]


def test_two_publishers_on_one_topic_are_not_mixed(messages: Messages, tmp_path: Path) -> None:
    messages.transform(9.9, "base_link", "laser", is_static=True)
    for i in range(11):
        messages.posed(10 + 0.1 * i, 1, 0, 0, topic="/odom")
        messages.posed(10.02 + 0.1 * i, 50, 0, 0, topic="/odom", frame="other")
    messages.scan(10.5, RANGES)
    assert near(read(messages.write(tmp_path))[0].odometry, Pose2D(1))


BAD_SCANS = {
    "no readings": {"ranges": []},
    "no increment": {"angle_increment": 0.0},
    "an increment that is no number": {"angle_increment": math.nan},
    "degrees": {"angle_increment": 5.7},
    "no limit": {"range_max": 0.0},
    "a limit that is no number": {"range_max": math.nan},
}


@pytest.mark.parametrize("what", BAD_SCANS)
def test_a_scan_that_is_none_is_counted(tmp_path: Path, ros2: Messages, what: str) -> None:
    ros2.scan(1.0, RANGES)
    ros2.scan(2.0, **({"ranges": RANGES} | BAD_SCANS[what]))  # type: ignore[arg-type]
    ros2.scan(3.0, RANGES)
    log = open_log(ros2.write(tmp_path))
    assert [record.scan is None for record in log] == [False, True, False]
    assert [problem.line for problem in log.problems] == [2]
    (tmp_path / "alone").mkdir()
    ros2.entries = ros2.entries[1:2]
    with pytest.raises(LogError, match="no readable laser scan on /scan: message 1: "):
        open_log(ros2.write(tmp_path / "alone"))


def test_a_message_that_is_no_scan_is_counted(tmp_path: Path) -> None:
    messages = Messages("sqlite3")
    messages.scan(1.0, RANGES)
    (part,) = messages.write(tmp_path).glob("*.db3")
    with sqlite3.connect(part) as base:
        ((data,),) = base.execute("SELECT data FROM messages").fetchall()
        promise = data.replace((21).to_bytes(4, "little"), b"\xff\xff\xff\x7f", 1)
        broken = [data[:40], b"", promise]
        rows = [(1, (2 + i) * NANO, one) for i, one in enumerate(broken)]
        base.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(?,?,?)", rows)
    log = open_log(part)
    records = list(log)
    assert [record.scan is None for record in records] == [False, True, True, True]
    assert [record.index for record in records] == [0, 1, 2, 3]
    assert log.problem_count == 3
    assert all("\n" not in record.problem for record in records)


def storage_file(path: Path) -> Path:
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")


@pytest.mark.parametrize("keep", [0.02, 0.3, 0.6, 0.9, 0.99])
def test_a_recording_that_is_cut_off_is_one_clear_line_or_a_report(
    messages: Messages, tmp_path: Path, keep: float
) -> None:
    for i in range(200):
        messages.scan(float(i), np.random.default_rng(i).uniform(1, 9, 360))
    path = messages.write(tmp_path)
    file = storage_file(path)
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * keep)])
    try:
        log = open_log(path)
    except LogError as error:
        assert_one_line(error, path)
        return
    records = list(log)
    assert all(record.scan is not None for record in records)
    assert log.problem_count > 0 or len(records) == 200


def assert_one_line(error: LogError, path: Path) -> None:
    assert str(error).startswith(str(path))
    assert "\n" not in str(error)


@pytest.mark.parametrize("seed", range(4))
def test_a_damaged_recording_never_ends_in_a_traceback(
    messages: Messages, tmp_path: Path, seed: int
) -> None:
    messages.transform(0.0, "base_link", "laser", is_static=True)
    for i in range(20):
        messages.posed(float(i), 1, 0, 0, topic="/odom")
        messages.scan(float(i), RANGES)
    path = messages.write(tmp_path)
    file = storage_file(path)
    generator = np.random.default_rng(seed)
    sound = np.frombuffer(file.read_bytes(), dtype=np.uint8)
    for _ in range(8):
        data = sound.copy()
        at = generator.integers(16, len(data), 30)
        data[at] = generator.integers(0, 256, 30)
        file.write_bytes(data.tobytes())
        try:
            for record in open_log(path):
                assert (record.scan is None) == bool(record.problem)
        except LogError as error:
            assert_one_line(error, path)


@pytest.mark.parametrize("storage", ["ros1", "mcap"])
def test_no_record_is_set_aside_because_a_header_promises_it(tmp_path: Path, storage: str) -> None:
    promise = (2**31 - 10).to_bytes(4, "little")
    if storage == "ros1":
        path = tmp_path / "a.bag"
        path.write_bytes(b"#ROSBAG V2.0\n" + promise + b"op=\x03" * 10)
    else:
        path = tmp_path / "a.mcap"
        size = (2**40).to_bytes(8, "little")
        path.write_bytes(b"\x89MCAP0\r\n\x01" + size + b"x" * 100)
    tracemalloc.start()
    with pytest.raises(LogError, match="cannot be read as a recording"):
        open_log(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6


def test_a_folder_with_broken_metadata_is_one_clear_line(tmp_path: Path, ros2: Messages) -> None:
    ros2.scan(1.0, RANGES)
    path = ros2.write(tmp_path)
    for text in ("", "a: [", "rosbag2_bagfile_information: {version: 99}", "\0"):
        (path / "metadata.yaml").write_text(text)
        with pytest.raises(LogError, match="cannot be read as a recording") as raised:
            open_log(path)
        assert "\n" not in str(raised.value)


def test_a_definition_nobody_can_parse_does_not_hide_the_scans(tmp_path: Path) -> None:
    messages = Messages("sqlite3")
    messages.scan(1.0, RANGES)
    messages.posed(1.0, 0, 0, 0, topic="/odom")
    path = messages.write(tmp_path)
    with sqlite3.connect(storage_file(path)) as base:
        base.execute(
            "UPDATE message_definitions SET encoded_message_definition='?!' "
            "WHERE topic_type='nav_msgs/msg/Odometry'"
        )
    assert len(list(open_log(path))) == 1


def test_an_old_recording_without_definitions_is_read(tmp_path: Path) -> None:
    messages = Messages("sqlite3")
    messages.transform(0.5, "base_link", "laser", (0.5, 0, 0), is_static=True)
    messages.scan(1.0, RANGES)
    path = messages.write(tmp_path)
    with sqlite3.connect(storage_file(path)) as base:
        base.execute("UPDATE schema SET schema_version=3")
        base.execute("DROP TABLE message_definitions")
    (record,) = read(path)
    assert near(record.T_base_laser, Pose2D(0.5))


def test_without_rosbags_the_message_says_what_to_install(tmp_path: Path, ros2: Messages) -> None:
    ros2.scan(1.0, RANGES)
    path = ros2.write(tmp_path)
    code = (
        "import sys; sys.modules['rosbags'] = None\n"
        "from anchorscan import open_log, MissingExtraError\n"
        f"try: open_log({str(path)!r})\n"
        "except MissingExtraError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install 'anchorscan[bags]'" in done.stdout


def test_rosbags_is_loaded_only_for_recordings() -> None:
    code = "import sys; import anchorscan.io; print('rosbags' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
