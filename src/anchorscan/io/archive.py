"""Zip archives, and what reading compressed data may raise."""

from __future__ import annotations

import lzma
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from ..errors import LogError
from .bounded_file import BoundedPath

__all__ = ["BROKEN", "ZIP_MAGIC", "largest_content", "member_names", "open_archive", "open_member"]

ZIP_MAGIC = b"PK\x03\x04"

# Recordings pack to a fifth; a thousandth, which deflate can reach, is a trap.
_SMALL_CONTENT = 1 << 22
_MOST_FOLDED = 100

# What gzip, zipfile and their decompressors raise on data that stops or was altered; a
# RuntimeError is a member that wants a password, or a compression that Python does not have.
BROKEN = (
    OSError,
    EOFError,
    ValueError,
    OverflowError,
    RuntimeError,
    struct.error,
    zlib.error,
    lzma.LZMAError,
    zipfile.BadZipFile,
)


@contextmanager
def open_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a zip archive.

    Raises:
        LogError: It cannot be read.
    """
    with BoundedPath(path).open("rb") as stream:
        try:
            archive = zipfile.ZipFile(stream)
        except BROKEN as error:
            raise LogError(f"the zip archive cannot be read: {error}", path) from None
        with archive:
            yield archive


def largest_content(packed: int) -> int:
    """Return to how many bytes at most a compressed file of ``packed`` bytes may unfold."""
    return max(_SMALL_CONTENT, _MOST_FOLDED * packed)


@contextmanager
def open_member(path: Path, name: str) -> Iterator[IO[bytes]]:
    """Open a file in a zip archive.

    Raises:
        LogError: The archive cannot be read, or the file unfolds beyond all measure.
    """
    with open_archive(path) as archive:
        size, limit = archive.getinfo(name).file_size, largest_content(path.stat().st_size)
        if size > limit:
            raise LogError(f"{name} unfolds to {size} bytes, more than a recording does", path)
        with archive.open(name) as stream:
            yield stream


def member_names(path: Path) -> list[str]:
    """Return the names of the files in a zip archive.

    Raises:
        LogError: It cannot be read.
    """
    with open_archive(path) as archive:
        return [name for name in archive.namelist() if not name.endswith("/")]
