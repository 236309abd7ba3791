"""Scans and answers on the wire come back as they were, and damage is told, not believed."""

from __future__ import annotations

import contextlib
import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anchorscan import Hypothesis, LaserScan, Pose2D, ScanError
from anchorscan.scan_message import (
    MOST_READINGS,
    hypothesis_of,
    hypothesis_values,
    packed,
    scan_of,
    scan_values,
    unpacked,
)

RANGES = st.lists(st.floats(width=32) | st.just(math.inf), max_size=40)
SCANS = st.builds(
    LaserScan,
    RANGES.map(lambda values: np.array(values, np.float32)),
    st.floats(-4.0, 4.0),
    st.floats(0.001, 0.1),
    st.floats(0.0, 1.0),
    st.floats(1.5, 100.0) | st.just(math.inf),
)


def are_same(one: LaserScan, other: LaserScan) -> bool:
    geometry = ("angle_min", "angle_increment", "range_min", "range_max")
    return np.array_equal(one.ranges, other.ranges, equal_nan=True) and all(
        getattr(one, name) == getattr(other, name) for name in geometry
    )


@given(SCANS)
def test_a_scan_comes_back_from_json_as_it_was(scan: LaserScan) -> None:
    text = json.dumps(scan_values(scan), allow_nan=False)
    assert are_same(scan_of(json.loads(text)), scan)


@given(st.lists(SCANS, min_size=1, max_size=4))
def test_scans_come_back_from_the_binary_form_as_they_were(scans: list[LaserScan]) -> None:
    back = unpacked(packed(scans), len(scans))
    assert len(back) == len(scans)
    assert all(are_same(*pair) for pair in zip(back, scans, strict=True))


@given(st.data(), st.lists(SCANS, min_size=1, max_size=3))
def test_damaged_binary_data_are_an_error_of_ours_or_another_scan(
    data: st.DataObject, scans: list[LaserScan]
) -> None:
    good = bytearray(packed(scans))
    good[data.draw(st.integers(0, len(good) - 1))] ^= data.draw(st.integers(1, 255))
    cut = bytes(good[: data.draw(st.integers(0, len(good)))])
    for damaged in (bytes(good), cut):
        with contextlib.suppress(ScanError):
            assert len(unpacked(damaged, 10)) <= 10


def test_sizes_are_not_believed_before_memory_is_taken() -> None:
    scan = LaserScan(np.ones(3, np.float32), 0.0, 0.1)
    good = bytearray(packed([scan]))
    good[44:48] = (MOST_READINGS + 1).to_bytes(4, "little")
    with pytest.raises(ScanError, match="more than"):
        unpacked(bytes(good), 1)
    with pytest.raises(ScanError, match="between 1 and 5"):
        unpacked(packed([scan] * 6), 5)
    with pytest.raises(ScanError, match="after the last scan"):
        unpacked(packed([scan]) + b"x", 1)


def test_special_ranges_are_spelled() -> None:
    scan = LaserScan(np.array([1.5, np.nan, np.inf, -np.inf], np.float32), 0.0, 0.1)
    assert scan_values(scan)["ranges"] == [1.5, None, "inf", "-inf"]


def test_a_hypothesis_comes_back_as_it_was() -> None:
    one = Hypothesis(
        3,
        Pose2D(0.1, 0.2, 0.3),
        None,
        np.eye(3) / 3.0,
        1 / 3,
        math.nan,
        0.7,
        0.123456789,
        True,
        True,
    )
    back = hypothesis_of(json.loads(json.dumps(hypothesis_values(one), allow_nan=False)))
    assert (back.reference, back.pose, back.accepted, back.ambiguous) == (3, None, True, True)
    assert back.pose_in_reference == one.pose_in_reference
    assert (back.probability, back.evaluation) == (one.probability, one.evaluation)
    assert np.array_equal(back.covariance, one.covariance)
    assert math.isnan(back.quality)
    with pytest.raises(ValueError, match="hypothesis"):
        hypothesis_of({"reference": 1})
