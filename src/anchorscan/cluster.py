"""Work in pieces: in this process, on worker processes of this machine, or on many machines.

A piece is a function of a module of this package and one plain value.  Without a cluster pieces
are done one after the other, here; with one, Dask (``dask.distributed``) hands them to its workers,
does a piece again whose worker has died, and the results come back in the order of the pieces.
So the outcome is the same, whoever did the work.  What takes long to make and is asked often stays
with a worker, as an actor of Dask, whose work no other worker may steal.

Workers run whatever a scheduler sends them: a scheduler belongs into a network that is trusted.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

from .errors import AnchorscanError, MissingExtraError

__all__ = ["Done", "Holder", "Spread", "cluster"]

Item = TypeVar("Item")
Result = TypeVar("Result")
Held = TypeVar("Held")

# Pieces that may wait for a worker; more would only fill memory.
_AHEAD = 4
# What asking a worker ends with that has died, or does not come to hold anything.
_LOST = (OSError, RuntimeError, asyncio.TimeoutError)
# Of workers that were asked the same, until the question is to blame.
_DEATHS = 3
# Seconds until nobody answers: a scheduler, or a worker that is to hold something.
_PATIENCE = 60
# Dask looks at a worker of this machine once, so long after it was lost, and never starts it again
# if it happens to be down just then: killed for a second time, or slow to start.
_LOOKED_AT_AGAIN = {"distributed.deploy.lost-worker-timeout": "1d"}


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
        return 0 if self._client is None else len(self._client.nthreads())

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
        submit = partial(self._client.submit, piece, pure=False)
        for item, future in _ahead(items, submit, most):
            yield _result(item, future)

    def hold(self, make: Callable[[Item], Held], items: Iterable[Item]) -> list[Holder[Held]]:
        """Make values that stay with who makes them, to be asked.

        Args:
            make: Of a module, so that other processes can find it.
            items: What to make them from, plain values.

        Returns:
            For ``ask``, in the order of the items; shared evenly among the workers.

        Raises:
            AnchorscanError: The first known error that one of them ended with.
        """
        workers = [] if self._client is None else sorted(self._client.nthreads())
        wishes = workers if len(workers) > 1 else [None]
        holders = [
            Holder(make, item, self._client, wishes[n % len(wishes)])
            for n, item in enumerate(items)
        ]
        list(self.ask(_nothing, holders, [None]))
        return holders

    def ask(
        self,
        function: Callable[[Held, Item], Result],
        holders: Sequence[Holder[Held]],
        questions: Iterable[Item],
    ) -> Iterator[list[Result]]:
        """Ask all that is held the same questions.

        Args:
            function: Of a module; of what is held and a question.
            holders: Given by ``hold``.
            questions: Plain values.

        Yields:
            For each question the answers, in the order of the holders.

        Raises:
            AnchorscanError: A known error that an answer ended with, or the same question ended
                several workers.
        """

        def put(question: Item) -> list[tuple[Any, Any]]:
            return [each.ask(function, question) for each in holders]

        for question, asked in _ahead(questions, put, 1 if self._client is None else _AHEAD):
            yield [
                each.answer(function, question, one)
                for each, one in zip(holders, asked, strict=True)
            ]


class Holder(Generic[Held]):
    """What a worker holds, made anew by another one when that worker has died.

    Args:
        make: Of a module.
        item: What to make it from.
        client: Of Dask; None holds it here.
        wish: Address of the worker that is to hold it; whichever Dask chooses if None.
    """

    def __init__(
        self, make: Callable[[Any], Held], item: object, client: Any, wish: str | None = None
    ) -> None:
        self._recipe = (make, item)
        self._client = client
        self._made: Any = None
        self._make(wish)

    def ask(self, function: Callable[[Held, Any], Any], question: object) -> tuple[Any, Any]:
        """Put a question; ``answer`` waits for what this returns."""
        if self._client is None:
            return self._made, None
        try:
            return self._made, self._made.result(_PATIENCE).ask(function, question)
        except _LOST as error:
            return self._made, error

    def answer(
        self, function: Callable[[Held, Any], Any], question: object, asked: tuple[Any, Any]
    ) -> Any:
        """Give the answer, of another worker if the one that was asked has died.

        Raises:
            AnchorscanError: A known error of the answer, or several workers died.
        """
        made, answer = asked
        if self._client is None:
            return _value(made.ask(function, question))
        for _ in range(_DEATHS):
            try:
                if isinstance(answer, Exception):
                    raise answer
                return _value(answer.result())
            except _LOST as error:
                died = error
            if made is self._made:
                self._make()
            made, answer = self.ask(function, question)
        raise AnchorscanError(f"several workers died of the same question: {died}") from died

    def _make(self, wish: str | None = None) -> None:
        """Have it made, anew without a wish.

        Dask gives what was wished for a worker that has died to another one that is there, but
        never to one that comes later.
        """
        if self._client is None:
            self._made = _Held(*self._recipe)
            return
        self._made = self._client.submit(
            _Held,
            *self._recipe,
            actor=True,
            pure=False,
            workers=wish and [wish],
            allow_other_workers=wish is not None,
        )


class _Held(Generic[Held]):
    """A value at its worker, made when it is first asked.

    To make it may take minutes, and an actor that is slow to come cannot be told from one that
    never comes; one that is slow to answer can, since Dask notices when its worker dies.
    """

    def __init__(self, make: Callable[[Any], Held], item: object) -> None:
        self._recipe = (make, item)
        self._made: Done[Any, Held] | None = None

    def ask(self, function: Callable[[Held, Any], Any], question: object) -> Done[Any, Any]:
        if self._made is None:
            self._made = _done(*self._recipe)
        if self._made.value is None:
            return Done(question, None, self._made.error)
        return _done(partial(function, self._made.value), question)


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
        import dask
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
        dask.config.set(_LOOKED_AT_AGAIN),
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


def _nothing(_: object, __: None) -> None:
    """Ask for nothing, to see whether it could be made."""


def _value(done: Done[Any, Any]) -> Any:
    if done.error is not None:
        raise done.error
    return done.value


def _ahead(
    items: Iterable[Item], begin: Callable[[Item], Result], most: int
) -> Iterator[tuple[Item, Result]]:
    """Yield items with what was begun for them, at most so many ahead of who waits for them."""
    waiting: deque[tuple[Item, Result]] = deque()
    for item in items:
        waiting.append((item, begin(item)))
        if len(waiting) >= most:
            yield waiting.popleft()
    yield from waiting


def _result(item: Item, future: Any) -> Done[Item, Result]:
    from distributed import KilledWorker

    try:
        done: Done[Item, Result] = future.result()
    except KilledWorker:
        raise AnchorscanError(f"several workers died of the same piece: {item}") from None
    return done
