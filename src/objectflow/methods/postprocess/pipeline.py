"""The order of the steps that follow a network's output."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from objectflow.alignment.frame_pair import Readied
from objectflow.alignment.refine_objects import refine_objects
from objectflow.frame import RgbdFrame
from objectflow.methods.labels import keep_seen
from objectflow.methods.mask_edges import follow_edges
from objectflow.methods.postprocess.merge_fragments import join_pieces
from objectflow.methods.postprocess.missed_objects import find_overlooked
from objectflow.methods.postprocess.motion_search import search_motions
from objectflow.methods.postprocess.pair_likelihood import Witness
from objectflow.methods.postprocess.scoring import score_movers
from objectflow.methods.postprocess.static_test import bring_to_rest
from objectflow.motion import ObjectMotion

Labels = NDArray[np.int32]


SURE = 0.3
"""Least probability of an object that stands still. What moves gives itself away in other ways, and needs less."""


def settle(
    ready: Readied, curr_s: RgbdFrame, labels: Labels, objects: tuple[ObjectMotion, ...]
) -> tuple[Labels, tuple[ObjectMotion, ...]]:
    """What the network said, set right by what the frames show.

    Args:
        ready: the frames, of a camera that stands still.
        curr_s: the current one as the network saw it.
        labels: (H, W) int32 on the pixels that it came with.
        objects: with the network's motions.

    Returns:
        Labels and objects, numbered anew from 1.
    """
    witness = Witness(ready.prev, ready.curr, labels)
    objects = bring_to_rest(witness, refine_objects(ready, labels, objects))
    objects = search_motions(ready.prev, ready.curr, witness, objects)
    labels, objects = join_pieces(witness, labels, objects)
    # Only now: a mask that ends a little inside its object makes the better motion.
    labels = follow_edges(labels, curr_s, ready.curr)
    labels, objects = keep_seen(labels, tuple(obj for obj in objects if obj.moving or obj.score >= SURE))
    labels, objects = find_overlooked(ready, witness, labels, objects)
    return labels, score_movers(witness, objects)
