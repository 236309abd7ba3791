"""What goes wrong around a robot: files that vanish, clocks that jump, processes that die."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from reference_set_kills import check_bits, pose_of, scan_of
from reference_set_two_processes import disturb

from anchorscan import Record, ReferenceSet, ReferenceSetError, drive, random_building
from anchorscan.localizer import Localizer
from anchorscan.robot import Robot


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The file of a set of ten references."""
    path = tmp_path / "a.apr"
    store(path, range(10))
    return path


def store(path: Path, numbers: range) -> None:
    with ReferenceSet(path=path) as places:
        places.add_batch([scan_of(n) for n in numbers], [pose_of(n) for n in numbers])


def remove(path: Path) -> None:
    path.unlink()


def replace(path: Path) -> None:
    other = path.with_name("other.apr")
    store(other, range(100, 105))
    os.replace(other, path)


def cut_short(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


HARM = [
    pytest.param(remove, "removed", id="removed"),
    pytest.param(replace, "replaced by another file", id="replaced"),
    pytest.param(cut_short, "cut short", id="cut short"),
]


class TestFileTakenAway:
    @pytest.mark.parametrize(("harm", "word"), HARM)
    def test_a_writer_is_told_and_can_save_elsewhere_what_it_has(
        self, harm: Callable[[Path], None], word: str, path: Path, tmp_path: Path
    ) -> None:
        places = ReferenceSet.open(path)
        places.add(scan_of(10), pose_of(10))
        harm(path)
        for change in (
            lambda: places.add(scan_of(11), pose_of(11)),
            lambda: places.remove(0),
            places.refresh,
            places.close,
        ):
            with pytest.raises(ReferenceSetError, match=f"a.apr: was {word} while"):
                change()
        assert len(places) == 11
        places.save(tmp_path / "rescued.apr")
        rescued = ReferenceSet.open(tmp_path / "rescued.apr")
        assert len(rescued) == 11
        check_bits(rescued)

    def test_the_file_that_took_the_place_stays_sound(self, path: Path) -> None:
        """The log of the file before it must not be folded into it."""
        places = ReferenceSet.open(path)
        places.add(scan_of(10), pose_of(10))
        replace(path)
        with pytest.raises(ReferenceSetError, match="replaced"):
            places.close()
        assert [file.name for file in path.parent.iterdir()] == ["a.apr"]
        other = ReferenceSet.open(path)
        assert len(other) == 5
        check_bits(other, shift=100)

    def test_a_reader_takes_over_what_took_the_place(self, path: Path) -> None:
        places = ReferenceSet.open(path)
        replace(path)
        assert places.refresh()
        check_bits(places, shift=100)

    @pytest.mark.parametrize("harm", [remove, cut_short, lambda path: path.write_bytes(b"x" * 999)])
    def test_a_reader_is_told_and_goes_on_with_what_it_has(
        self, harm: Callable[[Path], None], path: Path
    ) -> None:
        places = ReferenceSet.open(path)
        harm(path)
        with pytest.raises(ReferenceSetError, match=r"a\.apr: "):
            places.refresh()
        check_bits(places)
        assert places.locate(scan_of(3))

    def test_a_file_that_was_moved_and_came_back_is_the_same_file(self, path: Path) -> None:
        with ReferenceSet.open(path) as places:
            places.add(scan_of(10), pose_of(10))
            shutil.move(path, path.with_name("moved"))
            with pytest.raises(ReferenceSetError, match="removed"):
                places.add(scan_of(11), pose_of(11))
            shutil.move(path.with_name("moved"), path)
            assert places.add(scan_of(11), pose_of(11)) == 11
        assert len(ReferenceSet.open(path)) == 12


class TestKilledBesideAReader:
    def test_neither_loses_or_believes_anything_whoever_is_killed(self, tmp_path: Path) -> None:
        done = disturb(tmp_path, seed=4, kills=3)
        assert done.changes > 0


@pytest.fixture(scope="module")
def course() -> tuple[ReferenceSet, list[Record]]:
    world = random_building(2)
    records = drive(world, seed=1, length=15.0)
    return ReferenceSet.build(records, spacing=1.0), records


# What a clock does to a stamp: as it is, set forward or back, not a number, or stuck.
CLOCKS = st.one_of(
    st.just(0.0),
    st.floats(-1e10, 1e10),
    st.sampled_from([math.nan, math.inf, -math.inf, -0.5, 0.5, 86400.0, -3600.0]),
)


class TestClocks:
    @settings(max_examples=5, suppress_health_check=[HealthCheck.too_slow])
    @given(jumps=st.lists(st.tuples(CLOCKS, CLOCKS), min_size=1, max_size=12))
    def test_whatever_the_clocks_did_the_robot_is_found_once_they_run(
        self, course: tuple[ReferenceSet, list[Record]], jumps: list[tuple[float, float]]
    ) -> None:
        """Those of scans and of odometry jump apart from each other, then go on together."""
        places, records = course
        robot = Robot(Localizer(places))
        for record, (of_scan, of_odometry) in zip(records, jumps, strict=False):
            assert record.stamp is not None
            robot.odometry.add(record.stamp + of_odometry, record.odometry)
            report = robot.take(record.scan, record.stamp + of_scan)
            assert report is None or math.isfinite(report.stamp)
        # The clock is set to a time from which all that came before is in the past.
        begin = 2e10
        for record in records:
            robot.odometry.add(begin + record.stamp, record.odometry)
            report = robot.take(record.scan, begin + record.stamp)
            assert report is not None
        assert report.state == "located"
        assert report.T_map_base.distance(records[-1].pose) < 0.5

    @pytest.mark.parametrize("stamp", [math.nan, math.inf, -math.inf])
    def test_a_scan_of_no_time_is_left_out_and_spoils_nothing(
        self, course: tuple[ReferenceSet, list[Record]], stamp: float
    ) -> None:
        places, records = course
        robot = Robot(Localizer(places))
        assert robot.take(records[0].scan, 10.0) is not None
        assert robot.take(records[1].scan, stamp) is None
        assert robot.take(records[1].scan, 10.5) is not None
        assert robot.take(records[1].scan, 10.2) is None
        assert robot.late == 2
