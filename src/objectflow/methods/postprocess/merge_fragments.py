"""Pieces of one body, joined: a network splits long and thin things, a hammer into handle and head."""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow.methods.labels import relabel_present
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.motion import ObjectMotion
from objectflow.typing import Float64Array, LabelImage

MIN_CONTACT = 0.8
"""Least share of the common border over which the surface goes on."""
MAX_LIKELIHOOD_LOSS = 0.2
"""Mean log-likelihood a pixel that two pieces may lose by having one motion."""
MAX_COST = 1.0
"""Most that a pixel may cost under it on average: motions that explain nothing are no reason to join anything."""


def merge_fragments(
    likelihood: PairLikelihood, labels: LabelImage, objects: tuple[ObjectMotion, ...]
) -> tuple[LabelImage, tuple[ObjectMotion, ...]]:
    """Join moving objects that touch along one surface and that a single motion explains.

    Each object, the smallest first, joins the one with which the fewest is lost. Two bodies that move as one look the
    same as one body; what stands still is never joined.

    Args:
        likelihood: the frames, with `labels`; its own labels follow.
        labels: (H, W) int32 on the input's pixels.
        objects: of these labels.

    Returns:
        Labels and objects, numbered anew from 1; of two scores the higher one stays, the centre is the larger piece's.
    """
    left = {obj.id: obj for obj in objects}
    renamed = np.arange(1 + max(left, default=0), dtype=np.int32)
    for number in sorted((obj.id for obj in objects if obj.moving), key=lambda number: left[number].pixels):
        small = left[number]
        found = _partner(likelihood, small, left)
        if found is None:
            continue
        large, motion = found
        left[large.id] = dataclasses.replace(
            large,
            pixels=small.pixels + large.pixels,
            score=max(small.score, large.score),
            prev_T_curr=motion,
        )
        del left[small.id]
        renamed[renamed == small.id] = large.id
        likelihood.labels = np.where(likelihood.labels == small.id, np.int32(large.id), likelihood.labels)
    if len(left) == len(objects):
        return labels, objects
    return relabel_present(renamed[labels], tuple(left.values()))


def _partner(
    likelihood: PairLikelihood, small: ObjectMotion, objects: dict[int, ObjectMotion]
) -> tuple[ObjectMotion, Float64Array] | None:
    """The object that an object belongs to, and the motion of both."""
    mask = likelihood.mask(small.id)
    if not mask.any():
        return None
    own = likelihood.cost(small.prev_T_curr, mask).sum()
    best, out = MAX_LIKELIHOOD_LOSS, None
    for number, share in likelihood.contact(mask).items():
        other = objects[number]
        if share < MIN_CONTACT or not other.moving or other.pixels < small.pixels:
            continue
        theirs = likelihood.mask(number)
        apart = own + likelihood.cost(other.prev_T_curr, theirs).sum()
        for motion in (other.prev_T_curr, small.prev_T_curr):
            together = likelihood.cost(motion, mask).sum() + likelihood.cost(motion, theirs).sum()
            count = mask.sum() + theirs.sum()
            lost = float(together - apart) / count
            if lost < best and together < MAX_COST * count:
                best, out = lost, (other, motion)
    return out
