"""Beyond the paper: a scan without anchor points may stand wherever the map is free.

Relations need anchor points, and a scan of smooth walls, or of a laser that sees a few metres,
may show none.  The paper has no answer to it.  Here it is laid on every place around the
references that their rays passed, headed so that its main walls run along those of the nearest
reference, and a dozen readings tell which of these poses may be right.

That finds what relations cannot, and it is fair: a pose is an answer only where no other place
explains the scan as well, which takes a look at the other places.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ._jit import kernel
from .proposal import Proposals, ProposalSettings, checked
from .tiles import Tiles, is_clear

__all__ = ["Places", "places", "standing"]

# Places lie on a grid, and so far from references at most, metres.
_STEP = 0.3
_AROUND = 4.0
# A laser stands so far from all surfaces at least, metres.
_CLEAR = 0.15
_QUARTERS = np.linspace(0.0, 2.0 * math.pi, 4, endpoint=False, dtype=np.float64)
# Headings that are tried where no main walls are known.
_HEADINGS = np.linspace(0.0, 2.0 * math.pi, 36, endpoint=False, dtype=np.float64)
# Of more poses than this, which take ten milliseconds, some are tried.
_MOST = 1 << 17


class Places(NamedTuple):
    """Where a scan may have been taken.

    Args:
        positions: (N, 2) metres, in the set's frame.
        main_angles: (N,) of the main walls around, radians in the set's frame; NaN where there
            are none.
    """

    positions: NDArray[np.float64]
    main_angles: NDArray[np.float64]


def places(poses: NDArray[np.float64], main_angles: NDArray[np.float64], tiles: Tiles) -> Places:
    """List the positions of references, and behind them the free places of the map around them.

    Args:
        poses: (C, 3) ``T_set_laser`` of the references, metres and radians.
        main_angles: (C,) of their scans, radians; NaN for none.
        tiles: The map stitched from them.
    """
    positions, nearest = _around(poses)
    clear = _are_clear(positions, tiles)
    walls = main_angles + poses[:, 2]
    return Places(
        np.concatenate([poses[:, :2], positions[clear]]),
        np.concatenate([walls, walls[nearest[clear]]]),
    )


def standing(
    known: Places,
    main_angle: float,
    points: NDArray[np.float64],
    tiles: Tiles,
    settings: ProposalSettings,
) -> Proposals:
    """Propose the places at which the map explains most of a few readings.

    Args:
        known: The places that come into question.
        main_angle: Of the scan, radians; NaN for none.
        points: (N, 2) or (N, 3) readings of the scan to check with, see ``proposal.checked``.
        tiles: The map.
        settings: How many readings and proposals.

    Returns:
        Proposals; where the readings fit nowhere the first places, those of references, by
        themselves.
    """
    turns = known.main_angles - main_angle
    headings = np.where(np.isfinite(turns), len(_QUARTERS), len(_HEADINGS))
    step = -(-int(headings.sum()) // _MOST) or 1
    positions, turns = known.positions[::step], turns[::step]
    along = np.isfinite(turns)
    poses = np.concatenate(
        [
            _headed(positions[along], turns[along], _QUARTERS),
            _headed(positions[~along], np.zeros(np.count_nonzero(~along)), _HEADINGS),
        ]
    )
    proposed = checked(poses, points, tiles, settings)
    if len(proposed.poses):
        return proposed
    first = poses[: settings.most]
    return Proposals(first, np.zeros(len(first)), len(poses))


def _headed(
    positions: NDArray[np.float64], turns: NDArray[np.float64], headings: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(P, 3) poses at every position, turned to every heading."""
    theta = turns[:, np.newaxis] + headings
    return np.column_stack((np.repeat(positions, len(headings), axis=0), theta.ravel()))


def _around(poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(N, 2) positions of the grid around poses, in order, and (N,) the pose nearest to each."""
    cells, nearest = _cells_around(poses / _STEP, _AROUND / _STEP)
    order = np.lexsort(cells.T)
    return cells[order] * _STEP, nearest[order]


@kernel
def _cells_around(poses, reach):  # type: ignore[no-untyped-def]
    """Cells no farther from poses than ``reach``, all in cells, and the pose nearest to each."""
    wide = int(math.ceil(reach))
    slots = 64
    while slots < 2 * len(poses) * (2 * wide + 2) ** 2:
        slots *= 2
    cells = np.empty((slots, 2), np.int64)
    nearest = np.full(slots, -1)
    far = np.empty(slots)
    for n in range(len(poses)):
        x, y = poses[n, 0], poses[n, 1]
        for v in range(int(math.floor(y)) - wide, int(math.floor(y)) + wide + 2):
            for u in range(int(math.floor(x)) - wide, int(math.floor(x)) + wide + 2):
                away = (u - x) * (u - x) + (v - y) * (v - y)
                if away > reach * reach:
                    continue
                slot = (u * 73856093 ^ v * 19349663) & (slots - 1)
                while nearest[slot] >= 0 and (cells[slot, 0] != u or cells[slot, 1] != v):
                    slot = (slot + 1) & (slots - 1)
                if nearest[slot] < 0 or away < far[slot]:
                    cells[slot, 0], cells[slot, 1] = u, v
                    nearest[slot], far[slot] = n, away
    taken = np.flatnonzero(nearest >= 0)
    return cells[taken], nearest[taken]


@kernel
def _are_clear(positions, tiles):  # type: ignore[no-untyped-def]
    """Whether a laser may stand at each of (N, 2) positions."""
    clear = np.empty(len(positions), np.bool_)
    for k in range(len(positions)):
        clear[k] = is_clear(positions[k, 0], positions[k, 1], tiles, _CLEAR)
    return clear
