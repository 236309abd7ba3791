"""Where something was over time, from a topic or a file, read off at the time of a scan."""

from __future__ import annotations

import math
from array import array

import numpy as np
from numpy.typing import NDArray

from .spatial import matrix_of

__all__ = ["Trajectory"]

# Between samples further apart than this nobody knows how the robot went, seconds.
_LONGEST_GAP = 0.5
# A scan this much before the first or after the last sample belongs to it, seconds.
_REACH = 0.05
_SAMPLE = 8


class Trajectory:
    """Samples of ``T_target_source`` over time, in any order of arrival.

    A sample is kept as eight numbers; a day at 50 Hz is 276 MB, an hour 12 MB.
    """

    def __init__(self) -> None:
        self._samples = array("d")
        self._sorted: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self._samples) // _SAMPLE

    def add(self, stamp: float, sample: tuple[float, ...]) -> bool:
        """Add ``x y z qx qy qz qw`` at a time in seconds; False where it is no motion."""
        numbers = (stamp, *sample)
        if not all(map(math.isfinite, numbers)) or not any(sample[3:]):
            return False
        self._samples.extend(numbers)
        self._sorted = None
        return True

    @property
    def span(self) -> tuple[float, float] | None:
        """Times of the first and the last sample, seconds."""
        samples = self._in_order()
        return (float(samples[0, 0]), float(samples[-1, 0])) if len(samples) else None

    def at(self, stamp: float | None) -> NDArray[np.float64] | None:
        """Return the (4, 4) motion at a time, None where no samples near it tell.

        Between two samples the translation is interpolated linearly and the rotation along the
        shorter arc.

        Args:
            stamp: Seconds.
        """
        samples = self._in_order()
        if stamp is None or not len(samples):
            return None
        after = int(np.searchsorted(samples[:, 0], stamp))
        if after == len(samples) or (after == 0 and samples[0, 0] != stamp):
            nearest = samples[min(after, len(samples) - 1)]
            return matrix_of(nearest[1:]) if abs(nearest[0] - stamp) <= _REACH else None
        later = samples[after]
        if later[0] == stamp:
            return matrix_of(later[1:])
        earlier = samples[after - 1]
        if later[0] - earlier[0] > _LONGEST_GAP:
            nearest = earlier if stamp - earlier[0] < later[0] - stamp else later
            return matrix_of(nearest[1:]) if abs(nearest[0] - stamp) <= _REACH else None
        share = (stamp - earlier[0]) / (later[0] - earlier[0])
        return matrix_of(_between(earlier[1:], later[1:], share))

    def _in_order(self) -> NDArray[np.float64]:
        if self._sorted is None:
            samples = np.array(self._samples, dtype=np.float64).reshape(-1, _SAMPLE)
            samples = samples[np.argsort(samples[:, 0], kind="stable")]
            self._sorted = samples
        return self._sorted


def _between(a: NDArray[np.float64], b: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    first, second = a[3:] / np.linalg.norm(a[3:]), b[3:] / np.linalg.norm(b[3:])
    # q and -q are one rotation; the near one gives the shorter arc.
    cosine = float(first @ second)
    second, cosine = (-second, -cosine) if cosine < 0.0 else (second, cosine)
    angle = math.acos(min(1.0, cosine))
    if angle < 1e-6:
        rotation = first
    else:
        rotation = math.sin((1 - share) * angle) * first + math.sin(share * angle) * second
    return np.concatenate(((1 - share) * a[:3] + share * b[:3], rotation))
