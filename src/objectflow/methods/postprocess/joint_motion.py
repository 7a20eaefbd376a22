"""One motion for two fragments: what a network cut apart is one body if a motion registered to both explains each."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.refine_objects import refine_one
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, Float64Array


def joint_motion(
    pair: FramePair,
    likelihood: PairLikelihood,
    objects: tuple[ObjectMotion, ObjectMotion],
    masks: tuple[BoolMask, BoolMask],
    settings: PostprocessSettings,
) -> tuple[Float64Array, float] | None:
    """The motion registered to both fragments, if they lose next to nothing by it.

    The motions of small fragments are inexact, so that neither of them may explain the other fragment. A motion of two
    bodies that moved differently explains at most one of them. Two bodies that one push shifted have one motion, too,
    but hardly two that turned: a motion without rotation is no evidence.

    Args:
        pair: the frames, from a static camera.
        likelihood: of the pair.
        objects: the fragments.
        masks: (H, W) bool of each, at the width of the likelihood, with depth.
        settings: `merge.joint` and `refine` apply.

    Returns:
        (4, 4) `prev_T_curr` and the mean loss in nats per pixel; None for two bodies.
    """
    joint = settings.merge.joint
    own = [likelihood.cost(obj.prev_T_curr, mask) for obj, mask in zip(objects, masks, strict=True)]
    means = [float(cost.mean()) for cost in own]
    points = likelihood.points[masks[0] | masks[1]].astype(np.float64)
    sigma = match_sigma(likelihood, points)
    if max(means) > joint.max_piece_cost or ends_apart(points, objects) > joint.max_sigmas * sigma:
        return None
    wide, small = pair.at_width(settings.refine.width), likelihood.shape
    camera = wide.curr.frame.camera
    rows, columns = nearest_indices((small[0], small[1]), (camera.height, camera.width))
    source = wide.sources.take((masks[0] | masks[1])[rows[:, None], columns], limit=settings.refine.max_points)
    best: tuple[Float64Array, float] | None = None
    for start in objects:
        motion = refine_one(wide.target, source, [start.prev_T_curr], settings.refine)
        costs = [likelihood.cost(motion, mask) for mask in masks]
        pieces = [float(cost.mean()) for cost in costs]
        lost = sum(float(cost.sum() - before.sum()) for cost, before in zip(costs, own, strict=True))
        loss = lost / sum(map(len, own))
        worst = max(piece - mean for piece, mean in zip(pieces, means, strict=True))
        if max(pieces) > joint.max_piece_cost or worst > joint.max_piece_loss or loss > joint.max_loss:
            continue
        displacement = geometry.transform(motion, points) - points
        turn = np.linalg.norm(displacement - displacement.mean(axis=0), axis=1).mean()
        if turn < joint.min_turn_sigmas * sigma:
            continue
        if best is None or loss < best[1]:
            best = motion, loss
    return best


def ends_apart(points: Float64Array, objects: tuple[ObjectMotion, ObjectMotion]) -> float:
    """Mean distance in metres between the ends of points (N, 3) under the motions of two objects."""
    ends = [geometry.transform(obj.prev_T_curr, points) for obj in objects]
    return float(np.linalg.norm(ends[0] - ends[1], axis=1).mean())


def match_sigma(likelihood: PairLikelihood, points: Float64Array) -> float:
    """Standard deviation in metres of a match at the median depth of points (N, 3)."""
    pair = likelihood.pair
    depth = np.median(points[:, 2:], axis=0).astype(np.float32)
    return float(pair.noise.match_sigma(depth, pair.curr.frame.camera)[0])
