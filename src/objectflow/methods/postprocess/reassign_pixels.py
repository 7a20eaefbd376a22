"""Assignment of pixels between the movers and standing still, once the motions are known.

A network decides masks before motions are known. Each mask is an anchor: a mover keeps what touches its anchor and
follows its motion, and loses what stands still.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from objectflow.alignment.frame_pair import FramePair
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.consensus.assignment import Assignment
from objectflow.methods.labels import Objects, relabel_present
from objectflow.methods.mask_edges import upsample_labels
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings, ReassignSettings
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, Float32Array, LabelImage


def reassign_pixels(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Assign pixels anew between moving objects and standing still, and snap the borders to the full image.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: of these labels.
        settings: `reassign`, `likelihood` and `snap_to_edges` apply.

    Returns:
        Labels and objects, numbered anew from 1. Objects at rest keep their pixels unless a mover explains them far
        better.
    """
    small = pair.at_width(settings.likelihood.width)
    likelihood = PairLikelihood.of(pair, settings.likelihood)
    old = likelihood.downscale(labels)
    moving = np.isin(old, [obj.id for obj in objects if obj.moving])
    movers = [
        obj
        for obj in objects
        if obj.moving
        and not _touches(old == obj.id, moving, settings.reassign)
        and _is_explained(likelihood, old, obj, settings.reassign)
    ]
    new = old
    if movers:
        new = _assigned(small, old, objects, movers, settings)
    full = upsample_labels(new, pair.curr.frame, pair.noise, settings.snap_to_edges)
    # Pixels without depth keep their label where it is still the one around them.
    rows, columns = nearest_indices(new.shape, labels.shape)
    nearest = new[rows[:, None], columns]
    full = np.where(pair.curr.frame.valid, full, np.where(nearest == labels, labels, full))
    return relabel_present(full.astype(np.int32), objects)


def _touches(mask: BoolMask, moving: BoolMask, settings: ReassignSettings) -> bool:
    """Whether another mover lies beside a mask.

    Motions in a pile resemble each other too much to divide pixels between them better than the network does.
    """
    size = 2 * settings.neighbour_px + 1
    near = cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    return bool((near & moving & ~mask).any())


def _is_explained(
    likelihood: PairLikelihood, labels: LabelImage, obj: ObjectMotion, settings: ReassignSettings
) -> bool:
    """Whether an object's motion explains enough of its mask to decide about pixels."""
    mask = likelihood.mask(labels, obj.id)
    if mask.sum() < settings.min_pixels:
        return False
    cost = likelihood.cost(obj.prev_T_curr, mask)
    return bool((cost < settings.inlier_cost).mean() >= settings.min_inlier_ratio)


def _assigned(
    small: FramePair, labels: LabelImage, objects: Objects, movers: list[ObjectMotion], settings: PostprocessSettings
) -> LabelImage:
    """Labels at the width of the likelihood."""
    own = settings.reassign
    assignment = Assignment(
        small,
        None,
        min_pixels=own.min_pixels,
        likelihood=settings.likelihood,
        graph=own.graph,
        settings=own.assignment,
    )
    moving = {obj.id for obj in movers}
    fixed = (labels > 0) & ~np.isin(labels, list(moving))
    masks = [labels == obj.id for obj in movers]
    motions = [obj.prev_T_curr for obj in movers]
    outside = _growth_cost(assignment, settings) + np.where(labels > 0, own.other_object, 0.0)
    priors = [np.where(mask, -own.own_mask, outside).astype(np.float32) for mask in masks]
    anchors = [assignment.anchors(mask, motion) for mask, motion in zip(masks, motions, strict=True)]
    assignment.limit([assignment.around(points) for points in anchors])
    found = assignment.assign(motions, anchors, masks, fine=True, priors=priors)
    out = np.where(fixed, labels, 0).astype(np.int32)
    for number, (obj, mask) in enumerate(zip(movers, masks, strict=True), start=1):
        region = _touching(found == number, mask)
        cost = assignment.cost(obj.prev_T_curr, assignment.around(anchors[number - 1]))
        out[_changed(mask, region, cost, assignment.background_cost, own)] = obj.id
    return out


def _growth_cost(assignment: Assignment, settings: PostprocessSettings) -> Float32Array:
    """(H, W) cost of growing into each pixel, by the evidence that a fit of a motion is there."""
    own = settings.reassign
    texture = cv2.blur(assignment.pair.curr.appearance.contrast[0], (7, 7)) / own.full_texture
    impossible = assignment.background_cost >= settings.likelihood.free_space_violation
    at_rest = cv2.blur((assignment.background_cost < own.inlier_cost).astype(np.float32), (5, 5))
    evidence = np.where(impossible, 1.0, np.minimum(texture, 1.0) * (1 - at_rest))
    return np.asarray(own.growth + (own.textured_growth - own.growth) * evidence, dtype=np.float32)


def _changed(
    mask: BoolMask, region: BoolMask, moved: Float32Array, rested: Float32Array, settings: ReassignSettings
) -> BoolMask:
    """(H, W) bool: the assigned region where the costs of moving and of resting nearby support it, else the mask."""
    growth, loss = region & ~mask, mask & ~region
    size = settings.evidence_px
    move, rest = _nearby(moved, growth, size), _nearby(rested, growth, size)
    growth &= (move < settings.max_growth_cost) & (move < rest)
    move, rest = _nearby(moved, loss, size), _nearby(rested, loss, size)
    unexplained = move > np.minimum(settings.min_loss_cost, rest + settings.min_loss_gain)
    loss &= unexplained & (rest < settings.max_rest_cost)
    return np.asarray((mask & ~loss) | growth)


def _nearby(cost: Float32Array, region: BoolMask, size: int) -> Float32Array:
    """(H, W) mean costs of a region's pixels within a square of `size` pixels around each pixel."""
    share = cv2.blur(region.astype(np.float32), (size, size))
    total = cv2.blur(np.where(region, cost, np.float32(0)), (size, size))
    return np.asarray(total / np.maximum(share, np.float32(1e-6)))


def _touching(found: BoolMask, mask: BoolMask) -> BoolMask:
    """The connected parts of a region that overlap a mask."""
    opened = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0
    grown = opened | (found & mask)
    numbers, _ = ndimage.label(grown)
    kept = np.unique(numbers[mask & (numbers > 0)])
    return np.asarray(np.isin(numbers, kept[kept > 0]))
