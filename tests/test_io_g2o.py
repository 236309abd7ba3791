"""g2o files: scans at optimised vertices, with the laser where it sits on the robot."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchorscan import LogError, Pose2D, open_log

coordinates = st.floats(-100, 100).map(lambda value: round(value, 4))
poses = st.tuples(coordinates, coordinates, st.floats(-3.1, 3.1).map(lambda v: round(v, 5)))


def robotlaser(
    laser: Sequence[float], robot: Sequence[float], ranges: Sequence[float] = (1.0, 2.0, 60.0)
) -> str:
    header = ["ROBOTLASER1", 0, -1.0, 2.0, 1.0, 50.0, 0.1, 0, len(ranges)]
    words = [*header, *ranges, 0, *laser, *robot, 0, 0, 0, 0, 0, 12.5, "host", 1.0]
    return " ".join(map(str, words)) + "\n"


def vertex(number: int, pose: Sequence[float]) -> str:
    return f"VERTEX_SE2 {number} {pose[0]} {pose[1]} {pose[2]}\n"


@settings(max_examples=30, deadline=None)
@given(
    path=st.lists(st.tuples(poses, poses), min_size=2, max_size=5),
    mounting=poses,
    is_packed=st.booleans(),
)
def test_the_laser_is_placed_by_the_vertex_and_its_mounting(
    tmp_path_factory: pytest.TempPathFactory,
    path: list[tuple[tuple[float, ...], tuple[float, ...]]],
    mounting: tuple[float, ...],
    is_packed: bool,
) -> None:
    text = ""
    for number, (optimised, odometry) in enumerate(path):
        laser = Pose2D(*odometry) @ Pose2D(*mounting)
        text += vertex(number, optimised) + robotlaser(laser.to_array().tolist(), odometry)
    text += "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
    file = tmp_path_factory.mktemp("graph") / ("a.zip" if is_packed else "a.g2o")
    if is_packed:
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("a.g2o", text)
            archive.writestr("__MACOSX/._a.g2o", b"\0\0")
    else:
        file.write_text(text)
    log = open_log(file)
    assert log.format == "g2o"
    records = list(log)
    assert log.problems == ()
    assert len(records) == len(path) == log.count
    differ = {(Pose2D(*a).inverse() @ Pose2D(*b)).x for a, b in path}
    filled = len({optimised for optimised, _ in path}) > 1
    for record, (optimised, odometry) in zip(records, path, strict=True):
        assert record.scan is not None
        assert record.scan.is_free.tolist() == [False, False, True]
        assert record.T_base_laser is not None
        assert record.T_base_laser.distance(Pose2D(*mounting)) < 1e-6
        if filled:
            expected = Pose2D(*optimised) @ Pose2D(*mounting)
            assert record.pose is not None
            assert record.pose.distance(expected) < 1e-6
            assert record.pose.turn(expected) < 1e-9
        if record.odometry is not None:
            assert record.odometry.distance(Pose2D(*odometry) @ Pose2D(*mounting)) < 1e-6
    if filled and max(differ) - min(differ) > 1 and len({o for _, o in path}) > 1:
        assert all(record.odometry is not None for record in records)


def test_a_damaged_vertex_leaves_its_scan_without_a_pose(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    text = "".join(vertex(i, (i, 0, 0)) + robotlaser((0, i, 0), (0, i, 0)) for i in range(3))
    path.write_text(text.replace("VERTEX_SE2 1 1 0 0", "VERTEX_SE2 1 nan 0 0"))
    log = open_log(path)
    records = list(log)
    assert [record.pose for record in records] == [Pose2D(0), None, Pose2D(2)]
    assert [record.scan is None for record in records] == [False] * 3
    assert [problem.line for problem in log.problems] == [3, 4]


def test_a_scan_before_any_vertex_has_no_pose(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    scans = [vertex(i, (i, 0, 0)) + robotlaser((0, i, 0), (0, i, 0)) for i in range(2)]
    path.write_text("FIX 0\n" + robotlaser((0, 0, 0), (0, 0, 0)) + "".join(scans))
    assert [record.pose for record in open_log(path)] == [None, Pose2D(0), Pose2D(1)]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("ROBOTLASER1 0 -1 2 1 50 0.1 0 1000000000 1 2 3", "promises 1000000000 readings"),
        ("ROBOTLASER1 0 -1 2 1 50", "ends before"),
        (robotlaser((0, 0, 0), (0, 0, 0)).replace(" 1.0 50.0", " nan 50.0"), "angle_increment"),
        (robotlaser((0, 0, 0), (0, 0, 0)).replace(" 1.0 50.0", " 57.3 50.0"), "two turns"),
        (robotlaser((0, 0, 0), (0, 0, 0)).replace(" 1.0 50.0", " 0 50.0"), "zero"),
    ],
)
def test_a_malformed_scan_is_counted(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "a.g2o"
    good = vertex(0, (0, 0, 0)) + robotlaser((0, 0, 0), (0, 0, 0))
    path.write_text(good + line.strip() + "\n" + good)
    log = open_log(path)
    records = list(log)
    assert [record.scan is None for record in records] == [False, True, False]
    assert words in records[1].problem
    assert [problem.line for problem in log.problems] == [3]


def test_a_pose_graph_without_scans_is_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    path.write_text(vertex(0, (0, 0, 0)) + vertex(1, (1, 0, 0)))
    with pytest.raises(LogError, match="holds no laser scan"):
        open_log(path)


def test_an_override_stands_above_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.g2o"
    path.write_text(vertex(0, (0, 0, 0)) + robotlaser((0, 0, 0), (0, 0, 0)))
    (record,) = open_log(path, field_of_view=math.pi, range_max=1.5)
    assert record.scan is not None
    assert record.scan.angle_min == pytest.approx(-math.pi / 2)
    assert record.scan.field_of_view == pytest.approx(math.pi)
    assert record.scan.is_free.tolist() == [False, True, True]
