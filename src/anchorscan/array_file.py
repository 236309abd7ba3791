"""Derived arrays in one file, memory-mapped where they are read: an index that can be thrown away.

A short line of JSON says what the file was made of and where every array lies, how large it is
and what its checksum is; the arrays follow, each at a multiple of 64 bytes, little endian.
Nothing in the file is code and nothing is pickled.  A file is written beside its place and
renamed, so that readers see the old one or the new one, and keep the one that they have opened.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["read_arrays", "write_arrays"]

_MAGIC = b"anchorscan arrays 1\n"
_ALIGNED = 64
# The head is read whole: longer ones are damage.
_LONGEST_HEAD = 1 << 20


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]], made_of: str) -> None:
    """Write arrays into one file, or leave what was there.

    Args:
        path: The file; it is replaced as a whole.
        arrays: By name.
        made_of: What they were derived from (a digest, say): the key to read them with.

    Raises:
        OSError: The file cannot be written.
    """
    kept = {name: _little(array) for name, array in arrays.items()}
    head = _head(kept, made_of)
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with draft.open("wb") as stream:
            stream.write(_MAGIC + head)
            for array in kept.values():
                stream.write(b"\0" * (_aligned(stream.tell()) - stream.tell()))
                stream.write(_bytes(array))
            stream.flush()
            os.fsync(stream.fileno())
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def read_arrays(path: Path, made_of: str, *, verify: bool = True) -> dict[str, NDArray[Any]] | None:
    """Map the arrays of a file, read-only.

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
            line = stream.readline(_LONGEST_HEAD)
            size = os.fstat(stream.fileno()).st_size
            whole = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError):
        return None
    try:
        head = json.loads(line)
        if head["made_of"] != made_of or head["bytes"] != size:
            return None
        return {name: _mapped(whole, entry, verify) for name, entry in head["arrays"].items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        return None


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


def _head(arrays: Mapping[str, NDArray[Any]], made_of: str) -> bytes:
    """Return the line that says what lies where, and how long the file is."""
    entries = {
        name: {
            "dtype": array.dtype.str,
            "shape": list(array.shape),
            "offset": 0,
            "crc32": zlib.crc32(_bytes(array)),
        }
        for name, array in arrays.items()
    }
    head: dict[str, Any] = {"made_of": made_of, "bytes": 0, "arrays": entries}
    # Room for the numbers that follow from the length of the line itself.
    length = len(json.dumps(head)) + 24 * (len(entries) + 1)
    end = len(_MAGIC) + length
    for name, array in arrays.items():
        entries[name]["offset"] = _aligned(end)
        end = _aligned(end) + array.nbytes
    head["bytes"] = end
    return json.dumps(head).encode().ljust(length - 1) + b"\n"


def _mapped(whole: mmap.mmap, entry: Mapping[str, Any], verify: bool) -> NDArray[Any]:
    """One array of a file.

    Raises:
        ValueError: It does not lie within the file, or its checksum is another.
    """
    dtype, shape, offset = np.dtype(entry["dtype"]), tuple(entry["shape"]), int(entry["offset"])
    if dtype.hasobject or any(int(size) < 0 for size in shape):
        raise ValueError("no array of numbers")
    count = math.prod(shape)
    if offset < 0 or offset + count * dtype.itemsize > len(whole):
        raise ValueError("an array beyond the end of the file")
    array = np.frombuffer(whole, dtype, count, offset) if count else np.empty(0, dtype)
    if verify and zlib.crc32(_bytes(array)) != entry["crc32"]:
        raise ValueError("an array is damaged")
    return array.reshape(shape)
