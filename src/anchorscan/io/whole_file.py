"""Text files that appear when they are whole, and what is no file and is written as it comes."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from ..errors import LogError

__all__ = ["writing"]

_STREAMS = {"/dev/stdout": 1, "/dev/stderr": 2}
_DESCRIPTOR = re.compile(r"/(?:dev|proc/self)/fd/(\d{1,9})")


@contextmanager
def writing(path: str | Path) -> Iterator[TextIO]:
    """Give a stream to a file, which is replaced when all is written; else it stays as it was.

    Pipes and devices are written to at once.  So are streams that are open already, as
    ``/dev/stdout`` is, where they stand: behind what is in them.

    Raises:
        LogError: The file cannot be written.
    """
    path = Path(path)
    try:
        with _opened(path) as stream:
            yield stream
    except BrokenPipeError:
        raise
    except OSError as error:
        raise LogError(f"cannot be written: {error.strerror or error}", path) from None


@contextmanager
def _opened(path: Path) -> Iterator[TextIO]:
    descriptor = _descriptor(path)
    if descriptor is not None:
        with open(os.dup(descriptor), "w", encoding="utf-8", newline="\n") as stream:
            yield stream
        return
    target = path.resolve()
    if target.is_dir():
        raise LogError("is a folder; name a file in it", path)
    if target.exists() and not target.is_file():  # a pipe or a device
        with target.open("w", encoding="utf-8", newline="\n") as stream:
            yield stream
        return
    draft = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        with draft.open("w", encoding="utf-8", newline="\n") as stream:
            yield stream
        draft.replace(target)
    finally:
        draft.unlink(missing_ok=True)


def _descriptor(path: Path) -> int | None:
    """Return the number of an open stream by whose name a file is called, if it is."""
    if path.as_posix() in _STREAMS:
        return _STREAMS[path.as_posix()]
    found = _DESCRIPTOR.fullmatch(path.as_posix())
    return None if found is None else int(found[1])
