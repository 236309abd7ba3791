"""The best of a few values, in order, all of some hundred, and the place of one in order.

The best are inserted one by one: for the few that a query orders that takes no longer than to
sort them, and to compile numba's own sorting takes seconds, which does not sort some hundred any
faster.
"""

from __future__ import annotations

import numpy as np

from ._jit import kernel

__all__ = ["ascending", "best_first", "first_from"]


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
def ascending(values):  # type: ignore[no-untyped-def]
    """Indices of finite values in ascending order; equals as they came.

    They are dealt into as many bins as there are values, and then inserted: bins that are about
    as full as each other, as those of lengths are, leave hardly anything to move.
    """
    count = len(values)
    order = np.empty(count, np.int64)
    bins = np.zeros(count, np.int64)
    starts = np.zeros(count + 1, np.int64)
    least = values.min() if count > 0 else 0.0
    span = values.max() - least if count > 0 else 0.0
    for i in range(count if span > 0.0 else 0):
        bins[i] = int((values[i] - least) / span * (count - 1))
    for i in range(count):
        starts[bins[i] + 1] += 1
    for k in range(count):
        starts[k + 1] += starts[k]
    for i in range(count):
        order[starts[bins[i]]] = i
        starts[bins[i]] += 1
    for n in range(1, count):
        i, k = order[n], n
        while k > 0 and values[order[k - 1]] > values[i]:
            order[k] = order[k - 1]
            k -= 1
        order[k] = i
    return order


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
