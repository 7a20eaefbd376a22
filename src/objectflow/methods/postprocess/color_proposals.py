"""Positions where an object may have been: peaks of its colours in the previous frame (histogram back-projection)."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow.methods.postprocess.search_likelihood import SearchLikelihood
from objectflow.typing import Float32Array, Float64Array, IndexArray

_FULL_WEIGHT_RATIO = 8.0
"""Ratio of a colour's frequency in the object to that in the image from which it has full weight."""
_UNCHANGED_WEIGHT = 0.3
"""Weight of a pixel that did not change: an object that moved was not there."""
_BINS = (8, 16, 16)


def propose_positions(
    frames: SearchLikelihood, points: Float32Array, appearance: Float32Array, max_positions: int
) -> Float64Array:
    """Peaks of the object's colours, at about its size, in the previous frame (Swain and Ballard 1991).

    Args:
        frames: both frames.
        points: (N, 3) metres of the object in the current frame.
        appearance: (N, 3), theirs in `frames.curr_appearance`.
        max_positions: maximum number of positions.

    Returns:
        (P, 3) metres, the best first: possible positions of the points' centre in the previous frame.
    """
    scene = _bins(frames.prev_appearance)
    count = int(np.prod(_BINS))
    in_scene, own = (np.bincount(one.ravel(), minlength=count) for one in (scene, _bins(appearance)))
    ratio = (own / max(1, own.sum())) * (scene.size / np.maximum(in_scene, 1))
    likely = np.minimum(ratio / _FULL_WEIGHT_RATIO, 1).astype(np.float32)[scene]
    likely[~frames.changed] *= _UNCHANGED_WEIGHT
    center = points.mean(axis=0, dtype=np.float64)
    size = float(np.sqrt(np.square(points[:, :2] - center[:2]).sum(axis=1).mean()))
    blur = max(1.0, 0.7 * size / float(np.median(points[:, 2])) * frames.camera.fx)
    heat = cv2.GaussianBlur(likely, (0, 0), blur)
    heat[np.isnan(frames.prev_points[..., 2])] = 0
    around = cv2.dilate(heat, np.ones((2 * int(max(1.0, 0.7 * blur)) + 1,) * 2, np.uint8))
    rows, columns = np.nonzero((heat >= around) & (heat > 0))
    best = np.argsort(-heat[rows, columns], kind="stable")[:max_positions]
    surface = frames.prev_points[rows[best], columns[best]].astype(np.float64)
    # The centre lies as far behind the surface as it does in the current frame.
    nearest = np.argsort(np.square(points[:, :2] - center[:2]).sum(axis=1))[:5]
    behind = center[2] - float(np.median(points[nearest, 2]))
    return np.asarray(surface * (1 + behind / surface[:, 2:]))


def _bins(appearance: Float32Array) -> IndexArray:
    """Histogram bins of appearance; most colours lie in the middle half of the colour axes of CIELAB."""
    steps = np.array([8.0, 8.0, 8.0], np.float32)
    low = np.array([0.0, 64.0, 64.0], np.float32)
    cells = np.clip((appearance - low) / steps, 0, np.array(_BINS) - 1).astype(np.intp)
    return np.asarray((cells[..., 0] * _BINS[1] + cells[..., 1]) * _BINS[2] + cells[..., 2])
