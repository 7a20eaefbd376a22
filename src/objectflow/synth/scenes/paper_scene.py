"""Scenes of the paper (section IV-A): objects start in the air and fall onto a floor; drawn from one generator."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from objectflow.errors import DatasetError
from objectflow.geometry.camera import Camera
from objectflow.synth.objects.library import Library
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.scenes.appearance import draw_floor, draw_lights, draw_surface
from objectflow.synth.scenes.initial_layout import bounding_boxes, covered_radius, place_objects
from objectflow.synth.scenes.scene_data import Scene, SceneObject, View
from objectflow.synth.scenes.textures import list_images

Range = tuple[float, float]

_LOAD_TRIES = 30
"""Number of consecutive broken models after which the library is given up."""


@dataclass(frozen=True)
class SceneSettings:
    """Distributions that scenes are drawn from; the defaults are those of the paper and its code, where known."""

    objects: tuple[int, int] = (1, 30)
    """Minimum and maximum number of objects."""
    size: Range = (0.07, 0.3)
    """Longest side of an object, metres; other models are scaled to fit."""
    size_jitter: float = 1.25
    """Maximum factor by which an object is smaller or larger than its model."""
    drop_height: float = 0.2
    """Height of the lowest corner of the objects' boxes above the floor at the start, metres."""
    spread: float = 0.65
    """Radius of the disc in which objects start; 1 is a disc of the area that their boxes cover when laid side by
    side. A smaller disc gives higher piles and larger motions; 0.65 gives the paper's displacement (8.5 cm between
    frames 20 and 80)."""
    density: Range = (200.0, 900.0)
    """Density of objects, kg/m^3."""
    width: int = 320
    """Image width, pixels."""
    height: int = 240
    """Image height, pixels."""
    focal: Range = (236.46, 236.46)
    """Focal length at a width of 320, pixels (RealSense SR300); it is scaled with the width."""
    principal_shift: float = 0.0
    """Maximum offset of the principal point from the image centre at a width of 320, pixels."""
    distance: Range = (0.2, 0.8)
    """Distance from the camera to the scene's centre, metres."""
    elevation: Range = (20.0, 90.0)
    """Elevation of the camera above the floor, degrees."""
    roll: Range = (-1.0, 1.0)
    """Roll of the camera, degrees."""
    views: int = 8
    """Number of views drawn; a caller that needs fewer uses the first that no object blocks."""
    lights: tuple[int, int] = (1, 4)
    """Minimum and maximum number of lights; the renderer's kernel is compiled for at most 4."""
    images: Path | None = None
    """Folder of floor images; None for procedural textures only."""
    image_share: float = 0.5
    """Share of floors with an image, 0..1, where there is a folder."""


def draw_paper_scene(
    rng: np.random.Generator,
    library: Library,
    split: str,
    settings: SceneSettings,
    skip: Callable[[str], None] | None = None,
) -> tuple[Scene, tuple[ObjectModel, ...]]:
    """Draw a scene, and return it with the loaded models of its objects.

    Args:
        rng: the scene's only source of randomness.
        library: source of the objects.
        split: "train", "val" or "test".
        settings: distributions that the scene is drawn from.
        skip: receives one line per model that cannot be loaded and is replaced. None: such a model raises.

    Raises:
        DatasetError: an unknown split, invalid settings, or a library whose models cannot be loaded.
    """
    check_scene_settings(settings)
    count = int(rng.integers(settings.objects[0], settings.objects[1] + 1))
    models = tuple(load_random_model(rng, library, split, skip) for _ in range(count))
    scales = [draw_scale(rng, model, settings) for model in models]
    # Four normally distributed coordinates are isotropic, and so give uniformly distributed rotations.
    rotations = Rotation.from_quat(rng.normal(size=(count, 4)))
    boxes = bounding_boxes(models, scales)
    radius = settings.spread * covered_radius(boxes[1])
    origins = place_objects(rng, rotations.as_matrix(), boxes, settings.drop_height, radius, tries=4)
    objects = []
    for model, scale, quaternion, origin in zip(
        models, scales, rotations.as_quat(scalar_first=True), origins, strict=True
    ):
        w, qx, qy, qz = map(float, quaternion)
        x, y, z = map(float, origin)
        texture, specular, shininess = draw_surface(rng, model.texture is not None)
        objects.append(
            SceneObject(
                category=model.category,
                name=model.name,
                scale=scale,
                density=float(rng.uniform(*settings.density)),
                position=(x, y, z),
                quaternion=(w, qx, qy, qz),
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
    """Check that scenes can be drawn from settings.

    Raises:
        DatasetError: a range is empty or a value is out of bounds.
    """
    for name in ("objects", "size", "density", "focal", "distance", "lights"):
        low, high = getattr(settings, name)
        if not 0 < low <= high:
            raise DatasetError(f"scene settings: {name} must be a range above 0, from low to high, not {low} {high}")
    if not 0 <= settings.elevation[0] <= settings.elevation[1] <= 90:
        raise DatasetError(f"scene settings: elevation must be within 0 and 90 degrees, not {settings.elevation}")
    if settings.lights[1] > 4 or settings.views < 1 or settings.size_jitter < 1:
        raise DatasetError("scene settings: at most 4 lights, at least 1 view, a size jitter of at least 1")


def load_random_model(
    rng: np.random.Generator, library: Library, split: str, skip: Callable[[str], None] | None
) -> ObjectModel:
    """Load a random model of a split; `skip` receives a line for each one that cannot be loaded.

    Raises:
        DatasetError: an unknown split, or too many consecutive broken models.
    """
    refs = library.refs(split)
    if not refs:
        raise DatasetError(f"the library has no models in split {split}: choose another split, or add meshes")
    for _ in range(_LOAD_TRIES):
        try:
            return library.load(refs[int(rng.integers(len(refs)))])
        except DatasetError as error:
            if skip is None:
                raise
            skip(str(error))
    raise DatasetError(f"{_LOAD_TRIES} models in a row cannot be loaded: see the notes above for their names")


def draw_scale(rng: np.random.Generator, model: ObjectModel, settings: SceneSettings) -> float:
    """Draw the factor on a model's own size; the resulting size is clipped to the settings' range."""
    longest = float(np.ptp(model.vertices, axis=0).max())
    jitter = math.log(settings.size_jitter)
    wanted = longest * math.exp(rng.uniform(-jitter, jitter))
    return float(np.clip(wanted, *settings.size)) / longest


def draw_intrinsics(rng: np.random.Generator, settings: SceneSettings) -> Camera:
    """Draw the intrinsics of a camera with the settings' image size."""
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
    # The target is jittered: real images are not centred on a pile either.
    x, y = map(float, rng.uniform(-0.04, 0.04, 2))
    low, high = (math.sin(math.radians(angle)) for angle in settings.elevation)
    return View(
        target=(x, y, 0.03),
        distance=float(rng.uniform(*settings.distance)),
        azimuth=float(rng.uniform(0, 2 * math.pi)),
        elevation=math.asin(rng.uniform(low, high)),
        roll=math.radians(rng.uniform(*settings.roll)),
    )
