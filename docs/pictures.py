"""Draws the pictures of the documentation again, into docs/images.

    make picture

Everything is made from the MIT Killian Court recording (package ``rtb-data``) or from simulated
drives; no other data may appear in pictures that are kept.  The pictures of the report and of the
viewer need a browser and Rerun and are left as they are where those are missing.
"""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from anchorscan import Record, ReferenceSet, drive, open_log, random_building
from anchorscan.answers import Run, ScanAnswer
from anchorscan.demo import demonstrate, killian_court
from anchorscan.drawing import DARK, LIGHT
from anchorscan.explanation import Explanation
from anchorscan.figures import save_all
from anchorscan.protocol import revisit
from anchorscan.report import write_report
from anchorscan.settings import Settings

if TYPE_CHECKING:
    from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
# A room at the end of a corridor, seen twice: much to see, and many rivals.
SHOWN = 1424
COLOURS = 256
LARGEST = 300_000
WIDTH = 1100


def main() -> None:
    """Draw all pictures."""
    records = list(open_log(killian_court()))
    split = revisit(records)
    places = ReferenceSet.build((records[n] for n in split.references), keep_all=True)
    draw_steps(places, records[SHOWN])
    draw_report(places)
    draw_viewer()
    draw_loop_closures()
    for path in sorted(IMAGES.glob("*.png")):
        print(f"{path.stat().st_size:>8} {path.relative_to(ROOT)}")


def draw_steps(places: ReferenceSet, record: Record) -> None:
    """Draw the steps of the algorithm, for "How it works"."""
    assert record.scan is not None
    explanation = Explanation(places.explain(record.scan), places.references, record.pose)
    for path in save_all(explanation, IMAGES, (LIGHT, DARK)):
        reduce_colours(path)


def draw_report(places: ReferenceSet) -> None:
    """Take a picture of the report of the demonstration."""
    browser = shutil.which("chromium")
    if browser is None:
        print("no chromium: the picture of the report stays as it is")
        return
    outcome = demonstrate(killian_court())
    answers = tuple(
        ScanAnswer.of(each.record, [each.best] if each.best else [], each.answer.seconds)
        for each in outcome.located
    )
    with tempfile.TemporaryDirectory() as folder:
        page, picture = Path(folder) / "report.html", Path(folder) / "report.png"
        run = Run("locate", "demo", answers)
        log = {"killian": lambda: iter(outcome.records)}
        write_report(page, [run], outcome.places.references, log, title="MIT Killian Court")
        switches = [
            "--headless=new",
            "--no-sandbox",
            "--hide-scrollbars",
            "--window-size=1500,1180",
        ]
        subprocess.run(
            [browser, *switches, f"--screenshot={picture}", page.as_uri()],
            check=True,
            capture_output=True,
        )
        shutil.copy(picture, IMAGES / "report.png")
    shrink(IMAGES / "report.png")


def draw_viewer() -> None:
    """Take a picture of Rerun with a simulated drive."""
    rerun = shutil.which("rerun")
    if rerun is None:
        print("no rerun: the picture of the viewer stays as it is")
        return
    from anchorscan.viewer import Viewer

    with tempfile.TemporaryDirectory() as folder:
        recording, picture = Path(folder) / "demo.rrd", Path(folder) / "demo.png"
        building = random_building(7, length=24.0, depth=18.0)
        places = ReferenceSet.build(drive(building, seed=1, length=120.0))
        places.prepare()
        with Viewer(places.references, places.settings, recording) as viewer:
            for record in drive(building, seed=2, length=20.0)[:60]:
                assert record.scan is not None
                start = time.perf_counter()
                hypotheses = places.locate(record.scan)
                answer = ScanAnswer.of(record, hypotheses, time.perf_counter() - start)
                viewer.show(record, answer)
        with recording.open("rb") as stream:  # from stdin it is read whole before the picture
            done = subprocess.run(
                [rerun, "-", "--headless", f"--screenshot-to={picture}", "--window-size=1500x900"],
                stdin=stream,
                env={**os.environ, "CI": "1"},
                capture_output=True,
                check=False,
            )
        if not picture.exists():
            print(f"no picture of the viewer: {done.stderr.decode(errors='replace')[-200:]}")
            return
        shutil.copy(picture, IMAGES / "viewer.png")
    shrink(IMAGES / "viewer.png")


def draw_loop_closures() -> None:
    """Draw the picture of the example of loop closures, from a simulated drive."""
    records = drive(
        random_building(7, length=40.0, depth=24.0), seed=3, length=250.0, odometry_noise=0.08
    )
    example = runpy.run_path(str(ROOT / "examples" / "loop_closures.py"))
    frames = example["keyframes"](records)
    after, closures = example["build_map"](frames, Settings.preset())
    path = IMAGES / "loop-closures.png"
    example["draw"](path, frames, example["by_odometry"](frames), after, closures)
    reduce_colours(path)


def reduce_colours(path: Path) -> None:
    """Make a drawing small enough to be kept: it has few colours."""
    from PIL import Image

    picture = Image.open(path).convert("RGB")
    # By coverage, not by frequency: the rare colours are those that mean something.
    picture = picture.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    keep(picture, path)


def shrink(path: Path) -> None:
    """Make a picture of a window small enough to be kept."""
    from PIL import Image

    picture = Image.open(path).convert("RGB")
    height = round(picture.height * WIDTH / picture.width)
    keep(picture.resize((WIDTH, height), Image.Resampling.LANCZOS), path)


def keep(picture: Image.Image, path: Path) -> None:
    """Save a picture; stop if it is too large."""
    picture.save(path, optimize=True)
    if path.stat().st_size > LARGEST:
        sys.exit(f"{path} is too large to be kept: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
