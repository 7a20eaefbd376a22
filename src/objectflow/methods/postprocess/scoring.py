"""Confidence in the motion of each moving object, by its likelihood in both frames.

A network's probability tells whether there is an object, but hardly whether its motion is right. A wrong motion may
lay an object onto some other surface of the previous frame; that surface is then not where the object is now.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings, StaticTestSettings
from objectflow.methods.postprocess.uncovered import RestingCosts
from objectflow.typing import Float32Array, LabelImage

UNSEEN = 1e3
"""Cost that marks pixels which the previous frame does not show."""


def two_way_confidence(
    cost: Float32Array, previous_cost: Float32Array, gain: Float32Array, settings: StaticTestSettings
) -> float:
    """Confidence that pixels follow a motion; see `set_confidence`.

    Args:
        cost: (N,) of the pixels under the motion; `UNSEEN` where the previous frame does not show them.
        previous_cost: (M,) of the pixels of the previous frame where they came from, under the inverse motion.
        gain: (N,) cost of standing still minus `cost`.
        settings: see there.

    Returns:
        0..1, to four digits.
    """
    visible = cost < UNSEEN
    if not visible.any() or not len(previous_cost):
        return 0.0
    forward, backward = (float((one < settings.explained_cost).mean()) for one in (cost[visible], previous_cost))
    moved = 1 - float(np.exp(-2 * max(0.0, float(gain.mean()))))
    explained = float((forward * backward) ** settings.two_way_exponent)
    return round(float(visible.mean()) * explained * moved, 4)


def set_confidence(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Score moving objects by how well the two frames confirm their motions.

    With v the share of an object's pixels that the previous frame shows, f the share of these that the motion
    explains, b the share of the pixels where they came from that the inverse motion explains in the current frame, and
    g the mean gain over standing still, the score is v (f b)^a (1 - exp(-2 g)); a is `two_way_exponent`.

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
            before = likelihood.previous_cost(obj.prev_T_curr, mask)
            score = two_way_confidence(cost, before, gain, test)
            if visible.mean() < test.min_visible:
                score = min(score, test.unseen_score)
            elif obj.motion_known:
                rigid = bool((cost[visible] >= test.explained_cost).mean() <= test.max_unexplained)
        out.append(dataclasses.replace(obj, score=score, rigid=rigid))
    return labels, tuple(out)
