"""Dense labels from sparse tracks by a vote of the nearest tracks, weighted by distance and colour.

The paper uses a variational method (Ochs and Brox, ICCV 2011); for a grid of tracks this dense, a vote suffices.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from objectflow.typing import Float32Array, Float64Array, Int64Array

VOTERS = 8
"""Number of tracks that vote for a pixel's label."""
COLOR_SCALE = 10.0
"""Standard deviation of the colour weight, units of Lab (L in 0..100)."""


def densify(positions: Float64Array, labels: Int64Array, track_lab: Float64Array, lab: Float32Array) -> Int64Array:
    """Label every pixel.

    Args:
        positions: (N, 2) pixels (u, v) of the tracks.
        labels: (N,) labels of the tracks, not negative.
        track_lab: (N, 3) colours of the tracks.
        lab: (H, W, 3) the image in Lab.

    Returns:
        (H, W) labels; all 0 if there are no tracks.
    """
    height, width = lab.shape[:2]
    if not len(positions):
        return np.zeros((height, width), np.int64)
    v, u = np.mgrid[0:height, 0:width]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    count = min(VOTERS, len(positions))
    distance, nearest = cKDTree(positions).query(pixels, k=count)
    distance, nearest = np.asarray(distance).reshape(-1, count), np.asarray(nearest).reshape(-1, count)
    # The scale is half the distance to the furthest voter, because tracks are further apart in large images.
    scale = np.maximum(distance[:, -1:], 1.0) / 2
    color = np.square(lab.reshape(-1, 1, 3) - track_lab[nearest]).sum(-1)
    log_votes = -np.square(distance / scale) / 2 - color / (2 * COLOR_SCALE**2)
    # Normalised by the largest vote, so that a pixel's votes do not all underflow to 0.
    votes = np.exp(log_votes - log_votes.max(1, keepdims=True))
    voted = labels[nearest]
    totals = np.stack([np.where(voted == voted[:, k : k + 1], votes, 0).sum(1) for k in range(count)], axis=1)
    return np.asarray(np.take_along_axis(voted, totals.argmax(1)[:, None], axis=1).reshape(height, width))
