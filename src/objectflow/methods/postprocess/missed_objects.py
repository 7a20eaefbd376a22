"""What moves though the network saw no object there: sought as `consensus` seeks it, among the pixels left over.

A network knows what it was trained on. That something moved the frames tell themselves: a surface hangs where nothing
was, or looks different from what was there.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from scipy import ndimage

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import motion_cost
from objectflow.methods.consensus.estimator import ConsensusEstimator
from objectflow.methods.labels import relabel_present
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, LabelImage

CHANGED_COST = 1.5
"""Cost from which a pixel speaks against standing still."""
MIN_OBJECT_SHARE = 0.002
"""Of the image: changed regions of fewer pixels are not looked into, nor smaller objects added."""
RIM_PX = 2
"""Pixels of the likelihood around an object that are its own: masks end a little off the edge."""
MIN_SCORE = 0.3
"""Least score of what is added; `consensus` gives less to regions that no motion explains."""
NEIGHBOUR_PX = 7
"""Pixels of the likelihood within which a piece may belong to a known object."""
MAX_LIKELIHOOD_LOSS = 0.2
"""Mean log-likelihood a pixel that a piece may lose by having that object's motion."""
SAME_MOTION_RATIO = 0.6
"""Of its own way: a piece that another motion takes nearer than this to the same place goes along with it."""
MIN_AREA_RATIO, MIN_AREA_RATIO_SAME_MOTION = 0.25, 0.5
"""Of a neighbour's pixels: of fewer, a piece is not taken for an object by itself; the second if it goes along."""
FRAGMENT_AREA_RATIO = 0.1
"""Of the pixels of a body that the network overlooked: what it saw of fewer beside it is a piece of that body."""


def recover_missed_objects(
    pair: FramePair, likelihood: PairLikelihood, labels: LabelImage, objects: tuple[ObjectMotion, ...]
) -> tuple[LabelImage, tuple[ObjectMotion, ...]]:
    """Add moving objects that lie beside the known ones, and to the known ones the pieces that follow their motion.

    Args:
        pair: the frames, before a camera that stands still.
        likelihood: the same frames; its labels follow.
        labels: (H, W) int32 on the input's pixels.
        objects: of these labels.

    Returns:
        Labels and objects, numbered anew from 1.
    """
    known = _dilated(labels > 0, max(1, round(RIM_PX * labels.shape[1] / likelihood.labels.shape[1])))
    likelihood.show(labels)
    if not _has_changed(likelihood, known):
        return labels, objects
    others = [(obj.prev_T_curr, labels == obj.id) for obj in objects if obj.moving]
    more = ConsensusEstimator(camera="static", rounds=2, min_object_share=MIN_OBJECT_SHARE).find(
        pair, known=known, others=others
    )
    first = max((obj.id for obj in objects), default=0)
    added = tuple(dataclasses.replace(obj, id=first + obj.id) for obj in more.objects if obj.score >= MIN_SCORE)
    kept = np.isin(more.labels, [obj.id - first for obj in added])
    labels = np.where(kept, more.labels + np.int32(first), labels)
    likelihood.show(labels)
    number = np.arange(1 + first + len(more.objects), dtype=np.int32)
    for piece in added:
        number[piece.id] = _attach_or_drop(likelihood, piece, objects)
    own = tuple(piece for piece in added if number[piece.id] == piece.id)
    labels = number[labels]
    likelihood.show(labels)
    labels, objects = relabel_present(_merge_new_parts(likelihood, objects, own)[labels], objects + own)
    likelihood.show(labels)
    return labels, objects


def _has_changed(likelihood: PairLikelihood, known: BoolMask) -> bool:
    """Whether a region of some size beside the known objects speaks against standing still."""
    height, width = likelihood.labels.shape
    own = cv2.resize(known.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    cost, hidden = motion_cost(likelihood.prev, likelihood.points, np.eye(4), likelihood.appearance)
    changed = (cost >= CHANGED_COST) & likelihood.curr.valid & ~hidden & ~own
    core = cv2.morphologyEx(changed.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    numbers, count = ndimage.label(core, structure=np.ones((3, 3)))
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)[1:]
    return bool((sizes >= MIN_OBJECT_SHARE * cost.size).any())


def _attach_or_drop(likelihood: PairLikelihood, piece: ObjectMotion, objects: tuple[ObjectMotion, ...]) -> int:
    """The number of whom a piece belongs to: of a moving object nearby, its own, or 0 where it had better go.

    A small piece beside a larger object whose motion does not explain it is that object's shadow or reflection, or
    depth smeared along its edge: no object by itself.
    """
    mask = likelihood.mask(piece.id)
    if not mask.any():
        return 0
    near = np.unique(likelihood.labels[_dilated(mask, NEIGHBOUR_PX)])
    points = likelihood.points[mask]
    there = geometry.transform(piece.prev_T_curr, points)
    way = float(np.linalg.norm(there - points, axis=1).mean())
    best, owner = float(likelihood.cost(piece.prev_T_curr, mask).mean()) + MAX_LIKELIHOOD_LOSS, piece.id
    for obj in objects:
        if not obj.moving or obj.id not in near:
            continue
        cost = float(likelihood.cost(obj.prev_T_curr, mask).mean())
        apart = float(np.linalg.norm(geometry.transform(obj.prev_T_curr, points) - there, axis=1).mean())
        if cost < best:
            best, owner = cost, obj.id
        elif (
            owner == piece.id
            and piece.pixels
            < (MIN_AREA_RATIO_SAME_MOTION if apart < SAME_MOTION_RATIO * way else MIN_AREA_RATIO) * obj.pixels
        ):
            owner = 0
    return owner


def _merge_new_parts(
    likelihood: PairLikelihood, known: tuple[ObjectMotion, ...], added: tuple[ObjectMotion, ...]
) -> LabelImage:
    """New numbers for bodies of which the network saw one part and the search found others.

    Each mover, the smallest first, joins the larger one nearby whose motion explains it best, if that is about as well
    as its own does. One of the two is new: what the network told apart stays apart. A mere fragment joins in any case.
    """
    left = {obj.id: obj for obj in known + added if obj.moving}
    new = {obj.id for obj in added}
    number = np.arange(1 + max((obj.id for obj in known + added), default=0), dtype=np.int32)
    for small in sorted(left.values(), key=lambda obj: obj.pixels):
        mask = likelihood.mask(small.id)
        if not mask.any():
            continue
        near = np.unique(likelihood.labels[_dilated(mask, NEIGHBOUR_PX)])
        pixels = left[small.id].pixels
        best, host = float(likelihood.cost(small.prev_T_curr, mask).mean()) + MAX_LIKELIHOOD_LOSS, None
        for other in left.values():
            if other.id == small.id or other.id not in near or other.pixels < pixels or not new & {other.id, small.id}:
                continue
            cost = float(likelihood.cost(other.prev_T_curr, mask).mean())
            if cost < best:
                best, host = cost, other
            elif host is None and other.id in new and pixels < FRAGMENT_AREA_RATIO * other.pixels:
                host = other
        if host is not None:
            left[host.id] = dataclasses.replace(host, pixels=host.pixels + pixels)
            del left[small.id]
            number[number == small.id] = host.id
            likelihood.labels = np.where(likelihood.labels == small.id, np.int32(host.id), likelihood.labels)
    return number


def _dilated(mask: BoolMask, pixels: int) -> BoolMask:
    """A mask grown by so many pixels."""
    size = 2 * pixels + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)
