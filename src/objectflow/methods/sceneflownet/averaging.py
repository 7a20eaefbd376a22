"""The '+Rig' step: one rigid motion per object, the mean of its pixels' predictions (section V of the paper)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.errors import GeometryError
from objectflow.geometry.moved import STATIC_DISPLACEMENT, is_moving
from objectflow.motion import ObjectMotion
from objectflow.typing import Float64Array, LabelImage


def average_motions(
    labels: LabelImage,
    rotation: NDArray[Any],
    translation: NDArray[Any],
    center: NDArray[Any],
    *,
    confidence: NDArray[Any],
    still: float = STATIC_DISPLACEMENT,
) -> tuple[ObjectMotion, ...]:
    """Average X, T and the rotation over the pixels of each object.

    Args:
        labels: (H, W) int32, 0 = background.
        rotation: (H, W, 3) axis-angle in radians, from `curr` to `prev`.
        translation, center: (H, W, 3) metres: T and X.
        confidence: (H, W) 0..1, for example the foreground probability; an object's score is its mean.
        still: displacement threshold in metres. An object moves if the displacement of its centre exceeds it, or the
            displacement by rotation of a point 5 cm (the radius of a small object) from the centre does.

    Returns:
        One object per label, in ascending order. The flow of its pixels is `geometry.flow_from_motions` of its
        `prev_T_curr`.

    Raises:
        GeometryError: the sizes of the maps differ, or the prediction at a labelled pixel is not finite.
    """
    shape = (*labels.shape, 3)
    if any(values.shape != shape for values in (rotation, translation, center)) or confidence.shape != labels.shape:
        raise GeometryError(f"averaging needs (H, W, 3) maps and (H, W) confidence of the labels' size {labels.shape}")
    inside = labels > 0
    # Pixels are sorted by object, so that the sum over an object is the sum over a slice.
    owner = labels[inside]
    order = np.argsort(owner, kind="stable")
    ids, starts, counts = np.unique(owner[order], return_index=True, return_counts=True)
    if not len(ids):
        return ()
    vectors, shifts, centers = (
        np.asarray(values[inside][order], dtype=np.float64) for values in (rotation, translation, center)
    )
    probability = np.asarray(confidence[inside][order], dtype=np.float64)
    if not (np.isfinite(vectors).all() and np.isfinite(shifts).all() and np.isfinite(centers).all()):
        raise GeometryError(
            "averaging needs finite predictions at every labelled pixel: set the label of other pixels to 0"
        )

    def mean(values: Float64Array) -> Float64Array:
        return np.asarray(np.add.reduceat(values, starts) / counts.reshape(-1, *[1] * (values.ndim - 1)))

    X, T = mean(centers), mean(shifts)
    R = mean_rotation(mean(geometry.so3_exp(vectors)))
    score = np.clip(mean(probability), 0, 1)
    moving = is_moving(R, T, still)
    # P_prev = R (P - X) + X + T
    prev_T_curr = geometry.make_transform(R, X + T - (R @ X[..., None])[..., 0])
    return tuple(
        ObjectMotion(
            id=int(ids[k]),
            pixels=int(counts[k]),
            score=float(score[k]),
            moving=bool(moving[k]),
            center=X[k],
            prev_T_curr=prev_T_curr[k],
        )
        for k in range(len(ids))
    )


def mean_rotation(matrix_mean: Float64Array) -> Float64Array:
    """Compute the chordal mean of rotations: the rotation nearest to the mean of their matrices.

    It minimises the sum of squared Frobenius distances (Hartley et al. 2013, section 5.1). Unlike the mean of
    axis-angle vectors, it is not affected by their wrap-around at 180 degrees.

    Args:
        matrix_mean: (..., 3, 3) elementwise mean (or sum) of rotation matrices.

    Returns:
        (..., 3, 3) rotations. If the rotations cancel out, the minimiser is not unique and one of them is returned.
    """
    return geometry.nearest_rotation(matrix_mean)[0]
