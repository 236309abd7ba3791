"""What every command tells: results whole, messages and progress on stderr, errors in one line."""

from __future__ import annotations

import errno
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any, TextIO, TypeVar, cast

import typer

from ..errors import AnchorscanError

__all__ = [
    "FAILED",
    "guarded",
    "open_closed_streams",
    "progress",
    "refuse_overwriting",
    "say",
    "write_lines",
]

Command = TypeVar("Command", bound=Callable[..., None])
Item = TypeVar("Item")

FAILED = 1
_PROGRESS_DELAY = 1.0
_PROGRESS_INTERVAL = 0.1
# What a folder that is read is made of: sets, and the parts of a recording.
_PARTS = (".apr", ".db3", ".mcap", ".yaml")


def open_closed_streams() -> None:
    """Put something in the place of standard streams that the caller closed, as ``>&-`` does.

    Python has none of them then, and the next file that is opened takes the number of one: what
    a library complains of would be written into it.  Messages go nowhere, and results are an
    error as of any file that cannot be written.
    """
    if sys.stdin is None:
        sys.stdin = _nowhere(0, "r")
    if sys.stdout is None:
        sys.stdout = _nowhere(1, "w", os.O_RDONLY)
    if sys.stderr is None:
        sys.stderr = _nowhere(2, "w")


def _nowhere(number: int, mode: str, flags: int = os.O_RDWR) -> TextIO:
    opened = os.open(os.devnull, flags)
    if opened != number:
        os.dup2(opened, number)
        os.close(opened)
    return cast(TextIO, open(number, mode, closefd=False))


def guarded(command: Command) -> Command:
    """End known errors as one line, and an interrupted or unread run without a word."""

    @wraps(command)
    def guarded(*args: Any, **kwargs: Any) -> None:
        _tell_of_compiling()
        try:
            command(*args, **kwargs)
            sys.stdout.flush()
        except AnchorscanError as error:
            say(f"error: {error}")
            raise typer.Exit(FAILED) from None
        except BrokenPipeError:
            # Whoever read us (head, less) has seen enough.
            _drop_results()
            raise typer.Exit(128 + signal.SIGPIPE) from None
        except (KeyboardInterrupt, SystemError) as error:
            if not _is_interruption(error):
                raise
            raise typer.Exit(128 + signal.SIGINT) from None
        except OSError as error:
            if error.filename is None and error.errno is None:
                raise
            place = "" if error.filename is None else f"{error.filename}: "
            if error.errno == errno.EBADF:  # as of a stdout that the caller closed
                _drop_results()
                place = "results cannot be written: "
            say(f"error: {place}{error.strerror}")
            raise typer.Exit(FAILED) from None

    return guarded  # type: ignore[return-value]


def _drop_results() -> None:
    """Let go what is buffered for a stdout that takes nothing, or Python complains at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _is_interruption(error: BaseException | None) -> bool:
    """Tell whether Ctrl-C is behind an error: while numba loads a kernel it ends in SystemError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def say(message: str) -> None:
    """Tell the user something that is no result."""
    typer.echo(message, err=True)


class _Saying(logging.Handler):
    """Says what is logged."""

    def emit(self, record: logging.LogRecord) -> None:
        say(f"note: {record.getMessage()}")


def _tell_of_compiling() -> None:
    """Have kernels that are compiled announced: else the first search seems to hang."""
    log = logging.getLogger("anchorscan._jit")
    log.setLevel(logging.INFO)
    log.handlers = [_Saying()]
    log.propagate = False


def refuse_overwriting(outputs: Iterable[Path | None], inputs: Iterable[Path | str | None]) -> None:
    """End before anything is done where a file would be written that is read, or written, too.

    Args:
        outputs: Files to write; those that nobody asked for are None.
        inputs: Files and folders to read; names of nothing are no files.

    Raises:
        AnchorscanError: It would.
    """
    written: list[Path] = []
    read = [Path(path) for path in inputs if path is not None]
    for path in (path for path in outputs if path is not None):
        if path.exists() and not path.resolve().is_file():
            continue  # a pipe or a device loses nothing, and of a folder others complain
        if any(_is_same(path, other) or _is_part(path, other) for other in read):
            raise AnchorscanError(f"{path}: is read here, and would be overwritten; name another")
        if any(_is_same(path, other) for other in written):
            raise AnchorscanError(f"{path}: would be written twice; name another")
        written.append(path)


def _is_same(a: Path, b: Path) -> bool:
    """Tell whether two names are of one file, which need not be there."""
    try:
        return a.samefile(b)
    except OSError:
        return a.resolve() == b.resolve()


def _is_part(path: Path, folder: Path) -> bool:
    """Tell whether a file is what a folder is read for."""
    return path.suffix in _PARTS and folder.is_dir() and _is_same(path.parent, folder)


def write_lines(lines: Iterable[dict[str, Any]], path: Path | None) -> Iterator[dict[str, Any]]:
    """Write lines of JSON as they come, to stdout or to a file, and pass them on."""
    with _writing(path) as stream:
        for line in lines:
            stream.write(json.dumps(line, allow_nan=False) + "\n")
            stream.flush()
            yield line


@contextmanager
def _writing(path: Path | None) -> Iterator[TextIO]:
    """Give a stream to stdout or to a file that appears only when it is whole."""
    if path is None:
        yield sys.stdout
        return
    from ..io.whole_file import writing

    with writing(path) as stream:
        yield stream


def progress(items: Iterable[Item], what: str, total: int | None = None) -> Iterator[Item]:
    """Pass items on; show on a terminal how many, once that has taken a second."""
    if not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn(what),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    bar = Progress(*columns, console=Console(stderr=True), transient=True, auto_refresh=False)
    begin = shown = time.monotonic()
    task = bar.add_task(what, total=total)
    try:
        for done, item in enumerate(items, start=1):
            yield item
            now = time.monotonic()
            if now - begin > _PROGRESS_DELAY and now - shown > _PROGRESS_INTERVAL:
                bar.start()
                bar.update(task, completed=done, refresh=True)
                shown = now
    finally:
        bar.stop()
