"""The relationship database against plain counting and a plain assignment."""

from __future__ import annotations

import functools
import math
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from anchorscan import database
from anchorscan.anchors import AnchorPoints
from anchorscan.database import DatabaseSettings, RelationshipDatabase, _frequent
from anchorscan.graph import AnchorGraph, GraphSettings, anchor_graph

TOLERANCE = 0.1


def graph_of(lengths):
    """Give a graph of which only the edge lengths matter."""
    lengths = np.sort(np.asarray(lengths, dtype=np.float64))
    count = len(lengths)
    anchors = AnchorPoints(np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0))
    return AnchorGraph(anchors, np.zeros((count, 2), np.int32), lengths)


def by_length(count_once=False):
    return DatabaseSettings(relation="length", length_tolerance=TOLERANCE, count_once=count_once)


def corresponds(a, b):
    return abs(a - float(np.float32(b))) <= TOLERANCE


def plain_pairs(query, reference):
    return sum(corresponds(a, b) for a in query for b in reference)


def plain_assignment(query, reference):
    """Size of the largest one-to-one assignment, by augmenting paths."""
    partner = {}

    def assign(a, seen):
        for k, b in enumerate(reference):
            if k not in seen and corresponds(query[a], b):
                seen.add(k)
                if k not in partner or assign(partner[k], seen):
                    partner[k] = a
                    return True
        return False

    return sum(assign(a, set()) for a in range(len(query)))


def plain_votes(query, references, count_once):
    count = plain_assignment if count_once else plain_pairs
    rows = []
    for identifier, graph in references.items():
        n = count(query.lengths, graph.lengths)
        pairs = len(query) * len(graph)
        rows.append((-(n * n / pairs if pairs else 0.0), identifier, n))
    return [(identifier, n, -q) for q, identifier, n in sorted(rows)]


def as_rows(votes):
    return list(
        zip(votes.references.tolist(), votes.counts.tolist(), votes.quality.tolist(), strict=True)
    )


lengths = st.lists(st.floats(0.0, 6.0).map(lambda v: round(v, 2)), max_size=12)


@given(lengths, st.lists(lengths, max_size=6), st.booleans())
def test_counts_and_quality_are_those_of_plain_counting(query, references, count_once):
    graphs = {10 * k: graph_of(each) for k, each in enumerate(references)}
    settings = by_length(count_once)
    votes = RelationshipDatabase(settings, graphs.items()).votes(graph_of(query))

    expected = plain_votes(graph_of(query), graphs, count_once)

    assert [row[:2] for row in as_rows(votes)] == [row[:2] for row in expected]
    assert votes.quality.tolist() == pytest.approx([row[2] for row in expected])
    for (identifier, _, q_m), lone in ((row, graphs[row[0]]) for row in as_rows(votes)):
        alone = database.quality(graph_of(query).lengths, lone.lengths, TOLERANCE, count_once)
        assert (identifier, alone) == (identifier, q_m)


@given(lengths, st.lists(lengths, max_size=8), st.integers(1, 9))
def test_the_best_few_are_the_first_of_all(query, references, most):
    settings = by_length()
    graphs = [(k, graph_of(each)) for k, each in enumerate(references)]
    searched = RelationshipDatabase(settings, graphs)

    few = searched.votes(graph_of(query), most)

    assert as_rows(few) == as_rows(searched.votes(graph_of(query)))[:most]


@given(lengths.filter(bool))
def test_counted_once_a_graph_corresponds_fully_to_itself(each):
    settings = by_length(True)
    votes = RelationshipDatabase(settings, [(3, graph_of(each))]).votes(graph_of(each))

    assert votes.quality.tolist() == [1.0]


@given(lengths, st.permutations(range(5)))
def test_the_order_of_the_references_does_not_matter(query, order):
    rng = np.random.default_rng(2)
    graphs = [(k, graph_of(rng.uniform(0, 6, 5).round(1))) for k in range(5)]
    settings = by_length()

    straight = RelationshipDatabase(settings, graphs).votes(graph_of(query))
    shuffled = RelationshipDatabase(settings, [graphs[k] for k in order]).votes(graph_of(query))

    assert as_rows(straight) == as_rows(shuffled)


@functools.cache
def some_spacings(seed):
    return np.random.default_rng(seed + 1).integers(0, 1 << 63, 3).astype(np.uint64)


def plain_likeness(one, other):
    """Cosine of bits, the larger of both ways that the axes may correspond."""
    x, y, backs = (f"{int(word):064b}" for word in one)
    turned = (int(y, 2), int(x, 2), int(backs[32:] + backs[:32], 2))
    shared = max(
        sum((int(a) & int(b)).bit_count() for a, b in zip(way, other, strict=True))
        for way in (one, turned)
    )
    sizes = [sum(int(word).bit_count() for word in words) for words in (one, other)]
    return shared / math.sqrt(sizes[0] * sizes[1]) if all(sizes) else 0.0


@pytest.mark.parametrize("count", [60, 300])
def test_spacings_choose_as_plain_comparing_does(count):
    rng = np.random.default_rng(count)
    graphs = [(k, graph_of(rng.uniform(0.0, 6.0, 12))) for k in rng.permutation(count).tolist()]
    # Many are equal in everything: of these the lower identifiers are taken.
    saw = {k: some_spacings(k % 7) if k % 5 else np.zeros(3, np.uint64) for k, _ in graphs}
    graphs = [(k, graphs[k % 3][1]) for k, _ in graphs]
    searched = RelationshipDatabase(by_length(), graphs, [saw[k] for k, _ in graphs])
    query, own = graphs[0][1], some_spacings(3)
    everything = searched.votes(query)
    score = {
        k: 0.15 * math.log(q + 1e-6) + plain_likeness(own, saw[k])
        for k, q in zip(everything.references.tolist(), everything.quality.tolist(), strict=True)
    }
    for most in (1, 9, 50):
        expected = sorted(score, key=lambda k: (-round(score[k], 9), k))[:most]
        assert set(searched.votes(query, most, own).references.tolist()) == set(expected)


@pytest.mark.parametrize("looks", [1, 2])
def test_spacings_choose_only_from_those_of_the_most_votes(looks):
    rng = np.random.default_rng(4)
    graphs = [(k, graph_of(rng.uniform(0.0, 6.0, 12))) for k in range(300)]
    settings = by_length().model_copy(update={"shortlisted": 40})
    searched = RelationshipDatabase(settings, graphs, map(some_spacings, range(300)))
    query, own = graph_of(rng.uniform(0.0, 6.0, 12)), some_spacings(299)
    everything = searched.votes(query)
    chosen = searched.votes(query, 10, own, looks)
    # Those that are about as good as the last one may be among them.
    assert chosen.counts.min() >= 0.99 * np.sort(everything.counts)[-40 // looks]
    assert set(chosen.references.tolist()) - set(everything.references[:10].tolist())
    assert np.all(np.diff(chosen.quality) <= 0.0)


@given(st.lists(st.integers(0, 3000), min_size=1, max_size=300), st.integers(1, 60))
def test_no_count_that_is_left_out_is_larger_than_one_that_is_chosen(counts, most):
    counts = np.array(counts, np.float32) / np.float32(256.0)
    chosen = _frequent(counts, most)
    others = np.delete(counts, chosen)
    assert len(set(chosen.tolist())) == len(chosen) >= min(most, len(counts))
    assert others.max(initial=-1.0) <= counts[chosen].min()
    # Beyond those asked for, only such as are about as large as the last of these.
    last = np.sort(counts)[::-1][: min(most, len(counts))][-1]
    assert counts[chosen].min() >= last - counts.max() / 4000.0


def test_there_are_as_many_spacings_as_references():
    graphs = [(k, graph_of([1.0])) for k in range(3)]
    with pytest.raises(ValueError, match="3 references have 2 spacings"):
        RelationshipDatabase(by_length(), graphs, map(some_spacings, range(2)))


class ChangingDatabase(RuleBasedStateMachine):
    """Adding and removing in any order leaves what building at once would have made."""

    settings = by_length()

    def __init__(self):
        super().__init__()
        self.database = RelationshipDatabase(self.settings)
        self.model = {}
        self.query = self.graph(1)
        self.next = 0
        self.expected = None

    @staticmethod
    def graph(seed):
        return graph_of(np.random.default_rng(seed).uniform(0.0, 6.0, seed % 13))

    @rule(seed=st.integers(0, 1 << 20))
    def add(self, seed):
        self.model[self.next] = self.graph(seed)
        self.database.add(self.next, self.model[self.next], some_spacings(self.next))
        self.next += 1
        self.expected = None

    @precondition(lambda self: self.model)
    @rule(data=st.data())
    def remove(self, data):
        identifier = data.draw(st.sampled_from(sorted(self.model)))
        del self.model[identifier]
        self.database.remove(identifier)
        self.expected = None

    @rule()
    def write_and_read(self):
        arrays = self.database.arrays()
        for array in arrays.values():
            array.flags.writeable = False  # as if mapped from a file
        self.database = RelationshipDatabase.from_arrays(self.settings, arrays)

    @invariant()
    def votes_as_built_at_once(self):
        if self.expected is None:
            spacings = map(some_spacings, self.model)
            at_once = RelationshipDatabase(self.settings, self.model.items(), spacings)
            self.expected = self.votes(at_once)
        assert self.votes(self.database) == self.expected
        assert len(self.database) == len(self.model)

    def votes(self, searched):
        chosen = (self.query,), (self.query, 3), (self.query, 3, some_spacings(-1))
        return [as_rows(searched.votes(*each)) for each in chosen]


class ChangingLargeDatabase(ChangingDatabase):
    """The same with so small parts that they are merged, and what is removed stays a while."""

    def __init__(self):
        super().__init__()
        self.before = database._SMALLEST_PART
        database._SMALLEST_PART = 12

    def teardown(self):
        database._SMALLEST_PART = self.before


class ChangingOrientedDatabase(ChangingDatabase):
    """The same with relations that know more than a length."""

    settings = DatabaseSettings()

    @staticmethod
    def graph(seed):
        rng = np.random.default_rng(seed)
        count = 5 + seed % 4
        anchors = AnchorPoints(
            np.round(rng.uniform(-2.0, 2.0, (count, 2))),
            rng.integers(3, 5, count),
            np.zeros(count),
            0.0,
        )
        return anchor_graph(anchors, GraphSettings())


TestChangingDatabase = ChangingDatabase.TestCase
TestChangingLargeDatabase = ChangingLargeDatabase.TestCase
TestChangingOrientedDatabase = ChangingOrientedDatabase.TestCase


def oriented_graph(seed):
    return ChangingOrientedDatabase.graph(seed)


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("keys", lambda a: a[::-1].copy()),
        ("keys", lambda a: a.astype(np.int64)),
        ("starts", lambda a: a[:-1]),
        ("starts", lambda a: a + np.uint32(1)),
        ("postings", lambda a: a + np.uint32(4 * 100)),
        ("postings", lambda a: a[:-1]),
        ("sizes", lambda a: a[:-1]),
        ("sizes", lambda a: -a - 1),
        ("identifiers", np.zeros_like),
        ("identifiers", lambda a: None),
        ("spacings", lambda a: a[:-1]),
        ("spacings", lambda a: a.astype(np.int64)),
        ("spacings", lambda a: None),
        ("slots", lambda a: a + np.int32(100)),
        ("slots", lambda a: a - np.int32(100)),
        ("lengths", lambda a: a[::-1].copy()),
        ("lengths", lambda a: None),
    ],
)
def test_arrays_that_do_not_fit_together_are_refused(name, changed):
    for settings in (by_length(), DatabaseSettings()):
        graphs = [(k, oriented_graph(k)) for k in range(6)]
        arrays = RelationshipDatabase(settings, graphs).arrays()
        assert as_rows(
            RelationshipDatabase.from_arrays(settings, arrays).votes(graphs[2][1])
        ) == as_rows(RelationshipDatabase(settings, graphs).votes(graphs[2][1]))
        if name not in arrays:
            continue
        arrays[name] = changed(arrays[name])
        with pytest.raises(ValueError, match=r"arrays|identifier"):
            RelationshipDatabase.from_arrays(settings, arrays)


def test_arrays_of_another_relation_are_refused():
    arrays = RelationshipDatabase(by_length(), [(1, oriented_graph(3))]).arrays()
    with pytest.raises(ValueError, match="missing"):
        RelationshipDatabase.from_arrays(DatabaseSettings(), arrays)


def test_what_is_removed_later_does_not_change_the_arrays_that_were_given():
    searched = RelationshipDatabase(DatabaseSettings(), [(k, oriented_graph(k)) for k in range(9)])
    arrays = searched.arrays()
    before = {name: array.tobytes() for name, array in arrays.items()}
    for k in range(9):
        searched.remove(k)
        searched.add(100 + k, oriented_graph(50 + k))
    assert {name: array.tobytes() for name, array in arrays.items()} == before


def test_an_identifier_is_taken_once():
    searched = RelationshipDatabase(DatabaseSettings(), [(4, graph_of([1.0]))])
    with pytest.raises(ValueError, match="4"):
        searched.add(4, graph_of([2.0]))
    with pytest.raises(ValueError, match="identifier"):
        RelationshipDatabase(DatabaseSettings(), [(1, graph_of([])), (1, graph_of([]))])
    with pytest.raises(KeyError):
        searched.remove(5)
    assert 4 in searched
    assert 5 not in searched


def test_real_graphs_are_counted_as_plain_counting_does(real_records):
    from anchorscan.anchors import AnchorSettings, anchor_points

    records = real_records("freiburg-101.log.gz")[::15]
    graphs = {
        record.index: anchor_graph(anchor_points(record.scan, AnchorSettings()), GraphSettings())
        for record in records
    }
    query = graphs.pop(records[7].index)
    for count_once in (False, True):
        settings = by_length(count_once)
        votes = RelationshipDatabase(settings, graphs.items()).votes(query)
        expected = plain_votes(query, graphs, count_once)
        assert [row[:2] for row in as_rows(votes)] == [row[:2] for row in expected]


def test_searching_goes_on_while_references_come_and_go():
    rng = np.random.default_rng(1)
    fixed = [(k, graph_of(rng.uniform(0, 20, 30))) for k in range(40)]
    searched = RelationshipDatabase(by_length(), fixed)
    query = graph_of(rng.uniform(0, 20, 30))
    expected = {row[0]: row[1] for row in as_rows(searched.votes(query))}
    stop = threading.Event()
    wrong = []

    def search():
        while not stop.is_set():
            got = {row[0]: row[1] for row in as_rows(searched.votes(query))}
            wrong.extend(k for k in expected if got.get(k) != expected[k])

    searcher = threading.Thread(target=search)
    searcher.start()
    for k in range(1000, 1600):
        searched.add(k, graph_of(rng.uniform(0, 20, 30)))
        if k % 3:
            searched.remove(k)
    stop.set()
    searcher.join()
    assert not wrong
