"""How sure a moving object is, by what the frames show of its motion.

A network's probability tells whether there is an object, and hardly whether its motion is right.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow.alignment.likelihood import motion_confidence
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.motion import ObjectMotion


def set_confidence(likelihood: PairLikelihood, objects: tuple[ObjectMotion, ...]) -> tuple[ObjectMotion, ...]:
    """Score moving objects as `consensus` does, by their motion against standing still; see `motion_confidence`.

    Args:
        likelihood: the frames, with the objects' labels.
        objects: with their final motions.

    Returns:
        The same objects; what stands still keeps its score, and so does what has no pixel with depth.
    """
    return tuple(
        dataclasses.replace(obj, score=_confidence(likelihood, obj))
        if obj.moving and likelihood.mask(obj.id).any()
        else obj
        for obj in objects
    )


def _confidence(likelihood: PairLikelihood, obj: ObjectMotion) -> float:
    mask = likelihood.mask(obj.id)
    cost = likelihood.cost(obj.prev_T_curr, mask)
    return motion_confidence(cost, likelihood.cost(np.eye(4), mask) - cost)
