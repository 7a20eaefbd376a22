"""What is known of an object in the frames before it was found: its earlier poses, and its masks there."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.geometry.resample import resize_nearest
from objectflow.tracking.earlier_settings import EarlierSettings
from objectflow.tracking.earlier_steps import earlier_poses
from objectflow.tracking.recent_frames import RecentViews
from objectflow.tracking.track import Track
from objectflow.typing import Float64Array


def add_earlier_poses(track: Track, recent: RecentViews, settings: EarlierSettings) -> None:
    """Give the track of an object that has just been found the poses of the steps before its first one.

    Args:
        track: with a model.
        recent: the frames before the latest one.
        settings: thresholds.
    """
    if track.model is None:
        return
    numbers = {frame.time: number for number, frame in enumerate(recent.frames)}
    if track.times[0] not in numbers:
        return
    later = track.world_T_object[:2]
    first = numbers[track.times[0]]
    following = recent.view(first), recent.frames[first].world_T_camera
    poses = earlier_poses(track.model, recent, first - 1, following, later, settings)[::-1]
    track.prepend(
        [recent.frames[pose.number].time for pose in poses],
        [pose.world_T_object for pose in poses],
        [pose.present for pose in poses],
    )


def add_earlier_masks(track: Track, whole: int, recent: RecentViews, settings: EarlierSettings) -> None:
    """Add the masks of an object that has just been found to the recent frames since the start of its track.

    Args:
        track: with a model.
        whole: id of the object of which it was a part until now, 0 for none.
        recent: the frames before the latest one; they are given the masks.
        settings: thresholds.
    """
    if track.model is None:
        return
    for number, frame in enumerate(recent.frames):
        pose = _pose_at(track, frame.time)
        if pose is None:
            continue
        view, camera_T_object = recent.view(number), geometry.inverse(frame.world_T_camera) @ pose
        fit = view.fit(track.model, camera_T_object)
        if fit.present < settings.min_present:
            continue
        mask, _ = view.mask(track.model, camera_T_object)
        recent.add(number, track.id, np.asarray(resize_nearest(mask, frame.known.shape)), whole)


def _pose_at(track: Track, time: float) -> Float64Array | None:
    """(4, 4) the latest pose of a track up to a time; None before its first one."""
    before = [k for k, known in enumerate(track.times) if known <= time]
    return track.world_T_object[before[-1]] if before else None
