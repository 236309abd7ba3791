"""Every change changes something, and the table tells what became of the queries."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchorscan import Pose2D, Reference, SensorModel, Settings, random_building, simulate
from anchorscan.ablation import CHANGES, Change, Outcome, attempt, changes_named, header, row, run
from anchorscan.cli import main
from anchorscan.errors import AnchorscanError
from anchorscan.simulator import random_poses

DEFAULT = Settings.preset("default")


class Simulated:
    protocol = "P1"
    looks_alike = False

    def __init__(self):
        rng = np.random.default_rng(7)
        world = random_building(3)
        sensor = SensorModel(field_of_view=math.radians(270.0))
        places = random_poses(world, 10, rng)
        self.references = [
            Reference(k, simulate(world, place, sensor, rng), place)
            for k, place in enumerate(places)
        ]
        near = [place @ Pose2D(0.2, 0.1, 0.2) for place in places]
        self.queries = [(simulate(world, place, sensor, rng), place) for place in near]


@pytest.fixture(scope="module")
def case():
    return Simulated()


def leaves(values, path=()):
    for name, value in values.items():
        if isinstance(value, dict):
            yield from leaves(value, (*path, name))
        else:
            yield (*path, name), value


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.name)
def test_every_change_changes_its_settings_of_the_default_preset_and_no_others(change):
    before = dict(leaves(DEFAULT.model_dump()))
    after = dict(leaves(DEFAULT.changed(change.values).model_dump()))
    named = dict(leaves({name: dict(section) for name, section in change.values.items()}))
    differ = {path for path in before if before[path] != after[path]}
    assert differ
    assert differ <= set(named)
    if len(named) < 5:  # all but the one that takes a whole section's defaults
        assert differ == set(named)


def test_no_two_changes_are_the_same():
    assert len({change.name for change in CHANGES}) == len(CHANGES)
    settings = [DEFAULT.changed(change.values) for change in CHANGES]
    assert all(one not in settings[:k] for k, one in enumerate(settings))


def test_changes_are_found_by_name():
    assert changes_named([]) == CHANGES
    assert [each.name for each in changes_named(["4 fits", "no refinement"])] == [
        "4 fits",
        "no refinement",
    ]
    with pytest.raises(AnchorscanError, match=r"unknown change '5 fits'.*4 fits"):
        changes_named(["5 fits"])


def test_a_change_that_changes_nothing_is_an_error(case):
    idle = Change("idle", {"verification": {"fits": DEFAULT.verification.fits}}, "Nothing.")
    with pytest.raises(AnchorscanError, match="'idle' changes nothing"):
        run([case], DEFAULT, 1, lambda line: None, [idle])


def test_without_queries_there_is_no_table():
    with pytest.raises(AnchorscanError, match="no split has a query"):
        run([], DEFAULT, 1, lambda line: None, CHANGES[:1])


def test_the_queries_of_a_case_are_asked_and_judged_by_the_truth(case):
    usual = attempt([case], DEFAULT, 100)
    assert len(usual.right) == len(case.queries)
    assert usual.right.mean() > 0.7
    assert np.all(usual.among | ~usual.right)
    assert np.all(usual.seconds > 0.0)
    far = Simulated()
    far.queries = [(scan, pose @ Pose2D(3.0, 0.0, 0.0)) for scan, pose in case.queries]
    wrong = attempt([far], DEFAULT, 100)
    assert wrong.right.mean() < 0.2
    np.testing.assert_array_equal(wrong.probability, usual.probability)


def test_at_most_so_many_queries_are_asked(case):
    assert len(attempt([case, case], DEFAULT, 3).right) == 6


def test_the_table_of_a_simulated_building(case):
    said: list[str] = []
    chosen = changes_named(["no refinement", "edges not oriented", "1 candidate"])
    outcomes = run([case], DEFAULT, 100, said.append, chosen)
    assert [line.split(" | ")[0] for line in said[:6]] == [
        "| change",
        "| ---",
        "| no change",
        "| no refinement",
        "| edges not oriented",
        "| 1 candidate",
    ]
    assert len({line.count("|") for line in said[:6]}) == 1
    assert said[2].endswith(" | 1.00 |")
    assert said[-3:] == [f"- {change.name}: {change.reason}" for change in chosen]
    # One reference that may propose cannot propose more than all do.
    usual, still, directionless, single = outcomes
    np.testing.assert_array_equal(still.proposals, usual.proposals)
    assert directionless.proposals.mean() > usual.proposals.mean()
    assert single.proposals.mean() < usual.proposals.mean()
    assert single.among.sum() <= usual.among.sum()
    assert not np.array_equal(single.probability, usual.probability)


def test_a_row_pools_each_kind_of_split_by_itself():
    groups = np.array([0, 0, 0, 0, 2, 2])
    right = np.array([True, True, True, False, False, True])
    among = np.array([True, True, True, True, False, True])
    probability = np.array([0.9, 0.8, 0.3, 0.5, 0.9, 0.1])
    proposals = np.array([10, 20, 30, 40, 0, 20])
    usual = Outcome(groups, right, among, probability, proposals, np.full(6, 0.002))
    slow = Outcome(groups, right, among, probability, proposals, np.full(6, 0.005))
    figures = ["0.750", "1.000", "0.500", "-", "-", "-", "0.500", "0.500", "0.000"]
    assert row("slow", slow, usual) == f"| slow | {' | '.join(figures)} | 20 | 2.50 |"
    assert header()[0].count("|") == row("slow", slow, usual).count("|")


def test_look_alikes_and_sparse_references_are_told_apart(case):
    sparse, alike = Simulated(), Simulated()
    sparse.protocol, alike.looks_alike = "P2", True
    assert attempt([case, sparse, alike], DEFAULT, 1).groups.tolist() == [0, 1, 2]


def test_an_unknown_change_ends_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["anchorscan", "ablate", "--change", "nothing"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code
    said = capsys.readouterr()
    assert "unknown change 'nothing'" in said.err
    assert "Traceback" not in said.err
