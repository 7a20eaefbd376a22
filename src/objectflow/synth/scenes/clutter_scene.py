"""Scenes of the preset `clutter`: objects on tables, on floors and in bins, in front of walls; some are acted upon."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from objectflow.errors import DatasetError
from objectflow.synth.objects.library import Library
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.scenes.actions import Action, draw_action
from objectflow.synth.scenes.appearance import draw_floor, draw_lights, draw_surface
from objectflow.synth.scenes.initial_layout import bounding_boxes, covered_radius, place_objects
from objectflow.synth.scenes.paper_scene import (
    SceneSettings,
    check_scene_settings,
    draw_intrinsics,
    draw_scale,
    load_random_model,
)
from objectflow.synth.scenes.scene_data import Floor, Scene, SceneObject, Slab, View
from objectflow.synth.scenes.surroundings import Surroundings, draw_surroundings
from objectflow.synth.scenes.textures import TextureSpec, list_images

Range = tuple[float, float]

LAST_START = 20
"""Latest frame at which an action starts."""
MAX_RADIUS = 0.45
"""Maximum radius of the disc on which objects are placed, metres."""
SCENE = SceneSettings(
    objects=(1, 20),
    size=(0.04, 0.3),
    size_jitter=1.4,
    drop_height=0.01,
    focal=(215.0, 310.0),
    principal_shift=6.0,
    distance=(0.35, 1.3),
    elevation=(15.0, 90.0),
    roll=(-6.0, 6.0),
    image_share=0.6,
)
"""Objects, appearance and cameras of the preset."""


@dataclass(frozen=True)
class ClutterSettings:
    """Distributions that clutter scenes are drawn from."""

    scene: SceneSettings = field(default_factory=lambda: SCENE)
    """Objects, appearance and cameras; `spread` is not used."""
    spread: Range = (0.5, 2.2)
    """Radius of the disc in which objects start, as in `SceneSettings`: from a heap to objects side by side."""
    upright: float = 0.5
    """Share of upright objects, 0..1; the others have any orientation."""
    movers: tuple[int, int] = (1, 8)
    """Minimum and maximum number of moving objects in a pair with motion; small numbers are more frequent."""
    motionless: float = 0.125
    """Share of scenes without motion, 0..1."""
    gap: tuple[int, int] = (3, 60)
    """Minimum and maximum number of frames, at 60 Hz, between the two frames of a pair."""
    moving_camera: float = 0.25
    """Share of pairs with a moving camera, 0..1."""
    camera_turn: Range = (1.0, 5.0)
    """Rotation of a moving camera, degrees."""
    camera_shift: Range = (0.01, 0.05)
    """Translation of a moving camera, metres."""
    object_images: float = 0.25
    """Share of objects with an image as texture, 0..1, where there is a folder of images."""

    def __post_init__(self) -> None:
        check_scene_settings(self.scene)
        if not 1 <= self.movers[0] <= self.movers[1] or not 1 <= self.gap[0] <= self.gap[1]:
            raise DatasetError(f"clutter settings: movers and gap are ranges from 1 up, not {self.movers}, {self.gap}")
        shares = (self.upright, self.motionless, self.moving_camera, self.object_images)
        if not all(0 <= share <= 1 for share in shares):
            raise DatasetError("clutter settings: shares must be within 0 and 1")


@dataclass(frozen=True, eq=False)
class ClutterScene:
    """A scene, the models of its objects, and the actions on them; without actions nothing moves."""

    scene: Scene
    models: tuple[ObjectModel, ...]
    actions: tuple[Action, ...]


def draw_clutter_scene(
    rng: np.random.Generator,
    library: Library,
    split: str,
    settings: ClutterSettings,
    skip: Callable[[str], None] | None = None,
    *,
    motionless: bool = False,
) -> ClutterScene:
    """Draw a scene.

    Args:
        rng, library, split, skip: see `objectflow.synth.scenes.paper_scene.draw_paper_scene`.
        settings: distributions that the scene is drawn from.
        motionless: draw no actions. A caller that draws rejected scenes again must choose this once per scene:
            scenes with motion are rejected more often, so that a new choice would change their share.

    Raises:
        DatasetError: an unknown split, or a library whose models cannot be loaded.
    """
    plain = settings.scene
    acting = 0 if motionless else draw_number(rng, *settings.movers)
    count = int(rng.integers(max(acting, plain.objects[0]), max(acting, plain.objects[1]) + 1))
    models = tuple(load_random_model(rng, library, split, skip) for _ in range(count))
    scales = [draw_scale(rng, model, plain) for model in models]
    # Falling objects come last, so that they start above all others.
    actions = sorted(
        (draw_action(rng, 0, LAST_START) for _ in range(acting)), key=lambda action: action.kind == "fall"
    )
    targets = _draw_targets(rng, acting, sum(action.kind == "fall" for action in actions), count)
    actions = [dataclasses.replace(action, object=index) for action, index in zip(actions, targets, strict=True)]
    falling = {action.object for action in actions if action.kind == "fall"}
    rotations = draw_rotations(rng, count, settings.upright)
    boxes = bounding_boxes(models, scales)
    radius = min(MAX_RADIUS, float(rng.uniform(*settings.spread)) * covered_radius(boxes[1]))
    origins = place_objects(rng, rotations.as_matrix(), boxes, plain.drop_height, radius, tries=8)
    surroundings = draw_surroundings(rng, radius)
    images = list_images(plain.images) if plain.images is not None else []
    objects = []
    for k, (model, scale) in enumerate(zip(models, scales, strict=True)):
        w, qx, qy, qz = map(float, rotations[k].as_quat(scalar_first=True))
        texture, specular, shininess = draw_surface(rng, model.texture is not None)
        if rng.random() < settings.object_images and images and model.texture is None:
            texture = TextureSpec("image", path=str(images[int(rng.integers(len(images)))]))
        lift = rng.uniform(0.05, 0.2)
        x, y, z = map(float, origins[k])
        objects.append(
            SceneObject(
                category=model.category,
                name=model.name,
                scale=scale,
                density=float(rng.uniform(*plain.density)),
                position=(x, y, z + (float(lift) if k in falling else 0.0)),
                quaternion=(w, qx, qy, qz),
                texture=texture,
                specular=specular,
                shininess=shininess,
            )
        )
    floor = dataclasses.replace(draw_floor(rng, images, plain.image_share), height=surroundings.floor)
    scene = Scene(
        objects=tuple(objects),
        floor=floor,
        lights=draw_lights(rng, plain.lights),
        intrinsics=draw_intrinsics(rng, plain),
        views=tuple(draw_view(rng, plain, surroundings) for _ in range(plain.views)),
        slabs=_draw_slab_surfaces(rng, surroundings, images, plain.image_share),
    )
    return ClutterScene(scene, models, tuple(actions))


def draw_number(rng: np.random.Generator, low: int, high: int) -> int:
    """Draw an integer k from low to high with a probability proportional to 1 / k."""
    numbers = np.arange(low, high + 1)
    return int(rng.choice(numbers, p=(1 / numbers) / (1 / numbers).sum()))


def _draw_targets(rng: np.random.Generator, acting: int, falling: int, count: int) -> list[int]:
    """Draw the objects of the actions: the last ones fall, random others have the remaining actions."""
    rest = rng.permutation(count - falling)[: acting - falling]
    return [*map(int, rest), *range(count - falling, count)]


def draw_rotations(rng: np.random.Generator, count: int, upright: float) -> Rotation:
    """Draw uniformly distributed rotations, or, for the share `upright`, rotations about the vertical."""
    free = rng.normal(size=(count, 4))
    angles = rng.uniform(0, 2 * math.pi, count)
    standing = np.stack([np.zeros(count), np.zeros(count), np.sin(angles / 2), np.cos(angles / 2)], axis=1)
    return Rotation.from_quat(np.where((rng.random(count) < upright)[:, None], standing, free))


def draw_view(rng: np.random.Generator, settings: SceneSettings, surroundings: Surroundings) -> View:
    """Draw a camera; where there are walls, it looks from the side without walls."""
    x, y = map(float, rng.uniform(-0.1, 0.1, 2))
    low, high = (math.sin(math.radians(angle)) for angle in settings.elevation)
    spread = math.pi if not surroundings.walls else math.radians(60)
    return View(
        target=(x, y, 0.03),
        distance=float(rng.uniform(*settings.distance)),
        azimuth=surroundings.front + float(rng.uniform(-spread, spread)),
        elevation=math.asin(rng.uniform(low, high)),
        roll=math.radians(rng.uniform(*settings.roll)),
    )


def _draw_slab_surfaces(
    rng: np.random.Generator, surroundings: Surroundings, images: Sequence[Path], image_share: float
) -> tuple[Slab, ...]:
    """The slabs with one surface per group: table, walls, sides of a bin."""
    surfaces: dict[str, Floor] = {}
    slabs = []
    for group, slab in surroundings.slabs:
        if group not in surfaces:
            surfaces[group] = draw_floor(rng, images, image_share)
        slabs.append(dataclasses.replace(slab, surface=surfaces[group]))
    return tuple(slabs)
