"""Golden counts on recorded logs, and scans that lie over one another by their poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from anchorscan import LaserScan, Pose2D, Record, open_log

# scans, readings, with odometry, with a time, share of readings without return
GOLDEN = {
    "intel.log.gz": (910, 180, 0, 910, 0.0255),
    "intel-dense.log.gz": (2726, 180, 2726, 2726, 0.0),
    "freiburg-079.log.gz": (4791, 360, 0, 4791, 0.0209),
    "freiburg-101.log.gz": (292, 360, 0, 292, 0.1194),
    "csail.log.gz": (406, 361, 0, 406, 0.0267),
    "orebro.log.gz": (237, 181, 0, 0, 0.0226),
    "wean-2.log.gz": (2251, 180, 2251, 2251, 0.0372),
    "wean-3.log.gz": (1241, 180, 1241, 1241, 0.0164),
}


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_counts(data_file: Callable[[str], Path], name: str) -> None:
    scans, readings, odometry, stamps, free = GOLDEN[name]
    log = open_log(data_file(name))
    records = list(log)
    assert log.problems == ()
    assert log.count == len(records) == scans
    assert [record.index for record in records] == list(range(scans))
    assert all(record.pose is not None for record in records)
    assert sum(record.odometry is not None for record in records) == odometry
    assert sum(record.stamp is not None for record in records) == stamps
    assert {len(record.scan) for record in records if record.scan} == {readings}
    shares = [record.scan.is_free.mean() for record in records if record.scan]
    assert np.mean(shares) == pytest.approx(free, abs=5e-5)
    assert {record.scan.angle_min for record in records if record.scan} == {-math.pi / 2}


def test_killian_court_comes_out_of_its_package() -> None:
    rtbdata = pytest.importorskip("rtbdata", reason="MIT Killian Court is in rtb-data")
    log = open_log(Path(rtbdata.__file__).parent / "data" / "killian.g2o.zip")
    records = list(log)
    assert log.problems == ()
    assert len(records) == 3873
    assert all(record.pose is not None and record.odometry is None for record in records)
    assert records[0].pose == Pose2D(1.96, 37.867, -2.01239)
    longest = max(float(r.scan.ranges[r.scan.is_return].max()) for r in records if r.scan)
    assert longest < 51
    pairs = pairs_after(records, 2.0)
    as_read = overlap(pairs, lambda scan: scan)
    assert overlap(pairs, LaserScan.upside_down) > 1.5 * as_read
    assert overlap(pairs, lambda scan: turned(scan, 5)) > 1.3 * as_read


Change = Callable[[LaserScan], LaserScan]


def overlap(pairs: list[tuple[Record, Record]], change: Change) -> float:
    """Mean distance, of at most 0.3 m, from the points of scans to those of others nearby."""
    distances = []
    for a, b in pairs:
        pose_a, pose_b = place(a), place(b)
        assert a.scan is not None
        assert b.scan is not None
        one = pose_a.apply(change(a.scan).points)
        other = pose_b.apply(change(b.scan).points)[::5]
        nearest = np.sqrt(((other[:, None] - one[None]) ** 2).sum(axis=2).min(axis=1))
        distances.append(float(np.minimum(nearest, 0.3).mean()))
    assert len(distances) > 20
    return float(np.mean(distances))


def place(record: Record) -> Pose2D:
    pose = record.pose or record.odometry
    assert pose is not None
    return pose


def pairs_after(records: list[Record], distance: float) -> list[tuple[Record, Record]]:
    """Some 60 scans, each with the first one that was taken so many metres further on."""
    placed = [
        r for r in records if r.scan and r.scan.is_return.sum() > 20 and (r.pose or r.odometry)
    ]
    pairs = []
    for i in range(0, len(placed), max(1, len(placed) // 60)):
        later = (r for r in placed[i : i + 150] if place(r).distance(place(placed[i])) > distance)
        found = next(later, None)
        if found and place(found).distance(place(placed[i])) < 2 * distance:
            pairs.append((placed[i], found))
    return pairs


def turned(scan: LaserScan, degrees: float) -> LaserScan:
    start = scan.angle_min + math.radians(degrees)
    return LaserScan(scan.ranges, start, scan.angle_increment, scan.range_min, scan.range_max)


@pytest.mark.parametrize("name", [*GOLDEN, "olin"])
def test_scans_run_counter_clockwise_from_where_they_are_said_to(
    real_records: Callable[[str], list[Record]], name: str
) -> None:
    if name == "olin":
        pytest.importorskip("rosbags")
    pairs = pairs_after(real_records(name), 2.0)
    as_read = overlap(pairs, lambda scan: scan)
    assert overlap(pairs, LaserScan.upside_down) > 1.3 * as_read
    for degrees in (-5, 5):
        assert overlap(pairs, lambda scan, by=degrees: turned(scan, by)) > 1.1 * as_read


def test_a_turtlebot_drives_through_a_college(data_file: Callable[[str], Path]) -> None:
    pytest.importorskip("rosbags")
    folder = data_file("olin")
    for path in (folder, folder / "macfirst_floor_take_2_0.db3"):
        log = open_log(path)
        records = list(log)
        assert log.format == "rosbag2"
        assert log.problems == ()
        assert log.count == len(records) == 357
        assert {len(record.scan) for record in records if record.scan} == {720}
        # Odometry began 0.2 s after the first scan.
        assert [record.odometry is None for record in records] == [True] * 2 + [False] * 355
        assert all(record.pose is None for record in records)
        mounting = records[0].T_base_laser
        assert mounting is not None
        assert mounting.distance(Pose2D(0.00393584)) < 1e-9
        assert mounting.theta == pytest.approx(math.pi / 2)
        assert "scans from /scan, frame rplidar_link" in log.notes
