"""Twists by iteratively reweighted least squares with the Cauchy penalty."""

from __future__ import annotations

import numpy as np

from objectflow.typing import Float32Array, Float64Array

_ITERATIONS = 10
_CHI2_RATIO = 0.98
"""Stop when the weighted sum of squares falls by less than 2 %."""
_STEP = 1e-6
"""Stop when no number of the twist (m, rad) changes by more."""
_FEWEST = 6
"""Pixels: fewer say nothing about a motion."""


def solve_twist(
    J: Float32Array, r: Float32Array, repeats: Float32Array | None, cauchy: float, *, plain_start: bool
) -> Float64Array:
    """The twist (6,) that minimises the Cauchy penalty of `J twist - r`.

    Args:
        J: (N, 2, 6) rows, weighted.
        r: (N, 2).
        repeats: (N,) how often each pixel counts; None is once.
        cauchy: weights are 1 / (1 + k e^2) of residuals e with k = cauchy / mean(|e|)^2, found anew each time.
        plain_start: begin with the least-squares solution instead of no motion.

    Returns:
        (6,) float64 [translation, rotation], metres and radians; 0 where there are too few pixels.
    """
    if len(J) < _FEWEST:
        return np.zeros(6)
    A, b = J.reshape(-1, 6), r.reshape(-1)
    times: Float32Array = np.ones(len(b), np.float32) if repeats is None else np.repeat(repeats, 2).astype(np.float32)
    twist = _least_squares(A, b, times) if plain_start else np.zeros(6)
    last = np.inf
    for _ in range(_ITERATIONS):
        error = A @ twist.astype(np.float32) - b
        mean = max(1e-5, float(np.average(np.abs(error), weights=times)))
        weights = (1 / (1 + np.float32(cauchy / mean**2) * error**2)).astype(np.float32)
        chi2 = float((weights * times) @ error**2)
        new = _least_squares(A, b, weights * times)
        step, twist = np.abs(new - twist).max(), new
        if chi2 > _CHI2_RATIO * last or step < _STEP:
            break
        last = max(chi2, 1e-10)
    return twist


def _least_squares(A: Float32Array, b: Float32Array, weights: Float32Array) -> Float64Array:
    # By the normal equations, as 6x6 is quick; the pseudo-inverse leaves undetermined directions at rest.
    weighted = A * weights[:, None]
    normal, right = (weighted.T @ A).astype(np.float64), (weighted.T @ b).astype(np.float64)
    return np.asarray(np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ right)
