"""``anchorscan endure repeat``: the same questions under other circumstances.

The same set and the same scans are asked again in new processes: once more, with other hash
seeds, by threads and by processes, without compilation, and by other versions of Python.  All
but the last two must say the same to the bit.  Compiled code may fuse a product and a sum where
Python rounds twice, and libraries differ from version to version: there, the largest differences
are told.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import AnchorscanError
from .hypothesis import Hypothesis
from .reference_set import ReferenceSet
from .scan import LaserScan

__all__ = ["CIRCUMSTANCES", "Circumstance", "Difference", "answers", "ask", "compare", "run"]

# Columns of an answer.
_COLUMNS = 18
_POSITION, _HEADING, _PROBABILITY, _ACCEPTED = slice(2, 4), 4, 16, 17


@dataclass(frozen=True)
class Circumstance:
    """How a process is started that asks the questions.

    Args:
        name: What the table calls it.
        environment: Variables that it sees beside the usual ones.
        words: For its command line.
        python: The interpreter.
        exact: Whether its answers must be the same to the bit.
        most: At most so many questions, where it is slow.
    """

    name: str
    environment: Mapping[str, str]
    words: tuple[str, ...] = ()
    python: str = sys.executable
    exact: bool = True
    most: int | None = None


CIRCUMSTANCES = (
    Circumstance("once more", {}),
    Circumstance("hash seed 1", {"PYTHONHASHSEED": "1"}),
    Circumstance("hash seed 2", {"PYTHONHASHSEED": "2"}),
    Circumstance("one thread of numba's", {"NUMBA_NUM_THREADS": "1"}),
    Circumstance("2 threads", {}, ("--threads", "2")),
    Circumstance("4 threads", {}, ("--threads", "4")),
    Circumstance("2 processes", {}, ("--processes", "2")),
    Circumstance("without compilation", {"NUMBA_DISABLE_JIT": "1"}, exact=False, most=3),
)


@dataclass(frozen=True)
class Difference:
    """How far two runs of the same questions are apart.

    Args:
        same: Whether nothing differs, to the bit.
        position: Largest distance between best hypotheses, metres.
        heading: Largest turn between them, radians.
        probability: Largest difference of their probabilities.
        decided: Questions answered by one and not by the other.
    """

    same: bool
    position: float
    heading: float
    probability: float
    decided: int


def run(
    set_file: Path,
    scans_file: Path,
    say: Callable[[str], None],
    circumstances: Sequence[Circumstance] = CIRCUMSTANCES,
) -> list[Difference]:
    """Ask under all circumstances, and print a table.

    Args:
        set_file: The set.
        scans_file: A set that holds the questions.
        say: Takes the lines.
        circumstances: To compare with a usual run.

    Raises:
        AnchorscanError: A run failed.
    """
    usual = ask(set_file, scans_file, Circumstance("usual", {}))
    say(f"{len(usual)} scans; best hypotheses against those of a usual run, largest differences")
    say("| circumstance | same to the bit | metres | degrees | probability | decided otherwise |")
    say("| --- | --- | ---: | ---: | ---: | ---: |")
    found = []
    for each in circumstances:
        difference = compare(usual, ask(set_file, scans_file, each))
        found.append(difference)
        same = "yes" if difference.same else "**no**" if each.exact else "no"
        say(
            f"| {each.name} | {same} | {difference.position:.2g} | "
            f"{np.degrees(difference.heading):.2g} | {difference.probability:.2g} | "
            f"{difference.decided} |"
        )
    return found


def ask(set_file: Path, scans_file: Path, circumstance: Circumstance) -> NDArray[np.float64]:
    """Ask in a process of its own.

    Returns:
        As of `answers`.

    Raises:
        AnchorscanError: The process failed.
    """
    most = () if circumstance.most is None else ("--most", str(circumstance.most))
    home = str(Path(__file__).resolve().parents[1])
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder) / "answers.npy"
        paths = (str(set_file), str(scans_file), str(told))
        words = (*paths, *circumstance.words, *most)
        done = subprocess.run(
            [circumstance.python, "-m", "anchorscan.repetition", *words],
            env={**os.environ, "PYTHONPATH": home, **circumstance.environment},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0:
            last = (done.stderr.strip().splitlines() or ["no word"])[-1]
            raise AnchorscanError(f"{circumstance.name}: {last}")
        found: NDArray[np.float64] = np.load(told, allow_pickle=False)
        return found


def compare(usual: NDArray[np.float64], other: NDArray[np.float64]) -> Difference:
    """Compare two runs, the second of which may be shorter: it asked only the first questions."""
    one = usual[: len(other)]
    same = one.tobytes() == other.tobytes()
    apart = one[:, 0, :] - other[:, 0, :]
    turn = np.abs(np.remainder(apart[:, _HEADING] + np.pi, 2.0 * np.pi) - np.pi)
    return Difference(
        same,
        float(np.hypot(*apart[:, _POSITION].T).max(initial=0.0)),
        float(turn.max(initial=0.0)),
        float(np.abs(apart[:, _PROBABILITY]).max(initial=0.0)),
        int(np.count_nonzero(apart[:, _ACCEPTED])),
    )


def answers(
    places: ReferenceSet, scans: Sequence[LaserScan], threads: int = 1, processes: int = 1
) -> NDArray[np.float64]:
    """Locate scans.

    Args:
        places: The set.
        scans: The questions.
        threads: That share the set.
        processes: That share the work.

    Returns:
        (N, H, 18) all numbers of the best H hypotheses; zeros where there are fewer.
    """
    if processes > 1:
        found = places.locate_batch(scans, processes=processes)
    else:
        with ThreadPoolExecutor(threads) as pool:
            found = list(pool.map(places.locate, scans))
    most = places.settings.acceptance.hypotheses
    told = np.zeros((len(scans), most, _COLUMNS))
    for index, hypotheses in enumerate(found):
        for rank, each in enumerate(hypotheses[:most]):
            told[index, rank] = _numbers(each)
    return told


def _numbers(hypothesis: Hypothesis) -> NDArray[np.float64]:
    pose = hypothesis.pose
    return np.concatenate(
        (
            (hypothesis.reference, hypothesis.quality),
            np.zeros(3) if pose is None else pose.to_array(),
            hypothesis.pose_in_reference.to_array(),
            hypothesis.covariance[np.triu_indices(3)],
            (hypothesis.evaluation, hypothesis.score),
            (hypothesis.probability, hypothesis.accepted),
        )
    )


def _main() -> None:
    import argparse

    parser = argparse.ArgumentParser(description="Locate the scans of one set in another.")
    for name in ("set_file", "scans_file", "output"):
        parser.add_argument(name, type=Path)
    for name in ("--threads", "--processes"):
        parser.add_argument(name, type=int, default=1)
    parser.add_argument("--most", type=int)
    given = parser.parse_args()
    questions = ReferenceSet.open(given.scans_file).references[: given.most]
    scans = [question.scan for question in questions]
    places = ReferenceSet.open(given.set_file)
    np.save(given.output, answers(places, scans, given.threads, given.processes))


if __name__ == "__main__":
    _main()
