"""Work in pieces comes out the same on a cluster, whoever dies."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from as_a_user import run, write_log

from anchorscan import (
    AnchorscanError,
    BuildingHypothesis,
    Fleet,
    LaserScan,
    LogError,
    ReferenceSet,
    benchmark,
    drive,
    random_building,
)
from anchorscan import cluster as cluster_module
from anchorscan.cluster import Spread, cluster
from anchorscan.spread_fleet import SpreadFleet

ITEMS = list(range(12))


def squared(number: int) -> int:
    if number == 5:
        raise LogError("cannot be read", "five.log")
    return number * number


def counted(piece: tuple[str, int]) -> int:
    """Leave a mark for every time that a piece is begun; the first of number 3 dies of it."""
    folder, number = piece
    begun = len(list(Path(folder).glob(f"{number}-*")))
    (Path(folder) / f"{number}-{begun}").touch()
    if number == 3 and not begun:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.02)
    return number


def slowly_made(folder: str) -> str:
    """Leave a mark for every time that it is made."""
    (Path(folder) / f"made-{time.time_ns()}").touch()
    time.sleep(4.0)
    return "made"


def sum_of(made: str, number: int) -> int:
    return len(made) + number


@pytest.fixture(scope="module")
def two_workers() -> Iterator[Spread]:
    pytest.importorskip("distributed", reason="the cluster is an extra")
    with cluster(workers=2) as spread:
        yield spread


def test_pieces_come_back_in_order_and_a_known_error_stops_nothing() -> None:
    done = list(Spread().map(squared, ITEMS))
    assert [each.item for each in done] == ITEMS
    assert [each.value for each in done] == [n * n if n != 5 else None for n in ITEMS]
    assert str(done[5].error) == "five.log: cannot be read"


def test_a_cluster_gives_what_one_process_gives(two_workers: Spread) -> None:
    assert two_workers.workers == 2

    def shown(spread: Spread) -> list[object]:
        return [(each.item, each.value, str(each.error)) for each in spread.map(squared, ITEMS)]

    assert shown(two_workers) == shown(Spread())


def test_what_is_held_is_shared_evenly(two_workers: Spread) -> None:
    (holding,) = two_workers.ask(_process, two_workers.hold(str, "abcdefghijkl"), [0])
    assert [holding.count(each) for each in set(holding)] == [6, 6]


def test_what_cannot_be_held_is_a_known_error(two_workers: Spread, tmp_path: Path) -> None:
    for spread in (Spread(), two_workers):
        with pytest.raises(AnchorscanError, match=r"five\.log"):
            spread.hold(squared, ITEMS)
        with pytest.raises(AnchorscanError, match=r"none\.apr"):
            SpreadFleet([tmp_path / "none.apr"], spread)


def test_what_takes_longer_to_make_than_anybody_is_waited_for_is_made_once(
    two_workers: Spread, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Opening many sets, and compiling where nothing is compiled yet, takes minutes."""
    two_workers.hold(str, "ab")  # the workers have imported what they need
    monkeypatch.setattr(cluster_module, "_PATIENCE", 3.0)
    held = two_workers.hold(slowly_made, [str(tmp_path)])
    assert list(two_workers.ask(sum_of, held, [1, 2])) == [[len("made") + 1], [len("made") + 2]]
    assert len(list(tmp_path.iterdir())) == 1


def test_a_killed_worker_costs_only_its_running_piece(two_workers: Spread, tmp_path: Path) -> None:
    pieces = [(str(tmp_path), number) for number in ITEMS]
    done = list(two_workers.map(counted, pieces))
    assert [each.value for each in done] == ITEMS
    begun = [len(list(tmp_path.glob(f"{number}-*"))) for number in ITEMS]
    assert begun[3] == 2
    assert sum(begun) <= len(ITEMS) + 2


def test_bench_answers_the_same_on_a_cluster(two_workers: Spread, tmp_path: Path) -> None:
    logs = []
    for seed in (11, 12):
        records = drive(random_building(seed, length=24.0, depth=14.0), seed=seed, length=90.0)
        logs.append(write_log(tmp_path / f"b{seed}.log", records[::2]))
    bad = tmp_path / "bad.log"
    bad.write_text("nonsense\n")

    def answers(spread: Spread | None) -> tuple[list[object], list[str]]:
        said: list[str] = []
        board = benchmark.run(
            [*logs, bad],
            protocols=("P1", "P4"),
            candidates=(None,),
            queries=20,
            baselines=(),
            say=said.append,
            spread=spread,
        )
        facts = [
            (s.protocol, s.place, s.method, [_timeless(answer) for answer in s.answers])
            for s in board.scores
        ]
        return facts, [line for line in said if "not read" in line]

    here, there = answers(None), answers(two_workers)
    assert here == there
    assert len(here[0]) > 2
    assert "bad.log" in here[1][0]


def test_sets_held_by_workers_answer_as_in_one_process_whoever_dies(
    two_workers: Spread, tmp_path: Path
) -> None:
    scans = []
    for seed in (11, 12, 13):
        building = random_building(seed, length=24.0, depth=14.0)
        ReferenceSet.build(drive(building, seed=seed, length=20.0)).save(tmp_path / f"{seed}.apr")
        scans += [r.scan for r in drive(building, seed=seed, length=8.0)[:24] if r.scan is not None]
    scans.insert(3, LaserScan(np.empty(0, np.float32), 0.0, 1.0))
    together = Fleet.open([tmp_path])
    expected = [list(map(_place, together.locate(scan))) for scan in scans]
    assert expected[3] == []
    alone = SpreadFleet([tmp_path], Spread())
    assert [list(map(_place, found)) for found in alone.locate_all(scans)] == expected
    spread = SpreadFleet([tmp_path], two_workers)
    assert len(spread) == 3
    answers = spread.locate_all(scans)
    found = [next(answers)]
    ((first, _),) = two_workers.ask(_process, two_workers.hold(str, "ab"), [0])
    os.kill(first, signal.SIGKILL)
    found += answers
    assert [list(map(_place, each)) for each in found] == expected


def _place(found: BuildingHypothesis) -> object:
    each = found.hypothesis
    seen = (each.reference, each.pose, each.probability, each.accepted, each.evaluation)
    return found.building, seen, each.covariance.tolist()


def _process(_: str, __: int) -> int:
    return os.getpid()


def _ended(_: str, __: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_workers_that_are_killed_one_after_the_other_come_back() -> None:
    dask = pytest.importorskip("dask", reason="the cluster is an extra")
    # Dask itself would give up a worker that is down ten milliseconds after it was lost.
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "10ms"}),
        cluster(workers=1) as spread,
    ):
        with pytest.raises(AnchorscanError, match="several workers died"):
            list(spread.ask(_ended, spread.hold(str, "a"), [0]))
        (again,) = spread.ask(_process, spread.hold(str, "a"), [0])
        assert again != [os.getpid()]


def _timeless(answer: benchmark.Answer) -> object:
    spread = None if answer.covariance is None else answer.covariance.tolist()
    return replace(answer, seconds=0.0, covariance=None).__dict__, spread


def test_build_names_a_log_that_cannot_be_read_and_takes_the_others(tmp_path: Path) -> None:
    building = random_building(11, length=24.0, depth=14.0)
    first = write_log(tmp_path / "first.log", drive(building, seed=1, length=6.0))
    second = write_log(tmp_path / "second.log", drive(building, seed=2, length=6.0))
    bad = tmp_path / "bad.log"
    bad.write_text("nonsense\n")
    reading = ("--field-of-view", 180)
    alone = tmp_path / "alone.apr"
    assert run("build", first, second, "-o", alone, *reading).code == 0
    both = tmp_path / "both.apr"
    done = run("build", first, bad, second, "-o", both, *reading)
    assert done.code == 1
    assert "bad.log" in done.err
    assert "1 of 3" in done.err
    assert both.read_bytes() == alone.read_bytes()
    every = tmp_path / "every"
    done = run("build", first, bad, second, "-o", every, "--each", *reading)
    assert done.code == 1
    assert sorted(path.name for path in every.iterdir()) == ["first.apr", "second.apr"]
    bad.write_text(first.read_text())
    again = run("build", first, bad, second, "-o", every, "--each", *reading)
    assert again.code == 0
    assert "2 were there already" in again.err
    assert (every / "bad.apr").read_bytes() == (every / "first.apr").read_bytes()


def test_build_on_workers_is_the_same_to_the_last_bit(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="the cluster is an extra")
    building = random_building(11, length=24.0, depth=14.0)
    logs = [
        write_log(tmp_path / f"{seed}.log", drive(building, seed=seed, length=6.0))
        for seed in (1, 2, 3)
    ]
    words = ("--field-of-view", 180)
    assert run("build", *logs, "-o", tmp_path / "here.apr", *words).code == 0
    done = run("build", *logs, "-o", tmp_path / "there.apr", *words, "--workers", 2)
    assert done.code == 0, done.err
    assert (tmp_path / "here.apr").read_bytes() == (tmp_path / "there.apr").read_bytes()


def test_a_cluster_that_cannot_be_had_is_one_line() -> None:
    pytest.importorskip("distributed", reason="the cluster is an extra")
    with pytest.raises(AnchorscanError, match="not both"), cluster("tcp://127.0.0.1:1", 2):
        pass
    with pytest.raises(AnchorscanError, match="no scheduler"), cluster("nonsense"):
        pass


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """A scheduler and two workers, each by its own command line in its own folder."""
    pytest.importorskip("distributed", reason="the cluster is an extra")
    told = tmp_path / "scheduler.json"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    commands = [
        ("scheduler", "--host", "127.0.0.1", "--port", "0"),
        ("worker", "--nthreads", "1", "--no-nanny", "--host", "127.0.0.1"),
        ("worker", "--nthreads", "1", "--no-nanny", "--host", "127.0.0.1"),
    ]
    started = []
    try:
        for number, words in enumerate(commands):
            folder = tmp_path / f"process-{number}"
            folder.mkdir()
            command = [sys.executable, "-m", "dask", *words, "--no-dashboard"]
            with (folder / "log").open("wb") as log:
                started.append(
                    subprocess.Popen(
                        [*command, "--scheduler-file", str(told)],
                        cwd=folder,
                        env=environment,
                        stdout=log,
                        stderr=log,
                    )
                )
        end = time.monotonic() + 60.0
        while not told.exists() and time.monotonic() < end:
            time.sleep(0.05)
        address = str(json.loads(told.read_text())["address"])
        with cluster(address) as spread:
            while spread.workers < 2 and time.monotonic() < end:
                time.sleep(0.05)
        yield address
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()


def test_workers_of_a_scheduler_find_logs_and_one_may_die(
    scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    building = random_building(11, length=24.0, depth=14.0)
    records = drive(building, seed=1, length=60.0)
    write_log(tmp_path / "first.log", records[::2])
    write_log(tmp_path / "second.log", drive(building, seed=2, length=6.0))
    monkeypatch.chdir(tmp_path)  # where no worker is
    words = ("first.log", "missing.log", "second.log", "--field-of-view", 180)
    here = run("build", *words, "-o", "here.apr")
    there = run("build", *words, "-o", "there.apr", "--scheduler", scheduler)
    assert (here.code, there.code) == (1, 1)
    assert "1 of 3" in there.err
    assert Path("here.apr").read_bytes() == Path("there.apr").read_bytes()
    nothing = run("build", "no.log", "none.log", "-o", "x.apr", "--scheduler", scheduler)
    assert nothing.code == 1
    assert "no.log" in nothing.err
    assert "2 of 2" in nothing.err

    def facts(spread: Spread | None) -> list[object]:
        board = benchmark.run(
            ["first.log"],
            protocols=("P1",),
            candidates=(None,),
            queries=20,
            baselines=(),
            spread=spread,
        )
        return [(s.place, s.method, list(map(_timeless, s.answers))) for s in board.scores]

    marks = tmp_path / "marks"
    marks.mkdir()
    with cluster(scheduler) as spread:
        assert spread.workers == 2
        done = list(spread.map(counted, [(str(marks), number) for number in ITEMS]))
        assert [each.value for each in done] == ITEMS
        assert spread.workers == 1
        assert facts(spread) == facts(None)
