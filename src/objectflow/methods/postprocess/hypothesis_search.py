"""The search among hypotheses about one object's motion: coarse, then by registration and the likelihood itself."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.alignment.batch_likelihood import batch_cost
from objectflow.alignment.batch_registration import refine_batch
from objectflow.alignment.batch_target import BatchSource, BatchTarget
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import LikelihoodSettings
from objectflow.methods.postprocess.color_proposals import propose_positions
from objectflow.methods.postprocess.motion_prior import MotionPrior
from objectflow.methods.postprocess.pose_hypotheses import PoseHypotheses, perturb, suppress_duplicates
from objectflow.methods.postprocess.search_likelihood import SearchLikelihood
from objectflow.methods.postprocess.search_settings import MotionSearchSettings
from objectflow.typing import Float32Array, Float64Array

_AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]], np.float64)
_AXES /= np.linalg.norm(_AXES, axis=1, keepdims=True)
"""Axes of the first rotations: the axes of the camera and the diagonals of its octants."""


def coarse_search(
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


def judged_search(
    pair: FramePair,
    source: BatchSource,
    hypotheses: PoseHypotheses,
    prior: MotionPrior,
    random: np.random.Generator,
    likelihood: LikelihoodSettings,
    settings: MotionSearchSettings,
) -> PoseHypotheses:
    """Register hypotheses, perturb the best and register these, and return the best of all first.

    Args:
        pair: the frames, at the width of the likelihood.
        source: the object's points, in random order.
        hypotheses: the initial motions.
        prior: of the motion.
        random: draws the perturbations.
        likelihood: by which they are judged.
        settings: see there.
    """
    target, judged = BatchTarget.of(pair), settings.judged
    source, fewer = source.first(judged.points), source.first(judged.registered_points)

    def register(some: PoseHypotheses) -> tuple[PoseHypotheses, Float64Array]:
        some = PoseHypotheses(
            *refine_batch(target, fewer, some.rotations, some.positions, judged.iterations, judged.registration)
        )
        cost = batch_cost(
            target,
            source,
            some.rotations,
            some.positions,
            out_of_view=settings.cost_out_of_view,
            settings=likelihood,
        )
        return some, cost.mean(axis=1, dtype=np.float64) + prior(some)

    angle, shift = np.radians(judged.angle_deg), judged.shift
    hypotheses, cost = register(hypotheses)
    best = suppress_duplicates(hypotheses, cost, judged.kept, angle / 2, shift / 2)
    hypotheses, cost = hypotheses.take(best), cost[best]
    more, more_cost = register(perturb(hypotheses, judged.perturbed, angle, shift, random))
    hypotheses, cost = hypotheses + more, np.concatenate([cost, more_cost])
    distinct = np.radians(judged.distinct_angle_deg), judged.distinct_shift
    return hypotheses.take(suppress_duplicates(hypotheses, cost, settings.registered, *distinct))
