"""Pairs in which the known objects explain every change: their models give the motion, and no estimate is needed.

Most frames of a sequence show nothing new. The models of the known objects are registered to the current frame, in a
fraction of the time of an estimate; where something else changed, the caller estimates the pair.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment.apparent_shift import WIDTH, apparent_shift
from objectflow.alignment.frame_pair import FramePair
from objectflow.geometry.resample import resize_nearest
from objectflow.methods.labels import rigid_flow, with_surface_centers
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.tracking.known_object import KnownObject
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.known_step import Starts, known_step
from objectflow.tracking.model_motion import ModelPose, PairViews
from objectflow.tracking.tracker import Tracker
from objectflow.tracking.unexplained_change import has_unexplained_change
from objectflow.typing import BoolMask, Float32Array, LabelImage

METHOD = "models"
"""`SceneMotion.method` of these pairs."""


class ExplainedStep(NamedTuple):
    """A pair that the known objects explain.

    Attributes:
        motion: of the pair; its objects are the known ones that moved.
        tracks: track id of each object, by the object's id.
        poses: of these objects in the current frame, by track id.
        shown: where the current frame shows each known object, by track id; see `FrameView.mask`.
    """

    motion: SceneMotion
    tracks: dict[int, int]
    poses: dict[int, ModelPose]
    shown: dict[int, tuple[BoolMask, Float32Array]]


def may_be_explained(pair: FramePair, prev_known: LabelImage | None, settings: KnownSettings) -> bool:
    """Whether the camera likely stood still, as models alone do not tell its motion.

    Args:
        pair: the frames.
        prev_known: (H, W) int32 masks of the known objects in the previous frame; None without any.
        settings: `explained` applies.
    """
    prev, curr = (frame.at_width(WIDTH).frame.depth for frame in (pair.prev, pair.curr))
    # What moves by itself shows another depth, or is a known object.
    moved = (np.abs(curr - prev) > settings.explained.depth_change * prev).astype(np.uint8)
    if prev_known is not None:
        moved |= resize_nearest((prev_known > 0).astype(np.uint8), moved.shape)
    size = 2 * settings.explained.moving_rim + 1
    moving = cv2.dilate(moved, np.ones((size, size), np.uint8)) > 0
    return apparent_shift(pair.prev, pair.curr, moving) <= settings.explained.max_shift_px


def explained_step(
    views: PairViews, objects: dict[int, KnownObject], tracker: Tracker, time: float, settings: KnownSettings
) -> ExplainedStep | None:
    """Register the known objects to the current frame of a static camera, if they explain every change.

    Args:
        views: the pair.
        objects: by track id.
        tracker: before the pair, with a pose of the camera.
        time: of the current frame.
        settings: thresholds.

    Returns:
        None where something else changed, or an object was lost.
    """
    camera_T_world = geometry.inverse(tracker.world_T_camera[-1])
    numbers = sorted(set(objects) & tracker.alive)
    starts = []
    for number in numbers:
        pose = tracker.extrapolated(number, time)
        predicted = None if pose is None else camera_T_world @ pose
        starts.append(Starts(camera_T_world @ objects[number].world_T_object, predicted))

    # One after the other: threads take longer, since registration consists of many short computations, between which
    # they wait for the interpreter.
    steps = [
        known_step(views, number, objects[number], start, settings, quick=True)
        for number, start in zip(numbers, starts, strict=True)
    ]
    poses: dict[int, ModelPose] = {}
    for number, one in zip(numbers, steps, strict=True):
        if one.lost and objects[number].present >= settings.min_present:
            return None
        if one.moved is not None:
            poses[number] = one.moved
    shown = {
        number: views.curr.mask(objects[number].model, poses[number].curr_T_object if number in poses else start.rest)
        for number, start in zip(numbers, starts, strict=True)
    }
    masks = {number: mask for number, (mask, _) in shown.items()}
    if any(masks[number].sum() < settings.min_pixels or _is_claimed(number, masks, settings) for number in poses):
        return None
    known = np.zeros(views.curr.frame.frame.depth.shape, bool)
    for mask in masks.values():
        known |= mask
    before = np.zeros(known.shape, bool) if views.prev_known is None else views.prev_known > 0
    frames = views.prev.frame, views.curr.frame
    if has_unexplained_change(frames, views.prev_T_curr, (before, known), views.curr.noise, settings.explained):
        return None
    motion, tracks = _motion(views, masks, poses, dict(zip(numbers, starts, strict=True)))
    return ExplainedStep(motion, tracks, poses, shown)


def _is_claimed(number: int, masks: dict[int, BoolMask], settings: KnownSettings) -> bool:
    """Whether another object covers most of an object's mask, so that one of the two is not where it seems to be."""
    own = masks[number]
    return any(
        (own & mask).sum() > settings.follow.max_claimed * own.sum()
        for other, mask in masks.items()
        if other != number
    )


def _motion(
    views: PairViews, masks: dict[int, BoolMask], poses: dict[int, ModelPose], starts: dict[int, Starts]
) -> tuple[SceneMotion, dict[int, int]]:
    """The motion of a pair by the poses of the objects that moved, and the track id of each object by its label."""
    curr = views.pair.curr
    by_track = np.zeros(views.curr.frame.frame.depth.shape, np.int32)
    for number in poses:
        by_track[masks[number] & (by_track == 0)] = number
    by_track = resize_nearest(by_track, curr.frame.depth.shape)
    numbers = [number for number in np.flatnonzero(np.bincount(by_track.ravel())).tolist() if number]
    labels = (np.searchsorted(numbers, by_track) + 1).astype(np.int32) if numbers else np.zeros_like(by_track)
    labels[by_track == 0] = 0
    objects = tuple(
        ObjectMotion(
            id=label,
            pixels=int((labels == label).sum()),
            score=poses[number].present,
            moving=True,
            center=poses[number].curr_T_object[:3, 3],
            prev_T_curr=starts[number].rest @ geometry.inverse(poses[number].curr_T_object),
        )
        for label, number in enumerate(numbers, 1)
    )
    objects = with_surface_centers(labels, objects, curr.points)
    motion = SceneMotion(labels, rigid_flow(objects, labels, curr.points), objects, method=METHOD)
    return motion, dict(enumerate(numbers, 1))
