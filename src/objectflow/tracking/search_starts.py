"""Initial poses of a known object whose motion is unknown: in a mask, and where the frames changed."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow import geometry
from objectflow.geometry.resample import resize_nearest
from objectflow.tracking.known_object import KnownObject
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.model_fit import FrameView
from objectflow.tracking.model_motion import PairViews
from objectflow.tracking.unexplained_change import unexplained_regions
from objectflow.typing import BoolMask, Float64Array


def starts_in_mask(
    view: FrameView, known: KnownObject, mask: BoolMask, rest: Float64Array, settings: KnownSettings
) -> list[Float64Array]:
    """Initial poses of a model in a mask: by its looks, and at the mask's centre with its last orientation.

    Args:
        view: the frame.
        known: the object.
        mask: (H, W) bool at the size of the view.
        rest: (4, 4) its last pose `camera_T_object`.
        settings: thresholds.
    """
    around = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    looks = known.looks.find(view.frame, view.noise, settings.follow.looks, np.asarray(around))
    starts = [] if looks is None else [looks]
    inside = mask & view.frame.valid
    facing = known.model.facing(rest)
    if inside.any() and facing.any():
        center = np.median(view.frame.points[inside].astype(np.float64), axis=0)
        moved = rest.copy()
        moved[:3, 3] += center - np.median(geometry.transform(rest, known.model.points[facing]), axis=0)
        starts.append(moved)
    return starts


def starts_in_changes(
    views: PairViews, known: KnownObject, moving: BoolMask, rest: Float64Array, settings: KnownSettings
) -> list[Float64Array]:
    """Initial poses of a model in the largest regions that neither standing still nor another object explains.

    Args:
        views: the pair.
        known: the object.
        moving: (H, W) bool of any size: pixels of the current frame that the pair's moving objects explain.
        rest: (4, 4) its last pose `camera_T_object`.
        settings: thresholds.
    """
    before = np.zeros_like(moving) if views.prev_known is None else views.prev_known > 0
    frames = views.prev.frame, views.curr.frame
    regions = unexplained_regions(frames, views.prev_T_curr, (before, moving), views.curr.noise, settings.change)
    size = views.curr.frame.frame.depth.shape
    starts: list[Float64Array] = []
    for region in regions[: settings.follow.max_regions]:
        mask = np.asarray(resize_nearest(region.astype(np.uint8), size) > 0)
        starts += starts_in_mask(views.curr, known, mask, rest, settings)
    return starts
