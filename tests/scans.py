"""Scans for the tests of the stages: of simulated buildings, of drawn rooms, and of nonsense."""

from __future__ import annotations

import functools
import math

import numpy as np
from hypothesis import strategies as st

from anchorscan import LaserScan, Pose2D, SensorModel, World, random_building, simulate
from anchorscan.field import FieldSettings, LikelihoodField
from anchorscan.simulator import random_poses
from anchorscan.tiles import Tiles

FULL_TURN = SensorModel(field_of_view=2.0 * math.pi, resolution=math.radians(0.5))
WIDE = SensorModel(field_of_view=math.radians(270.0), resolution=math.radians(0.5))
HALF_TURN = SensorModel()
EXACT = SensorModel(field_of_view=2.0 * math.pi, resolution=math.radians(0.5), noise=0.0)

seeds = st.integers(0, 2**31 - 1)
places = st.integers(0, 95)


# So many buildings, and places in each.
BUILDINGS, PLACES = 4, 24


@functools.cache
def building(number: int) -> tuple[World, list[Pose2D]]:
    """Give one of the buildings and places in it."""
    world = random_building(number)
    return world, random_poses(world, PLACES, number)


@functools.cache
def seen_in_building(number: int, sensor: SensorModel = WIDE) -> LaserScan:
    """Give a noisy scan of a building, one of ``BUILDINGS * PLACES``."""
    world, places = building(number % BUILDINGS)
    place = places[number // BUILDINGS % PLACES]
    return simulate(world, place, sensor, np.random.default_rng(number))


def box(x1: float, y1: float, x2: float, y2: float) -> list[tuple[float, float, float, float]]:
    """Give the walls of a rectangle."""
    return [(x1, y1, x2, y1), (x2, y1, x2, y2), (x2, y2, x1, y2), (x1, y2, x1, y1)]


def drawn(walls=(), pillars=(), at: Pose2D = Pose2D(), sensor: SensorModel = EXACT) -> LaserScan:  # noqa: B008
    """Give the exact scan of what is drawn."""
    return simulate(World(np.reshape(walls, (-1, 4)), np.reshape(pillars, (-1, 3))), at, sensor)


def small_room(settings: FieldSettings) -> tuple[LaserScan, Tiles]:
    """A scan of few rays in a room, and the map of it: soon drawn, even without compilation."""
    sensor = SensorModel(field_of_view=2.0 * math.pi, resolution=math.radians(6.0))
    scan = drawn(box(-2.0, -1.0, 2.0, 1.0), sensor=sensor)
    return scan, LikelihoodField(settings, [(scan, Pose2D())]).tiles


def reversed_sweep(scan: LaserScan) -> LaserScan:
    """Give the same readings as a sensor that turns the other way round reports them."""
    return LaserScan(
        scan.ranges[::-1],
        scan.angle_min + scan.angle_increment * (len(scan) - 1),
        -scan.angle_increment,
        scan.range_min,
        scan.range_max,
    )


def rolled(scan: LaserScan, count: int) -> LaserScan:
    """Give the same readings of a full turn as a sensor that begins elsewhere reports them."""
    return LaserScan(
        np.roll(scan.ranges, -count),
        scan.angle_min + count * scan.angle_increment,
        scan.angle_increment,
        scan.range_min,
        scan.range_max,
    )


def turned(scan: LaserScan, angle: float) -> LaserScan:
    """Give what a sensor sees that is mounted turned by minus ``angle``."""
    return LaserScan(
        scan.ranges, scan.angle_min + angle, scan.angle_increment, scan.range_min, scan.range_max
    )


specials = st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -1.0, 1e-30, 79.0, 81.0, 1e30])


@st.composite
def wild_scans(draw, largest: int = 80) -> LaserScan:
    """Surfaces and nonsense: pieces of walls at random ranges, with special values among them."""
    rng = np.random.default_rng(draw(seeds))
    count = draw(st.integers(0, largest))
    step = draw(st.sampled_from([math.radians(a) for a in (0.25, 0.5, 1.0, 3.0)]))
    if draw(st.booleans()):
        step = 2.0 * math.pi / max(count, 3)  # a full turn, coarse as it may be
    ranges = np.exp(np.cumsum(rng.normal(0.0, 0.01, count)) + rng.normal(0.0, 1.0))
    for start in rng.integers(0, max(count, 1), rng.integers(0, 6)):
        ranges[start:] *= np.exp(rng.normal(0.0, 0.7))
    for at in rng.integers(0, max(count, 1), rng.integers(0, 8)):
        ranges[at : at + rng.integers(1, 6)] = draw(specials)
    sense = draw(st.sampled_from([1.0, -1.0]))
    return LaserScan(ranges, rng.uniform(-3.2, 3.2), sense * step, draw(st.sampled_from([0, 0.1])))


@st.composite
def scans(draw) -> LaserScan:
    """Scans of buildings by several sensors."""
    sensor = draw(st.sampled_from([WIDE, HALF_TURN, FULL_TURN]))
    return seen_in_building(draw(places), sensor)


@st.composite
def sweeps(draw) -> LaserScan:
    """Anything that a message may hold."""
    ranges = draw(
        st.lists(
            st.one_of(specials, st.floats(width=32), st.floats(0.0, 5.0)), min_size=0, max_size=40
        )
    )
    step = draw(
        st.one_of(st.sampled_from([-0.2, 0.01, 0.15, 2.0 * math.pi / 40]), st.floats(1e-9, 0.3))
    )
    limits = draw(st.sampled_from([(0.0, 80.0), (0.1, 4.0), (0.0, math.inf), (0.0, 1e38)]))
    return LaserScan(np.array(ranges), draw(st.floats(-1e3, 1e3)), step, *limits)
