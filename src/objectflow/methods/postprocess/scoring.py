"""Confidence in the motion of each moving object, by its likelihood.

A network's probability tells whether there is an object, but hardly whether its motion is right.
"""

from __future__ import annotations

import dataclasses

from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import motion_confidence
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.methods.postprocess.uncovered import RestingCosts
from objectflow.typing import LabelImage

UNSEEN = 1e3
"""Cost that marks pixels which the previous frame does not show."""


def set_confidence(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Score moving objects by their motion against standing still; see `motion_confidence`.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: with their final motions.
        settings: `static_test` and `likelihood` apply.

    Returns:
        The same labels and objects; static objects keep their score. Pixels that the previous frame does not show
        confirm nothing, and an object of which it shows too little is a guess. A moving object whose motion leaves
        too many visible pixels unexplained is marked as not rigid.
    """
    likelihood, test = PairLikelihood.of(pair, settings.likelihood), settings.static_test
    small = likelihood.downscale(labels)
    resting = RestingCosts(likelihood, small, objects, test)
    out = []
    for obj in objects:
        mask = likelihood.mask(small, obj.id)
        if not obj.moving:
            out.append(obj)
            continue
        score, rigid = 0.0, True
        if mask.any():
            cost = likelihood.cost(obj.prev_T_curr, mask, out_of_view=UNSEEN)
            visible = cost < UNSEEN
            gain = resting.of(obj.id) - likelihood.cost(obj.prev_T_curr, mask)
            score = motion_confidence(cost, gain, test.explained_cost)
            if visible.mean() < test.min_visible:
                score = min(score, test.unseen_score)
            elif obj.motion_known:
                rigid = bool((cost[visible] >= test.explained_cost).mean() <= test.max_unexplained)
        out.append(dataclasses.replace(obj, score=score, rigid=rigid))
    return labels, tuple(out)
