"""Twists by iteratively reweighted least squares with the Cauchy loss."""

from __future__ import annotations

import numpy as np

from objectflow.typing import Float32Array, Float64Array

_ITERATIONS = 10
_CHI2_RATIO = 0.98
"""Iterations stop when the weighted sum of squares decreases by less than 2%."""
_MIN_STEP = 1e-6
"""Iterations stop when the twist (m, rad) changes by less."""
_MIN_PIXELS = 6
"""Minimum number of pixels for an estimate."""


def solve_twist(
    J: Float32Array, r: Float32Array, repeats: Float32Array | None, cauchy: float, *, least_squares_start: bool
) -> Float64Array:
    """Minimise the Cauchy loss of `J twist - r`.

    Args:
        J: (N, 2, 6) weighted rows.
        r: (N, 2).
        repeats: (N,) multiplicity of each pixel, or None for 1.
        cauchy: the weight of a residual e is 1 / (1 + k e^2) with k = cauchy / mean(|e|)^2, updated per iteration.
        least_squares_start: start from the least-squares solution instead of 0.

    Returns:
        (6,) float64 [translation, rotation], metres and radians; 0 if there are too few pixels.
    """
    if len(J) < _MIN_PIXELS:
        return np.zeros(6)
    A, b = J.reshape(-1, 6), r.reshape(-1)
    times: Float32Array = np.ones(len(b), np.float32) if repeats is None else np.repeat(repeats, 2).astype(np.float32)
    twist = _least_squares(A, b, times) if least_squares_start else np.zeros(6)
    last = np.inf
    for _ in range(_ITERATIONS):
        error = A @ twist.astype(np.float32) - b
        mean = max(1e-5, float(np.average(np.abs(error), weights=times)))
        weights = (1 / (1 + np.float32(cauchy / mean**2) * error**2)).astype(np.float32)
        chi2 = float((weights * times) @ error**2)
        new = _least_squares(A, b, weights * times)
        step, twist = np.abs(new - twist).max(), new
        if chi2 > _CHI2_RATIO * last or step < _MIN_STEP:
            break
        last = max(chi2, 1e-10)
    return twist


def _least_squares(A: Float32Array, b: Float32Array, weights: Float32Array) -> Float64Array:
    # The pseudo-inverse of the 6x6 normal equations leaves unconstrained directions at 0.
    weighted = A * weights[:, None]
    normal, right = (weighted.T @ A).astype(np.float64), (weighted.T @ b).astype(np.float64)
    return np.asarray(np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ right)
