"""The motion of a known object, found by its model where the estimate of a pair lacks it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from objectflow import geometry
from objectflow.alignment.fitting import fit_matches
from objectflow.alignment.frame_pair import MATCH_WIDTH, FramePair
from objectflow.tracking.follow_settings import FollowSettings
from objectflow.tracking.model_fit import FrameView, ModelFit
from objectflow.tracking.surface_model import SurfaceModel
from objectflow.typing import Float64Array, LabelImage


class ModelPose(NamedTuple):
    """A pose that a frame confirms.

    Attributes:
        curr_T_object: (4, 4).
        present: share of the model's visible points that the frame confirms, 0..1.
    """

    curr_T_object: Float64Array
    present: float


@dataclass(frozen=True, eq=False)
class PairViews:
    """Both frames of a pair as models are compared with them, and the motion between them.

    Attributes:
        pair: the frames.
        prev, curr: the frames as models are compared with them.
        prev_T_curr: (4, 4) motion of the static background.
        prev_known: (H, W) int32 track ids of the known objects in the previous frame; None before the first pair.
    """

    pair: FramePair
    prev: FrameView
    curr: FrameView
    prev_T_curr: Float64Array
    prev_known: LabelImage | None


def model_motion(
    views: PairViews,
    model: SurfaceModel,
    given: Float64Array,
    starts: Sequence[Float64Array],
    settings: FollowSettings,
) -> ModelPose | None:
    """The best of the registered initial poses of an object, if the frames confirm it.

    The current frame must confirm clearly more of the model than at the given pose, and also clearly more than the
    previous frame does at the new pose: what was there before is another object.

    Args:
        views: the pair.
        model: of the object.
        given: (4, 4) `curr_T_object`, which the frame refutes: that of the object at rest, or that of an estimate.
        starts: (4, 4) each, `curr_T_object` by hypotheses of its motion.
        settings: thresholds.

    Returns:
        None where no pose is confirmed.
    """
    view = views.curr
    found = best_pose(view, model, starts, settings)
    if found is None:
        return None
    before = views.prev.fit(model, views.prev_T_curr @ found.curr_T_object)
    if found.present < max(view.fit(model, given).present, before.present) + settings.min_gain:
        return None
    return found if view.is_better(model, given, found.curr_T_object) else None


def best_pose(
    view: FrameView, model: SurfaceModel, starts: Sequence[Float64Array], settings: FollowSettings
) -> ModelPose | None:
    """The registered initial pose at which a frame confirms most of a model.

    Args:
        view: the frame.
        model: of an object.
        starts: (4, 4) each, initial poses `curr_T_object`.
        settings: thresholds.

    Returns:
        None where the frame confirms too little of the model.
    """
    order = sorted(range(len(starts)), key=lambda k: -_confirmed(view.fit(model, starts[k])))
    best: tuple[float, Float64Array, ModelFit] | None = None
    for k in order[: settings.max_starts]:
        pose, better = view.register(model, starts[k])
        pose = pose if better else starts[k]
        fit = view.fit(model, pose)
        if best is None or _confirmed(fit) > best[0]:
            best = _confirmed(fit), pose, fit
    if best is None:
        return None
    _, pose, fit = best
    seen = fit.fits.sum() >= settings.min_points and fit.visible >= settings.min_visible
    return ModelPose(pose, fit.present) if seen and fit.present >= settings.min_present else None


def matched_motion(views: PairViews, number: int, settings: FollowSettings) -> Float64Array | None:
    """(4, 4) `prev_T_curr` of the matches between the frames that start on a known object of the previous frame.

    Args:
        views: the pair.
        number: track id of the object.
        settings: thresholds.

    Returns:
        None for too few matches.
    """
    if views.prev_known is None:
        return None
    # Between two frames, a known object may move too far for optical flow.
    pair = views.pair.at_width(MATCH_WIDTH).with_features()
    matches, camera = pair.matches, views.pair.prev.frame.camera
    pixels = geometry.project(matches.prev.astype(np.float64), camera)
    height, width = views.prev_known.shape
    column = np.clip(np.rint(pixels[:, 0]), 0, width - 1).astype(np.int64)
    row = np.clip(np.rint(pixels[:, 1]), 0, height - 1).astype(np.int64)
    chosen = matches[views.prev_known[row, column] == number]
    if len(chosen.curr) < settings.min_matches:
        return None
    motion, inliers = fit_matches(chosen, pair.curr.frame.camera, noise=views.curr.noise, settings=settings.fit)
    return motion if inliers.sum() >= settings.min_matches else None


def _confirmed(fit: ModelFit) -> float:
    """Share of the facing points that the frame confirms."""
    return float(fit.fits.sum() / max(1, fit.facing.sum()))
