"""Makes sequences of clutter scenes: actions one after another with rests between them, through a static camera."""

from __future__ import annotations

from typing import Any

import numpy as np

from objectflow import geometry
from objectflow.dataset.schema import SequenceRow
from objectflow.frame import RgbdFrame
from objectflow.synth.generation.rows import MIN_CAMERA_DISTANCE, frame_objects, visible_in_both
from objectflow.synth.generation.stage_timer import StageTimer
from objectflow.synth.physics.clutter_physics import simulate_actions
from objectflow.synth.physics.mjcf import build_model
from objectflow.synth.physics.simulate import RejectedSceneError
from objectflow.synth.rendering.renderer import Renderer
from objectflow.synth.scenes.clutter_scene import ClutterScene
from objectflow.synth.scenes.sequence_actions import STEP
from objectflow.synth.scenes.surroundings import is_unobstructed
from objectflow.typing import Float64Array

SEQUENCE_FRAMES = 30
"""Default number of frames of a sequence."""
SEQUENCE_OBJECTS = (2, 8)
"""Minimum and maximum number of objects in a sequence."""


def make_sequence(
    name: str, drawn: ClutterScene, frames: int, renderer: Renderer, timer: StageTimer
) -> list[dict[str, Any]]:
    """Make one row per frame.

    Args:
        name: of the sequence.
        drawn: the scene with its actions.
        frames: number of frames, `STEP` simulated frames apart.
        renderer: of the scene's image size.
        timer: of the stages.

    Raises:
        RejectedSceneError: the simulation or all views are unusable, or an object with an action is not visible in
            both the first and the last frame.
    """
    scene = drawn.scene
    recording = simulate_actions(scene, drawn.models, drawn.actions, STEP * (frames - 1))
    poses = recording.world_T_object[::STEP]
    timer.lap("physics")
    camera = _open_camera(drawn, poses)
    visible_model = build_model(scene, drawn.models, solid=False)
    timer.lap("build")
    rendered = renderer.render(visible_model, poses, camera[None])
    timer.lap("render")
    labels = rendered.labels[:, 0]
    visible = visible_in_both(labels[0], labels[-1], len(drawn.models))
    if not drawn.actions or not all(visible[action.object] for action in drawn.actions):
        raise RejectedSceneError("unseen", "an object with an action is not visible at the start and at the end")
    camera_T_world = geometry.inverse(camera)
    rows = [
        SequenceRow(
            name,
            STEP * k,
            RgbdFrame(color=rendered.color[k, 0], depth=rendered.depth[k, 0], camera=scene.intrinsics),
            labels[k],
            frame_objects(drawn.models, camera_T_world @ poses[k]),
        ).to_dict()
        for k in range(frames)
    ]
    timer.lap("encode")
    return rows


def _open_camera(drawn: ClutterScene, poses: Float64Array) -> Float64Array:
    """`world_T_camera` (4, 4) of the first view that keeps its distance from all objects at all times."""
    scene = drawn.scene
    radii = np.array([model.radius * item.scale for model, item in zip(drawn.models, scene.objects, strict=True)])
    for view in scene.views:
        camera = view.world_T_camera
        gap = np.linalg.norm(poses[..., :3, 3] - camera[:3, 3], axis=-1) - radii
        if gap.min() > MIN_CAMERA_DISTANCE and is_unobstructed(scene.slabs, camera[:3, 3], np.asarray(view.target)):
            return np.asarray(camera)
    raise RejectedSceneError("blocked", "something is at or directly in front of every camera")
