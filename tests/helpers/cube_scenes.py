"""A floor, a camera, lamps and cubes, for the renderer; needs MuJoCo."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from objectflow.typing import Float64Array, UInt8Array

mujoco = pytest.importorskip("mujoco", reason="rendering needs the extra [synth]")

WIDTH, HEIGHT = 96, 72
AMBIENT, DIFFUSE = 0.25, 0.5


def look_at(eye: tuple[float, float, float], target: tuple[float, float, float]) -> Float64Array:
    """world_T_camera, x right, y down, z forward."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, (0, 0, 1) if abs(forward[2]) < 0.999 else (0, 1, 0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose


def empty_scene(light: tuple[float, float, float] = (0.3, -0.4, 1.5)) -> Any:
    """A floor, a camera with an off-centre principal point, and four lights, two of them off."""
    spec = mujoco.MjSpec()
    spec.visual.headlight.active = False
    world = spec.worldbody
    world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], rgba=[1, 1, 1, 1])
    world.add_camera(
        name="camera",
        resolution=[WIDTH, HEIGHT],
        focal_pixel=[71, 70],
        sensor_size=[WIDTH * 1e-4, HEIGHT * 1e-4],
        principal_pixel=[3, -2],
    )
    for number in range(4):
        world.add_light(
            name=f"light_{number}",
            type=mujoco.mjtLightType.mjLIGHT_POINT,
            pos=light,
            dir=[0, 0, -1],
            active=number < 2,
            castshadow=True,
            attenuation=[1, 0, 0],
            ambient=[AMBIENT / 2] * 3,
            diffuse=[DIFFUSE / 2] * 3,
            specular=[0, 0, 0],
        )
    return spec


def add_object(
    spec: Any, number: int, vertices: NDArray[Any], faces: NDArray[Any], uv: NDArray[Any], texture: UInt8Array
) -> None:
    """Add a textured object with a hull in group 3 that is twice its size and must not be visible."""
    name = f"{number}"
    spec.add_mesh(
        name=f"seen_{name}",
        uservert=vertices.astype(np.float32).ravel(),
        userface=faces.astype(np.int32).ravel(),
        usertexcoord=uv.astype(np.float32).ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.add_mesh(name=f"hull_{name}", uservert=(2 * vertices).astype(np.float32).ravel())
    image = spec.add_texture(
        name=f"image_{name}",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=texture.shape[1],
        height=texture.shape[0],
        nchannel=3,
    )
    image.data = texture.tobytes()
    material = spec.add_material(name=f"material_{name}", specular=0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = f"image_{name}"
    body = spec.worldbody.add_body(name=f"obj_{number}")
    body.add_freejoint()
    mesh = mujoco.mjtGeom.mjGEOM_MESH
    body.add_geom(type=mesh, meshname=f"seen_{name}", material=f"material_{name}", group=0)
    body.add_geom(type=mesh, meshname=f"hull_{name}", group=3)


CUBE = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
CUBE_FACES = np.array(
    [
        *[(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)],
        *[(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)],
    ]
)
GREY = np.full((4, 4, 3), 128, dtype=np.uint8)


def cube_scene(half: float, light: tuple[float, float, float] = (0.3, -0.4, 1.5)) -> Any:
    spec = empty_scene(light)
    add_object(spec, 1, CUBE * half, CUBE_FACES, np.zeros((8, 2)), GREY)
    return spec.compile()


def poses(*positions: tuple[float, float, float]) -> Float64Array:
    """(1, N, 4, 4) without rotation."""
    result = np.tile(np.eye(4), (1, len(positions), 1, 1))
    result[0, :, :3, 3] = positions
    return result
