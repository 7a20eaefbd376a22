"""Scenes of the preset `wild`: things on tables, floors and in bins, with walls behind; some are acted upon."""

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
from objectflow.synth.scenes.initial_layout import hang
from objectflow.synth.scenes.paper_scene import (
    SceneSettings,
    check_scene_settings,
    draw_intrinsics,
    draw_scale,
    load_any,
)
from objectflow.synth.scenes.scene_data import Floor, Scene, SceneObject, Slab, View
from objectflow.synth.scenes.surroundings import Surroundings, draw_surroundings
from objectflow.synth.scenes.textures import TextureSpec, list_images
from objectflow.typing import Float64Array

Range = tuple[float, float]

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


@dataclass(frozen=True)
class WildSettings:
    """What wild scenes are drawn from."""

    scene: SceneSettings = field(default_factory=lambda: SCENE)
    """Objects, looks and cameras; `spread` does not count."""
    spread: Range = (0.5, 2.2)
    """How far apart objects start, as in `SceneSettings`: from a heap to one beside the other."""
    upright: float = 0.5
    """Share of the objects that stand as they were made to stand; the others fall as they may."""
    movers: tuple[int, int] = (1, 8)
    """Objects that move in a pair with motion, from and to; few are drawn more often than many."""
    motionless: float = 0.125
    """Share of the scenes in which nothing moves."""
    gap: tuple[int, int] = (3, 60)
    """Frames of 60 Hz between the two of a pair."""
    moving_camera: float = 0.25
    """Share of the pairs before a camera that moves."""
    camera_turn: Range = (1.0, 5.0)
    """Degrees that it turns then."""
    camera_shift: Range = (0.01, 0.05)
    """Metres that it goes."""
    object_images: float = 0.25
    """Share of the objects that wear a picture, where there is a folder of them."""

    def __post_init__(self) -> None:
        check_scene_settings(self.scene)
        if not 1 <= self.movers[0] <= self.movers[1] or not 1 <= self.gap[0] <= self.gap[1]:
            raise DatasetError(f"wild settings: movers and gap are ranges from 1 up, not {self.movers}, {self.gap}")
        shares = (self.upright, self.motionless, self.moving_camera, self.object_images)
        if not all(0 <= share <= 1 for share in shares):
            raise DatasetError("wild settings: shares lie within 0 and 1")


@dataclass(frozen=True, eq=False)
class WildScene:
    """A scene, its models, and what is done to its objects; without actions nothing moves."""

    scene: Scene
    models: tuple[ObjectModel, ...]
    actions: tuple[Action, ...]


LAST_START = 20
"""Frame at which the latest action begins."""


def draw_wild_scene(
    rng: np.random.Generator,
    library: Library,
    split: str,
    settings: WildSettings,
    skip: Callable[[str], None] | None = None,
    *,
    motionless: bool = False,
) -> WildScene:
    """Draw a scene.

    Args:
        rng, library, split, skip: see `objectflow.synth.scenes.paper_scene.draw_scene_and_models`.
        settings: see there.
        motionless: nothing is done to anything. Whoever draws a scene anew decides this first, once: more scenes with
            motion than without come to nothing.

    Raises:
        DatasetError: an unknown split, or a library whose models cannot be loaded.
    """
    plain = settings.scene
    acting = 0 if motionless else _draw_few(rng, *settings.movers)
    count = int(rng.integers(max(acting, plain.objects[0]), max(acting, plain.objects[1]) + 1))
    models = tuple(load_any(rng, library, split, skip) for _ in range(count))
    scales = [draw_scale(rng, model, plain) for model in models]
    # What falls comes last: it hangs above everything else.
    actions = sorted((draw_action(rng, 0, LAST_START) for _ in range(acting)), key=lambda one: one.kind == "fall")
    places = _draw_actors(rng, acting, sum(one.kind == "fall" for one in actions), count)
    actions = [dataclasses.replace(one, object=place) for one, place in zip(actions, places, strict=True)]
    hanging = {one.object for one in actions if one.kind == "fall"}
    rotations = _draw_rotations(rng, count, settings.upright)
    centers, radius = _draw_places(rng, models, scales, rotations.as_matrix(), settings)
    surroundings = draw_surroundings(rng, radius)
    images = list_images(plain.images) if plain.images is not None else []
    objects = []
    for k, (model, scale) in enumerate(zip(models, scales, strict=True)):
        w, x, y, z = map(float, rotations[k].as_quat(scalar_first=True))
        texture, specular, shininess = draw_surface(rng, model.texture is not None)
        if rng.random() < settings.object_images and images and model.texture is None:
            texture = TextureSpec("image", path=str(images[int(rng.integers(len(images)))]))
        lift = rng.uniform(0.05, 0.2)
        x0, y0, z0 = map(float, centers[k])
        objects.append(
            SceneObject(
                category=model.category,
                name=model.name,
                scale=scale,
                density=float(rng.uniform(*plain.density)),
                position=(x0, y0, z0 + (float(lift) if k in hanging else 0.0)),
                quaternion=(w, x, y, z),
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
        views=tuple(_draw_view(rng, plain, surroundings) for _ in range(plain.views)),
        slabs=_dress(rng, surroundings, images, plain.image_share),
    )
    return WildScene(scene, models, tuple(actions))


def _draw_few(rng: np.random.Generator, low: int, high: int) -> int:
    """A whole number of a range; k is drawn in proportion to 1 / k."""
    numbers = np.arange(low, high + 1)
    return int(rng.choice(numbers, p=(1 / numbers) / (1 / numbers).sum()))


def _draw_actors(rng: np.random.Generator, acting: int, falling: int, count: int) -> list[int]:
    """Objects for the actions: the last ones for those that fall, any others for the rest."""
    rest = rng.permutation(count - falling)[: acting - falling]
    return [*map(int, rest), *range(count - falling, count)]


def _draw_rotations(rng: np.random.Generator, count: int, upright: float) -> Rotation:
    """Any way round, or standing and turned about the vertical."""
    free = rng.normal(size=(count, 4))
    angles = rng.uniform(0, 2 * math.pi, count)
    standing = np.stack([np.zeros(count), np.zeros(count), np.sin(angles / 2), np.cos(angles / 2)], axis=1)
    return Rotation.from_quat(np.where((rng.random(count) < upright)[:, None], standing, free))


def _draw_places(
    rng: np.random.Generator,
    models: Sequence[ObjectModel],
    scales: Sequence[float],
    rotations: Float64Array,
    settings: WildSettings,
) -> tuple[Float64Array, float]:
    """(N, 3) positions of the objects' origins, just above the table, and the radius of the disc that they share."""
    low = np.stack([model.vertices.min(axis=0) * scale for model, scale in zip(models, scales, strict=True)])
    high = np.stack([model.vertices.max(axis=0) * scale for model, scale in zip(models, scales, strict=True)])
    half = (high - low) / 2
    sides = np.sort(2 * half, axis=1)
    area = float((sides[:, 1] * sides[:, 2]).sum()) / math.pi
    radius = min(0.45, float(rng.uniform(*settings.spread)) * math.sqrt(area))
    boxes = hang(rng, rotations, half, settings.scene.drop_height, radius, tries=8)
    return np.asarray(boxes - np.einsum("nij,nj->ni", rotations, (high + low) / 2)), radius


def _draw_view(rng: np.random.Generator, settings: SceneSettings, surroundings: Surroundings) -> View:
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


def _dress(
    rng: np.random.Generator, surroundings: Surroundings, images: Sequence[Path], share: float
) -> tuple[Slab, ...]:
    """The slabs with a surface for each group of them: a table, the walls, a bin's sides."""
    surfaces: dict[str, Floor] = {}
    slabs = []
    for group, slab in surroundings.slabs:
        if group not in surfaces:
            surfaces[group] = draw_floor(rng, images, share)
        slabs.append(dataclasses.replace(slab, surface=surfaces[group]))
    return tuple(slabs)
