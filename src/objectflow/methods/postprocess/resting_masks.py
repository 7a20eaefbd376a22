"""Masks that the network gave to objects at rest, for the moving objects that the search found in their place.

A motion that is found from the pixels which contradict standing still explains these alone: the middle of a body
without texture fits standing still as well. The network may have had the whole body and only its motion wrong.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.refine_objects import refine_one
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.typing import BoolMask, Float64Array, LabelImage


def take_resting_masks(
    pair: FramePair,
    labels: LabelImage,
    found: Objects,
    proposed: LabelImage,
    resting: Objects,
    settings: PostprocessSettings,
) -> tuple[LabelImage, Objects]:
    """Give found objects the whole masks of objects at rest where their motion explains these better.

    The motion is registered to both masks first: what a part of a body determines may be off on the rest of it.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32 with the found objects.
        found: moving objects; those without a pixel are left out of account.
        proposed: (H, W) int32, the labels before the search.
        resting: the objects at rest of `proposed`.
        settings: `missed_objects`, `static_test`, `refine` and `likelihood` apply.

    Returns:
        The labels, and the found objects with the motions of their masks.
    """
    likelihood = PairLikelihood.of(pair, settings.likelihood)
    after, before = likelihood.downscale(labels), likelihood.downscale(proposed)
    motions = {obj.id: obj.prev_T_curr for obj in found}
    for obj in found:
        own = likelihood.mask(after, obj.id)
        for other in resting:
            mask = likelihood.mask(before, other.id)
            if not own.any() or (own & mask).sum() < settings.missed_objects.min_inside * own.sum():
                continue
            motion = _motion_of_both(pair, likelihood, motions[obj.id], own, mask, settings)
            if motion is not None:
                free = (labels == 0) | (labels == other.id)
                labels = np.where((proposed == other.id) & free, np.int32(obj.id), labels)
                motions[obj.id] = motion
    return labels, tuple(dataclasses.replace(obj, prev_T_curr=motions[obj.id]) for obj in found)


def _motion_of_both(
    pair: FramePair,
    likelihood: PairLikelihood,
    found: Float64Array,
    own: BoolMask,
    mask: BoolMask,
    settings: PostprocessSettings,
) -> Float64Array | None:
    """A found motion, registered to its pixels and a mask at rest; None if standing still explains the mask better."""
    rest = mask & ~own
    if not rest.any():
        return None
    wide = pair.at_width(settings.refine.width)
    rows, columns = nearest_indices(own.shape, wide.curr.frame.depth.shape)
    source = wide.sources.take((own | mask)[rows[:, None], columns], limit=settings.refine.max_points)
    motion = refine_one(wide.target, source, [found], settings.refine)
    cost, test = likelihood.cost(motion, rest), settings.static_test
    lost = likelihood.cost(motion, own).mean() - likelihood.cost(found, own).mean()
    explained = cost.mean() < likelihood.cost_at_rest(rest).mean() and lost < settings.missed_objects.max_loss
    return motion if explained and (cost >= test.explained_cost).mean() <= test.max_unexplained else None
