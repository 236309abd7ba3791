"""Covariances of poses: inverses as linear algebra gives them, and shares as samples do."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from anchorscan.covariance import held, inverses


@given(seed=st.integers(0, 2**32 - 1))
def test_inverses_are_those_of_linear_algebra(seed: int) -> None:
    roots = np.random.default_rng(seed).normal(0.0, 0.3, (6, 3, 3))
    matrices = roots @ roots.transpose(0, 2, 1) + 0.01 * np.eye(3)
    out = inverses(matrices)
    assert np.allclose(out, np.linalg.inv(matrices), rtol=1e-6)
    assert np.array_equal(out, out.transpose(0, 2, 1))


@given(
    deviations=st.tuples(*[st.floats(0.01, 3.0)] * 3),
    turn=st.floats(-3.0, 3.0),
)
@settings(max_examples=25)
def test_what_is_held_is_the_share_of_the_covariance_that_counts_as_correct(
    deviations: tuple[float, float, float], turn: float
) -> None:
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    spread: NDArray[np.float64] = np.diag(np.square(deviations))
    samples = np.random.default_rng(0).standard_normal((20_000, 3)) * deviations
    limits = (0.5, 0.5, math.radians(10.0))
    expected = float(np.mean((np.abs(samples) <= limits).all(axis=1)))
    assert held(rotation @ spread @ rotation.T) == pytest.approx(expected, abs=0.015)


def test_a_pose_that_is_exact_is_held_and_one_that_is_not_is_not() -> None:
    assert held(np.zeros((3, 3))) == 1.0
    assert held(np.diag([25.0, 1e-4, 1e-6])) < 0.1
    assert held(np.diag([1e-4, 1e-4, 1.0])) < 0.2
