"""From a wild scene's number to its pairs: draw, let rest, act, pick two frames, render, label."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from objectflow import geometry
from objectflow.dataset.pairing import pair_objects
from objectflow.dataset.schema import FrameObject, PairRow
from objectflow.errors import DatasetError
from objectflow.frame import RgbdFrame
from objectflow.synth.generation.frame_pairs import FramePairChoice, pick_moment
from objectflow.synth.generation.rejection import draw_until_kept, library_and_broken
from objectflow.synth.generation.rows import MIN_GAP, MIN_PIXELS, Clock
from objectflow.synth.generation.tasks import Maker, SceneRows, Task
from objectflow.synth.objects.library import SPLIT_SIZES, check_split
from objectflow.synth.objects.mixed_library import Meshes
from objectflow.synth.physics.clutter_physics import act
from objectflow.synth.physics.mjcf import build_model
from objectflow.synth.physics.recording import Recording
from objectflow.synth.physics.simulate import RejectedSceneError
from objectflow.synth.rendering.renderer import Device, Renderer
from objectflow.synth.scenes.clutter_scene import LAST_START, WildScene, WildSettings, draw_wild_scene
from objectflow.synth.scenes.surroundings import is_open
from objectflow.typing import Float64Array, LabelImage


@dataclass(frozen=True)
class ClutterScenes:
    """Makes the wild scenes of one split; its fields are those of `paper_maker.PaperScenes`.

    Attributes:
        meshes: a folder of meshes, and how they are mixed in.
        texture_folder: pictures for floors, furniture, walls and objects.
    """

    seed: int
    split: str
    settings: WildSettings = field(default_factory=WildSettings)
    views: int = 1
    samples: int = 4
    device: Device = "cpu"
    meshes: Meshes | None = None
    texture_folder: Path | None = None

    def __post_init__(self) -> None:
        check_split(self.split)

    def __call__(self) -> Maker:
        """The maker, with its library open and its renderer ready."""
        library, broken = library_and_broken(self.meshes)
        plain = dataclasses.replace(self.settings.scene, images=self.texture_folder)
        settings = dataclasses.replace(self.settings, scene=plain)
        renderer = Renderer(plain.width, plain.height, samples=self.samples, device=self.device)

        def make(task: Task) -> SceneRows:
            if task.kind != "pairs":
                raise DatasetError("the preset wild has no sequences: leave --sequences out")
            part = list(SPLIT_SIZES).index(self.split)
            scene_rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(part, task.scene)))
            name = f"{self.split}-{task.scene:06d}"
            motionless = bool(scene_rng.random() < settings.motionless)

            def draw(rng: np.random.Generator, clock: Clock, skip: Callable[[str], None]) -> list[dict[str, Any]]:
                wild = draw_wild_scene(rng, library, self.split, settings, skip, motionless=motionless)
                clock.lap("draw")
                return _make_pairs(rng, name, wild, settings, renderer, self.views, clock)

            where = f"{self.split} scene {task.scene}"
            return draw_until_kept(scene_rng, draw, where=where, broken=broken, clock=Clock())

        return make


def _make_pairs(
    rng: np.random.Generator,
    name: str,
    wild: WildScene,
    settings: WildSettings,
    renderer: Renderer,
    views: int,
    clock: Clock,
) -> list[dict[str, Any]]:
    """One pair a view, each of its own moment and camera."""
    scene, models = wild.scene, wild.models
    last = LAST_START + settings.gap[1] if wild.actions else 0
    recording = act(scene, models, wild.actions, last)
    clock.lap("physics")
    shots = _draw_shots(rng, wild, recording, settings, views)
    seen = build_model(scene, models, solid=False)
    clock.lap("build")
    rows = []
    for number, (moment, cameras) in enumerate(shots):
        row = _take(f"{name}-{number}" if views > 1 else name, name, wild, moment, cameras, renderer, seen)
        clock.lap("render")
        rows.append(row.to_dict())
        clock.lap("encode")
    return rows


def _draw_shots(
    rng: np.random.Generator, wild: WildScene, recording: Recording, settings: WildSettings, views: int
) -> list[tuple[FramePairChoice, Float64Array]]:
    """For each view the moment and (2, 4, 4) `world_T_camera`, of cameras that nothing blocks."""
    scene = wild.scene
    scales = [item.scale for item in scene.objects]
    radii = np.array([model.radius * scale for model, scale in zip(wild.models, scales, strict=True)])
    movers = settings.movers if wild.actions else (0, 0)
    shots: list[tuple[FramePairChoice, Float64Array]] = []
    for view in scene.views:
        moment = pick_moment(rng, recording, wild.models, scales, gap=settings.gap, movers=movers)
        if moment is None:
            raise RejectedSceneError("unclear", "no two frames in which everything either moves or stands still")
        curr = view.world_T_camera
        moving = rng.random() < settings.moving_camera
        motion = _draw_camera_motion(rng, settings) if moving else np.eye(4)
        cameras = np.stack([curr @ motion, curr])
        gap = np.linalg.norm(moment.world_T_object[:, :, :3, 3] - cameras[:, None, :3, 3], axis=-1) - radii
        free = all(is_open(scene.slabs, camera[:3, 3], np.asarray(view.target)) for camera in cameras)
        if gap.min() > MIN_GAP and free:
            shots.append((moment, cameras))
        if len(shots) == views:
            return shots
    raise RejectedSceneError("blocked", "every camera stands in or right before something")


def _draw_camera_motion(rng: np.random.Generator, settings: WildSettings) -> Float64Array:
    """`curr_T_prev` of the camera itself, any way round: (4, 4)."""
    axis, way = rng.normal(size=(2, 3))
    turn = np.radians(rng.uniform(*settings.camera_turn)) * axis / np.linalg.norm(axis)
    shift = rng.uniform(*settings.camera_shift) * way / np.linalg.norm(way)
    return geometry.make_transform(geometry.so3_exp(turn), shift)


def _take(
    key: str, name: str, wild: WildScene, moment: FramePairChoice, cameras: Float64Array, renderer: Renderer, seen: Any
) -> PairRow:
    scene, poses = wild.scene, moment.world_T_object
    still = np.array_equal(cameras[0], cameras[1])
    if still:
        seen_by = [renderer.render(seen, poses, cameras[:1])]
    else:
        seen_by = [renderer.render(seen, poses[k : k + 1], cameras[k : k + 1]) for k in (0, 1)]
    color = np.concatenate([frames.color[:, 0] for frames in seen_by])
    depth = np.concatenate([frames.depth[:, 0] for frames in seen_by])
    labels = np.concatenate([frames.labels[:, 0] for frames in seen_by])
    _check_pictures(labels, moment)
    prev, curr = (RgbdFrame(color=color[k], depth=depth[k], camera=scene.intrinsics) for k in (0, 1))
    camera_T_world = [geometry.inverse(camera) for camera in cameras]
    objects = [
        tuple(
            FrameObject(number, model.category, model.name, model.symmetry, camera_T_world[k] @ poses[k, number - 1])
            for number, model in enumerate(wild.models, 1)
        )
        for k in (0, 1)
    ]
    return PairRow(
        key=key,
        scene=name,
        prev=prev,
        prev_labels=labels[0],
        curr=curr,
        curr_labels=labels[1],
        objects=pair_objects(objects[0], objects[1], labels[0], labels[1]),
        camera_motion=np.eye(4) if still else camera_T_world[0] @ cameras[1],
    )


def _check_pictures(labels: LabelImage, moment: FramePairChoice) -> None:
    """Reject pictures in which nothing is to be seen of what moves, or of anything where nothing does."""
    least = MIN_PIXELS * labels.shape[-1] * labels.shape[-2] / (320 * 240)
    prev, curr = (np.bincount(image.ravel(), minlength=len(moment.moves) + 1)[1:] for image in labels)
    shown = (prev >= least) & (curr >= least)
    if not (shown & moment.moves if moment.moves.any() else shown).any():
        raise RejectedSceneError("unseen", "nothing that moves is seen in both frames")
