"""Damage at random, the same every time: no target may fall, hang, or hoard memory.

The long search is a command, ``make fuzz``; what it found stands in ``test_bad_input.py``.
"""

from __future__ import annotations

import importlib.util
import os
import random
import sys
from pathlib import Path

import pytest
from fuzz import targets
from fuzz.mutation import mutated
from fuzz.targets import TARGETS, HungryError, SlowError, Target, execute

from anchorscan import Record

# Executions that take about a second.
RUNS = {"bag-metadata": 200, "set-sealed": 200, "map-scans": 500, "index": 100}
RUNS |= {"scan": 200, "scan-paper": 200, "set": 200, "map": 600}
USUAL = 1000
LOGS = ("carmen", "g2o", "csv", "tum", "numpy", "archive")
RECORDINGS = ("bag", "bag-metadata", "bag-message")
NEEDS = dict.fromkeys(RECORDINGS, "rosbags") | dict.fromkeys(("map", "map-scans"), "PIL")


@pytest.mark.parametrize("name", TARGETS)
def test_damage_at_random_does_no_harm(name: str, tmp_path: Path) -> None:
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    target = TARGETS[name]
    seeds = target.seeds()
    for seed in seeds:  # what is loaded and compiled once is nobody's fault
        target.check(seed, tmp_path)
    rng = random.Random(8)
    for _ in range(RUNS.get(name, USUAL)):
        data = mutated(rng, seeds, target.words)
        try:
            execute(target, data, tmp_path)
        except Exception as error:
            pytest.fail(f"{type(error).__name__}: {error} on {data!r}")


@pytest.mark.parametrize("name", [*LOGS, *RECORDINGS])
def test_what_logs_are_damaged_from_is_sound(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    records: list[Record] = []
    monkeypatch.setattr(targets, "_check_records", records.extend)
    for seed in TARGETS[name].seeds():
        TARGETS[name].check(seed, tmp_path)
    assert any(record.scan is not None for record in records)
    assert name in RECORDINGS or any(record.pose is not None for record in records)


def test_a_target_that_hangs_or_hoards_is_caught(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def hang(data: bytes, folder: Path) -> None:
        sum(range(10**8 if data else 0))

    def hoard(data: bytes, folder: Path) -> None:
        bytes(b"\1" * (3 << 29 if data else 0))

    with pytest.raises(SlowError):
        execute(Target("hang", list, hang), b"a", tmp_path)
    monkeypatch.setattr(targets, "LONGEST", 60.0)  # so much memory takes its time
    if sys.platform == "linux" and not os.environ.get("CI"):
        with pytest.raises(HungryError):
            execute(Target("hoard", list, hoard), b"a", tmp_path)


def test_the_command_counts_its_executions() -> None:
    import subprocess

    words = ["-m", "fuzz", "csv", "--runs", "50", "--engine", "random", "--findings", "found"]
    home = Path(__file__).parent
    done = subprocess.run(
        [sys.executable, *words],
        capture_output=True,
        text=True,
        cwd=home,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        check=True,
    )
    assert "csv: 50 executions" in done.stdout
    assert importlib.util.find_spec("fuzz") is not None
