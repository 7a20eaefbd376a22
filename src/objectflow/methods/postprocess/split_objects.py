"""Splitting of masks that hold two things: separate surfaces of one mask that different motions explain.

A network gives one query to two things that lie close together, such as a ball that moves beside a carrot that does
not. One motion then explains only one of them, or neither.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from scipy import ndimage

from objectflow.alignment import fitting
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.matching import inside
from objectflow.alignment.refine_objects import refine_one
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.labels import Objects, relabel_present
from objectflow.methods.postprocess.new_motion import with_motion
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings, SplitSettings
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, Float64Array, IndexArray, LabelImage


def split_objects(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Give the separate surfaces of a mask motions of their own, and make them objects where these differ.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: with their motions.
        settings: `split`, `refine` and `likelihood` apply.

    Returns:
        Labels and objects, numbered anew from 1. A part that moves by itself has the score of the whole.
    """
    likelihood = PairLikelihood.of(pair, settings.likelihood)
    small = likelihood.downscale(labels)
    surfaces = _surfaces(likelihood, settings.split)
    objects = tuple(_with_core_motion(pair, likelihood, small, obj, settings) for obj in objects)
    out, new = list(objects), small.copy()
    for obj in objects:
        parts = _parts(likelihood.mask(small, obj.id), surfaces, settings.split)
        if len(parts) < 2:
            continue
        groups = _groups(pair, likelihood, obj, parts, settings)
        if any(_cost(likelihood, motion, mask) > settings.split.max_cost for motion, mask in groups):
            continue
        for motion, mask in groups[1:]:
            number = 1 + max(one.id for one in out)
            new[mask] = number
            out.append(_with_motion(dataclasses.replace(obj, id=number), motion, likelihood, mask, settings))
        if len(groups) > 1:
            motion, mask = groups[0]
            out[out.index(obj)] = _with_motion(obj, motion, likelihood, mask, settings)
    if len(out) == len(objects):
        return labels, objects
    rows, columns = nearest_indices(new.shape, labels.shape)
    full = new[rows[:, None], columns]
    # Only pixels of divided masks change; the others keep the borders of the full image.
    divided = full > max(obj.id for obj in objects)
    return relabel_present(np.where(divided & (labels > 0), full, labels).astype(np.int32), tuple(out))


def _with_core_motion(
    pair: FramePair, likelihood: PairLikelihood, labels: LabelImage, obj: ObjectMotion, settings: PostprocessSettings
) -> ObjectMotion:
    """The object with the motion of the pixels that cannot have stood still, where its own explains them badly.

    A mask may hold more than what moved: depth that a temporal filter left where the object was, or its shadow.
    """
    own, mask = settings.split, likelihood.mask(labels, obj.id)
    static, _ = likelihood.static_cost()
    core = mask & (static >= settings.likelihood.free_space_violation)
    if core.sum() < max(own.min_pixels, own.min_core_share * mask.sum()):
        return obj
    if _cost(likelihood, obj.prev_T_curr, core) < own.max_cost:
        return obj
    motion, cost = _best_motion(pair, likelihood, obj.prev_T_curr, core, settings)
    if cost > own.max_core_cost:
        return obj
    return _with_motion(obj, motion, likelihood, mask, settings)


def _surfaces(likelihood: PairLikelihood, settings: SplitSettings) -> BoolMask:
    """(H, W) bool: pixels that no depth step crosses."""
    depth = likelihood.pair.curr.frame.depth
    step = cv2.dilate(depth, np.ones((3, 3))) - cv2.erode(depth, np.ones((3, 3)))
    limit = settings.depth_slope * depth + settings.depth_sigmas * likelihood.pair.noise.sigma(depth)
    return np.asarray((depth > 0) & (step < limit))


def _parts(mask: BoolMask, surfaces: BoolMask, settings: SplitSettings) -> list[BoolMask]:
    """The separate surfaces of a mask that are large enough, with the pixels of the mask that are nearest to each."""
    numbers, count = ndimage.label(mask & surfaces)
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)
    sizes[0] = 0
    least = max(settings.min_pixels, settings.min_share * int(mask.sum()))
    large: IndexArray = np.flatnonzero(sizes >= least)
    if len(large) < 2:
        return []
    kept = np.isin(numbers, large)
    rows, columns = ndimage.distance_transform_edt(~kept, return_distances=False, return_indices=True)
    nearest = np.where(mask, numbers[rows, columns], 0)
    return [nearest == number for number in large[np.argsort(-sizes[large])]]


def _groups(
    pair: FramePair,
    likelihood: PairLikelihood,
    obj: ObjectMotion,
    parts: list[BoolMask],
    settings: PostprocessSettings,
) -> list[tuple[Float64Array, BoolMask]]:
    """Motions and masks of the parts, of which those that one motion explains are together."""
    groups: list[tuple[Float64Array, BoolMask]] = []
    for part in parts:
        own, cost = _best_motion(pair, likelihood, obj.prev_T_curr, part, settings)
        for number, (motion, mask) in enumerate(groups):
            if _cost(likelihood, motion, part) < cost + settings.split.max_loss:
                groups[number] = motion, mask | part
                break
        else:
            groups.append((own, part))
    return groups


def _best_motion(
    pair: FramePair, likelihood: PairLikelihood, first: Float64Array, part: BoolMask, settings: PostprocessSettings
) -> tuple[Float64Array, float]:
    """The motion that explains a part best, among the whole's, the part's own and none; and its mean cost.

    A part that the whole's motion or standing still explains is not registered by itself, and a part that a
    registered motion explains is not registered from further starts.
    """
    candidates = [first, np.eye(4)]
    costs = [_cost(likelihood, motion, part) for motion in candidates]
    registered = _registered(pair, part, tuple(candidates), settings)
    while min(costs) > settings.split.max_trusted_cost and (motion := next(registered, None)) is not None:
        candidates.append(motion)
        costs.append(_cost(likelihood, motion, part))
    best = int(np.argmin(costs))
    return candidates[best], costs[best]


def _registered(
    pair: FramePair, part: BoolMask, starts: Sequence[Float64Array], settings: PostprocessSettings
) -> Iterator[Float64Array]:
    """The motions of a part that registration finds from each start and from the fit to its matches."""
    wide = pair.at_width(settings.refine.width)
    frame = wide.curr.frame
    rows, columns = nearest_indices(part.shape, frame.depth.shape)
    source = wide.sources.take(part[rows[:, None], columns], limit=settings.split.max_points)
    for start in starts:
        yield refine_one(wide.target, source, [start], settings.refine)
    matches = wide.matches[inside(part, wide.matches, frame.camera)]
    if len(matches.curr) >= settings.refine.min_matches:
        start = fitting.fit_matches(matches, frame.camera, noise=wide.noise, settings=settings.refine.fit)[0]
        yield refine_one(wide.target, source, [start], settings.refine)


def _cost(likelihood: PairLikelihood, motion: Float64Array, mask: BoolMask) -> float:
    if np.array_equal(motion, np.eye(4)):
        return float(likelihood.cost_at_rest(mask).mean())
    return float(likelihood.cost(motion, mask).mean())


def _with_motion(
    obj: ObjectMotion, motion: Float64Array, likelihood: PairLikelihood, mask: BoolMask, settings: PostprocessSettings
) -> ObjectMotion:
    """An object of the pixels of a mask, with their motion."""
    center = np.asarray(likelihood.points[mask].mean(axis=0), dtype=np.float64)
    part = dataclasses.replace(obj, center=center)
    return with_motion(part, motion, likelihood.points[mask], settings.static_test.static_displacement)
