"""Scene flow without the motion of the camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from objectflow import geometry
from objectflow.motion.object_motion import ObjectMotion
from objectflow.typing import Float32Array, Float64Array, LabelImage

ROUNDING = 1e-5
"""Metres: a smaller displacement is the rounding of single precision and becomes 0."""


def own_flow(
    flow: Float32Array,
    points: Float32Array,
    labels: LabelImage,
    objects: Sequence[ObjectMotion],
    camera_motion: Float64Array | None,
) -> Float32Array:
    """The previous minus the current position of each point in the world, in the current camera frame.

    Args:
        flow: (H, W, 3) scene flow in metres, NaN where depth is missing.
        points: (H, W, 3) metres, current camera frame; used only if the camera moved.
        labels: (H, W) int32.
        objects: of the labels; those that are not moving have a flow of 0.
        camera_motion: (4, 4) `prev_T_curr` of the static background, None for a static camera.

    Returns:
        (H, W, 3) float32 metres: 0 for what stands still, NaN where depth is missing.
    """
    own = flow.copy()
    if camera_motion is not None:
        own = (geometry.transform(geometry.inverse(camera_motion), points + flow) - points).astype(np.float32)
    # Reductions over an axis of three are many times slower than the same by component.
    u, v, w = (flow[..., k] for k in range(3))
    known = np.isfinite(u) & np.isfinite(v) & np.isfinite(w)
    is_static = np.zeros(int(labels.max(initial=0)) + 1, np.bool_)
    is_static[[obj.id for obj in objects if not obj.moving and obj.id < len(is_static)]] = True
    with np.errstate(invalid="ignore"):
        u, v, w = (np.abs(own[..., k]) for k in range(3))
        still = is_static[labels] | (np.maximum(np.maximum(u, v), w) < ROUNDING)
    own[known & still] = 0
    own[~known] = np.nan
    return own
