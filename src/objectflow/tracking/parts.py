"""Parts of a model: what was taken for one object while it moved together, and of which a part now rests."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from objectflow import geometry
from objectflow.tracking.follow_settings import FollowSettings
from objectflow.tracking.model_fit import FrameView
from objectflow.tracking.surface_model import SurfaceModel
from objectflow.typing import BoolMask, Float64Array


def resting_part(
    view: FrameView,
    model: SurfaceModel,
    rest: Float64Array,
    moved: Float64Array,
    mask: BoolMask,
    settings: FollowSettings,
) -> BoolMask | None:
    """The voxels of a model that rest while others move.

    Args:
        view: the current frame.
        model: of the object.
        rest, moved: (4, 4) `curr_T_object` if the object rests, and as it moves.
        mask: (H, W) bool of the surface that moves, by the estimate of the pair.
        settings: thresholds.

    Returns:
        (N,) bool, or None where the object moves as one: too few voxels rest, or too few move.
    """
    at_rest, at_moved = view.fit(model, rest), view.fit(model, moved)
    size = 2 * settings.part_margin + 1
    near = np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)
    beside = ~_inside(near, model, rest, view)
    resting = at_rest.fits & ~at_moved.fits & beside
    moving = at_moved.fits & ~resting
    least = max(settings.min_points, settings.min_part * int((resting | moving).sum()))
    if min(resting.sum(), moving.sum()) < least:
        return None
    # Where the surface looks the same at both poses, the mask decides; hidden voxels go with the nearest ones.
    resting = at_rest.fits & beside
    moving = at_moved.fits & _inside(mask, model, moved, view)
    decided = np.flatnonzero(resting != moving)
    _, nearest = cKDTree(model.points[decided]).query(model.points)
    return np.asarray(resting[decided[nearest]])


def _inside(mask: BoolMask, model: SurfaceModel, pose: Float64Array, view: FrameView) -> BoolMask:
    """(N,) bool: the voxels that a mask (H, W) contains at a pose (4, 4) `curr_T_object`."""
    camera = view.frame.frame.camera
    pixels = np.nan_to_num(geometry.project(geometry.transform(pose, model.points), camera), nan=-1)
    column = np.clip(np.rint(pixels[:, 0]), 0, camera.width - 1).astype(np.int64)
    row = np.clip(np.rint(pixels[:, 1]), 0, camera.height - 1).astype(np.int64)
    return np.asarray(mask[row, column])
