"""The clock of the stages: what it counts, and that it leaves nothing behind."""

from __future__ import annotations

import math
import sys
import time

import numpy as np

from anchorscan import anchors, description, matcher, verification
from anchorscan.database import RelationshipDatabase
from anchorscan.matcher import Matcher
from anchorscan.pose import Pose2D
from anchorscan.reference import Reference
from anchorscan.scan import LaserScan
from anchorscan.settings import Settings
from anchorscan.stage_times import STAGES, _Clock, stage_times


def corner(width: float) -> LaserScan:
    angles = np.radians(np.arange(-90.0, 91.0))
    with np.errstate(divide="ignore"):
        ranges = np.minimum(np.abs(width / np.cos(angles)), np.abs(2.0 / np.sin(angles)))
    return LaserScan(ranges, -math.pi / 2, math.radians(1.0))


def test_stages_of_the_paper_add_up_to_no_more_than_the_whole():
    references = [Reference(i, corner(2.0 + i), Pose2D(5.0 * i)) for i in range(3)]
    places = Matcher(references, Settings.preset("paper"))
    expected = places.locate(corner(3.0))
    with stage_times() as seconds:
        start = time.perf_counter()
        found = places.locate(corner(3.0))
        total = time.perf_counter() - start
    assert [h.pose for h in found] == [h.pose for h in expected]
    for stage in ("extraction", "search", "alignment", "evaluation"):
        assert seconds[stage] > 0.0
    assert sum(seconds.values()) <= total


def test_everything_is_as_before_afterwards():
    watched = [(sys.modules[f"anchorscan.{key.partition('.')[0]}"]) for key in STAGES]
    watched += [description, matcher, anchors, verification]
    before = [dict(vars(module)) for module in watched]
    methods = dict(vars(RelationshipDatabase))
    with stage_times():
        assert vars(RelationshipDatabase)["votes"] is not methods["votes"]
    assert [dict(vars(module)) for module in watched] == before
    assert dict(vars(RelationshipDatabase)) == methods


def test_every_stage_that_is_named_exists():
    for key in STAGES:
        home, _, function = key.partition(".")
        module = sys.modules[f"anchorscan.{home}"]
        assert not function or hasattr(module, function)


def test_time_counts_for_the_inner_stage():
    clock = _Clock({"outer": 0.0, "inner": 0.0})
    inner = clock.timed(lambda: time.sleep(0.05), "inner")
    outer = clock.timed(lambda: (inner(), time.sleep(0.01)), "outer")
    outer()
    assert clock.seconds["inner"] >= 0.05
    assert 0.01 <= clock.seconds["outer"] < clock.seconds["inner"]
