"""Derived arrays in one file: what is read is what was written, or nothing."""

from __future__ import annotations

import json
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from anchorscan.array_file import read_arrays, write_arrays

numbers = arrays_of.arrays(
    st.sampled_from([np.uint8, np.int32, np.uint32, np.int64, np.float32, np.float64]),
    arrays_of.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=7),
)
ARRAYS = {"keys": np.arange(1000, dtype=np.uint32), "rows": np.ones((3, 5)), "none": np.empty(0)}


@given(st.dictionaries(st.text(max_size=20), numbers, max_size=5), st.text(max_size=30))
def test_what_is_read_is_what_was_written(tmp_path_factory, arrays, made_of):
    path = tmp_path_factory.mktemp("arrays") / "index"
    write_arrays(path, arrays, made_of)
    read = read_arrays(path, made_of)
    assert list(read) == list(arrays)
    for name, array in arrays.items():
        assert read[name].dtype == array.dtype
        assert read[name].shape == array.shape
        assert read[name].tobytes() == array.tobytes()
        read[name][...] = 0  # this process's own, which the file never sees
    again = read_arrays(path, made_of)
    assert all(again[name].tobytes() == array.tobytes() for name, array in arrays.items())


def test_arrays_made_of_something_else_are_not_read(tmp_path):
    write_arrays(tmp_path / "index", ARRAYS, "yesterday's scans")
    assert read_arrays(tmp_path / "index", "today's scans") is None
    assert read_arrays(tmp_path / "nothing", "today's scans") is None


@pytest.mark.parametrize("at", [0, 3, 25, 60, 200, 700, 2000, -1])
def test_a_changed_byte_makes_the_file_useless(tmp_path, at):
    path = tmp_path / "index"
    write_arrays(path, ARRAYS, "scans")
    whole = bytearray(path.read_bytes())
    whole[at] ^= 0x11
    path.write_bytes(whole)
    read = read_arrays(path, "scans")
    # A byte between two arrays, or a blank of the first line, belongs to nothing.
    assert read is None or all(np.array_equal(read[name], ARRAYS[name]) for name in ARRAYS)


def test_no_changed_byte_goes_unnoticed(tmp_path):
    path = tmp_path / "index"
    write_arrays(path, {"keys": ARRAYS["keys"][:20]}, "scans")
    whole = path.read_bytes()
    for at in range(len(whole)):
        changed = bytearray(whole)
        changed[at] ^= 0x04
        path.write_bytes(changed)
        read = read_arrays(path, "scans")
        assert read is None or np.array_equal(next(iter(read.values())), ARRAYS["keys"][:20])


def test_a_head_that_was_changed_with_care_is_useless_too(tmp_path):
    """Its checksum is right, but an array lies over the next one, or in the room behind it."""
    path = tmp_path / "index"
    write_arrays(path, {"a": np.zeros((4, 8)), "b": np.ones((4, 8))}, "scans", {"a": 2})
    assert read_arrays(path, "scans")["a"].shape == (6, 8)
    magic, line, rest = path.read_bytes().split(b"\n", 2)
    head = json.loads(line[9:])
    for change in ({"shape": [9, 8]}, {"offset": head["arrays"]["b"]["offset"]}):
        crafted = {"a": head["arrays"]["a"] | change, "b": head["arrays"]["b"]}
        crafted["a"]["crc32"] = [
            zlib.crc32(np.ones((4, 8)).data if "offset" in change else bytes(256))
        ]
        told = json.dumps(head | {"arrays": crafted}).encode().ljust(len(line) - 9)
        checksum = b"%08x " % zlib.crc32(told + b"\n")
        path.write_bytes(b"\n".join([magic, checksum + told, rest]))
        assert read_arrays(path, "scans") is None


@pytest.mark.parametrize("left", [0, 5, 20, 100, -1])
def test_a_file_cut_short_is_useless(tmp_path, left):
    path = tmp_path / "index"
    write_arrays(path, ARRAYS, "scans")
    path.write_bytes(path.read_bytes()[:left])
    assert read_arrays(path, "scans") is None


def test_readers_keep_the_file_that_they_have_opened(tmp_path):
    path = tmp_path / "index"
    write_arrays(path, ARRAYS, "scans")
    before = read_arrays(path, "scans")
    write_arrays(path, {"keys": np.zeros(5, np.uint32)}, "others")
    assert before["keys"].tolist() == ARRAYS["keys"].tolist()
    assert read_arrays(path, "others")["keys"].tolist() == [0] * 5
    assert [file.name for file in tmp_path.iterdir()] == ["index"]


def test_only_numbers_are_written_and_what_was_there_stays(tmp_path):
    path = tmp_path / "index"
    write_arrays(path, ARRAYS, "scans")
    with pytest.raises(TypeError, match="numbers"):
        write_arrays(path, {"keys": np.array([print, None])}, "scans")
    assert read_arrays(path, "scans") is not None
    assert [file.name for file in tmp_path.iterdir()] == ["index"]
