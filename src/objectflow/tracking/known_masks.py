"""Masks of the known objects in one frame: each object's region, and the label of every pixel."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from objectflow.tracking.model_fit import FrameView
from objectflow.tracking.surface_model import SurfaceModel
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage


def moving_region(
    view: FrameView, model: SurfaceModel | None, pose: Float64Array, mask: BoolMask, others: Sequence[BoolMask]
) -> tuple[BoolMask, Float32Array]:
    """Where a moving object is seen, and its depth.

    A pair's mask contains surface that the model has not seen before, and may lack parts that the model has.

    Args:
        view: the current frame.
        model: of the object; None where the frame does not confirm it.
        pose: (4, 4) `curr_T_object`.
        mask: (H, W) bool of the pair.
        others: (H, W) bool each, masks of the pair's other objects, which the model does not cover.

    Returns:
        (H, W) bool, and (H, W) float32 metres.
    """
    measured = view.frame.frame.depth
    own = mask & view.frame.valid
    if model is None:
        return own, measured
    shown, depth = view.mask(model, pose)
    for other in others:
        shown &= ~other
    return own | shown, np.where(own, measured, depth)


def nearest_labels(
    view: FrameView, regions: Mapping[int, tuple[BoolMask, Float32Array]], first: Collection[int]
) -> LabelImage:
    """The object of each pixel: of those that claim it, the one whose depth is nearer to the measured one.

    Args:
        view: the current frame.
        regions: (H, W) bool and (H, W) float32 metres by object.
        first: objects that come first where two are equally near.

    Returns:
        (H, W) int32, 0 where no object is.
    """
    measured = view.frame.frame.depth
    out = np.zeros(measured.shape, np.int32)
    best = np.full(measured.shape, np.inf, np.float32)
    for number in sorted(regions, key=lambda n: n not in first):
        region, depth = regions[number]
        with np.errstate(invalid="ignore"):
            off = np.abs(depth - measured)
        wins = region & (off < best)
        out[wins], best[wins] = number, off[wins]
    return out
