"""Files whose headers may promise more than there is.

A damaged or hostile header can promise a record of gigabytes, and ``read`` sets that memory
aside before it finds out.  A `BoundedPath` opens files that never ask for more than is left.
"""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import IO, Any

__all__ = ["BoundedPath"]

_SMALL = 1 << 16


class _BoundedReader(io.BufferedReader):
    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > _SMALL:
            size = min(size, max(0, os.fstat(self.fileno()).st_size - self.tell()))
        return super().read(size)


class BoundedPath(type(Path())):  # type: ignore[misc]  # Path itself has no subclasses before 3.12
    """A path whose ``open("rb")`` reads no further than the file reaches."""

    def open(self, mode: str = "r", *args: Any, **kwargs: Any) -> IO[Any]:
        """Open the file, as `pathlib.Path.open` does."""
        if mode == "rb" and not args and not kwargs:
            return _BoundedReader(io.FileIO(self, "rb"))
        stream: IO[Any] = super().open(mode, *args, **kwargs)
        return stream
