"""The answer: where the scan may have been taken, how well that fits, and how likely it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .pose import Pose2D

__all__ = ["Hypothesis"]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One possible place of a scan (sections 4.2 and 5 of the paper).

    Args:
        reference: Identifier of the reference scan that it was aligned with.
        pose_in_reference: ``T_reference_laser``, metres and radians.
        pose: ``T_set_laser``; None when the set has no common frame.
        covariance: (3, 3) of x, y (metres) and theta (radians), in the frame of ``pose``
            (of ``pose_in_reference`` where that is None).
        evaluation: e_m of section 5, in [0, 1].
        quality: q_m of section 4.1 of the reference.
        score: What the hypotheses of one query are ordered by; comparable within one preset.
        probability: That the pose is right, in [0, 1].
        accepted: Whether the probability reaches the shipped threshold.
    """

    reference: int
    pose_in_reference: Pose2D
    pose: Pose2D | None
    covariance: NDArray[np.float64]
    evaluation: float
    quality: float
    score: float
    probability: float
    accepted: bool
