"""Pieces of one body, joined: a network splits long and thin things, a hammer into handle and head."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from objectflow.methods.labels import keep_seen
from objectflow.methods.postprocess.pair_likelihood import Witness
from objectflow.motion import ObjectMotion

Array = NDArray[np.float64]
Labels = NDArray[np.int32]

CONTACT = 0.8
"""Least share of the common border over which the surface goes on."""
WORSE = 0.2
"""Mean log-likelihood a pixel that two pieces may lose by having one motion."""
FAIR = 1.0
"""Most that a pixel may cost under it on average: motions that explain nothing are no reason to join anything."""


def join_pieces(
    witness: Witness, labels: Labels, objects: tuple[ObjectMotion, ...]
) -> tuple[Labels, tuple[ObjectMotion, ...]]:
    """Join moving objects that touch along one surface and that a single motion explains.

    Each object, the smallest first, joins the one with which the fewest is lost. Two bodies that move as one look the
    same as one body; what stands still is never joined.

    Args:
        witness: the frames, with `labels`; its own labels follow.
        labels: (H, W) int32 on the input's pixels.
        objects: of these labels.

    Returns:
        Labels and objects, numbered anew from 1; of two scores the higher one stays, the centre is the larger piece's.
    """
    left = {obj.id: obj for obj in objects}
    renamed = np.arange(1 + max(left, default=0), dtype=np.int32)
    for number in sorted((obj.id for obj in objects if obj.moving), key=lambda number: left[number].pixels):
        small = left[number]
        found = _partner(witness, small, left)
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
        witness.labels = np.where(witness.labels == small.id, np.int32(large.id), witness.labels)
    if len(left) == len(objects):
        return labels, objects
    return keep_seen(renamed[labels], tuple(left.values()))


def _partner(
    witness: Witness, small: ObjectMotion, objects: dict[int, ObjectMotion]
) -> tuple[ObjectMotion, Array] | None:
    """The object that an object belongs to, and the motion of both."""
    mask = witness.mask(small.id)
    if not mask.any():
        return None
    own = witness.cost(small.prev_T_curr, mask).sum()
    best, out = WORSE, None
    for number, share in witness.contact(mask).items():
        other = objects[number]
        if share < CONTACT or not other.moving or other.pixels < small.pixels:
            continue
        theirs = witness.mask(number)
        apart = own + witness.cost(other.prev_T_curr, theirs).sum()
        for motion in (other.prev_T_curr, small.prev_T_curr):
            together = witness.cost(motion, mask).sum() + witness.cost(motion, theirs).sum()
            count = mask.sum() + theirs.sum()
            lost = float(together - apart) / count
            if lost < best and together < FAIR * count:
                best, out = lost, (other, motion)
    return out
