"""The pictures of a trace: they show what the trace holds, in colours that everybody can tell."""

from __future__ import annotations

import itertools
import math
import re
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from as_a_user import run, write_log
from numpy.typing import NDArray

from anchorscan import (
    LaserScan,
    Matcher,
    MissingExtraError,
    Pose2D,
    Record,
    Reference,
    SensorModel,
    Settings,
    drive,
    random_building,
)
from anchorscan.drawing import DARK, LIGHT, Theme
from anchorscan.explanation import Explanation, Reading
from anchorscan.figures import PICTURES, draw, save_all
from anchorscan.reference_set import ReferenceSet

matplotlib = pytest.importorskip("matplotlib", reason="pictures are in the extra 'plot'")

THEMES = pytest.mark.parametrize("theme", [LIGHT, DARK], ids=lambda theme: theme.name)


def explain(references: list[Reference], scan: LaserScan, preset: str = "default") -> Explanation:
    trace = Matcher(references, Settings.preset(preset)).explain(scan)
    return Explanation(trace, references, Pose2D(1.0, 1.0, 0.0))


@pytest.fixture(scope="module")
def drives() -> tuple[list[Record], list[Record]]:
    building = random_building(5)
    full = SensorModel(
        field_of_view=2.0 * math.pi, resolution=math.radians(2.0), range_max=8.0, clockwise=True
    )
    return drive(building, seed=1, length=20.0)[::6], drive(building, full, seed=1, length=2.0)


def known(drives: tuple[list[Record], list[Record]], *, posed: bool = True) -> list[Reference]:
    return [
        Reference(record.index, record.scan, record.pose if posed else None)
        for record in drives[0]
        if record.scan is not None
    ]


@pytest.fixture(scope="module")
def explanation(drives: tuple[list[Record], list[Record]]) -> Explanation:
    scan = drives[0][3].scan
    assert scan is not None
    return explain(known(drives)[:3] + known(drives)[4:], scan)


@pytest.fixture(scope="module")
def odd(drives: tuple[list[Record], list[Record]]) -> dict[str, Explanation]:
    """Traces in which something that is usually there is missing."""
    full = drives[1][4].scan
    assert full is not None
    lone = LaserScan(np.full(1, 2.0), 0.0, 0.1)
    return {
        "full turn": explain(known(drives), full),
        "paper": explain(known(drives), full, "paper"),
        "no poses": explain(known(drives, posed=False), full),
        "one reading": explain(known(drives), lone),
        "one reading everywhere": explain([Reference(0, lone, Pose2D())], lone),
        "one reading, paper": explain([Reference(0, lone)], lone, "paper"),
    }


def words(figure: object) -> str:
    """Everything that is written in a figure."""
    found = figure.findobj(matplotlib.text.Text)  # type: ignore[attr-defined]
    return "\n".join(text.get_text() for text in found)


@pytest.mark.parametrize("name", PICTURES)
def test_every_picture_can_be_drawn_of_every_trace(name: str, odd: dict[str, Explanation]) -> None:
    for theme, (what, each) in zip(itertools.cycle([LIGHT, DARK]), odd.items(), strict=False):
        figure = draw(each, name, theme)
        panels = [axes for axes in figure.axes if axes.has_data() or axes.texts]
        assert panels, f"{what}: nothing is drawn and nothing said"


def test_what_there_is_nothing_of_is_said(odd: dict[str, Explanation]) -> None:
    assert "no poses in a common frame" in words(draw(odd["no poses"], "3-votes"))
    assert "not searched in a stitched map" in words(draw(odd["paper"], "8-proposals"))
    assert "no anchor point" in words(draw(odd["one reading"], "6-correspondence-matrix"))
    assert "No surface" in words(draw(odd["one reading"], "2-virtual-edges"))
    assert "0 pairs correspond" in words(draw(odd["one reading"], "5-matching-angles"))


def test_the_angle_function_is_drawn_beam_by_beam(explanation: Explanation) -> None:
    angles = explanation.trace.description.angles
    _, right = draw(explanation, "1-angle-function").axes
    drawn = np.concatenate([line.get_xydata() for line in right.lines[:2]])
    expected = np.degrees(np.column_stack((angles.beams, np.mod(angles.surface, math.pi))))
    np.testing.assert_allclose(
        drawn[np.argsort(drawn[:, 0])], expected[np.argsort(expected[:, 0])], equal_nan=True
    )


def test_the_histograms_of_the_walls_hold_every_metre_of_surface(
    explanation: Explanation,
) -> None:
    edges = explanation.trace.description.edges[0]
    panel = draw(explanation, "2-virtual-edges").axes[0]
    above, aside = panel.child_axes
    assert sum(bar.get_height() for bar in above.patches) == pytest.approx(
        edges.histograms[0].sum()
    )
    assert sum(bar.get_width() for bar in aside.patches) == pytest.approx(edges.histograms[1].sum())


def test_the_matching_angles_are_all_corresponding_pairs(explanation: Explanation) -> None:
    steps = explanation.pairing.alignment.steps
    axes = draw(explanation, "5-matching-angles").axes[0]
    assert sum(bar.get_height() for bar in axes.patches) == len(steps.correspondences)
    # The turn of the answer is drawn where its pairs are: modulo half a turn.
    (turn,) = set(axes.lines[0].get_xdata())
    expected = math.degrees(explanation.trace.hypotheses[0].pose_in_reference.theta)
    assert math.remainder(turn - expected, 180.0) == pytest.approx(0.0, abs=1e-9)
    low, high = axes.get_xlim()
    assert low <= turn <= high


def test_the_matrix_is_that_of_the_alignment(explanation: Explanation) -> None:
    axes = draw(explanation, "6-correspondence-matrix").axes[0]
    matrix = explanation.pairing.alignment.steps.matrix(0)
    np.testing.assert_array_equal(axes.images[0].get_array(), matrix)
    assert explanation.pairing.maximum is not None
    row, column, value = explanation.pairing.maximum
    assert value == matrix.max() == matrix[row, column]
    (square,) = [line for line in axes.lines if line.get_marker() == "s"]
    assert (square.get_xdata()[0], square.get_ydata()[0]) == (column, row)
    written = {text.get_position(): int(text.get_text()) for text in axes.texts}
    assert written == {(c, r): matrix[r, c] for r, c in np.argwhere(matrix > 0).tolist()}


def test_the_legend_counts_every_reading_of_the_front_scan(explanation: Explanation) -> None:
    readings = explanation.comparison.readings
    (legend,) = draw(explanation, "7-overlay").legends
    counts = [
        int(text.get_text().rsplit(":")[1]) for text in legend.texts if ":" in text.get_text()
    ]
    assert sum(counts) == np.sum(readings != Reading.NO_RETURN)
    assert np.sum(readings == Reading.AGREES) in counts


def test_the_fits_are_drawn_best_first_with_what_they_are_worth(explanation: Explanation) -> None:
    search = explanation.trace.in_map
    assert search is not None
    figure = draw(explanation, "8-proposals")
    *_, bars = figure.axes
    drawn = [bar.get_width() for bar in bars.patches]
    np.testing.assert_allclose(drawn, np.maximum(search.fits.features[: len(drawn), 0], 0.0))
    notes = [text.get_text() for text in bars.texts]
    assert notes[0] == f"p = {search.decision.probabilities[0]:.3f}"
    assert f"{search.proposals.proposed:,} proposals" in words(figure)


def test_files_appear_whole_one_for_each_picture_and_theme(
    odd: dict[str, Explanation], tmp_path: Path
) -> None:
    folder = tmp_path / "new" / "folder"
    files = save_all(odd["one reading everywhere"], folder, [LIGHT, DARK], "svg")
    names = [f"{name}{suffix}.svg" for name in PICTURES for suffix in ("", "-dark")]
    assert [file.name for file in files] == names
    assert sorted(path.name for path in folder.iterdir()) == sorted(names)
    for file in files:
        text = file.read_text(encoding="utf-8")
        assert text.rstrip().endswith("</svg>")
        ours, other = (DARK, LIGHT) if "-dark" in file.name else (LIGHT, DARK)
        assert ours.paper in text
        assert other.paper not in text
    # The method of the paper proposes nothing in a map.
    assert "8-proposals.svg" not in {
        file.name for file in save_all(odd["one reading, paper"], tmp_path / "b", [LIGHT], "svg")
    }


def test_the_same_trace_gives_the_same_file(explanation: Explanation, tmp_path: Path) -> None:
    from anchorscan.drawing import save

    for kind in ("png", "svg"):
        first, second = tmp_path / f"a.{kind}", tmp_path / f"b.{kind}"
        for path in (first, second):
            save(draw(explanation, "5-matching-angles"), path)
        assert first.read_bytes() == second.read_bytes()


def test_without_matplotlib_one_is_told_what_to_install(
    explanation: Explanation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'anchorscan\[plot\]'"):
        save_all(explanation, tmp_path / "pictures")
    assert not (tmp_path / "pictures").exists()


# What dichromats see, in linear RGB (Machado, Oliveira and Fernandes, 2009, severity 1).
PROTANOPIA = [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]]
DEUTERANOPIA = [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]]
TRITANOPIA = [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]]


def linear(color: str) -> NDArray[np.float64]:
    values = np.array([int(color[k : k + 2], 16) / 255.0 for k in (1, 3, 5)])
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def lab(rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """Carry linear RGB to CIE L*a*b* (D65)."""
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    xyz = np.clip(to_xyz @ rgb, 0.0, None) / (0.9505, 1.0, 1.089)
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


def together() -> Iterator[tuple[str, ...]]:
    """Colours that must be told apart in one picture."""
    yield "scan", "reference"
    yield "jump", "angle", "virtual"
    yield "scan", "soft"


@THEMES
@pytest.mark.parametrize(
    "eye",
    [np.eye(3), PROTANOPIA, DEUTERANOPIA, TRITANOPIA],
    ids=["full", "protan", "deutan", "tritan"],
)
def test_colours_are_told_apart_with_any_colour_vision(theme: Theme, eye: object) -> None:
    for group in together():
        for one, other in itertools.combinations(group, 2):
            seen = [lab(np.asarray(eye) @ linear(getattr(theme, name))) for name in (one, other)]
            assert np.linalg.norm(seen[0] - seen[1]) > 15.0, (one, other)


@THEMES
def test_everything_stands_out_from_the_paper(theme: Theme) -> None:
    def luminance(color: str) -> float:
        return float(np.dot((0.2126, 0.7152, 0.0722), linear(color)))

    def contrast(name: str) -> float:
        pair = luminance(theme.paper), luminance(getattr(theme, name))
        return (max(pair) + 0.05) / (min(pair) + 0.05)

    assert contrast("ink") > 12.0
    assert contrast("soft") > 3.5
    for field in fields(theme):
        if field.name in {"scan", "reference", "jump", "angle", "virtual", "surface"}:
            assert contrast(field.name) > 2.0, field.name


# As a user


@pytest.fixture(scope="module")
def files(
    drives: tuple[list[Record], list[Record]], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("drive")
    log = write_log(folder / "drive.log", drives[0])
    places = folder / "drive.apr"
    ReferenceSet.build(drives[0], keep_all=True, path=places).close()
    return places, log


def test_explain_writes_the_pictures_and_names_them(
    files: tuple[Path, Path], tmp_path: Path
) -> None:
    folder = tmp_path / "why"
    done = run("explain", *files, "--scan", 2, "-o", folder, "--format", "svg", "--preset", "paper")
    assert done.code == 0
    assert done.out.split() == [str(folder / f"{name}.svg") for name in [*PICTURES][:-1]]
    assert all(Path(name).stat().st_size > 1000 for name in done.out.split())
    assert "scan 2: " in done.err.splitlines()[-1]
    # The scan is a reference of the set: it was located, and laid on itself.
    assert "probability" in done.err.splitlines()[-1]


def test_explain_tells_how_well_a_scan_fits_upside_down_where_that_is_asked(
    files: tuple[Path, Path], tmp_path: Path
) -> None:
    both_ways = tmp_path / "both-ways.json"
    both_ways.write_text('{"decision": {"both_ways": true}}', encoding="utf-8")
    words = ("explain", *files, "--scan", 2, "-o", tmp_path / "why")
    assert "upside down" not in run(*words).err
    said = run(*words, "--settings", both_ways).err.splitlines()[-1]
    found = re.search(r"its score is ([\d.]+), that of the best guess upside down ([\d.]+)$", said)
    assert found is not None
    assert float(found[1]) > float(found[2])


def test_explain_says_what_is_wrong_with_the_number_of_the_scan(
    files: tuple[Path, Path], tmp_path: Path
) -> None:
    folder = tmp_path / "why"
    missing = run("explain", *files, "--scan", 99, "-o", folder)
    assert missing.code == 1
    assert "no scan 99" in missing.err.splitlines()[-1]
    assert run("explain", *files, "--scan", -1, "-o", folder).code == 2
    log = tmp_path / "blind.log"
    blind = LaserScan(np.full(180, np.inf), 0.0, 0.01)
    write_log(log, [Record(0, blind, Pose2D())])
    seen = run("explain", files[0], log, "--scan", 0, "-o", folder)
    assert seen.code == 1
    assert "no reading is a return" in seen.err.splitlines()[-1]
    assert not folder.exists()
