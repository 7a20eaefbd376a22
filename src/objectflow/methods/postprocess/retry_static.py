"""Another registration of objects at rest that standing still does not explain.

A network may find the mask of an object and a motion near none. Registration from such a motion, which is off by about
as much as the object moved, can end at rest or elsewhere; from standing still itself, it finds small motions reliably.
"""

from __future__ import annotations

import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.mask_registration import register_mask
from objectflow.methods.postprocess.new_motion import with_motion
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, LabelImage


def retry_static(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Give objects at rest the motion that registration finds from standing still, where it explains them far better.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: of these labels.
        settings: `retry_static`, `refine`, `static_test` and `likelihood` apply.

    Returns:
        The same labels and objects; some that were static move.
    """
    likelihood = PairLikelihood.of(pair, settings.likelihood)
    small = likelihood.downscale(labels)
    masks = {obj.id: likelihood.mask(small, obj.id) for obj in objects if not obj.moving}
    retry = settings.retry_static
    doubted = {
        number
        for number, mask in masks.items()
        if mask.sum() >= retry.min_pixels and likelihood.cost_at_rest(mask).mean() >= retry.min_static_cost
    }
    if not doubted:
        return labels, objects
    out = tuple(
        _retried(pair, labels, obj, likelihood, masks[obj.id], settings) if obj.id in doubted else obj
        for obj in objects
    )
    return labels, out


def _retried(
    pair: FramePair,
    labels: LabelImage,
    obj: ObjectMotion,
    likelihood: PairLikelihood,
    mask: BoolMask,
    settings: PostprocessSettings,
) -> ObjectMotion:
    """The object with the best registered motion, or itself if none explains it well enough."""
    retry = settings.retry_static
    motions = register_mask(pair, labels == obj.id, settings.refine)
    costs = [float(likelihood.cost(motion, mask).mean()) for motion in motions]
    best = int(np.argmin(costs))
    static = float(likelihood.cost_at_rest(mask).mean())
    least = max(retry.min_gain, retry.min_gain_ratio * static)
    if costs[best] > retry.max_cost or static - costs[best] < least:
        return obj
    found = with_motion(obj, motions[best], likelihood.points[mask], settings.static_test.static_displacement)
    return found if found.moving else obj
