"""Simple object models and scenes for tests of the generator."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from objectflow.geometry.camera import Camera
from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics.mjcf import box_mesh
from objectflow.synth.scenes.scene_data import Floor, Light, Scene, SceneObject, View
from objectflow.synth.scenes.textures import TextureSpec

DENSITY = 500.0
CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
FACES = np.array(
    [
        *[(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)],
        *[(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)],
    ],
    dtype=np.int32,
)


def box_model(*half: float) -> ObjectModel:
    vertices = CORNERS * half
    return ObjectModel("box", "box", vertices, FACES, CORNERS[:, :2] / 2 + 0.5, (vertices,), ())


def ball_model(radius: float) -> ObjectModel:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    return dataclasses.replace(box_model(radius, radius, radius), parts=(points,))


def place(
    model: ObjectModel, position: tuple[float, float, float], rotation: Rotation | None = None, scale: float = 1.0
) -> SceneObject:
    w, x, y, z = map(float, (rotation or Rotation.identity()).as_quat(scalar_first=True))
    return SceneObject(
        model.category, model.name, scale, DENSITY, position, (w, x, y, z), TextureSpec("plain"), 0.1, 0.2
    )


def scene_of(*objects: SceneObject) -> Scene:
    return Scene(
        objects=objects,
        floor=Floor(TextureSpec("checker"), 0.5, 0.1, 0.2),
        lights=(Light((0, 0, 2), (0.5, 0.5, 0.5), (0.1, 0.1, 0.1), (0.2, 0.2, 0.2)),),
        intrinsics=Camera(width=320, height=240, fx=230, fy=231, cx=150, cy=125),
        views=(View((0, 0, 0), 0.5, 0.0, 1.0, 0.0),),
    )


def plate_model(symmetry: tuple[SymmetryAxis, ...] = (), name: str = "box-1") -> ObjectModel:
    """A square plate of 20 x 20 x 2 cm."""
    vertices, faces, uv = box_mesh((0.1, 0.1, 0.01))
    return ObjectModel("box", name, vertices, faces, uv, (vertices,), symmetry)
