"""What changes in a world changes as it is told to, and what becomes of the answers is counted."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scans import scans

from anchorscan import AnchorscanError, LaserScan, Settings, random_building
from anchorscan import changed_world as module
from anchorscan.changed_world import CHANGES, Outcome, changed, pooled, run, table
from anchorscan.simulator import occlude

OFFICE = random_building(1)


class TestOccluded:
    @settings(max_examples=60)
    @given(scan=scans(), share=st.floats(0.0, 1.0), seed=st.integers(0, 99))
    def test_people_only_bring_readings_nearer(
        self, scan: LaserScan, share: float, seed: int
    ) -> None:
        crowded = occlude(scan, share, seed)
        assert len(crowded) == len(scan)
        differs = ~np.isclose(crowded.ranges, scan.ranges, rtol=0.0, atol=0.0, equal_nan=True)
        # Free beyond the limit counts as the limit; readings of people err by a centimetre.
        seen = np.where(scan.is_return, scan.ranges, scan.range_max)
        assert np.all(crowded.ranges[differs] <= seen[differs] + 0.06)
        assert not np.any(differs & ~scan.is_return & ~scan.is_free)
        assert crowded.ranges.tobytes() == occlude(scan, share, seed).ranges.tobytes()

    @pytest.mark.parametrize("share", [0.1, 0.3, 0.6])
    def test_so_many_readings_are_occluded_and_few_more(self, share: float) -> None:
        scan = LaserScan.from_field_of_view(np.full(181, 6.0), math.pi)
        for seed in range(20):
            hit = np.mean(occlude(scan, share, seed).ranges != scan.ranges)
            # A person at 0.82 m takes 31 degrees, a sixth of the view.
            assert share - 0.01 <= hit <= share + 0.18

    def test_nobody_is_nobody(self) -> None:
        scan = LaserScan.from_field_of_view(np.full(181, 6.0), math.pi)
        assert occlude(scan, 0.0, 1).ranges.tobytes() == scan.ranges.tobytes()


class TestChanged:
    @pytest.mark.parametrize("change", CHANGES)
    def test_nothing_changes_by_nothing(self, change: str) -> None:
        assert changed(OFFICE, change, 0.0).segments.tobytes() == OFFICE.segments.tobytes()

    @pytest.mark.parametrize(
        ("change", "of"), [("furniture", "furniture"), ("doors", "doors"), ("walls", "walls")]
    )
    def test_only_what_is_named_changes_by_its_share(self, change: str, of: str) -> None:
        world = changed(OFFICE, change, 0.3, seed=3)
        for kind in ("furniture", "doors", "walls"):
            before = {str(each) for each in getattr(OFFICE, kind)}
            kept = {str(each) for each in getattr(world, kind)} & before
            share = 1.0 - len(kept) / len(before)
            assert 0.1 < share < 0.5 if kind == of else share == 0.0

    def test_an_unknown_change_is_named(self) -> None:
        with pytest.raises(AnchorscanError, match="unknown change 'paint': there are people"):
            changed(OFFICE, "paint", 0.3)


def test_recorded_and_simulated_places_are_added_up_apart() -> None:
    found = [
        Outcome("people", "intel", 0.3, 10, 9, 8, 1),
        Outcome("people", "wean", 0.3, 10, 10, 9, 0),
        Outcome("people", "office 0", 0.3, 5, 5, 0, 0),
    ]
    assert pooled(found) == [
        Outcome("people", "pooled, recorded", 0.3, 20, 19, 17, 1),
        Outcome("people", "pooled, simulated", 0.3, 5, 5, 0, 0),
    ]
    assert table([*found[:1], *found[2:]])[2:] == [
        "| people | intel | 30 % | 10 | 0.900 | 8 | 1 | 1 | **88.9 %** |",
        "| people | office 0 | 30 % | 5 | 1.000 | 0 | 0 | 5 | - |",
    ]


def test_a_run_keeps_what_it_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "AMOUNTS", (0.0, 0.5))
    monkeypatch.setattr(module, "_DRIVEN", 40.0)
    said: list[str] = []
    found = run(
        [], Settings.preset(), 6, 1, 0, tmp_path, said.append, lambda items, what, total=None: items
    )
    assert {each.change for each in found} == set(CHANGES)
    same = [each for each in found if each.amount == 0.0 and each.place == "office 0"]
    assert len({(each.queries, each.top_1, each.correct, each.wrong) for each in same}) == 1
    assert same[0].correct > same[0].queries / 2
    with (tmp_path / "changed-world.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(found)
    kept = json.loads((tmp_path / "changed-world.json").read_text())
    assert kept["outcomes"][0]["change"] == found[0].change
    assert (tmp_path / "changed-world.png").stat().st_size > 0
