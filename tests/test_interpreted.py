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


def test_the_marked_tests_hold_without_compilation() -> None:
    files = [
        path
        for path in sorted(HERE.glob("test_*.py"))
        if "@pytest.mark.interpreted" in path.read_text(encoding="utf-8") and path != Path(__file__)
    ]
    words = [*files, "-q", "-m", "interpreted", "-p", "no:cacheprovider", "-W", "ignore"]
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
