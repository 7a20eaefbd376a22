"""Robust statistics against NumPy and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from objectflow.alignment.robust import median, tukey_weights


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 101, 1000])
def test_the_median_is_that_of_numpy(count: int, dtype: type) -> None:
    values = np.random.default_rng(count).normal(size=count).astype(dtype)
    before = values.copy()
    assert median(values) == float(np.median(values))
    np.testing.assert_array_equal(values, before)


def test_the_median_of_nothing_is_not_a_number() -> None:
    assert math.isnan(median(np.zeros(0)))


def test_weights_fall_from_one_to_zero_at_the_limit() -> None:
    weights = tukey_weights(np.array([0.0, 1.0, -1.0, 2.0, -2.0, 7.0], np.float32), 2.0)
    np.testing.assert_allclose(weights, [1, 0.5625, 0.5625, 0, 0, 0])  # (1 - (r / 2)^2)^2
    assert weights.dtype == np.float64
