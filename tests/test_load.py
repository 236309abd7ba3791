"""Threads and processes on one set say what a single one says, to the bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from anchorscan import AnchorscanError, LaserScan, ReferenceSet, drive, random_building
from anchorscan.load import Load, digest, processes, run, table, threads


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[LaserScan], list[bytes]]:
    path = tmp_path_factory.mktemp("load") / "a.apr"
    world = random_building(3)
    ReferenceSet.build(drive(world, seed=0, length=40.0), path=path)
    scans = [record.scan for record in drive(world, seed=1, length=10.0)]
    places = ReferenceSet.open(path)
    return path, scans, [digest(places.locate(scan)) for scan in scans]


def test_threads_that_share_a_new_set_answer_as_one_does(asked) -> None:
    path, scans, expected = asked
    found = threads(ReferenceSet.open(path), scans, expected, 4, 0.0)
    assert found.alike
    assert len(found.seconds) == 4 * len(scans)


def test_processes_on_one_file_answer_as_one_does(asked) -> None:
    path, scans, expected = asked
    found = processes(path, scans, expected, 2, 0.0)
    assert found.alike
    assert len(found.seconds) == 2 * len(scans)


def test_an_answer_that_differs_is_noticed(asked) -> None:
    path, scans, expected = asked
    wrong = [expected[1], *expected[1:]]
    found = threads(ReferenceSet.open(path), scans, wrong, 2, 0.0)
    assert not found.alike
    assert "| 2 threads | 2 | 1.00 | 1.00 | 1.00 | 1.0 | **no** |" in table(
        [
            Load("threads", 1, np.array([1e-3]), 1.0, True),
            Load("threads", 2, np.array([1e-3, 1e-3]), 1.0, found.alike),
        ]
    )


def test_the_99th_percentile_is_told_against_that_of_one() -> None:
    alone = Load("processes", 1, np.full(100, 2e-3), 1.0, True)
    four = Load("processes", 4, np.full(400, 5e-3), 1.0, True)
    assert table([alone, four])[2:] == [
        "| 1 process | 100 | 2.00 | 2.00 | 1.00 | 2.0 | yes |",
        "| 4 processes | 400 | 5.00 | 5.00 | 2.50 | 5.0 | yes |",
    ]


def test_without_a_scan_there_is_nothing_to_load(tmp_path: Path) -> None:
    with pytest.raises(AnchorscanError, match="no scan"):
        run(tmp_path / "a.apr", [], 1.0, lambda line: None)
