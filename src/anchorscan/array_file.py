"""Derived arrays in one file, memory-mapped where they are read: an index that can be thrown away.

A short line of JSON, behind its own checksum, says what the file was made of and where every array
lies, how large it is and what its checksum is; the arrays follow, each at a multiple of 64 bytes,
little endian.  None may lie over another, and the room behind one is nobody else's.
Nothing in the file is code and nothing is pickled.  A file is written beside its place and
renamed, so that readers see the old one or the new one, and keep the one that they have opened.
Who changes a file in its place instead, or cuts it short, pulls it from under its readers: the
system ends them.

What is mapped may be written to: changes are this process's own and never reach the file.  An
array may have *room* behind it, a hole in the file that takes no place on the disk until then.
"""

from __future__ import annotations

import glob
import json
import math
import mmap
import os
import secrets
import time
import zlib
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["keep_names", "read_arrays", "write_arrays"]

_MAGIC = b"anchorscan arrays 2\n"
_ALIGNED = 64
# The head is read whole: longer ones are damage.
_LONGEST_HEAD = 1 << 20
# Its checksum: eight digits and a blank.
_CHECKSUM = 9
# Checksums are of pieces of so many bytes, so that several threads can share an array.
_PIECE = 1 << 24
_THREADS = 4
# A draft that nobody has written to for so many seconds was left by a process that was killed.
_FORSAKEN = 3600.0


def write_arrays(
    path: Path,
    arrays: Mapping[str, NDArray[Any]],
    made_of: str,
    room: Mapping[str, int] | None = None,
) -> None:
    """Write arrays into one file, or leave what was there.

    A process killed meanwhile leaves a hidden draft beside it, ``.NAME.*.part``; a later one
    removes that.

    Args:
        path: The file; it is replaced as a whole.
        arrays: By name.
        made_of: What they were derived from (a digest, say): the key to read them with.
        room: Rows by which an array is longer when it is read; what they hold is no matter.

    Raises:
        OSError: The file cannot be written.
    """
    kept = {name: _little(array) for name, array in arrays.items()}
    head, offsets, end = _head(kept, made_of, room or {})
    _remove_forsaken(path)
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with draft.open("xb") as stream:
            stream.write(_MAGIC + head)
            for name, array in kept.items():
                stream.seek(offsets[name])
                stream.write(_bytes(array))
            stream.truncate(end)
            stream.flush()
            os.fsync(stream.fileno())
        draft.replace(path)
        keep_names(path.parent)
    finally:
        draft.unlink(missing_ok=True)


def keep_names(folder: Path) -> None:
    """Have the names of a folder's files outlast a loss of power, where the system can."""
    with suppress(OSError):
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def read_arrays(path: Path, made_of: str, *, verify: bool = True) -> dict[str, NDArray[Any]] | None:
    """Map the arrays of a file; what is written to them stays in this process.

    Args:
        path: The file.
        made_of: What they must have been derived from.
        verify: Compare the checksums, which reads the file once.

    Returns:
        Arrays by name; None where there is no such file, or it was made of something else, cut
        short, or damaged: then it has to be made anew.
    """
    try:
        with path.open("rb") as stream:
            if stream.read(len(_MAGIC)) != _MAGIC:
                return None
            checksum, _, line = stream.readline(_LONGEST_HEAD).partition(b" ")
            size = os.fstat(stream.fileno()).st_size
            whole = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_COPY)
    except (OSError, ValueError):
        return None
    try:
        if int(checksum, 16) != zlib.crc32(line):
            return None
        head = json.loads(line)
        if head["made_of"] != made_of or head["bytes"] != size:
            return None
        mapped = {name: _mapped(whole, entry) for name, entry in head["arrays"].items()}
        _see_apart(
            [(entry["offset"], mapped[name].nbytes) for name, entry in head["arrays"].items()]
        )
        if verify:
            _verify({name: (mapped[name], entry) for name, entry in head["arrays"].items()})
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError):
        return None
    return mapped


def _little(array: NDArray[Any]) -> NDArray[Any]:
    """The array in one piece, little endian; numbers only."""
    if array.dtype.hasobject:
        raise TypeError("only numbers go into a file of arrays")
    return np.ascontiguousarray(array, array.dtype.newbyteorder("<"))


def _bytes(array: NDArray[Any]) -> memoryview:
    """The bytes of an array in one piece, not copied."""
    return array.reshape(-1).view(np.uint8).data


def _aligned(offset: int) -> int:
    return -(-offset // _ALIGNED) * _ALIGNED


def _head(
    arrays: Mapping[str, NDArray[Any]], made_of: str, room: Mapping[str, int]
) -> tuple[bytes, dict[str, int], int]:
    """Return the line that says what lies where, the offsets in it, and the length of the file."""
    with ThreadPoolExecutor(_THREADS) as threads:
        checksums = {name: _checksums(array, threads) for name, array in arrays.items()}
    entries: dict[str, dict[str, Any]] = {
        name: {
            "dtype": array.dtype.str,
            "shape": [len(array) + room.get(name, 0), *array.shape[1:]],
            "rows": len(array),
            "offset": 0,
            "crc32": checksums[name],
        }
        for name, array in arrays.items()
    }
    head: dict[str, Any] = {"made_of": made_of, "bytes": 0, "arrays": entries}
    # Room for the numbers that follow from the length of the line itself.
    length = _CHECKSUM + len(json.dumps(head)) + 24 * (len(entries) + 1)
    end = len(_MAGIC) + length
    for entry in entries.values():
        entry["offset"] = _aligned(end)
        end = _aligned(end) + math.prod(entry["shape"]) * np.dtype(entry["dtype"]).itemsize
    head["bytes"] = end
    offsets = {name: entry["offset"] for name, entry in entries.items()}
    line = json.dumps(head).encode().ljust(length - _CHECKSUM - 1) + b"\n"
    return b"%08x " % zlib.crc32(line) + line, offsets, end


def _mapped(whole: mmap.mmap, entry: Mapping[str, Any]) -> NDArray[Any]:
    """One array of a file.

    Raises:
        ValueError: It does not lie within the file.
    """
    dtype, shape, offset = np.dtype(entry["dtype"]), tuple(entry["shape"]), int(entry["offset"])
    if dtype.hasobject or not dtype.itemsize or any(int(size) < 0 for size in shape):
        raise ValueError("no array of numbers")
    count = math.prod(shape)
    if offset < 0 or offset % _ALIGNED or offset + count * dtype.itemsize > len(whole):
        raise ValueError("an array beyond the end of the file")
    if not 0 <= int(entry["rows"]) <= shape[0]:
        raise ValueError("an array with more rows than it has")
    array = np.frombuffer(whole, dtype, count, offset) if count else np.empty(0, dtype)
    return array.reshape(shape)


def _verify(arrays: Mapping[str, tuple[NDArray[Any], Mapping[str, Any]]]) -> None:
    """Compare all checksums.

    Raises:
        ValueError: One is another.
    """
    with ThreadPoolExecutor(_THREADS) as threads:
        for array, entry in arrays.values():
            if _checksums(array[: entry["rows"]], threads) != entry["crc32"]:
                raise ValueError("an array is damaged")


def _see_apart(places: Iterable[tuple[int, int]]) -> None:
    """See that no array lies over another: writing to one would change it.

    Raises:
        ValueError: One does.
    """
    end = 0
    for offset, size in sorted(places):
        if size and offset < end:
            raise ValueError("two arrays in one place")
        end = max(end, offset + size)


def _checksums(array: NDArray[Any], threads: ThreadPoolExecutor) -> list[int]:
    """Checksums of the pieces of an array; threads for one piece would cost more than it."""
    pieces = _pieces(array)
    return list((threads.map if len(pieces) > 1 else map)(zlib.crc32, pieces))


def _pieces(array: NDArray[Any]) -> list[memoryview]:
    """The bytes of an array in pieces, not copied."""
    whole = _bytes(array)
    return [whole[first : first + _PIECE] for first in range(0, len(whole), _PIECE)]


def _remove_forsaken(path: Path) -> None:
    """Remove drafts that killed processes have left."""
    for draft in path.parent.glob(f".{glob.escape(path.name)}.*.part"):
        with suppress(OSError):
            if time.time() - draft.stat().st_mtime > _FORSAKEN:
                draft.unlink()
