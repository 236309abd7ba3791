"""Logistic regression: what numbers say of whether an answer is right."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["logistic_regression"]

_STEPS = 50


def logistic_regression(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    weights: NDArray[np.float64],
    ridge: float,
) -> NDArray[np.float64]:
    """Fit coefficients by Newton's method.

    Args:
        x: (N, C) numbers of each answer; a column of ones gives a constant.
        y: (N,) one for right answers, zero for wrong ones.
        weights: (N,) of the answers.
        ridge: Added to the curvature along every coefficient.

    Returns:
        (C,) coefficients.
    """
    coefficients = np.zeros(x.shape[1])
    for _ in range(_STEPS):
        # Bounded, so that separable samples do not run away between steps.
        p = 1.0 / (1.0 + np.exp(-np.clip(x @ coefficients, -30.0, 30.0)))
        gradient = x.T @ (weights * (p - y)) + ridge * coefficients
        curvature = (x.T * (weights * np.maximum(p * (1.0 - p), 1e-6))) @ x
        step = np.linalg.solve(curvature + ridge * np.eye(x.shape[1]), gradient)
        step *= min(1.0, 2.0 / max(float(np.abs(step).max()), 1e-12))
        coefficients = coefficients - step
        if float(np.abs(step).max()) < 1e-9:
            break
    return coefficients
