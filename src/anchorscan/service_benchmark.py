"""``anchorscan bench-service``: sustained load on a service of this machine.

A service is started on a free port of the loopback address with a copy of the set, and clients,
each a process, ask one question after the other, for as many seconds or questions as allowed.
Beside it stands what the same scans take in this process, alone, before.  Service and
clients share the cores of the machine, so the requests a second are those of both together.
Where others use it, too, only the processor time is worth something: that of the service alone, as
Linux tells it, beside that of the same calls in this process.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from .client import RemoteSet
from .errors import AnchorscanError, ScanError, ServiceError
from .reference_set import ReferenceSet
from .scan import LaserScan

__all__ = ["run"]

_NAME = "set"
_STARTING = 180.0
_WARM_UP = 20
_IN_PROCESS = 500


def run(
    set_file: Path,
    scans: Sequence[LaserScan],
    workers: int,
    clients: int,
    queries: int,
    seconds: float,
    batch: int = 1,
) -> Iterator[str]:
    """Measure, and give the lines of a table.

    Args:
        set_file: A reference set.
        scans: To be located, over and over.
        workers: Processes of the service.
        clients: Processes that ask.
        queries: Questions of each client, at most.
        seconds: How long they go on, at most.
        batch: Scans in a question.

    Raises:
        AnchorscanError: There is no scan, or the service does not start.
    """
    if not scans:
        raise ScanError("there is no scan to ask with")
    with ReferenceSet.open(set_file) as places:
        places.prepare()
        spent = []
        used = 0.0
        for number in range(min(max(len(scans), _IN_PROCESS), queries) + _WARM_UP):
            start, before = time.perf_counter(), time.process_time()
            places.locate(scans[number % len(scans)])
            spent.append(time.perf_counter() - start)
            used += (time.process_time() - before) * (number >= _WARM_UP)
    yield (
        "| | scans a second | a second and worker | processor ms a scan | median ms a question "
        "| 99 % ms | failed |"
    )
    yield "| --- " * 7 + "|"
    alone = np.array(spent[_WARM_UP:])
    yield _row("in process", 1, len(alone), float(alone.sum()), used, alone, 0)
    with _service(set_file, workers) as (url, service):
        _Client(url, scans, _WARM_UP * workers, seconds, batch)()
        asking = _Client(url, scans, queries, seconds, batch)
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(clients, context) as pool:
            list(pool.map(_begin, range(clients)))  # started before the clock is
            start, before = time.perf_counter(), _processor_time(service)
            told = [job.result() for job in [pool.submit(asking) for _ in range(clients)]]
            total = time.perf_counter() - start
            used = _processor_time(service) - before
        taken = np.array([each for times, _ in told for each in times])
        failed = sum(count for _, count in told)
        label = f"service, {workers} workers, {clients} clients, {batch} scans a question"
        yield _row(label, workers, len(taken) * batch, total, used, taken, failed)


class _Client:
    """Asks one question after the other."""

    def __init__(
        self, url: str, scans: Sequence[LaserScan], queries: int, seconds: float, batch: int
    ) -> None:
        self.url, self.scans, self.queries = url, list(scans), queries
        self.seconds, self.batch = seconds, batch

    def __call__(self) -> tuple[list[float], int]:
        """Give the seconds of every answer, and how many questions had none."""
        times: list[float] = []
        failed = 0
        end = time.perf_counter() + self.seconds
        with RemoteSet(self.url, _NAME) as remote:
            for number in range(self.queries):
                first = number * self.batch
                asked = [self.scans[(first + k) % len(self.scans)] for k in range(self.batch)]
                start = time.perf_counter()
                if start > end:
                    break
                try:
                    if self.batch == 1:
                        remote.locate(asked[0])
                    else:
                        remote.locate_batch(asked)
                    times.append(time.perf_counter() - start)
                except ServiceError:
                    failed += 1
        return times, failed


def _begin(_: int) -> None:
    """Load what a client needs."""


@contextmanager
def _service(set_file: Path, workers: int) -> Iterator[tuple[str, int]]:
    """Serve a copy of a set on a free port until the work is done."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = int(taken.getsockname()[1])
    url = f"http://127.0.0.1:{port}"
    with tempfile.TemporaryDirectory(prefix="anchorscan-") as folder:
        shutil.copyfile(set_file, Path(folder) / f"{_NAME}.apr")
        words = ["serve", folder, "--port", str(port), "--workers", str(workers)]
        code = "from anchorscan.cli import main; main()"
        service = subprocess.Popen(
            [sys.executable, "-c", code, *words],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            _wait(url, service)
            yield url, service.pid
        finally:
            service.terminate()
            service.wait()


def _wait(url: str, service: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + _STARTING
    blank = LaserScan(np.full(9, np.inf, np.float32), 0.0, 0.1)
    while service.poll() is None and time.monotonic() < end:
        try:
            RemoteSet(url, _NAME).locate(blank)
        except ServiceError:
            time.sleep(0.2)
        else:
            return
    raise AnchorscanError("the service did not start: try anchorscan serve")


def _row(
    label: str,
    workers: int,
    count: int,
    seconds: float,
    used: float,
    times: np.ndarray[tuple[int], np.dtype[np.float64]],
    failed: int,
) -> str:
    rate = count / seconds
    median, late = (1e3 * float(np.percentile(times, q)) for q in (50, 99))
    figures = f"{rate:.0f} | {rate / workers:.0f} | {1e3 * used / count:.2f}"
    return f"| {label} | {figures} | {median:.2f} | {late:.2f} | {failed} |"


def _processor_time(process: int) -> float:
    """Return the seconds that a process and its children have used; NaN where nobody tells."""
    try:
        folder = Path(f"/proc/{process}")
        children = (folder / f"task/{process}/children").read_text().split()
        values = (folder / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return math.nan
    own = (int(values[11]) + int(values[12])) / os.sysconf("SC_CLK_TCK")
    return own + sum(_processor_time(int(child)) for child in children)
