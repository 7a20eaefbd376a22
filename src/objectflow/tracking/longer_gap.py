"""Objects that are too small, or move too little, for a pair: they are found between frames that lie farther apart."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.geometry.resample import resize_nearest
from objectflow.methods.base import Estimator, closer, estimate_pair
from objectflow.motion import SceneMotion
from objectflow.tracking.earlier_steps import earlier_poses
from objectflow.tracking.fine_step import displacement
from objectflow.tracking.known_object import KnownObject
from objectflow.tracking.known_objects import KnownObjects
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.longer_gap_settings import LongerGapSettings
from objectflow.tracking.model_motion import PairViews
from objectflow.tracking.recent_frames import RecentViews
from objectflow.tracking.surface_model import new_model
from objectflow.tracking.tracker import Tracker
from objectflow.tracking.unexplained_change import UnexplainedChangeSettings, has_unexplained_change
from objectflow.typing import BoolMask, Float64Array, LabelImage


class LongerEstimate(NamedTuple):
    """An estimate between the current frame and one that lies farther back than the previous one.

    Attributes:
        prev_time: of the older frame.
        motion: from the current frame back to it.
    """

    prev_time: float
    motion: SceneMotion


class LongerGaps:
    """Compares frames with older ones where something changed that no known object explains. It can be pickled."""

    def __init__(self, settings: LongerGapSettings, change: UnexplainedChangeSettings) -> None:
        """Start.

        Args:
            settings: when frames are compared.
            change: what counts as a change.
        """
        self._settings, self._change = settings, change
        self._saved = 1.0

    def estimate(
        self,
        estimator: Estimator,
        views: PairViews,
        recent: RecentViews,
        known: BoolMask,
        world_T_camera: Float64Array,
        given: LongerEstimate | None = None,
    ) -> LongerEstimate | None:
        """Compare the current frame with an older one, if something changed and the time allows it.

        Args:
            estimator: of pairs.
            views: the latest pair.
            recent: the frames before the current one.
            known: (H, W) bool: pixels of known objects and of moving ones in the current frame.
            world_T_camera: (4, 4) of the current frame.
            given: the estimate of an earlier run.
        """
        settings = self._settings
        self._saved = min(self._saved + 1 / settings.pairs_per_estimate, float(settings.max_saved))
        number = max(0, len(recent.frames) - settings.gap)
        if number > len(recent.frames) - 2 or self._saved < 1:
            return None
        older = recent.frames[number]
        older_T_curr = geometry.inverse(older.world_T_camera) @ world_T_camera
        frames = recent.view(number).frame, views.curr.frame
        both_known = recent.known(number) > 0, known
        if not has_unexplained_change(frames, older_T_curr, both_known, views.curr.noise, self._change):
            return None
        self._saved -= 1
        if given is not None and given.prev_time == older.time:
            return given
        pair = FramePair(PreparedFrame(older.frame), views.pair.curr)
        return LongerEstimate(older.time, estimate_pair(closer(estimator) if settings.closer else estimator, pair))


def add_found(
    longer: LongerEstimate,
    known_objects: KnownObjects,
    tracker: Tracker,
    views: PairViews,
    recent: RecentViews,
    known: LabelImage,
    time: float,
) -> tuple[int, ...]:
    """Add the objects that only the estimate between frames farther apart shows, where their models confirm it.

    Args:
        longer: the estimate.
        known_objects, tracker: are given the objects.
        views: the latest pair.
        recent: the frames before the current one.
        known: (H, W) int32 masks of the known objects in the current frame, to which those of the objects are added.
        time: of the current frame.

    Returns:
        The track ids of the added objects.
    """
    settings, gap = known_objects.settings, known_objects.settings.longer_gap
    number = next(k for k, frame in enumerate(recent.frames) if frame.time == longer.prev_time)
    world_T_older = recent.frames[number].world_T_camera
    world_T_curr = tracker.world_T_camera[-1]
    added = []
    for obj in longer.motion.objects:
        mask = np.asarray(longer.motion.labels == obj.id)
        covered = float((mask & (known > 0)).sum() / max(1, mask.sum()))
        if not obj.moving or obj.score < gap.min_score or covered > gap.max_known:
            continue
        mask &= known == 0
        own = _at_size(mask, views.curr.frame.frame.depth.shape)
        inside = own & views.curr.frame.valid
        if inside.sum() < settings.min_pixels:
            continue
        step = world_T_curr @ geometry.inverse(world_T_older @ obj.prev_T_curr)
        whole = _whole(
            mask, geometry.transform(world_T_curr, obj.center), step, longer.prev_time, known, tracker, settings
        )
        if whole in known_objects.objects:
            existing = known_objects.objects[whole]
            existing.model.integrate(views.curr.frame, own, geometry.inverse(world_T_curr) @ existing.world_T_object)
            known[mask] = whole
            continue
        # The object's frame lies at its centre in the older frame, aligned with the world.
        start = np.eye(4)
        start[:3, 3] = geometry.transform(world_T_older @ obj.prev_T_curr, obj.center)
        pose = world_T_curr @ geometry.inverse(world_T_older @ obj.prev_T_curr) @ start
        model = new_model(views.curr.frame, own, geometry.inverse(world_T_curr) @ pose, settings.max_points)
        poses = earlier_poses(
            model, recent, len(recent.frames) - 1, (views.curr, world_T_curr), [pose], settings.earlier, [start]
        )
        if not poses:
            continue
        there = next((one for one in poses if one.number == number), poses[-1]).world_T_object
        if displacement(model, there, start) > gap.max_deviation * displacement(model, pose, start):
            continue
        track = tracker.start(
            [*(recent.frames[one.number].time for one in poses[::-1]), time],
            [*(one.world_T_object for one in poses[::-1]), pose],
            [*(one.present for one in poses[::-1]), obj.score],
            geometry.transform(world_T_curr, views.curr.frame.points[inside].astype(np.float64)),
            views.curr.frame.frame.color[inside],
        )
        track.model = model
        found = KnownObject(model, pose, moved=poses[0].moved, present=1.0)
        found.looks.add(views.curr.frame, own, geometry.inverse(world_T_curr) @ pose, settings.follow.looks)
        known_objects.objects[track.id] = found
        known_objects.found[track.id] = 0
        known[mask] = track.id
        added.append(track.id)
    return tuple(added)


def _whole(
    mask: BoolMask,
    center: Float64Array,
    step: Float64Array,
    since: float,
    known: LabelImage,
    tracker: Tracker,
    settings: KnownSettings,
) -> int:
    """The known object that an object touches and with which it moved: the id of its track, 0 for none.

    Args:
        mask: (H, W) bool.
        center: (3,) metres in the world, of the object in the current frame.
        step: (4, 4) its motion in the world since the older frame.
        since: time of the older frame.
        known: (H, W) int32 masks of the known objects.
        tracker: with their poses.
        settings: thresholds.
    """
    size = 2 * settings.longer_gap.rim + 1
    around = cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    near = set(np.unique(known[around]).tolist())
    before = geometry.transform(geometry.inverse(step), center)
    for track in tracker.tracks:
        poses = [pose for time, pose in zip(track.times, track.world_T_object, strict=True) if time <= since]
        if track.id not in near or not poses:
            continue
        own = geometry.transform(poses[-1] @ geometry.inverse(track.world_T_object[-1]), center)
        limit = max(settings.follow.piece_shift, settings.follow.piece_share * float(np.linalg.norm(center - before)))
        if np.linalg.norm(own - before) <= limit:
            return track.id
    return 0


def _at_size(mask: BoolMask, shape: tuple[int, ...]) -> BoolMask:
    return np.asarray(resize_nearest(mask.astype(np.uint8), shape) > 0)
