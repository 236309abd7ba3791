"""The report of a run: what it holds is true, nothing in it is markup, and it stays small."""

from __future__ import annotations

import base64
import hashlib
import math
import re
from pathlib import Path

import numpy as np
import pytest
from as_a_user import run, write_log
from hypothesis import given
from hypothesis import strategies as st
from report_pages import (
    NASTY,
    answer,
    data,
    data_of,
    decoded,
    located,
    of,
    parsed,
    record,
    reference,
    square_scan,
)

from anchorscan import AnchorscanError, LaserScan, Pose2D, Record, Reference, drive, random_building
from anchorscan.answers import Guess, Run, ScanAnswer
from anchorscan.explanation import wall_points
from anchorscan.protocol import Answer, figures, precision_recall
from anchorscan.report import page, write_report


def test_the_page_loads_nothing_and_its_policy_lets_only_its_own_script_run() -> None:
    text = page([located(answer(0))], [reference(1)], of(record(0)))
    found = parsed(text)
    for tag, attributes in found.elements:
        assert tag not in {"link", "iframe", "img", "object", "embed", "base", "form"}
        assert not {"src", "href", "srcset"} & set(attributes)
        assert not [name for name in attributes if name.startswith("on")]
    addresses = set(re.findall(r"https?://[\w./]+", text))
    assert addresses == {"http://www.w3.org/2000/svg"}  # a name, not an address that is loaded
    assert not re.search(r"@import|url\(|fetch\(|XMLHttp|innerHTML|insertAdjacent|eval\(", text)
    (policy,) = [a["content"] for t, a in found.elements if t == "meta" and "http-equiv" in a]
    assert policy is not None
    assert "default-src 'none'" in policy
    digest = base64.b64encode(hashlib.sha256(found.raw["script"][1].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy


def test_hostile_names_stay_text() -> None:
    nasty = Run("locate", NASTY, (ScanAnswer(0, False, (), None, 0.1, NASTY),))
    text = page([nasty], [], None, title=NASTY, notes=[NASTY])
    plain = page([located(answer(0))])
    tags = [tag for tag, _ in parsed(text).elements]
    assert tags == [tag for tag, _ in parsed(plain).elements]
    found = data_of(text)
    assert found["notes"] == [NASTY]
    assert found["runs"][0]["name"] == NASTY
    assert found["runs"][0]["queries"][0]["reason"] == NASTY
    assert parsed(text).raw["title"] == [NASTY]
    assert "\u2028" not in text.split('id="data"')[1]


@given(st.text(max_size=30))
def test_any_text_comes_out_as_it_went_in(text: str) -> None:
    found = data([Run("locate", text, (ScanAnswer(0, False, (), None, 0.1, text or "none"),))])
    assert found["runs"][0]["name"] == text
    assert found["runs"][0]["queries"][0]["reason"] == (text or "none")


def test_a_placeholder_in_a_name_is_not_filled_in() -> None:
    text = page([located(answer(0))], title="@SCRIPT@ @DATA@")
    assert "".join(parsed(text).raw["title"]) == "@SCRIPT@ @DATA@"


def test_right_and_wrong_are_those_of_the_protocols() -> None:
    answers = [
        answer(0, 0.1, 0.99),  # right
        answer(1, 9.0, 0.95),  # wrong
        answer(2, 0.2, 0.4, accepted=False),  # silent, though right
        answer(3, 0.49, 0.97),  # right, just so
        ScanAnswer(4, False, (), 4.0, 0.001, "no reading is a return"),
    ]
    found = data([located(*answers)], [reference(1)], of(*(record(n) for n in range(5))))
    (shown,) = found["runs"]
    right = {query["scan"]: query["right"] for query in shown["queries"]}
    assert right == {0: True, 1: False, 2: True, 3: True, 4: None}
    rows = dict(shown["figures"])
    assert (rows["queries judged"], rows["located, right"]) == ("4", "2")
    assert (rows["located, wrong"], rows["not known"]) == ("1", "1")
    assert rows["best guess right"] == "75.0 %"
    assert shown["judged"]["right"] == [1, 0, 1, 1]
    assert shown["judged"]["accepted"] == [1, 1, 0, 1]
    (off,) = [q["hypotheses"][0]["off"] for q in shown["queries"] if q["scan"] == 1]
    assert off == [9.0, 0.0]


def test_the_curve_and_the_reliability_are_those_of_the_protocols() -> None:
    rng = np.random.default_rng(0)
    probability = np.round(rng.random(300), 3)
    right = rng.random(300) < probability
    answers = [
        answer(n, 0.0 if good else 5.0, p, accepted=p > 0.9)
        for n, (p, good) in enumerate(zip(probability.tolist(), right.tolist(), strict=True))
    ]
    (shown,) = data([located(*answers)], [], of(*(record(n) for n in range(300))))["runs"]
    thresholds, precision, recall = precision_recall(probability, right)
    for share, sure, threshold in shown["curve"]:
        n = np.flatnonzero(thresholds == threshold)[0]
        assert share == pytest.approx(recall[n], abs=1e-4)
        assert sure == pytest.approx(precision[n], abs=1e-4)
    assert shown["curve"][0][2] == thresholds[0]
    assert shown["curve"][-1][0] == pytest.approx(right.mean(), abs=1e-4)
    judged = [
        Answer(n, Pose2D(0.0 if good else 5.0), Pose2D(), p, p > 0.9, 0.001)
        for n, (p, good) in enumerate(zip(probability.tolist(), right.tolist(), strict=True))
    ]
    assert shown["reliability"]["error"] == pytest.approx(
        figures(judged).calibration_error, abs=1e-4
    )
    assert sum(shown["reliability"]["counts"]) == 300
    assert sum(shown["times"]["counts"]) == 300


def test_scans_that_are_references_are_not_judged() -> None:
    mine = record(0, half=2.0)  # the very readings of the reference
    found = data([located(answer(0, 50.0), answer(1))], [reference(1)], of(mine, record(1)))
    (shown,) = found["runs"]
    assert {q["scan"]: q["isReference"] for q in shown["queries"]} == {0: True, 1: False}
    assert dict(shown["figures"])["queries judged"] == "1"
    assert any("1 of 2 scans are references" in note for note in shown["notes"])


def test_without_poses_nothing_is_called_right_or_wrong() -> None:
    for log in (None, of(record(0, posed=False))):
        (shown,) = data([located(answer(0))], [reference(1)], log)["runs"]
        assert shown["queries"][0]["right"] is None
        assert shown["curve"] is None
        assert shown["reliability"] is None
        assert dict(shown["figures"])["located"] == "1"
        assert any("Nothing tells right from wrong" in note for note in shown["notes"])


def test_in_an_unknown_place_every_answer_of_a_benchmark_is_wrong() -> None:
    strange = Run("bench", "P4", (answer(0, 0.0), answer(1, accepted=False)), "b")
    (shown,) = data([strange])["runs"]
    rows = dict(shown["figures"])
    assert (rows["located, wrong"], rows["not known"], rows["located, right"]) == ("1", "1", "0")


def test_queries_far_from_all_references_are_counted() -> None:
    logs = of(record(0, 1.5), record(1, 30.0))
    (shown,) = data([located(answer(0), answer(1))], [reference(1)], logs)["runs"]
    assert any(note.startswith("1 scans were taken where no reference") for note in shown["notes"])


def test_the_worst_come_first() -> None:
    right = Guess(Pose2D(), 0.1)
    answers = [
        answer(0, 0.3, 0.99),
        answer(1, 9.0, 0.5, accepted=False),
        answer(2, 9.0, 0.93),
        answer(3, 0.0, 0.6, accepted=False),
        answer(4, 9.0, 0.99, more=(right,)),
        ScanAnswer(5, False, (), None, 0.0, "no reading is a return"),
        answer(6, 0.01, 0.91),
        answer(7, 9.0, 0.6, accepted=False),
    ]
    found = data([located(*answers)], [], of(*(record(n) for n in range(8))))
    order = [query["scan"] for query in found["runs"][0]["queries"]]
    assert order == [4, 2, 7, 1, 5, 3, 0, 6]


def test_of_too_many_queries_the_worst_are_kept_and_the_figures_are_of_all() -> None:
    wrong = {13, 57, 91}
    answers = [answer(n, 9.0 if n in wrong else 0.0) for n in range(100)]
    logs = of(*(record(n) for n in range(100)))
    found = data([located(*answers)], [], logs, most=12)
    (shown,) = found["runs"]
    scans = [query["scan"] for query in shown["queries"]]
    assert len(scans) == len(set(scans)) == 12
    assert wrong == set(scans[:3])
    assert dict(shown["figures"])["queries judged"] == "100"
    assert len(shown["judged"]["p"]) == 100
    assert len(found["scans"]) == 12
    assert any("12 of 100 queries" in note for note in shown["notes"])


def test_readings_are_kept_to_the_centimetre_and_what_is_no_return_is_none() -> None:
    ranges = np.array([1.0, 2.345, np.inf, np.nan, 0.2, 79.99, 700.0, 5.0])
    scan = LaserScan(ranges, 0.3, -0.1, 0.25, 680.0)
    found = data([located(answer(0))], [], of(Record(0, scan, Pose2D())))
    sensor, text = found["scans"][0]
    kept = decoded(text) / 100.0
    np.testing.assert_allclose(kept, [1.0, 2.345, 0, 0, 0, 79.99, 0, 5.0], atol=0.00501)
    assert found["sensors"][sensor] == [0.3, -0.1]


def test_thinned_readings_keep_their_directions() -> None:
    scan = square_scan(2.0, 1801)
    found = data([located(answer(0))], [], of(Record(0, scan, Pose2D())))
    (first, step), kept = found["sensors"][0], decoded(found["scans"][0][1]) / 100.0
    assert len(kept) <= 360
    angles = first + step * np.arange(len(kept))
    expected = np.interp(angles, scan.angles, scan.ranges)
    np.testing.assert_allclose(kept, expected, atol=0.006)


def test_the_map_is_where_the_readings_of_the_references_end() -> None:
    references = [reference(1), reference(2, 7.5, 1.0), Reference(3, square_scan())]
    found = data([located(answer(0))], references)
    (place,) = found["maps"]
    cells = decoded(place["cells"]).reshape(-1, 2)
    drawn = (cells + 0.5) * place["cell"] + (place["x"], place["y"])
    expected = wall_points(references, place["cell"])
    assert len(drawn) == len(expected)
    for point in expected[::17]:
        assert np.abs(drawn - point).max(axis=1).min() < 0.001
    assert place["references"] == [[0.0, 0.0, 0.0], [7.5, 0.0, 0.0]]


def test_a_set_without_poses_has_no_map_but_its_scans() -> None:
    guess = Guess(None, 0.9, reference=1, pose_in_reference=Pose2D(0.5, 0.0, 0.1))
    said = ScanAnswer(0, True, (guess,))
    found = data([located(said)], [Reference(1, square_scan())], of(record(0)))
    (shown,) = found["runs"]
    assert found["maps"] == []
    assert shown["map"] is None
    assert shown["queries"][0]["hypotheses"][0]["inner"] == [0.5, 0.0, 0.1]
    assert shown["queries"][0]["right"] is None
    number, pose = shown["referenceScans"]["1"]
    assert pose is None
    assert decoded(found["scans"][number][1]).any()


def test_a_log_belongs_to_the_runs_that_name_it() -> None:
    runs = [Run("bench", "one", (answer(0),), "a"), Run("bench", "two", (answer(0),), "b")]
    found = data(runs, [], {"b": lambda: iter([record(0)])})
    first, second = found["runs"]
    assert first["queries"][0]["points"] is None
    assert second["queries"][0]["points"] == 0


def test_a_thousand_queries_stay_below_ten_megabytes() -> None:
    rng = np.random.default_rng(0)
    angles = np.linspace(-math.pi, math.pi, 1081)
    scans = [
        LaserScan(rng.uniform(0.5, 60.0, 1081), -math.pi, angles[1] - angles[0]) for _ in range(50)
    ]
    references = [
        Reference(n, scans[n % 50], Pose2D(*rng.uniform(-100.0, 100.0, 2), 0.3)) for n in range(700)
    ]
    guesses = [
        Guess(
            Pose2D(*rng.uniform(-100.0, 100.0, 3)),
            rng.random(),
            int(rng.integers(700)),
            None,
            np.diag(rng.random(3)),
            *rng.random(3),
        )
        for _ in range(5000)
    ]
    answers = [
        ScanAnswer(n, True, tuple(guesses[5 * n : 5 * n + 5]), 0.1 * n, rng.random())
        for n in range(1000)
    ]
    records = [
        Record(n, scans[n % 50], Pose2D(*rng.uniform(-100.0, 100.0, 3))) for n in range(1000)
    ]
    text = page([located(*answers)], references, of(*records))
    assert len(data_of(text)["runs"][0]["queries"]) == 1000
    assert len(text.encode()) < 10_000_000


def test_nothing_to_report_is_said(tmp_path: Path) -> None:
    with pytest.raises(AnchorscanError, match="no answer"):
        write_report(tmp_path / "r.html", [located()])
    assert not list(tmp_path.iterdir())


def test_report_as_a_user_runs_it(tmp_path: Path) -> None:
    records = drive(random_building(3), seed=4, length=8.0, step=0.5)
    first, second = records[::2], records[1::2]
    known, asked = write_log(tmp_path / "a.log", first), write_log(tmp_path / "b.log", second)
    places, answers, html = (tmp_path / name for name in ("a.apr", "b.jsonl", "b.html"))
    assert run("build", known, "-o", places, "--all").code == 0
    assert run("locate", places, asked, "-o", answers).code == 0
    done = run("report", answers, "--set", places, "--log", asked, "-o", html)
    assert (done.code, done.out) == (0, "")
    assert done.err.splitlines()[-1].startswith(f"{html}: {len(second)} answers, ")
    found = data_of(html.read_text(encoding="utf-8"))
    (shown,) = found["runs"]
    assert len(found["maps"][0]["references"]) == len(first)
    assert sorted(query["scan"] for query in shown["queries"]) == list(range(len(second)))
    assert all(query["points"] is not None for query in shown["queries"])
    assert dict(shown["figures"])["queries judged"] == str(len(second))
    assert run("report", answers, "-o", tmp_path / "plain.html").code == 0


def test_report_says_what_is_wrong(tmp_path: Path) -> None:
    missing = run("report", tmp_path / "none.jsonl", "-o", tmp_path / "r.html")
    assert (missing.code, len(missing.err.splitlines())) == (1, 1)
    other = tmp_path / "other.txt"
    other.write_text("hello\n")
    refused = run("report", other, "-o", tmp_path / "r.html")
    assert refused.code == 1
    assert "holds no line" in refused.err
    good = tmp_path / "one.jsonl"
    good.write_text('{"scan": 0, "accepted": false, "hypotheses": [], "reason": "none"}\n')
    unwritable = run("report", good, "-o", tmp_path / "no" / "such" / "r.html")
    assert unwritable.code == 1
    assert unwritable.err.startswith("error: ")
    assert not (tmp_path / "r.html").exists()
