"""World poses of the geoms, cameras and lights of a MuJoCo scene, for given object poses."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from objectflow.synth.scenes.scene_data import Light
from objectflow.typing import Float32Array, Int64Array

_OPENCV_R_MUJOCO = np.diag([1.0, -1.0, -1.0])
"""MuJoCo cameras look along -z, with y up."""
_LIGHT_COLORS = ("light_diffuse", "light_specular", "light_ambient")
"""Arrays of a `mujoco.MjModel` that hold the lamps' colours."""


@dataclass(frozen=True, eq=False)
class Placement:
    """World poses for B images. World frame, metres, float32."""

    geom_position: Float32Array
    """(B, G, 3)."""
    geom_rotation: Float32Array
    """(B, G, 3, 3)."""
    camera_position: Float32Array
    """(B, cameras of the model, 3)."""
    camera_rotation: Float32Array
    """(B, cameras of the model, 3, 3): columns are x right, y up, z backward."""
    light_position: Float32Array
    """(B, L, 3)."""
    light_direction: Float32Array
    """(B, L, 3)."""
    light_colors: Mapping[str, Float32Array] = field(default_factory=dict)
    """Names of the model's arrays, such as `light_diffuse`, and their values (B, L, 3) in the images. Arrays that are
    not named have the model's values in all images."""

    @classmethod
    def of(
        cls,
        model: Any,
        numbers: Int64Array,
        world_T_objects: NDArray[np.floating],
        world_T_cameras: NDArray[np.floating],
    ) -> Placement:
        """Compute the world poses of a model for F x C images, cameras varying fastest.

        Args:
            model: `mujoco.MjModel`; geoms without an object are fixed in the world.
            numbers: (G,) object number of each geom, from 1; 0 = none.
            world_T_objects: (F, N, 4, 4).
            world_T_cameras: (C, 4, 4), x right, y down, z forward.
        """
        frames, cameras = len(world_T_objects), len(world_T_cameras)
        return cls.each(
            model, numbers, np.repeat(world_T_objects, cameras, axis=0), np.tile(world_T_cameras, (frames, 1, 1))
        )

    @classmethod
    def each(
        cls,
        model: Any,
        numbers: Int64Array,
        world_T_objects: NDArray[np.floating],
        world_T_cameras: NDArray[np.floating],
        lights: Sequence[Sequence[Light]] | None = None,
    ) -> Placement:
        """Compute the world poses of a model for B images, each with its own camera and light.

        Args:
            model, numbers: see `of`.
            world_T_objects: (B, N, 4, 4).
            world_T_cameras: (B, 4, 4), x right, y down, z forward.
            lights: the lamps of each image, as many as the model was built with; None for the model's own.
        """
        images = len(world_T_objects)
        # The identity comes first, as the pose of the world (number 0).
        world = np.broadcast_to(np.eye(4), (images, 1, 4, 4))
        world_T_body = np.concatenate([world, world_T_objects], axis=1)[:, numbers]
        body_R_geom = Rotation.from_quat(model.geom_quat, scalar_first=True).as_matrix()
        rotation = world_T_body[..., :3, :3] @ body_R_geom
        position = (world_T_body[..., :3, :3] @ model.geom_pos[:, :, None])[..., 0] + world_T_body[..., :3, 3]
        lamps = {name: np.tile(getattr(model, name), (images, 1, 1)) for name in ("light_pos", *_LIGHT_COLORS)}
        for image, in_image in enumerate(lights or ()):
            for number, light in enumerate(in_image):
                lamps["light_pos"][image, number] = light.position
                for name in _LIGHT_COLORS:
                    lamps[name][image, number] = getattr(light, name.removeprefix("light_"))
        return cls(
            geom_position=_float(position),
            geom_rotation=_float(rotation),
            camera_position=_tile(world_T_cameras[:, None, :3, 3], int(model.ncam)),
            camera_rotation=_tile((world_T_cameras[:, :3, :3] @ _OPENCV_R_MUJOCO)[:, None], int(model.ncam)),
            light_position=_float(lamps["light_pos"]),
            light_direction=_float(np.tile(model.light_dir, (images, 1, 1))),
            light_colors={} if lights is None else {name: _float(lamps[name]) for name in _LIGHT_COLORS},
        )


def object_numbers(model: Any) -> Int64Array:
    """(G,) object number of each geom of a `mujoco.MjModel`: k for the body obj_k, 0 = none."""
    bodies = [re.fullmatch(r"obj_(\d+)", model.body(body).name) for body in range(model.nbody)]
    of_body = np.array([int(match[1]) if match else 0 for match in bodies], dtype=np.int64)
    return np.asarray(of_body[model.geom_bodyid], dtype=np.int64)


def _tile(values: NDArray[np.floating], times: int) -> Float32Array:
    """Repeat an array along its second axis, for every camera of the model."""
    return _float(np.tile(values, (1, times, *(1,) * (values.ndim - 2))))


def _float(values: NDArray[np.floating]) -> Float32Array:
    return np.ascontiguousarray(values, dtype=np.float32)
