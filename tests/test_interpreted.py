"""The marked tests hold without compilation too: kernels are Python that means the same.

Compiled code keeps to the types of the first call, Python to those of each value; a sum of bytes
that runs over in one of them and not in the other shows here.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
# Their maps take minutes to draw without compilation.
TOO_SLOW = (
    "test_verification.py::test_a_few_poses_go_through_the_sieves_as_the_twins_say",
    "test_proposal.py::test_readings_are_turned_to_every_heading",
)


def test_the_marked_tests_hold_without_compilation() -> None:
    files = [
        path
        for path in sorted(HERE.glob("test_*.py"))
        if "@pytest.mark.interpreted" in path.read_text(encoding="utf-8") and path.name != __file__
    ]
    slow = [f"--deselect={HERE / name}" for name in TOO_SLOW]
    words = [*files, "-q", "-m", "interpreted", "-p", "no:cacheprovider", "-W", "ignore", *slow]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *words],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        cwd=HERE.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout
