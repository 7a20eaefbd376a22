"""The '+Rig' step: one rigid motion an object, the mean of what its pixels predict (section V of the paper)."""

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
    """Average X, T and the rotation over each object's pixels.

    Args:
        labels: (H, W) int32, 0 = background.
        rotation: (H, W, 3) axis-angle in radians, from `curr` to `prev`.
        translation, center: (H, W, 3) metres: T and X.
        confidence: (H, W) 0..1, such as the mask's probability of foreground; its mean is an object's score.
        still: metres; an object moves if its centre does by more, or a point 5 cm off, a small object's radius, by
            its rotation.

    Returns:
        An object for each label that occurs, by rising label. The flow of its pixels is
        `geometry.flow_from_motions` of their `prev_T_curr`.

    Raises:
        GeometryError: maps of different sizes, or labelled pixels whose prediction is not finite.
    """
    shape = (*labels.shape, 3)
    if any(one.shape != shape for one in (rotation, translation, center)) or confidence.shape != labels.shape:
        raise GeometryError(f"averaging needs (H, W, 3) maps and an (H, W) confidence on labels {labels.shape}")
    inside = labels > 0
    # Object after object, so that sums over them are sums over slices.
    owner = labels[inside]
    order = np.argsort(owner, kind="stable")
    ids, starts, counts = np.unique(owner[order], return_index=True, return_counts=True)
    if not len(ids):
        return ()
    vectors, shifts, centers = (
        np.asarray(one[inside][order], dtype=np.float64) for one in (rotation, translation, center)
    )
    sure = np.asarray(confidence[inside][order], dtype=np.float64)
    if not (np.isfinite(vectors).all() and np.isfinite(shifts).all() and np.isfinite(centers).all()):
        raise GeometryError("averaging needs finite predictions on every labelled pixel: label the others 0")

    def mean(values: Float64Array) -> Float64Array:
        return np.asarray(np.add.reduceat(values, starts) / counts.reshape(-1, *[1] * (values.ndim - 1)))

    X, T = mean(centers), mean(shifts)
    R = mean_rotation(mean(geometry.so3_exp(vectors)))
    score = np.clip(mean(sure), 0, 1)
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
    """The chordal mean of rotations from the mean of their matrices: the rotation nearest to it.

    It minimises the summed squared Frobenius distances (Hartley et al. 2013, section 5.1). Unlike a mean of axis-angle
    vectors it does not depend on where those vectors wrap around, at half a turn.

    Args:
        matrix_mean: (..., 3, 3), the elementwise mean (or sum) of rotation matrices.

    Returns:
        (..., 3, 3) rotations. Where the rotations cancel out, one of the many minimisers.
    """
    return geometry.nearest_rotation(matrix_mean)[0]
