"""What fuzzing begins with: small sound files of every kind, and pieces of real ones.

Small on purpose: an execution should cost a fraction of a millisecond, and a byte that is changed
should be one that means something.
"""

from __future__ import annotations

import gzip
import io
import itertools
import json
import math
import os
import sqlite3
import struct
import tempfile
import zipfile
from contextlib import closing
from pathlib import Path

import numpy as np

from anchorscan import (
    LaserScan,
    OccupancyGrid,
    Pose2D,
    ReferenceSet,
    SensorModel,
    Settings,
    World,
    simulate,
    write_map,
)
from anchorscan.array_file import write_arrays

SEPARATOR = b"\n--8<--\n"
"""Between the files of an input that stands for several."""

_READINGS = " ".join(f"{1 + 0.05 * i:.2f}" for i in range(9))
_TAIL = "0 1 2 0.3 1 2 0.3 0 0 0 0 0 5.5 host 5.5"
# Real lines are cut to so many readings' worth of text, so that executions stay quick.
_REAL_LINES = 3


def real_text(name: str) -> list[bytes]:
    """Give the first lines of a real log as one text, or nothing where there is none."""
    path = Path(os.environ.get("ANCHORSCAN_DATA", "")) / name
    if not path.is_file():
        return []
    with gzip.open(path, "rb") as stream:
        return [b"".join(itertools.islice(stream, _REAL_LINES))]


def carmen() -> list[bytes]:
    """CARMEN logs: every kind of scan line, parameters, odometry, comments."""
    laser = "".join(
        f"FLASER 9 {_READINGS} {i} {0.5 * i} 0.1 {1.1 * i} 0 0 {i}.5 host {i}.5\n" for i in range(3)
    )
    parameters = (
        "# comment\nPARAM laser_front_laser_resolution 1.0 1.0 host 0\n"
        "PARAM robot_frontlaser_offset 0.1 host 0\nPARAM robot_front_laser_max 30 1.0 host 0\n"
    )
    robot = f"ROBOTLASER1 0 -1.57 3.14 0.01745 80 0.1 0 9 {_READINGS} {_TAIL}\n"
    rear = f"RLASER 9 {_READINGS} 1 2 3 1 2 3 1.0 host 1.0\nODOM 0 0 0 0 0 0 1.0 host 1.0\n"
    texts = [parameters + laser, parameters + rear, robot * 2, laser, "NEFF 1\nODOM 0\n" + robot]
    return [text.encode() for text in texts] + real_text("intel.log.gz")


def g2o() -> list[bytes]:
    """g2o files of vertices, scans and edges."""
    scan = f"ROBOTLASER1 0 -1.57 3.14 0.01745 80 0.1 0 9 {_READINGS} {_TAIL}\n"
    parts = "".join(f"VERTEX_SE2 {i} {i} 0.5 0.1\n{scan}" for i in range(3))
    edge = "EDGE_SE2 0 1 1 0 0 500 0 0 500 0 5000\n"
    return [parts.encode(), (parts + edge).encode(), (edge + scan).encode(), _killian()]


def _killian() -> bytes:
    try:
        import rtbdata
    except ImportError:
        return b"VERTEX_SE2 0 0 0 0\n"
    path = Path(rtbdata.__file__).parent / "data" / "killian.g2o.zip"
    with zipfile.ZipFile(path) as archive, archive.open(archive.namelist()[0]) as stream:
        return b"".join(itertools.islice(stream, _REAL_LINES))


def csv() -> list[bytes]:
    """Tables with and without names, with each delimiter."""
    names = "stamp,x,y,theta,angle_min,angle_increment,range_max,r0,r1,r2,r3"
    rows = "".join(f"\n{i},{i},0.5,0.1,-0.5,0.25,8,1,2,,inf" for i in range(3))
    plain = " ".join(["1"] * 181)  # short: inputs may become twice as long as the longest seed
    echo = (
        "%time,field.header.stamp,field.angle_min,field.angle_increment,field.ranges0,field.ranges1"
    )
    texts = [names + rows, (names + rows).replace(",", ";"), (names + rows).replace(",", "\t")]
    texts += [plain, echo + "\n1e18,-1,0.5,1,2\n"]
    return [text.encode() for text in texts]


def tum() -> list[bytes]:
    """TUM trajectories, dense enough for the times of the scans to lie between two poses."""
    rows = "".join(f"{0.4 * i:.1f} {i} 0 0 0 0 0.1 0.99\n" for i in range(5))
    return [b"# time x y z\n" + rows.encode(), rows.replace(" ", ",").encode()]


def _npy(values: object, **options: object) -> bytes:
    stream = io.BytesIO()
    np.save(stream, np.asarray(values, **options), allow_pickle=False)  # type: ignore[call-overload]
    return stream.getvalue()


NPZ_MEMBERS = ("ranges", "poses", "stamps", "angle_min", "angle_increment", "T_base_laser")


def numpy_files() -> list[bytes]:
    """``.npy`` files, and members of ``.npz`` files one after the other."""
    ranges = np.ones((3, 8), np.float32)
    members = [
        *(_npy(ranges), _npy(np.ones((3, 3))), _npy(np.ones(3))),
        *(_npy(-0.5), _npy(np.full(3, 0.1)), _npy(np.ones(3))),
    ]
    fortran = _npy(np.asfortranarray(np.ones((2, 181), np.uint8)))
    return [
        _npy(np.ones((1, 181), ">f2")),
        fortran,
        SEPARATOR.join(members),
        SEPARATOR.join(members[:2]),
    ]


def archives() -> list[bytes]:
    """What is to be packed, and what is packed already; the first byte says which."""
    text = carmen()[0]
    raw = io.BytesIO()
    with zipfile.ZipFile(raw, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.log", text)
    return [b"\0" + gzip.compress(text), b"\0" + raw.getvalue(), b"\1" + text, b"\2" + text]


def _recordings() -> list[tuple[str, bytes]]:
    from ros_recordings import Messages

    found = []
    for storage, ending in (("ros1", "bag"), ("sqlite3", "db3"), ("mcap", "mcap")):
        messages = Messages(storage)
        for number in range(2):
            messages.scan(1.0 + number, [1.0, 2.0, 3.0])
        with tempfile.TemporaryDirectory() as folder:
            path = messages.write(Path(folder))
            part = path if path.is_file() else next(path.glob(f"*.{ending}"))
            if ending == "db3":
                _shrink(part)
            found.append((ending, part.read_bytes()))
    return found


def _shrink(path: Path) -> None:
    """Have an SQLite file waste less: its pages are larger than most tables."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA page_size = 512")
        connection.execute("VACUUM")


def bags() -> list[bytes]:
    """Recordings in every storage."""
    return [content for _, content in _recordings()]


def metadata() -> list[bytes]:
    """The description of a rosbag2 folder: what is read of it, the rest costs a millisecond."""
    topic = {"name": "/scan", "type": "sensor_msgs/msg/LaserScan", "serialization_format": "cdr"}
    told = {
        "version": 9,
        "storage_identifier": "sqlite3",
        "relative_file_paths": ["run.db3"],
        "duration": {"nanoseconds": 9},
        "starting_time": {"nanoseconds_since_epoch": 1},
        "message_count": 2,
        "topics_with_message_count": [{"topic_metadata": topic, "message_count": 2}],
    }
    rows = """\
rosbag2_bagfile_information:
  compression_mode: ''
  duration:
    nanoseconds: 9
  files: []
  message_count: 2
  relative_file_paths:
  - run.db3
  starting_time:
    nanoseconds_since_epoch: 1
  storage_identifier: sqlite3
  topics_with_message_count:
  - message_count: 2
    topic_metadata:
      name: /scan
      offered_qos_profiles: ''
      serialization_format: cdr
      type: sensor_msgs/msg/LaserScan
  version: 4
"""
    return [rows.encode(), json.dumps({"rosbag2_bagfile_information": told}).encode()]


def storage() -> bytes:
    """A rosbag2 storage that `metadata` describes."""
    return next(content for ending, content in _recordings() if ending == "db3")


def messages() -> list[bytes]:
    """Laser scans as messages, serialised."""
    from ros_recordings import Messages

    recorded = Messages("sqlite3")
    recorded.scan(1.5, [1.0, 2.0, 3.0])
    recorded.scan(2.5, [])
    return [bytes(recorded.store.serialize_cdr(m, kind)) for _, _, kind, m in recorded.entries]


def rooms() -> list[tuple[LaserScan, Pose2D]]:
    """Scans of one drawn room with a niche, from two places."""
    walls = [
        *((0, 0, 6, 0), (6, 0, 6, 2), (6, 2, 7, 2), (7, 2, 7, 3), (7, 3, 6, 3)),
        *((6, 3, 6, 4), (6, 4, 0, 4), (0, 4, 0, 0), (2, 1, 2.5, 1), (2.5, 1, 2.5, 1.5)),
    ]
    world = World(np.array(walls, dtype=float), np.empty((0, 3)))
    sensor = SensorModel(field_of_view=4.7, resolution=0.05, noise=0.0)
    places = [Pose2D(3.0, 2.0, 0.3), Pose2D(1.0, 3.0, -1.2)]
    return [(simulate(world, place, sensor), place) for place in places]


def sets() -> list[bytes]:
    """Files of reference sets."""
    found = []
    for poses in (True, False):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "a.apr"
            with ReferenceSet(path=path, name="a room") as places:
                for scan, pose in rooms():
                    places.add(scan, pose if poses else None, "niche")
            found.append(path.read_bytes())
    return found


SEALED = struct.Struct("<qqddddddd")
"""Identifier, readings, geometry (four) and pose (three) of a row of a set's file."""


def sealed() -> list[bytes]:
    """Rows of a set's file: values, name, settings, ranges."""
    rows = []
    for scan, pose in rooms():
        geometry = (scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
        head = SEALED.pack(0, len(scan), *geometry, pose.x, pose.y, pose.theta)
        rows.append(SEPARATOR.join([head, b"name", b"", scan.ranges.tobytes()]))
    rows.append(SEPARATOR.join([head, b"", b'{"method": "references"}', scan.ranges.tobytes()]))
    return rows


ARRAYS = {"keys": np.arange(9, dtype=np.uint32), "rows": np.ones((3, 5)), "none": np.empty(0)}
"""What a small file of arrays holds."""


def array_files() -> list[bytes]:
    """Files of arrays, with and without room behind them."""
    found = []
    for room in ({}, {"rows": 4}):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "arrays"
            write_arrays(path, ARRAYS, "fuzz", room)
            found.append(path.read_bytes())
    return found


EDIT = struct.Struct("<BBHHq")
"""One change of the arrays of an index: which, how, where, how many, and a value."""


def index_edits() -> list[bytes]:
    """Changes of the arrays of an index: none, and a value of every kind in every array."""
    found = [bytes([first]) for first in range(12)]  # of both kinds, whatever is done then
    for how in range(9):
        found += [bytes([2 + (n + how) % 10]) + EDIT.pack(n, how, 3, 2, -1) for n in range(34)]
    found += [bytes([2 + n % 10]) + EDIT.pack(n, 0, 3, 2, WORST[n % len(WORST)]) for n in range(34)]
    return found


WORST = tuple(
    struct.unpack("<q", struct.pack("<d", value))[0]
    for value in (math.nan, math.inf, -math.inf, 1e308, 1e18, 1e9)
)
"""Numbers that fit no kernel, as the value of a change."""


def directories() -> list[bytes]:
    """``set.json``, ``references.csv`` and the ranges of an exported set."""
    table = (
        "identifier,x,y,theta,name,angle_min,angle_increment,range_min,range_max\n"
        "0,1.0,2.0,0.5,door,-1.5,0.1,0.0,80.0\n"
    )
    description = json.dumps({"name": "a", "next_identifier": 1, "settings": None})
    return [SEPARATOR.join([description.encode(), table.encode(), _npy(np.ones(8, np.float32))])]


def _image(kind: str, mode: str) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.new(mode, (8, 6)).save(stream, kind)
    return stream.getvalue()


def maps() -> list[bytes]:
    """YAML and image of maps."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.yaml"
        cells = np.zeros((8, 10), np.int8)
        cells[0], cells[-1], cells[:, 0], cells[:, -1], cells[4, 5] = 100, 100, 100, 100, -1
        write_map(OccupancyGrid(cells, 0.5, Pose2D(-1.0, 2.0, 0.1)), path)
        text, image = path.read_bytes(), path.with_suffix(".pgm").read_bytes()
    plain = b"P2\n# by hand\n3 2\n255\n0 254 205\n254 254 0\n"
    scaled = b"image: m.pgm\nresolution: 5e-2\norigin: [0, 0, 0]\nmode: scale\nnegate: 1\n"
    return [
        SEPARATOR.join([text, image]),
        SEPARATOR.join([scaled, plain]),
        SEPARATOR.join([scaled.replace(b"scale", b"raw"), _image("PNG", "L")]),
        SEPARATOR.join([text, _image("PNG", "RGBA")]),
        SEPARATOR.join([text, _image("BMP", "1")]),
    ]


def settings() -> list[bytes]:
    """Settings files."""
    texts = [Settings.preset(name).to_json() for name in ("default", "paper")]
    texts += ['{"database": {"candidates": 10}}', '{"anchors": {"arm": 0.4}, "method": "map"}']
    return [text.encode() for text in texts]


LIMITS = struct.Struct("<dddd")
"""First angle, increment, shortest and longest range of a scan."""


def scans() -> list[bytes]:
    """Geometry and readings of scans."""
    found = []
    for scan, _ in rooms():
        limits = LIMITS.pack(scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
        found.append(limits + scan.ranges.tobytes())
    wild = np.array([np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-30, 1e30, 5.0] * 4, np.float32)
    return [*found, LIMITS.pack(-0.5, 0.05, 0.0, 8.0) + wild.tobytes()]


def answers() -> list[bytes]:
    """What ``locate`` and ``track`` write."""
    pose = {"x": 1.0, "y": 2.0, "theta": 0.1}
    covariance = [[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]]
    guess = {**pose, "reference": 1, "covariance": covariance, "evaluation": 0.9, "quality": 0.5}
    guess |= {"probability": 0.9, "score": 0.8, "pose_in_reference": pose}
    line = {"scan": 0, "stamp": 1.5, "seconds": 0.01, "accepted": True, "hypotheses": [guess]}
    track = {"scan": 0, "stamp": 1.5, "seconds": 0.01, "accepted": False, **pose}
    track |= {"covariance": covariance, "probability": 0.5, "state": "searching"}
    texts = ["\n".join([json.dumps(line)] * 2), json.dumps(track)]
    return [*(text.encode() for text in texts), gzip.compress(texts[0].encode())]
