"""What the readings of a scan are worth at a pose, by the cells of the map that they end in."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ._jit import inlined, kernel
from .tiles import look_up, room_for

__all__ = ["Weights", "better_score", "field_scores", "score_of"]


class Weights(NamedTuple):
    """What readings are worth by the byte of the cell in which they end.

    Args:
        scores: (256,) float32, one at most.
        is_new: (256,) whether a small thing there would be new.
        share: A reading on a new thing counts as this share of one.
        price: What new things leave unexplained counts as so many times as much.
    """

    scores: NDArray[np.float32]
    is_new: NDArray[np.bool_]
    share: float
    price: float


@kernel
def field_scores(poses, readings, tiles, weights):  # type: ignore[no-untyped-def]
    """(P,) score of readings (scan frame) at each of (P, 3) poses.

    Readings are (N, 3): x, y and 1 for those on small things.
    """
    scores = np.empty(len(poses))
    room = room_for(readings)
    small = np.flatnonzero(readings[:, 2] > 0.0)
    for p in range(len(poses)):
        scores[p] = score_of(look_up(poses[p], room, tiles), small, weights)
    return scores


@inlined
def score_of(codes, small, weights):  # type: ignore[no-untyped-def]
    """Score of readings that end in cells of such codes; ``small`` ones are on small things."""
    total, held_against, new = 0.0, 0.0, 0
    for code in codes:
        total += weights.scores[code]
    for i in small:
        if weights.is_new[codes[i]]:
            held_against += weights.scores[codes[i]]
            new += 1
    return better_score(total, len(codes), held_against, new, weights)


@kernel
def better_score(total, count, held_against, new, weights):  # type: ignore[no-untyped-def]
    """Mean score of readings, in the world as it was or in one with new things.

    A small thing in known free space, as a person is, may be new, and then its readings are not
    held against the pose: they score nothing and count less.  But that explains more at any
    pose, so that what it leaves unexplained has a price.

    ``total`` is the sum of the scores of all ``count`` readings, ``held_against`` of the ``new``.
    """
    if count == 0:
        return 0.0
    as_it_was = total / count
    if new == 0:
        return as_it_was
    with_new = (total - held_against) / (count - (1.0 - weights.share) * new)
    return max(as_it_was, 1.0 - weights.price * (1.0 - with_new))
