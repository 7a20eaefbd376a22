"""How sure a moving object is, by what the frames show of its motion.

A network's probability tells whether there is an object, and hardly whether its motion is right.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow.alignment.likelihood import certainty
from objectflow.methods.postprocess.pair_likelihood import Witness
from objectflow.motion import ObjectMotion


def score_movers(witness: Witness, objects: tuple[ObjectMotion, ...]) -> tuple[ObjectMotion, ...]:
    """Score moving objects as `consensus` does, by their motion against standing still; see `certainty`.

    Args:
        witness: the frames, with the objects' labels.
        objects: with their final motions.

    Returns:
        The same objects; what stands still keeps its score, and so does what has no pixel with depth.
    """
    return tuple(
        dataclasses.replace(obj, score=_score(witness, obj)) if obj.moving and witness.mask(obj.id).any() else obj
        for obj in objects
    )


def _score(witness: Witness, obj: ObjectMotion) -> float:
    mask = witness.mask(obj.id)
    cost = witness.cost(obj.prev_T_curr, mask)
    return certainty(cost, witness.cost(np.eye(4), mask) - cost)
