"""The index: what was derived from the references of a set, in a file beside the set's own.

``office.apr`` holds what cannot be made again.  ``office.apr.index`` holds what can, so that a
large set need not wait for it: anchor points, landmarks, the relationship database, the tiles of
the map and their evidence, and a copy of the scans, from which single references are read when an
answer names them.  Graphs and outlines are not in it: making those of the few references that an
answer names takes less than reading them all would.  The index is mapped into memory: opening
takes little time however large it is, and processes share it.

It may be deleted at any time, and it is written only on request (``ReferenceSet.save_index``,
``anchorscan build``), as a whole: drafted beside its place, synchronised, renamed.  Of several
writers the last one wins.

Nothing in it is believed.  It counts only when

* it was made by this version, from these settings (those that change what is derived);
* every array has the checksum that it was written with, and no number in it names a place that
  is not there (``array_file``, and the stages when they take their arrays);
* its references are those of the set: the set's own file knows how many references it has, and
  the checksum of them all.  What was added and removed since is then added to and removed from
  what the index holds, so that a set need not be indexed anew after every change.

Otherwise everything is derived anew, in memory.  Every reference that is read from the index
must have the checksum that the set's file has for it.
"""

from __future__ import annotations

import operator
from bisect import bisect_left
from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex

import numpy as np
from numpy.typing import NDArray

from .array_file import read_arrays, write_arrays
from .errors import ReferenceSetError, ScanError
from .pose import Pose2D
from .reference import Reference
from .scan import LaserScan
from .set_file import Sensor, checksum_of

if TYPE_CHECKING:
    from .settings import Settings

__all__ = ["DerivedIndex", "IndexedReferences", "index_path", "read_index", "write_index"]

# What is stored, and how; raise it when that changes.
_FORMAT = 2
# Whoever changes one of these derives something else from the same references; the first names
# the version.
_STAGES = (
    *("__init__", "scan", "pose", "angle_function", "segments", "anchors", "graph"),
    *("length_relation", "oriented_relation", "database", "panorama", "spacing"),
    *("description", "evidence", "tiles", "field", "proposal", "placed"),
)
_SECTIONS = ("method", "anchors", "graph", "database", "field")
_PROPOSAL = ("shortest_edge", "longest_edge", "landmark_cell", "landmark_turn")
# What the arrays are of, and in how many dimensions; the relationship database looks at its own.
_ROWS: Mapping[str, Any] = {
    **dict.fromkeys(("references.identifiers", "references.checksums"), np.int64),
    **dict.fromkeys(("scans.starts", "names.starts"), np.int64),
    **dict.fromkeys(("anchors.kinds", "anchors.starts", "field.evidence_starts"), np.int64),
    **dict.fromkeys(("anchors.directions", "anchors.main_angles"), np.float64),
    **dict.fromkeys(("scans.ranges", "landmarks.lengths"), np.float32),
    **dict.fromkeys(("names.text", "field.evidence"), np.uint8),
    "scans.sensors": np.int32,
}
_TABLES: Mapping[str, Any] = {
    **dict.fromkeys(("landmarks.starts", "landmarks.edge_starts"), np.int64),
    **dict.fromkeys(("references.poses", "scans.geometries"), np.float64),
    **dict.fromkeys(("anchors.positions", "landmarks.positions"), np.float64),
    **dict.fromkeys(("landmarks.edges", "field.squares"), np.int32),
    **dict.fromkeys(("landmarks.directions", "landmarks.turns"), np.int16),
    **dict.fromkeys(("references.panoramas", "field.codes"), np.uint8),
    "field.coarse": np.int8,
}
_KINDS = {
    **{name: (np.dtype(kind), 1) for name, kind in _ROWS.items()},
    **{name: (np.dtype(kind), 2) for name, kind in _TABLES.items()},
}
# What kernels make places of, and how large it may be: far more than any building, and few enough
# cells to be counted.
_PLACES = ("references.poses", "anchors.positions", "anchors.directions", "landmarks.positions")
_FARTHEST = 1e8
_NOWHERE = np.empty(0)
# Room for tiles that are added while the index is in use.
_ROOMY = ("field.codes", "field.coarse")
_ROOM_SHARE = 8
_LEAST_ROOM = 1024


@dataclass(frozen=True, eq=False)
class DerivedIndex:
    """An index that was read: its arrays, and the references of which it is.

    Args:
        arrays: What the matcher takes up, by name.
        identifiers: (N,) of its references, ascending.
        checksums: (N,) of these, as the set's file has them.
        size: Bytes of the file.
    """

    arrays: Mapping[str, NDArray[Any]]
    identifiers: NDArray[np.int64]
    checksums: NDArray[np.int64]
    size: int

    def read(self, identifier: int) -> Reference:
        """Read a reference.

        Raises:
            KeyError: There is none.
            ReferenceSetError: It is not the one that was stored.
        """
        place = int(np.searchsorted(self.identifiers, identifier))
        if place == len(self.identifiers) or self.identifiers[place] != identifier:
            raise KeyError(identifier)
        arrays = self.arrays
        own = slice(*arrays["scans.starts"][place : place + 2].tolist())
        sensor = arrays["scans.geometries"][arrays["scans.sensors"][place]]
        named = slice(*arrays["names.starts"][place : place + 2].tolist())
        try:
            reference = Reference(
                identifier,
                LaserScan(arrays["scans.ranges"][own], *sensor.tolist()),
                Pose2D(*arrays["references.poses"][place].tolist()),
                arrays["names.text"][named].tobytes().decode(),
            )
        except (ScanError, UnicodeDecodeError) as error:
            raise ReferenceSetError(f"reference {identifier} of the index: {error}") from None
        if checksum_of(reference) != self.checksums[place]:
            raise ReferenceSetError(
                f"reference {identifier} of the index fails its checksum; delete the index"
            )
        return reference


class IndexedReferences(MutableMapping[int, Reference]):
    """References by their identifiers, those of an index read when they are asked for.

    Args:
        index: Where they are.
    """

    def __init__(self, index: DerivedIndex) -> None:
        self._index = index
        self._gone: set[int] = set()
        self._added: dict[int, Reference] = {}

    @property
    def gone(self) -> list[int]:
        """References of the index that were removed since."""
        return sorted(self._gone)

    @property
    def added(self) -> list[Reference]:
        """References that were added since, in the order of their identifiers."""
        return [self._added[identifier] for identifier in sorted(self._added)]

    def __getitem__(self, identifier: int) -> Reference:
        if identifier not in self:
            raise KeyError(identifier)
        identifier = operator.index(identifier)
        return self._added.get(identifier) or self._index.read(identifier)

    def __contains__(self, identifier: object) -> bool:
        if identifier in self._added:
            return True
        if not isinstance(identifier, SupportsIndex) or identifier in self._gone:
            return False
        known = self._index.identifiers
        place = bisect_left(known, identifier)
        return place < len(known) and bool(known[place] == identifier)

    def __setitem__(self, identifier: int, reference: Reference) -> None:
        self._added[identifier] = reference

    def __delitem__(self, identifier: int) -> None:
        if identifier not in self:
            raise KeyError(identifier)
        if self._added.pop(identifier, None) is None:
            self._gone.add(identifier)

    def __len__(self) -> int:
        return len(self._index.identifiers) - len(self._gone) + len(self._added)

    def __iter__(self) -> Iterator[int]:
        left = (each for each in self._index.identifiers.tolist() if each not in self._gone)
        return iter(sorted([*left, *self._added]))


def index_path(path: Path) -> Path:
    """Return where the index of a set's file is."""
    return path.parent / f"{path.name}.index"  # also of a path that has no name


def write_index(
    path: Path,
    references: Sequence[Reference],
    derived: Mapping[str, NDArray[Any]],
    settings: Settings,
) -> None:
    """Write the index of a set.

    Args:
        path: The set's file.
        references: All of the set, in the order of their identifiers.
        derived: What was derived from them, by name.
        settings: That it was derived with.

    Raises:
        ReferenceSetError: It cannot be written; what was there is as it was.
    """
    sensors: dict[Sensor, int] = {}
    numbers = [sensors.setdefault(Sensor.of(each.scan), len(sensors)) for each in references]
    names = [each.name.encode() for each in references]
    arrays = {
        **derived,
        "references.checksums": np.array([checksum_of(each) for each in references], np.int64),
        "scans.sensors": np.array(numbers, np.int32),
        "scans.geometries": np.array(
            [(s.angle_min, s.angle_increment, s.range_min, s.range_max) for s in sensors]
        ).reshape(-1, 4),
        "scans.starts": np.cumsum([0, *(len(each.scan) for each in references)], dtype=np.int64),
        "scans.ranges": np.concatenate(
            [np.empty(0, np.float32), *(each.scan.ranges for each in references)]
        ),
        "names.starts": np.cumsum([0, *map(len, names)], dtype=np.int64),
        "names.text": np.frombuffer(b"".join(names), np.uint8),
    }
    room = {name: max(_LEAST_ROOM, len(arrays[name]) // _ROOM_SHARE) for name in _ROOMY}
    target = index_path(path)
    try:
        write_arrays(target, arrays, _made_of(settings), room)
    except OSError as error:
        raise ReferenceSetError(f"{target}: {error.strerror or error}") from None


def read_index(path: Path, settings: Settings) -> DerivedIndex | None:
    """Read the index of a set, if it is whole and was made by this version with these settings.

    Args:
        path: The set's file.
        settings: Of the matcher.
    """
    target = index_path(path)
    arrays = read_arrays(target, _made_of(settings))
    try:
        return None if arrays is None else _index_of(arrays, target.stat().st_size)
    except OSError:
        return None


def _index_of(arrays: Mapping[str, NDArray[Any]], size: int) -> DerivedIndex | None:
    """Take arrays for an index, if they are what it has and fit each other."""
    try:
        index = DerivedIndex(
            arrays, arrays["references.identifiers"], arrays["references.checksums"], size
        )
        _check_references(arrays, len(index.identifiers))
    except (KeyError, ValueError, TypeError, IndexError):
        return None
    return index


def _check_references(arrays: Mapping[str, NDArray[Any]], count: int) -> None:
    """See that no number names a scan, a sensor or a name that is not there.

    Raises:
        ValueError: One does.
    """
    for name, array in arrays.items():
        if (array.dtype, array.ndim) != _KINDS.get(name, (array.dtype, array.ndim)):
            raise ValueError(f"{name} of the index has values of another kind")
    for name in _PLACES:
        array = arrays.get(name, _NOWHERE)
        if array.size and not -_FARTHEST <= array.min() <= array.max() <= _FARTHEST:
            raise ValueError(f"{name} of the index has values that are no places")
    if np.any(np.abs(arrays["anchors.main_angles"]) > _FARTHEST):  # NaN where there is none
        raise ValueError("anchors.main_angles of the index has values that are no angles")
    sensors = arrays["scans.sensors"]
    lengths = (("scans.starts", "scans.ranges"), ("names.starts", "names.text"))
    if (
        np.any(np.diff(arrays["references.identifiers"]) <= 0)
        or (count and arrays["references.identifiers"][0] < 0)
        or arrays["references.checksums"].shape != (count,)
        or arrays["references.poses"].shape != (count, 3)
        or sensors.shape != (count,)
        or (count and not 0 <= sensors.min() <= sensors.max() < len(arrays["scans.geometries"]))
        or arrays["scans.geometries"].shape[1] != 4
    ):
        raise ValueError("the references of the index do not fit each other")
    for starts, what in lengths:
        ends = arrays[starts]
        if (
            ends.shape != (count + 1,)
            or ends[0] != 0
            or ends[-1] != len(arrays[what])
            or np.any(np.diff(ends) < 0)
        ):
            raise ValueError(f"{starts} of the index does not fit")


def _made_of(settings: Settings) -> str:
    """Sign version and settings: what else an index depends on but its references."""
    values = settings.model_dump(mode="json")
    chosen = {name: values[name] for name in _SECTIONS}
    chosen["proposal"] = {name: values["proposal"][name] for name in _PROPOSAL}
    digest = blake2b(repr((_FORMAT, chosen)).encode(), digest_size=16)
    return f"{_stages()} {digest.hexdigest()}"


@cache
def _stages() -> str:
    """Sign the code of all stages, so that no version is forgotten."""
    digest = blake2b(digest_size=16)
    for stage in _STAGES:
        try:
            digest.update(Path(__file__).with_name(f"{stage}.py").read_bytes())
        except OSError:  # installed without its source: its version has to do
            digest.update(stage.encode() + version("anchorscan").encode())
    return digest.hexdigest()
