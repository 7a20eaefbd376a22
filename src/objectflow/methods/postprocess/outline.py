"""Objects without an outline: surface that something uncovered or on which a shadow lay, and that never moved."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.labels import Objects, relabel_present
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import OutlineSettings, PostprocessSettings
from objectflow.typing import BoolMask, Float32Array, LabelImage


def drop_without_outline(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Remove moving objects that differ from what is around them in neither colour nor depth.

    Where an object or its shadow was, the colour changes too, and any motion along a surface without texture explains
    that. But what appears there looks like the surface around it, while an object ends somewhere.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: with their motions.
        settings: `outline`, `static_test` and `likelihood` apply.

    Returns:
        Labels and objects, numbered anew from 1; pixels of removed objects are background.
    """
    likelihood = PairLikelihood.of(pair, settings.likelihood)
    small = likelihood.downscale(labels)
    outside = likelihood.pair.curr.valid & ~np.isin(small, [obj.id for obj in objects if obj.moving])
    depth, hidden = likelihood.static_depth_cost()
    unchanged = (depth < settings.static_test.inlier_cost) & ~hidden
    kept = []
    for obj in objects:
        mask = likelihood.mask(small, obj.id)
        plain = obj.moving and mask.any() and unchanged[mask].mean() >= settings.outline.min_unchanged
        if not plain or _has_outline(likelihood, mask, outside, settings.outline):
            kept.append(obj)
    return relabel_present(labels, tuple(kept))


def _has_outline(likelihood: PairLikelihood, mask: BoolMask, outside: BoolMask, settings: OutlineSettings) -> bool:
    """Whether a mask differs from the pixels around it in the current frame, or too few of these are known."""
    curr, noise = likelihood.pair.curr, likelihood.pair.noise
    _, *lab = curr.appearance.channels
    # The inverse depth of a plane is linear in the image, so its steps across the border have no common sign.
    inverse = np.where(curr.valid, 1 / np.maximum(curr.frame.depth, 1e-6), 0).astype(np.float32)
    steps = _steps(np.dstack([*lab, inverse]), mask, outside, settings.reach_px)
    if len(steps) < settings.min_border:
        return True
    depth = float(np.median(curr.frame.depth[mask]))
    depth_step = abs(float(np.median(steps[:, 3]))) * depth**2
    contrast = float(np.median(np.linalg.norm(steps[:, :3], axis=1)))
    return contrast >= settings.min_contrast or depth_step >= settings.min_sigmas * float(noise.sigma(np.array(depth)))


def _steps(image: Float32Array, mask: BoolMask, outside: BoolMask, reach: int) -> Float32Array:
    """(N, C) differences between the local means of an image inside and outside of a mask, along its border.

    Args:
        image: (H, W, C).
        mask, outside: (H, W); other pixels count for neither.
        reach: pixels from the border within which means are taken.
    """
    rows, columns = np.nonzero(mask)
    box = tuple(slice(max(0, one.min() - 2 * reach), one.max() + 2 * reach + 1) for one in (rows, columns))
    size = (2 * reach + 1, 2 * reach + 1)
    mask, image = mask[box], image[box]
    border = mask & (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
    means = []
    for part in (mask, outside[box]):
        weight = part.astype(np.float32)
        count = cv2.boxFilter(weight, -1, size, normalize=False)
        total = cv2.boxFilter(image * weight[..., None], -1, size, normalize=False)
        border &= count >= reach
        means.append(total / np.maximum(count, 1)[..., None])
    return np.asarray((means[0] - means[1])[border])
