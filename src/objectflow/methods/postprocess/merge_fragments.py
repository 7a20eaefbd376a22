"""Merging of fragments: networks over-segment long and thin bodies, such as a hammer into handle and head."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial import cKDTree

from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.labels import Objects, relabel_present
from objectflow.methods.postprocess.joint_motion import ends_apart, joint_motion, match_sigma
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import MergeSettings, PostprocessSettings
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, Float64Array, LabelImage


def merge_fragments(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Merge moving objects that touch along a continuous surface and that one motion explains.

    Each object, the smallest first, is merged into the neighbour with which the least likelihood is lost. Where the
    two motions agree within the noise of matches, they may explain their objects less well. Neighbours beyond a small
    gap or a step of depth, such as the handle of a cup, are merged if the motions agree or hardly anything is lost.
    The common motion must explain each of them by itself. Where no motion of a fragment explains its neighbour, one
    that is registered to both may, also beyond a larger gap; see `joint_motion`.
    Two bodies that move as one cannot be told from one body; static objects are never merged.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: of these labels.
        settings: `merge` and `likelihood` apply.

    Returns:
        Labels and objects, numbered anew from 1. A merged object has the higher score and the larger piece's centre.
    """
    likelihood = PairLikelihood.of(pair, settings.likelihood)
    small_labels = likelihood.downscale(labels)
    left = {obj.id: obj for obj in objects}
    renamed = np.arange(1 + max(left, default=0), dtype=np.int32)
    samples: dict[int, Float64Array] = {}
    for number in sorted((obj.id for obj in objects if obj.moving), key=lambda number: left[number].pixels):
        small = left[number]
        found = _partner(likelihood, small_labels, small, left, samples, settings.merge)
        found = found or _joint_partner(pair, likelihood, small_labels, small, left, samples, settings)
        if found is None:
            continue
        large, motion = found
        left[large.id] = dataclasses.replace(
            large,
            pixels=small.pixels + large.pixels,
            score=max(small.score, large.score),
            prev_T_curr=motion,
        )
        del left[small.id]
        samples.pop(large.id, None)
        renamed[renamed == small.id] = large.id
        small_labels = np.where(small_labels == small.id, np.int32(large.id), small_labels)
    if len(left) == len(objects):
        return labels, objects
    return relabel_present(renamed[labels], tuple(left.values()))


def _partner(
    likelihood: PairLikelihood,
    labels: LabelImage,
    small: ObjectMotion,
    objects: dict[int, ObjectMotion],
    samples: dict[int, Float64Array],
    settings: MergeSettings,
) -> tuple[ObjectMotion, Float64Array] | None:
    """The object into which an object is merged, and the motion of both; None for none.

    `samples` keeps points of the objects by their numbers.
    """
    mask = likelihood.mask(labels, small.id)
    if not mask.any():
        return None
    own = likelihood.cost(small.prev_T_curr, mask).sum()
    best, out = settings.max_loss, None
    contact = likelihood.contact_ratio(labels, mask, settings.max_depth_step)
    for number, other in objects.items():
        if number == small.id or not other.moving or other.pixels < small.pixels:
            continue
        theirs = likelihood.mask(labels, number)
        joined = contact.get(number, 0.0) >= settings.min_contact
        if not theirs.any():
            continue
        if not joined:
            points = _sample(likelihood, mask, small.id, samples, settings)
            others = _sample(likelihood, theirs, number, samples, settings)
            if not _near(points, others, settings.max_gap_ratio):
                continue
        union = likelihood.points[mask | theirs].astype(np.float64)
        agree = ends_apart(union, (small, other)) < settings.agreement_sigmas * match_sigma(likelihood, union)
        limit = best if joined or agree else min(best, settings.max_apart_loss)
        max_cost = settings.max_cost * (settings.agreement_factor if agree and joined else 1.0)
        apart = own + likelihood.cost(other.prev_T_curr, theirs).sum()
        max_piece_cost = settings.max_piece_cost if joined else settings.max_apart_piece_cost
        for motion in (other.prev_T_curr, small.prev_T_curr):
            pieces = [likelihood.cost(motion, piece) for piece in (mask, theirs)]
            if max(float(cost.mean()) for cost in pieces) > max_piece_cost:
                continue
            together, count = sum(float(cost.sum()) for cost in pieces), mask.sum() + theirs.sum()
            lost = float(together - apart) / count
            if lost < limit and together < max_cost * count:
                best = limit = lost
                out = other, motion
    return out


def _joint_partner(
    pair: FramePair,
    likelihood: PairLikelihood,
    labels: LabelImage,
    small: ObjectMotion,
    objects: dict[int, ObjectMotion],
    samples: dict[int, Float64Array],
    settings: PostprocessSettings,
) -> tuple[ObjectMotion, Float64Array] | None:
    """`_partner` by a motion that is registered to both."""
    joint, mask = settings.merge.joint, likelihood.mask(labels, small.id)
    if mask.sum() < joint.min_pixels:
        return None
    best, out = np.inf, None
    points = _sample(likelihood, mask, small.id, samples, settings.merge)
    for number, other in objects.items():
        theirs = likelihood.mask(labels, number)
        if number == small.id or not other.moving or other.pixels < small.pixels or not theirs.any():
            continue
        if not _near(points, _sample(likelihood, theirs, number, samples, settings.merge), joint.max_gap_ratio):
            continue
        found = joint_motion(pair, likelihood, (small, other), (mask, theirs), settings)
        if found is not None and found[1] < best:
            best, out = found[1], (other, found[0])
    return out


def _sample(
    likelihood: PairLikelihood,
    mask: BoolMask,
    number: int,
    samples: dict[int, Float64Array],
    settings: MergeSettings,
) -> Float64Array:
    """At most about `max_points` points of an object, kept in `samples`."""
    if number not in samples:
        points = likelihood.points[mask]
        samples[number] = points[:: 1 + len(points) // settings.max_points].astype(np.float64)
    return samples[number]


def _near(points: Float64Array, others: Float64Array, max_gap_ratio: float) -> bool:
    """Whether the gap between two objects is small beside the second: another object may hide what joins them."""
    limit = max_gap_ratio * float(np.linalg.norm(np.ptp(others, axis=0)))
    # Bounding boxes are never farther apart than the points in them.
    apart = np.maximum(points.min(axis=0) - others.max(axis=0), others.min(axis=0) - points.max(axis=0))
    if np.linalg.norm(np.maximum(apart, 0)) >= limit:
        return False
    return bool(np.min(cKDTree(others).query(points, distance_upper_bound=limit)[0]) < limit)
