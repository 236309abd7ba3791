"""Spacings of walls: against plain adding up, and what must not change them."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchorscan.database import WORDS
from anchorscan.panorama import _DISTANCES, _UNITS, DIRECTIONS, panorama
from anchorscan.spacing import spacings

SAME, FACING, BACKS = range(3)


def room(x, y, wide, high):
    """Give what is seen in a room, so far from its lower left corner."""
    bearings = (np.arange(720) + 0.3) * math.pi / 360.0
    c, s = np.cos(bearings), np.sin(bearings)
    across = np.where(c > 0.0, (wide - x) / c, -x / c)
    along = np.where(s > 0.0, (high - y) / s, -y / s)
    ranges = np.minimum(across, along)
    return panorama(np.column_stack([c, s]) * ranges[:, None], 0.0)


def random_panorama(seed):
    """Give walls, gaps, and single readings."""
    rng = np.random.default_rng(seed)
    seen = room(*rng.uniform(0.5, 3.0, 2), *rng.uniform(3.5, 9.0, 2))
    for _ in range(rng.integers(0, 5)):
        first, count = rng.integers(0, DIRECTIONS), rng.integers(1, 40)
        nearer = (first + np.arange(count)) % DIRECTIONS
        seen[nearer] = np.maximum(seen[nearer].astype(int) - rng.integers(0, 60), 0)
    return seen


def lengths_of(words):
    """Axis, kind and number of every bit that is set."""
    x, y, backs = (int(word) for word in words)
    return {
        *((0, SAME, k) for k in range(32) if x >> k & 1),
        *((0, FACING, k) for k in range(32) if x >> (32 + k) & 1),
        *((1, SAME, k) for k in range(32) if y >> k & 1),
        *((1, FACING, k) for k in range(32) if y >> (32 + k) & 1),
        *((axis, BACKS, k) for axis in range(2) for k in range(32) if backs >> (32 * axis + k) & 1),
    }


def plain_weights(seen):
    """How much walls weigh at every axis, kind and number of a spacing."""
    walls = Counter()
    for a in range(DIRECTIONS):
        b = (a + 1) % DIRECTIONS
        if not seen[a] or not seen[b]:
            continue
        begin, end = (_UNITS[k].astype(float) * float(_DISTANCES[seen[k]]) for k in (a, b))
        way = end - begin
        length = np.hypot(*way)
        if length > 0.25 + 0.12 * min(np.hypot(*begin), np.hypot(*end)):
            continue
        for axis in range(2):
            if abs(way[axis]) < 0.35 * length:
                # Free space is on the left of the way.
                faces = (-way[1], way[0])[axis] > 0.0
                at = 0.5 * (begin[axis] + end[axis]) / 0.1 + 127.5
                k = math.floor(at)
                walls[axis, faces, k] += length * (1.0 - at + k)
                walls[axis, faces, k + 1] += length * (at - k)
                break
    weights = Counter()
    for (axis, faces, k), one in walls.items():
        for (other_axis, other_faces, j), two in walls.items():
            lag = j - k
            if axis != other_axis or not 0 <= lag < 64 or (faces == other_faces and lag < 2):
                continue
            kind = SAME if faces == other_faces else FACING if faces else BACKS
            weight = math.sqrt(min(one, 1.0) * min(two, 1.0))
            weights[axis, kind, lag // 2] += 0.75 * weight
            weights[axis, kind, lag // 2 + (1 if lag % 2 else -1)] += 0.25 * weight
    return weights


@given(st.integers(0, 1 << 30))
@settings(max_examples=25)
def test_a_bit_is_set_where_walls_weigh_enough(seed):
    seen = random_panorama(seed)
    found = lengths_of(spacings(seen[None])[0])
    for (axis, kind, k), weight in plain_weights(seen).items():
        # By rounding, one that weighs just enough may be missed.
        if 0 <= k < 32 and abs(weight - 0.25) > 0.02:
            assert ((axis, kind, k) in found) == (weight >= 0.25)
    assert all(plain_weights(seen)[bit] > 0.23 for bit in found)


def test_the_walls_of_a_room_face_each_other_at_its_width_and_height():
    found = lengths_of(spacings(room(1.0, 1.3, 4.1, 2.9)[None])[0])
    assert {(0, FACING, 20), (1, FACING, 14)} <= found
    for axis, kind, k in found:
        # Readings are in steps of 2.7 %: walls are in a few bins.
        assert abs(k - {SAME: 0, FACING: (20, 14)[axis]}[kind]) <= 1


@given(st.floats(0.8, 3.2), st.floats(0.8, 2.2))
def test_the_spacings_of_a_room_are_the_same_from_everywhere(x, y):
    near, far = (
        {bit for bit in lengths_of(spacings(room(*at, 4.1, 2.9)[None])[0]) if bit[1] == FACING}
        for at in ((2.0, 1.5), (x, y))
    )
    assert len(near & far) >= 2


@given(st.integers(0, 1 << 30), st.integers(1, 3))
def test_a_quarter_turn_exchanges_the_axes_and_half_a_turn_changes_nothing(seed, quarters):
    seen = random_panorama(seed)
    straight = lengths_of(spacings(seen[None])[0])
    turned = lengths_of(spacings(np.roll(seen, 45 * quarters)[None])[0])
    expected = {((axis + quarters) % 2, kind, k) for axis, kind, k in straight}
    # What lies on the border of two bins, or weighs just enough, may go either way.
    assert len(expected ^ turned) <= 2


@pytest.mark.parametrize("count", [0, 2])
def test_who_saw_nothing_saw_no_spacing(count):
    found = spacings(np.zeros((count, DIRECTIONS), np.uint8))
    assert found.shape == (count, WORDS)
    assert found.dtype == np.uint64
    assert not found.any()
