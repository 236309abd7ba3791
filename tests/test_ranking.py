"""The best of a few values come as sorting gives them."""

from __future__ import annotations

import bisect

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from anchorscan.ranking import best_first, first_from


@given(st.lists(st.integers(-9, 9), max_size=60), st.integers(1, 40))
def test_the_highest_values_come_first_and_of_equals_the_first(values, most):
    expected = sorted(range(len(values)), key=lambda k: (-values[k], k))[:most]
    assert best_first(np.array(values, float), most).tolist() == expected


@given(st.lists(st.integers(-9, 9), max_size=60), st.integers(-10, 10), st.data())
def test_the_first_value_that_is_not_below_is_where_bisection_finds_it(values, least, data):
    ordered = np.sort(np.array(values, float))
    low = data.draw(st.integers(0, len(values)))
    high = data.draw(st.integers(low, len(values)))
    assert first_from(ordered, low, high, least) == bisect.bisect_left(ordered, least, low, high)
