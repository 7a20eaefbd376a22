"""Recovery of moving objects that the network missed, by the steps of `consensus` on the pixels of no known object.

A network knows what it was trained on. The frames themselves show that something moved: a surface violates free space,
or its colour changed.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.geometry.resample import upsample_mask
from objectflow.methods.consensus.estimator import ConsensusEstimator
from objectflow.methods.labels import Objects, relabel_present
from objectflow.methods.postprocess.changed_regions import changed_regions
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.resting_masks import take_resting_masks
from objectflow.methods.postprocess.settings import MissedObjectSettings, PostprocessSettings
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, LabelImage


def recover_missed_objects(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Add moving objects beside the known ones, and attach pieces that follow a known object's motion to it.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: of these labels.
        settings: `missed_objects` and `likelihood` apply.

    Returns:
        Labels and objects, numbered anew from 1.
    """
    likelihood, search = PairLikelihood.of(pair, settings.likelihood), settings.missed_objects
    rim = max(1, round(search.rim_px * labels.shape[1] / likelihood.shape[1]))
    proposed = labels
    # A mask at rest of low probability may be wrong, so its pixels are searched like those of the background.
    certain = [obj.id for obj in objects if obj.moving or obj.score >= settings.min_static_score]
    labels = np.where(np.isin(labels, certain), labels, np.int32(0))
    known = _dilated((labels > 0) & ~_unexplained(likelihood, labels, objects, search), rim)
    if not _has_changed(likelihood, known, search):
        return proposed, objects
    others = [(obj.prev_T_curr, labels == obj.id) for obj in objects if obj.moving]
    consensus = ConsensusEstimator(
        rounds=search.rounds,
        min_object_share=search.min_object_share,
        likelihood=settings.likelihood,
        fit=settings.refine.fit,
        registration=settings.refine.registration,
    )
    more = consensus.find(pair, known=known, others=others)
    first = max((obj.id for obj in objects), default=0)
    added = tuple(dataclasses.replace(obj, id=first + obj.id) for obj in more.objects if obj.score >= search.min_score)
    kept = np.isin(more.labels, [obj.id - first for obj in added])
    labels = np.where(kept, more.labels + np.int32(first), labels)
    small = likelihood.downscale(labels)
    number = np.arange(1 + first + len(more.objects), dtype=np.int32)
    for piece in added:
        number[piece.id] = _attach_or_drop(likelihood, small, piece, objects, search)
    own = tuple(piece for piece in added if number[piece.id] == piece.id)
    labels = number[labels]
    merged = _merge_new_parts(likelihood, likelihood.downscale(labels), objects, own, search)
    labels = merged[labels]
    resting = tuple(obj for obj in objects if not obj.moving)
    labels, own = take_resting_masks(pair, labels, own, proposed, resting, settings)
    # What no found object took stays where it was.
    uncertain = np.where(np.isin(proposed, certain), np.int32(0), proposed)
    return relabel_present(np.where(labels > 0, labels, uncertain), objects + own)


def _unexplained(
    likelihood: PairLikelihood, labels: LabelImage, objects: Objects, settings: MissedObjectSettings
) -> BoolMask:
    """(H, W) bool: larger regions of objects at rest that cannot have stood still: something moved there."""
    small = likelihood.downscale(labels)
    resting = np.isin(small, [obj.id for obj in objects if not obj.moving])
    regions = changed_regions(
        likelihood, resting, changed_cost=settings.changed_cost, min_share=settings.min_object_share
    )
    grown = cv2.dilate((regions > 0).astype(np.uint8), np.ones((5, 5))) > 0
    return upsample_mask(grown, labels.shape) & (labels > 0)


def _has_changed(likelihood: PairLikelihood, known: BoolMask, settings: MissedObjectSettings) -> bool:
    """Whether standing still does not explain some larger region beside the known objects."""
    height, width = likelihood.shape
    own = cv2.resize(known.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    regions = changed_regions(
        likelihood, ~own, changed_cost=settings.changed_cost, min_share=settings.min_object_share
    )
    return bool(regions.any())


def _attach_or_drop(
    likelihood: PairLikelihood,
    labels: LabelImage,
    piece: ObjectMotion,
    objects: Objects,
    settings: MissedObjectSettings,
) -> int:
    """The id that a new piece takes: that of a moving neighbour, its own, or 0 to drop it.

    A small piece beside a larger object whose motion does not explain it is a shadow, a reflection, or depth smeared
    along an edge.
    """
    mask = likelihood.mask(labels, piece.id)
    if not mask.any():
        return 0
    near = np.unique(labels[_dilated(mask, settings.neighbour_px)])
    points = likelihood.points[mask]
    end = geometry.transform(piece.prev_T_curr, points)
    length = float(np.linalg.norm(end - points, axis=1).mean())
    best, owner = float(likelihood.cost(piece.prev_T_curr, mask).mean()) + settings.max_loss, piece.id
    for obj in objects:
        if not obj.moving or obj.id not in near:
            continue
        cost = float(likelihood.cost(obj.prev_T_curr, mask).mean())
        apart = float(np.linalg.norm(geometry.transform(obj.prev_T_curr, points) - end, axis=1).mean())
        same_motion = apart < settings.same_motion_ratio * length
        min_ratio = settings.min_area_ratio_same_motion if same_motion else settings.min_area_ratio
        if cost < best:
            best, owner = cost, obj.id
        elif owner == piece.id and piece.pixels < min_ratio * obj.pixels:
            owner = 0
    return owner


def _merge_new_parts(
    likelihood: PairLikelihood,
    labels: LabelImage,
    known: Objects,
    added: Objects,
    settings: MissedObjectSettings,
) -> LabelImage:
    """New ids for bodies of which the network found one part and the search found others.

    Each moving object, the smallest first, is merged into the larger neighbour whose motion explains it best, if it
    does so about as well as its own. One of the two must be new, so that objects which the network separated stay
    separate. A mere fragment is merged in any case.
    """
    left = {obj.id: obj for obj in known + added if obj.moving}
    new = {obj.id for obj in added}
    number = np.arange(1 + max((obj.id for obj in known + added), default=0), dtype=np.int32)
    for small in sorted(left.values(), key=lambda obj: obj.pixels):
        mask = likelihood.mask(labels, small.id)
        if not mask.any():
            continue
        near = np.unique(labels[_dilated(mask, settings.neighbour_px)])
        pixels = left[small.id].pixels
        best, host = float(likelihood.cost(small.prev_T_curr, mask).mean()) + settings.max_loss, None
        for other in left.values():
            if other.id == small.id or other.id not in near or other.pixels < pixels or not new & {other.id, small.id}:
                continue
            cost = float(likelihood.cost(other.prev_T_curr, mask).mean())
            if cost < best:
                best, host = cost, other
            elif host is None and other.id in new and pixels < settings.fragment_area_ratio * other.pixels:
                host = other
        if host is not None:
            left[host.id] = dataclasses.replace(host, pixels=host.pixels + pixels)
            del left[small.id]
            number[number == small.id] = host.id
            labels = np.where(labels == small.id, np.int32(host.id), labels)
    return number


def _dilated(mask: BoolMask, pixels: int) -> BoolMask:
    """A mask grown by a number of pixels."""
    size = 2 * pixels + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)
