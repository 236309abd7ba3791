"""The growth of the search for candidates: what it is measured against must be what it says."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anchorscan.anchors import AnchorPoints
from anchorscan.growth import RANKS, Place, Scene, distractors, measure, slope
from anchorscan.protocol import revisit
from anchorscan.reference import Reference
from anchorscan.settings import Settings
from anchorscan.simulator import drive, random_building


def scene(seed, building=""):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(3, 12))
    anchors = AnchorPoints(
        rng.uniform(-9.0, 9.0, (count, 2)), rng.integers(0, 5, count), rng.uniform(-3, 3, count), 0
    )
    return Scene(building, anchors, rng.uniform(-9.0, 9.0, (40, 2)))


POOL = [scene(k, "office" if k % 3 else "") for k in range(12)]


def rows(made):
    return [
        (base, *(each.tobytes() for each in (*astuple(scene.anchors)[:3], scene.points)))
        for base, scene in made
    ]


@given(st.integers(0, 99))
def test_the_first_distractors_are_the_same_whatever_their_number(seed):
    few, many = rows(distractors(POOL, 7, seed)), rows(distractors(POOL, 40, seed))
    assert many[:7] == few
    assert rows(distractors(POOL, 7, seed + 1)) != few
    assert len(set(many)) == 40


def test_half_of_the_distractors_are_from_real_scans_and_none_is_its_base():
    made = list(distractors(POOL, 400, 3))
    assert sum(bool(POOL[base].building) for base, _ in made) == 200
    for base, scene in made:
        before, anchors = POOL[base].anchors, scene.anchors
        assert len(scene.points) == len(POOL[base].points)
        assert np.isin(anchors.kinds, [0, 1, 2, 3, 4]).all()
        # Some relation of the base is longer or shorter than noise makes it, or gone.
        spans = np.ptp(before.positions, axis=0) if len(before) else np.zeros(2)
        same = len(anchors) == len(before) and np.allclose(
            np.ptp(anchors.positions, axis=0), spans, rtol=0.01, atol=0.0
        )
        assert not same


@given(st.floats(-0.5, 2.0), st.floats(0.01, 100.0))
def test_the_slope_of_a_power_is_its_exponent(power, factor):
    counts = [100, 1_000, 30_000]
    assert slope(counts, [factor * n**power for n in counts]) == pytest.approx(power, abs=1e-6)
    assert math.isnan(slope([5], [1.0]))


@pytest.fixture(scope="module")
def growth():
    records = drive(random_building(5), seed=5, length=250.0, step=0.5)
    split = revisit(records)
    place = Place(
        "P1 office",
        "office",
        tuple(
            Reference(k, records[n].scan, records[n].pose) for k, n in enumerate(split.references)
        ),
        tuple((records[n].scan, records[n].pose) for n in split.queries),
        tuple(record.scan for record in records[::10]),
    )
    settings = Settings.preset()
    return measure([place], settings, sizes=(300,), queries=25, seed=1, buildings=2)


def test_a_place_is_found_alone_and_among_distractors(growth):
    alone, among = growth.sizes
    assert (alone.distractors, among.distractors) == (0, 300)
    assert alone.edges == 0 < among.edges
    for size in growth.sizes:
        hits = [size.hits[rank] for rank in RANKS]
        assert hits == sorted(hits)
        assert hits == [size.places["P1 office"][rank] for rank in RANKS]
        assert size.located[100] >= 0.9
    # What distractors take can only be rank.
    assert among.hits[100] <= alone.hits[100]
    assert alone.hits[100] >= 0.95
    assert among.hits[20] >= 0.8


def test_what_was_measured_is_written(growth, tmp_path):
    files = growth.write(tmp_path / "new")
    kept = json.loads(files[0].read_text())
    assert [size["distractors"] for size in kept["sizes"]] == [0, 300]
    assert kept["slope"] == pytest.approx(growth.slope)
    with files[1].open(newline="") as stream:
        table = list(csv.DictReader(stream))
    assert [float(row["hits_5"]) for row in table] == [s.hits[5] for s in growth.sizes]
    assert any(f"{growth.slope:.2f}" in line for line in growth.lines())
    pytest.importorskip("matplotlib")
    growth.draw(tmp_path / "growth.png")
    assert (tmp_path / "growth.png").read_bytes().startswith(b"\x89PNG")
