"""From a drawn scene to its rows: let it fall, look at it, label it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from objectflow import geometry
from objectflow.dataset.pairing import pair_objects
from objectflow.dataset.schema import FrameObject, PairRow, SequenceRow
from objectflow.frame import RgbdFrame
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics.mjcf import build_model
from objectflow.synth.physics.simulate import PAIR_FRAMES, SEQUENCE_FRAMES, RejectedSceneError, Trajectory, simulate
from objectflow.synth.rendering.renderer import Frames, Renderer
from objectflow.synth.scenes.scene_data import Scene, View
from objectflow.typing import Float64Array, LabelImage

MIN_PIXELS = 60
"""An object counts as seen from so many pixels on, at 320x240."""
MIN_GAP = 0.03
"""Metres between a camera and the sphere around any object."""
VIEW_STEP = 5
"""Frames by which each further view of a scene begins later."""

STAGES = ("draw", "build", "physics", "render", "encode")


class Clock:
    """Seconds spent in each stage of a scene; drafts that come to nothing count too."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self._since = time.perf_counter()

    def start(self) -> None:
        """Begin to measure."""
        self._since = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Count the time since the last call for a stage."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._since
        self._since = now


@dataclass(frozen=True, eq=False)
class Draft:
    """A scene as it was drawn, and what makes rows of it."""

    name: str
    scene: Scene
    models: Sequence[ObjectModel]
    renderer: Renderer
    clock: Clock


@dataclass(frozen=True, eq=False)
class _Take:
    """Frames of a scene as one camera sees them."""

    frames: list[RgbdFrame]
    labels: LabelImage
    """(F, H, W)."""
    objects: list[tuple[FrameObject, ...]]
    """Of each frame."""


def make_pairs(draft: Draft, views: int) -> list[dict[str, Any]]:
    """One pair a view: each further view has its own camera and begins a little later.

    Raises:
        RejectedSceneError: the scene must not become data.
    """
    starts = [VIEW_STEP * view for view in range(views)]
    wanted = sorted({frame + start for start in starts for frame in PAIR_FRAMES})
    trajectory, seen, open_views = _let_fall(draft, wanted, views)
    rows = []
    for number, (start, view) in enumerate(zip(starts, open_views, strict=True)):
        take = _take(draft, trajectory, seen, view, [frame + start for frame in PAIR_FRAMES])
        (prev, curr), (prev_labels, curr_labels) = take.frames, take.labels
        prev_objects, curr_objects = take.objects
        row = PairRow(
            key=f"{draft.name}-{number}" if views > 1 else draft.name,
            scene=draft.name,
            prev=prev,
            prev_labels=prev_labels,
            curr=curr,
            curr_labels=curr_labels,
            objects=pair_objects(prev_objects, curr_objects, prev_labels, curr_labels),
        )
        rows.append(row.to_dict())
        draft.clock.lap("encode")
    return rows


def make_sequence(draft: Draft) -> list[dict[str, Any]]:
    """One row a frame: 20, 30, ..., 90, through one camera.

    Raises:
        RejectedSceneError: the scene must not become data.
    """
    trajectory, seen, (view,) = _let_fall(draft, SEQUENCE_FRAMES, 1)
    take = _take(draft, trajectory, seen, view, SEQUENCE_FRAMES)
    rows = [
        SequenceRow(draft.name, frame, image, labels, objects).to_dict()
        for frame, image, labels, objects in zip(SEQUENCE_FRAMES, take.frames, take.labels, take.objects, strict=True)
    ]
    draft.clock.lap("encode")
    return rows


def _let_fall(draft: Draft, frames: Sequence[int], views: int) -> tuple[Trajectory, Any, list[View]]:
    """Where everything is at the frames, the model to be seen, and as many views that nothing blocks."""
    trajectory = simulate(draft.scene, draft.models, frames)
    draft.clock.lap("physics")
    open_views = _open_views(draft.scene, draft.models, trajectory, views)
    seen = build_model(draft.scene, draft.models, solid=False)
    draft.clock.lap("build")
    return trajectory, seen, open_views


def _take(draft: Draft, trajectory: Trajectory, seen: Any, view: View, frames: Sequence[int]) -> _Take:
    poses = trajectory.world_T_object[[trajectory.frames.index(frame) for frame in frames]]
    pictures = draft.renderer.render(seen, poses, view.world_T_camera[None])
    draft.clock.lap("render")
    _check_pictures(pictures, draft.scene)
    camera_T_world = geometry.inverse(view.world_T_camera)
    images = [
        RgbdFrame(color=pictures.color[i, 0], depth=pictures.depth[i, 0], camera=draft.scene.intrinsics)
        for i in range(len(frames))
    ]
    return _Take(images, pictures.labels[:, 0], [_objects(draft.models, camera_T_world @ pose) for pose in poses])


def _open_views(scene: Scene, models: Sequence[ObjectModel], trajectory: Trajectory, count: int) -> list[View]:
    """The scene's first views whose camera nothing touches in any frame; told without making a picture."""
    radii = np.array([model.radius * item.scale for model, item in zip(models, scene.objects, strict=True)])
    positions = trajectory.world_T_object[:, :, :3, 3]
    found = []
    for view in scene.views:
        gap = np.linalg.norm(positions - view.world_T_camera[:3, 3], axis=-1) - radii
        if gap.min() > MIN_GAP:
            found.append(view)
        if len(found) == count:
            return found
    raise RejectedSceneError("blocked", "every camera stands in or right before an object")


def _check_pictures(pictures: Frames, scene: Scene) -> None:
    """Reject pictures that teach nothing: no object that is seen in the first frame and the last."""
    least = MIN_PIXELS * pictures.labels.shape[-1] * pictures.labels.shape[-2] / (320 * 240)
    first, last = (
        np.bincount(pictures.labels[frame, 0].ravel(), minlength=len(scene.objects) + 1)[1:] for frame in (0, -1)
    )
    if not ((first >= least) & (last >= least)).any():
        raise RejectedSceneError("unseen", "no object is seen in both frames")


def _objects(models: Sequence[ObjectModel], camera_T_objects: Float64Array) -> tuple[FrameObject, ...]:
    return tuple(
        FrameObject(
            label=number, category=model.category, model=model.name, symmetry=model.symmetry, pose=camera_T_object
        )
        for number, (model, camera_T_object) in enumerate(zip(models, camera_T_objects, strict=True), 1)
    )
