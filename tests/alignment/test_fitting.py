"""Truncated costs of motions on matches, against a loop over motions; more matches than a block holds."""

from __future__ import annotations

import numpy as np
import pytest

from objectflow import geometry
from objectflow.alignment.fitting import truncated_costs


@pytest.mark.parametrize("count", [3, 500, 20000])
def test_truncated_costs_are_those_of_a_loop(count: int) -> None:
    rng = np.random.default_rng(0)
    curr = rng.normal(size=(count, 3)).astype(np.float32)
    prev = curr + rng.normal(scale=0.05, size=curr.shape).astype(np.float32)
    sigma = rng.uniform(0.01, 0.05, count)
    motions = geometry.make_transform(
        geometry.so3_exp(rng.normal(scale=0.05, size=(40, 3))), rng.normal(scale=0.05, size=(40, 3))
    )
    expected = []
    for motion in motions:
        moved = curr.astype(np.float64) @ motion[:3, :3].T + motion[:3, 3]
        expected.append(np.minimum(((moved - prev) ** 2).sum(axis=1) / sigma**2, 9.0).sum())
    np.testing.assert_allclose(truncated_costs(motions, curr, prev, sigma, 9.0), expected, rtol=1e-9)
