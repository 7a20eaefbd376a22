"""Drawing a scene: objects, their start in the air, floor, lights and views, all from one rng (section IV-A)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from objectflow.errors import DatasetError
from objectflow.geometry.camera import Camera
from objectflow.synth.objects.library import Library
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.scenes.appearance import draw_floor, draw_lights, draw_surface
from objectflow.synth.scenes.initial_layout import hang
from objectflow.synth.scenes.scene_data import Floor, Light, Scene, SceneObject, View
from objectflow.synth.scenes.textures import list_images
from objectflow.typing import Float64Array

__all__ = ["Floor", "Light", "Scene", "SceneObject", "SceneSettings", "View", "draw_scene", "draw_scene_and_models"]

Range = tuple[float, float]

_TRIES_TO_LOAD = 30
"""Models drawn in a row that may be broken before the library is given up."""


@dataclass(frozen=True)
class SceneSettings:
    """What scenes are drawn from; the defaults are the paper's, where it or its code says."""

    objects: tuple[int, int] = (1, 30)
    """Objects a scene, from and to."""
    size: Range = (0.07, 0.3)
    """Longest side of an object in metres; models outside are scaled to fit."""
    size_jitter: float = 1.25
    """Objects are up to this factor smaller or larger than their model."""
    drop_height: float = 0.2
    """Metres between the floor and the lowest corner of the objects' boxes, at the start."""
    spread: float = 0.65
    """How far apart objects start: 1 = a disc of the area that their boxes cover when laid side by side. Less piles
    them up, and they move further; this value gives the paper's displacement (8.5 cm between frames 20 and 80)."""
    density: Range = (200.0, 900.0)
    """Kilograms a cubic metre."""
    width: int = 320
    """Pixels."""
    height: int = 240
    """Pixels."""
    focal: Range = (236.46, 236.46)
    """Focal length in pixels at a width of 320 (RealSense SR300); it grows with the width."""
    principal_shift: float = 0.0
    """Up to this many pixels, at a width of 320, between the principal point and the image's middle."""
    distance: Range = (0.2, 0.8)
    """Metres from the camera to the scene's centre."""
    elevation: Range = (20.0, 90.0)
    """Degrees above the floor."""
    roll: Range = (-1.0, 1.0)
    """Degrees."""
    views: int = 8
    """Views drawn; a caller that needs fewer takes those that no object blocks."""
    lights: tuple[int, int] = (1, 4)
    """Lights, from and to; the renderer's kernel is made for at most 4."""
    images: Path | None = None
    """Folder of pictures for floors; procedural textures alone without one."""
    image_share: float = 0.5
    """Share of the floors that are pictures, where there is a folder."""


def draw_scene(rng: np.random.Generator, library: Library, split: str, settings: SceneSettings) -> Scene:
    """Draw a scene; see `draw_scene_and_models`."""
    return draw_scene_and_models(rng, library, split, settings)[0]


def draw_scene_and_models(
    rng: np.random.Generator,
    library: Library,
    split: str,
    settings: SceneSettings,
    skip: Callable[[str], None] | None = None,
) -> tuple[Scene, tuple[ObjectModel, ...]]:
    """Draw a scene, and hand over the models that were loaded on the way.

    Args:
        rng: the scene's only source of chance.
        library: where objects come from.
        split: "train", "val" or "test".
        settings: see there.
        skip: told, in one line, of a model that cannot be loaded, which is then replaced. None: it ends the drawing.

    Raises:
        DatasetError: an unknown split, settings that cannot be, or a library whose models cannot be loaded.
    """
    check_scene_settings(settings)
    count = int(rng.integers(settings.objects[0], settings.objects[1] + 1))
    models = tuple(load_any(rng, library, split, skip) for _ in range(count))
    scales = [draw_scale(rng, model, settings) for model in models]
    # Normal coordinates in four dimensions have no direction that they prefer, so neither have the rotations.
    rotations = Rotation.from_quat(rng.normal(size=(count, 4)))
    centers = _draw_start(rng, models, scales, rotations.as_matrix(), settings)
    objects = []
    for model, scale, quaternion, position in zip(
        models, scales, rotations.as_quat(scalar_first=True), centers, strict=True
    ):
        w, x, y, z = map(float, quaternion)
        texture, specular, shininess = draw_surface(rng, model.texture is not None)
        objects.append(
            SceneObject(
                category=model.category,
                name=model.name,
                scale=scale,
                density=float(rng.uniform(*settings.density)),
                position=_floats(position),
                quaternion=(w, x, y, z),
                texture=texture,
                specular=specular,
                shininess=shininess,
            )
        )
    images = list_images(settings.images) if settings.images is not None else []
    scene = Scene(
        objects=tuple(objects),
        floor=draw_floor(rng, images, settings.image_share),
        lights=draw_lights(rng, settings.lights),
        intrinsics=draw_intrinsics(rng, settings),
        views=tuple(_draw_view(rng, settings) for _ in range(settings.views)),
    )
    return scene, models


def check_scene_settings(settings: SceneSettings) -> None:
    """Refuse settings that no scene can have.

    Raises:
        DatasetError: a range that runs backwards, or values without sense.
    """
    for name in ("objects", "size", "density", "focal", "distance", "lights"):
        low, high = getattr(settings, name)
        if not 0 < low <= high:
            raise DatasetError(f"scene settings: {name} must be a range above 0, from low to high, not {low} {high}")
    if not 0 <= settings.elevation[0] <= settings.elevation[1] <= 90:
        raise DatasetError(f"scene settings: elevation must lie within 0 and 90 degrees, not {settings.elevation}")
    if settings.lights[1] > 4 or settings.views < 1 or settings.size_jitter < 1:
        raise DatasetError("scene settings: at most 4 lights, at least 1 view, a size jitter of at least 1")


def load_any(
    rng: np.random.Generator, library: Library, split: str, skip: Callable[[str], None] | None
) -> ObjectModel:
    """Any model of a split that can be loaded; `skip` is told of those that cannot.

    Raises:
        DatasetError: an unknown split, or too many broken models in a row.
    """
    refs = library.refs(split)
    if not refs:
        raise DatasetError(f"the library has no models in split {split}: choose another split, or add meshes")
    for _ in range(_TRIES_TO_LOAD):
        try:
            return library.load(refs[int(rng.integers(len(refs)))])
        except DatasetError as error:
            if skip is None:
                raise
            skip(str(error))
    raise DatasetError(f"{_TRIES_TO_LOAD} models in a row cannot be loaded: see the notes above for their names")


def draw_scale(rng: np.random.Generator, model: ObjectModel, settings: SceneSettings) -> float:
    """Times the model's own size, which the settings limit."""
    longest = float(np.ptp(model.vertices, axis=0).max())
    jitter = math.log(settings.size_jitter)
    wanted = longest * math.exp(rng.uniform(-jitter, jitter))
    return float(np.clip(wanted, *settings.size)) / longest


def _draw_start(
    rng: np.random.Generator,
    models: Sequence[ObjectModel],
    scales: Sequence[float],
    rotations: Float64Array,
    settings: SceneSettings,
) -> Float64Array:
    """(N, 3) positions of the objects' origins."""
    low = np.stack([model.vertices.min(axis=0) * scale for model, scale in zip(models, scales, strict=True)])
    high = np.stack([model.vertices.max(axis=0) * scale for model, scale in zip(models, scales, strict=True)])
    half = (high - low) / 2
    sides = np.sort(2 * half, axis=1)
    radius = settings.spread * math.sqrt(float((sides[:, 1] * sides[:, 2]).sum()) / math.pi)
    boxes = hang(rng, rotations, half, settings.drop_height, radius, tries=4)
    return np.asarray(boxes - np.einsum("nij,nj->ni", rotations, (high + low) / 2))


def draw_intrinsics(rng: np.random.Generator, settings: SceneSettings) -> Camera:
    """A camera of the settings' size."""
    unit = settings.width / 320
    focal = float(rng.uniform(*settings.focal)) * unit
    shift = rng.uniform(-1, 1, 2) * settings.principal_shift * unit
    return Camera(
        width=settings.width,
        height=settings.height,
        fx=focal,
        fy=focal,
        cx=(settings.width - 1) / 2 + float(shift[0]),
        cy=(settings.height - 1) / 2 + float(shift[1]),
    )


def _draw_view(rng: np.random.Generator, settings: SceneSettings) -> View:
    # Not always dead centre: nothing says that a pile lies in the middle of the image.
    x, y = map(float, rng.uniform(-0.04, 0.04, 2))
    low, high = (math.sin(math.radians(angle)) for angle in settings.elevation)
    return View(
        target=(x, y, 0.03),
        distance=float(rng.uniform(*settings.distance)),
        azimuth=float(rng.uniform(0, 2 * math.pi)),
        elevation=math.asin(rng.uniform(low, high)),
        roll=math.radians(rng.uniform(*settings.roll)),
    )


def _floats(values: Float64Array) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
