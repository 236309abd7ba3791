"""The reference set as its users see it: what goes in comes out, to the last bit."""

from __future__ import annotations

import math
import random
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from enum import Enum
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from anchorscan import (
    AnchorscanError,
    LaserScan,
    Matcher,
    Pose2D,
    Record,
    Reference,
    ReferenceSet,
    ReferenceSetError,
    SensorModel,
    Settings,
    SettingsError,
    World,
    simulate,
)
from anchorscan.hypothesis import Hypothesis
from anchorscan.set_file import MOST_READINGS, Sensor

SCAN = LaserScan(np.array([1.0, 2.0, 3.0]), -1.0, 0.5)
FLOATS = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def scans(draw: st.DrawFn) -> LaserScan:
    """Any scan that can be one: every bit pattern of a float32 is a range."""
    bits = draw(hnp.arrays(np.uint32, st.integers(0, 12)))
    increment = draw(st.floats(1e-6, 1.0)) * draw(st.sampled_from([1, -1]))
    range_min = draw(st.floats(0.0, 10.0))
    range_max = range_min + draw(st.floats(1e-3, 100.0) | st.just(math.inf))
    return LaserScan(bits.view(np.float32), draw(FLOATS), increment, range_min, range_max)


poses = st.none() | st.builds(Pose2D, FLOATS, FLOATS, FLOATS)
names = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=8)


def meaning(reference: Reference) -> tuple[object, ...]:
    """Everything a reference says, comparable to the last bit."""
    scan = reference.scan
    return (
        reference.identifier,
        scan.ranges.tobytes(),
        *(scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max),
        None if reference.pose is None else tuple(reference.pose.to_array()),
        reference.name,
    )


def meanings(places: ReferenceSet) -> list[tuple[object, ...]]:
    return [meaning(reference) for reference in places.references]


class SetAgainstDict(RuleBasedStateMachine):
    """Whatever is done to a set with a file, it and the file hold what a plain dict holds."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())
        self.copies = 0
        self.model: dict[int, tuple[object, ...]] = {}
        self.following = 0
        self.places = ReferenceSet(path=self.folder / "a.apr", name="model")

    def teardown(self) -> None:
        self.places.close()
        shutil.rmtree(self.folder)

    def note(self, identifiers: list[int], scans_: Iterable[LaserScan], *rest: object) -> None:
        assert identifiers == list(range(self.following, self.following + len(identifiers)))
        self.following += len(identifiers)
        for identifier, *place in zip(identifiers, scans_, *rest, strict=True):  # type: ignore[call-overload]
            self.model[identifier] = meaning(Reference(identifier, *place))

    @rule(scan=scans(), pose=poses, name=names)
    def add(self, scan: LaserScan, pose: Pose2D | None, name: str) -> None:
        self.note([self.places.add(scan, pose, name)], [scan], [pose], [name])

    @rule(batch=st.lists(st.tuples(scans(), poses, names), max_size=4))
    def add_batch(self, batch: list[tuple[LaserScan, Pose2D | None, str]]) -> None:
        columns = ([place[i] for place in batch] for i in range(3))
        first, *rest = columns
        self.note(self.places.add_batch(first, *rest), first, *rest)  # type: ignore[arg-type]

    @precondition(lambda self: self.model)
    @rule(data=st.data())
    def remove(self, data: st.DataObject) -> None:
        identifier = data.draw(st.sampled_from(sorted(self.model)))
        self.places.remove(identifier)
        del self.model[identifier]
        with pytest.raises(ReferenceSetError, match="there is no reference"):
            self.places.remove(identifier)

    @rule()
    def open_again(self) -> None:
        path = self.places.path
        self.places.close()
        self.places = ReferenceSet.open(path)

    @rule(onto_another=st.booleans())
    def save_and_go_on_with_the_copy(self, onto_another: bool) -> None:
        self.copies += 1
        copy = self.folder / f"{self.copies}.apr"
        if onto_another:
            with ReferenceSet(path=copy, name="other") as other:
                other.add(SCAN)
        self.places.save(copy)
        self.places.close()
        self.places = ReferenceSet.open(copy)

    @rule(to_file=st.booleans())
    def export_and_go_on_with_the_import(self, to_file: bool) -> None:
        self.copies += 1
        directory, copy = self.folder / f"{self.copies}", self.folder / f"{self.copies}.apr"
        self.places.export_directory(directory)
        self.places.close()
        self.places = ReferenceSet.import_directory(directory, path=copy if to_file else None)
        if not to_file:
            self.places.save(copy)
            self.places = ReferenceSet.open(copy)

    @invariant()
    def memory_agrees(self) -> None:
        assert meanings(self.places) == list(self.model.values())
        assert [identifier in self.places for identifier in self.model] == [True] * len(self.model)

    @invariant()
    def file_agrees(self) -> None:
        stored = ReferenceSet.open(self.places.path)
        assert meanings(stored) == list(self.model.values())
        assert stored.info().next_identifier == self.following
        assert stored.name == "model"


SetAgainstDict.TestCase.settings = settings(
    max_examples=15, stateful_step_count=12, deadline=None, suppress_health_check=list(HealthCheck)
)
TestSetAgainstDict = SetAgainstDict.TestCase


class TestValues:
    def test_places_that_cannot_be_stored_are_refused_alike_with_and_without_a_file(
        self, tmp_path: Path
    ) -> None:
        for places in (ReferenceSet(), ReferenceSet(path=tmp_path / "a.apr")):
            for scan, pose, name, words in (
                (SCAN, Pose2D(math.nan, 0, 0), "", "finite"),
                (SCAN, Pose2D(0, math.inf, 0), "", "finite"),
                (SCAN, None, "x" * 5000, "4096 bytes"),
                (SCAN, None, "\ud800", "Unicode"),
                (SCAN, None, "a\0b", "NUL"),
                (LaserScan(np.ones(MOST_READINGS + 1), 0, 1e-6), None, "", "readings"),
            ):
                with pytest.raises(ReferenceSetError, match=words) as refusal:
                    places.add_batch([SCAN, scan], [None, pose], ["", name])
                assert "\n" not in str(refusal.value)
            assert len(places) == 0
            assert places.add(SCAN) == 0

    def test_columns_of_different_lengths_are_refused(self) -> None:
        with pytest.raises(ReferenceSetError, match="2 scans, 1 poses and 2 names"):
            ReferenceSet().add_batch([SCAN, SCAN], [None])

    def test_info_says_what_is_there(self, tmp_path: Path) -> None:
        path = tmp_path / "office.apr"
        with ReferenceSet(path=path, name="office") as places:
            places.add_batch([SCAN] * 3, [Pose2D(1, -2), Pose2D(-4, 5), None])
            places.add(replace(SCAN, range_max=30.0))
            places.remove(0)
        info = ReferenceSet.open(path).info()
        assert (info.path, info.size, info.name) == (path, path.stat().st_size, "office")
        assert (info.references, info.with_pose, info.next_identifier) == (3, 1, 4)
        assert info.sensors == (
            (Sensor(3, -1.0, 0.5, 0.0, 80.0), 2),
            (Sensor(3, -1.0, 0.5, 0.0, 30.0), 1),
        )
        assert info.bounds == (-4.0, 5.0, -4.0, 5.0)
        assert info.build is None

    def test_a_topological_set_is_legal(self, tmp_path: Path) -> None:
        with ReferenceSet(path=tmp_path / "a.apr") as places:
            places.add(SCAN, name="kitchen")
        opened = ReferenceSet.open(tmp_path / "a.apr")
        assert opened[0].pose is None
        assert opened[0].name == "kitchen"
        assert opened.info().bounds is None

    def test_its_references_can_be_gone_through_and_searched_by_a_matcher(self) -> None:
        places = ReferenceSet()
        places.add_batch([SCAN, SCAN, SCAN], [None] * 3, ["hall", "kitchen", "stairs"])
        places.remove(0)
        assert list(places) == list(places.references)
        assert [each.name for each in places] == ["kitchen", "stairs"]
        assert [each.identifier for each in Matcher(places).references] == [1, 2]

    def test_a_closed_set_cannot_be_changed(self, tmp_path: Path) -> None:
        places = ReferenceSet(path=tmp_path / "a.apr")
        places.add(SCAN)
        places.close()
        for change in (lambda: places.add(SCAN), lambda: places.remove(0)):
            with pytest.raises(ReferenceSetError, match="closed"):
                change()
        assert len(places) == 1


class TestSettings:
    def test_those_given_are_stored_and_those_not_given_stay_the_readers(
        self, tmp_path: Path
    ) -> None:
        few = Settings().changed({"database": {"candidates": 3}})
        for number, given_ in enumerate((None, few)):
            path = tmp_path / f"{number}.apr"
            ReferenceSet(path=path, settings=given_).close()
            assert ReferenceSet.open(path).settings == (given_ or Settings.preset("default"))
            assert ReferenceSet.open(path, settings=few).settings == few

    def test_saving_onto_the_own_file_stores_other_settings_and_the_name(
        self, tmp_path: Path
    ) -> None:
        path = tmp_path / "a.apr"
        few = Settings().changed({"database": {"candidates": 3}})
        with ReferenceSet(path=path) as places:
            places.add(SCAN)
        with ReferenceSet.open(path, settings=few) as places:
            places.name = "office"
            places.save(path)
        opened = ReferenceSet.open(path)
        assert (opened.settings, opened.name, len(opened)) == (few, "office", 1)

    def test_settings_that_nobody_understands_leave_the_scans_within_reach(
        self, tmp_path: Path
    ) -> None:
        directory, path = tmp_path / "plain", tmp_path / "a.apr"
        places = ReferenceSet()
        places.add(SCAN)
        places.export_directory(directory)
        text = (directory / "set.json").read_text().replace("null", '{"databse": {}}')
        (directory / "set.json").write_text(text)
        ReferenceSet.import_directory(directory, path=path)
        opened = ReferenceSet.open(path)
        assert meanings(opened) == meanings(places)
        with pytest.raises(SettingsError, match=r"a\.apr: .*databse"):
            _ = opened.settings
        assert ReferenceSet.open(path, settings=Settings()).settings == Settings()


def log_of(positions: Iterable[tuple[float, float, float]]) -> list[Record]:
    return [
        Record(index, replace(SCAN, angle_min=0.001 * index), Pose2D(*position))
        for index, position in enumerate(positions)
    ]


def naive_rule(records: list[Record], spacing: float, heading: float) -> list[int]:
    """The rule of the build as it is stated, reference by reference."""
    kept: list[Record] = []
    for record in records:
        if all(
            math.hypot(record.pose.x - other.pose.x, record.pose.y - other.pose.y) > spacing
            or record.pose.turn(other.pose) > heading
            for other in kept
        ):
            kept.append(record)
    return [record.index for record in kept]


def kept(places: ReferenceSet) -> list[int]:
    """Indices of the records behind the references of a build from ``log_of``."""
    return [round(reference.scan.angle_min / 0.001) for reference in places.references]


# Steps of exactly the spacing lie within it: where a grid errs, it errs there.
coordinates = st.sampled_from([0.5 * i for i in range(-9, 10)]) | st.floats(-9.0, 9.0)
headings = st.sampled_from([i * math.pi / 8 for i in range(-8, 9)]) | st.floats(-4.0, 4.0)


class TestBuild:
    @given(
        st.lists(st.tuples(coordinates, coordinates, headings), min_size=1, max_size=60),
        st.sampled_from([0.0, 0.5, 1.0, 2.0, math.inf]) | st.floats(0.0, 5.0),
        st.sampled_from([0.0, math.pi / 8, math.pi / 4, math.pi / 2, math.pi, 7.0])
        | st.floats(0.0, 4.0),
    )
    @settings(max_examples=300, deadline=None)
    def test_the_rule_agrees_with_its_naive_twin(
        self, positions: list[tuple[float, float, float]], spacing: float, heading: float
    ) -> None:
        records = log_of(positions)
        places = ReferenceSet.build(records, spacing=spacing, heading=heading)
        assert kept(places) == naive_rule(records, spacing, heading)

    @given(st.lists(st.tuples(FLOATS, FLOATS, FLOATS), min_size=1, max_size=12))
    @settings(deadline=None)
    def test_poses_beyond_all_measure_are_no_worse(
        self, positions: list[tuple[float, float, float]]
    ) -> None:
        records = log_of(positions)
        assert kept(ReferenceSet.build(records)) == naive_rule(records, 2.0, math.pi / 4)

    def test_the_rule_agrees_with_its_naive_twin_on_real_drives(
        self, real_records: Callable[[str], list[Record]]
    ) -> None:
        records = real_records("intel.log.gz")
        places = ReferenceSet.build(records)
        naive = naive_rule(records, 2.0, math.pi / 4)
        assert [reference.pose for reference in places.references] == [
            records[index].pose for index in naive
        ]

    def test_keep_all_keeps_every_usable_scan_with_a_pose(self) -> None:
        records = log_of([(0.0, 0.0, 0.0)] * 5)
        blind = replace(SCAN, ranges=np.array([math.nan, math.inf, 0.0]))
        records[1] = replace(records[1], pose=None)
        records[2] = replace(records[2], scan=None)
        records[3] = replace(records[3], scan=blind)
        records.append(replace(records[0], pose=Pose2D(math.nan, 0, 0)))
        endless = LaserScan(np.ones(MOST_READINGS + 1), 0, 1e-6)
        records.append(replace(records[0], scan=endless))
        places = ReferenceSet.build(records, keep_all=True)
        assert kept(places) == [0, 4]
        build = places.info().build
        assert build is not None
        assert (build.consumed, build.unusable, build.without_pose) == (7, 3, 2)
        assert kept(ReferenceSet.build(records)) == [0]

    @pytest.mark.parametrize(
        ("records", "words"),
        [
            ([], "no record"),
            ([Record(0, SCAN)], "none of 1 records .* 0 have no usable scan, 1 no pose"),
            ([Record(0, None, Pose2D())], "none of 1 records .* 1 have no usable scan"),
        ],
    )
    def test_a_log_without_a_reference_is_an_error_and_leaves_no_file(
        self, records: list[Record], words: str, tmp_path: Path
    ) -> None:
        for path in (None, tmp_path / "a.apr"):
            with pytest.raises(ReferenceSetError, match=words):
                ReferenceSet.build(records, path=path)
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("rule_", [{"spacing": -1.0}, {"heading": math.nan}])
    def test_an_impossible_rule_is_refused(self, rule_: dict[str, float]) -> None:
        with pytest.raises(SettingsError, match="must not be negative"):
            ReferenceSet.build(log_of([(0, 0, 0)]), **rule_)

    def test_progress_counts_up_to_the_whole(self, tmp_path: Path) -> None:
        told: list[tuple[int, int]] = []
        records = log_of([(float(i), 0.0, 0.0) for i in range(600)])
        places = ReferenceSet.build(records, progress=lambda *counts: told.append(counts))
        assert told == sorted(told)
        assert told[-1] == (600, len(places))


class StopReadingError(Exception):
    pass


def until(records: list[Record], count: int) -> Iterator[Record]:
    yield from records[:count]
    raise StopReadingError


class TestResume:
    RECORDS = log_of(np.random.default_rng(5).uniform(-30, 30, (1500, 3)).tolist())

    @pytest.mark.parametrize("keep_all", [False, True])
    def test_a_build_interrupted_anywhere_ends_as_if_it_had_not_been(
        self, tmp_path: Path, keep_all: bool
    ) -> None:
        whole = ReferenceSet.build(self.RECORDS, keep_all=keep_all)
        stops = random.Random(1)
        path = tmp_path / "a.apr"
        for count in sorted(stops.sample(range(1500), 6)):
            with pytest.raises(StopReadingError):
                ReferenceSet.build(until(self.RECORDS, count), keep_all=keep_all, path=path)
            if path.exists():
                consumed = ReferenceSet.open(path).info().build.consumed
                assert count - 256 < consumed <= count
        resumed = ReferenceSet.build(self.RECORDS, keep_all=keep_all, path=path)
        assert meanings(resumed) == meanings(whole) == meanings(ReferenceSet.open(path))
        assert resumed.info().build == whole.info().build

    def test_a_finished_build_has_nothing_to_do(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        first = ReferenceSet.build(self.RECORDS, path=path)
        before = path.read_bytes(), path.stat().st_mtime_ns
        again = ReferenceSet.build(self.RECORDS, path=path)
        assert meanings(again) == meanings(first)
        assert (path.read_bytes(), path.stat().st_mtime_ns) == before

    def test_what_was_removed_stays_removed(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        with ReferenceSet.build(self.RECORDS, path=path) as places:
            places.remove(3)
        assert 3 not in ReferenceSet.build(self.RECORDS, path=path)

    def test_a_log_that_grew_adds_what_is_new(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        ReferenceSet.build(self.RECORDS[:700], path=path)
        grown = ReferenceSet.build(self.RECORDS, path=path)
        assert meanings(grown) == meanings(ReferenceSet.build(self.RECORDS))

    def test_other_records_another_rule_or_a_set_by_hand_are_refused(self, tmp_path: Path) -> None:
        path, by_hand = tmp_path / "a.apr", tmp_path / "b.apr"
        few = Settings().changed({"database": {"candidates": 3}})
        ReferenceSet.build(self.RECORDS, path=path, name="one")
        with ReferenceSet(path=by_hand) as places:
            places.add(SCAN)
        before = path.read_bytes(), by_hand.read_bytes()
        moved = [*self.RECORDS[:9], replace(self.RECORDS[9], pose=Pose2D()), *self.RECORDS[10:]]
        other_scan = [replace(self.RECORDS[0], scan=SCAN), *self.RECORDS[1:]]
        for records, change, words in (
            (moved, {}, "other records"),
            (other_scan, {}, "other records"),
            (self.RECORDS[:-1], {}, "other records"),
            (self.RECORDS, {"spacing": 1.0}, "another rule .*spacing 2 m, heading 45 degrees"),
            (self.RECORDS, {"heading": 1.0}, "another rule"),
            (self.RECORDS, {"keep_all": True}, "another rule"),
            (self.RECORDS, {"settings": few}, "other settings"),
            (self.RECORDS, {"name": "two"}, "another name"),
            (self.RECORDS, {"path": by_hand}, "not built from a log"),
        ):
            with pytest.raises(ReferenceSetError, match=words):
                ReferenceSet.build(records, **{"path": path, **change})
        assert (path.read_bytes(), by_hand.read_bytes()) == before


class Places(str, Enum):
    """Names that are no plain text."""

    HALL = "hall"


class TestOthers:
    """What others have done to the file, and what the map cannot hold."""

    @pytest.mark.parametrize("name", [np.array(["hall"])[0], Places.HALL])
    def test_a_name_of_another_kind_is_stored_as_text(self, name: str, tmp_path: Path) -> None:
        with ReferenceSet(path=tmp_path / "a.apr", name=name) as places:
            places.add(SCAN, Pose2D(), name)
        again = ReferenceSet.open(tmp_path / "a.apr")
        assert (again.name, again[0].name) == ("hall", "hall")
        with pytest.raises(ReferenceSetError, match="must be text"):
            ReferenceSet(name=7)  # type: ignore[arg-type]

    @pytest.mark.parametrize("path", [".", "/", ""])
    def test_a_path_without_a_name_is_no_set(self, path: str) -> None:
        with pytest.raises(ReferenceSetError, match="is a directory"):
            ReferenceSet.open(path)

    def test_a_set_in_use_refuses_what_its_map_cannot_hold(
        self, drive: list[Record], tmp_path: Path
    ) -> None:
        with ReferenceSet.build(drive, path=tmp_path / "a.apr") as places:
            asked = drive[3].scan
            before, count = places.locate(asked)[0].pose, len(places)
            with pytest.raises(ReferenceSetError, match=r"10000 km apart; is a pose wrong\?"):
                places.add_batch([asked, asked], [Pose2D(), Pose2D(1e7, 0.0, 0.0)])
            assert len(places) == len(ReferenceSet.open(tmp_path / "a.apr")) == count
            assert places.locate(asked)[0].pose == before

    def test_what_was_stored_before_the_set_was_used_can_be_removed_again(
        self, drive: list[Record], tmp_path: Path
    ) -> None:
        with ReferenceSet.build(drive, path=tmp_path / "a.apr") as places:
            far = places.add(SCAN, Pose2D(1e7, 0.0, 0.0))
            for _ in range(2):
                with pytest.raises(AnchorscanError, match="is a pose wrong"):
                    places.locate(drive[3].scan)
            places.remove(far)
            assert places.locate(drive[3].scan)[0].accepted

    @pytest.mark.parametrize("is_used", [True, False])
    def test_a_set_whose_file_was_given_another_content_changes_nothing_there(
        self, drive: list[Record], tmp_path: Path, is_used: bool
    ) -> None:
        places = ReferenceSet.build(drive, path=tmp_path / "a.apr")
        if is_used:
            places.locate(drive[3].scan)
        other = ReferenceSet()
        other.add(SCAN, Pose2D(), "other")
        other.save(tmp_path / "a.apr")
        for change in (lambda: places.add(SCAN, Pose2D()), lambda: places.remove(0)):
            with pytest.raises(ReferenceSetError, match="another set than the one"):
                change()
        (left,) = ReferenceSet.open(tmp_path / "a.apr")
        assert left.name == "other"
        places.close()

    def test_settings_and_name_that_others_stored_are_taken_over(
        self, drive: list[Record], tmp_path: Path
    ) -> None:
        path = tmp_path / "a.apr"
        places = ReferenceSet.build(drive, path=path)
        assert not places.settings.decision.both_ways
        assert places.locate(drive[3].scan)
        assert not places.refresh()
        both_ways = Settings.preset().changed({"decision": {"both_ways": True}})
        ReferenceSet.open(path, settings=both_ways).save(path)
        assert places.refresh()
        assert places.settings.decision.both_ways
        decision = places.explain(drive[3].scan).decision
        assert decision is not None
        assert math.isfinite(decision.upside_down)
        renamed = ReferenceSet.open(path)
        renamed.name = "office"
        renamed.save(path)
        assert places.refresh()
        assert places.name == "office"

    def test_numbers_of_numpy_name_references_with_and_without_an_index(
        self, drive: list[Record], tmp_path: Path
    ) -> None:
        path = tmp_path / "a.apr"
        with ReferenceSet.build(drive, path=path) as places:
            (number,), _ = places.nearest(np.array([[1.0, 0.0, 0.0]]))
            expected = meaning(places[number])
            places.save_index()
        indexed = ReferenceSet.open(path)
        assert indexed.info().index == "current"
        assert meaning(indexed[number]) == expected
        assert number in indexed


class TestExtend:
    @pytest.mark.parametrize("split", [1, 5, 9])
    def test_a_set_extended_by_the_rest_of_a_log_is_that_of_the_whole(
        self, drive: list[Record], split: int, tmp_path: Path
    ) -> None:
        whole = ReferenceSet.build(drive, spacing=1.0)
        with ReferenceSet.build(drive[:split], spacing=1.0, path=tmp_path / "a.apr") as places:
            state = places.extend(iter(drive[split:]))  # by the rule of the build
            assert state.consumed == len(drive) - split
            assert list(map(meaning, places)) == list(map(meaning, whole))
            before = len(places)
            places.extend(drive)
            assert len(places) == before
        assert len(ReferenceSet.open(tmp_path / "a.apr")) == before

    def test_another_rule_and_what_is_of_no_use_count(self) -> None:
        places = ReferenceSet()
        places.add(SCAN, Pose2D())
        blind = LaserScan([math.inf], 0.0, 0.1)
        records = [
            Record(0, SCAN, Pose2D(0.4, 0.0, 0.0)),
            Record(1, SCAN, Pose2D(0.6, 0.0, 0.0)),
            Record(2, SCAN, None),
            Record(3, blind, Pose2D()),
        ]
        state = places.extend(records, spacing=0.5, heading=1.0)
        assert (state.consumed, state.unusable, state.without_pose) == (4, 1, 1)
        assert [each.pose.x for each in places if each.pose] == [0.0, 0.6]
        places.extend(records, keep_all=True)
        assert len(places) == 4
        with pytest.raises(SettingsError, match="negative"):
            places.extend(records, spacing=-1.0)


class TestRefresh:
    def test_it_takes_over_what_others_wrote(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        with ReferenceSet(path=path) as writer:
            writer.add_batch([SCAN] * 3)
            reader = ReferenceSet.open(path)
            kept_ = reader[2]
            assert not reader.refresh()
            writer.add(SCAN, Pose2D(1, 2, 3), "new")
            writer.remove(0)
            assert len(reader) == 3
            assert reader.refresh()
            assert meanings(reader) == meanings(writer)
            assert reader[2] is kept_
            assert not reader.refresh()

    def test_it_takes_over_another_set_in_its_place(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        with ReferenceSet(path=path) as writer:
            writer.add_batch([SCAN] * 3)
        reader = ReferenceSet.open(path)
        other = ReferenceSet(name="other")
        other.add(SCAN, name="elsewhere")
        other.save(path)
        assert reader.refresh()
        assert meanings(reader) == meanings(other)
        assert reader.name == "other"

    def test_two_writers_take_turns(self, tmp_path: Path) -> None:
        path = tmp_path / "a.apr"
        with ReferenceSet(path=path) as one, ReferenceSet.open(path) as other:
            added = [writer.add(SCAN, name=str(i)) for i, writer in enumerate([one, other] * 4)]
            assert added == list(range(8))
            other.remove(0)
            for nobody in (0, -1, 8, 10**30):
                with pytest.raises(ReferenceSetError, match=f"there is no reference {nobody}"):
                    one.remove(nobody)
            one.refresh()
            other.refresh()
            assert meanings(one) == meanings(other)
        assert meanings(ReferenceSet.open(path)) == meanings(one)
        assert [file.name for file in tmp_path.iterdir()] == ["a.apr"]


def _rooms() -> World:
    walls = [
        [(0, 0), (9, 0), (9, 6), (0, 6), (0, 0)],
        [(4, 0), (4, 2.2)],
        [(4, 3.1), (4, 6)],
        [(6.5, 6), (6.5, 4.1), (7.3, 4.1), (7.3, 6)],
        [(0, 3.7), (1.6, 3.7), (1.6, 4.4)],
    ]
    pieces = [(*a, *b) for line in walls for a, b in pairwise(line)]
    return World(walls=np.array(pieces, dtype=float), pillars=np.array([[7.4, 1.3, 0.25]]))


@pytest.fixture(scope="module")
def drive() -> list[Record]:
    """A drive through three rooms, exact."""
    sensor = SensorModel(field_of_view=2 * math.pi, resolution=math.radians(1.0))
    way = [Pose2D(1 + 0.7 * i, 2.6 + 0.4 * math.sin(i), 0.3 * i) for i in range(11)]
    world = _rooms()
    return [Record(i, simulate(world, pose, sensor), pose) for i, pose in enumerate(way)]


def answers(hypotheses: list[Hypothesis]) -> list[tuple[object, ...]]:
    return [(h.reference, h.pose, h.evaluation, h.quality, h.probability) for h in hypotheses]


class TestLocate:
    def test_a_reference_is_found_where_it_is(self, drive: list[Record]) -> None:
        places = ReferenceSet.build(drive, keep_all=True)
        for reference in places.references:
            best = places.locate(reference.scan, "all")[0]
            assert best.pose is not None
            assert reference.pose is not None
            assert best.pose.distance(reference.pose) < 0.05
            assert best.pose.turn(reference.pose) < math.radians(1.0)

    def test_the_file_answers_as_the_set_in_memory(
        self, drive: list[Record], tmp_path: Path
    ) -> None:
        path = tmp_path / "a.apr"
        built = ReferenceSet.build(drive, spacing=1.0, path=path)
        opened = ReferenceSet.open(path)
        opened.prepare()
        for record in drive:
            assert answers(opened.locate(record.scan)) == answers(built.locate(record.scan))
            trace = opened.explain(record.scan)
            assert answers(list(trace.hypotheses)) == answers(built.locate(record.scan))

    def test_a_change_counts_from_the_next_scan_on(
        self, drive: list[Record], tmp_path: Path
    ) -> None:
        path = tmp_path / "a.apr"
        ReferenceSet.build(drive[:3], keep_all=True, path=path)
        new = drive[7]
        with ReferenceSet.open(path) as places, ReferenceSet.open(path) as reader:
            for each in (places, reader):
                assert 3 not in {h.reference for h in each.locate(new.scan, "all")}
            identifier = places.add(new.scan, new.pose)
            reader.refresh()
            for each in (places, reader):
                assert each.locate(new.scan)[0].reference == identifier
            fresh = ReferenceSet.open(path)
            for record in drive:
                assert answers(places.locate(record.scan)) == answers(fresh.locate(record.scan))
            places.remove(identifier)
            reader.refresh()
            for each in (places, reader):
                assert identifier not in {h.reference for h in each.locate(new.scan, "all")}

    @pytest.mark.parametrize("processes", [1, 2, 5])
    def test_a_batch_answers_as_its_scans_one_by_one(
        self, drive: list[Record], processes: int
    ) -> None:
        places = ReferenceSet.build(drive, spacing=1.0)
        scans_ = [record.scan for record in drive]
        batch = places.locate_batch(scans_, "all", processes=processes)
        assert [answers(found) for found in batch] == [
            answers(places.locate(scan, "all")) for scan in scans_
        ]

    def test_with_other_threads_about_workers_are_not_forked_and_answer_alike(
        self, drive: list[Record]
    ) -> None:
        places = ReferenceSet.build(drive, spacing=1.0)
        scans_ = [record.scan for record in drive[:4]]
        with ThreadPoolExecutor(1) as threads:
            threads.submit(int).result()
            batch = places.locate_batch(scans_, processes=2)
        assert [answers(found) for found in batch] == [
            answers(places.locate(scan)) for scan in scans_
        ]

    def test_an_empty_batch_and_an_empty_set_find_nothing(self) -> None:
        assert ReferenceSet().locate_batch([], processes=2) == []
        assert ReferenceSet().locate(SCAN) == []
