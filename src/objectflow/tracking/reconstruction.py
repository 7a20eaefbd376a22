"""Shapes of tracked objects and of the background, fused over a sequence along the objects' poses.

Each new view of an object is registered to what was fused of it before (frame to model), so that the errors of
consecutive motions do not add up.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from objectflow import geometry
from objectflow.alignment.registration import (
    RegistrationResult,
    RegistrationSettings,
    RegistrationSources,
    RegistrationTarget,
    evaluate_registration,
    refine,
)
from objectflow.frame import RgbdFrame
from objectflow.settings import Settings, setting
from objectflow.tracking.background import BackgroundCloud
from objectflow.tracking.object_volume import ObjectVolume, VolumeSettings
from objectflow.tracking.pose_cost import PoseCostSettings, is_better, pose_costs
from objectflow.tracking.track import Track
from objectflow.typing import BoolMask, Float64Array, LabelImage, UInt8Array


@dataclass(frozen=True)
class ReconstructionSettings(Settings):
    """How views are registered and fused, and what is too little for a model."""

    volume: VolumeSettings = VolumeSettings()
    """Resolution and weights of the volumes."""
    registration: RegistrationSettings = RegistrationSettings()
    """Convergence and weights of the registration to the model."""
    pose_cost: PoseCostSettings = PoseCostSettings()
    """When a registered pose replaces that of the track."""
    min_fitness: float = setting(0.5, minimum=0, maximum=1)
    """Smallest share of a view's points on the model at which the view is registered and fused."""
    max_shift: float = setting(0.03, above=0)
    """Metres: largest correction of a pose at the object's centre; a larger one is discarded with the view."""
    max_turn: float = setting(12.0, above=0)
    """Degrees: largest correction of an orientation."""
    margin: int = setting(24, minimum=4)
    """Pixels around a mask that are used with it."""
    min_views: int = setting(2, minimum=1)
    """Number of fused views below which an object has no model."""
    min_area: float = setting(0.0004, minimum=0)
    """Square metres of surface below which an object has no model."""
    background_voxel: float = setting(0.008, above=0)
    """Metres: distance of the background's points."""
    hidden_margin: float = setting(0.02, above=0)
    """Metres: depth this close to a model's belongs to the object, not to the background."""


class SequenceView(NamedTuple):
    """One frame of a sequence with its result.

    Attributes:
        number: of the frame.
        part: number of the part of the sequence; each part has its own world.
        time: as in the tracks.
        frame: colour and depth.
        labels: (H, W) int32 of the pair of which this is the current frame.
        world_T_camera: (4, 4).
        known: (H, W) int32 masks of the known objects by track id, for objects that the pair does not move; None to
            use only masks of moving objects.
    """

    number: int
    part: int
    time: float
    frame: RgbdFrame
    labels: LabelImage
    world_T_camera: Float64Array
    known: LabelImage | None = None


@dataclass(eq=False)
class ObjectModel:
    """The fused shape of one track.

    Attributes:
        id: of the track.
        volume: the fused views.
        part: of the sequence, in which the track lies.
        frames, times: of the fused views.
        world_T_object: (4, 4) registered pose of each fused view.
        residuals: metres: root mean square distance of each registered view to the model before it was fused.
        rejected: number of views that do not fit the model.
    """

    id: int
    volume: ObjectVolume
    part: int = 0
    frames: list[int] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    world_T_object: list[Float64Array] = field(default_factory=list)
    residuals: list[float] = field(default_factory=list)
    rejected: int = 0

    def pose_at(self, time: float) -> Float64Array:
        """(4, 4) `world_T_object` of the last fused view up to a time, or of the first one."""
        before = [k for k, known in enumerate(self.times) if known <= time]
        return self.world_T_object[before[-1] if before else 0]


def fuse_objects(
    views: Iterable[SequenceView], tracks: Sequence[Track], settings: ReconstructionSettings | None = None
) -> list[ObjectModel]:
    """Fuse each track's masked views.

    Args:
        views: in order of time.
        tracks: with the label of each time.
        settings: see `ReconstructionSettings`.

    Returns:
        A model for each track, in their order; a model without frames where no view could be fused.
    """
    settings = settings or ReconstructionSettings()
    models = {track.id: ObjectModel(track.id, ObjectVolume(settings.volume)) for track in tracks}
    tracked = {
        track.id: {
            time: (label, pose)
            for time, label, pose in zip(track.times, track.labels, track.world_T_object, strict=True)
        }
        for track in tracks
    }
    corrections: dict[int, Float64Array] = {}
    last: dict[int, Float64Array | None] = dict.fromkeys(tracked)
    for view in views:
        for number, poses in tracked.items():
            label, world_T_object = poses.get(view.time, (0, None))
            if label:
                mask = view.labels == label
            elif view.known is not None:
                mask = view.known == number
                world_T_object = last[number] if world_T_object is None else world_T_object
            else:
                continue
            last[number] = world_T_object
            if world_T_object is None or not (mask & view.frame.valid).any():
                continue
            # Poses of a track are chained motions: a correction holds for all later ones.
            expected = geometry.inverse(view.world_T_camera) @ world_T_object @ corrections.get(number, np.eye(4))
            found = _fuse_view(models[number], view, mask, expected, settings)
            if found is not None:
                corrections[number] = geometry.inverse(world_T_object) @ view.world_T_camera @ found
    return list(models.values())


def fuse_background(
    views: Iterable[SequenceView], models: Sequence[ObjectModel], settings: ReconstructionSettings | None = None
) -> BackgroundCloud:
    """Fuse what never moved: all pixels outside the masks of a frame and outside the models at their poses.

    Args:
        views: of one part of the sequence.
        models: of that part.
        settings: see `ReconstructionSettings`.
    """
    settings = settings or ReconstructionSettings()
    cloud = BackgroundCloud(settings.background_voxel)
    for view in views:
        moving = cv2.dilate((view.labels > 0).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
        for model in models:
            if not model.frames or model.part != view.part:
                continue
            pose = geometry.inverse(view.world_T_camera) @ model.pose_at(view.time)
            shown = model.volume.render(view.frame.camera, pose)
            on_model = shown.valid & (view.frame.depth > shown.depth - settings.hidden_margin)
            moving |= cv2.dilate(on_model.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        cloud.add(view.frame, ~moving, view.world_T_camera)
    return cloud


def missing_reason(model: ObjectModel, area: float, settings: ReconstructionSettings) -> str:
    """Why an object has no model, in words; empty if it has one.

    Args:
        model: the fused object.
        area: of its mesh, square metres.
        settings: the limits.
    """
    if not model.frames:
        return f"never seen in {settings.volume.min_pixels} pixels away from edges"
    if len(model.frames) < settings.min_views:
        return f"seen in {len(model.frames)} frame, a model needs {settings.min_views}"
    if area < settings.min_area:
        return f"{1e4 * area:.1f} cm2 of surface seen, a model needs {1e4 * settings.min_area:g}"
    return ""


def register_to_model(
    volume: ObjectVolume,
    frame: RgbdFrame,
    mask: BoolMask,
    camera_T_object: Float64Array,
    settings: RegistrationSettings | None = None,
    pose_cost: PoseCostSettings | None = None,
) -> tuple[Float64Array, RegistrationResult] | None:
    """Register the masked part of a frame to a volume as it is seen from an expected pose.

    Args:
        volume: fused from other frames.
        frame: the frame.
        mask: (H, W) bool: the object's pixels.
        camera_T_object: (4, 4) expected pose; the basin of convergence is that of `refine`.
        settings: of the registration.
        pose_cost: when the registered pose replaces the expected one.

    Returns:
        The registered pose, or the expected one where registration is not clearly better, and the quality of its fit;
        None where the volume is not in view.
    """
    shown = volume.render(frame.camera, camera_T_object)
    if shown.valid.sum() < volume.settings.min_pixels:
        return None
    model = RgbdFrame(_extended(shown.color, shown.valid), shown.depth, frame.camera)
    target = RegistrationTarget(model, volume.noise)
    source = RegistrationSources(frame).take(mask)
    settings, pose_cost = settings or RegistrationSettings(), pose_cost or PoseCostSettings()
    result = refine(target, source, np.eye(4), settings=settings)
    costs = pose_costs(target, source, (np.eye(4), result.prev_T_curr), settings, pose_cost)
    if not is_better(costs, pose_cost):
        result = evaluate_registration(target, source, np.eye(4), settings)
    return geometry.inverse(result.prev_T_curr) @ camera_T_object, result


def _fuse_view(
    model: ObjectModel, view: SequenceView, mask: BoolMask, expected: Float64Array, settings: ReconstructionSettings
) -> Float64Array | None:
    """Register and fuse one view; return its pose `camera_T_object`, or None if it was not fused."""
    frame, mask = _cropped(view.frame, mask, settings.margin)
    pose = expected
    if model.frames:
        found = register_to_model(model.volume, frame, mask, expected, settings.registration, settings.pose_cost)
        if found is not None:
            pose, result = found
            if result.fitness < settings.min_fitness or not _is_close(expected, pose, model, settings):
                model.rejected += 1
                return None
            model.residuals.append(result.inlier_rmse)
    if not model.volume.integrate(frame, mask, pose):
        return None
    model.part = view.part
    model.frames.append(view.number)
    model.times.append(view.time)
    model.world_T_object.append(view.world_T_camera @ pose)
    return pose


def _is_close(
    expected: Float64Array, found: Float64Array, model: ObjectModel, settings: ReconstructionSettings
) -> bool:
    """Whether a registered pose is a small correction of the expected one."""
    center = model.volume.surface().points.mean(axis=0)
    shift = geometry.transform(expected, center) - geometry.transform(found, center)
    turn = np.degrees(geometry.rotation_angle(expected[:3, :3].T @ found[:3, :3]))
    return bool(np.linalg.norm(shift) < settings.max_shift and turn < settings.max_turn)


def _cropped(frame: RgbdFrame, mask: BoolMask, margin: int) -> tuple[RgbdFrame, BoolMask]:
    """The part of a frame and of a mask around the mask, which holds depth."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    top, bottom = max(0, int(rows[0]) - margin), min(frame.camera.height, int(rows[-1]) + margin + 1)
    left, right = max(0, int(columns[0]) - margin), min(frame.camera.width, int(columns[-1]) + margin + 1)
    return frame.cropped(left, top, right - left, bottom - top), mask[top:bottom, left:right]


def _extended(color: UInt8Array, valid: BoolMask) -> UInt8Array:
    """Colours with those of the nearest valid pixel elsewhere, so that blurring does not darken the edge."""
    nearest = ndimage.distance_transform_edt(~valid, return_distances=False, return_indices=True)
    return np.asarray(color[nearest[0], nearest[1]])
