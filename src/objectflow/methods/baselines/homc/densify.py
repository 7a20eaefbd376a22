"""Labels of sparse tracks to labels of every pixel: a vote of the nearest tracks, weighted by distance and colour.

The paper's authors fill in with a variational method (Ochs and Brox, ICCV 2011); this does the same on a grid of
tracks as dense as ours with a vote: near tracks count more, and tracks of the pixel's colour.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from objectflow.typing import Float32Array, Float64Array, Int64Array

VOTERS = 8
COLOR_SCALE = 10.0
"""Units of Lab (L in 0..100) at which a vote is down to 61%."""


def densify(at: Float64Array, labels: Int64Array, track_lab: Float64Array, lab: Float32Array) -> Int64Array:
    """Give every pixel a label.

    Args:
        at: (N, 2) where the tracks are, as (u, v) of the wanted image.
        labels: (N,) theirs, not negative.
        track_lab: (N, 3) their colours.
        lab: (H, W, 3) the image in Lab.

    Returns:
        (H, W); 0 where there is no track at all.
    """
    height, width = lab.shape[:2]
    if not len(at):
        return np.zeros((height, width), np.int64)
    v, u = np.mgrid[0:height, 0:width]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    count = min(VOTERS, len(at))
    distance, near = cKDTree(at).query(pixels, k=count)
    distance, near = np.asarray(distance).reshape(-1, count), np.asarray(near).reshape(-1, count)
    # Half the distance to the furthest voter is the scale: tracks lie further apart in large images.
    scale = np.maximum(distance[:, -1:], 1.0) / 2
    color = np.square(lab.reshape(-1, 1, 3) - track_lab[near]).sum(-1)
    log_votes = -np.square(distance / scale) / 2 - color / (2 * COLOR_SCALE**2)
    # Relative to the strongest, so that no pixel's votes all round to 0.
    votes = np.exp(log_votes - log_votes.max(1, keepdims=True))
    voted = labels[near]
    totals = np.stack([np.where(voted == voted[:, k : k + 1], votes, 0).sum(1) for k in range(count)], axis=1)
    return np.asarray(np.take_along_axis(voted, totals.argmax(1)[:, None], axis=1).reshape(height, width))
