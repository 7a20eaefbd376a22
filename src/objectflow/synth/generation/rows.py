"""From a drawn scene of falling objects to its rows: simulate, render, label."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from objectflow import geometry
from objectflow.dataset.pairing import pair_objects
from objectflow.dataset.schema import FrameObject, PairRow, SequenceRow
from objectflow.frame import RgbdFrame
from objectflow.synth.generation.stage_timer import StageTimer
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics.mjcf import build_model
from objectflow.synth.physics.simulate import PAIR_FRAMES, SEQUENCE_FRAMES, RejectedSceneError, Trajectory, simulate
from objectflow.synth.rendering.renderer import RenderedFrames, Renderer
from objectflow.synth.scenes.scene_data import Scene, View
from objectflow.typing import BoolMask, Float64Array, LabelImage

MIN_VISIBLE_PIXELS = 60
"""Minimum number of visible pixels of a visible object, in an image of 320x240 pixels."""
MIN_CAMERA_DISTANCE = 0.03
"""Minimum distance between a camera and the bounding sphere of any object, metres."""
VIEW_DELAY = 5
"""Number of frames by which each further view of a scene starts later."""


@dataclass(frozen=True, eq=False)
class DrawnScene:
    """A scene, the models of its objects, and what is needed to make its rows."""

    name: str
    scene: Scene
    models: Sequence[ObjectModel]
    renderer: Renderer
    timer: StageTimer


@dataclass(frozen=True, eq=False)
class _ViewFrames:
    """Frames of a scene through one camera."""

    frames: list[RgbdFrame]
    labels: LabelImage
    """(F, H, W)."""
    objects: list[tuple[FrameObject, ...]]
    """The objects of each frame."""


def make_pairs(drawn: DrawnScene, views: int) -> list[dict[str, Any]]:
    """Make one pair per view; each further view has its own camera and starts a little later.

    Raises:
        RejectedSceneError: the simulation or the views are unusable.
    """
    starts = [VIEW_DELAY * view for view in range(views)]
    wanted = sorted({frame + start for start in starts for frame in PAIR_FRAMES})
    trajectory, visible_model, open_views = _simulate(drawn, wanted, views)
    rows = []
    for number, (start, view) in enumerate(zip(starts, open_views, strict=True)):
        seen = _render(drawn, trajectory, visible_model, view, [frame + start for frame in PAIR_FRAMES])
        (prev, curr), (prev_labels, curr_labels) = seen.frames, seen.labels
        prev_objects, curr_objects = seen.objects
        row = PairRow(
            key=f"{drawn.name}-{number}" if views > 1 else drawn.name,
            scene=drawn.name,
            prev=prev,
            prev_labels=prev_labels,
            curr=curr,
            curr_labels=curr_labels,
            objects=pair_objects(prev_objects, curr_objects, prev_labels, curr_labels),
        )
        rows.append(row.to_dict())
        drawn.timer.lap("encode")
    return rows


def make_sequence(drawn: DrawnScene) -> list[dict[str, Any]]:
    """Make one row per frame of `SEQUENCE_FRAMES`, all through one camera.

    Raises:
        RejectedSceneError: the simulation or the views are unusable.
    """
    trajectory, visible_model, (view,) = _simulate(drawn, SEQUENCE_FRAMES, 1)
    seen = _render(drawn, trajectory, visible_model, view, SEQUENCE_FRAMES)
    rows = [
        SequenceRow(drawn.name, frame, image, labels, objects).to_dict()
        for frame, image, labels, objects in zip(SEQUENCE_FRAMES, seen.frames, seen.labels, seen.objects, strict=True)
    ]
    drawn.timer.lap("encode")
    return rows


def frame_objects(models: Sequence[ObjectModel], camera_T_objects: Iterable[Float64Array]) -> tuple[FrameObject, ...]:
    """The object table of one frame; object k, from 1, has label k.

    Args:
        models: N models, in order.
        camera_T_objects: N poses (4, 4) in the camera frame, metres.
    """
    return tuple(
        FrameObject(
            label=number, category=model.category, model=model.name, symmetry=model.symmetry, pose=camera_T_object
        )
        for number, (model, camera_T_object) in enumerate(zip(models, camera_T_objects, strict=True), 1)
    )


def visible_in_both(prev_labels: LabelImage, curr_labels: LabelImage, count: int) -> BoolMask:
    """(N,) which of `count` objects have enough visible pixels in both label images (H, W)."""
    least = MIN_VISIBLE_PIXELS * prev_labels.size / (320 * 240)
    prev, curr = (np.bincount(labels.ravel(), minlength=count + 1)[1:] for labels in (prev_labels, curr_labels))
    return np.asarray((prev >= least) & (curr >= least))


def _simulate(drawn: DrawnScene, frames: Sequence[int], views: int) -> tuple[Trajectory, Any, list[View]]:
    """The trajectory at the given frames, the MuJoCo model to render, and the requested number of unblocked views."""
    trajectory = simulate(drawn.scene, drawn.models, frames)
    drawn.timer.lap("physics")
    open_views = _open_views(drawn.scene, drawn.models, trajectory, views)
    visible_model = build_model(drawn.scene, drawn.models, solid=False)
    drawn.timer.lap("build")
    return trajectory, visible_model, open_views


def _render(
    drawn: DrawnScene, trajectory: Trajectory, visible_model: Any, view: View, frames: Sequence[int]
) -> _ViewFrames:
    poses = trajectory.world_T_object[[trajectory.frames.index(frame) for frame in frames]]
    rendered = drawn.renderer.render(visible_model, poses, view.world_T_camera[None])
    drawn.timer.lap("render")
    _check_visibility(rendered, len(drawn.models))
    camera_T_world = geometry.inverse(view.world_T_camera)
    images = [
        RgbdFrame(color=rendered.color[i, 0], depth=rendered.depth[i, 0], camera=drawn.scene.intrinsics)
        for i in range(len(frames))
    ]
    return _ViewFrames(
        images, rendered.labels[:, 0], [frame_objects(drawn.models, camera_T_world @ pose) for pose in poses]
    )


def _open_views(scene: Scene, models: Sequence[ObjectModel], trajectory: Trajectory, count: int) -> list[View]:
    """The first views whose camera keeps its distance from all objects in all frames; no image is needed for this."""
    radii = np.array([model.radius * item.scale for model, item in zip(models, scene.objects, strict=True)])
    positions = trajectory.world_T_object[:, :, :3, 3]
    found = []
    for view in scene.views:
        gap = np.linalg.norm(positions - view.world_T_camera[:3, 3], axis=-1) - radii
        if gap.min() > MIN_CAMERA_DISTANCE:
            found.append(view)
        if len(found) == count:
            return found
    raise RejectedSceneError("blocked", "an object is at or directly in front of every camera")


def _check_visibility(rendered: RenderedFrames, count: int) -> None:
    """Reject a view in which no object is visible in both the first and the last frame."""
    if not visible_in_both(rendered.labels[0, 0], rendered.labels[-1, 0], count).any():
        raise RejectedSceneError("unseen", "no object is visible in both frames")
