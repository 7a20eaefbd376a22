"""A scene as plain data: which objects hang where, over which floor, lit and seen from where; drawn from one rng."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from objectflow.errors import DatasetError
from objectflow.geometry.camera import Camera
from objectflow.geometry.se3 import make_transform
from objectflow.synth.objects.model import ModelRef
from objectflow.synth.scenes.textures import TextureSpec
from objectflow.typing import Float64Array

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class SceneObject:
    """One object at the start of the simulation, at rest in the air."""

    category: str
    name: str
    scale: float
    """Times the model's own size."""
    density: float
    """Kilograms a cubic metre, of its collision parts."""
    position: Vector
    """Metres, of the object's origin in the world (z up, the floor at 0)."""
    quaternion: tuple[float, float, float, float]
    """(w, x, y, z) of `world_R_object`."""
    texture: TextureSpec
    specular: float
    shininess: float

    @property
    def ref(self) -> ModelRef:
        """The model's name in its library."""
        return ModelRef(self.category, self.name)

    @property
    def world_T_object(self) -> Float64Array:
        """(4, 4) pose at the start."""
        return make_transform(Rotation.from_quat(self.quaternion, scalar_first=True).as_matrix(), self.position)


@dataclass(frozen=True)
class Floor:
    """A square floor around the scene's centre."""

    texture: TextureSpec
    tile: float
    """Metres that one copy of the texture covers."""
    specular: float
    shininess: float
    height: float = 0.0
    """Metres, of the floor in the world; below 0 where objects lie on a table."""


@dataclass(frozen=True)
class Slab:
    """A box that never moves: a table's top, a wall, a side of a bin."""

    center: Vector
    """Metres, in the world."""
    turn: float
    """Radians about the world's z axis."""
    half: Vector
    """Half its sides, metres."""
    surface: Floor
    """How it looks; the height does not count."""


@dataclass(frozen=True)
class Light:
    """A lamp that shines to all sides and casts shadows; colours are RGB, 1 = as bright as the surface's own."""

    position: Vector
    diffuse: Vector
    specular: Vector
    ambient: Vector
    """Reaches everything, shadows too."""


@dataclass(frozen=True)
class View:
    """Where a camera stands: on a sphere around its target, which is near the scene's centre."""

    target: Vector
    distance: float
    """Metres."""
    azimuth: float
    elevation: float
    """Above the floor's plane, like all angles here in radians."""
    roll: float
    """About the viewing direction; at 0 the image's x axis is level."""

    @property
    def world_T_camera(self) -> Float64Array:
        """(4, 4), camera frame x right, y down, z forward."""
        ca, sa, ce, se = (f(x) for x in (self.azimuth, self.elevation) for f in (math.cos, math.sin))
        backward = np.array([ca * ce, sa * ce, se])
        # Written out instead of crossed with "up", so that it is defined straight above the target too.
        right = np.array([-sa, ca, 0.0])
        level = np.stack([right, np.cross(-backward, right), -backward], axis=1)
        world_R_camera = level @ Rotation.from_euler("z", self.roll).as_matrix()
        return make_transform(world_R_camera, np.asarray(self.target) + self.distance * backward)


@dataclass(frozen=True)
class Scene:
    """Everything physics and rendering need besides the models themselves."""

    objects: tuple[SceneObject, ...]
    """Object k, from 1, has label k."""
    floor: Floor
    lights: tuple[Light, ...]
    intrinsics: Camera
    """Of every view."""
    views: tuple[View, ...]
    slabs: tuple[Slab, ...] = ()
    """Furniture, walls and the like: background, as the floor is."""

    @property
    def camera(self) -> View:
        """The first view."""
        return self.views[0]

    def to_dict(self) -> dict[str, Any]:
        """JSON-able; `from_dict` gives the same scene back."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Scene:
        """The inverse of `to_dict`, also after a way through JSON.

        Raises:
            DatasetError: keys are missing or unknown.
        """
        try:
            return cls(
                objects=tuple(SceneObject(**_tuples(item)) for item in data["objects"]),
                floor=Floor(**_tuples(data["floor"])),
                lights=tuple(Light(**_tuples(item)) for item in data["lights"]),
                intrinsics=Camera(**data["intrinsics"]),
                views=tuple(View(**_tuples(item)) for item in data["views"]),
                slabs=tuple(Slab(**_tuples(item)) for item in data.get("slabs", ())),
            )
        except (KeyError, TypeError) as error:
            raise DatasetError(f"not a scene: {error}; was it written by another version?") from error


def _tuples(data: Mapping[str, Any]) -> dict[str, Any]:
    """JSON's lists as the tuples they were, and the texture as itself."""
    out: dict[str, Any] = {}
    for name, value in data.items():
        if name == "texture":
            colors = tuple(tuple(color) for color in value["colors"])
            out[name] = TextureSpec(**{**value, "colors": colors})
        elif name == "surface":
            out[name] = Floor(**_tuples(value))
        else:
            out[name] = tuple(value) if isinstance(value, list | tuple) else value
    return out
