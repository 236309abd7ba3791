"""A reference set as a plain directory, so that nobody is locked in.

``references.csv`` holds a line per reference: ``identifier, x, y, theta, name, angle_min,
angle_increment, range_min, range_max``, metres and radians, the pose empty where there is none.
``scans/<identifier>.npy`` holds its ranges, (N,) float32 metres.  ``set.json`` holds the name of
the set, its settings, and the next identifier; a directory made by hand may leave it out.
Numbers are written so that they are read back exactly.
"""

from __future__ import annotations

import csv
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import ReferenceSetError, ScanError
from .pose import Pose2D
from .reference import Reference
from .scan import LaserScan
from .set_file import LAST_IDENTIFIER, MOST_READINGS, Place, SetContent

__all__ = ["read_directory", "write_directory"]

_TABLE = "references.csv"
_DESCRIPTION = "set.json"
_SCANS = "scans"
_COLUMNS = (
    "identifier",
    "x",
    "y",
    "theta",
    "name",
    "angle_min",
    "angle_increment",
    "range_min",
    "range_max",
)
# What numpy lets through when the header of an array is nonsense.
_BAD_ARRAY = (OSError, ValueError, OverflowError, SyntaxError, TypeError, TokenError)
_IDENTIFIER = re.compile(r"[0-9]{1,16}", re.ASCII)
_LARGEST_DESCRIPTION = 1 << 22


def write_directory(path: Path, content: SetContent) -> None:
    """Write a set as a new directory, which appears at ``path`` whole or not at all.

    Raises:
        ReferenceSetError: ``path`` exists and is not an empty directory, or it cannot be
            written.
    """
    try:
        if path.exists() and not (path.is_dir() and not any(path.iterdir())):
            raise ReferenceSetError(f"{path}: exists already; choose a new directory")
        draft = path.absolute().with_name(f".{path.name}.{secrets.token_hex(4)}.new")
        try:
            _write(draft, content)
            if path.exists():
                path.rmdir()
            draft.rename(path)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
    except (OSError, ValueError) as error:
        raise ReferenceSetError(
            f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}"
        ) from error


def read_directory(path: Path) -> SetContent:
    """Read a directory that ``write_directory`` or a person made.

    Raises:
        ReferenceSetError: A file is missing or holds what it cannot hold; file and line are
            named.
    """
    try:
        if not path.is_dir():
            raise ReferenceSetError(f"{path}: is not a directory")
        name, settings, following = _read_description(path / _DESCRIPTION)
        references = sorted(_read_table(path), key=lambda reference: reference.identifier)
    except (OSError, UnicodeError) as error:
        raise ReferenceSetError(f"{path}: {error}") from error
    for one, other in pairwise(references):
        if one.identifier == other.identifier:
            raise ReferenceSetError(
                f"{path / _TABLE}: two references have the identifier {one.identifier}"
            )
    last = references[-1].identifier if references else -1
    try:
        return SetContent(name, settings, max(following, last + 1), tuple(references))
    except ReferenceSetError as error:
        raise ReferenceSetError(f"{path / _DESCRIPTION}: {error}") from None


def _write(path: Path, content: SetContent) -> None:
    path.mkdir()
    (path / _SCANS).mkdir()
    description = {
        "name": content.name,
        "next_identifier": content.next_identifier,
        "settings": json.loads(content.settings) if content.settings else None,
    }
    text = json.dumps(description, indent=2, ensure_ascii=False) + "\n"
    (path / _DESCRIPTION).write_text(text, encoding="utf-8")
    with (path / _TABLE).open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(_COLUMNS)
        for reference in content.references:
            table.writerow(_line(reference))
            ranges = reference.scan.ranges.astype("<f4", copy=False)
            np.save(_scan_path(path, reference.identifier), ranges, allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())


def _line(reference: Reference) -> tuple[int | float | str, ...]:
    pose, scan = reference.pose, reference.scan
    place = ("", "", "") if pose is None else (pose.x, pose.y, pose.theta)
    geometry = (scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
    return (reference.identifier, *place, reference.name, *geometry)


def _scan_path(path: Path, identifier: int) -> Path:
    return path / _SCANS / f"{identifier:06d}.npy"


def _read_description(path: Path) -> tuple[str, str, int]:
    """Return name, settings as JSON and next identifier; what is not there is empty or zero."""
    if not path.exists():
        return "", "", 0
    if path.stat().st_size > _LARGEST_DESCRIPTION:
        raise ReferenceSetError(f"{path}: is too large to be the description of a set")
    try:
        values: Any = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ReferenceSetError(f"{path}: is not JSON: {error}") from None
    if not isinstance(values, dict):
        raise ReferenceSetError(f"{path}: must hold a JSON object")
    name, settings = values.get("name", ""), values.get("settings")
    following = values.get("next_identifier", 0)
    if not isinstance(name, str):
        raise ReferenceSetError(f"{path}: the name must be text")
    if not (isinstance(settings, dict) or settings is None):
        raise ReferenceSetError(f"{path}: the settings must be an object or null")
    if not isinstance(following, int) or not 0 <= following <= LAST_IDENTIFIER:
        raise ReferenceSetError(f"{path}: next_identifier must be a number from 0 to 2^53")
    return name, "" if settings is None else json.dumps(settings), following


def _read_table(path: Path) -> Iterator[Reference]:
    with (path / _TABLE).open(encoding="utf-8", newline="") as file:
        table = csv.DictReader(file)
        try:
            missing = set(_COLUMNS) - set(table.fieldnames or ())
            if missing:
                raise ReferenceSetError(
                    f"{path / _TABLE}:1: there is no column {', '.join(sorted(missing))}"
                )
            for row in table:
                try:
                    yield _read_line(path, row)
                except (ReferenceSetError, ScanError, ValueError) as error:
                    reason = " ".join(str(error).split())
                    raise ReferenceSetError(f"{path / _TABLE}:{table.line_num}: {reason}") from None
        except csv.Error as error:
            raise ReferenceSetError(f"{path / _TABLE}:{table.line_num}: {error}") from None


def _read_line(path: Path, row: dict[str, str | None]) -> Reference:
    values = {column: row[column] or "" for column in _COLUMNS}
    # Only digits become part of a path: a table cannot name a file elsewhere.
    if not _IDENTIFIER.fullmatch(values["identifier"]):
        raise ReferenceSetError(f"{values['identifier']!a} is not an identifier")
    identifier = int(values["identifier"])
    if identifier >= LAST_IDENTIFIER:
        raise ReferenceSetError(f"{identifier} is too large for an identifier")
    ranges = _read_ranges(_scan_path(path, identifier))
    geometry = (float(values[column]) for column in _COLUMNS[5:])
    place = Place(LaserScan(ranges, *geometry), _read_pose(values), values["name"])
    return Reference(identifier, place.scan, place.pose, place.name)


def _read_pose(values: dict[str, str]) -> Pose2D | None:
    place = [values[column] for column in ("x", "y", "theta")]
    if not any(place):
        return None
    return Pose2D(*(float(value) for value in place))


def _read_ranges(path: Path) -> NDArray[np.float32]:
    """Read (N,) ranges; a file that claims more than it holds costs no memory."""
    try:
        mapped = np.lib.format.open_memmap(path, mode="r")
    except FileNotFoundError:
        raise ReferenceSetError(f"there is no {path}") from None
    except _BAD_ARRAY as error:
        raise ReferenceSetError(f"{path} cannot be read: {error}") from None
    if mapped.ndim != 1 or mapped.dtype.kind not in "fiu":
        raise ReferenceSetError(f"{path} does not hold ranges: one row of numbers")
    if len(mapped) > MOST_READINGS:
        raise ReferenceSetError(f"{path} holds more than {MOST_READINGS} readings")
    with np.errstate(over="ignore"):
        return np.array(mapped, dtype=np.float32)
