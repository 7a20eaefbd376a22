"""The order of the steps that follow a network's output."""

from __future__ import annotations

from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.refine_objects import refine_objects
from objectflow.frame import RgbdFrame
from objectflow.methods.labels import relabel_present
from objectflow.methods.mask_edges import snap_to_edges
from objectflow.methods.postprocess.merge_fragments import merge_fragments
from objectflow.methods.postprocess.missed_objects import recover_missed_objects
from objectflow.methods.postprocess.motion_search import search_motions
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.scoring import set_confidence
from objectflow.methods.postprocess.static_test import reject_static
from objectflow.motion import ObjectMotion
from objectflow.typing import LabelImage

MIN_STATIC_SCORE = 0.3
"""Least probability of an object that stands still. What moves gives itself away in other ways, and needs less."""


def postprocess(
    pair: FramePair, curr_s: RgbdFrame, labels: LabelImage, objects: tuple[ObjectMotion, ...]
) -> tuple[LabelImage, tuple[ObjectMotion, ...]]:
    """What the network said, set right by what the frames show.

    Args:
        pair: the frames, of a camera that stands still.
        curr_s: the current one as the network saw it.
        labels: (H, W) int32 on the pixels that it came with.
        objects: with the network's motions.

    Returns:
        Labels and objects, numbered anew from 1.
    """
    likelihood = PairLikelihood(pair.prev, pair.curr, labels)
    objects = reject_static(likelihood, refine_objects(pair, labels, objects))
    objects = search_motions(pair.prev, pair.curr, likelihood, objects)
    labels, objects = merge_fragments(likelihood, labels, objects)
    # Only now: a mask that ends a little inside its object makes the better motion.
    labels = snap_to_edges(labels, curr_s, pair.curr)
    labels, objects = relabel_present(
        labels, tuple(obj for obj in objects if obj.moving or obj.score >= MIN_STATIC_SCORE)
    )
    labels, objects = recover_missed_objects(pair, likelihood, labels, objects)
    return labels, set_confidence(likelihood, objects)
