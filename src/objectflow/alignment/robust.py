"""Robust statistics of many short arrays, for loops in which NumPy's general functions cost more than the work."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.typing import Float64Array


def median(values: NDArray[np.floating[Any]]) -> float:
    """The median of a vector without NaN, as `np.median` computes it; NaN where it is empty."""
    count = len(values)
    if not count:
        return float("nan")
    middle = count // 2
    if count % 2:
        return float(np.partition(values, middle)[middle])
    low, high = np.partition(values, (middle - 1, middle))[middle - 1 : middle + 1]
    return float((low + high) / 2)


def tukey_weights(residuals: NDArray[np.floating[Any]], limit: float) -> Float64Array:
    """Weights by Tukey's biweight: 1 at 0, and 0 from `limit` on."""
    scaled = np.asarray(residuals, dtype=np.float64) / limit
    np.multiply(scaled, scaled, out=scaled)
    np.subtract(1.0, scaled, out=scaled)
    np.maximum(scaled, 0.0, out=scaled)
    np.multiply(scaled, scaled, out=scaled)
    return scaled
