"""Karto's matcher as a check: it must agree with the truth where it can see it."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from anchorscan.building import random_building
from anchorscan.errors import MissingExtraError
from anchorscan.karto_matcher import KartoMatcher
from anchorscan.pose import Pose2D
from anchorscan.reference import Reference
from anchorscan.scan import LaserScan
from anchorscan.sensor import SensorModel
from anchorscan.simulator import random_poses, simulate


@pytest.mark.parametrize("clockwise", [False, True])
def test_finds_a_turned_scan_near_a_candidate(clockwise):
    pytest.importorskip("karto_scanmatcher")
    world = random_building(5)
    sensor = SensorModel(field_of_view=2.0 * math.pi, clockwise=clockwise)
    rng = np.random.default_rng(0)
    poses = random_poses(world, 3, 9)
    references = [
        Reference(i, simulate(world, pose, sensor, rng), pose) for i, pose in enumerate(poses)
    ]
    references.append(Reference(9, references[0].scan))  # without a pose: passed over
    matcher = KartoMatcher(lambda scan: references)
    for reference, pose in zip(references, poses, strict=False):
        truth = pose @ Pose2D(0.15, -0.1, 1.0)
        found = matcher.locate(simulate(world, truth, sensor, rng))
        assert len(found) == 3
        assert found[0].reference == reference.identifier
        assert found[0].pose.distance(truth) < 0.25
        assert found[0].pose.turn(truth) < math.radians(3.0)
        assert [one.response for one in found] == sorted((o.response for o in found), reverse=True)


def test_a_scan_without_returns_is_not_handed_over():
    pytest.importorskip("karto_scanmatcher")
    blind = LaserScan(np.full(10, np.inf), 0.0, 0.1)
    assert KartoMatcher(lambda scan: [Reference(0, blind, Pose2D())]).locate(blind) == []


def test_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "karto_scanmatcher", None)
    with pytest.raises(MissingExtraError, match=r"anchorscan\[bench\]"):
        KartoMatcher(lambda scan: [])
