"""Zip archives, and what reading compressed data may raise."""

from __future__ import annotations

import lzma
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import LogError
from .bounded_file import BoundedPath

__all__ = ["BROKEN", "ZIP_MAGIC", "member_names", "open_archive"]

ZIP_MAGIC = b"PK\x03\x04"

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


def member_names(path: Path) -> list[str]:
    """Return the names of the files in a zip archive.

    Raises:
        LogError: It cannot be read.
    """
    with open_archive(path) as archive:
        return [name for name in archive.namelist() if not name.endswith("/")]
