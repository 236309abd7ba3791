"""The best of a few values come as sorting gives them."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from anchorscan.ranking import best_first


@given(st.lists(st.integers(-9, 9), max_size=60), st.integers(1, 40))
def test_the_highest_values_come_first_and_of_equals_the_first(values, most):
    expected = sorted(range(len(values)), key=lambda k: (-values[k], k))[:most]
    assert best_first(np.array(values, float), most).tolist() == expected
