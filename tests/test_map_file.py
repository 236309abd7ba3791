"""Map files: what every mode means, what writing keeps, and what broken files say."""

from __future__ import annotations

import io
import math
import os
import random
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from anchorscan.errors import LogError
from anchorscan.map_file import load_map, write_map
from anchorscan.occupancy import OccupancyGrid
from anchorscan.pose import Pose2D

KEYS = {
    "image": "map.pgm",
    "resolution": 0.05,
    "origin": [1.0, -2.0, 0.0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}


def write_files(folder: Path, pixels: bytes, **keys: object) -> Path:
    """Write a YAML file with the given keys (None leaves one out) and the image it names."""
    merged = {key: value for key, value in (KEYS | keys).items() if value is not None}
    (folder / str(merged.get("image", "map.pgm"))).write_bytes(pixels)
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump(merged))
    return path


def pgm(*rows: list[int], white: int = 255) -> bytes:
    header = f"P5\n{len(rows[0])} {len(rows)}\n{white}\n".encode()
    return header + np.array(rows, dtype=">u1" if white < 256 else ">u2").tobytes()


def test_first_row_of_the_image_is_the_highest_y(tmp_path: Path) -> None:
    grid = load_map(write_files(tmp_path, pgm([0, 254], [254, 254], [205, 254])))
    assert grid.data.tolist() == [[-1, 0], [0, 0], [100, 0]]
    assert grid.resolution == 0.05
    assert grid.origin == Pose2D(1.0, -2.0, 0.0)
    np.testing.assert_allclose(grid.centres([[2, 0]]), [[1.025, -1.875]])


def test_yaw_of_the_origin_turns_the_map_about_its_corner(tmp_path: Path) -> None:
    path = write_files(tmp_path, pgm([0, 254]), origin=[1.0, -2.0, math.pi / 2])
    np.testing.assert_allclose(load_map(path).centres([[0, 1]]), [[0.975, -1.925]])


#                         levels:   0  10  89  90 100 127 205 206 255
@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({}, [100, 100, 100, -1, -1, -1, -1, 0, 0]),
        ({"mode": "trinary", "negate": 1}, [0, 0, -1, -1, -1, -1, 100, 100, 100]),
        ({"negate": True}, [0, 0, -1, -1, -1, -1, 100, 100, 100]),
        ({"mode": "scale"}, [100, 100, 100, 99, 91, 67, 0, 0, 0]),
        ({"mode": "raw"}, [0, 10, 89, 90, 100, -1, -1, -1, -1]),
        ({"mode": "raw", "negate": 1}, [0, 10, 89, 90, 100, -1, -1, -1, -1]),
    ],
)
def test_modes_follow_map_server(
    tmp_path: Path, keys: dict[str, object], expected: list[int]
) -> None:
    levels = [0, 10, 89, 90, 100, 127, 205, 206, 255]
    assert load_map(write_files(tmp_path, pgm(levels), **keys)).data[0].tolist() == expected


def test_unknown_level_of_map_savers_stays_unknown_whatever_the_threshold(tmp_path: Path) -> None:
    saved = pgm([0, 205, 254])
    assert load_map(write_files(tmp_path, saved, free_thresh=0.25)).data.tolist() == [[100, -1, 0]]
    # An image with further levels was not made by a saver and means what it says.
    drawn = pgm([0, 205, 254, 250])
    assert load_map(write_files(tmp_path, drawn, free_thresh=0.25)).data[0, 1] == 0


def test_plain_and_wide_images_are_the_same_map(tmp_path: Path) -> None:
    expected = load_map(write_files(tmp_path, pgm([0, 100, 205, 255]), mode="scale")).data
    plain = b"P2 # by hand\n# a comment\n4 1\n255\n0 100 # more\n205\n\n255"
    wide = pgm([0, 25700, 52685, 65535], white=65535)
    commented = b"P5\n# one\n4 #two\r\n1\n255\n" + bytes([0, 100, 205, 255])
    for image in (plain, wide, commented):
        np.testing.assert_array_equal(
            load_map(write_files(tmp_path, image, mode="scale")).data, expected
        )


def test_a_header_with_the_line_ends_of_windows_shifts_nothing(tmp_path: Path) -> None:
    levels = np.array([[10, 254, 0], [254, 205, 13]], dtype=np.uint8)
    for end in (b"\n", b"\r\n", b"\r"):  # one white space ends the header, before a pixel of 10
        header = end.join([b"P5", b"3 2", b"255", b""])
        grid = load_map(write_files(tmp_path, header + levels.tobytes()))
        np.testing.assert_array_equal(grid.data, [[0, -1, 100], [100, 0, 100]])


def png(pixels: np.ndarray) -> bytes:
    images = pytest.importorskip("PIL.Image")
    stream = io.BytesIO()
    images.fromarray(pixels).save(stream, format="PNG")
    return stream.getvalue()


def test_png_is_read_with_its_alpha(tmp_path: Path) -> None:
    grey = np.array([[0, 100, 205, 254]], dtype=np.uint8)
    alpha = np.array([[255, 255, 255, 254]], dtype=np.uint8)
    rgba = np.dstack((grey, grey, grey, alpha))
    for mode, expected in (("trinary", [100, -1, -1, -1]), ("scale", [100, 91, 0, -1])):
        keys = {"mode": mode, "image": "map.png"}
        assert load_map(write_files(tmp_path, png(rgba), **keys)).data[0].tolist() == expected
        opaque = load_map(write_files(tmp_path, png(grey), **keys)).data[0]
        assert opaque.tolist() == [*expected[:3], 0]
    raw = {"mode": "raw", "image": "map.png"}
    assert load_map(write_files(tmp_path, png(rgba), **raw)).data[0].tolist() == [0, 100, -1, -1]


def test_colours_are_averaged(tmp_path: Path) -> None:
    rgb = np.array([[[255, 255, 0], [0, 0, 30], [255, 0, 0]]], dtype=np.uint8)
    path = write_files(tmp_path, png(rgb), image="map.png", free_thresh=0.35)
    assert load_map(path).data.tolist() == [[0, 100, 100]]


def test_what_may_be_left_out_and_what_is_ignored(tmp_path: Path) -> None:
    path = write_files(
        tmp_path,
        pgm([0, 205, 254]),
        negate=None,
        occupied_thresh=None,
        free_thresh=None,
        author={"name": "nobody"},
        resolution="5e-2",  # text, to YAML 1.1
    )
    grid = load_map(path)
    assert grid.data.tolist() == [[100, -1, 0]]
    assert grid.resolution == 0.05


@given(
    st.integers(1, 12),
    st.integers(1, 12),
    st.booleans(),
    st.integers(0, 2**31),
    st.floats(1e-3, 10.0),
)
@settings(max_examples=60, deadline=None)
def test_written_map_reads_back_the_same(
    tmp_path_factory: pytest.TempPathFactory,
    rows: int,
    columns: int,
    is_trinary: bool,
    seed: int,
    resolution: float,
) -> None:
    rng = np.random.default_rng(seed)
    values = [-1, 0, 100] if is_trinary else range(-1, 101)
    data = rng.choice(list(values), (rows, columns))
    origin = Pose2D(*rng.uniform(-100.0, 100.0, 2), rng.uniform(-3.0, 3.0))
    grid = OccupancyGrid(data, resolution, origin, 0.7, 0.2)
    path = tmp_path_factory.mktemp("maps") / 'a "map": #1.yaml'
    write_map(grid, path)
    back = load_map(path)
    np.testing.assert_array_equal(back.data, grid.data)
    np.testing.assert_array_equal(back.is_free, grid.is_free)
    np.testing.assert_array_equal(back.is_occupied, grid.is_occupied)
    assert (back.resolution, back.origin) == (grid.resolution, grid.origin)


def test_what_is_written_reads_the_same_by_the_letter_of_map_server(tmp_path: Path) -> None:
    write_map(OccupancyGrid(np.array([[-1, 0, 100]]), 0.05), tmp_path / "map.yaml")
    keys = yaml.safe_load((tmp_path / "map.yaml").read_text())
    levels = np.frombuffer((tmp_path / "map.pgm").read_bytes()[-3:], np.uint8)
    occupancy = 1.0 - levels / 255.0
    assert (occupancy > keys["occupied_thresh"]).tolist() == [False, False, True]
    assert (occupancy < keys["free_thresh"]).tolist() == [False, True, False]


def test_map_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    grid = OccupancyGrid(np.zeros((2, 2)), 0.05)
    with pytest.raises(LogError, match="cannot be written"):
        write_map(grid, tmp_path / "missing" / "map.yaml")
    with pytest.raises(LogError, match="give that of the YAML file"):
        write_map(grid, tmp_path / "map.pgm")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"image": None}, "has no image"),
        ({"image": 3}, "has no image"),
        ({"image": "two\nlines"}, "names an image that cannot be one"),
        ({"resolution": None}, "the resolution is missing"),
        ({"resolution": 0}, "resolution must be positive"),
        ({"resolution": -0.05}, "resolution must be positive"),
        ({"resolution": 1e300}, "resolution must be positive metres up to 1000"),
        ({"resolution": "wide"}, "resolution must be a number, not wide"),
        ({"resolution": True}, "resolution must be a number"),
        ({"resolution": math.nan}, "resolution must be a number"),
        ({"resolution": 10**400}, "resolution must be a number"),
        ({"origin": None}, "origin must be a list of x, y, yaw"),
        ({"origin": [1.0, 2.0]}, "origin must be a list of x, y, yaw"),
        ({"origin": [1.0, 2.0, "north"]}, "origin must be a number, not north"),
        ({"origin": [1.0, math.inf, 0.0]}, "origin must be a number"),
        ({"mode": "binary"}, "mode must be one of trinary, scale, raw, not binary"),
        ({"mode": ["raw"]}, "mode must be one of"),
        ({"negate": 2}, "negate must be 0 or 1"),
        ({"negate": {}}, "negate must be 0 or 1"),
        ({"occupied_thresh": 0.1}, "thresholds out of order"),
        ({"free_thresh": -0.5}, "thresholds out of order"),
        ({"occupied_thresh": 1.5}, "thresholds out of order"),
    ],
)
def test_wrong_keys_are_named(tmp_path: Path, keys: dict[str, object], message: str) -> None:
    path = write_files(tmp_path, pgm([0]), **keys)
    with pytest.raises(LogError, match=message) as caught:
        load_map(path)
    assert caught.value.path == path
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "has no keys"),
        (b"- a\n- b\n", "has no keys"),
        (b"image: [\n", "map.yaml:2: is not YAML"),
        (b"a: *b\n", "aliases"),
        (b"\xff\xfe\x00", "is not YAML"),
        (b"a\x00b: 1", "is not YAML"),
        (b"date: 2020-99-99", "is not a map's YAML"),
        (b"? {a: [1]}\n: 2\n", "is not"),
        (b"[" * 10_000, "is not a map's YAML"),
        (b"!!python/object/apply:os.system ['true']", "is not YAML"),
        (b"# " + b"x" * 2_000_000, "too many for a map's YAML"),
    ],
)
def test_file_that_is_no_yaml_of_a_map(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "map.yaml"
    path.write_bytes(content)
    with pytest.raises(LogError, match=message) as caught:
        load_map(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not an image"),
        (b"GIF89a", "is not an image"),
        (b"\x89PNG\r\n\x1a\n", "is not an image"),
        (b"P5\n", "header is broken"),
        (b"P5\n3 x\n255\n", "header is broken"),
        (b"P5\n-3 1\n255\n\0\0\0", "header is broken"),
        (b"P5\n9999999999 1\n255\n", "header is broken"),
        (b"P5\n0 5\n255\n", "0 x 5 pixels"),
        (b"P5\n2 2\n0\n\0\0\0\0", "up to 0"),
        (b"P5\n2 2\n70000\n\0\0\0\0", "up to 70000"),
        (b"P5\n1000000 1000000\n255\n\0\0", "ends before its 1000000 x 1000000 pixels"),
        (b"P2\n1000000 1000000\n255\n0 0", "ends before its 1000000 x 1000000 pixels"),
        (b"P5\n2 2\n255\n\0\0\0", "ends before its 2 x 2 pixels"),
        (b"P5\n2 2\n300\n\0\0\0\0", "ends before its 2 x 2 pixels"),
        (b"P5\n2 1\n100\n\0\xff", "has a pixel of 255, above its maximum of 100"),
        (b"P2\n2 1\n255\n1 abc", "not a number: b'abc'"),
        (b"P2\n2 1\n255\n1 -4", "not a number: b'-4'"),
        (b"P2\n2 1\n255\n12345    ", "ends after 1 of 2 pixels"),
        (b"P2\n2 1\n255\n1 256", "above its maximum"),
    ],
)
def test_broken_images_are_named(tmp_path: Path, content: bytes, message: str) -> None:
    path = write_files(tmp_path, content)
    with pytest.raises(LogError, match=message) as caught:
        load_map(path)
    assert caught.value.path == tmp_path / "map.pgm"
    assert "\n" not in str(caught.value)


def test_missing_and_odd_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such file"):
        load_map(tmp_path / "none.yaml")
    with pytest.raises(LogError, match="is not a file"):
        load_map(tmp_path)
    path = write_files(tmp_path, pgm([0]))
    for image, message in (("none.pgm", "no such file"), (".", "is not a file")):
        path.write_text(yaml.safe_dump(KEYS | {"image": image}))
        with pytest.raises(LogError, match=message):
            load_map(path)
    if hasattr(os, "mkfifo"):  # reading one would wait for ever
        os.mkfifo(tmp_path / "pipe.pgm")
        path.write_text(yaml.safe_dump(KEYS | {"image": "pipe.pgm"}))
        with pytest.raises(LogError, match="is not a file"):
            load_map(path)


def test_small_file_with_a_huge_png_is_refused(tmp_path: Path) -> None:
    content = bytearray(png(np.zeros((1, 1), dtype=np.uint8)))
    import struct
    import zlib

    header = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0)
    content[12:33] = header + struct.pack(">I", zlib.crc32(header))
    path = write_files(tmp_path, bytes(content), image="map.png")
    with pytest.raises(LogError, match="too many pixels"):
        load_map(path)


@pytest.mark.parametrize("kind", ["yaml", "pgm", "plain", "png"])
def test_damaged_files_give_a_map_or_one_line(tmp_path: Path, kind: str) -> None:
    rng = random.Random(1)
    pixels = np.array([[0, 205, 254], [254, 100, 7]], dtype=np.uint8)
    image = {
        "plain": b"P2\n3 2\n255\n0 205 254 254 100 7\n",
        "png": png(pixels) if kind == "png" else b"",
    }.get(kind, pgm(*pixels.tolist()))
    name = "map.png" if kind == "png" else "map.pgm"
    path = write_files(tmp_path, image, image=name)
    target = path if kind == "yaml" else tmp_path / name
    whole = target.read_bytes()
    for _ in range(400):
        damaged = bytearray(whole)
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(len(damaged))
            damaged[at : at + rng.randint(0, 2)] = rng.choice(
                [bytes([rng.randrange(256)]), b"", b"99999", b"-", b"\n", b"&a [*a]", b"1e400"]
            )
        target.write_bytes(bytes(damaged))
        message = ""
        try:
            load_map(path)
        except LogError as error:
            message = str(error)
        assert "\n" not in message
