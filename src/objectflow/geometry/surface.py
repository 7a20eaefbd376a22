"""The centre of an object's visible surface: the point at which displacements are measured everywhere."""

from __future__ import annotations

import numpy as np

from objectflow.typing import Float32Array, Float64Array, LabelImage


def surface_centers(points: Float32Array, labels: LabelImage) -> dict[int, Float64Array]:
    """The mean of the points of each label.

    Args:
        points: (H, W, 3) metres, NaN where depth is missing.
        labels: (H, W) int32, 0 = background.

    Returns:
        label -> (3,) metres, in the frame of the points; labels without depth are left out.
    """
    inside = (labels > 0) & np.isfinite(points[..., 2])
    owner = labels[inside]
    counts = np.bincount(owner)
    own = points[inside]
    sums = np.stack([np.bincount(owner, weights=own[:, axis]) for axis in range(3)], axis=1)
    return {int(label): np.asarray(sums[label] / counts[label]) for label in np.flatnonzero(counts)}
