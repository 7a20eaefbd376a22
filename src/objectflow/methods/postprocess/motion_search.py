"""A search by sampling for the motions of objects that their present motion does not explain.

A correct motion explains the previous frame far better than one that is off by centimetres; finding it is the hard
part. From the present motion and from positions with the object's colours, in many orientations, the best hypotheses
are perturbed and selected at ever finer levels, and the last few are registered to depth and colour.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import partial

import numpy as np

from objectflow import geometry
from objectflow.alignment import registration
from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.color_proposals import propose_positions
from objectflow.methods.postprocess.feature_motions import feature_motion, match_features
from objectflow.methods.postprocess.new_motion import with_motion
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.search_likelihood import SearchLikelihood
from objectflow.methods.postprocess.search_settings import MotionSearchSettings
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.runtime.side_threads import side_by_side
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray, LabelImage

_AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]], np.float64)
_AXES /= np.linalg.norm(_AXES, axis=1, keepdims=True)
"""Axes of the first rotations: the axes of the camera and the diagonals of its octants."""


@dataclasses.dataclass(frozen=True, eq=False)
class PoseHypotheses:
    """Hypotheses about an object's motion.

    Attributes:
        rotations: (K, 3, 3) `prev_R_curr`.
        positions: (K, 3) metres: position of the object's centre in the previous frame.
    """

    rotations: Float64Array
    positions: Float64Array

    def take(self, index: IndexArray) -> PoseHypotheses:
        """Some of them."""
        return PoseHypotheses(self.rotations[index], self.positions[index])

    def __add__(self, other: PoseHypotheses) -> PoseHypotheses:
        return PoseHypotheses(
            np.concatenate([self.rotations, other.rotations]), np.concatenate([self.positions, other.positions])
        )


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
    hypotheses = coarse_to_fine_search(frames, points, appearance, first, random, settings)

    pair = likelihood.pair
    source = pair.sources.take(mask, limit=settings.max_points)
    out_of_view = settings.cost_out_of_view
    own, static = (likelihood.cost(motion, mask, out_of_view=out_of_view).mean() for motion in (first, np.eye(4)))
    best, out = min(own, static) - settings.min_cost_reduction, first
    count = settings.registered
    for rotation, position in zip(hypotheses.rotations[:count], hypotheses.positions[:count], strict=True):
        start = geometry.make_transform(rotation, position - rotation @ center)
        motion = registration.refine(pair.target, source, start, settings=settings.registration).prev_T_curr
        cost = likelihood.cost(motion, mask, out_of_view=out_of_view)
        distance = np.linalg.norm(geometry.transform(motion, center) - geometry.transform(first, center))
        total = float(cost.mean()) + settings.cost_per_metre * float(distance)
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
    out = {}
    for number, (mask, motion) in objects.items():
        own, static = (
            float(likelihood.cost(one, mask, out_of_view=settings.cost_out_of_view).mean())
            for one in (motion, np.eye(4))
        )
        if own <= settings.max_trusted_cost:
            continue
        found = feature_motion(match_features(pair, settings.features), pair, likelihood, mask, settings.features)
        if found is None:
            continue
        cost = likelihood.cost(found, mask, out_of_view=settings.cost_out_of_view)
        explained = float((cost < settings.inlier_cost).mean())
        if cost.mean() < min(own, static) - settings.min_cost_reduction and explained > settings.min_inlier_ratio:
            out[number] = found
    return out


def coarse_to_fine_search(
    frames: SearchLikelihood,
    points: Float32Array,
    appearance: Float32Array,
    first: Float64Array,
    random: np.random.Generator,
    settings: MotionSearchSettings,
) -> PoseHypotheses:
    """Hypotheses about an object's motion, the best first.

    Args:
        frames: both frames.
        points: (N, 3) metres, in random order.
        appearance: (N, 3), theirs in `frames.curr_appearance`.
        first: (4, 4) the present motion.
        random: draws the perturbations.
        settings: see there.
    """
    center = points.mean(axis=0, dtype=np.float64)
    centered = (points - center).astype(np.float32)
    expected = geometry.transform(first, center)

    def evaluate(hypotheses: PoseHypotheses, count: int, depth_scale: float, color_scale: float) -> Float64Array:
        cost = frames(
            hypotheses.rotations,
            hypotheses.positions,
            centered[:count],
            appearance[:count],
            depth_scale=depth_scale,
            color_scale=color_scale,
        )
        distance = np.linalg.norm(hypotheses.positions - expected, axis=1)
        penalty = np.minimum(settings.cost_per_metre * distance, settings.max_distance_cost)
        return np.asarray(cost + penalty, dtype=np.float64)

    begin, levels = settings.start, settings.levels
    angles = np.radians(begin.angles_deg)
    turns = np.concatenate([np.eye(3)[None], *(geometry.so3_exp(s * t * _AXES) for t in angles for s in (1, -1))])
    by_color = propose_positions(frames, points, appearance, settings.max_positions, settings.colors)
    positions = np.concatenate([[expected, center], by_color])
    hypotheses = PoseHypotheses(np.tile(turns, (len(positions), 1, 1)), np.repeat(positions, len(turns), axis=0))
    hypotheses += PoseHypotheses(np.stack([first[:3, :3]] * 2), np.stack([expected, center]))
    cost = evaluate(hypotheses, begin.points, begin.depth_scale, begin.color_scale)
    hypotheses = hypotheses.take(
        suppress_duplicates(hypotheses, cost, begin.kept, np.radians(begin.min_angle_deg), begin.min_shift)
    )
    for k, shift in enumerate(levels.shifts):
        angle = np.radians(levels.angles_deg[k])
        hypotheses += perturb(hypotheses, levels.perturbed[k], angle, shift, random)
        cost = evaluate(hypotheses, levels.points, levels.depth_scales[k], levels.color_scales[k])
        hypotheses = hypotheses.take(suppress_duplicates(hypotheses, cost, levels.kept[k], angle / 2, shift / 2))
    return hypotheses


def perturb(
    hypotheses: PoseHypotheses, number: int, angle: float, shift: float, random: np.random.Generator
) -> PoseHypotheses:
    """About `number` hypotheses, rotated and shifted at random with standard deviations in radians and metres."""
    times = max(1, number // len(hypotheses.rotations))
    index = np.repeat(np.arange(len(hypotheses.rotations)), times)
    turns = geometry.so3_exp(random.normal(size=(len(index), 3)) * angle / np.sqrt(3))
    shifts = random.normal(size=(len(index), 3)) * shift
    return PoseHypotheses(turns @ hypotheses.rotations[index], hypotheses.positions[index] + shifts)


def suppress_duplicates(
    hypotheses: PoseHypotheses, cost: Float64Array, count: int, angle: float, shift: float
) -> IndexArray:
    """Indices of the cheapest hypotheses, no two of which lie within both `angle` (radians) and `shift` (metres)."""
    order = np.argsort(cost, kind="stable")[: 6 * count]
    kept: list[int] = []
    while len(order) and len(kept) < count:
        best, rest = order[0], order[1:]
        kept.append(int(best))
        cosine = ((hypotheses.rotations[rest] * hypotheses.rotations[best]).sum((1, 2)) - 1) / 2
        apart = np.linalg.norm(hypotheses.positions[rest] - hypotheses.positions[best], axis=1) > shift
        order = rest[apart | (cosine < np.cos(angle))]
    return np.array(kept, dtype=np.intp)
