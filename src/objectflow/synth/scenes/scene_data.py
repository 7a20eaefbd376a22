"""A scene as plain data: objects and their start poses, floor, furniture, lights and cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from objectflow.geometry.camera import Camera
from objectflow.geometry.se3 import make_transform
from objectflow.synth.scenes.textures import TextureSpec
from objectflow.typing import Float64Array

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class SceneObject:
    """One object at the start of the simulation, at rest in the air."""

    category: str
    name: str
    """Name of the model in its library."""
    scale: float
    """Factor on the model's own size."""
    density: float
    """Density of the collision parts, kg/m^3."""
    position: Vector
    """Position of the object's origin in the world, metres (z up, support at height 0)."""
    quaternion: tuple[float, float, float, float]
    """(w, x, y, z) of `world_R_object`."""
    texture: TextureSpec
    specular: float
    """Specular coefficient, 0..1."""
    shininess: float
    """Shininess, 0..1."""

    @property
    def world_T_object(self) -> Float64Array:
        """(4, 4) start pose."""
        return make_transform(Rotation.from_quat(self.quaternion, scalar_first=True).as_matrix(), self.position)


@dataclass(frozen=True)
class Floor:
    """A square floor around the scene's centre; also the surface of a slab."""

    texture: TextureSpec
    tile: float
    """Side length of one repetition of the texture, metres."""
    specular: float
    """Specular coefficient, 0..1."""
    shininess: float
    """Shininess, 0..1."""
    height: float = 0.0
    """Height of the floor in the world, metres; below 0 where the objects lie on a table."""
    pixels: int = 512
    """Side length of the texture, pixels: about one per image pixel, because the renderer has no mip maps."""
    half: float = 2.0
    """Half the side length of the visible floor, metres; it keeps depth finite. For collisions it is infinite. A slab
    has its own size."""


@dataclass(frozen=True)
class Slab:
    """A fixed box: a table top, a wall, a side of a bin."""

    center: Vector
    """Metres, in the world."""
    yaw: float
    """Rotation about the world's z axis, radians."""
    half: Vector
    """Half its side lengths, metres."""
    surface: Floor
    """Its appearance; the height is not used."""


@dataclass(frozen=True)
class Light:
    """An omnidirectional light that casts shadows; colours are RGB, and 1 reproduces the surface's own colour."""

    position: Vector
    """Metres, in the world."""
    diffuse: Vector
    specular: Vector
    ambient: Vector
    """Light on every surface, including shadows."""


@dataclass(frozen=True)
class View:
    """A camera pose: a point on a sphere around the target, which is near the scene's centre. Angles in radians."""

    target: Vector
    """Metres, in the world."""
    distance: float
    """From the target, metres."""
    azimuth: float
    elevation: float
    """Above the horizontal plane."""
    roll: float
    """About the viewing direction; at 0 the image's x axis is horizontal."""

    @property
    def world_T_camera(self) -> Float64Array:
        """(4, 4), camera frame x right, y down, z forward."""
        ca, sa, ce, se = (f(x) for x in (self.azimuth, self.elevation) for f in (math.cos, math.sin))
        backward = np.array([ca * ce, sa * ce, se])
        # This form, unlike a cross product with the vertical, is also defined for a camera straight above the target.
        right = np.array([-sa, ca, 0.0])
        level = np.stack([right, np.cross(-backward, right), -backward], axis=1)
        world_R_camera = level @ Rotation.from_euler("z", self.roll).as_matrix()
        return make_transform(world_R_camera, np.asarray(self.target) + self.distance * backward)


@dataclass(frozen=True)
class Scene:
    """All that physics and rendering need besides the object models."""

    objects: tuple[SceneObject, ...]
    """Object k, from 1, has label k."""
    floor: Floor
    lights: tuple[Light, ...]
    intrinsics: Camera
    """Of every view."""
    views: tuple[View, ...]
    slabs: tuple[Slab, ...] = ()
    """Furniture and walls, which are background like the floor."""
