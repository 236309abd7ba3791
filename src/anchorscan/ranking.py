"""The best of a few values, in order, and the place of one value among many in order.

The best are inserted one by one: for the few that a query orders that takes no longer than to
sort them, and to compile numba's own sorting takes seconds.
"""

from __future__ import annotations

import numpy as np

from ._jit import kernel

__all__ = ["best_first", "first_from"]


@kernel
def best_first(values, most):  # type: ignore[no-untyped-def]
    """Indices of the ``most`` highest values, the highest first; of equals the first."""
    best = np.empty(min(most, len(values)), np.int64)
    found = 0
    for i in range(len(values)):
        if found < len(best):
            found += 1
        elif not values[i] > values[best[found - 1]]:
            continue
        k = found - 1
        while k > 0 and values[best[k - 1]] < values[i]:
            best[k] = best[k - 1]
            k -= 1
        best[k] = i
    return best


@kernel
def first_from(values, low, high, least):  # type: ignore[no-untyped-def]
    """First index from ``low`` up to ``high`` whose ascending value is not below ``least``."""
    while low < high:
        middle = (low + high) // 2
        if values[middle] < least:
            low = middle + 1
        else:
            high = middle
    return low
