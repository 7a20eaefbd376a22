"""Makes sequences of clutter scenes: actions one after another with rests between them."""

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
CAMERA_PERIOD = 24
"""Number of frames in which a moving camera returns to its first pose."""


def draw_camera_path(rng: np.random.Generator, frames: int, turn: float, shift: float) -> Float64Array:
    """Draw `start_T_camera` (frames, 4, 4) of a camera that moves on a circle while its viewing direction circles.

    Both return to their start after `CAMERA_PERIOD` frames, so that the scene stays in view.

    Args:
        rng: source of randomness.
        frames: number of frames.
        turn: degrees between two frames.
        shift: metres between two frames.
    """
    step = 2 * np.pi / CAMERA_PERIOD
    first_turn, first_shift = rng.uniform(0, 2 * np.pi, 2)
    normal = rng.normal(size=3)
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    second = np.cross(normal / np.linalg.norm(normal), first)
    angles = step * np.arange(frames)
    chord = 2 * np.sin(step / 2)

    def circle(start: float, length: float) -> Float64Array:
        """(frames, 2) points on a circle, from the origin; neighbours have this distance."""
        points = np.stack([np.cos(angles + start), np.sin(angles + start)], axis=1) * (length / chord)
        return np.asarray(points - points[0])

    # A rotation vector without a component along z turns the viewing direction and does not roll the image.
    turns, shifts = circle(first_turn, np.radians(turn)), circle(first_shift, shift)
    return np.stack(
        [
            geometry.make_transform(geometry.so3_exp(np.array([*vector, 0.0])), x * first + y * second)
            for vector, (x, y) in zip(turns, shifts, strict=True)
        ]
    )


def make_sequence(
    name: str,
    drawn: ClutterScene,
    frames: int,
    renderer: Renderer,
    timer: StageTimer,
    path: Float64Array | None = None,
) -> list[dict[str, Any]]:
    """Make one row per frame.

    Args:
        name: of the sequence.
        drawn: the scene with its actions.
        frames: number of frames, `STEP` simulated frames apart.
        renderer: of the scene's image size.
        timer: of the stages.
        path: `start_T_camera` (frames, 4, 4) of a moving camera.

    Raises:
        RejectedSceneError: the simulation or all views are unusable, or an object with an action is not visible in
            both the first and the last frame.
    """
    scene = drawn.scene
    recording = simulate_actions(scene, drawn.models, drawn.actions, STEP * (frames - 1))
    poses = recording.world_T_object[::STEP]
    timer.lap("physics")
    start_T_camera = np.eye(4)[None] if path is None else path
    cameras = _open_cameras(drawn, poses, start_T_camera)
    visible_model = build_model(scene, drawn.models, solid=False)
    timer.lap("build")
    if path is None:
        parts = [renderer.render(visible_model, poses, cameras)]
    else:
        parts = [renderer.render(visible_model, poses[k : k + 1], cameras[k : k + 1]) for k in range(frames)]
    color, depth, labels = (
        np.concatenate([getattr(part, name)[:, 0] for part in parts]) for name in ("color", "depth", "labels")
    )
    timer.lap("render")
    visible = visible_in_both(labels[0], labels[-1], len(drawn.models))
    if not drawn.actions or not all(visible[action.object] for action in drawn.actions):
        raise RejectedSceneError("unseen", "an object with an action is not visible at the start and at the end")
    camera_T_world = np.stack([geometry.inverse(camera) for camera in np.broadcast_to(cameras, (frames, 4, 4))])
    rows = [
        SequenceRow(
            name,
            STEP * k,
            RgbdFrame(color=color[k], depth=depth[k], camera=scene.intrinsics),
            labels[k],
            frame_objects(drawn.models, camera_T_world[k] @ poses[k]),
            None if path is None else path[k],
        ).to_dict()
        for k in range(frames)
    ]
    timer.lap("encode")
    return rows


def _open_cameras(drawn: ClutterScene, poses: Float64Array, start_T_camera: Float64Array) -> Float64Array:
    """`world_T_camera` (C, 4, 4) along a path, from the first view that keeps its distance from all objects."""
    scene = drawn.scene
    radii = np.array([model.radius * item.scale for model, item in zip(drawn.models, scene.objects, strict=True)])
    for view in scene.views:
        cameras = view.world_T_camera @ start_T_camera
        eyes = cameras[:, :3, 3]
        gap = np.linalg.norm(poses[..., :3, 3] - eyes[:, None], axis=-1) - radii
        target = np.asarray(view.target)
        if gap.min() > MIN_CAMERA_DISTANCE and all(is_unobstructed(scene.slabs, eye, target) for eye in eyes):
            return np.asarray(cameras)
    raise RejectedSceneError("blocked", "something is at or directly in front of every camera")
