"""The answer: where the scan may have been taken, how well that fits, and how likely it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .pose import Pose2D

__all__ = ["Hypothesis", "state_of"]


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
        ambiguous: Whether this is one of two or more places that explain the scan alike: none is
            accepted, and the first would be without the others.  Of single scans that are
            searched as one map; a belief over time has its ``state``.
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
    ambiguous: bool = False


def state_of(hypotheses: Sequence[Hypothesis]) -> Literal["located", "ambiguous", "unknown"]:
    """Say in a word what the hypotheses of one scan amount to.

    Args:
        hypotheses: Best first.
    """
    if hypotheses and hypotheses[0].accepted:
        return "located"
    return "ambiguous" if hypotheses and hypotheses[0].ambiguous else "unknown"
