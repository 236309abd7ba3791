"""Kernels come from the disk cache only while everything that was compiled into them stands."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

CALLEE = """
from anchorscan._jit import kernel
STEP = {step}
@kernel
def more(x):
    return x + {more}
"""
CALLER = """
from anchorscan._jit import kernel
from callee import STEP, more
@kernel
def twice(x):
    return more(more(x)) + STEP
"""
RESULT = """
from anchorscan._jit import kernel
from caller import twice
@kernel
def result(x):
    return twice(x)
"""
MAIN = """
from result import result
print(result(0), sum(result.stats.cache_hits.values()))
"""


def answer(folder: Path, **environment: str) -> tuple[int, int]:
    done = subprocess.run(
        [sys.executable, "main.py"],
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    value, hits = done.stdout.split()
    return int(value), int(hits)


def write_callee(folder: Path, more: int, step: int) -> None:
    (folder / "callee.py").write_text(CALLEE.format(more=more, step=step), encoding="ascii")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in (("caller", CALLER), ("result", RESULT), ("main", MAIN)):
        (tmp_path / f"{name}.py").write_text(text, encoding="ascii")
    write_callee(tmp_path, more=1, step=0)
    return tmp_path


def test_a_kernel_is_compiled_anew_when_a_kernel_that_it_uses_has_changed(folder: Path) -> None:
    assert answer(folder) == (2, 0)
    assert answer(folder) == (2, 1)
    write_callee(folder, more=7, step=0)
    assert answer(folder) == (14, 0)
    write_callee(folder, more=7, step=100)
    assert answer(folder) == (114, 0)
    assert answer(folder) == (114, 1)


def test_kernels_work_where_no_cache_folder_is_writable(folder: Path) -> None:
    assert answer(folder, NUMBA_CACHE_DIR="/dev/null/none") == (2, 0)


ANNOUNCED = """
import logging
logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s")
import numpy
from anchorscan.covariance import held, inverses
held(numpy.eye(3)), inverses(numpy.eye(3)[None])
"""


def test_that_kernels_are_compiled_is_logged_once_and_not_when_they_come_from_the_cache(
    tmp_path: Path,
) -> None:
    said = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", ANNOUNCED],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        )
        said.append(done.stderr)
    assert said[0].startswith("anchorscan._jit: compiling for the first use")
    assert said[0].count("\n") == 1
    assert said[1] == ""
