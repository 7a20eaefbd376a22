"""A search by sampling for the motions of objects that their present motion does not explain.

A correct motion explains the previous frame far better than one that is off by centimetres; finding it is the hard
part. From the present motion and from positions with the object's colours, in many orientations, the best hypotheses
are perturbed and selected by a coarse likelihood, then registered to depth and colour, all at once, and judged by the
likelihood proper: the coarse one prefers some wrong motion to the correct one nearly always.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from objectflow import geometry
from objectflow.alignment.batch_registration import refine_batch
from objectflow.alignment.batch_target import BatchSource, BatchTarget
from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.feature_motions import feature_motion, match_features
from objectflow.methods.postprocess.hypothesis_search import coarse_search, judged_search
from objectflow.methods.postprocess.motion_prior import MotionPrior
from objectflow.methods.postprocess.new_motion import with_motion
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.pose_hypotheses import PoseHypotheses
from objectflow.methods.postprocess.search_likelihood import SearchLikelihood
from objectflow.methods.postprocess.search_settings import MotionSearchSettings
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.runtime.side_threads import side_by_side
from objectflow.typing import BoolMask, Float64Array, LabelImage


def search_motions(
    pair: FramePair, labels: LabelImage, objects: Objects, settings: PostprocessSettings
) -> tuple[LabelImage, Objects]:
    """Replace the motions of moving objects that do not fit by better ones, where the frames support such.

    Args:
        pair: the frames, from a static camera.
        labels: (H, W) int32.
        objects: with their present motions.
        settings: `motion_search` and `likelihood` apply.

    Returns:
        The same labels and objects; `moving` follows a new motion's size. The result is deterministic.
    """
    likelihood, search = PairLikelihood.of(pair, settings.likelihood), settings.motion_search
    small = likelihood.downscale(labels)
    motions = {obj.id: obj.prev_T_curr for obj in objects if obj.moving}
    masks = {number: likelihood.mask(small, number) for number in motions}
    doubted = {
        number: mask
        for number, mask in masks.items()
        if mask.sum() >= search.min_pixels
        and likelihood.cost(motions[number], mask, out_of_view=search.cost_out_of_view).mean()
        > search.max_trusted_cost
    }
    if not doubted:
        return labels, objects
    frames = SearchLikelihood.of(pair, settings)
    searches = (
        partial(_search, frames, likelihood, mask, motions[number], search) for number, mask in doubted.items()
    )
    found = dict(zip(doubted, side_by_side(*searches), strict=True))
    found |= _by_features(pair, likelihood, {number: (doubted[number], found[number]) for number in doubted}, search)
    tolerance = settings.static_test.static_displacement
    return labels, tuple(
        with_motion(obj, found[obj.id], likelihood.points[masks[obj.id]], tolerance)
        if obj.id in found and found[obj.id] is not obj.prev_T_curr
        else obj
        for obj in objects
    )


def _search(
    frames: SearchLikelihood,
    likelihood: PairLikelihood,
    mask: BoolMask,
    first: Float64Array,
    settings: MotionSearchSettings,
) -> Float64Array:
    """The motion of one object: `first`, or one that explains it better."""
    random = np.random.default_rng(int(mask.sum()))
    rows, columns = np.nonzero(mask)
    order = random.permutation(len(rows))
    rows, columns = rows[order], columns[order]
    points = likelihood.points[rows, columns]
    height, width = frames.curr_appearance.shape[:2]
    appearance = frames.curr_appearance[rows * height // mask.shape[0], columns * width // mask.shape[1]]
    center = points.mean(axis=0, dtype=np.float64)
    hypotheses = coarse_search(frames, points, appearance, first, random, settings)
    pair = likelihood.pair
    source = BatchSource.take(pair, rows[: settings.max_points], columns[: settings.max_points], center)
    prior = MotionPrior(first, center, len(rows), settings)
    hypotheses = judged_search(pair, source, hypotheses, prior, random, likelihood.settings, settings)
    hypotheses = PoseHypotheses(
        *refine_batch(
            BatchTarget.of(pair),
            source,
            hypotheses.rotations,
            hypotheses.positions,
            settings.last_iterations,
            settings.registration,
        )
    )

    own, static = (
        likelihood.cost(motion, mask, out_of_view=settings.cost_out_of_view).mean() for motion in (first, np.eye(4))
    )
    best, out = min(own, static) - settings.min_cost_reduction, first
    for rotation, position in zip(hypotheses.rotations, hypotheses.positions, strict=True):
        motion = geometry.make_transform(rotation, position - rotation @ center)
        cost = likelihood.cost(motion, mask, out_of_view=settings.cost_out_of_view)
        total = float(cost.mean()) + prior(prior.hypothesis(motion)).item()
        if total < best and (cost < settings.inlier_cost).mean() > settings.min_inlier_ratio:
            best, out = total, motion
    return out


def _by_features(
    pair: FramePair,
    likelihood: PairLikelihood,
    objects: Mapping[int, tuple[BoolMask, Float64Array]],
    settings: MotionSearchSettings,
) -> dict[int, Float64Array]:
    """Better motions of objects, given with their masks and motions, that the search leaves unexplained."""
    features, out = settings.features, {}
    for number, (mask, motion) in objects.items():
        if mask.sum() < features.min_pixels:
            continue
        own, static = (
            float(likelihood.cost(one, mask, out_of_view=settings.cost_out_of_view).mean())
            for one in (motion, np.eye(4))
        )
        if own <= max(features.min_cost, settings.max_trusted_cost):
            continue
        found = feature_motion(match_features(pair, features), pair, likelihood, mask, features)
        if found is None:
            continue
        cost = likelihood.cost(found, mask, out_of_view=settings.cost_out_of_view)
        explained = float((cost < settings.inlier_cost).mean())
        if cost.mean() < min(own, static) - features.min_cost_reduction and explained > features.min_inlier_ratio:
            out[number] = found
    return out
