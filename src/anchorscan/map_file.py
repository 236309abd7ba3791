"""Map files of map_server: a YAML file with the scale, beside an image with the cells.

Format and modes are those of ROS map_server and Nav2.  The occupancy of a pixel of
brightness ``s`` (0 black, 1 white) is ``p = 1 - s``, or ``p = s`` with ``negate``.

- ``trinary``: occupied from ``occupied_thresh`` on, free up to ``free_thresh``, else unknown.
- ``scale``: the same, but between the thresholds the occupancy rises from 0 to 100 percent.
- ``raw``: the pixel (0 to 255) is the occupancy in percent; above 100 it is unknown.

Pixels that are not opaque are unknown in the first two modes.

One departure.  The map savers of ROS write unknown cells as the grey level 205, which has
p = 0.196, and Nav2 writes ``free_thresh: 0.25`` beside it, so that read to the letter all
unknown space becomes free (slam_toolbox issue 587).  An image in trinary mode that has only
the savers' three levels 0, 205 and 254 is read as the saver meant it.
"""

from __future__ import annotations

import json
import math
import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import LogError, MissingExtraError
from .occupancy import LARGEST_RESOLUTION, OccupancyGrid
from .pose import Pose2D

__all__ = ["load_map", "write_map"]

_IMAGE_SUFFIXES = (".pgm", ".png", ".bmp", ".jpg", ".jpeg")

_MODES = ("trinary", "scale", "raw")
# Below this, 205 is unknown to map_server too: the value that ROS 1 writes.
_SAVED_FREE_THRESHOLD = 0.196
_FREE_LEVEL, _UNKNOWN_LEVEL, _OCCUPIED_LEVEL = 254, 205, 0
# A map's YAML has a few hundred bytes; PyYAML takes a second for some ten thousand.
_LARGEST_YAML = 1 << 14
_MOST_BRACKETS = 64
_LARGEST_LEVEL = 65535
_DIGITS = 9


def load_map(path: str | Path) -> OccupancyGrid:
    """Read a map from its YAML file and the image that this names.

    Images in PGM (plain or binary) need PyYAML only; PNG, BMP and JPEG need Pillow too.
    Unknown keys are ignored; ``mode``, ``negate`` and the thresholds may be left out.

    Args:
        path: The YAML file.

    Raises:
        LogError: The YAML file or the image is missing, broken or impossible.
        MissingExtraError: A library is missing that the extra ``maps`` installs.
    """
    path = Path(path)
    keys = _read_yaml(path)
    image = _read_image(path.parent / keys.image)
    cells = _levels_to_cells(image, keys)
    # Raw cells are classified here as trinary ones are there; the others already are.
    thresholds = (keys.occupied_threshold, keys.free_threshold) if keys.mode == "raw" else ()
    data = np.flipud(cells[image.levels])
    if image.opaque is not None and keys.mode != "raw":
        data = np.where(np.flipud(image.opaque), data, np.int8(-1))
    return OccupancyGrid(data, keys.resolution, keys.origin, *thresholds)


def write_map(grid: OccupancyGrid, path: str | Path) -> None:
    """Write a map as a YAML file and, beside it, a PGM image, for map_server.

    A grid of free, occupied and unknown cells is written in trinary mode, any other in raw
    mode, so that reading it back gives the same cells.

    Args:
        grid: The map.
        path: The YAML file; the image gets its name with the ending ``.pgm``.

    Raises:
        LogError: The files cannot be written.
    """
    path = Path(path)
    image = path.with_suffix(".pgm")
    if image == path:
        raise LogError("is the name of the image; give that of the YAML file", path)
    is_trinary = bool(np.isin(grid.data, (-1, 0, 100)).all())
    if is_trinary:
        known = np.where(grid.data == 0, _FREE_LEVEL, _OCCUPIED_LEVEL)
        levels = np.where(grid.data < 0, _UNKNOWN_LEVEL, known)
        occupied, free = 0.65, _SAVED_FREE_THRESHOLD
    else:
        levels = np.where(grid.data < 0, 255, grid.data.astype(np.int64))
        occupied, free = grid.occupied_threshold, grid.free_threshold
    rows, columns = grid.data.shape
    origin = [grid.origin.x, grid.origin.y, grid.origin.theta]
    text = (
        f"image: {json.dumps(image.name)}\n"
        f"mode: {'trinary' if is_trinary else 'raw'}\n"
        f"resolution: {grid.resolution!r}\n"
        f"origin: {origin!r}\n"
        "negate: 0\n"
        f"occupied_thresh: {occupied!r}\n"
        f"free_thresh: {free!r}\n"
    )
    try:
        header = f"P5\n{columns} {rows}\n255\n".encode()
        image.write_bytes(header + np.flipud(levels).astype(np.uint8).tobytes())
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise LogError(f"cannot be written: {error.strerror or error}", path) from None


# --- YAML ------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Keys:
    """The YAML file, checked."""

    image: str
    resolution: float
    origin: Pose2D
    mode: str
    negate: bool
    occupied_threshold: float
    free_threshold: float


def _read_yaml(path: Path) -> _Keys:
    raw = _parse_yaml(path)
    image = raw.get("image")
    if not isinstance(image, str) or not image.strip():
        raise LogError("has no image: it must name the file with the cells", path)
    if not image.isprintable():
        raise LogError(f"names an image that cannot be one: {image[:60]!r}", path)
    mode = raw.get("mode", "trinary")
    if mode not in _MODES:
        raise LogError(f"the mode must be one of {', '.join(_MODES)}, not {_shown(mode)}", path)
    negate = raw.get("negate", 0)
    if negate not in (0, 1):
        raise LogError(f"negate must be 0 or 1, not {_shown(negate)}", path)
    resolution = _number(raw, "resolution", path)
    if not 0.0 < resolution <= LARGEST_RESOLUTION:
        raise LogError(
            f"the resolution must be positive metres up to {LARGEST_RESOLUTION:g}, "
            f"not {resolution:g}",
            path,
        )
    occupied = _number(raw, "occupied_thresh", path, 0.65)
    free = _number(raw, "free_thresh", path, 0.25)
    if not 0.0 <= free < occupied <= 1.0:
        raise LogError(
            f"thresholds out of order: free_thresh {free:g}, occupied_thresh {occupied:g}", path
        )
    origin = raw.get("origin")
    if not isinstance(origin, list) or len(origin) != 3:
        raise LogError("the origin must be a list of x, y, yaw", path)
    x, y, yaw = (_number(dict(enumerate(origin)), k, path, name="origin") for k in range(3))
    return _Keys(image, resolution, Pose2D(x, y, yaw), mode, bool(negate), occupied, free)


def _parse_yaml(path: Path) -> dict[Any, Any]:
    try:
        import yaml
    except ImportError:
        raise MissingExtraError("reading a map", "maps") from None
    if path.suffix.lower() in _IMAGE_SUFFIXES:
        raise LogError("is the image of a map; give the YAML file that names it", path)
    content = _read_bytes(path, _LARGEST_YAML)
    try:
        # Nested brackets take PyYAML quadratic time.
        if sum(map(content.count, (b"[", b"{"))) > _MOST_BRACKETS:
            raise LogError("is not a map's YAML: it has too many brackets", path)
        # A few aliases of aliases stand for more than any memory holds.
        if any(
            isinstance(event, yaml.AliasEvent) for event in yaml.parse(content, yaml.SafeLoader)
        ):
            raise LogError("is not a map's YAML: it has aliases", path)
        raw = yaml.safe_load(content)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or "broken"
        line = None if mark is None else mark.line + 1
        raise LogError(f"is not YAML: {_shown(problem)}", path, line) from None
    # Impossible dates, keys that cannot be keys, nesting without end.
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise LogError(f"is not a map's YAML: {_shown(error)}", path) from None
    if not isinstance(raw, dict):
        raise LogError("is not a map's YAML: it has no keys such as image, resolution", path)
    return raw


def _number(
    raw: dict[Any, Any], key: Any, path: Path, default: float | None = None, name: str = ""
) -> float:
    """Read a finite number, also one that YAML takes for text, as it does ``5e-2``."""
    value = raw.get(key, default)
    try:
        if isinstance(value, (int, float, str)) and not isinstance(value, bool):
            number = float(value)
            if math.isfinite(number):
                return number
    except (ValueError, OverflowError):
        pass
    what = "is missing" if value is None else f"must be a number, not {_shown(value)}"
    raise LogError(f"the {name or key} {what}", path)


def _shown(value: object) -> str:
    """A foreign value, short and on one line."""
    try:
        text = " ".join(str(value).split()) if isinstance(value, str | Exception) else repr(value)
    except ValueError:  # an integer of too many digits
        text = f"such a {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."


# --- Images ----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, slots=True)
class _Image:
    """Grey levels 0 to ``white``, (H, W) from the top, and what is opaque, if not all."""

    levels: NDArray[Any]
    white: int
    opaque: NDArray[np.bool_] | None = None


def _levels_to_cells(image: _Image, keys: _Keys) -> NDArray[np.int8]:
    """Give the cell (-1, 0 to 100) that each grey level stands for."""
    shade = np.arange(image.white + 1) / image.white
    if keys.mode == "raw":
        value = np.round(255.0 * shade)
        return np.where(value <= 100, value, -1).astype(np.int8)
    occupancy = shade if keys.negate else 1.0 - shade
    between = np.full(len(shade), -1.0)
    if keys.mode == "scale":
        share = (occupancy - keys.free_threshold) / (keys.occupied_threshold - keys.free_threshold)
        between = np.rint(100.0 * share)
    cells = np.where(occupancy >= keys.occupied_threshold, 100.0, between)
    cells = np.where(occupancy <= keys.free_threshold, 0.0, cells).astype(np.int8)
    if keys.mode == "trinary" and not keys.negate and _is_from_a_saver(image):
        cells[_UNKNOWN_LEVEL] = -1
    return cells


def _is_from_a_saver(image: _Image) -> bool:
    """Tell whether the image has no other levels than those that map savers write."""
    if image.white != 255:
        return False
    present = np.bincount(image.levels.ravel(), minlength=256) > 0
    present[[_FREE_LEVEL, _UNKNOWN_LEVEL, _OCCUPIED_LEVEL]] = False
    return not present.any()


def _read_bytes(path: Path, most: int | None = None) -> bytes:
    """Read a whole regular file."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise LogError("is not a file", path)
        if most is not None and status.st_size > most:
            raise LogError(f"has {status.st_size} bytes, too many for a map's YAML", path)
        return path.read_bytes()
    except FileNotFoundError:
        raise LogError("no such file", path) from None
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the path
        reason = getattr(error, "strerror", None) or error
        raise LogError(f"cannot be read: {reason}", path) from None


def _read_image(path: Path) -> _Image:
    content = _read_bytes(path)
    if content[:2] in (b"P2", b"P5"):
        return _parse_pgm(content, path)
    return _decode_with_pillow(content, path)


def _parse_pgm(content: bytes, path: Path) -> _Image:
    """Read a plain (P2) or binary (P5) PGM image."""
    space = rb"(?:\s|#[^\r\n]*[\r\n])+"
    header = re.match(rb"P[25]" + space.join([b"", *[rb"(\d{1,%d})" % _DIGITS] * 3]), content)
    if header is None:
        raise LogError("is not a PGM image: its header is broken", path)
    columns, rows, white = (int(group) for group in header.groups())
    if columns < 1 or rows < 1 or not 1 <= white <= _LARGEST_LEVEL:
        raise LogError(f"is a PGM image of {columns} x {rows} pixels up to {white}", path)
    # One white space ends the header; comments end with the header, so the rest is data.
    body = content[header.end() + 1 :]
    is_plain = content[:2] == b"P2"
    width = 1 if white < 256 else 2
    promised = 2 * columns * rows - 1 if is_plain else columns * rows * width
    if len(body) < promised:
        raise LogError(f"ends before its {columns} x {rows} pixels are complete", path)
    if len(body) > promised and content[header.end() : header.end() + 2] == b"\r\n":
        body = body[1:]  # an editor of Windows ended the lines of the header
    if is_plain:
        levels = _plain_levels(content[header.end() :], columns * rows, path)
    else:
        levels = np.frombuffer(body, np.dtype(f">u{width}"), columns * rows)
    if levels.max() > white:
        raise LogError(f"has a pixel of {levels.max()}, above its maximum of {white}", path)
    return _Image(levels.reshape(rows, columns), white)


def _plain_levels(body: bytes, count: int, path: Path) -> NDArray[np.uint32]:
    words = re.sub(rb"#[^\r\n]*", b" ", body).split(None, count)[:count]
    if len(words) < count:
        raise LogError(f"ends after {len(words)} of {count} pixels", path)
    wrong = next((w for w in words if not (w.isdigit() and len(w) <= _DIGITS)), None)
    if wrong is not None:
        raise LogError(f"has a pixel that is not a number: {wrong[:20]!r}", path)
    return np.array(words, dtype=np.uint32)


def _decode_with_pillow(content: bytes, path: Path) -> _Image:
    """Read other images; colours are averaged, as map_server does."""
    try:
        from PIL import Image
    except ImportError:
        raise MissingExtraError("reading a map image other than PGM", "maps") from None
    import io
    import warnings

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content), formats=("PNG", "BMP", "JPEG")) as image:
                if image.mode.startswith("I;16"):
                    return _Image(np.asarray(image).astype(np.uint16), 65535)
                channels = np.asarray(image.convert("RGBA"))
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise LogError("is an image of too many pixels", path) from None
    except Exception as error:
        raise LogError(f"is not an image: {_shown(error)}", path) from None
    levels = channels[:, :, :3].sum(axis=2, dtype=np.uint16)
    opaque = channels[:, :, 3] == 255
    if (channels[:, :, :3].max(axis=2) == channels[:, :, :3].min(axis=2)).all():
        return _Image(channels[:, :, 0], 255, opaque)
    return _Image(levels, 3 * 255, opaque)
