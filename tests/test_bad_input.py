"""Input that is wrong on purpose or by mistake: traps, what fuzzing found, and wrong meanings."""

from __future__ import annotations

import ast
import gzip
import io
import json
import math
import pickle
import struct
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from as_a_user import run
from fuzz import seeds
from scans import drawn

import anchorscan
from anchorscan import (
    AnchorscanError,
    Fleet,
    Hypothesis,
    LaserScan,
    LogError,
    Matcher,
    Pose2D,
    Record,
    Reference,
    ReferenceSet,
    ReferenceSetError,
    Settings,
    SettingsError,
    drive,
    load_map,
    open_log,
    random_building,
)
from anchorscan.answers import read_runs
from anchorscan.localizer import Belief, Localizer
from anchorscan.plausibility import MirrorWatch, Plausibility, mirror_check
from anchorscan.robot import Robot
from anchorscan.set_check import check, detours_of
from anchorscan.wrong_data import displaced

LINE = f"FLASER 180 {' '.join(['1.5'] * 180)} 1 2 3 1 2 3 0 host 0\n".encode()


class TestTraps:
    def test_a_gzip_bomb_is_left_where_it_unfolds_beyond_measure(self, tmp_path: Path) -> None:
        path = tmp_path / "bomb.log.gz"
        skipped = b"NEFF " + b"1" * 4000 + b"\n"
        path.write_bytes(gzip.compress(LINE * 10 + skipped * 5_000))
        log = open_log(path)
        assert len(list(log)) == 10
        assert "unfolds to more" in log.problems[-1].reason

    def test_one_endless_line_of_a_gzip_bomb_is_left_too(self, tmp_path: Path) -> None:
        path = tmp_path / "bomb.log.gz"
        path.write_bytes(gzip.compress(LINE + bytes(1 << 25)))
        log = open_log(path)
        assert len(list(log)) == 1
        assert "unfolds to more" in log.problems[-1].reason

    def test_a_zip_bomb_is_refused_before_it_unfolds(self, tmp_path: Path) -> None:
        path = tmp_path / "bomb.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("a.log", LINE * 30_000)
        with pytest.raises(LogError, match="unfolds to 2"):
            open_log(path)

    def test_what_a_message_quotes_cannot_break_its_line_or_speak_to_the_terminal(
        self, tmp_path: Path
    ) -> None:
        path = tmp_path / "bomb.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("a\n\x1b[2Jb\u2028.log", LINE * 30_000)
        with pytest.raises(LogError, match="unfolds to 2") as refusal:
            open_log(path)
        assert r"a\n\x1b[2Jb\u2028.log unfolds" in str(refusal.value)
        assert str(refusal.value).isprintable()

    def test_a_log_that_packs_well_is_no_bomb(self, tmp_path: Path) -> None:
        path = tmp_path / "still.log.gz"
        path.write_bytes(gzip.compress(LINE * 100))
        assert len(list(open_log(path))) == 100

    def test_a_header_that_promises_a_billion_readings_costs_nothing(self, tmp_path: Path) -> None:
        stream = io.BytesIO()
        header = {"descr": "<f4", "fortran_order": False, "shape": (1, 10**9)}
        np.lib.format.write_array_header_1_0(stream, header)
        path = tmp_path / "a.npy"
        path.write_bytes(stream.getvalue() + bytes(100))
        with pytest.raises(LogError, match="promise 1000000000 readings"):
            open_log(path)

    @pytest.mark.parametrize(
        ("text", "reason"),
        [
            (b"a: &a [x, x]\nb: &b [*a, *a]\nmode: *b\n", "aliases"),
            (b"[" * 16_000, "brackets"),
            (b"{a: " * 4_000, "brackets"),
            (b"image: m.pgm\nresolution: " + b"1:" * 7000 + b"1\n", "must be a number"),
            (b"image: m.pgm\n" + b"#" * (1 << 15), "too many for a map"),
        ],
        ids=["aliases", "nested lists", "nested maps", "sexagesimal", "long"],
    )
    def test_a_maps_yaml_that_grows_when_read_is_refused(
        self, text: bytes, reason: str, tmp_path: Path
    ) -> None:
        pytest.importorskip("yaml")
        path = tmp_path / "m.yaml"
        path.write_bytes(text)
        with pytest.raises(LogError, match=reason):
            load_map(path)

    def test_a_map_of_a_million_by_a_million_cells_costs_nothing(self, tmp_path: Path) -> None:
        pytest.importorskip("yaml")
        path = tmp_path / "m.yaml"
        path.write_text("image: m.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n", encoding="ascii")
        (tmp_path / "m.pgm").write_bytes(b"P5\n1000000 1000000\n255\n" + bytes(100))
        with pytest.raises(LogError, match="ends before"):
            load_map(path)

    def test_a_picture_of_a_billion_pixels_is_refused(self, tmp_path: Path) -> None:
        pytest.importorskip("PIL")

        def chunk(kind: bytes, data: bytes) -> bytes:
            check = zlib.crc32(kind + data)
            return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check)

        head = chunk(b"IHDR", struct.pack(">IIBBBBB", 40_000, 40_000, 8, 0, 0, 0, 0))
        body = chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
        (tmp_path / "m.pgm").write_bytes(b"\x89PNG\r\n\x1a\n" + head + body)
        path = tmp_path / "m.yaml"
        path.write_text("image: m.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n", encoding="ascii")
        with pytest.raises(LogError, match="too many pixels"):
            load_map(path)

    @pytest.mark.parametrize(
        ("text", "reason"),
        [
            ('{"field": {"resolution": 1e999}}', "finite"),
            ('{"field": {"resolution": 1e-9}}', "greater than or equal to 0.01"),
            ('{"proposal": {"most": 1' + "0" * 30 + "}}", "proposal.most: is too large"),
            ('{"a' + "a" * 100_000 + '": 1}', "unknown setting 'aaa"),
            ("[" * 100_000, "not JSON"),
        ],
        ids=["infinite", "tiny", "huge", "long name", "nested"],
    )
    def test_settings_that_no_stage_could_work_with_are_refused(
        self, text: str, reason: str
    ) -> None:
        with pytest.raises(SettingsError, match=reason) as caught:
            Settings.from_json(text)
        assert len(str(caught.value)) < 300

    def test_a_ray_of_a_light_minute_is_no_return(self) -> None:
        scan = LaserScan(np.full(40, 1e12), -1.0, 0.05, 0.0, math.inf)
        assert not scan.is_return.any()
        references = [Reference(n, scan, pose) for n, (scan, pose) in enumerate(seeds.rooms())]
        assert Matcher(references).locate(scan) == []

    def test_limits_beyond_what_readings_can_hold_are_limits(self) -> None:
        scan = LaserScan([1.0, 2.0], 0.0, 0.1, 0.0, 1e300)
        assert scan.is_return.all()
        assert not LaserScan([1.0, 2.0], 0.0, 0.1, 1e299, 1e300).is_return.any()

    def test_a_scan_of_a_million_readings_is_answered_and_nowhere(
        self, records: list[Record]
    ) -> None:
        places = ReferenceSet.build(records)
        angles = np.arange(1_000_000) * 6.0e-6
        for ranges in (np.ones(len(angles)), 3.0 + np.sin(40.0 * angles)):
            found = places.locate(LaserScan(ranges, angle_min=-3.0, angle_increment=6.0e-6))
            assert not any(each.accepted for each in found)


class TestWhatFuzzingFound:
    def test_a_run_whose_compression_is_damaged_is_an_error(self, tmp_path: Path) -> None:
        data = bytearray(gzip.compress(b'{"scan": 0, "accepted": false, "hypotheses": []}\n'))
        data[12:20] = bytes(8)
        path = tmp_path / "a.jsonl.gz"
        path.write_bytes(data)
        with pytest.raises(LogError, match="cannot be read"):
            read_runs(path)

    def test_a_run_with_numbers_beyond_all_integers_is_passed_over(self, tmp_path: Path) -> None:
        path = tmp_path / "a.jsonl"
        path.write_text(
            '{"scan": Infinity, "accepted": false, "hypotheses": []}\n'
            '{"scan": 1, "accepted": false, "hypotheses": []}\n',
            encoding="ascii",
        )
        (found,) = read_runs(path)
        assert [number for number, _ in found.problems] == [1]

    @pytest.mark.parametrize("name", [b"range_max", b"angle_min", b"frame_id"])
    def test_a_recording_whose_definition_lacks_a_field_is_an_error(
        self, name: bytes, tmp_path: Path
    ) -> None:
        pytest.importorskip("rosbags")
        path = tmp_path / "a.bag"
        path.write_bytes(seeds.bags()[0].replace(name, name[:-1] + b"q"))
        with pytest.raises(LogError, match=f"no (header.)?{name.decode()} that can be read"):
            open_log(path)

    @pytest.mark.parametrize(
        ("right", "wrong"),
        [(b"message_count: 2\n    topic", b"message_count: 2|\n    topic"), (b"/scan", b"[]")],
    )
    def test_a_recording_whose_metadata_say_no_number_or_name_is_an_error(
        self, right: bytes, wrong: bytes, tmp_path: Path
    ) -> None:
        pytest.importorskip("rosbags")
        metadata, _ = seeds.metadata()
        assert metadata != metadata.replace(right, wrong)
        (tmp_path / "metadata.yaml").write_bytes(metadata.replace(right, wrong))
        (tmp_path / "run.db3").write_bytes(seeds.storage())
        with pytest.raises(LogError, match="cannot be read as a recording"):
            open_log(tmp_path)

    def test_a_reference_beyond_the_earth_is_an_error_even_if_it_shows_nothing(self) -> None:
        nothing = LaserScan(np.empty(0, np.float32), 0.0, 0.1)
        places = ReferenceSet()
        places.add(nothing, Pose2D(3.0, 2e307, 0.0))
        with pytest.raises(AnchorscanError, match="km away"):
            places.locate(LaserScan.from_field_of_view([1.0, 2.0, 3.0], math.pi))


class _Trap:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return Path.touch, (Path("trapped"),)


class TestNothingIsRun:
    def test_pickles_are_refused(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        trap = np.array([_Trap()], dtype=object)
        np.save("a.npy", trap, allow_pickle=True)
        assert b"trapped" in Path("a.npy").read_bytes()
        with pytest.raises(LogError):
            open_log("a.npy")
        Path("a.npz").write_bytes(pickle.dumps(_Trap()))
        with pytest.raises(LogError):
            open_log("a.npz")
        description, table, _ = seeds.directories()[0].split(seeds.SEPARATOR)
        Path("set/scans").mkdir(parents=True)
        Path("set/set.json").write_bytes(description)
        Path("set/references.csv").write_bytes(table)
        Path("set/scans/000000.npy").write_bytes(Path("a.npy").read_bytes())
        with pytest.raises(ReferenceSetError):
            ReferenceSet.import_directory("set")
        assert not Path("trapped").exists()

    def test_no_call_allows_pickles(self) -> None:
        for path in Path(anchorscan.__file__).parent.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if not isinstance(node, ast.Call):
                    continue
                given = {word.arg: word.value for word in node.keywords}
                allowed = given.get("allow_pickle")
                assert allowed is None or ast.unparse(allowed) == "False", path
                assert ast.unparse(node.func) != "np.load" or allowed is not None, path


@pytest.fixture(scope="module")
def records() -> list[Record]:
    return drive(random_building(5), seed=5, length=60.0)


def doubts(records: list[Record]) -> str:
    plausibility = Plausibility()
    for record in records:
        plausibility.add(record)
    return "; ".join(plausibility.doubts())


class TestWrongMeaning:
    def test_sound_records_raise_no_doubt(self, records: list[Record]) -> None:
        assert doubts(records) == ""

    def test_ranges_in_millimetres_are_noticed(self, records: list[Record]) -> None:
        def tenfold(record: Record, limit: float) -> Record:
            scan = record.scan
            assert scan is not None
            geometry = (scan.angle_min, scan.angle_increment, 0.0, limit)
            return replace(record, scan=LaserScan(1000.0 * scan.ranges, *geometry))

        assert "ranges in millimetres" in doubts([tenfold(r, 1e5) for r in records])
        assert "ranges in millimetres" in doubts([tenfold(r, 80.0) for r in records[:20]])

    def test_poses_that_are_missing_here_and_there_are_no_jumps(
        self, records: list[Record]
    ) -> None:
        far = Pose2D(50.0, 0.0, 1.0)
        gappy = [
            replace(r, pose=r.pose if r.index % 2 else None, odometry=far @ r.pose)
            for r in records
            if r.pose is not None
        ]
        assert doubts(gappy) == ""

    def test_positions_in_millimetres_are_noticed(self, records: list[Record]) -> None:
        wrong = [
            replace(r, pose=Pose2D(1000 * r.pose.x, 1000 * r.pose.y, r.pose.theta))
            for r in records
            if r.pose is not None
        ]
        assert "poses jump" in doubts(wrong)

    def test_headings_in_degrees_are_noticed(self, records: list[Record]) -> None:
        wrong = [
            replace(r, pose=Pose2D(r.pose.x, r.pose.y, math.degrees(r.pose.theta)))
            for r in records
            if r.pose is not None
        ]
        assert "degrees, not radians" in doubts(wrong)

    @pytest.mark.parametrize(
        ("swapped", "said"),
        [
            ([0, 1, 1, 2, 3], "1 repeated, 0 backwards), the first at scan 2"),
            ([0, 2, 1, 3, 4], "0 repeated, 1 backwards), the first at scan 2"),
            ([4, 3, 2, 1, 0], "0 repeated, 4 backwards), the first at scan 1"),
        ],
        ids=["duplicated", "swapped", "reversed"],
    )
    def test_times_that_do_not_rise_are_noticed(
        self, swapped: list[int], said: str, records: list[Record]
    ) -> None:
        times = [replace(r, stamp=float(t)) for r, t in zip(records, swapped, strict=False)]
        assert said in doubts(times)

    def test_a_laser_upside_down_is_noticed_and_one_that_stands_is_not(
        self, records: list[Record]
    ) -> None:
        places = ReferenceSet.build(records)
        turned = [replace(r, scan=r.scan.upside_down()) for r in records if r.scan is not None]
        assert mirror_check(places, turned).is_mirrored
        assert not mirror_check(places, records).is_mirrored
        other = drive(random_building(9), seed=9, length=20.0)
        assert not mirror_check(places, other).is_mirrored

    def test_a_single_scan_asked_both_ways_is_not_located_at_its_mirror_image(self) -> None:
        symmetric = random_building(27, length=24.0, depth=14.0)
        records = drive(symmetric, seed=27, length=40.0)
        both_ways = Settings.preset().changed({"decision": {"both_ways": True}})
        trusting, wary = (ReferenceSet.build(records, settings=s) for s in (None, both_ways))
        scans = [record.scan for record in records if record.scan is not None]
        turned = [scan.upside_down() for scan in scans]
        assert sum(trusting.locate(scan)[0].accepted for scan in turned) > 20
        assert not any(wary.locate(scan)[0].accepted for scan in turned)
        located = sum(trusting.locate(scan)[0].accepted for scan in scans)
        assert sum(wary.locate(scan)[0].accepted for scan in scans) > 0.75 * located  # the price
        fleet = Fleet({"here": wary})
        assert not any(fleet.locate(scan)[0].hypothesis.accepted for scan in turned)

    def test_a_robot_whose_laser_hangs_upside_down_is_located_nowhere_and_says_why(
        self, records: list[Record]
    ) -> None:
        places = ReferenceSet.build(records)
        other = [r for r in drive(random_building(5), seed=9, length=20.0) if r.scan is not None]
        told = {}
        for is_turned in (False, True):
            robot = Robot(Localizer(places), mirror=MirrorWatch(places))
            reports = []
            for number, record in enumerate(other):
                assert record.scan is not None
                assert record.odometry is not None
                robot.odometry.add(number, record.odometry)
                scan = record.scan.upside_down() if is_turned else record.scan
                reports.append(robot.take(scan, number))
            told[is_turned] = [one.state for one in reports if one is not None].count("located")
            assert ("upside down" in robot.doubt) == is_turned
            robot.start_over()
            assert not robot.doubt
        assert told[False] > 0.3 * len(other)
        assert told[True] == 0

    def test_what_was_found_sure_is_withheld_from_a_laser_upside_down(self) -> None:
        answer = Hypothesis(0, Pose2D(), Pose2D(), np.eye(3), 0, 0, 0.5, 0.99, True)

        class Places:
            def locate(self, scan: LaserScan) -> list[Hypothesis]:
                return [replace(answer, score=1.0 if scan.angle_increment < 0.0 else 0.5)]

        class Sure:
            def update(
                self, scan: LaserScan, odometry: Pose2D | None, stamp: float, T_base_laser: Pose2D
            ) -> Belief:
                return Belief((answer,), 0.01, True)

            def reset(self) -> None: ...

        scan = LaserScan.from_field_of_view([1.0, 2.0, 3.0], math.pi)
        for robot, state in (
            (Robot(Sure()), "located"),
            (Robot(Sure(), mirror=MirrorWatch(Places())), "ambiguous"),
        ):
            report = robot.take(scan, 1.0)
            assert report is not None
            assert report.state == state

    def test_a_robot_that_stands_still_is_asked_once_and_no_more_than_two_dozen_times(self) -> None:
        asked = []

        class Places:
            def locate(self, scan: LaserScan) -> list[Hypothesis]:
                asked.append(scan)
                return [Hypothesis(0, Pose2D(), Pose2D(), np.eye(3), 0, 0, 0.5, 0.99, True)]

        scan = LaserScan.from_field_of_view([1.0, 2.0, 3.0], math.pi)
        watch = MirrorWatch(Places())
        for _ in range(100):
            watch.add(scan, Pose2D(1.0, 1.0))
        assert len(asked) == 2  # once both ways
        for number in range(100):
            watch.add(scan, Pose2D(1.0 + number, 1.0))
        assert len(asked) == 48
        assert watch.found.as_given == 24
        watch.reset()
        for _ in range(33):
            watch.add(scan)
        assert len(asked) == 48 + 6

    def test_mirrored_scans_are_refused_unless_they_are_said_to_be(
        self, records: list[Record], tmp_path: Path
    ) -> None:
        ReferenceSet.build(records, path=tmp_path / "a.apr")
        log = tmp_path / "upside-down.npz"
        scans = [record.scan for record in records[::4] if record.scan is not None]
        geometry = {"angle_min": scans[0].angle_min, "angle_increment": scans[0].angle_increment}
        np.savez(log, ranges=np.array([scan.ranges[::-1] for scan in scans]), **geometry)
        refused = run("locate", str(tmp_path / "a.apr"), str(log))
        assert refused.code == 1
        assert "mirror images" in refused.err
        done = run("locate", str(tmp_path / "a.apr"), str(log), "--upside-down")
        assert done.code == 0
        lines = [json.loads(line) for line in done.out.splitlines()]
        assert sum(line["accepted"] for line in lines) > 0.8 * len(scans)


class TestCheck:
    def test_misplaced_references_are_named_and_no_others(
        self, records: list[Record], tmp_path: Path
    ) -> None:
        chosen = ReferenceSet.build(records).references
        kept = [Record(r.identifier, r.scan, r.pose) for r in chosen]
        moved, wrong = displaced(kept, np.random.default_rng(2), 0.08)
        places = ReferenceSet(path=tmp_path / "a.apr")
        places.add_batch([r.scan for r in moved], [r.pose for r in moved])
        found = {each.reference.identifier: each for each in check(places)}
        bad = {n for n, each in found.items() if each.is_wrong}
        assert len(bad & wrong) >= 0.7 * len(wrong)
        assert len(bad - wrong) <= 0.05 * len(kept)
        for number in bad & wrong:
            if found[number].elsewhere is not None:
                assert found[number].elsewhere.distance(kept[number].pose) < 0.5
        places.close()
        done = run("check", str(tmp_path / "a.apr"))
        assert done.code == 1
        assert f"{len(bad)} do not" in done.out.splitlines()[-1]

    def test_a_sound_set_is_sound(self, records: list[Record], tmp_path: Path) -> None:
        ReferenceSet.build(records, path=tmp_path / "a.apr").close()
        done = run("check", str(tmp_path / "a.apr"))
        # One that was taken where the robot turned away from all others may be contradicted.
        assert "misplaced" not in done.out
        assert done.code == int(" 0 do not" not in done.out)
        assert " 0 do not" in done.out or " 1 do not" in done.out

    def test_a_reference_off_the_way_where_nobody_has_been_is_astray(self, tmp_path: Path) -> None:
        corridor = [(-2.0, -1.0, 62.0, -1.0), (-2.0, 1.0, 62.0, 1.0)]
        poses = [Pose2D(2.0 * k, 0.0, 0.0) for k in range(31)]
        scans = [drawn(corridor, at=pose) for pose in poses]
        poses[12] = Pose2D(24.0, 9.0, 0.0)
        with ReferenceSet(path=tmp_path / "a.apr") as places:
            places.add_batch(scans, poses)
            assert [each.verdict for each in check(places)].count("astray") == 1
        done = run("check", str(tmp_path / "a.apr"))
        assert done.code == 1
        first, last = done.out.splitlines()
        assert first.startswith("reference 12 at x 24.00 m, y 9.00 m, 0 degrees: ")
        assert "astray, a detour of 14.4 m; 0 % of its readings" in first
        assert "1 do not" in last

    def test_what_lies_on_a_way_makes_no_detour(self) -> None:
        way = np.array([[0.0, 0.0], [2.0, 0.0], [4.0, 3.0], [6.0, 0.0], [8.0, 0.0], [8.0, 2.0]])
        off = 2.0 * math.hypot(2.0, 3.0) - 4.0
        corner = 2.0 + 2.0 - math.hypot(2.0, 2.0)
        expected = [0.0, 0.0, off, 0.0, corner, 0.0, 0.0]
        way = np.append(way, [[8.0, 4.0]], axis=0)
        # Of few references a single one may make more than a quarter longer; and none but it.
        assert not detours_of(way).any()
        np.testing.assert_allclose(detours_of(way[:2]), [0.0, 0.0])
        longer = np.concatenate([np.arange(-40.0, 0.0, 2.0)[:, None] * (1.0, 0.0), way])
        np.testing.assert_allclose(detours_of(longer)[-7:], expected)
        np.testing.assert_allclose(detours_of(longer[::-1])[:7], expected[::-1])
        longer[0] = (-30.0, 9.0)  # whose sound neighbour is not to blame
        np.testing.assert_allclose(detours_of(longer)[:20], np.zeros(20))

    def test_references_in_no_order_make_no_detour(self) -> None:
        assert not detours_of(np.random.default_rng(4).uniform(-20.0, 20.0, (90, 2))).any()

    def test_a_set_without_poses_cannot_be_checked(self, tmp_path: Path) -> None:
        with ReferenceSet(path=tmp_path / "a.apr") as places:
            places.add(seeds.rooms()[0][0])
        done = run("check", str(tmp_path / "a.apr"))
        assert done.code == 1
        assert "only references with poses" in done.err
