"""Makes the rows of tabletop scenes: draw, simulate, move the arms, select two frames, render under changing light."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from objectflow import geometry
from objectflow.dataset.pairing import pair_objects
from objectflow.dataset.schema import PairRow
from objectflow.errors import DatasetError
from objectflow.frame import RgbdFrame
from objectflow.synth.generation.clutter_maker import draw_camera_motion
from objectflow.synth.generation.frame_pairs import (
    MAX_STATIC_DISPLACEMENT,
    MIN_MOVING_DISPLACEMENT,
    SelectedFrames,
    select_frames,
)
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
from objectflow.synth.rendering.color_response import draw_responses
from objectflow.synth.rendering.renderer import RenderedFrames, Renderer
from objectflow.synth.scenes.arm_motion import arm_poses
from objectflow.synth.scenes.clutter_scene import LAST_START
from objectflow.synth.scenes.light_changes import change_lights, place_shadow_caster
from objectflow.synth.scenes.paper_scene import SceneSettings
from objectflow.synth.scenes.scene_data import Light, Scene
from objectflow.synth.scenes.surroundings import is_unobstructed
from objectflow.synth.scenes.tabletop_scene import (
    TabletopScene,
    TabletopSettings,
    draw_tabletop_scene,
    scaled_scene,
)
from objectflow.typing import Float64Array

MIN_ARM_DISTANCE = 0.12
"""Minimum distance between a camera and any vertex of an arm before the scene is scaled, metres."""
MAX_ARM_SHARE = 0.45
"""Maximum share of an image that arms cover, 0..1."""
OUT_OF_THE_WAY = np.array([0.0, 0.0, -30.0])
"""Place of a shadow caster that is not used, metres: below the floor, where it casts no visible shadow."""


@dataclass(frozen=True)
class TabletopScenes(SceneFactory[TabletopSettings]):
    """Tabletop scenes; see `SceneFactory`. Texture images cover furniture, walls, sheets of paper and objects."""

    settings: TabletopSettings = field(default_factory=TabletopSettings)

    @property
    def scene_settings(self) -> SceneSettings:
        """See `SceneFactory.scene_settings`."""
        return dataclasses.replace(self.settings.scene, images=self.texture_folder)

    def begin(self, task: Task, rng: np.random.Generator, library: Library, renderer: Renderer) -> DrawRows:
        """See `SceneFactory.begin`. Whether the scene has motion is decided here, once for all attempts."""
        if task.kind != "pairs":
            raise DatasetError("the preset tabletop has no sequences: leave --sequences out")
        settings = dataclasses.replace(self.settings, scene=self.scene_settings)
        motionless = bool(rng.random() < settings.motionless)

        def draw(rng: np.random.Generator, timer: StageTimer, skip: Callable[[str], None]) -> list[dict[str, Any]]:
            drawn = draw_tabletop_scene(rng, library, self.split, settings, skip, motionless=motionless)
            timer.lap("draw")
            return _make_pairs(rng, self.scene_name(task), drawn, settings, renderer, self.views, timer)

        return draw


@dataclass(frozen=True, eq=False)
class _Shot:
    """What differs between the pairs of one scene: times, cameras and light."""

    poses: Float64Array
    """(2, N, 4, 4) `world_T_object` in both frames, the shadow caster last, metres."""
    moving: bool
    """Whether any object moves, the shadow caster left out."""
    cameras: Float64Array
    """(2, 4, 4) `world_T_camera`; equal for a static camera."""
    lights: tuple[tuple[Light, ...], tuple[Light, ...]]
    """The lamps in both frames."""


def _make_pairs(
    rng: np.random.Generator,
    name: str,
    drawn: TabletopScene,
    settings: TabletopSettings,
    renderer: Renderer,
    views: int,
    timer: StageTimer,
) -> list[dict[str, Any]]:
    """Make one pair per view, each with its own frames, camera and light."""
    recording = _record(drawn, LAST_START + settings.gap[1] if drawn.actions else 0)
    scene = scaled_scene(drawn.scene, drawn.scale)
    timer.lap("physics")
    shots = _draw_shots(rng, drawn, scene, recording, settings, views)
    visible_model = build_model(scene, drawn.models, solid=False)
    timer.lap("build")
    rendered = renderer.render_each(
        visible_model,
        np.concatenate([shot.poses for shot in shots]),
        np.concatenate([shot.cameras for shot in shots]),
        [lights for shot in shots for lights in shot.lights],
    )
    timer.lap("render")
    rows = []
    for number, shot in enumerate(shots):
        key = f"{name}-{number}" if views > 1 else name
        row = _make_row(rng, key, name, drawn, scene, shot, settings, rendered, 2 * number)
        rows.append(row.to_dict())
        timer.lap("encode")
    return rows


def _record(drawn: TabletopScene, last: int) -> Recording:
    """Simulate the objects, move the arms with them, and scale the result; the shadow caster is left out."""
    free = drawn.free
    solid = dataclasses.replace(drawn.scene, objects=drawn.scene.objects[:free])
    recording = simulate_actions(solid, drawn.models[:free], drawn.actions, last)
    poses = [recording.world_T_object]
    for arm, plan in drawn.arms:
        if plan.action is None:
            poses.append(arm_poses(plan, arm, None, None, last + 1)[:, None])
        else:
            target = plan.action.object
            vertices = drawn.models[target].vertices * drawn.scene.objects[target].scale
            poses.append(arm_poses(plan, arm, recording.world_T_object[:, target], vertices, last + 1)[:, None])
    world_T_object = np.concatenate(poses, axis=1)
    world_T_object[..., :3, 3] *= drawn.scale
    return Recording(world_T_object, recording.penetration, recording.energy)


def _draw_shots(
    rng: np.random.Generator,
    drawn: TabletopScene,
    scene: Scene,
    recording: Recording,
    settings: TabletopSettings,
    views: int,
) -> list[_Shot]:
    """Select frames, unobstructed cameras, light and shadows for each view."""
    scales = [item.scale for item in scene.objects[:-1]]
    models, factor = drawn.models[:-1], drawn.scale
    movers = settings.movers if drawn.actions else (0, 0)
    shots: list[_Shot] = []
    for view in scene.views:
        # Far scenes are also noisy, so that the least motion grows with the scale; it never falls below the default.
        selected = select_frames(
            rng, recording, models, scales, gap=settings.gap, movers=movers,
            least_motion=MIN_MOVING_DISPLACEMENT * max(1.0, factor), most_rest=MAX_STATIC_DISPLACEMENT * factor,
        )  # fmt: skip
        if selected is None:
            raise RejectedSceneError("unclear", "no two frames in which every object either moves or stands still")
        curr = view.world_T_camera
        motion = np.eye(4)
        if rng.random() < settings.moving_camera:
            motion = draw_camera_motion(rng, settings.camera_turn, settings.camera_shift)
            motion[:3, 3] *= factor
        cameras = np.stack([curr @ motion, curr])
        free = all(is_unobstructed(scene.slabs, camera[:3, 3], np.asarray(view.target)) for camera in cameras)
        shown = _shows_shoulder(drawn, scene, selected, cameras)
        hidden = rng.random() < settings.visible_shoulders or not shown
        if free and hidden and _keeps_distance(drawn, scene, selected, cameras):
            lights = (
                scene.lights,
                change_lights(rng, scene.lights) if rng.random() < settings.relit else scene.lights,
            )
            caster = _place_caster(rng, drawn, scene, cameras, settings)
            poses = np.concatenate([selected.world_T_object, caster[:, None]], axis=1)
            shots.append(_Shot(poses, bool(selected.moving.any()), cameras, lights))
        if len(shots) == views:
            return shots
    raise RejectedSceneError("blocked", "something is at or directly in front of every camera")


def _keeps_distance(drawn: TabletopScene, scene: Scene, selected: SelectedFrames, cameras: Float64Array) -> bool:
    """Whether both cameras keep their distance from all objects and arms."""
    for number, (model, item) in enumerate(zip(drawn.models[:-1], scene.objects[:-1], strict=True)):
        poses, eyes = selected.world_T_object[:, number], cameras[:, :3, 3]
        if number < drawn.free:
            gap = np.linalg.norm(poses[:, :3, 3] - eyes, axis=-1) - model.radius * item.scale
            least = MIN_CAMERA_DISTANCE
        else:
            points = model.vertices * item.scale @ poses[:, :3, :3].swapaxes(-1, -2) + poses[:, None, :3, 3]
            gap = np.linalg.norm(points - eyes[:, None], axis=-1)
            least = MIN_ARM_DISTANCE
        if gap.min() < least * drawn.scale:
            return False
    return True


def _shows_shoulder(drawn: TabletopScene, scene: Scene, selected: SelectedFrames, cameras: Float64Array) -> bool:
    """Whether an arm's end, where the body would be, is within the image of one of the frames."""
    for number, (arm, _) in enumerate(drawn.arms, drawn.free):
        for pose, camera in zip(selected.world_T_object[:, number], cameras, strict=True):
            world = pose[:3, :3] @ arm.shoulder * drawn.scale + pose[:3, 3]
            x, y, z = camera[:3, :3].T @ (world - camera[:3, 3])
            c = scene.intrinsics
            if z > 0 and 0 <= c.fx * x / z + c.cx < c.width and 0 <= c.fy * y / z + c.cy < c.height:
                return True
    return False


def _place_caster(
    rng: np.random.Generator, drawn: TabletopScene, scene: Scene, cameras: Float64Array, settings: TabletopSettings
) -> Float64Array:
    """(2, 4, 4) poses of the shadow caster in both frames; out of everybody's way in most pairs."""
    rotation = geometry.so3_exp(rng.normal(size=3) * 1.5)
    turn = geometry.so3_exp(rng.normal(size=3) * 0.15)
    places = None
    if rng.random() < settings.shadows:
        energies = [light.diffuse[1] for light in scene.lights]
        size = drawn.models[-1].radius * drawn.scale
        places = place_shadow_caster(
            rng, scene.lights[int(np.argmax(energies))], drawn.radius * drawn.scale, size, cameras, scene.intrinsics
        )
    if places is None:
        places = np.stack([OUT_OF_THE_WAY] * 2)
    return geometry.make_transform(np.stack([rotation, turn @ rotation]), places)


def _make_row(
    rng: np.random.Generator,
    key: str,
    name: str,
    drawn: TabletopScene,
    scene: Scene,
    shot: _Shot,
    settings: TabletopSettings,
    rendered: RenderedFrames,
    first: int,
) -> PairRow:
    """The row of a shot, whose frames are the rendered images `first` and `first` + 1."""
    color, depth, labels = (
        images[first : first + 2, 0] for images in (rendered.color, rendered.depth, rendered.labels)
    )
    count = len(drawn.models)
    visible = visible_in_both(labels[0], labels[1], count)
    still = (shot.poses[0] == shot.poses[1]).all(axis=(-2, -1))
    if not (visible & ~still if shot.moving else visible).any():
        raise RejectedSceneError("unseen", "no moving object is visible in both frames")
    if max(float((frame > drawn.free).mean()) for frame in labels) > MAX_ARM_SHARE:
        raise RejectedSceneError("covered", "an arm covers most of an image")
    responses = draw_responses(rng, settings.response)
    prev, curr = (
        RgbdFrame(color=responses[k].apply(color[k]), depth=depth[k], camera=scene.intrinsics) for k in (0, 1)
    )
    camera_T_world = [geometry.inverse(camera) for camera in shot.cameras]
    prev_objects, curr_objects = (
        frame_objects(drawn.models, [camera_T_world[k] @ pose for pose in shot.poses[k]]) for k in (0, 1)
    )
    static_camera = np.array_equal(shot.cameras[0], shot.cameras[1])
    return PairRow(
        key=key,
        scene=name,
        prev=prev,
        prev_labels=labels[0],
        curr=curr,
        curr_labels=labels[1],
        objects=pair_objects(prev_objects, curr_objects, labels[0], labels[1]),
        camera_motion=np.eye(4) if static_camera else camera_T_world[0] @ shot.cameras[1],
    )
