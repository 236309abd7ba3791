"""The simulator against plain twins and against what geometry says."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from anchorscan import LaserScan, Pose2D
from anchorscan.errors import AnchorscanError, ScanError
from anchorscan.sensor import SensorModel
from anchorscan.simulator import (
    Door,
    World,
    cast_rays,
    drive,
    move_furniture,
    noisy_odometry,
    random_building,
    random_poses,
    rasterise,
    remove_walls,
    scatter_people,
    simulate,
    turn_doors,
)

SEEDS = st.integers(0, 2**31 - 1)
POSES = st.builds(
    Pose2D, st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(-math.pi, math.pi)
)
SENSORS = st.builds(
    SensorModel,
    field_of_view=st.sampled_from([math.radians(a) for a in (90, 180, 240, 270, 360)]),
    resolution=st.sampled_from([math.radians(a) for a in (0.25, 0.5, 1.0, 2.0)]),
    range_max=st.sampled_from([4.0, 8.0, 30.0, 80.0]),
    clockwise=st.booleans(),
    upside_down=st.booleans(),
)


def random_world(seed: int) -> World:
    """Segments and circles without any order, some beside, some around the origin."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform(-8.0, 8.0, (rng.integers(0, 30), 4))
    circles = np.column_stack((rng.uniform(-8.0, 8.0, (5, 2)), rng.uniform(0.05, 3.0, 5)))
    return World(ends, circles[: rng.integers(0, 6)])


def cast_rays_twin(
    world: World, pose: Pose2D, first_angle: float, increment: float, count: int
) -> NDArray[np.float64]:
    """Every ray against every surface."""
    angles = pose.theta + first_angle + increment * np.arange(count)
    dx, dy = np.cos(angles)[:, None], np.sin(angles)[:, None]
    a = world.segments[:, :2] - (pose.x, pose.y)
    e = world.segments[:, 2:] - world.segments[:, :2]
    with np.errstate(all="ignore"):
        cross = dx * e[:, 1] - dy * e[:, 0]
        distance = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / cross
        share = (a[:, 0] * dy - a[:, 1] * dx) / cross
    hit = (np.abs(cross) > 1e-12) & (share >= -1e-9) & (share <= 1 + 1e-9) & (distance >= 0)
    straight = np.where(hit, distance, np.inf)
    c = world.circles[:, :2] - (pose.x, pose.y)
    along = c[:, 0] * dx + c[:, 1] * dy
    root = world.circles[:, 2] ** 2 - (c**2).sum(axis=1) + along**2
    half = np.sqrt(np.maximum(root, 0.0))
    entry = np.where(along - half >= 0.0, along - half, along + half)
    round_ = np.where((root >= 0.0) & (entry >= 0.0), entry, np.inf)
    return np.concatenate((straight, round_, np.full((count, 1), np.inf)), axis=1).min(axis=1)


@given(SEEDS, SENSORS)
@settings(max_examples=150, deadline=None)
def test_ray_caster_agrees_with_its_plain_twin(seed: int, sensor: SensorModel) -> None:
    world = random_world(seed)
    rng = np.random.default_rng(seed)
    pose = Pose2D(*rng.uniform(-6.0, 6.0, 2), rng.uniform(-math.pi, math.pi))
    arguments = (world, pose, *sensor.sweep, sensor.count)
    np.testing.assert_allclose(cast_rays(*arguments), cast_rays_twin(*arguments), rtol=1e-9)


@pytest.mark.parametrize("style", ["office", "hall", "lookalike"])
def test_ray_caster_agrees_with_its_plain_twin_in_buildings(style: str) -> None:
    world = random_building(7, style=style)
    sensor = SensorModel(2.0 * math.pi, math.radians(0.5))
    for pose in random_poses(world, 20, 8):
        arguments = (world, pose, *sensor.sweep, sensor.count)
        distances = cast_rays(*arguments)
        np.testing.assert_allclose(distances, cast_rays_twin(*arguments), rtol=1e-9)
        # Buildings are closed: from inside, every ray ends.
        assert np.isfinite(distances).all()


def test_reach_leaves_out_only_what_is_beyond_it() -> None:
    world = random_building(3)
    for pose in random_poses(world, 10, 4):
        everything = cast_rays(world, pose, -3.0, 0.01, 600)
        limited = cast_rays(world, pose, -3.0, 0.01, 600, reach=5.0)
        near = everything <= 5.0
        np.testing.assert_array_equal(limited[near], everything[near])
        assert (limited[~near] > 5.0).all()


def assert_same_scan(one: LaserScan, other: LaserScan) -> None:
    """Equal geometry and readings, but for the last digits.

    A rigid motion changes those, so that a ray within them of an edge may fall to its other
    side: one such reading in a thousand is let pass.
    """
    assert (one.angle_min, one.angle_increment) == (other.angle_min, other.angle_increment)
    same = np.isclose(one.ranges, other.ranges, rtol=1e-5, atol=1e-5)
    assert (~same).sum() <= max(1, len(one) // 1000)


@given(SEEDS, POSES, SENSORS)
@settings(max_examples=50, deadline=None)
def test_world_moved_rigidly_with_the_pose_gives_the_same_scan(
    seed: int, motion: Pose2D, sensor: SensorModel
) -> None:
    world = random_building(seed % 5, length=20.0, depth=14.0)
    pose = random_poses(world, 1, seed)[0]
    one = simulate(world, pose, sensor)
    other = simulate(world.moved(motion), motion @ pose, sensor)
    assert_same_scan(one, other)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_either_sense_of_rotation_sees_the_same_points(seed: int) -> None:
    world = random_building(seed % 5, length=20.0, depth=14.0)
    pose = random_poses(world, 1, seed)[0]
    for degrees in (180, 270, 360):
        sensor = SensorModel(math.radians(degrees), math.radians(1.0))
        counter = simulate(world, pose, sensor).points
        for turned in ({"clockwise": True}, {"upside_down": True}):
            clockwise = simulate(world, pose, replace(sensor, **turned))
            assert clockwise.angle_increment < 0.0
            points = clockwise.points[::-1]
            if degrees == 360:  # the first ray is the same, not mirrored, in a full turn
                points = np.roll(points, 1, axis=0)
            assert np.isclose(points, counter, atol=1e-4).all(axis=1).mean() > 0.99
        both = simulate(world, pose, replace(sensor, clockwise=True, upside_down=True))
        np.testing.assert_array_equal(both.points, counter)


def test_mirrored_sensor_shows_the_mirror_image() -> None:
    world = random_building(1)
    sensor = SensorModel(math.radians(270), math.radians(1.0))
    for pose in random_poses(world, 5, 2):
        true = simulate(world, pose, sensor)
        mirrored = simulate(world, pose, replace(sensor, mirrored=True))
        assert mirrored.angle_min == true.angle_min
        np.testing.assert_allclose(mirrored.ranges[::-1], true.ranges, rtol=1e-5)


def square_room() -> World:
    corners = np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]])
    return World(np.hstack((corners, np.roll(corners, -1, axis=0))))


def test_square_room_by_hand() -> None:
    scan = simulate(square_room(), Pose2D(1.0, 0.0, 0.0), SensorModel(math.pi, math.pi / 2))
    np.testing.assert_allclose(scan.ranges, [2.0, 1.0, 2.0], rtol=1e-6)


def test_range_limits_follow_rep_117() -> None:
    sensor = SensorModel(math.pi, math.pi / 2, range_min=1.5, range_max=1.8)
    scan = simulate(square_room(), Pose2D(1.0, 0.3, 0.0), sensor)
    assert scan.ranges.tolist() == [math.inf, -math.inf, np.float32(1.7)]
    zero = simulate(square_room(), Pose2D(), replace(sensor, no_return_value=0.0))
    assert zero.ranges.tolist() == [0.0, 0.0, 0.0]


def test_noise_and_dropouts_have_the_size_asked_for() -> None:
    world, pose = square_room(), Pose2D(0.3, 0.2, 0.1)
    sensor = SensorModel(
        2 * math.pi, math.radians(0.1), noise=0.02, relative_noise=0.01, dropout=0.1
    )
    exact = simulate(world, pose, sensor).ranges.astype(float)
    noisy = simulate(world, pose, sensor, np.random.default_rng(0)).ranges.astype(float)
    lost = np.isnan(noisy)
    assert 0.08 < lost.mean() < 0.12
    error = ((noisy - exact) / np.hypot(0.02, 0.01 * exact))[~lost]
    assert abs(error.mean()) < 0.1
    assert 0.95 < error.std() < 1.05


def test_open_door_lets_the_laser_through_and_a_closed_one_does_not() -> None:
    door = Door((0.0, -0.5), (0.0, 0.5))
    wall = np.array([[0.0, -3.0, 0.0, -0.5], [0.0, 0.5, 0.0, 3.0], [2.0, -3.0, 2.0, 3.0]])
    pose = Pose2D(-1.0, 0.0, 0.0)
    assert cast_rays(World(wall, doors=(door,)), pose, 0.0, 1.0, 1)[0] == pytest.approx(1.0)
    for opening in (math.pi / 2, -math.pi / 2):
        opened = World(wall, doors=(replace(door, opening=opening),))
        assert cast_rays(opened, pose, 0.0, 1.0, 1)[0] == pytest.approx(3.0)


@given(SEEDS)
@settings(max_examples=20, deadline=None)
def test_people_stand_in_view_and_nothing_else_changes(seed: int) -> None:
    world = random_building(seed % 5, length=20.0, depth=14.0)
    pose = random_poses(world, 1, seed)[0]
    crowd = scatter_people(world, 6, seed, around=pose)
    before = cast_rays(world, pose, -math.pi, 0.01, 628)
    after = cast_rays(crowd, pose, -math.pi, 0.01, 628)
    assert (after <= before).all()
    assert len(crowd.people) > 0
    assert (after < before).any()
    assert after.min() >= min(0.6 - 1e-9, before.min())
    gone = replace(crowd, people=world.people)
    np.testing.assert_array_equal(cast_rays(gone, pose, -math.pi, 0.01, 628), before)


def test_changes_touch_what_they_name() -> None:
    world = random_building(5)
    turned = turn_doors(world, 1)
    assert all(
        (a.opening == 0) != (b.opening == 0) for a, b in zip(world.doors, turned.doors, strict=True)
    )
    assert turn_doors(world, 1, share=0.0).doors == world.doors
    moved = move_furniture(world, 1, distance=0.8)
    steps = [a.pose.distance(b.pose) for a, b in zip(world.furniture, moved.furniture, strict=True)]
    assert 0.0 < max(steps) <= 0.8
    assert move_furniture(world, 1, share=0.0).furniture == world.furniture
    removed = remove_walls(world, 1, share=1 / 3)
    assert 0.55 < len(removed.walls) / len(world.walls) < 0.78
    for changed in (turned, moved):
        np.testing.assert_array_equal(changed.walls, world.walls)


@pytest.mark.parametrize("style", ["office", "hall", "lookalike"])
def test_drive_is_plausible_and_exact(style: str) -> None:
    world = random_building(11, style=style)
    sensor = SensorModel(mounting=Pose2D(0.2, 0.05, 0.1))
    records = drive(world, sensor, seed=12, length=60.0, step=0.25, turn=0.2)
    assert [r.index for r in records] == list(range(len(records)))
    driven = 0.0
    for before, after in pairwise(records):
        assert before.pose is not None
        assert after.pose is not None
        one, two = (r.pose @ sensor.mounting.inverse() for r in (before, after))
        assert one.distance(two) <= 0.25 + 1e-9
        assert one.turn(two) <= 0.2 + 1e-9
        assert after.stamp > before.stamp
        driven += one.distance(two)
    assert driven > 50.0
    for record in records[::20]:
        base = record.pose @ sensor.mounting.inverse()
        assert cast_rays(world, base, -math.pi, 0.02, 315).min() > 0.15
        exact = simulate(world, record.pose, sensor)
        both = record.scan.is_return & exact.is_return
        error = record.scan.ranges[both] - exact.ranges[both]
        assert abs(np.median(error)) < 0.005
        assert 0.007 < np.std(error) < 0.013


def test_another_sensor_sees_the_same_drive() -> None:
    world = random_building(13, length=20.0, depth=14.0)
    one = drive(world, SensorModel(), seed=3, length=20.0)
    other = drive(world, SensorModel(2 * math.pi, math.radians(2.0)), seed=3, length=20.0)
    assert [r.pose for r in one] == [r.pose for r in other]
    assert [r.odometry for r in one] == [r.odometry for r in other]


def test_same_seed_gives_the_same_everything() -> None:
    one, other = (drive(random_building(4), seed=9, length=30.0) for _ in range(2))
    assert [(r.pose, r.odometry, r.stamp) for r in one] == [
        (r.pose, r.odometry, r.stamp) for r in other
    ]
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.scan.ranges, b.scan.ranges)
    assert random_building(5).walls.tolist() != random_building(4).walls.tolist()


def test_odometry_without_noise_is_the_motion_itself() -> None:
    poses = random_poses(random_building(1), 30, 1)
    exact = noisy_odometry(poses, 0.0, np.random.default_rng(0))
    for pose, odometry in zip(poses, exact, strict=True):
        expected = poses[0].inverse() @ pose
        assert expected.distance(odometry) < 1e-9
        assert expected.turn(odometry) < 1e-9


def test_odometry_drifts_by_about_the_share_asked_for() -> None:
    straight = [Pose2D(0.1 * i, 0.0, 0.0) for i in range(1001)]
    ends = [noisy_odometry(straight, 0.05, np.random.default_rng(seed))[-1] for seed in range(200)]
    along = np.array([end.x for end in ends]) / 100.0 - 1.0
    assert 0.035 < along.std() < 0.065


def test_lookalike_rooms_look_alike() -> None:
    world = random_building(21, style="lookalike")
    # The rooms on one side repeat every room width and wall.
    here, there = Pose2D(2.0, 4.5, 1.0), Pose2D(2.0 + 4.15, 4.5, 1.0)
    sensor = SensorModel(2 * math.pi, math.radians(1.0))
    one, other = simulate(world, here, sensor), simulate(world, there, sensor)
    assert np.isclose(one.ranges, other.ranges, atol=1e-3).mean() > 0.9


def test_impossible_buildings_are_refused() -> None:
    with pytest.raises(AnchorscanError, match="no style 'castle'; there are office"):
        random_building(1, style="castle")
    with pytest.raises(AnchorscanError, match="too small"):
        random_building(1, length=3.0)
    with pytest.raises(AnchorscanError, match="fits nowhere"):
        random_poses(square_room(), 1, 0, radius=3.0)


def test_outside_of_a_drawn_building_is_unknown_and_its_rooms_are_free() -> None:
    world = square_room()
    grid = rasterise(world, 0.1)
    inside, outside = grid.cells([[0.0, 0.0], [-2.3, 2.3]])
    assert grid.is_free[tuple(inside)]
    assert grid.data[tuple(outside)] == -1
    # All that is free lies in the room; a world without an inside is free as a whole.
    assert np.abs(grid.centres(np.argwhere(grid.is_free))).max() < 2.0
    wall = rasterise(World(np.array([[0.0, 0.0, 1.0, 0.0]])), 0.1)
    assert (wall.data >= 0).all()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"field_of_view": 0.0}, "field of view"),
        ({"field_of_view": 7.0}, "field of view"),
        ({"resolution": 0.0}, "angular resolution"),
        ({"resolution": math.nan}, "angular resolution"),
        ({"range_min": 9.0, "range_max": 3.0}, "out of order"),
        ({"range_max": math.inf}, "out of order"),
        ({"noise": -1.0}, "must not be negative"),
        ({"dropout": 1.1}, "dropout"),
    ],
)
def test_impossible_sensors_are_refused(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(ScanError, match=message):
        SensorModel(**wrong)


def test_sensor_counts_its_readings_as_real_ones_do() -> None:
    half = SensorModel(math.pi, math.radians(1.0))
    full = SensorModel(2 * math.pi, math.radians(0.5))
    assert (half.count, full.count) == (181, 720)
    scan = full.measure(np.ones(720))
    assert scan.is_full_turn
    assert scan.angles[-1] == pytest.approx(math.pi - math.radians(0.5))
    with pytest.raises(ScanError, match="181 readings need as many"):
        half.measure(np.ones(180))
