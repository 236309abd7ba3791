"""Whatever happens to a file: a clear line, or records that hold what they say."""

from __future__ import annotations

import gzip
import io
import os
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from anchorscan import LogError, ReferenceSet, ReferenceSetError, open_log

LASER = " ".join(f"{1 + 0.01 * i:.2f}" for i in range(181))


def carmen() -> bytes:
    lines = [f"FLASER 181 {LASER} {i} 0 0 {i + 0.1 * i} 0 0 {i} host {i}\n" for i in range(4)]
    lines.insert(0, "PARAM robot_frontlaser_offset 0.1 host 0\n")
    lines.append(
        f"ROBOTLASER1 0 -1.57 3.14 0.01745 80 0.1 0 181 {LASER} 0 1 2 3 1 2 3 0 0 0 0 0 5 h 5\n"
    )
    return "".join(lines).encode()


def g2o() -> bytes:
    tail = "0 1 2 3 1 2 3 0 0 0 0 0 5 host 5"
    scan = f"ROBOTLASER1 0 -1.57 3.14 0.01745 80 0.1 0 181 {LASER} {tail}\n"
    return "".join(f"VERTEX_SE2 {i} {i} 0 0\n{scan}" for i in range(4)).encode()


def csv() -> bytes:
    names = ",".join(["stamp", "x", "y", "theta", *(f"r{i}" for i in range(181))])
    row = LASER.replace(" ", ",")
    return "\n".join([names, *(f"{i},{i},0,0,{row}" for i in range(4))]).encode()


def npy() -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.ones((4, 181), dtype=np.float32))
    return stream.getvalue()


def npz() -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, ranges=np.ones((4, 181)), poses=np.ones((4, 3)), stamps=np.ones(4))
    return stream.getvalue()


def zipped() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.g2o", g2o())
    return stream.getvalue()


SOUND = {"carmen": carmen(), "g2o": g2o(), "csv": csv(), "npy": npy(), "npz": npz()}
SOUND |= {"gzip": gzip.compress(carmen()), "zip": zipped()}


def check(path: Path) -> None:
    try:
        log = open_log(path)
    except LogError as error:
        message = str(error)
    else:
        message = ""
        for index, record in enumerate(log):
            assert record.index == index
            assert (record.scan is None) == bool(record.problem)
            assert record.pose is None or record.pose.is_finite()
            assert record.odometry is None or record.odometry.is_finite()
        for problem in log.problems:
            assert "\n" not in problem.reason
            assert problem.line > 0
    assert "\n" not in message


@pytest.mark.parametrize("kind", SOUND)
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_damaged_file_gives_a_clear_line_or_sound_records(
    tmp_path_factory: pytest.TempPathFactory, kind: str, data: st.DataObject
) -> None:
    content = bytearray(SOUND[kind])
    places = st.integers(0, len(content) - 1)
    for at, byte in data.draw(st.lists(st.tuples(places, st.integers(0, 255)), max_size=8)):
        content[at] = byte
    if data.draw(st.booleans()):
        at = data.draw(places)
        content[at : at + data.draw(st.integers(0, 40))] = data.draw(st.binary(max_size=40))
    if data.draw(st.booleans()):
        del content[data.draw(places) :]
    path = tmp_path_factory.mktemp("damage") / "log"
    path.write_bytes(content)
    check(path)


WORDS = [b"FLASER", b"RLASER", b"ROBOTLASER1", b"VERTEX_SE2", b"PARAM", b"ODOM", b"#", b"r0", b"x"]
WORDS += [b"0", b"1", b"2", b"181", b"-1", b"1e400", b"nan", b"inf", b"-inf", b"1_0", b"0x10", b""]
WORDS += [b"\n", b"\r\n", b"\r", b"\0", b",", b";", b"\t", b"\xff", b"9" * 30, b"laser"]


@settings(max_examples=300, deadline=None)
@given(words=st.lists(st.sampled_from(WORDS), max_size=60))
@example(words=[b"PARAM", b"robot_frontlaser_offset", b"inf", b"\n", b"FLASER"])
def test_any_words_give_a_clear_line_or_sound_records(
    tmp_path_factory: pytest.TempPathFactory, words: list[bytes]
) -> None:
    path = tmp_path_factory.mktemp("words") / "log"
    path.write_bytes(b" ".join(words))
    check(path)


@settings(max_examples=100, deadline=None)
@given(content=st.binary(max_size=200))
def test_any_bytes_give_a_clear_line_or_sound_records(
    tmp_path_factory: pytest.TempPathFactory, content: bytes
) -> None:
    for magic in (b"", b"\x1f\x8b\x08", b"PK\x03\x04", b"\x93NUMPY\x01\x00", b"#ROSBAG V2.0\n"):
        path = tmp_path_factory.mktemp("bytes") / "log"
        path.write_bytes(magic + content)
        check(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes here")
def test_a_pipe_is_refused_before_it_is_read(tmp_path: Path) -> None:
    pipe, log = tmp_path / "pipe", tmp_path / "a.log"
    os.mkfifo(pipe)
    log.write_bytes(carmen())
    with pytest.raises(LogError, match=r"pipe: is no file, .*: write it to a file first"):
        open_log(pipe)
    with pytest.raises(LogError, match=r"pipe: is no file, .*: write it to a file first"):
        open_log(log, poses=pipe)


@pytest.fixture
def locked() -> Iterator[Path]:
    """A folder that may not be looked into, with a log and a set in it."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        folder = Path(name) / "locked"
        folder.mkdir()
        (folder / "a.log").write_bytes(carmen())
        ReferenceSet(path=folder / "a.apr").close()
        (Path(name) / "b.log").write_bytes(carmen())
        folder.chmod(0)
        is_root = os.geteuid() == 0  # who may look into everything
        if is_root:
            os.seteuid(65534)
        yield folder
        if is_root:
            os.seteuid(0)
        folder.chmod(0o700)


@pytest.mark.skipif(not hasattr(os, "seteuid"), reason="there are no such permissions here")
def test_what_may_not_be_read_is_one_clear_line_that_names_it(locked: Path) -> None:
    for path in (locked, locked / "a.log"):
        with pytest.raises(LogError) as raised:
            open_log(path)
        assert str(raised.value) == f"{path}: cannot be read: Permission denied"
    with pytest.raises(LogError) as raised:
        open_log(locked.parent / "b.log", poses=locked / "a.log")
    assert str(raised.value) == f"{locked / 'a.log'}: cannot be read: Permission denied"
    with pytest.raises(ReferenceSetError) as refused:
        ReferenceSet.open(locked / "a.apr")
    assert str(refused.value).startswith(f"{locked / 'a.apr'}: ")
