"""Objects that have moved once stay known: their models are compared with every later frame."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import numpy as np

from objectflow import geometry
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise
from objectflow.geometry.resample import resize_nearest
from objectflow.motion import SceneMotion
from objectflow.tracking.known_masks import moving_region, nearest_labels
from objectflow.tracking.known_object import KnownObject
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.known_step import Starts, known_step
from objectflow.tracking.model_evidence import ModelEvidence
from objectflow.tracking.model_fit import FrameView
from objectflow.tracking.model_motion import ModelPose, PairViews, best_pose, model_motion
from objectflow.tracking.parts import resting_part
from objectflow.tracking.search_starts import starts_in_changes, starts_in_mask
from objectflow.tracking.seen_surface import seen_surface
from objectflow.tracking.surface_model import SurfaceModel, new_model
from objectflow.tracking.tracker import Tracker
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage


class KnownObjects:
    """The models of all objects that have moved, and where the current frame shows them.

    Attributes:
        settings: thresholds.
        objects: by the id of the track.
        found: id of each object that became known in the latest frame, and the id of the object of which it was a
            part until then, 0 for none.
        rested: ids of the objects that came to rest in the latest frame.
    """

    def __init__(self, settings: KnownSettings | None = None) -> None:
        self.settings = settings or KnownSettings()
        self.objects: dict[int, KnownObject] = {}
        self.found: dict[int, int] = {}
        self.rested: set[int] = set()
        self._searches = 0

    def view(self, frame: PreparedFrame, noise: DepthNoise = STRUCTURED_LIGHT) -> FrameView:
        """A frame, prepared for its comparison with the models.

        Args:
            frame: the frame.
            noise: of its depth.
        """
        return FrameView(frame, self.settings, noise)

    def evidence(self, views: PairViews, labels: LabelImage, tracker: Tracker) -> ModelEvidence:
        """The models as evidence for the association of a pair's objects.

        Args:
            views: the pair.
            labels: (H, W) int32 of the estimate.
            tracker: before the pair.
        """
        prev_T_world = geometry.inverse(tracker.world_T_camera[-1]) if tracker.world_T_camera else None
        return ModelEvidence(self.objects, views, labels, prev_T_world, self.settings)

    def follow(
        self,
        views: PairViews,
        motion: SceneMotion,
        tracks: Mapping[int, int],
        tracker: Tracker,
        prev_time: float,
        time: float,
    ) -> tuple[int, ...]:
        """Follow the objects that moved although the estimate lacks their motions.

        Args:
            views: the pair.
            motion: its estimate.
            tracks: the track id of each object of the estimate; the tracker has been updated by them.
            tracker: is given the poses that are found.
            prev_time, time: of the pair.

        Returns:
            The track ids of the objects that were followed.
        """
        if not tracker.world_T_camera:
            return ()
        followed: list[int] = []
        lost: list[int] = []
        motions = [obj.prev_T_curr for obj in motion.objects if obj.moving]
        for number in sorted(set(self.objects) & tracker.alive - set(tracks.values())):
            starts = Starts(self._rest(number, tracker), tracker.predicted_in_camera(number), motions)
            step = known_step(views, number, self.objects[number], starts, self.settings)
            if step.lost:
                lost.append(number)
            found = step.moved
            if found is None:
                continue
            if step.fine or not self._is_claimed(views.curr, number, found.curr_T_object, motion, tracks, tracker):
                pose = tracker.world_T_camera[-1] @ found.curr_T_object
                tracker.follow(number, prev_time, time, pose, found.present)
                followed.append(number)
        # One lost object per frame bounds the time; the one that was not searched for longest is next.
        self._searches += 1
        for number in sorted(lost, key=lambda number: (self.objects[number].searched, number))[:1]:
            self.objects[number].searched = self._searches
            found = self._search(views, number, motion, tracks, tracker)
            if found is not None:
                tracker.follow(
                    number, prev_time, time, tracker.world_T_camera[-1] @ found.curr_T_object, found.present
                )
                followed.append(number)
        return tuple(sorted(followed))

    def _rest(self, number: int, tracker: Tracker) -> Float64Array:
        """(4, 4) `curr_T_object` of an object at its last pose."""
        return geometry.inverse(tracker.world_T_camera[-1]) @ self.objects[number].world_T_object

    def _search(
        self,
        views: PairViews,
        number: int,
        motion: SceneMotion,
        tracks: Mapping[int, int],
        tracker: Tracker,
    ) -> ModelPose | None:
        """The pose at which a lost object is found again, confirmed by its model.

        It is searched by its looks in the whole frame, and where something changed.
        """
        known, settings, view = self.objects[number], self.settings.follow, views.curr
        start = known.looks.find(view.frame, view.noise, settings.looks)
        found = None if start is None else best_pose(view, known.model, [start], settings)
        if found is None:
            rest, moving = self._rest(number, tracker), np.isin(motion.labels, list(tracks))
            starts = starts_in_changes(views, known, moving, rest, self.settings)
            found = model_motion(views, known.model, rest, starts, settings)
        if found is None or self._is_claimed(view, number, found.curr_T_object, motion, tracks, tracker):
            return None
        center = known.model.points.mean(axis=0)
        place = geometry.transform(tracker.world_T_camera[-1] @ found.curr_T_object, center)
        twin = known.twin is not None and np.linalg.norm(place - known.twin) < settings.twin_distance
        return None if twin else found

    def _is_claimed(
        self,
        view: FrameView,
        number: int,
        curr_T_object: Float64Array,
        motion: SceneMotion,
        tracks: Mapping[int, int],
        tracker: Tracker,
    ) -> bool:
        """Whether most of the surface at the new pose of an object belongs to other objects."""
        mask, _ = view.mask(self.objects[number].model, curr_T_object)
        labels = resize_nearest(motion.labels, mask.shape)
        # A mask of the estimate may contain several known objects, which only their models tell apart.
        claimed = np.isin(labels, [label for label, track in tracks.items() if track not in self.objects])
        moved = {track.id: track.world_T_object[-1] for track in tracker.tracks if track.id in tracks.values()}
        curr_T_world = geometry.inverse(tracker.world_T_camera[-1])
        for other, known in self.objects.items():
            if other != number:
                pose = moved.get(other, known.world_T_object)
                claimed |= view.mask(known.model, curr_T_world @ pose)[0]
        return bool((mask & claimed).sum() > self.settings.follow.max_claimed * max(1, mask.sum()))

    def _separated(
        self,
        masks: Mapping[int, BoolMask],
        followed: Collection[int],
        poses: Mapping[int, Float64Array],
        view: FrameView,
    ) -> dict[int, BoolMask]:
        """Masks of an estimate without the surface of objects that were followed by their models.

        Args:
            masks: (H, W) bool by track id.
            followed: track ids.
            poses: (4, 4) `curr_T_object` by track id.
            view: the current frame.
        """
        taken = np.zeros(view.frame.frame.depth.shape, bool)
        for number in followed if masks else ():
            taken |= view.mask(self.objects[number].model, poses[number])[0]
        if not taken.any():
            return dict(masks)
        out = {}
        for number, mask in masks.items():
            known = self.objects.get(number)
            own = taken & False if known is None else view.mask(known.model, poses[number])[0]
            out[number] = mask & (own | ~taken)
        return out

    def update(
        self,
        view: FrameView,
        motion: SceneMotion,
        tracks: dict[int, int],
        tracker: Tracker,
        shape: tuple[int, ...],
        followed: Collection[int] = (),
        shown: Mapping[int, tuple[BoolMask, Float32Array]] | None = None,
    ) -> LabelImage:
        """Compare the models with the current frame, and extend those of the objects that moved.

        Poses of moving objects are refined by registration to their models; an object that came to rest is
        registered once more, and its track continues from there.

        Args:
            view: the current frame.
            motion: the estimate for the pair that ends with it.
            tracks: the track id of each object of the estimate, as `Tracker.update` returned them.
            tracker: after this update.
            shape: (H, W) of the result, that of the frame.
            followed: track ids of the objects that were followed by their models.
            shown: `FrameView.mask` of objects at their poses, by track id, where it is known already.

        Returns:
            (H, W) int32, the track id of each pixel that shows a known object, 0 elsewhere.
        """
        self.found, self.rested = {}, set()
        if not tracker.world_T_camera:  # the camera is lost
            self.objects = {}
            return np.zeros(shape, np.int32)
        curr_T_world = geometry.inverse(tracker.world_T_camera[-1])
        height, width = view.frame.frame.depth.shape
        labels = resize_nearest(motion.labels, (height, width))
        masks = {
            track: np.isin(labels, [label for label, other in tracks.items() if other == track])
            for track in set(tracks.values())
        }
        alive = {track.id for track in tracker.tracks}
        self.objects = {number: known for number, known in self.objects.items() if number in alive}
        for number in sorted(set(masks) & set(self.objects)):
            self._split(number, masks[number], view, tracker)
        by_id = {track.id: track for track in tracker.tracks}
        poses = {number: curr_T_world @ by_id[number].world_T_object[-1] for number in (*masks, *followed)}
        masks = self._separated(masks, followed, poses, view)
        regions: dict[int, tuple[BoolMask, Float32Array]] = {}
        for number in sorted({*self.objects, *masks}):
            track = by_id[number]
            if number in masks:
                self._move(number, masks[number], track.world_T_object, view, curr_T_world)
            elif number in followed:
                known = self.objects[number]
                known.world_T_object, known.moved = track.world_T_object[-1], True
                fit = view.fit(known.model, curr_T_world @ known.world_T_object)
                known.model.count(fit.fits, fit.missing)
            elif self.objects[number].moved:
                self.rested.add(number)
                self._come_to_rest(self.objects[number], track.world_T_object, view, curr_T_world)
            if number not in self.objects:
                continue
            known = self.objects[number]
            track.model = known.model
            pose = curr_T_world @ known.world_T_object
            fit = view.fit(known.model, pose)
            known.present = fit.present if fit.visible >= self.settings.min_visible else 0.0
            if number in masks:
                others = [mask for other, mask in masks.items() if other != number]
                sure = known.present >= self.settings.min_present
                regions[number] = moving_region(view, known.model if sure else None, pose, masks[number], others)
            elif known.present >= self.settings.min_present:
                mask, depth = (shown or {}).get(number) or view.mask(known.model, pose)
                if mask.sum() >= self.settings.min_pixels:
                    regions[number] = mask, depth
        tracker.keep(number for number, known in self.objects.items() if known.present >= self.settings.min_present)
        out = nearest_labels(view, regions, masks)
        for number in set(masks) & set(self.objects):
            surface = seen_surface(view.frame.frame, out == number, tracker.settings.max_points)
            if len(surface.points):
                tracker.see(number, surface)
        return np.asarray(resize_nearest(out, shape), dtype=np.int32)

    def _split(self, number: int, mask: BoolMask, view: FrameView, tracker: Tracker) -> None:
        """Give a part of a moving object that rests a track of its own, with the trajectory of both up to now."""
        known, settings = self.objects[number], self.settings.follow
        poses = next(track.world_T_object for track in tracker.tracks if track.id == number)
        curr_T_world = geometry.inverse(tracker.world_T_camera[-1])
        rest = curr_T_world @ known.world_T_object
        resting = resting_part(view, known.model, rest, curr_T_world @ poses[-1], mask, settings)
        if resting is None:
            return
        part = known.model.take(resting)
        shown, _ = view.mask(part, rest)
        for other, another in self.objects.items():
            if other != number:
                shown &= ~view.mask(another.model, curr_T_world @ another.world_T_object)[0]
        if shown.sum() < self.settings.min_pixels:
            return  # a part of another known object, which a mask had contained
        points = geometry.transform(known.world_T_object, part.points)
        track = tracker.split(number, points, part.colors)
        self.objects[track.id] = KnownObject(part, known.world_T_object, moved=False)
        self.found[track.id] = number
        self.objects[track.id].looks.add(view.frame, shown, rest, settings.looks)

    def _move(
        self,
        number: int,
        mask: BoolMask,
        poses: list[Float64Array],
        view: FrameView,
        curr_T_world: Float64Array,
    ) -> None:
        """Refine the newest of a track's poses by its model, and extend the model by the surface in the mask."""
        known = self.objects.get(number)
        if known is None:
            if (mask & view.frame.valid).sum() < self.settings.min_pixels:
                return
            model = new_model(view.frame, mask, curr_T_world @ poses[-1], self.settings.max_points)
            known = self.objects[number] = KnownObject(model, poses[-1])
            self.found[number] = 0
        else:
            step = poses[-1] @ geometry.inverse(poses[-2]) if len(poses) > 1 else np.eye(4)
            poses[-1] = self._registered(known.model, poses[-1], view, curr_T_world)
            fit = view.fit(known.model, curr_T_world @ poses[-1])
            if known.present < self.settings.min_present and fit.present < self.settings.min_present:
                # The object was lost, so that its motion did not begin at its last pose.
                starts = starts_in_mask(view, known, mask, curr_T_world @ poses[-1], self.settings)
                found = best_pose(view, known.model, starts, self.settings.follow)
                if found is not None and found.present >= fit.present + self.settings.follow.min_gain:
                    poses[-1] = geometry.inverse(curr_T_world) @ found.curr_T_object
                    if len(poses) > 1:
                        poses[-2] = geometry.inverse(step) @ poses[-1]
                    fit = view.fit(known.model, found.curr_T_object)
            known.model.count(fit.fits, fit.missing)
            known.model.integrate(view.frame, mask, curr_T_world @ poses[-1])
        known.world_T_object, known.moved = poses[-1], True
        known.looks.add(view.frame, mask, curr_T_world @ poses[-1], self.settings.follow.looks)

    def _come_to_rest(
        self, known: KnownObject, poses: list[Float64Array], view: FrameView, curr_T_world: Float64Array
    ) -> None:
        """Register an object that came to rest; its track continues from the registered pose."""
        fit = view.fit(known.model, curr_T_world @ known.world_T_object)
        if fit.visible >= self.settings.min_visible and fit.present >= self.settings.min_present:
            poses[-1] = known.world_T_object = self._registered(known.model, known.world_T_object, view, curr_T_world)
            known.moved = False
            self._note_twin(known, view, curr_T_world)

    def _note_twin(self, known: KnownObject, view: FrameView, curr_T_world: Float64Array) -> None:
        """Note whether something beside an object at rest looks the same."""
        settings = self.settings.follow
        own, _ = view.mask(known.model, curr_T_world @ known.world_T_object)
        start = known.looks.find(view.frame, view.noise, settings.looks, ~own)
        found = None if start is None else best_pose(view, known.model, [start], settings)
        known.twin = None
        if found is not None:
            center = known.model.points.mean(axis=0)
            known.twin = geometry.transform(geometry.inverse(curr_T_world) @ found.curr_T_object, center)

    def _registered(
        self, model: SurfaceModel, world_T_object: Float64Array, view: FrameView, curr_T_world: Float64Array
    ) -> Float64Array:
        """The pose registered to the model, or the given one where registration is not clearly better or moves far."""
        start = curr_T_world @ world_T_object
        pose, better = view.register(model, start)
        if not better:
            return world_T_object
        change = geometry.inverse(start) @ pose
        angle = math.degrees(float(geometry.rotation_angle(change[:3, :3])))
        center = model.points.mean(axis=0)
        shift = float(np.linalg.norm(geometry.transform(change, center) - center))
        if shift > self.settings.max_correction or angle > self.settings.max_correction_deg:
            return world_T_object
        if view.fit(model, pose).present < view.fit(model, start).present - self.settings.max_loss:
            return world_T_object
        return geometry.inverse(curr_T_world) @ pose
