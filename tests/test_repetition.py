"""The same questions have the same answers, whatever is about them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from anchorscan import AnchorscanError, ReferenceSet, drive, random_building
from anchorscan.repetition import Circumstance, answers, ask, compare


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A set, and a set of questions."""
    folder = tmp_path_factory.mktemp("repetition")
    world = random_building(3)
    ReferenceSet.build(drive(world, seed=0, length=12.0), path=folder / "a.apr")
    with ReferenceSet(path=folder / "scans.apr") as scans:
        scans.add_batch([record.scan for record in drive(world, seed=0, length=12.0)[3::12]])
    return folder / "a.apr", folder / "scans.apr"


def test_hash_seeds_threads_and_processes_change_no_bit(files: tuple[Path, Path]) -> None:
    places = ReferenceSet.open(files[0])
    scans = [reference.scan for reference in ReferenceSet.open(files[1]).references]
    here = answers(places, scans)
    seeded = Circumstance("", {"PYTHONHASHSEED": "1"}, ("--threads", "4"))
    assert ask(*files, seeded).tobytes() == here.tobytes()
    assert answers(places, scans, processes=2).tobytes() == here.tobytes()
    # And they are answers: of scans that lie on the way of the references most are found.
    assert here[:, 0, -1].mean() > 0.5


def test_without_compilation_the_answers_are_the_same_but_for_rounding(
    files: tuple[Path, Path],
) -> None:
    places = ReferenceSet.open(files[0])
    scans = [reference.scan for reference in ReferenceSet.open(files[1]).references[:3]]
    interpreted = Circumstance("", {"NUMBA_DISABLE_JIT": "1", "PYTHONWARNINGS": "ignore"}, most=3)
    found = compare(answers(places, scans), ask(*files, interpreted))
    assert found.position < 1e-6
    assert found.heading < 1e-6
    assert found.probability < 1e-6
    assert found.decided == 0


def test_differences_are_those_of_the_best_hypotheses() -> None:
    one = np.zeros((3, 2, 18))
    other = one[:2].copy()
    assert compare(one, other).same
    other[0, 0, 2:5] = 3.0, 4.0, 2.0 * np.pi - 0.1
    other[1, 0, 16:18] = 0.25, 1.0
    found = compare(one, other)
    assert not found.same
    assert found.position == pytest.approx(5.0)
    assert found.heading == pytest.approx(0.1)
    assert found.probability == pytest.approx(0.25)
    assert found.decided == 1


def test_a_run_that_fails_says_why(files: tuple[Path, Path]) -> None:
    with pytest.raises(AnchorscanError, match=r"gone: .*no such file"):
        ask(files[0].with_name("none.apr"), files[1], Circumstance("gone", {}))
