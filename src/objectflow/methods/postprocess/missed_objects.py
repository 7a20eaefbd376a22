"""What moves though the network saw no object there: sought as `consensus` seeks it, among the pixels left over.

A network knows what it was trained on. That something moved the frames tell themselves: a surface hangs where nothing
was, or looks like another one.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from objectflow import geometry
from objectflow.alignment.frame_pair import Readied
from objectflow.alignment.likelihood import motion_cost
from objectflow.methods.consensus.estimator import Consensus
from objectflow.methods.labels import keep_seen
from objectflow.methods.postprocess.pair_likelihood import Witness
from objectflow.motion import ObjectMotion

Labels = NDArray[np.int32]
Mask = NDArray[np.bool_]

CHANGED = 1.5
"""Cost from which a pixel speaks against standing still."""
LEAST_SHARE = 0.002
"""Of the image: changed regions of fewer pixels are not looked into, nor smaller objects added."""
RIM = 2
"""Pixels of the witness around an object that are its own: masks end a little off the edge."""
EXPLAINED = 0.3
"""Least score of what is added; `consensus` gives less to regions that no motion explains."""
REACH = 7
"""Pixels of the witness within which a piece may belong to a known object."""
WORSE = 0.2
"""Mean log-likelihood a pixel that a piece may lose by having that object's motion."""
ALONG = 0.6
"""Of its own way: a piece that another motion takes nearer than this to the same place goes along with it."""
SMALL, SMALL_ALONG = 0.25, 0.5
"""Of a neighbour's pixels: of fewer, a piece is not taken for an object by itself; the second if it goes along."""
FRAGMENT = 0.1
"""Of the pixels of a body that the network overlooked: what it saw of fewer beside it is a piece of that body."""


def find_overlooked(
    ready: Readied, witness: Witness, labels: Labels, objects: tuple[ObjectMotion, ...]
) -> tuple[Labels, tuple[ObjectMotion, ...]]:
    """Add moving objects that lie beside the known ones, and to the known ones the pieces that follow their motion.

    Args:
        ready: the frames, before a camera that stands still.
        witness: the same frames; its labels follow.
        labels: (H, W) int32 on the input's pixels.
        objects: of these labels.

    Returns:
        Labels and objects, numbered anew from 1.
    """
    known = _spread(labels > 0, max(1, round(RIM * labels.shape[1] / witness.labels.shape[1])))
    witness.show(labels)
    if not _has_changed(witness, known):
        return labels, objects
    others = [(obj.prev_T_curr, labels == obj.id) for obj in objects if obj.moving]
    more = Consensus(camera="static", rounds=2, min_object_share=LEAST_SHARE).find(ready, known=known, others=others)
    first = max((obj.id for obj in objects), default=0)
    added = tuple(dataclasses.replace(obj, id=first + obj.id) for obj in more.objects if obj.score >= EXPLAINED)
    kept = np.isin(more.labels, [obj.id - first for obj in added])
    labels = np.where(kept, more.labels + np.int32(first), labels)
    witness.show(labels)
    number = np.arange(1 + first + len(more.objects), dtype=np.int32)
    for piece in added:
        number[piece.id] = _owner(witness, piece, objects)
    own = tuple(piece for piece in added if number[piece.id] == piece.id)
    labels = number[labels]
    witness.show(labels)
    labels, objects = keep_seen(_gather(witness, objects, own)[labels], objects + own)
    witness.show(labels)
    return labels, objects


def _has_changed(witness: Witness, known: Mask) -> bool:
    """Whether a region of some size beside the known objects speaks against standing still."""
    height, width = witness.labels.shape
    own = cv2.resize(known.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    cost, hidden = motion_cost(witness.prev, witness.points, np.eye(4), witness.looks)
    changed = (cost >= CHANGED) & witness.curr.valid & ~hidden & ~own
    core = cv2.morphologyEx(changed.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    numbers, count = ndimage.label(core, structure=np.ones((3, 3)))
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)[1:]
    return bool((sizes >= LEAST_SHARE * cost.size).any())


def _owner(witness: Witness, piece: ObjectMotion, objects: tuple[ObjectMotion, ...]) -> int:
    """The number of whom a piece belongs to: of a moving object nearby, its own, or 0 where it had better go.

    A small piece beside a larger object whose motion does not explain it is that object's shadow or reflection, or
    depth smeared along its edge: no object by itself.
    """
    mask = witness.mask(piece.id)
    if not mask.any():
        return 0
    near = np.unique(witness.labels[_spread(mask, REACH)])
    points = witness.points[mask]
    there = geometry.transform(piece.prev_T_curr, points)
    way = float(np.linalg.norm(there - points, axis=1).mean())
    best, owner = float(witness.cost(piece.prev_T_curr, mask).mean()) + WORSE, piece.id
    for obj in objects:
        if not obj.moving or obj.id not in near:
            continue
        cost = float(witness.cost(obj.prev_T_curr, mask).mean())
        apart = float(np.linalg.norm(geometry.transform(obj.prev_T_curr, points) - there, axis=1).mean())
        if cost < best:
            best, owner = cost, obj.id
        elif owner == piece.id and piece.pixels < (SMALL_ALONG if apart < ALONG * way else SMALL) * obj.pixels:
            owner = 0
    return owner


def _gather(witness: Witness, known: tuple[ObjectMotion, ...], added: tuple[ObjectMotion, ...]) -> Labels:
    """New numbers for bodies of which the network saw one part and the search found others.

    Each mover, the smallest first, joins the larger one nearby whose motion explains it best, if that is about as well
    as its own does. One of the two is new: what the network told apart stays apart. A mere fragment joins in any case.
    """
    left = {obj.id: obj for obj in known + added if obj.moving}
    new = {obj.id for obj in added}
    number = np.arange(1 + max((obj.id for obj in known + added), default=0), dtype=np.int32)
    for small in sorted(left.values(), key=lambda obj: obj.pixels):
        mask = witness.mask(small.id)
        if not mask.any():
            continue
        near = np.unique(witness.labels[_spread(mask, REACH)])
        pixels = left[small.id].pixels
        best, host = float(witness.cost(small.prev_T_curr, mask).mean()) + WORSE, None
        for other in left.values():
            if other.id == small.id or other.id not in near or other.pixels < pixels or not new & {other.id, small.id}:
                continue
            cost = float(witness.cost(other.prev_T_curr, mask).mean())
            if cost < best:
                best, host = cost, other
            elif host is None and other.id in new and pixels < FRAGMENT * other.pixels:
                host = other
        if host is not None:
            left[host.id] = dataclasses.replace(host, pixels=host.pixels + pixels)
            del left[small.id]
            number[number == small.id] = host.id
            witness.labels = np.where(witness.labels == small.id, np.int32(host.id), witness.labels)
    return number


def _spread(mask: Mask, pixels: int) -> Mask:
    """A mask grown by so many pixels."""
    size = 2 * pixels + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)
