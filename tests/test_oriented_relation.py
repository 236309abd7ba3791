"""Oriented relations against plain counting, and what must not change what they count."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anchorscan import oriented_relation
from anchorscan.anchors import AnchorPoints, AnchorSettings, anchor_points
from anchorscan.database import DatabaseSettings, RelationshipDatabase
from anchorscan.graph import GraphSettings, anchor_graph
from anchorscan.oriented_relation import EdgesByKey, OrientedRelation, OrientedSettings

SETTINGS = OrientedSettings(most_edges=10_000)


def graph_of(anchors):
    return anchor_graph(anchors, GraphSettings())


def random_anchors(seed, count=None, main_angle=None):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 12)) if count is None else count
    return AnchorPoints(
        rng.uniform(-8.0, 8.0, (count, 2)),
        rng.integers(0, 5, count),
        rng.uniform(-math.pi, math.pi, count),
        rng.uniform(0.0, 0.5 * math.pi) if main_angle is None else main_angle,
    )


def moved(anchors, x, y, turn):
    """Give the same anchor points as another sensor pose sees them."""
    c, s = math.cos(turn), math.sin(turn)
    main = math.fmod(anchors.main_angle + turn, 0.5 * math.pi)
    return AnchorPoints(
        anchors.positions @ np.array([[c, s], [-s, c]]) + (x, y),
        anchors.kinds,
        np.angle(np.exp(1j * (anchors.directions + turn))),
        main + (0.5 * math.pi if main < 0.0 else 0.0),
    )


def jittered(anchors, seed, size=0.03):
    rng = np.random.default_rng(seed)
    shift = rng.normal(0.0, size, anchors.positions.shape)
    return AnchorPoints(
        anchors.positions + shift, anchors.kinds, anchors.directions, anchors.main_angle
    )


# A plain twin of the relation.


def directions_in_walls(anchors):
    return anchors.directions - anchors.main_angle


def vector_in_walls(anchors, a, b):
    # Rounded as in the kernel: an edge along a wall lies at the border of two cells.
    c, s = math.cos(anchors.main_angle), math.sin(anchors.main_angle)
    dx, dy = anchors.positions[b] - anchors.positions[a]
    return np.array([c * dx + s * dy, c * dy - s * dx])


def folded(kinds, sectors, cell):
    (i, j), turns = cell, 0
    while i < 0 or j < 0:
        i, j, turns = j, -1 - i, turns + 1
    return (*kinds, *((sector - 2 * turns) % 8 for sector in sectors), i, j), turns


def sector_of(direction, off=0.0):
    return math.floor(direction * 8.0 / (2.0 * math.pi) + 0.5 + off)


def is_used(vector):
    return SETTINGS.shortest_edge <= np.hypot(*vector) <= SETTINGS.longest_edge


def plain_keys(anchors):
    directions = directions_in_walls(anchors)
    kinds = anchors.kinds.tolist()
    keys = set()
    for n, m in itertools.combinations(range(len(kinds)), 2):
        a, b = (n, m) if kinds[n] <= kinds[m] else (m, n)
        vector = vector_in_walls(anchors, a, b)
        if is_used(vector):
            sectors = (sector_of(directions[a]), sector_of(directions[b]))
            cell = tuple(math.floor(v / SETTINGS.cell) for v in vector)
            keys.add(folded((kinds[a], kinds[b]), sectors, cell))
    return keys


def plain_cells(anchors):
    directions = directions_in_walls(anchors)
    kinds = anchors.kinds.tolist()
    near, cell = SETTINGS.position_tolerance, SETTINGS.cell
    wide = SETTINGS.direction_tolerance * 8.0 / (2.0 * math.pi)
    for a, b in itertools.permutations(range(len(kinds)), 2):
        vector = vector_in_walls(anchors, a, b)
        if kinds[a] > kinds[b] or not is_used(vector):
            continue
        spans = [
            range(math.floor((v - near) / cell), math.floor((v + near) / cell) + 1) for v in vector
        ]
        arcs = [
            range(sector_of(directions[k], -wide), sector_of(directions[k], wide) + 1)
            for k in (a, b)
        ]
        for i, j, p, q in itertools.product(*spans, *arcs):
            share = 1.0
            for k, v in zip((i, j), vector, strict=True):
                share *= min((k + 1) * cell, v + near) - max(k * cell, v - near)
            share /= min(cell, 2.0 * near) ** 2
            yield (*folded((kinds[a], kinds[b]), (p, q), (i, j)), share)


def plain_counts(query, references):
    known = {identifier: plain_keys(anchors) for identifier, anchors in references.items()}
    edges = sum(
        is_used(query.positions[b] - query.positions[a])
        for a, b in itertools.combinations(range(len(query)), 2)
    )
    unit = min(256, max(1, 30_000 // max(edges, 1)))
    counts = {identifier: np.zeros(4) for identifier in references}
    for key, turns, share in plain_cells(query):
        postings = [(n, t) for n, keys in known.items() for k, t in keys if k == key]
        for identifier, other in postings:
            rarity = math.log1p(len(known) / len(postings)) / math.log1p(len(known))
            counts[identifier][(other - turns) % 4] += round(rarity * share * unit)
    return {identifier: each.max() / unit for identifier, each in counts.items()}


def votes(query, references, settings=SETTINGS, most=None):
    graphs = [(identifier, graph_of(anchors)) for identifier, anchors in references.items()]
    database = RelationshipDatabase(DatabaseSettings(oriented=settings), graphs)
    return database.votes(graph_of(query), most)


def as_dict(votes):
    return dict(zip(votes.references.tolist(), votes.counts.tolist(), strict=True))


@given(st.integers(0, 1 << 30), st.integers(1, 6))
def test_counts_are_those_of_plain_counting(seed, count):
    query = random_anchors(seed)
    references = {
        k: jittered(query, k) if k % 2 else random_anchors(seed + k) for k in range(count)
    }
    assert as_dict(votes(query, references)) == pytest.approx(
        plain_counts(query, references), abs=0.03
    )


def test_real_graphs_are_counted_as_plain_counting_does(real_records):
    records = real_records("intel.log.gz")[::60]
    anchors = {r.index: anchor_points(r.scan, AnchorSettings()) for r in records}
    query = anchors.pop(records[5].index)
    assert as_dict(votes(query, anchors)) == pytest.approx(plain_counts(query, anchors), abs=0.03)


@given(st.integers(0, 1 << 30), st.floats(-9.0, 9.0), st.floats(-9.0, 9.0), st.floats(-3.1, 3.1))
def test_where_the_sensor_stood_does_not_matter(seed, x, y, turn):
    query = random_anchors(seed, 8)
    references = {k: jittered(query, k) for k in range(3)}
    here, there = votes(query, references), votes(moved(query, x, y, turn), references)
    # A vector at the very border of its tolerance may fall to either side, with little share.
    assert as_dict(there) == pytest.approx(as_dict(here), abs=0.1)


@given(st.integers(0, 1 << 30), st.floats(-3.1, 3.1))
def test_a_scan_corresponds_fully_to_itself_and_hardly_to_its_mirror_image(seed, turn):
    query = random_anchors(seed, 9)
    mirrored = AnchorPoints(
        query.positions * (1.0, -1.0), query.kinds, -query.directions, -query.main_angle % 1.5707
    )
    found = votes(moved(query, 1.0, 2.0, turn), {1: mirrored, 2: query})
    count = as_dict(found)
    assert found.references[0] == 2
    edges = OrientedRelation(SETTINGS).size(graph_of(query))
    assert count[2] > 0.5 * edges  # less than all: a vector may lie in the corner of its cell
    assert count[1] < 0.2 * edges


def test_a_rare_relation_counts_more_than_one_that_all_references_have():
    pair = AnchorPoints(np.array([[0.0, 0.0], [3.07, 0.07]]), np.array([2, 3]), np.zeros(2), 0.0)
    other = AnchorPoints(np.array([[0.0, 0.0], [2.02, 4.57]]), np.array([0, 1]), np.zeros(2), 0.0)
    both = AnchorPoints(
        np.concatenate([pair.positions, other.positions + 40.0]),
        np.concatenate([pair.kinds, other.kinds]),
        np.zeros(4),
        0.0,
    )
    references = dict.fromkeys(range(20), pair) | {20: other}
    count = as_dict(votes(both, references))
    assert count[20] > 3.0 * count[0] > 0.0


def test_of_many_edges_all_references_keep_the_same():
    few = OrientedRelation(OrientedSettings(most_edges=20))
    crowd = random_anchors(3, 30)
    kept, _ = few.edges([graph_of(crowd)], 0)
    other, _ = few.edges([graph_of(moved(crowd, 3.0, 4.0, 0.5))], 0)
    assert len(kept) == len(other) == 20
    assert len(set(kept.keys.tolist()) & set(other.keys.tolist())) >= 18
    everything, _ = OrientedRelation(SETTINGS).edges([graph_of(crowd)], 0)
    assert set(kept.keys.tolist()) < set(everything.keys.tolist())


@pytest.mark.parametrize("most", [1, 40, 200, 100_000])
def test_no_more_database_edges_are_looked_at_than_allowed_and_rare_ones_first(most, monkeypatch):
    query = random_anchors(5, 8)
    references = [jittered(query, k) if k else query for k in range(30)]
    graphs = [graph_of(each) for each in (*references, random_anchors(77, 12))]
    relation = OrientedRelation(OrientedSettings(most_edges=10_000, most_votes=most))
    edges, _ = relation.edges(graphs, 0)
    looked_at = []

    def vote(postings, keys, opening, unit, scratch, count):
        looked_at.append(keys[0][:, 1] - keys[0][:, 0])
        return count

    monkeypatch.setattr(oriented_relation, "_vote", vote)
    relation.met(graph_of(query), [edges], len(graphs), len(graphs))
    taken = looked_at[0]
    assert taken.sum() <= most
    relation = OrientedRelation(OrientedSettings(most_edges=10_000))
    relation.met(graph_of(query), [edges], len(graphs), len(graphs))
    everything = looked_at[1]
    assert np.all(np.diff(everything) >= 0)
    # The rarest ones, all that are as rare as each other or none.
    assert everything[: len(taken)].tolist() == taken.tolist()
    left = everything[len(taken) :]
    assert not len(left) or not len(taken) or taken[-1] < left[0]
    assert (len(left) == 0) == (most == 100_000)


@given(st.integers(0, 1 << 30), st.integers(1, 400), st.integers(1, 200))
def test_two_looks_share_the_work_of_one(seed, most, opening):
    query = random_anchors(seed, 7)
    graphs = [graph_of(jittered(query, k, 0.1)) for k in range(12)]
    allowed = {"most_edges": 10_000, "most_votes": 2 * most, "most_opening": 2 * opening}
    half = allowed | {"most_votes": most, "most_opening": opening}
    found = []
    for settings, looks in ((allowed, 2), (half, 1)):
        relation = OrientedRelation(OrientedSettings(**settings))
        edges, _ = relation.edges(graphs, 0)
        slots, counts = relation.met(graph_of(query), [edges], 12, 12, looks)
        found.append(dict(zip(slots.tolist(), counts.tolist(), strict=True)))
    assert found[0] == found[1]


@given(st.integers(0, 1 << 30), st.integers(1, 400))
def test_what_the_rarest_keys_meet_is_counted_in_full_and_nothing_else(seed, opening):
    query = random_anchors(seed, 7)
    references = {
        k: jittered(query, k, 0.1) if k % 2 else random_anchors(seed + k) for k in range(12)
    }
    fewer = OrientedSettings(most_edges=10_000, most_opening=opening)
    count, full = as_dict(votes(query, references, fewer)), as_dict(votes(query, references))
    missed = [k for k in full if count[k] != full[k]]
    assert all(count[k] == 0.0 for k in missed)
    # Before the rarest edge that one has in common with the scan, enough others were looked at.
    known = {k: [key for key, _ in plain_keys(anchors)] for k, anchors in references.items()}
    cells = []
    for key, _, share in plain_cells(query):
        having = [keys.count(key) for keys in known.values()]
        if any(having):
            worth = math.log1p(12 / sum(having)) / math.log1p(12) * share * 256
            cells.append((sum(having), worth, having))
    for k in missed:
        rarest = min(found for found, worth, having in cells if having[k] and worth > 0.6)
        assert sum(found for found, worth, _ in cells if found <= rarest) >= opening


@given(st.integers(0, 1 << 30), st.integers(0, 30), st.sampled_from([1, 4000]))
def test_slots_far_apart_are_counted_as_plain_counting_does(seed, opening, heaviest):
    rng = np.random.default_rng(seed)
    crowd = rng.integers(0, 200_000, 40)  # of several blocks
    lists = [
        sorted(set((4 * rng.choice(crowd, n) + rng.integers(0, 4, n)).tolist()))
        for n in rng.integers(0, 20, 30)
    ]
    ends = np.cumsum([len(each) for each in lists])
    ranges = np.column_stack([ends - [len(each) for each in lists], ends]).astype(np.int64)
    turns = rng.integers(0, 4, 30).astype(np.uint8)
    weights = rng.integers(1, heaviest + 1, 30).astype(np.uint16)
    tallies = {}
    for c, postings in enumerate(lists):
        for posting in postings:
            if c < opening or posting >> 2 in tallies:
                tally = tallies.setdefault(posting >> 2, [0, 0, 0, 0])
                turn = (posting - int(turns[c])) % 4
                tally[turn] = min(tally[turn] + int(weights[c]), 65_535)
    relation = OrientedRelation(SETTINGS)
    scratch = relation._scratch_of(200_000)
    postings = np.array([each for some in lists for each in some], np.uint32)
    for begun in (0, 5):  # and it leaves nothing behind
        count = oriented_relation._vote(
            postings, (ranges, turns, weights), opening, 0.5, scratch, begun
        )
        found = zip(scratch.slots[begun:count].tolist(), scratch.counts[begun:count], strict=True)
        assert dict(found) == {slot: 0.5 * max(tally) for slot, tally in tallies.items()}


pairs = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 30)), max_size=60)


def part_of(rows, first=0):
    rows = [(key, posting + 4 * first) for key, posting in rows]
    keys, postings = np.array(rows, np.uint32).reshape(-1, 2).T
    return EdgesByKey.of(keys, postings)


def rows_of(part):
    keys = np.repeat(part.keys, np.diff(part.starts.astype(np.int64)))
    return list(zip(keys.tolist(), part.postings.tolist(), strict=True))


@given(pairs, pairs)
def test_merging_is_sorting_all_together(one, two):
    merged = part_of(one).merged(part_of(two, first=8))
    both = sorted([*one, *((key, posting + 32) for key, posting in two)])
    assert rows_of(merged) == both
    assert len(merged) == len(both)
    assert merged.keys.tolist() == sorted({key for key, _ in both})


@given(pairs, st.lists(st.booleans(), min_size=8, max_size=8))
def test_renumbering_leaves_out_the_dead(rows, alive):
    numbers = np.where(alive, np.cumsum(alive) - 1, -1).astype(np.int32)
    expected = [(k, int(numbers[p >> 2]) << 2 | (p & 3)) for k, p in sorted(rows) if alive[p >> 2]]
    assert rows_of(part_of(rows).renumbered(numbers)) == expected


@given(pairs, st.lists(st.integers(0, 1 << 20)), st.integers(0, 20))
def test_the_postings_of_a_key_are_found(rows, wanted, shift):
    part = part_of([(key << shift, posting) for key, posting in rows])
    wanted = np.array([*wanted, *(key << shift for key, _ in rows)], np.uint32)
    for key, (begin, end) in zip(wanted.tolist(), part.ranges(wanted).tolist(), strict=True):
        expected = sorted(posting for k, posting in rows if k << shift == key)
        assert part.postings[begin:end].tolist() == expected
