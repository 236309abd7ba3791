"""Work in pieces: in this process, on worker processes of this machine, or on many machines.

A piece is a function of a module of this package and one plain value.  Without a cluster pieces
are done one after the other, here; with one, Dask (``dask.distributed``) hands them to its workers,
does a piece again whose worker has died, and the results come back in the order of the pieces.
So the outcome is the same, whoever did the work.

Workers run whatever a scheduler sends them: a scheduler belongs into a network that is trusted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

from .errors import AnchorscanError, MissingExtraError

__all__ = ["Done", "Spread", "cluster"]

Item = TypeVar("Item")
Result = TypeVar("Result")

# Pieces that may wait for a worker; more would only fill memory.
_AHEAD = 4
_PATIENCE = 30


@dataclass(frozen=True)
class Done(Generic[Item, Result]):
    """A piece that was done, or that could not be.

    Args:
        item: What it was about.
        value: What came of it; None where it failed.
        error: The known error that it ended with, if it did.
    """

    item: Item
    value: Result | None
    error: AnchorscanError | None = None


class Spread:
    """Does pieces of work; made by ``cluster``.

    Args:
        client: Of Dask; None does all here.
    """

    def __init__(self, client: Any = None) -> None:
        self._client = client

    @property
    def workers(self) -> int:
        """How many workers there are now; 0 where all is done here."""
        return 0 if self._client is None else len(self._client.scheduler_info(-1)["workers"])

    def map(
        self, function: Callable[[Item], Result], items: Iterable[Item]
    ) -> Iterator[Done[Item, Result]]:
        """Do pieces, and give what came of them in their order.

        Args:
            function: Of a module, so that other processes can find it.
            items: What the pieces are about, plain values.

        Raises:
            AnchorscanError: The same piece ended several workers.
        """
        piece = partial(_done, function)
        if self._client is None:
            yield from map(piece, items)
            return
        most = _AHEAD * max(self.workers, 1)
        waiting: deque[tuple[Item, Any]] = deque()
        for item in items:
            waiting.append((item, self._client.submit(piece, item, pure=False)))
            if len(waiting) >= most:
                yield _result(*waiting.popleft())
        while waiting:
            yield _result(*waiting.popleft())


@contextmanager
def cluster(scheduler: str | None = None, workers: int | None = None) -> Iterator[Spread]:
    """Give what does pieces of work.

    Args:
        scheduler: Address of a Dask scheduler.
        workers: Start so many worker processes on this machine instead.  With neither, all is
            done in this process.

    Raises:
        MissingExtraError: Dask is not installed.
        AnchorscanError: Nobody answers at the address, or both are given.
    """
    if scheduler is None and workers is None:
        yield Spread()
        return
    if scheduler is not None and workers is not None:
        raise AnchorscanError("name a scheduler or a number of workers, not both")
    try:
        import distributed
    except ImportError as error:
        raise MissingExtraError("a cluster", "fleet") from error
    connect: Any = distributed.Client
    start: Any = distributed.LocalCluster
    if scheduler is not None:
        try:
            client: Any = connect(scheduler, timeout=_PATIENCE)
        except (OSError, ValueError) as error:
            raise AnchorscanError(f"{scheduler}: no scheduler answers: {error}") from None
        with client:
            yield Spread(client)
        return
    with (
        start(
            n_workers=workers,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            silence_logs=50,
        ) as local,
        connect(local) as client,
    ):
        yield Spread(client)


def _done(function: Callable[[Item], Result], item: Item) -> Done[Item, Result]:
    """Do one piece; a known error is a result, since it must stop nothing else."""
    try:
        return Done(item, function(item))
    except AnchorscanError as error:
        return Done(item, None, AnchorscanError(str(error)))


def _result(item: Item, future: Any) -> Done[Item, Result]:
    from distributed import KilledWorker

    try:
        done: Done[Item, Result] = future.result()
    except KilledWorker:
        raise AnchorscanError(f"several workers died of the same piece: {item}") from None
    return done
