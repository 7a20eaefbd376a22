"""Depth-guided upsampling from a baseline's working size to its input size, without mixing surfaces."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from objectflow.typing import Float32Array

_SURFACE = 0.02
"""Relative depth difference at which a neighbour's weight is 1/e."""


def upsample_guided(values: Float32Array, small_depth: Float32Array, large_depth: Float32Array) -> Float32Array:
    """Interpolate maps to another size between neighbours on the same surface.

    Args:
        values: (h, w, C), known where `small_depth` is.
        small_depth: (h, w) metres, 0 = missing.
        large_depth: (H, W) metres, 0 = missing; it may also be smaller.

    Returns:
        (H, W, C) float32. Pixels without a neighbour on their surface take the nearest known value, or 0 if there is
        none. Values at pixels without depth are undefined.
    """
    known = small_depth > 0
    if not known.any():
        return np.zeros((*large_depth.shape, values.shape[2]), np.float32)
    (height, width), (rows, columns) = small_depth.shape, large_depth.shape
    v = np.clip((np.arange(rows) + 0.5) * height / rows - 0.5, 0, height - 1)[:, None]
    u = np.clip((np.arange(columns) + 0.5) * width / columns - 0.5, 0, width - 1)[None]
    v0, u0 = np.minimum(v.astype(int), max(height - 2, 0)), np.minimum(u.astype(int), max(width - 2, 0))
    total = np.zeros(large_depth.shape, np.float32)
    out = np.zeros((*large_depth.shape, values.shape[2]), np.float32)
    for down in (0, 1):
        for right in (0, 1):
            row, column = np.minimum(v0 + down, height - 1), np.minimum(u0 + right, width - 1)
            bilinear = (v - v0 if down else 1 - (v - v0)) * (u - u0 if right else 1 - (u - u0))
            distance = np.abs(small_depth[row, column] - large_depth) / (_SURFACE * np.maximum(large_depth, 1e-6))
            weight = (bilinear * known[row, column] * np.exp(-np.minimum(distance, 50))).astype(np.float32)
            total += weight
            out += weight[..., None] * values[row, column]
    row, column = np.rint(v).astype(int), np.rint(u).astype(int)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    fallback = values[nearest[0][row, column], nearest[1][row, column]]
    weak = total < 1e-6
    return np.where(weak[..., None], fallback, out / np.where(weak, 1, total)[..., None]).astype(np.float32)
