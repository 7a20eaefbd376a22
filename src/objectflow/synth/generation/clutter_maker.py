"""Makes the rows of clutter scenes: draw, settle, carry out actions, select two frames, render, label."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from objectflow import geometry
from objectflow.dataset.pairing import pair_objects
from objectflow.dataset.schema import PairRow
from objectflow.frame import RgbdFrame
from objectflow.synth.generation.clutter_sequences import (
    SEQUENCE_FRAMES,
    SEQUENCE_OBJECTS,
    draw_camera_path,
    make_sequence,
)
from objectflow.synth.generation.frame_pairs import SelectedFrames, select_frames
from objectflow.synth.generation.rejection import DrawRows
from objectflow.synth.generation.rows import MIN_CAMERA_DISTANCE, frame_objects, visible_in_both
from objectflow.synth.generation.scene_factory import SceneFactory
from objectflow.synth.generation.stage_timer import StageTimer
from objectflow.synth.generation.tasks import Task
from objectflow.synth.objects.library import Library
from objectflow.synth.physics.clutter_physics import simulate_actions
from objectflow.synth.physics.mjcf import build_model
from objectflow.synth.physics.recording import Recording
from objectflow.synth.physics.simulate import RejectedSceneError
from objectflow.synth.rendering.renderer import Renderer
from objectflow.synth.scenes.clutter_scene import LAST_START, ClutterScene, ClutterSettings, draw_clutter_scene
from objectflow.synth.scenes.paper_scene import SceneSettings
from objectflow.synth.scenes.sequence_actions import draw_sequence_actions
from objectflow.synth.scenes.surroundings import is_unobstructed
from objectflow.typing import Float64Array


@dataclass(frozen=True)
class ClutterScenes(SceneFactory[ClutterSettings]):
    """Cluttered scenes with actions; see `SceneFactory`. Texture images cover floors, furniture, walls and objects."""

    settings: ClutterSettings = field(default_factory=ClutterSettings)
    sequence_frames: int = SEQUENCE_FRAMES
    """Number of frames of a sequence."""
    camera_turn: float = 0.0
    """Degrees by which the camera of a sequence turns per frame."""
    camera_shift: float = 0.0
    """Metres by which the camera of a sequence moves per frame."""

    @property
    def scene_settings(self) -> SceneSettings:
        """See `SceneFactory.scene_settings`."""
        return dataclasses.replace(self.settings.scene, images=self.texture_folder)

    def begin(self, task: Task, rng: np.random.Generator, library: Library, renderer: Renderer) -> DrawRows:
        """See `SceneFactory.begin`. Whether the scene has motion is decided here, once for all attempts."""
        settings = dataclasses.replace(self.settings, scene=self.scene_settings)
        if task.kind == "sequences":
            plain = dataclasses.replace(settings.scene, objects=SEQUENCE_OBJECTS)
            settings = dataclasses.replace(settings, scene=plain)

            def draw_frames(
                rng: np.random.Generator, timer: StageTimer, skip: Callable[[str], None]
            ) -> list[dict[str, Any]]:
                drawn = draw_clutter_scene(rng, library, self.split, settings, skip, motionless=True)
                actions = draw_sequence_actions(rng, len(drawn.models), self.sequence_frames)
                timer.lap("draw")
                scene = dataclasses.replace(drawn, actions=actions)
                path = None
                if self.camera_turn or self.camera_shift:
                    path = draw_camera_path(rng, self.sequence_frames, self.camera_turn, self.camera_shift)
                return make_sequence(self.scene_name(task), scene, self.sequence_frames, renderer, timer, path)

            return draw_frames
        motionless = bool(rng.random() < settings.motionless)

        def draw(rng: np.random.Generator, timer: StageTimer, skip: Callable[[str], None]) -> list[dict[str, Any]]:
            drawn = draw_clutter_scene(rng, library, self.split, settings, skip, motionless=motionless)
            timer.lap("draw")
            return _make_pairs(rng, self.scene_name(task), drawn, settings, renderer, self.views, timer)

        return draw


def _make_pairs(
    rng: np.random.Generator,
    name: str,
    drawn: ClutterScene,
    settings: ClutterSettings,
    renderer: Renderer,
    views: int,
    timer: StageTimer,
) -> list[dict[str, Any]]:
    """Make one pair per view, each with its own frames and camera."""
    last = LAST_START + settings.gap[1] if drawn.actions else 0
    recording = simulate_actions(drawn.scene, drawn.models, drawn.actions, last)
    timer.lap("physics")
    shots = _draw_shots(rng, drawn, recording, settings, views)
    visible_model = build_model(drawn.scene, drawn.models, solid=False)
    timer.lap("build")
    rows = []
    for number, (selected, cameras) in enumerate(shots):
        key = f"{name}-{number}" if views > 1 else name
        row = _render_pair(key, name, drawn, selected, cameras, renderer, visible_model)
        timer.lap("render")
        rows.append(row.to_dict())
        timer.lap("encode")
    return rows


def _draw_shots(
    rng: np.random.Generator, drawn: ClutterScene, recording: Recording, settings: ClutterSettings, views: int
) -> list[tuple[SelectedFrames, Float64Array]]:
    """Select frames and unobstructed cameras, `world_T_camera` (2, 4, 4), for each view."""
    scene = drawn.scene
    scales = [item.scale for item in scene.objects]
    radii = np.array([model.radius * scale for model, scale in zip(drawn.models, scales, strict=True)])
    movers = settings.movers if drawn.actions else (0, 0)
    shots: list[tuple[SelectedFrames, Float64Array]] = []
    for view in scene.views:
        selected = select_frames(rng, recording, drawn.models, scales, gap=settings.gap, movers=movers)
        if selected is None:
            raise RejectedSceneError("unclear", "no two frames in which every object either moves or stands still")
        curr = view.world_T_camera
        moving = rng.random() < settings.moving_camera
        motion = draw_camera_motion(rng, settings.camera_turn, settings.camera_shift) if moving else np.eye(4)
        cameras = np.stack([curr @ motion, curr])
        gap = np.linalg.norm(selected.world_T_object[:, :, :3, 3] - cameras[:, None, :3, 3], axis=-1) - radii
        free = all(is_unobstructed(scene.slabs, camera[:3, 3], np.asarray(view.target)) for camera in cameras)
        if gap.min() > MIN_CAMERA_DISTANCE and free:
            shots.append((selected, cameras))
        if len(shots) == views:
            return shots
    raise RejectedSceneError("blocked", "something is at or directly in front of every camera")


def draw_camera_motion(
    rng: np.random.Generator, turn: tuple[float, float], shift: tuple[float, float]
) -> Float64Array:
    """Draw `curr_T_prev` (4, 4) of the camera, with uniformly distributed directions of axis and translation.

    Args:
        rng: source of randomness.
        turn: range of the rotation, degrees.
        shift: range of the translation, metres.
    """
    axis, direction = rng.normal(size=(2, 3))
    rotation_vector = np.radians(rng.uniform(*turn)) * axis / np.linalg.norm(axis)
    offset = rng.uniform(*shift) * direction / np.linalg.norm(direction)
    return geometry.make_transform(geometry.so3_exp(rotation_vector), offset)


def _render_pair(
    key: str,
    name: str,
    drawn: ClutterScene,
    selected: SelectedFrames,
    cameras: Float64Array,
    renderer: Renderer,
    visible_model: Any,
) -> PairRow:
    scene, poses = drawn.scene, selected.world_T_object
    static_camera = np.array_equal(cameras[0], cameras[1])
    if static_camera:
        rendered = [renderer.render(visible_model, poses, cameras[:1])]
    else:
        rendered = [renderer.render(visible_model, poses[k : k + 1], cameras[k : k + 1]) for k in (0, 1)]
    color = np.concatenate([frames.color[:, 0] for frames in rendered])
    depth = np.concatenate([frames.depth[:, 0] for frames in rendered])
    labels = np.concatenate([frames.labels[:, 0] for frames in rendered])
    visible = visible_in_both(labels[0], labels[1], len(drawn.models))
    if not (visible & selected.moving if selected.moving.any() else visible).any():
        raise RejectedSceneError("unseen", "no moving object is visible in both frames")
    prev, curr = (RgbdFrame(color=color[k], depth=depth[k], camera=scene.intrinsics) for k in (0, 1))
    camera_T_world = [geometry.inverse(camera) for camera in cameras]
    prev_objects, curr_objects = (
        frame_objects(drawn.models, [camera_T_world[k] @ pose for pose in poses[k]]) for k in (0, 1)
    )
    return PairRow(
        key=key,
        scene=name,
        prev=prev,
        prev_labels=labels[0],
        curr=curr,
        curr_labels=labels[1],
        objects=pair_objects(prev_objects, curr_objects, labels[0], labels[1]),
        camera_motion=np.eye(4) if static_camera else camera_T_world[0] @ cameras[1],
    )
