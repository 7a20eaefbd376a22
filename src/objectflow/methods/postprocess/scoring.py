"""Confidence in the motion of each moving object, by its likelihood in both frames.

A network's probability tells whether there is an object, but hardly whether its motion is right. A wrong motion may
lay an object onto some other surface of the previous frame; that surface is then not where the object is now. Where it
lays the object onto itself, turned, other motions fit as well, or the colours do not lie where they were.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.color_similarity import color_similarity
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.rival_motions import rival_loss
from objectflow.methods.postprocess.search_likelihood import SearchLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings, RivalSettings, StaticTestSettings
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


def confirmed_score(score: float, rival_loss: float, color_similarity: float, settings: RivalSettings) -> float:
    """A score of which only what rivals and colours confirm exceeds `unconfirmed_score`; see `set_confidence`.

    Args:
        score: 0..1, of a motion by itself.
        rival_loss: mean cost, in nats per pixel, that the best rival adds; see `rival_loss`.
        color_similarity: 0..1; see there.
        settings: see there.

    Returns:
        0..1, to four digits.
    """
    base = settings.unconfirmed_score
    if score <= base:
        return score
    confirmed = (1 - float(np.exp(-settings.rate * max(0.0, rival_loss)))) * color_similarity
    return round(base + (score - base) * confirmed, 4)


def set_confidence(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Score moving objects by how well the two frames confirm their motions.

    With v the share of an object's pixels that the previous frame shows, f the share of these that the motion
    explains, b the share of the pixels where they came from that the inverse motion explains in the current frame, and
    g the mean gain over standing still, the score is v (f b)^a (1 - exp(-2 g)); a is `two_way_exponent`. What exceeds
    `RivalSettings.unconfirmed_score` is multiplied by (1 - exp(-r l)) c, where l is the mean cost that the best rival
    of the motion adds, r is `RivalSettings.rate`, and c is the similarity of the aligned colours.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: with their final motions.
        settings: `static_test`, `likelihood`, `rivals`, `color_similarity` and `motion_search` apply.

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
            if score > settings.rivals.unconfirmed_score:
                loss = rival_loss(SearchLikelihood.of(pair, settings), likelihood, mask, obj.prev_T_curr, settings)
                similarity = color_similarity(likelihood, mask, obj.prev_T_curr, settings.color_similarity)
                score = confirmed_score(score, loss, similarity, settings.rivals)
            if visible.mean() < test.min_visible:
                score = min(score, test.unseen_score)
            elif obj.motion_known:
                rigid = bool((cost[visible] >= test.explained_cost).mean() <= test.max_unexplained)
        out.append(dataclasses.replace(obj, score=score, rigid=rigid))
    return labels, tuple(out)
