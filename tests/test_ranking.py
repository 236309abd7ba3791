"""Values come in the order that sorting gives them."""

from __future__ import annotations

import bisect

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from anchorscan.ranking import ascending, best_first, first_from


@given(st.lists(st.integers(-9, 9), max_size=60), st.integers(1, 40))
def test_the_highest_values_come_first_and_of_equals_the_first(values, most):
    expected = sorted(range(len(values)), key=lambda k: (-values[k], k))[:most]
    assert best_first(np.array(values, float), most).tolist() == expected


@given(
    st.lists(
        st.integers(-9, 9).map(float) | st.floats(0.0, 1e300) | st.floats(0.0, 1e-300), max_size=60
    )
)
def test_values_are_put_in_order_and_equals_stay_as_they_came(values):
    values = np.array(values, float)
    assert ascending(values).tolist() == np.argsort(values, kind="stable").tolist()


@given(st.lists(st.integers(-9, 9), max_size=60), st.integers(-10, 10), st.data())
def test_the_first_value_that_is_not_below_is_where_bisection_finds_it(values, least, data):
    ordered = np.sort(np.array(values, float))
    low = data.draw(st.integers(0, len(values)))
    high = data.draw(st.integers(low, len(values)))
    assert first_from(ordered, low, high, least) == bisect.bisect_left(ordered, least, low, high)
