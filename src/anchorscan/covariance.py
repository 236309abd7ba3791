"""Covariance of a pose: from its information, and what it leaves within reach of the truth."""

from __future__ import annotations

import math

import numpy as np

from ._jit import kernel
from .protocol import CORRECT_HEADING, CORRECT_POSITION

__all__ = ["held", "inverses"]


@kernel
def inverses(matrices):  # type: ignore[no-untyped-def]
    """Inverse of every symmetric (K, 3, 3) matrix, symmetric by construction."""
    out = np.empty(matrices.shape)
    for k in range(len(matrices)):
        h = matrices[k]
        a, b, c, d, e, f = h[0, 0], h[0, 1], h[0, 2], h[1, 1], h[1, 2], h[2, 2]
        p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
        s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
        determinant = a * p + b * q + c * r
        out[k, 0, 0], out[k, 1, 1], out[k, 2, 2] = p / determinant, s / determinant, u / determinant
        out[k, 0, 1] = out[k, 1, 0] = q / determinant
        out[k, 0, 2] = out[k, 2, 0] = r / determinant
        out[k, 1, 2] = out[k, 2, 1] = t / determinant
    return out


@kernel
def held(covariance):  # type: ignore[no-untyped-def]
    """How likely a pose of (3, 3) covariance is to be within 0.5 m and 10 degrees.

    Position along the two axes of its ellipse, and heading, taken as independent.
    """
    a, b, d = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    mean, spread = 0.5 * (a + d), math.hypot(0.5 * (a - d), b)
    variances = (mean + spread, max(mean - spread, 0.0), covariance[2, 2])
    limits = (CORRECT_POSITION, CORRECT_POSITION, CORRECT_HEADING)
    share = 1.0
    for k in range(3):
        if variances[k] > 0.0:
            share *= math.erf(limits[k] / math.sqrt(2.0 * variances[k]))
    return share
