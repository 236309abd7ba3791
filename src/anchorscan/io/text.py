"""Text files as numbered lines of bytes: plain, gzipped, or one file of a zip archive.

Lines stay bytes, because logs are not always UTF-8 and only their words and numbers count.
Nothing here holds more than one line, and no line longer than `_LONGEST_LINE`.
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, cast

from ..errors import LogError
from .archive import BROKEN, ZIP_MAGIC, largest_content, member_names, open_member
from .log import Report

__all__ = ["TextFile", "find_text", "shown"]

GZIP_MAGIC = b"\x1f\x8b"

# A scan of a hundred thousand readings fits; a binary file without line ends is cut off here.
_LONGEST_LINE = 1 << 22
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_SHOWN = 24


def shown(word: bytes) -> str:
    """Return a word of a log for a message: short, printable, on one line."""
    text = word[:_SHOWN].decode("utf-8", "replace")
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    return repr(text + ("..." if len(word) > _SHOWN else ""))


@dataclass(frozen=True)
class TextFile:
    """A text file, perhaps compressed.

    Args:
        path: The file.
        compression: "", "gzip" or "zip".
        member: Name inside the zip archive.
    """

    path: Path
    compression: str = ""
    member: str = ""

    @property
    def name(self) -> str:
        """Name of the text itself, without what compressed it."""
        if self.member:
            return PurePosixPath(self.member).name
        return self.path.stem if self.compression == "gzip" else self.path.name

    @contextmanager
    def open(self) -> Iterator[IO[bytes]]:
        """Open the text as bytes.

        Raises:
            LogError: The file cannot be opened.
        """
        try:
            if self.compression == "zip":
                with open_member(self.path, self.member) as stream:
                    yield stream
            elif self.compression == "gzip":
                with gzip.open(self.path, "rb") as stream:
                    yield cast(IO[bytes], stream)
            else:
                with self.path.open("rb") as stream:
                    yield stream
        except BROKEN as error:
            raise LogError(f"cannot be read: {error}", self.path) from None

    def head(self, size: int) -> bytes:
        """Return at most ``size`` bytes of the beginning, fewer where the file is cut off."""
        pieces = bytearray()
        with self.open() as stream:
            try:
                while len(pieces) < size and (piece := stream.read(min(size, 1 << 16))):
                    pieces += piece
            except BROKEN as error:
                if not pieces:
                    raise LogError(f"cannot be read: {error}", self.path) from None
        return bytes(pieces[:size])

    def lines(self, report: Report) -> Iterator[tuple[int, bytes]]:
        """Yield the number, from one, and the bytes of every line that is not empty.

        A file that is cut off, or that unfolds beyond all measure, ends with a report instead
        of an error; so does every line that is too long to be one.
        """
        number = 0
        with self.open() as stream:
            left = largest_content(self.path.stat().st_size) if self.compression else math.inf
            while True:
                number += 1
                try:
                    line = stream.readline(_LONGEST_LINE)
                    left -= len(line)
                    if len(line) == _LONGEST_LINE:
                        report(number, "the line is too long to be a scan")
                        while len(rest := stream.readline(_LONGEST_LINE)) == _LONGEST_LINE:
                            left -= len(rest)
                            if left < 0:
                                break
                        else:
                            continue
                except BROKEN as error:
                    report(number, f"the file is damaged or cut off here: {error}")
                    return
                if left < 0:
                    report(number, "the file unfolds to more than a recording does")
                    return
                if not line:
                    return
                if number == 1:
                    line = line.removeprefix(_BYTE_ORDER_MARK)
                if line := line.strip():
                    yield number, line


def find_text(path: Path, magic: bytes) -> TextFile:
    """Tell how a text file is compressed, from its first bytes.

    Raises:
        LogError: A zip archive that is damaged, or that holds no file or several.
    """
    if magic.startswith(GZIP_MAGIC):
        return TextFile(path, "gzip")
    if not magic.startswith(ZIP_MAGIC):
        return TextFile(path)
    names = [name for name in member_names(path) if _is_visible(name)]
    if len(names) != 1:
        held = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        problem = f"holds several files ({held}); unpack the one you mean" if names else "is empty"
        raise LogError(f"the zip archive {problem}", path)
    return TextFile(path, "zip", names[0])


def _is_visible(name: str) -> bool:
    parts = PurePosixPath(name).parts
    # macOS adds a shadow of every file under this name.
    return bool(parts) and "__MACOSX" not in parts and not parts[-1].startswith(".")
