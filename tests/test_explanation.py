"""What a trace means: readings that agree, edges that coincide, and the map around."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchorscan import (
    AnchorscanError,
    LaserScan,
    Matcher,
    Pose2D,
    Record,
    Reference,
    SensorModel,
    Settings,
    drive,
    random_building,
)
from anchorscan.explanation import (
    Explanation,
    Reading,
    bounds_of,
    compare,
    ellipse,
    map_at,
    picture_of_map,
    wall_points,
)


def explained(
    references: list[Record], query: Record, preset: str = "default", *, posed: bool = True
) -> Explanation:
    known = [
        Reference(record.index, record.scan, record.pose if posed else None)
        for record in references
        if record.scan is not None
    ]
    assert query.scan is not None
    trace = Matcher(known, Settings.preset(preset)).explain(query.scan)
    return Explanation(trace, known, query.pose)


@pytest.fixture(scope="module")
def drives() -> tuple[list[Record], list[Record]]:
    building = random_building(5)
    return drive(building, seed=1, length=30.0)[::6], drive(building, seed=2, length=6.0)


@pytest.fixture(scope="module", params=["default", "paper"])
def several(
    request: pytest.FixtureRequest, drives: tuple[list[Record], list[Record]]
) -> list[Explanation]:
    references, queries = drives
    return [explained(references, query, request.param) for query in queries[::8]]


def test_the_readings_that_agree_are_those_that_e_counts(several: list[Explanation]) -> None:
    for explanation in several:
        for hypothesis in explanation.trace.hypotheses:
            comparison = compare(explanation.trace, hypothesis)
            agree = np.sum(comparison.readings == Reading.AGREES)
            returns = comparison.front.is_return.sum()
            assert agree / returns == pytest.approx(hypothesis.evaluation, abs=1.01 / returns)


def test_of_a_laser_of_many_readings_those_that_are_looked_at_are_compared() -> None:
    building = random_building(5)
    sensor = SensorModel(field_of_view=2.0 * math.pi, resolution=2.0 * math.pi / 3200)
    references = drive(building, sensor, seed=1, length=8.0)[::8]
    query = drive(building, sensor, seed=1, length=8.0)[10]
    for preset, most in (("default", 800), ("paper", 3200)):
        explanation = explained(references, query, preset)
        comparison = explanation.comparison
        assert 0.9 * most <= len(comparison.front) <= most + 1
        agree = np.sum(comparison.readings == Reading.AGREES) / comparison.front.is_return.sum()
        best = explanation.trace.hypotheses[0]
        assert agree == pytest.approx(best.evaluation, abs=2e-3)
        assert best.pose is not None
        assert query.pose is not None
        assert best.pose.distance(query.pose) < 0.1


def test_real_readings_that_agree_are_those_that_e_counts(
    real_records: Callable[[str], list[Record]],
) -> None:
    records = [record for record in real_records("intel.log.gz") if record.scan is not None]
    for query in records[700:720:5]:
        explanation = explained(records[:300:4], query)
        comparison = explanation.comparison
        agree = np.sum(comparison.readings == Reading.AGREES) / comparison.front.is_return.sum()
        expected = explanation.trace.hypotheses[0].evaluation
        assert agree == pytest.approx(expected, abs=1.01 / comparison.front.is_return.sum())


def test_what_sees_through_ends_behind_the_synthetic_scan_and_what_is_nearer_before(
    several: list[Explanation],
) -> None:
    seen = 0
    for explanation in several:
        comparison = explanation.comparison
        off = comparison.front.ranges - comparison.evaluation.synthetic.ranges
        assert (off[comparison.readings == Reading.THROUGH] > 0.0).all()
        assert (off[comparison.readings == Reading.NEARER] < 0.0).all()
        assert np.isnan(off[comparison.readings == Reading.UNSEEN]).all()
        assert (comparison.front.is_return == (comparison.readings != Reading.NO_RETURN)).all()
        seen += np.sum(comparison.readings == Reading.THROUGH)
    assert seen > 0


def test_a_scan_laid_on_itself_agrees_throughout(drives: tuple[list[Record], list[Record]]) -> None:
    record = drives[0][2]
    explanation = explained([record], record)
    assert (explanation.comparison.readings != Reading.NEARER).all()
    pairing = explanation.pairing
    assert pairing.aligned is not None
    assert pairing.aligned.distance(Pose2D()) < 1e-6
    count = len(explanation.trace.description.graph)
    # Every edge lies on itself at least; the maximum lies on the matrix's diagonal.
    assert {(n, n) for n in range(count)} <= set(map(tuple, pairing.edges.tolist()))
    assert pairing.maximum is not None
    assert pairing.maximum[0] == pairing.maximum[1]


def test_edges_that_coincide_do_so_end_on_end(several: list[Explanation]) -> None:
    found = 0
    for explanation in several:
        pairing, ours = explanation.pairing, explanation.trace.description.graph
        tolerance = explanation.trace.settings.alignment.cluster_distance
        laid = set(map(tuple, pairing.edges.tolist()))
        found += len(laid)
        for theirs_edge, ours_edge in pairing.alignment.steps.correspondences.edges.tolist():
            assert pairing.aligned is not None
            there = pairing.description.graph.anchors.positions[
                pairing.description.graph.nodes[theirs_edge]
            ]
            here = pairing.aligned.apply(ours.anchors.positions[ours.nodes[ours_edge]])
            apart = min(
                max(math.dist(there[0], here[0]), math.dist(there[1], here[1])),
                max(math.dist(there[0], here[1]), math.dist(there[1], here[0])),
            )
            assert (apart <= tolerance) == ((theirs_edge, ours_edge) in laid)
    assert found > 0


def test_all_references_are_voted_for_as_the_search_would(
    drives: tuple[list[Record], list[Record]],
) -> None:
    references, queries = drives
    explanation = explained(references, queries[5], "paper")
    assert explanation.trace.pairwise is not None
    first = explanation.trace.pairwise.votes
    best = slice(0, len(first))
    np.testing.assert_array_equal(explanation.votes.references[best], first.references)
    np.testing.assert_array_equal(explanation.votes.counts[best], first.counts)
    assert len(explanation.votes) > len(first)


def test_nothing_is_explained_where_there_is_no_answer(
    drives: tuple[list[Record], list[Record]],
) -> None:
    references, queries = drives
    blind = Record(0, LaserScan(np.full(10, np.inf), 0.0, 0.1), Pose2D())
    with pytest.raises(AnchorscanError, match="no reading is a return"):
        explained(references, blind)
    with pytest.raises(AnchorscanError, match="no references"):
        explained([], queries[0])


def test_references_without_poses_make_no_map(drives: tuple[list[Record], list[Record]]) -> None:
    references, queries = drives
    explanation = explained(references, queries[0], posed=False)
    assert explanation.field is None
    assert len(wall_points(explanation.references)) == 0


def test_the_map_tells_the_distance_to_the_nearest_wall(several: list[Explanation]) -> None:
    explanation = several[0]
    assert explanation.field is not None
    walls = np.concatenate(
        [each.pose.apply(each.scan.points) for each in explanation.references if each.pose]
    )
    rng = np.random.default_rng(0)
    near = walls[rng.integers(len(walls), size=200)] + rng.normal(0.0, 0.2, (200, 2))
    far = np.array([[1e3, 1e3]])
    distance, is_free = map_at(explanation.field, np.concatenate([near, far]))
    truth = np.array([np.min(np.linalg.norm(walls - point, axis=1)) for point in near])
    reach = explanation.trace.settings.field.reach
    known = distance[:-1] < reach
    # A cell's distance is that of its centre, from where hits in a cell lie on average.
    assert np.abs(distance[:-1][known] - truth[known]).max() < 0.08
    assert (truth[~known] > reach - 0.08).all()
    assert np.isinf(distance[-1])
    assert not is_free[-1]
    midway = [
        0.5 * (each.pose.apply(each.scan.points)[40] + (each.pose.x, each.pose.y))
        for each in explanation.references
        if each.pose
    ]
    assert map_at(explanation.field, np.array(midway))[1].mean() > 0.8


def test_a_coarse_picture_of_the_map_loses_no_surface(several: list[Explanation]) -> None:
    explanation = several[0]
    assert explanation.field is not None
    bounds = bounds_of(wall_points(explanation.references))
    fine = picture_of_map(explanation.field, bounds, most=10_000)
    step = math.ceil(max(fine.is_surface.shape) / 100)
    coarse = picture_of_map(explanation.field, bounds, most=100)
    assert max(coarse.is_surface.shape) <= 100
    rows, columns = coarse.is_surface.shape
    for name, join in (("is_surface", np.any), ("is_free", np.any), ("distance", np.min)):
        layer = getattr(fine, name)
        layer = np.pad(
            layer,
            ((0, rows * step - layer.shape[0]), (0, columns * step - layer.shape[1])),
            constant_values=1.0 if name == "distance" else False,
        )
        joined = join(layer.reshape(rows, step, columns, step), axis=(1, 3))
        inside = joined[:-1, :-1]
        np.testing.assert_allclose(getattr(coarse, name)[:-1, :-1], inside)
    assert coarse.is_surface.any()


def test_a_picture_of_the_map_lies_where_it_says(several: list[Explanation]) -> None:
    explanation = several[0]
    assert explanation.field is not None
    best = explanation.trace.hypotheses[0].pose
    assert best is not None
    bounds = (best.x - 3.0, best.x + 2.0, best.y - 1.0, best.y + 2.5)
    picture = picture_of_map(explanation.field, bounds)
    left, right, bottom, top = picture.extent
    assert left <= bounds[0]
    assert right >= bounds[1]
    rows, columns = picture.distance.shape
    x = left + (np.arange(columns) + 0.5) * (right - left) / columns
    y = bottom + (np.arange(rows) + 0.5) * (top - bottom) / rows
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    distance, is_free = map_at(explanation.field, grid)
    np.testing.assert_array_equal(picture.is_free.ravel(), is_free)
    known = np.isfinite(distance)
    np.testing.assert_allclose(picture.distance.ravel()[known], distance[known], rtol=1e-5)


def test_walls_are_where_readings_end(drives: tuple[list[Record], list[Record]]) -> None:
    references = [
        Reference(record.index, record.scan, record.pose)
        for record in drives[0]
        if record.scan is not None
    ]
    points = wall_points(references, 0.1)
    ends = np.concatenate([each.pose.apply(each.scan.points) for each in references if each.pose])
    # One point a cell, and no cell without a reading or the other way round.
    assert {tuple(cell) for cell in np.floor(points / 0.1).astype(int).tolist()} == {
        tuple(cell) for cell in np.floor(ends / 0.1).astype(int).tolist()
    }
    assert len(points) == len(np.unique(points, axis=0))


@settings(max_examples=50, deadline=None)
@given(st.floats(0.01, 3.0), st.floats(0.01, 3.0), st.floats(-0.95, 0.95), st.floats(0.5, 4.0))
def test_an_ellipse_is_all_points_so_many_deviations_away(
    a: float, b: float, correlation: float, deviations: float
) -> None:
    covariance = np.diag([a * a, b * b, 1.0])
    covariance[0, 1] = covariance[1, 0] = correlation * a * b
    outline = ellipse(Pose2D(3.0, -2.0, 1.0), covariance, deviations) - (3.0, -2.0)
    squared = np.einsum("ni,ij,nj->n", outline, np.linalg.inv(covariance[:2, :2]), outline)
    np.testing.assert_allclose(np.sqrt(squared), deviations, rtol=1e-6)


def test_a_stray_reading_does_not_shrink_the_view_but_what_must_be_seen_is() -> None:
    points = np.concatenate([np.random.default_rng(0).uniform(-2.0, 2.0, (999, 2)), [[80.0, 0.0]]])
    left, right, _, top = bounds_of(points, np.array([[0.0, 20.0]]))
    assert -4.0 < left < -2.0
    assert 2.0 < right < 4.0
    assert top > 20.0
    assert bounds_of(np.empty((0, 2)))[0] < bounds_of(np.empty((0, 2)))[1]
