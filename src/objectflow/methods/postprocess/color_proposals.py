"""Positions where an object may have been: peaks of its colours in the previous frame (histogram back-projection)."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow.methods.postprocess.search_likelihood import SearchLikelihood
from objectflow.methods.postprocess.search_settings import ColorProposalSettings
from objectflow.typing import Float32Array, Float64Array, IndexArray

_BINS = (8, 16, 16)
"""Number of histogram bins in weighted lightness and in the two colour channels."""
DEFAULTS = ColorProposalSettings()


def propose_positions(
    frames: SearchLikelihood,
    points: Float32Array,
    appearance: Float32Array,
    max_positions: int,
    settings: ColorProposalSettings = DEFAULTS,
) -> Float64Array:
    """Peaks of the object's colours, at about its size, in the previous frame (Swain and Ballard 1991).

    Args:
        frames: both frames.
        points: (N, 3) metres of the object in the current frame.
        appearance: (N, 3), theirs in `frames.curr_appearance`.
        max_positions: maximum number of positions.
        settings: see there.

    Returns:
        (P, 3) metres, the best first: possible positions of the points' centre in the previous frame.
    """
    scene, wanted = (_bins(one, settings.bin_width) for one in (frames.prev_appearance, appearance))
    in_scene, own = (np.bincount(one.ravel(), minlength=int(np.prod(_BINS))) for one in (scene, wanted))
    ratio = (own / max(1, own.sum())) * (scene.size / np.maximum(in_scene, 1))
    likely = np.minimum(ratio / settings.full_weight_ratio, 1).astype(np.float32)[scene]
    likely[~frames.changed] *= settings.unchanged_weight
    center = points.mean(axis=0, dtype=np.float64)
    size = float(np.sqrt(np.square(points[:, :2] - center[:2]).sum(axis=1).mean()))
    blur = max(1.0, settings.blur_ratio * size / float(np.median(points[:, 2])) * frames.camera.fx)
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


def _bins(appearance: Float32Array, width: float) -> IndexArray:
    """Histogram bins of appearance, around the neutral colours in the middle of the colour axes of 8-bit CIELAB."""
    low = np.array([0.0, *(128 - width * count / 2 for count in _BINS[1:])], np.float32)
    cells = np.clip((appearance - low) / np.float32(width), 0, np.array(_BINS) - 1).astype(np.intp)
    return np.asarray((cells[..., 0] * _BINS[1] + cells[..., 1]) * _BINS[2] + cells[..., 2])
