"""Many sets asked at once: one order, one decision, and odds that know how many were asked."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from as_a_user import run, write_log

from anchorscan import (
    Fleet,
    LaserScan,
    Pose2D,
    Record,
    ReferenceSet,
    ReferenceSetError,
    Settings,
    SettingsError,
    drive,
    random_building,
)
from anchorscan.description import describe
from anchorscan.fleet import decide_over, search
from anchorscan.fleet_benchmark import Asked, fitted, outcomes

SEEDS = (11, 12, 13)


@pytest.fixture(scope="module")
def drives() -> dict[str, list[Record]]:
    """Two drives through each of three buildings."""
    found = {}
    for seed in SEEDS:
        building = random_building(seed, length=24.0, depth=14.0)
        found[f"b{seed}"] = drive(building, seed=seed, length=25.0)
        found[f"later-b{seed}"] = drive(building, seed=seed, length=8.0)[:20]
    return found


@pytest.fixture(scope="module")
def sets(drives: dict[str, list[Record]]) -> dict[str, ReferenceSet]:
    return {f"b{seed}": ReferenceSet.build(drives[f"b{seed}"]) for seed in SEEDS}


def test_every_scan_finds_its_building_and_its_place(
    sets: dict[str, ReferenceSet], drives: dict[str, list[Record]]
) -> None:
    fleet = Fleet(sets)
    right = asked = 0
    for name in sets:
        for record in drives[f"later-{name}"]:
            assert record.scan is not None
            assert record.pose is not None
            best = fleet.locate(record.scan)[0]
            asked += 1
            near = best.hypothesis.pose is not None and best.hypothesis.pose.distance(record.pose)
            right += best.building == name and near < 0.5
    assert right >= 0.9 * asked


def test_a_fleet_of_one_set_answers_as_the_set(
    sets: dict[str, ReferenceSet], drives: dict[str, list[Record]]
) -> None:
    fleet = Fleet({"b11": sets["b11"]})
    for record in drives["later-b11"]:
        assert record.scan is not None
        alone, together = sets["b11"].locate(record.scan), fleet.locate(record.scan)
        assert [each.hypothesis.pose for each in together] == [each.pose for each in alone]
        assert together[0].hypothesis.probability == alone[0].probability
        for one, other in zip(together, alone, strict=True):
            assert one.hypothesis.accepted == other.accepted
            assert one.hypothesis.evaluation == other.evaluation
            assert one.hypothesis.reference == other.reference
            assert np.array_equal(one.hypothesis.covariance, other.covariance)


def test_neither_order_nor_parts_change_an_answer(
    sets: dict[str, ReferenceSet], drives: dict[str, list[Record]]
) -> None:
    fleet, backwards = Fleet(sets), Fleet(dict(reversed(sets.items())))
    for record in drives["later-b12"][:8]:
        scan = record.scan
        assert scan is not None
        description = describe(scan, fleet.settings)
        parts = [part for each in reversed(sets.items()) for part in search([each], description)]
        answers = [
            fleet.locate(scan),
            backwards.locate(scan),
        ]
        shown = [
            [(each.building, each.hypothesis.pose, each.hypothesis.probability) for each in answer]
            for answer in answers
        ]
        joined = decide_over(parts, len(sets), fleet.settings.decision)
        shown.append(
            [(each.building, Pose2D(*each.fit.poses[0]), each.probability) for each in joined]
        )
        assert all(each == shown[0] for each in shown)
        probabilities = [each.hypothesis.probability for each in answers[0]]
        assert sum(probabilities) <= 1.0 + 1e-9
        assert max(probabilities) == probabilities[0]


def test_a_twin_in_another_building_silences_the_answer(
    sets: dict[str, ReferenceSet], drives: dict[str, list[Record]]
) -> None:
    twin = ReferenceSet()
    moved = Pose2D(100.0, -50.0, 1.0)
    for reference in sets["b11"].references:
        assert reference.pose is not None
        twin.add(reference.scan, moved @ reference.pose)
    alone, doubled = Fleet({"b11": sets["b11"]}), Fleet({"b11": sets["b11"], "twin": twin})
    for record in drives["later-b11"]:
        assert record.scan is not None
        one, two = (each.hypothesis for each in doubled.locate(record.scan)[:2])
        assert not one.accepted
        assert one.probability >= two.probability
        assert one.probability < 0.96
        # Where one building would be enough for an answer, both are told.
        first, second = (each.building for each in doubled.locate(record.scan)[:2])
        if alone.locate(record.scan)[0].hypothesis.accepted and {first, second} == {"b11", "twin"}:
            assert one.ambiguous
            assert two.ambiguous
    assert alone.locate(record.scan)[0].hypothesis.accepted


def test_more_sets_never_raise_a_probability(
    sets: dict[str, ReferenceSet], drives: dict[str, list[Record]]
) -> None:
    for record in drives["later-b13"][:8]:
        assert record.scan is not None
        description = describe(record.scan, sets["b13"].settings)
        own = next(search([("b13", sets["b13"])], description))
        rest = list(search([(n, s) for n, s in sets.items() if n != "b13"], description))
        settings = sets["b13"].settings.decision
        chances = [
            decide_over(found, count, settings, look_alikes=0.25)[0].probability
            for found, count in (([own], 1), ([own, *rest], 3), ([own, *rest], 1000))
        ]
        best = decide_over([own, *rest], 3, settings)[0]
        if best.building == "b13":
            assert chances == sorted(chances, reverse=True)
        assert chances[1] >= chances[2]


def test_sets_that_cannot_be_compared_are_refused(sets: dict[str, ReferenceSet]) -> None:
    with pytest.raises(ReferenceSetError, match="needs a set"):
        Fleet({})
    other = ReferenceSet(settings=Settings.preset("thorough"))
    with pytest.raises(SettingsError, match="different settings"):
        Fleet({"b11": sets["b11"], "other": other})
    nowhere = ReferenceSet()
    nowhere.add(sets["b11"].references[0].scan)
    with pytest.raises(ReferenceSetError, match="without a pose"):
        Fleet({"nowhere": nowhere})
    with pytest.raises(SettingsError, match="map"):
        Fleet({"paper": ReferenceSet(settings=Settings.preset("paper"))})


def test_an_unusable_scan_and_empty_sets_have_no_answer(sets: dict[str, ReferenceSet]) -> None:
    blank = LaserScan(np.full(90, np.inf, np.float32), 0.0, 0.01)
    assert Fleet(sets).locate(blank) == []
    scan = sets["b11"].references[0].scan
    assert Fleet({"empty": ReferenceSet()}).locate(scan) == []


def test_which_names_the_building_of_every_scan(
    sets: dict[str, ReferenceSet], drives: dict[str, list[Record]], tmp_path: Path
) -> None:
    folder = tmp_path / "sets"
    folder.mkdir()
    for name, places in sets.items():
        places.save(folder / f"{name}.apr")
    log = write_log(tmp_path / "later.log", drives["later-b12"])
    done = run("which", folder, log, "--field-of-view", 180)
    assert done.code == 0, done.err
    lines = [json.loads(line) for line in done.out.splitlines()]
    assert [line["scan"] for line in lines] == list(range(len(drives["later-b12"])))
    located = [line["hypotheses"][0]["building"] for line in lines if line["accepted"]]
    assert located
    assert set(located) == {"b12"}
    unsure = sum(line["state"] == "ambiguous" for line in lines)
    assert f"{len(located)} in b12, {unsure} ambiguous" in done.err
    for words in ((log,), (tmp_path / "none", log), (tmp_path, log)):
        refused = run("which", *words)
        assert refused.code in (1, 2)
        assert "Traceback" not in refused.err


def test_the_measurement_counts_what_it_says(
    sets: dict[str, ReferenceSet], drives: dict[str, list[Record]]
) -> None:
    record = drives["later-b11"][0]
    assert record.scan is not None
    assert record.pose is not None
    asked = Asked("b11", record.scan, record.pose, False)
    description = describe(record.scan, sets["b11"].settings)
    found = [(n, next(search([(n, s)], description), None), 0.5) for n, s in sets.items()]
    settings = sets["b11"].settings.decision
    known, unknown = outcomes(asked, found, 2, settings)
    assert (known.is_known, known.is_right_building, known.is_correct) == (True, True, True)
    assert (unknown.is_known, unknown.is_right_building, unknown.is_correct) == (False,) * 3
    assert known.seconds > 1.0
    assert len(list(outcomes(asked, found, 3, settings))) == 1  # only two without its own
    # Where answers among many sets are always right, nothing speaks for lower odds.
    many = [replace(known, sets=1000)] * 5
    assert fitted(many, settings) == 0.0
    assert fitted([replace(each, is_correct=False) for each in many], settings) > 1.0
