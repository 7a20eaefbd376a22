"""From a scene's number to its rows: draw, let fall, render, label; what went wrong is drawn anew."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.dataset.pairing import pair_objects
from objectflow.dataset.schema import FrameObject, PairRow, SequenceRow
from objectflow.errors import DatasetError
from objectflow.frame import RgbdFrame
from objectflow.synth.mjcf import build_model
from objectflow.synth.model import ObjectModel
from objectflow.synth.objects import open_library
from objectflow.synth.physics import PAIR_FRAMES, SEQUENCE_FRAMES, RejectedSceneError, Trajectory, simulate
from objectflow.synth.render import Device, Frames, Renderer
from objectflow.synth.scene import SceneSettings, draw_scene_and_models
from objectflow.synth.scene_data import Scene, View
from objectflow.synth.workers import Maker, SceneRows, Task

SPLITS = ("train", "val", "test")
MAX_DRAFTS = 50
MIN_PIXELS = 60
"""An object counts as seen from so many pixels on, at 320x240."""
MIN_GAP = 0.03
"""Metres between a camera and the sphere around any object."""
VIEW_STEP = 5
"""Frames by which each further view of a scene begins later."""


@dataclass(frozen=True)
class Scenes:
    """Makes the scenes of one split; each process that does calls it once, and keeps its renderer.

    Attributes:
        seed: of the data set.
        split: "train", "val" or "test".
        settings: what scenes are drawn from.
        views: pairs a scene, each through a camera of its own.
        samples: colour samples a pixel, 1 or 4.
        device: where pictures are made, "cpu" or "cuda".
        mesh_folder, texture_folder: meshes instead of the procedural library, pictures for floors.
    """

    seed: int
    split: str
    settings: SceneSettings = field(default_factory=SceneSettings)
    views: int = 1
    samples: int = 4
    device: Device = "cpu"
    mesh_folder: Path | None = None
    texture_folder: Path | None = None

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise DatasetError(f"unknown split {self.split!r}: choose one of {', '.join(SPLITS)}")

    def __call__(self) -> Maker:
        """The maker, with its library open and its renderer ready."""
        library = open_library(self.mesh_folder)
        renderer = Renderer(self.settings.width, self.settings.height, samples=self.samples, device=self.device)
        settings = dataclasses.replace(self.settings, images=self.texture_folder)
        # What a mesh folder has sorted out already; the procedural library has nothing broken.
        found: dict[str, str] = getattr(library, "broken", {})
        broken = [f"{name}: skipped: {reason}" for name, reason in sorted(found.items())]

        def make(task: Task) -> SceneRows:
            # (split, index); a split's sequences count as a split of their own, or they would be its pairs' scenes.
            part = SPLITS.index(self.split) + (0 if task.kind == "pairs" else len(SPLITS))
            rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(part, task.scene)))
            rejected: dict[str, int] = {}
            skipped = list(broken)
            seconds = {"draw": 0.0, "build": 0.0, "physics": 0.0, "render": 0.0, "encode": 0.0}
            clock = _Clock(seconds)
            for _ in range(MAX_DRAFTS):
                try:
                    clock.start()
                    scene, models = draw_scene_and_models(rng, library, self.split, settings, skipped.append)
                    clock.lap("draw")
                    word = "" if task.kind == "pairs" else "sequence-"
                    name = f"{self.split}-{word}{task.scene:06d}"
                    maker = _pairs if task.kind == "pairs" else _sequence
                    rows = maker(name, scene, models, renderer, clock, self.views)
                    return SceneRows(rows, rejected, tuple(dict.fromkeys(skipped)), seconds)
                except RejectedSceneError as error:
                    rejected[error.reason] = rejected.get(error.reason, 0) + 1
            raise DatasetError(
                f"{self.split} scene {task.scene}: {MAX_DRAFTS} drafts were rejected ({rejected}): check the settings"
            )

        return make


class _Clock:
    def __init__(self, seconds: dict[str, float]) -> None:
        self._seconds = seconds
        self._since = time.perf_counter()

    def start(self) -> None:
        self._since = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self._seconds[stage] += now - self._since
        self._since = now


def _pairs(
    name: str,
    scene: Scene,
    models: Sequence[ObjectModel],
    renderer: Renderer,
    clock: _Clock,
    views: int,
) -> list[dict[str, Any]]:
    """One pair a view: each further view has its own camera and begins a little later."""
    starts = [VIEW_STEP * view for view in range(views)]
    wanted = sorted({frame + start for start in starts for frame in PAIR_FRAMES})
    trajectory = simulate(scene, models, wanted)
    clock.lap("physics")
    open_views = _open_views(scene, models, trajectory, views)
    seen = build_model(scene, models, solid=False)
    clock.lap("build")
    rows = []
    for number, (start, view) in enumerate(zip(starts, open_views, strict=True)):
        at = [trajectory.frames.index(frame + start) for frame in PAIR_FRAMES]
        poses = trajectory.world_T_object[at]
        pictures = renderer.render(seen, poses, view.world_T_camera[None])
        clock.lap("render")
        _check_pictures(pictures, scene)
        camera_T_world = geometry.inverse(view.world_T_camera)
        objects = [_objects(models, camera_T_world @ frame) for frame in poses]
        labels = pictures.labels[:, 0]
        frames = [_frame(pictures, frame, scene) for frame in (0, 1)]
        row = PairRow(
            key=f"{name}-{number}" if views > 1 else name,
            scene=name,
            prev=frames[0],
            prev_labels=labels[0],
            curr=frames[1],
            curr_labels=labels[1],
            objects=pair_objects(objects[0], objects[1], labels[0], labels[1]),
        )
        rows.append(row.to_dict())
        clock.lap("encode")
    return rows


def _sequence(
    name: str,
    scene: Scene,
    models: Sequence[ObjectModel],
    renderer: Renderer,
    clock: _Clock,
    views: int,
) -> list[dict[str, Any]]:
    """One row a frame: 20, 30, ..., 90, through one camera."""
    trajectory = simulate(scene, models, SEQUENCE_FRAMES)
    clock.lap("physics")
    (view,) = _open_views(scene, models, trajectory, 1)
    seen = build_model(scene, models, solid=False)
    clock.lap("build")
    pictures = renderer.render(seen, trajectory.world_T_object, view.world_T_camera[None])
    clock.lap("render")
    _check_pictures(pictures, scene)
    camera_T_world = geometry.inverse(view.world_T_camera)
    rows = []
    for position, frame in enumerate(trajectory.frames):
        row = SequenceRow(
            sequence=name,
            frame=frame,
            image=_frame(pictures, position, scene),
            labels=pictures.labels[position, 0],
            objects=_objects(models, camera_T_world @ trajectory.world_T_object[position]),
        )
        rows.append(row.to_dict())
    clock.lap("encode")
    return rows


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


def _frame(pictures: Frames, frame: int, scene: Scene) -> RgbdFrame:
    return RgbdFrame(color=pictures.color[frame, 0], depth=pictures.depth[frame, 0], camera=scene.intrinsics)


def _objects(models: Sequence[ObjectModel], camera_T_objects: NDArray[np.float64]) -> tuple[FrameObject, ...]:
    return tuple(
        FrameObject(
            label=number, category=model.category, model=model.name, symmetry=model.symmetry, pose=camera_T_object
        )
        for number, (model, camera_T_object) in enumerate(zip(models, camera_T_objects, strict=True), 1)
    )
