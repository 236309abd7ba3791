"""The localizer over time: found from nothing, sure only where it may be, and found again."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchorscan import (
    LaserScan,
    Localizer,
    Matcher,
    Pose2D,
    Record,
    Reference,
    ReferenceSetError,
    SensorModel,
    Settings,
    SettingsError,
    drive,
    random_building,
)
from anchorscan.hypothesis import Hypothesis
from anchorscan.localizer import Belief
from anchorscan.protocol import CORRECT_HEADING, CORRECT_POSITION, choose_references
from anchorscan.simulator import simulate

BLIND = LaserScan(np.full(181, np.inf), -math.pi / 2, math.pi / 180)


def known(records: list[Record]) -> Matcher:
    chosen = [records[position] for position in choose_references(records)]
    return Matcher(Reference(r.index, r.scan, r.pose) for r in chosen if r.scan is not None)


def is_right(belief: Belief, record: Record) -> bool:
    assert belief.pose is not None
    assert record.pose is not None
    return (
        belief.pose.distance(record.pose) <= CORRECT_POSITION
        and belief.pose.turn(record.pose) <= CORRECT_HEADING
    )


def told(belief: Belief) -> tuple[object, ...]:
    """All that a belief says, to be compared exactly."""
    places = [
        (h.reference, h.pose, h.covariance.tobytes(), h.score, h.probability, h.accepted)
        for h in belief.hypotheses
    ]
    return (*places, belief.elsewhere, belief.accepted, belief.state)


@pytest.fixture(scope="module")
def places() -> Matcher:
    return known(drive(random_building(5), seed=1, length=120.0))


@pytest.fixture(scope="module")
def journey() -> list[Record]:
    """An independent drive through the same building, with noisy odometry."""
    return drive(random_building(5), seed=2, length=25.0, odometry_noise=0.05)


def fed(localizer: Localizer, records: list[Record], *, wheels: bool = True) -> list[Belief]:
    assert all(record.scan is not None for record in records)
    return [
        localizer.update(r.scan, r.odometry if wheels else None, r.stamp)  # type: ignore[arg-type]
        for r in records
    ]


@pytest.mark.parametrize(
    ("wheels", "share"), [(True, 0.5), (False, 0.05)], ids=["odometry", "no odometry"]
)
def test_a_lost_robot_is_found_and_never_sure_of_a_wrong_place(
    places: Matcher, journey: list[Record], wheels: bool, share: float
) -> None:
    """The first 40 % of the journey are outside of the map."""
    beliefs = fed(Localizer(places), journey, wheels=wheels)
    sure = [is_right(b, r) for b, r in zip(beliefs, journey, strict=True) if b.accepted]
    assert len(sure) >= share * len(journey)
    assert all(sure)


def test_the_same_scans_give_the_same_beliefs_to_the_last_bit(
    places: Matcher, journey: list[Record]
) -> None:
    localizer = Localizer(places)
    first = [told(belief) for belief in fed(localizer, journey[:25])]
    localizer.reset()
    assert [told(belief) for belief in fed(localizer, journey[:25])] == first


def test_where_odometry_began_does_not_matter(places: Matcher, journey: list[Record]) -> None:
    frame = Pose2D(30.0, -4.0, 2.0)
    one, other = Localizer(places), Localizer(places)
    for record in journey[:25]:
        assert record.scan is not None
        assert record.odometry is not None
        here = one.update(record.scan, record.odometry)
        there = other.update(record.scan, frame @ record.odometry)
        assert here.accepted == there.accepted
        if here.pose is not None and there.pose is not None and here.probability > 0.9:
            assert here.pose.distance(there.pose) < 1e-3


def test_a_robot_that_was_carried_away_is_doubted_and_found_again(
    places: Matcher, journey: list[Record]
) -> None:
    half = len(journey) // 2
    here = journey[half - 1].pose
    assert here is not None
    apart = [r.pose is not None and r.pose.distance(here) > 5.0 for r in journey]
    there = next(i for i in range(len(journey)) if apart[i])
    localizer = Localizer(places)
    assert any(belief.accepted for belief in fed(localizer, journey[:half]))
    # The wheels stood still while it was carried: their pose goes on from where it was.
    T_odom_odom = journey[half - 1].odometry @ journey[there].odometry.inverse()  # type: ignore[union-attr, operator]
    driven, sure = 0.0, []
    for before, record in zip([journey[there], *journey[there:]], journey[there:], strict=False):
        driven += before.pose.distance(record.pose)  # type: ignore[union-attr, arg-type]
        belief = localizer.update(record.scan, T_odom_odom @ record.odometry, None)  # type: ignore[arg-type, operator]
        sure.append((driven, belief.accepted, is_right(belief, record)))
    assert not any(accepted and not right for metres, accepted, right in sure if metres > 2.0)
    assert any(accepted and right for _, accepted, right in sure)


def test_a_robot_outside_of_the_map_is_never_sure(places: Matcher) -> None:
    elsewhere = drive(random_building(8), seed=3, length=15.0)
    assert not any(belief.accepted for belief in fed(Localizer(places), elsewhere))


def test_a_blind_scan_gives_no_new_evidence_and_no_search(
    places: Matcher, journey: list[Record]
) -> None:
    localizer = Localizer(places)
    assert localizer.update(BLIND).hypotheses == ()
    assert localizer.update(BLIND).state == "lost"
    before = fed(localizer, journey[:20])[-1]
    after = localizer.update(BLIND, journey[19].odometry, journey[19].stamp)
    assert len(after.hypotheses) == len(before.hypotheses)
    assert after.probability <= before.probability


def test_an_empty_map_knows_nothing(journey: list[Record]) -> None:
    beliefs = fed(Localizer(Matcher()), journey[:3])
    assert {(b.pose, b.accepted, b.elsewhere) for b in beliefs} == {(None, False, 1.0)}


@pytest.mark.parametrize("poseless", [False, True], ids=["none left", "one without a pose left"])
def test_when_all_references_go_nothing_is_known_until_others_come(
    journey: list[Record], poseless: bool
) -> None:
    known = [Reference(r.index, r.scan, r.pose) for r in journey[:60:5] if r.scan is not None]
    places = Matcher(known)
    localizer = Localizer(places)
    assert fed(localizer, journey[:10])[-1].pose is not None
    if poseless:
        places.add(Reference(-1, known[0].scan))
    for reference in known:
        places.remove(reference.identifier)
    belief = fed(localizer, journey[10:11])[0]
    assert (belief.state, belief.hypotheses, belief.elsewhere) == ("lost", (), 1.0)
    assert localizer.update(BLIND).hypotheses == ()
    assert not len(localizer.mixture)
    for reference in known:
        places.add(reference)
    assert any(belief.accepted for belief in fed(localizer, journey[11:40]))


def test_settings_that_make_no_map_are_refused_with_what_to_do() -> None:
    places = Matcher((), Settings.preset("paper"))
    with pytest.raises(SettingsError, match="use those of the preset default"):
        Localizer(places)


def test_references_without_poses_are_refused_with_what_to_do(journey: list[Record]) -> None:
    places = Matcher()
    localizer = Localizer(places)
    assert fed(localizer, journey[:1])[0].state == "lost", "they may come later"
    assert journey[0].scan is not None
    places.add(Reference(0, journey[0].scan))
    with pytest.raises(ReferenceSetError, match="TopologicalLocalizer"):
        fed(localizer, journey[1:2])
    places.add(Reference(1, journey[1].scan, journey[1].pose))  # type: ignore[arg-type]
    assert fed(localizer, journey[2:3])[0].pose is not None


@settings(max_examples=12)
@given(data=st.data())
def test_no_odometry_clock_or_scan_breaks_the_belief(
    places: Matcher, journey: list[Record], data: st.DataObject
) -> None:
    localizer = Localizer(places)
    numbers = st.one_of(st.none(), st.floats(), st.floats(-5.0, 5.0))
    for _ in range(6):
        record = data.draw(st.sampled_from(journey))
        scan = data.draw(st.sampled_from([record.scan, BLIND]))
        x = data.draw(numbers)
        wheels = None if x is None else Pose2D(x, 0.0, data.draw(st.floats(-4.0, 4.0)))
        belief = localizer.update(scan, wheels, data.draw(numbers))  # type: ignore[arg-type]
        named = sum(each.probability for each in belief.hypotheses)
        assert 0.0 <= belief.probability <= 1.0
        assert named + belief.elsewhere <= 1.0 + 1e-9
        assert [h.probability for h in belief.hypotheses] == sorted(
            (h.probability for h in belief.hypotheses), reverse=True
        )
        assert all(h.pose is not None and h.pose.is_finite() for h in belief.hypotheses)


class Counting:
    """A map that counts what it is asked."""

    def __init__(self, places: Matcher) -> None:
        self.places = places
        self.settings = places.settings
        self.nearest = places.nearest
        self.searches = 0
        self.most = 0

    def explain(self, scan: LaserScan, candidates: None = None):  # type: ignore[no-untyped-def]
        self.searches += 1
        return self.places.explain(scan, candidates)

    def follow(self, scan, poses, stiffness):  # type: ignore[no-untyped-def]
        self.most = max(self.most, len(poses))
        return self.places.follow(scan, poses, stiffness)


def test_a_step_costs_at_most_one_search_and_a_bounded_number_of_places(
    places: Matcher, journey: list[Record]
) -> None:
    counting = Counting(places)
    localizer = Localizer(counting)
    limits = places.settings
    for number, record in enumerate(journey, start=1):
        belief = fed(localizer, [record])[0]
        assert counting.searches <= number
        assert len(localizer.mixture) <= limits.belief.places
        assert len(belief.hypotheses) <= 5
    assert counting.most <= limits.belief.places + limits.verification.fits
    assert counting.searches < len(journey)


def test_two_lasers_of_a_robot_at_rest_prove_no_more_than_one(
    places: Matcher, journey: list[Record]
) -> None:
    """What one laser sees after the other is neither a way nor new: nothing is searched again."""
    here, front, rear = journey[-1].pose, Pose2D(0.2), Pose2D(-0.4, 0.0, math.pi)
    assert here is not None
    counting = Counting(places)
    localizer, rng = Localizer(counting), np.random.default_rng(1)
    for number in range(8):
        mounting = (front, rear)[number % 2]
        scan = simulate(random_building(5), here @ mounting, SensorModel(noise=0.02), rng)
        belief = localizer.update(scan, Pose2D(3.0) @ mounting, 0.1 * number, mounting)
        assert belief.pose is not None
        assert belief.pose.distance(here @ mounting) < 0.3
        assert belief.pose.turn(here @ mounting) < 0.1
    assert counting.searches == 1


def test_a_robot_outside_of_the_map_searches_ever_less(places: Matcher) -> None:
    """It sees a corridor without an end that is no place of the map."""
    counting = Counting(places)
    localizer = Localizer(counting)
    angles = np.radians(np.arange(-90.0, 91.0))
    sides = np.minimum(0.31 / np.maximum(np.abs(np.sin(angles)), 1e-9), 30.0)
    scan = LaserScan(sides, math.radians(-90.0), math.radians(1.0), 0.1, 31.0)
    searches = []
    for number in range(400):
        localizer.update(scan, Pose2D(0.1 * number, 0.0, 0.0))
        searches.append(counting.searches)
    assert searches[40] >= 8
    assert 5 <= searches[399] - searches[200] <= 20


def test_a_located_robot_whose_scan_fits_no_more_searches_as_one_that_is_lost(
    places: Matcher,
) -> None:
    settings = places.settings.belief
    localizer = Localizer(places)
    spacings = []
    for score in (3.0, -3.0):
        best = Hypothesis(0, Pose2D(), Pose2D(), np.eye(3), 0.0, 0.0, score, 0.995, True)
        localizer._belief = Belief((best,), 0.0, True)
        spacings.append(localizer._spacing())
    assert spacings == [settings.check_spacing, settings.search_spacing]


# On real logs


def blocked(scan: LaserScan, rng: np.random.Generator, share: float = 0.3) -> LaserScan:
    """Some readings end nearer: legs and bodies, two to eight readings wide."""
    ranges = scan.ranges.astype(np.float64).copy()
    hidden = np.zeros(len(ranges), bool)
    while hidden.mean() < share:
        begin, width = int(rng.integers(len(ranges))), int(rng.integers(2, 9))
        near = np.where(np.isfinite(ranges[begin : begin + width]), 1.0, 0.0)
        farthest = np.minimum(np.nan_to_num(ranges[begin : begin + width], posinf=8.0), 8.0)
        body = rng.uniform(0.3, 0.9) * float(farthest.min(initial=8.0))
        ranges[begin : begin + width] = np.where(near > 0, body, ranges[begin : begin + width])
        hidden[begin : begin + width] = True
    return LaserScan(ranges, scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)


def test_people_around_the_robot_neither_break_nor_mislead_the_belief(
    real_records: Callable[[str], list[Record]],
) -> None:
    places = known(real_records("wean-2.log.gz"))
    records = real_records("wean-3.log.gz")[:600:2]
    localizer, rng = Localizer(places), np.random.default_rng(0)
    sure = []
    for record in records:
        assert record.scan is not None
        belief = localizer.update(blocked(record.scan, rng), record.odometry, record.stamp)
        if belief.accepted:
            sure.append(is_right(belief, record))
    assert len(sure) > 0.3 * len(records)
    assert all(sure)


def test_a_real_drive_is_followed_with_its_raw_odometry(
    real_records: Callable[[str], list[Record]],
) -> None:
    records = real_records("wean-3.log.gz")[300:900]
    places = known(real_records("wean-2.log.gz"))
    beliefs = fed(Localizer(places), records)
    sure = [is_right(b, r) for b, r in zip(beliefs, records, strict=True) if b.accepted]
    assert len(sure) > 0.8 * len(records)
    assert all(sure)
