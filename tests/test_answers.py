"""What locate, track and bench wrote is read back whole, and damage is named."""

from __future__ import annotations

import gzip
import json
import math
from pathlib import Path

import numpy as np
import pytest
from as_a_user import run, write_log
from hypothesis import given
from hypothesis import strategies as st

from anchorscan import LogError, Pose2D, drive, random_building
from anchorscan.answers import read_runs
from anchorscan.protocol import Answer
from anchorscan.scoreboard import Score, Scoreboard

LOCATED = {
    "scan": 17,
    "stamp": 12.3,
    "seconds": 0.0004,
    "accepted": True,
    "hypotheses": [
        {
            "reference": 4,
            "x": 1.0,
            "y": -3.0,
            "theta": 0.5,
            "covariance": [[1.0, 0.1, 0.0], [0.1, 2.0, 0.0], [0.0, 0.0, 0.3]],
            "evaluation": 0.87,
            "quality": 0.41,
            "probability": 0.997,
            "ambiguous": True,
        },
        {"reference": 5, "x": None, "y": None, "theta": None, "probability": 0.003},
    ],
}
UNUSABLE = {
    **{"scan": 18, "stamp": None, "seconds": 0.0, "accepted": False, "hypotheses": []},
    "reason": "no reading is a return",
}
TRACKED = {
    **{"scan": 3, "stamp": 1.5, "seconds": 0.001, "accepted": False},
    **{"x": 4.0, "y": 5.0, "theta": -1.0, "probability": 0.25, "covariance": np.eye(3).tolist()},
}


def lines(path: Path, *values: object) -> Path:
    path.write_text("".join(f"{json.dumps(value)}\n" for value in values), encoding="utf-8")
    return path


def test_a_line_of_locate_is_read_as_it_was_written(tmp_path: Path) -> None:
    (found,) = read_runs(lines(tmp_path / "office.jsonl", LOCATED, UNUSABLE))
    assert (found.kind, found.name, found.log, found.problems) == ("locate", "office", "", ())
    one, other = found.answers
    assert (one.scan, one.stamp, one.seconds, one.accepted) == (17, 12.3, 0.0004, True)
    first, second = one.guesses
    assert (first.reference, first.pose) == (4, Pose2D(1.0, -3.0, 0.5))
    assert (first.evaluation, first.quality, first.probability) == (0.87, 0.41, 0.997)
    assert first.covariance is not None
    assert first.covariance[1, 1] == 2.0
    assert (first.ambiguous, second.ambiguous) == (True, False)  # older lines do not say
    assert second.pose is None
    assert math.isnan(second.evaluation)
    assert (other.guesses, other.reason, other.stamp) == ((), "no reading is a return", None)


def test_a_line_of_track_is_one_guess(tmp_path: Path) -> None:
    lost = {**TRACKED, "scan": 4, "x": None, "y": None, "theta": None}
    (found,) = read_runs(lines(tmp_path / "t.jsonl", TRACKED, lost))
    assert found.kind == "track"
    assert found.answers[0].guesses[0].pose == Pose2D(4.0, 5.0, -1.0)
    assert found.answers[0].guesses[0].probability == 0.25
    assert found.answers[1].guesses == ()


def test_what_locate_writes_is_understood(tmp_path: Path) -> None:
    records = drive(random_building(3), seed=4, length=3.0, step=0.5)
    log = write_log(tmp_path / "drive.log", records)
    assert run("build", log, "-o", tmp_path / "drive.apr", "--all").code == 0
    plain, packed = tmp_path / "out.jsonl", tmp_path / "out.jsonl.gz"
    assert run("locate", tmp_path / "drive.apr", log, "-o", plain).code == 0
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    (found,), (same,) = read_runs(plain), read_runs(packed)
    assert [answer.scan for answer in found.answers] == [record.index for record in records]
    assert not found.problems
    written = [json.loads(line) for line in plain.read_text().splitlines()]
    for answer, again, line in zip(found.answers, same.answers, written, strict=True):
        assert [guess.pose for guess in answer.guesses] == [guess.pose for guess in again.guesses]
        assert [guess.score for guess in answer.guesses] == [h["score"] for h in line["hypotheses"]]
        assert answer.guesses[0].pose_in_reference is not None


def test_lines_that_are_no_answers_are_named_and_the_others_kept(tmp_path: Path) -> None:
    path = lines(tmp_path / "torn.jsonl", LOCATED)
    not_finite = json.dumps({**TRACKED, "x": float("inf")})
    with path.open("a") as stream:
        stream.write(f'\n[1, 2]\n{{"scan": 1}}\n{not_finite}\n{json.dumps(LOCATED)[:60]}')
    (found,) = read_runs(path)
    assert len(found.answers) == 1
    assert [line for line, _ in found.problems] == [3, 4, 5, 6]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "holds no line"),
        (b"\n\n", "holds no line"),
        (b"hello\n", "holds no line"),
        (b"\x1f\x8b broken", "cannot be read"),
        (b"\xff\xfe\x00", "cannot be read"),
    ],
)
def test_a_file_of_another_kind_is_refused_in_one_line(
    content: bytes, reason: str, tmp_path: Path
) -> None:
    path = tmp_path / "other"
    path.write_bytes(content)
    with pytest.raises(LogError, match=reason) as raised:
        read_runs(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_what_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no such file"):
        read_runs(tmp_path / "missing.jsonl")
    with pytest.raises(LogError, match=r"no answers\.csv"):
        read_runs(tmp_path)


@given(st.binary(max_size=200))
def test_no_file_makes_it_stumble(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any"
    path.write_bytes(data)
    try:
        runs = read_runs(path)
    except LogError:
        return
    assert any(found.answers for found in runs)


def test_the_answers_of_bench_are_those_it_had(tmp_path: Path) -> None:
    answers = (
        Answer(5, Pose2D(1.0, 2.0, 3.0), Pose2D(1.25, 2.0, 3.0), 0.75, True, 0.001),
        Answer(6, None, Pose2D(0.0, 0.0, 0.0), math.nan, False, 0.002),
    )
    unknown = (Answer(7, Pose2D(1.0, 1.0, 1.0), None, 0.5, False, 0.003),)
    scores = (
        Score("P3", "wean-2 -> wean-3", "default", 9, answers),
        Score("P3", "wean-2 -> wean-3", "karto", 9, answers, calibrated=False),
        Score("P4", "a -> b", "default", 9, unknown),
    )
    Scoreboard(scores, (), (), {}, {}).write(tmp_path)
    runs = read_runs(tmp_path)
    assert [found.name for found in runs] == [
        "P3 · wean-2 -> wean-3 · default",
        "P3 · wean-2 -> wean-3 · karto",
        "P4 · a -> b · default",
    ]
    assert [found.log for found in runs] == ["wean-3", "wean-3", "b"]
    first, second = runs[0].answers
    assert first.guesses[0].pose == answers[0].pose
    assert (first.truth, first.accepted, first.seconds) == (answers[0].truth, True, 0.001)
    assert (second.scan, second.guesses, second.truth) == (6, (), Pose2D())
    assert not runs[1].answers[0].accepted
    assert runs[2].answers[0].truth is None
    assert read_runs(tmp_path / "answers.csv")[0].name == runs[0].name
