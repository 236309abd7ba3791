"""What README and documentation tell people to type works."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import pytest

from anchorscan import LaserScan, Record, drive, random_building
from anchorscan.cli import main
from anchorscan.reference_set import ReferenceSet

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(language: str) -> list[object]:
    return [
        pytest.param(text, id=f"{page.relative_to(ROOT)}-{number}")
        for page in PAGES
        for number, (kind, text) in enumerate(BLOCK.findall(page.read_text(encoding="utf-8")))
        if kind == language
    ]


@pytest.fixture(scope="module")
def drives() -> tuple[list[Record], list[Record]]:
    building = random_building(5)
    return drive(building, seed=1, length=15.0), drive(building, seed=2, length=3.0)


@pytest.fixture
def somewhere(
    drives: tuple[list[Record], list[Record]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """A folder with the files that the pages speak of."""
    for name, records in zip(("first", "second"), drives, strict=True):
        write_g2o(tmp_path / f"{name}-drive.log.gz", records)
    ReferenceSet.build(drives[0], path=tmp_path / "office.apr").close()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write_g2o(path: Path, records: list[Record]) -> None:
    import gzip

    with gzip.open(path, "wt") as stream:
        for number, record in enumerate(records):
            assert record.scan is not None
            assert record.pose is not None
            scan, pose = record.scan, record.pose
            ranges = " ".join(f"{min(value, 99.0):.3f}" for value in scan.ranges)
            stream.write(f"VERTEX_SE2 {number} {pose.x} {pose.y} {pose.theta}\n")
            stream.write(
                f"ROBOTLASER1 0 {scan.angle_min} {scan.field_of_view} {scan.angle_increment} "
                f"{scan.range_max} 0.1 0 {len(scan)} {ranges} 0 {pose.x} {pose.y} {pose.theta} "
                f"{pose.x} {pose.y} {pose.theta} 0 0 0 0 0 {record.stamp} robot {record.stamp}\n"
            )


@pytest.mark.parametrize("text", blocks("python"))
def test_python_runs(
    text: str,
    somewhere: Path,
    drives: tuple[list[Record], list[Record]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    scan = drives[1][0].scan
    assert isinstance(scan, LaserScan)
    exec(compile(text, "page", "exec"), {"ranges": scan.ranges})
    assert "Pose2D" in capsys.readouterr().out


@pytest.mark.parametrize("text", blocks("sh"))
def test_commands_run(
    text: str,
    somewhere: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Run the commands of anchorscan; those of make must be verbs of the Makefile."""
    (somewhere / "office.apr").unlink()
    verbs = re.findall(r"^([\w-]+):.*## ", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    for line in re.split(r"\n|&&", text):
        words = shlex.split(line, comments=True)
        if words[:1] == ["make"]:
            assert words[1] in verbs
        elif words[:1] == ["anchorscan"]:
            monkeypatch.setattr(sys, "argv", words)
            with pytest.raises(SystemExit) as ended:
                main()
            assert not ended.value.code, capsys.readouterr().err


def test_links_lead_to_files() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for link in re.findall(r"\]\((?!https?:)([^)#]+)", text):
            assert (page.parent / link).exists(), f"{page.name} links to {link}"
