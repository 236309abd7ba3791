"""Fixtures: where real logs lie, and what to say when they are absent."""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable
from pathlib import Path

import hypothesis
import pytest

from anchorscan import LaserScan, Record

# No test measures time, and the first example of one may wait for a kernel to be compiled.  The
# same examples every time, so that a change is judged by what it changes; others on request.
hypothesis.settings.register_profile(
    "anchorscan",
    deadline=None,
    derandomize="ANCHORSCAN_EXPLORE" not in os.environ,
    print_blob=True,
)
hypothesis.settings.load_profile("anchorscan")

DATA = Path(
    os.environ.get(
        "ANCHORSCAN_DATA", Path(__file__).resolve().parents[1] / ".." / "shared" / "data"
    )
)


@pytest.fixture(scope="session")
def data_file() -> Callable[[str], Path]:
    """Give the path of a file in the data folder, or skip the test when it is absent."""

    def find(name: str) -> Path:
        path = DATA / name
        if not path.exists():
            pytest.skip(f"{name} is not in {DATA} (set ANCHORSCAN_DATA to the folder of the logs)")
        return path

    return find


@pytest.fixture(scope="session")
def real_records(data_file: Callable[[str], Path]) -> Callable[[str], list[Record]]:
    """Give the records of a log in the data folder, read once; or skip the test."""
    from anchorscan import open_log

    @functools.cache
    def read(name: str) -> list[Record]:
        return list(open_log(data_file(name)))

    return read


# A few scans of each log: a sensor of 180 degrees or more, and the turntable of a small robot.
_SAMPLED = ("freiburg-101.log.gz", "csail.log.gz", "olin", "killian")
_SAMPLES = 6


def pytest_configure(config: pytest.Config) -> None:
    """Name the marks that tests carry."""
    config.addinivalue_line(
        "markers", "interpreted: also run without compilation, by tests/test_interpreted.py"
    )


# Few tests that take long: begun last, one core would wait for them alone.
_LONG = ("test_cluster.py", "test_documentation.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest; the others stay in their order."""
    items.sort(key=lambda item: item.path.name not in _LONG)


@pytest.fixture(scope="session", params=_SAMPLED)
def real_scans(
    request: pytest.FixtureRequest, real_records: Callable[[str], list[Record]]
) -> list[LaserScan]:
    """Give a few scans of a real log, spread over its first part; or skip the test."""
    from anchorscan import open_log

    if request.param == "killian":
        home = pytest.importorskip("rtbdata", reason="Killian Court comes with rtb-data")
        log = open_log(Path(home.__file__).parent / "data" / "killian.g2o.zip")
        records = list(itertools.islice(log, 40 * _SAMPLES))
    else:
        records = real_records(request.param)
    scans = [record.scan for record in records if record.scan is not None]
    return scans[:: -(-len(scans) // _SAMPLES)]
