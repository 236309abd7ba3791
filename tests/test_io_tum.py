"""TUM trajectories: written for others, read for logs whose poses were made later."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchorscan import LogError, Pose2D, open_log, write_tum
from anchorscan.io.text import TextFile
from anchorscan.io.tum import read_tum

coordinates = st.floats(-1000, 1000)
poses = st.builds(Pose2D, coordinates, coordinates, st.floats(-math.pi, math.pi))


def scans(path: Path, stamps: list[float], header: str = "") -> Path:
    lines = [f"FLASER 181 {'2.0 ' * 181}0 0 0 0 0 0 {stamp} host {stamp}\n" for stamp in stamps]
    path.write_text(header + "".join(lines))
    return path


def near(a: Pose2D | None, b: Pose2D, tolerance: float = 1e-6) -> bool:
    return a is not None and a.distance(b) < tolerance and a.turn(b) < tolerance


@settings(max_examples=40, deadline=None)
@given(path=st.lists(st.tuples(st.floats(0, 1e6), poses), min_size=1, max_size=20))
def test_what_is_written_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, path: list[tuple[float, Pose2D]]
) -> None:
    from anchorscan.io.spatial import planar

    path = sorted({round(stamp, 3): pose for stamp, pose in path}.items())
    file = tmp_path_factory.mktemp("tum") / "poses.tum"
    assert write_tum(file, path) == len(path)
    trajectory, problems = read_tum(TextFile(file))
    assert problems == ()
    assert len(trajectory) == len(path)
    for stamp, pose in path:
        motion = trajectory.at(stamp)
        assert motion is not None
        assert near(planar(motion), pose)


def test_a_pose_that_is_not_finite_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="not finite"):
        write_tum(tmp_path / "a.tum", [(0.0, Pose2D()), (1.0, Pose2D(math.nan, 0, 0))])
    assert not list(tmp_path.iterdir())
    with pytest.raises(LogError, match="cannot be written"):
        write_tum(tmp_path / "none" / "a.tum", [(1.0, Pose2D())])
    with pytest.raises(LogError, match="is a folder; name a file in it"):
        write_tum(tmp_path, [(1.0, Pose2D())])


def test_poses_are_interpolated_between_samples_near_in_time(tmp_path: Path) -> None:
    log = scans(tmp_path / "a.log", [9.8, 9.97, 10.0, 10.1, 10.4, 10.7, 12.0, 12.02, 13.0])
    tum = tmp_path / "poses.tum"
    turn = math.radians(170)
    write_tum(
        tum,
        [(10.0, Pose2D(0, 0, turn)), (10.4, Pose2D(4, 0, -turn)), (12.0, Pose2D(9, 9, 0))],
    )
    found = [record.pose for record in open_log(log, poses=tum, poses_of="laser")]
    assert found[0] is None  # before the first
    assert near(found[1], Pose2D(0, 0, turn))  # just before the first
    assert near(found[2], Pose2D(0, 0, turn))
    assert near(found[3], Pose2D(1, 0, math.radians(175)))  # by the shorter arc
    assert near(found[4], Pose2D(4, 0, -turn))
    assert found[5] is None  # nobody knows how the robot went for 1.6 s
    assert near(found[6], Pose2D(9, 9, 0))
    assert near(found[7], Pose2D(9, 9, 0))
    assert found[8] is None


def test_poses_of_the_robot_need_to_know_where_the_laser_sits(tmp_path: Path) -> None:
    tum = tmp_path / "poses.tum"
    write_tum(tum, [(10.0, Pose2D(1, 2, math.pi / 2))])
    log = scans(tmp_path / "a.log", [10.0])
    with pytest.raises(LogError, match="where the laser sits on the robot is not known"):
        list(open_log(log, poses=tum))
    (record,) = open_log(log, poses=tum, T_base_laser=Pose2D(0.3))
    assert near(record.pose, Pose2D(1, 2.3, math.pi / 2))
    assert record.T_base_laser == Pose2D(0.3)
    (record,) = open_log(log, poses=tum, poses_of="laser")
    assert near(record.pose, Pose2D(1, 2, math.pi / 2))
    log = scans(tmp_path / "b.log", [10.0], "PARAM robot_frontlaser_offset 0.2 host 0\n")
    (record,) = open_log(log, poses=tum)
    assert near(record.pose, Pose2D(1, 2.2, math.pi / 2))


def test_poses_of_another_time_are_an_error_that_names_both_times(tmp_path: Path) -> None:
    tum = tmp_path / "poses.tum"
    write_tum(tum, [(10.0, Pose2D()), (20.0, Pose2D())])
    log = scans(tmp_path / "a.log", [100.0, 200.0])
    with pytest.raises(LogError, match=r"10\.000 to 20\.000.*100\.000 to 200\.000"):
        list(open_log(log, poses=tum, poses_of="laser"))


def test_a_file_that_is_no_trajectory_is_one_clear_line(tmp_path: Path) -> None:
    log = scans(tmp_path / "a.log", [10.0])
    bad = tmp_path / "bad.tum"
    bad.write_text("# time\n1 2 3\n")
    with pytest.raises(LogError, match=r"bad\.tum:2: not a trajectory"):
        open_log(log, poses=bad)
    bad.write_text("")
    with pytest.raises(LogError, match="empty"):
        open_log(log, poses=bad)
    bad.write_text("# nothing\n")
    with pytest.raises(LogError, match="no pose in it"):
        open_log(log, poses=bad)
    with pytest.raises(LogError, match="no such file of poses"):
        open_log(log, poses=tmp_path / "none.tum")
    with pytest.raises(LogError, match="is the log itself"):
        open_log(log, poses=log)


def test_malformed_lines_of_a_trajectory_are_reported(tmp_path: Path) -> None:
    log = scans(tmp_path / "a.log", [10.0])
    tum = tmp_path / "poses.tum"
    tum.write_text("10.0 1 2 0 0 0 0 1\n10.1 1 2 0 0 0 0 0\n10.2,1,2,0,0,0,nan,1\nx\n")
    opened = open_log(log, poses=tum, poses_of="laser")
    (record,) = opened
    assert record.pose == Pose2D(1, 2)
    assert [problem.line for problem in opened.problems] == [2, 3, 4]
    assert "poses.tum" in opened.problems[0].reason
