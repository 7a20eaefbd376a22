"""Confidence in the motion of each moving object, by its likelihood.

A network's probability tells whether there is an object, but hardly whether its motion is right.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import motion_confidence
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.typing import LabelImage


def set_confidence(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Score moving objects by their motion against standing still; see `motion_confidence`.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: with their final motions.
        settings: `likelihood` applies.

    Returns:
        The same labels and objects; static objects and objects without depth keep their score.
    """
    likelihood = PairLikelihood(pair, settings.likelihood)
    small = likelihood.downscale(labels)
    out = []
    for obj in objects:
        mask = likelihood.mask(small, obj.id) if obj.moving else np.zeros(0, bool)
        if mask.any():
            cost = likelihood.cost(obj.prev_T_curr, mask)
            gain = likelihood.cost_at_rest(mask) - cost
            obj = dataclasses.replace(obj, score=motion_confidence(cost, gain))  # noqa: PLW2901
        out.append(obj)
    return labels, tuple(out)
