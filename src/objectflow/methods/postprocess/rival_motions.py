"""How much worse than an object's motion the best clearly different motion explains the object.

A smooth, a symmetric or a hardly visible body fits the previous frame under many motions. That one of them fits well
is then no evidence that it is right.
"""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.alignment.batch_likelihood import batch_cost
from objectflow.alignment.batch_registration import refine_batch
from objectflow.alignment.batch_target import BatchSource, BatchTarget
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.pose_hypotheses import PoseHypotheses, perturb, suppress_duplicates
from objectflow.methods.postprocess.search_likelihood import SearchLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings, RivalSettings
from objectflow.typing import BoolMask, Float32Array, Float64Array


def rival_loss(
    frames: SearchLikelihood,
    likelihood: PairLikelihood,
    mask: BoolMask,
    motion: Float64Array,
    settings: PostprocessSettings,
) -> float:
    """The mean cost, in nats per pixel, that the best rival of a motion adds to it.

    A rival displaces the object's points by more than `RivalSettings.min_distance` or `min_relative_distance` from
    where the motion carries them. The first rivals are rotations about the centre of the visible surface, combined
    with shifts; the best on a few points are perturbed once, and the best of all are registered. Those that
    registration returns to the motion are no rivals.

    Args:
        frames: at the width of the search.
        likelihood: of the pair.
        mask: (H, W) bool, the object's pixels with depth, at the width of the likelihood.
        motion: (4, 4) `prev_T_curr`.
        settings: `rivals` and `motion_search` apply.

    Returns:
        Negative if a rival explains the object better, infinite if there is none, and 0 for a mask of fewer pixels
        than `RivalSettings.min_pixels`, which many motions explain.
    """
    rivals, search = settings.rivals, settings.motion_search
    if mask.sum() < rivals.min_pixels:
        return 0.0
    points = likelihood.points[mask].astype(np.float64)
    center, ends = points.mean(axis=0), geometry.transform(motion, points)
    displacement = float(np.linalg.norm(ends - points, axis=1).mean())
    distance = max(rivals.min_distance, rivals.min_relative_distance * displacement)
    found = _find_rivals(frames, mask, points, motion, distance, rivals)
    pair, (rows, columns) = likelihood.pair, np.nonzero(mask)
    if len(rows) > search.max_points:
        pick = np.linspace(0, len(rows) - 1, search.max_points).astype(int)
        rows, columns = rows[pick], columns[pick]
    target, source = BatchTarget.of(pair), BatchSource.take(pair, rows, columns, center)
    found = PoseHypotheses(
        *refine_batch(target, source, found.rotations, found.positions, search.last_iterations, search.registration)
    )
    found = found.take(np.flatnonzero(_distances(found, points - center, ends) > distance))
    if not len(found.rotations):
        return np.inf
    own = PoseHypotheses(motion[None, :3, :3], geometry.transform(motion, center)[None])
    every = own + found
    cost = batch_cost(
        target,
        source,
        every.rotations,
        every.positions,
        out_of_view=search.cost_out_of_view,
        settings=settings.likelihood,
    ).mean(axis=1, dtype=np.float64)
    return float(cost[1:].min() - cost[0])


def _distances(hypotheses: PoseHypotheses, centered: Float64Array, ends: Float64Array) -> Float64Array:
    """(K,) mean distance in metres between points (N, 3), given from their centre, under hypotheses and `ends`."""
    carried = centered @ np.swapaxes(hypotheses.rotations, 1, 2) + hypotheses.positions[:, None]
    return np.asarray(np.linalg.norm(carried - ends, axis=2).mean(axis=1))


def _find_rivals(
    frames: SearchLikelihood,
    mask: BoolMask,
    points: Float64Array,
    motion: Float64Array,
    distance: float,
    settings: RivalSettings,
) -> PoseHypotheses:
    """The best rivals of a motion on a few of the object's points (N, 3), the best first."""
    random = np.random.default_rng(len(points))
    chosen = random.permutation(len(points))[: settings.points]
    rows, columns = (index[chosen] for index in np.nonzero(mask))
    height, width = frames.curr_appearance.shape[:2]
    appearance = frames.curr_appearance[rows * height // mask.shape[0], columns * width // mask.shape[1]]
    centered = points[chosen] - points.mean(axis=0)
    few: Float32Array = centered.astype(np.float32)
    ends = geometry.transform(motion, points[chosen])

    def keep_best(hypotheses: PoseHypotheses, count: int) -> PoseHypotheses:
        hypotheses = hypotheses.take(np.flatnonzero(_distances(hypotheses, centered, ends) > distance))
        cost = frames(
            hypotheses.rotations,
            hypotheses.positions,
            few,
            appearance,
            depth_scale=settings.depth_scale,
            color_scale=settings.color_scale,
        ).astype(np.float64)
        angle = np.radians(settings.min_angle_deg)
        return hypotheses.take(suppress_duplicates(hypotheses, cost, count, angle, settings.min_shift))

    best = keep_best(_first_rivals(points, motion, distance, settings), settings.kept)
    if len(best.rotations):
        angle = np.radians(settings.perturbed_angle_deg)
        best = keep_best(
            best + perturb(best, settings.perturbed, angle, settings.perturbed_shift, random), settings.registered
        )
    return best


def _first_rivals(
    points: Float64Array, motion: Float64Array, distance: float, settings: RivalSettings
) -> PoseHypotheses:
    """Rotations of the carried points (N, 3) about their principal axes, combined with shifts along the camera's."""
    ends = geometry.transform(motion, points)
    center = ends.mean(axis=0)
    axes = np.linalg.eigh(np.cov((ends - center).T))[1].T
    angles = np.radians(settings.angles_deg)
    turns = np.concatenate([np.eye(3)[None], *(geometry.so3_exp(s * t * axes) for t in angles for s in (1, -1))])
    lengths = distance * np.array(settings.shift_ratios)
    shifts = np.concatenate([np.zeros((1, 3)), *(s * t * np.eye(3) for t in lengths for s in (1, -1))])
    return PoseHypotheses(
        np.repeat(turns @ motion[:3, :3], len(shifts), axis=0), np.tile(center + shifts, (len(turns), 1))
    )
