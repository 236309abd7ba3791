"""What README and documentation tell people to type works, in the order of each page.

A block that cannot run here says why in its title: ``sh title="needs ROS 2"``.  Blocks of the
kinds ``console``, ``pycon`` and ``text`` are what somebody saw, and are not run.
"""

from __future__ import annotations

import gzip
import html
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from as_a_user import run, write_log

from anchorscan import LaserScan, Pose2D, Record, Settings, drive, random_building
from anchorscan.reference_set import ReferenceSet

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<kind>\w+)(?P<notes>[^\n]*)\n(?P<text>.*?)^(?P=indent)```",
    re.MULTILINE | re.DOTALL,
)
# Why a block may be left out; a new reason belongs here.
EXCUSES = {
    "needs ROS 2",
    "needs a service",
    "needs several machines",
    "needs the logs",
    "opens a window",
}
LARGEST_PICTURE = 300_000


@dataclass(frozen=True)
class Block:
    kind: str
    excuse: str
    text: str


def blocks(page: Path) -> list[Block]:
    found = []
    for match in FENCE.finditer(page.read_text(encoding="utf-8")):
        indent = len(match["indent"])
        text = "".join(line[indent:] for line in match["text"].splitlines(keepends=True))
        title = re.search(r'title="([^"]*)"', match["notes"])
        found.append(Block(match["kind"], title[1] if title else "", text))
    return found


def named(pages: list[Path]) -> list[Any]:
    return [pytest.param(page, id=str(page.relative_to(ROOT))) for page in pages]


WITH_BLOCKS = [
    page for page in PAGES if any(block.kind in {"sh", "python"} for block in blocks(page))
]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the pages speak of."""
    folder = tmp_path_factory.mktemp("reader")
    building = random_building(5, length=24.0, depth=14.0)
    first, second = drive(building, seed=3, length=25.0), drive(building, seed=2, length=5.0)
    for name, records in (("first", first), ("second", second)):
        plain = write_log(folder / f"{name}-drive.log", records)
        packed = folder / f"{name}-drive.log.gz"
        packed.write_bytes(gzip.compress(plain.read_bytes()))
        plain.unlink()
    ReferenceSet.build(first, path=folder / "office.apr").close()
    write_table(folder / "scans.csv", first)
    write_trajectory(folder / "trajectory.txt", first)
    write_map(folder / "map.yaml", first)
    write_recording(folder / "drive.mcap", first[:40])
    return folder


def write_table(path: Path, records: list[Record]) -> None:
    with path.open("w", encoding="ascii") as stream:
        assert records[0].scan is not None
        names = [f"r{n}" for n in range(len(records[0].scan))]
        stream.write(",".join(["stamp", *names]) + "\n")
        for record in records:
            assert record.scan is not None
            stream.write(",".join([f"{record.stamp}", *map(str, record.scan.ranges)]) + "\n")


def write_trajectory(path: Path, records: list[Record]) -> None:
    from anchorscan import write_tum

    write_tum(path, [(record.stamp, record.pose) for record in records if record.stamp is not None])


def write_map(path: Path, records: list[Record]) -> None:
    from anchorscan import stitch, write_map

    if has_extra("maps"):
        write_map(stitch(records), path)


def write_recording(path: Path, records: list[Record]) -> None:
    """Write an MCAP with scans and a corrected pose, as a robot would."""
    if not has_extra("bags"):
        return
    from ros_recordings import Messages

    messages = Messages("mcap")
    messages.transform(0.0, "base_link", "laser", is_static=True)
    for record in records:
        assert record.scan is not None
        assert record.pose is not None
        assert record.stamp is not None
        scan, pose = record.scan, record.pose
        geometry = {
            **{"angle_min": scan.angle_min, "angle_increment": scan.angle_increment},
            **{"angle_max": float(scan.angles[-1]), "range_max": scan.range_max},
        }
        messages.posed(record.stamp, pose.x, pose.y, pose.theta, topic="/odometry", frame="map")
        messages.scan(record.stamp, scan.ranges, **geometry)
    folder = messages.write(path.parent, "recording")
    next(folder.glob("*.mcap")).rename(path)
    shutil.rmtree(folder)


def has_extra(name: str) -> bool:
    needed = {"bags": "rosbags", "maps": "yaml", "plot": "matplotlib", "view": "rerun"}
    return importlib.util.find_spec(needed[name]) is not None


@pytest.fixture
def reader(world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same folder, as it was, for each page."""
    folder = tmp_path / "reader"
    shutil.copytree(world, folder)
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize("page", named(WITH_BLOCKS))
def test_what_a_page_says_works_in_the_order_in_which_it_says_it(page: Path, reader: Path) -> None:
    scan = next(record.scan for record in drive(random_building(5), seed=1, length=1.0))
    assert isinstance(scan, LaserScan)
    known: dict[str, Any] = {"ranges": scan.ranges}
    for block in blocks(page):
        if block.excuse:
            assert block.excuse in EXCUSES, f"{page.name}: {block.excuse!r} is no reason we know"
        elif block.kind == "python":
            exec(compile(block.text, page.name, "exec"), known)
        elif block.kind == "sh":
            for line in block.text.splitlines():
                for command in line.split(" && "):
                    type_in(command, reader)
        elif block.kind == "json":
            json.loads(block.text)


_EXPLAINED: set[str] = set()


def type_in(line: str, folder: Path) -> None:
    """Do what a line of the shell says, as far as that is about this project."""
    words = shlex.split(line, comments=True)
    if not words:
        return
    if words[0] == "make":
        verbs = re.findall(r"^(\w+):.*## ", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
        assert words[1] in verbs, line
    elif words[:4] == ["python3", "-m", "pip", "install"]:
        for extra in re.findall(r"\.\[([\w,]+)\]", line):
            assert set(extra.split(",")) <= extras(), line
    elif words[:2] == ["anchorscan", "explain"] and line in _EXPLAINED:
        return  # several pages begin by looking at a scan, and drawing takes its time
    elif words[:1] == ["anchorscan"] and "|" not in words:
        _EXPLAINED.add(line)
        if words[1] == "view":
            pytest.importorskip("rerun", reason="the viewer is an extra")
        if words[1] == "build" and (target := folder / words[words.index("-o") + 1]).exists():
            target.unlink()  # the reader of this page has none yet
        done = run(*words[1:])
        assert done.code == 0, f"{line}\n{done.err}"
    elif words[:2] == ["python3", "examples/loop_closures.py"]:
        pytest.importorskip("gtsam")
        succeeds([sys.executable, str(ROOT / words[1]), *words[2:]])
    else:
        places = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        succeeds(["bash", "-ec", line], PATH=places)


def succeeds(command: list[str], folder: Path | None = None, **environment: str) -> None:
    """Run a command in a process of its own."""
    done = subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{shlex.join(command)}\n{done.stdout}{done.stderr}"


def extras() -> set[str]:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    section = text.split("[project.optional-dependencies]\n")[1].split("\n[")[0]
    return set(re.findall(r"^(\w+) = ", section, re.MULTILINE))


def test_links_and_pictures_lead_to_files() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for link in re.findall(r"\]\((?!https?:)([^)#]+)", text):
            assert (page.parent / link).exists(), f"{page.name} links to {link}"


def test_every_picture_is_used_and_small() -> None:
    used = " ".join(page.read_text(encoding="utf-8") for page in PAGES)
    for picture in (DOCS / "images").iterdir():
        assert picture.name in used, f"{picture.name} is in no page"
        assert picture.stat().st_size <= LARGEST_PICTURE, picture.name


def test_every_page_is_in_the_navigation() -> None:
    yaml = pytest.importorskip("yaml")
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")

    def pages(tree: Any) -> list[str]:
        if isinstance(tree, str):
            return [tree]
        branches = tree.values() if isinstance(tree, dict) else tree
        return [page for branch in branches for page in pages(branch)]

    listed = pages(yaml.safe_load(text.split("\nnav:\n")[1]))
    assert sorted(listed) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs", reason="the site is built with the extra 'docs'")
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
    succeeds(build, ROOT, NO_MKDOCS_2_WARNING="1")
    return folder


def test_the_site_is_built_strictly_and_loads_nothing_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(
            r"<(?:script|link|img|iframe)[^>]*(?:src|href)=\"?(https?:[^\" >]+)", text
        )
        assert not [address for address in loaded if "canonical" not in text], (page.name, loaded)


def test_every_command_and_option_is_documented(site: Path) -> None:
    from anchorscan.cli import app

    text = (site / "commands" / "index.html").read_text(encoding="utf-8")
    for command in app.registered_commands:
        assert command.callback is not None
        name = command.name or command.callback.__name__.replace("_", "-")
        assert f'<h2 id="{name}">' in text
        help_of = re.findall(r"(--[a-z-]+)", run(name, "--help").out)
        for option in set(help_of) - {"--help", "--ros-args"}:
            assert option in text, f"{name} {option}"


def test_every_setting_is_documented_with_its_value(site: Path) -> None:
    text = (site / "settings" / "index.html").read_text(encoding="utf-8")

    def leaves(tree: dict[str, Any], path: str = "") -> list[tuple[str, Any]]:
        found = []
        for name, value in tree.items():
            if isinstance(value, dict):
                found += leaves(value, f"{path}{name}.")
            else:
                found.append((f"{path}{name}", value))
        return found

    for name, value in leaves(Settings.preset("default").model_dump()):
        row = re.search(rf"<td><code>{re.escape(name)}</code></td>\s*<td>([^<]*)</td>", text)
        assert row is not None, name
        if isinstance(value, float):
            assert float(row[1].split()[0]) == pytest.approx(value, rel=1e-3), name


def test_every_parameter_of_the_robot_is_documented(site: Path) -> None:
    from anchorscan.robot_parameters import RobotParameters

    text = (site / "robot" / "index.html").read_text(encoding="utf-8")
    for name, (_, meaning) in RobotParameters.meanings().items():
        assert f"<td><code>{name}</code></td>" in text
        assert meaning.split(";")[0] in html.unescape(text)


def test_every_public_name_is_documented(site: Path) -> None:
    import anchorscan

    text = (site / "python" / "index.html").read_text(encoding="utf-8")
    for name in set(anchorscan.__all__) - {"__version__"}:
        assert re.search(rf'id="anchorscan\.(?:\w+\.)*{name}"', text), name


def test_numbers_in_numpy_do_not_leak_into_what_is_shown() -> None:
    """Blocks print poses; a page that shows ``np.float64(1.0)`` would be noise."""
    assert "np.float" not in repr(Pose2D(np.float64(1.0), 0.0, 0.0))
