"""The Rerun recording: what is shown is what was answered, and nothing is sent anywhere."""

from __future__ import annotations

import io
import json
import math
import os
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar
from unittest import mock

import numpy as np
import pytest
from as_a_user import run, write_log
from report_pages import answer, record, reference

from anchorscan import (
    AnchorscanError,
    MissingExtraError,
    Pose2D,
    Reference,
    Settings,
    drive,
    random_building,
)
from anchorscan.answers import Guess, ScanAnswer
from anchorscan.explanation import wall_points
from anchorscan.viewer import Viewer

os.environ.setdefault("CI", "1")  # Rerun sends nothing from tests, whatever they do
rerun = pytest.importorskip("rerun", reason="the viewer is in the extra 'view'")


class Recorder:
    """Stands in for Rerun's stream and keeps what is logged."""

    made: ClassVar[list[Recorder]] = []

    def __init__(self, name: str) -> None:
        self.logged: list[tuple[dict[str, Any], str, Any]] = []
        self.times: dict[str, Any] = {}
        self.is_open = True
        Recorder.made.append(self)

    def save(self, path: Path, default_blueprint: Any) -> None:
        self.path = path

    def spawn(self, default_blueprint: Any) -> None:
        self.environment = {"CI": os.environ.get("CI")}

    def set_time(self, name: str, **value: Any) -> None:
        self.times[name] = value

    def log(self, path: str, entity: Any, *, static: bool = False) -> None:
        self.logged.append(({} if static else dict(self.times), path, entity))

    def flush(self) -> None:
        pass

    def disconnect(self) -> None:
        self.is_open = False

    def last(self, path: str) -> Any:
        return [entity for _, name, entity in self.logged if name == path][-1]


def values(batch: Any) -> np.ndarray[Any, Any]:
    return np.array(batch.as_arrow_array().to_pylist())


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Recorder]:
    monkeypatch.setattr(rerun, "RecordingStream", Recorder)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Rerun warns and shows nothing where it cannot convert
        yield Recorder("unused")


def viewer(references: list[Reference], path: Path) -> tuple[Viewer, Recorder]:
    made = Viewer(references, Settings.preset(), path / "out.rrd")
    return made, Recorder.made[-1]


def test_the_map_is_the_readings_of_the_references(recorder: Recorder, tmp_path: Path) -> None:
    references = [reference(1), reference(2, 8.0)]
    _, stream = viewer(references, tmp_path)
    walls = values(stream.last("world/walls").positions)
    np.testing.assert_allclose(walls[:, :2], wall_points(references), atol=1e-5)
    assert (walls[:, 2] == 0.0).all()
    np.testing.assert_allclose(
        values(stream.last("world/references").origins)[:, :2], [[0.0, 0.0], [8.0, 0.0]]
    )


def test_the_scan_lies_where_the_best_guess_says(recorder: Recorder, tmp_path: Path) -> None:
    made, stream = viewer([reference(1)], tmp_path)
    seen = record(7, 0.2)
    pose = Pose2D(1.0, -2.0, 0.5)
    said = ScanAnswer(7, True, (Guess(pose, 0.9, 1, None, np.diag([0.01, 0.04, 0.001])),), 3.5, 0.2)
    made.show(seen, said)
    assert seen.scan is not None
    points = values(stream.last("world/scan").positions)
    np.testing.assert_allclose(points[:, :2], pose.apply(seen.scan.points), atol=1e-5)
    arrow = stream.last("world/hypotheses")
    vector = values(arrow.vectors)[0]
    assert math.atan2(vector[1], vector[0]) == pytest.approx(0.5, abs=1e-6)
    outline = np.array(values(stream.last("world/hypotheses/covariance").strips)[0])
    # Two standard deviations: 0.2 m along x, 0.4 m along y.
    np.testing.assert_allclose(np.ptp(outline[:, :2], axis=0), [0.4, 0.8], rtol=0.01)
    assert len(values(stream.last("world/scan/anchors").positions)) > 0


def test_everything_is_on_the_clock_of_the_recording_and_on_the_number_of_the_scan(
    recorder: Recorder, tmp_path: Path
) -> None:
    made, stream = viewer([reference(1)], tmp_path)
    made.show(record(7), answer(7))
    timed = [times for times, path, _ in stream.logged if path == "world/scan"]
    assert timed == [{"scan": {"sequence": 7}}]  # this record has no stamp
    from dataclasses import replace

    made.show(replace(record(8), stamp=12.25), answer(8))
    assert stream.logged[-1][0] == {"scan": {"sequence": 8}, "recording": {"duration": 12.25}}


def test_the_belief_is_the_probability_and_what_is_left(recorder: Recorder, tmp_path: Path) -> None:
    made, stream = viewer([reference(1)], tmp_path)
    made.show(record(0), answer(0, probability=0.7, more=(Guess(Pose2D(5.0), 0.2, 1),)))
    assert values(stream.last("belief/probability").scalars).tolist() == [0.7]
    assert values(stream.last("belief/elsewhere").scalars)[0] == pytest.approx(0.1)
    assert values(stream.last("time/milliseconds").scalars).tolist() == [1.0]
    faint, strong = sorted(values(stream.last("world/hypotheses").colors) & 0xFF)
    assert faint < strong


def test_a_scan_without_an_answer_wipes_what_was_shown(recorder: Recorder, tmp_path: Path) -> None:
    made, stream = viewer([reference(1)], tmp_path)
    made.show(record(0), answer(0))
    made.show(record(1), ScanAnswer(1, False, (), None, 0.1, "no reading is a return"))
    for path in ("world/scan", "world/hypotheses"):
        assert isinstance(stream.last(path), rerun.Clear)
    words = stream.last("words")
    assert "no reading is a return" in str(values(words.text))
    assert values(stream.last("belief/probability").scalars).tolist() == [0.0]


def test_the_trail_has_only_accepted_answers(recorder: Recorder, tmp_path: Path) -> None:
    made, stream = viewer([reference(1)], tmp_path)
    made.show(record(0, 1.0), answer(0, 1.0))
    made.show(record(1, 2.0), answer(1, 9.0, accepted=False))
    made.show(record(2, 3.0), answer(2, 3.0))
    assert values(stream.last("world/trail/answer").positions)[:, 0].tolist() == [1.0, 3.0]
    assert values(stream.last("world/trail/log").positions)[:, 0].tolist() == [1.0, 2.0, 3.0]


def test_a_set_without_poses_is_told_in_words(recorder: Recorder, tmp_path: Path) -> None:
    made, stream = viewer([Reference(3, reference(3).scan)], tmp_path)
    guess = Guess(None, 0.95, 3, Pose2D(0.1, 0.0, 0.0))
    made.show(record(0), ScanAnswer(0, True, (guess,)))
    assert "near reference 3" in str(values(stream.last("words").text))
    assert isinstance(stream.last("world/scan"), rerun.Clear)


def test_it_lets_go_of_the_file(recorder: Recorder, tmp_path: Path) -> None:
    made, stream = viewer([reference(1)], tmp_path)
    with made:
        assert stream.is_open
    assert not stream.is_open


def test_without_rerun_one_is_told_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'anchorscan\[view\]'"):
        Viewer([reference(1)], Settings.preset(), tmp_path / "out.rrd")


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(AnchorscanError, match="no such folder"):
        Viewer([reference(1)], Settings.preset(), tmp_path / "no" / "out.rrd")


def test_the_window_is_opened_without_usage_statistics(
    recorder: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CI")
    made = Viewer([reference(1)], Settings.preset())
    assert Recorder.made[-1].environment == {"CI": "1"}
    assert "CI" not in os.environ
    made.close()


def test_loading_rerun_leaves_nothing_at_home(tmp_path: Path) -> None:
    code = (
        "import os\nfrom anchorscan.viewer import _load\n_load()\nassert 'CI' not in os.environ\n"
    )
    clean = {name: value for name, value in os.environ.items() if name != "CI"}
    subprocess.run([sys.executable, "-c", code], check=True, env={**clean, "HOME": str(tmp_path)})
    assert not list(tmp_path.rglob("*rerun*"))


def test_view_as_a_user_runs_it(tmp_path: Path) -> None:
    records = drive(random_building(3), seed=4, length=4.0, step=0.5)
    log, places = write_log(tmp_path / "a.log", records), tmp_path / "a.apr"
    assert run("build", log, "-o", places, "--all").code == 0
    saved = tmp_path / "now.rrd"
    done = run("view", places, log, "-o", saved)
    assert (done.code, done.out) == (0, "")
    assert f"{len(records)} scans shown in {saved}" in done.err.splitlines()[-1]
    assert "Warning" not in done.err
    answers, again = tmp_path / "a.jsonl", tmp_path / "later.rrd"
    assert run("locate", places, log, "-o", answers).code == 0
    assert run("view", places, log, "--run", answers, "-o", again).code == 0
    entities = ["/world/walls", "/world/scan", "/world/hypotheses", "/words"]
    for path in (saved, again):
        printed = subprocess.run(
            [Path(sys.executable).with_name("rerun"), "rrd", "print", "-v", path],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "CI": "1"},
        ).stdout
        assert all(f"- {entity} -" in printed for entity in entities)


def test_answers_are_shown_as_they_come(recorder: Recorder, tmp_path: Path) -> None:
    """Only some scans have an answer; the others are passed over."""
    records = drive(random_building(3), seed=4, length=2.0, step=0.5)
    log, places = write_log(tmp_path / "a.log", records), tmp_path / "a.apr"
    assert run("build", log, "-o", places, "--all").code == 0
    tracked = [
        {
            **{"scan": n, "stamp": 0.0, "seconds": 0.1, "accepted": True, "probability": 0.5},
            **{"x": 1.0, "y": 2.0, "theta": 0.0, "covariance": np.eye(3).tolist()},
        }
        for n in (1, 3)
    ]
    lines = "".join(f"{json.dumps(each)}\n" for each in tracked)
    with mock.patch.object(sys, "stdin", io.StringIO(lines)):
        done = run("view", places, log, "--run", "-", "-o", tmp_path / "live.rrd")
    assert done.code == 0
    assert "2 scans shown" in done.err
    stream = Recorder.made[-1]
    assert [times["scan"]["sequence"] for times, path, _ in stream.logged if path == "words"] == [
        1,
        3,
    ]
    with mock.patch.object(sys, "stdin", io.StringIO("hello\n")):
        torn = run("view", places, log, "--run", "-", "-o", tmp_path / "live.rrd")
    assert torn.code == 1
    assert "<stdin>:1" in torn.err.splitlines()[-1]
