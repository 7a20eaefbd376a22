"""World poses of the geoms, cameras and lights of a MuJoCo scene, for given object poses."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from objectflow.typing import Float32Array, Int64Array

_OPENCV_R_MUJOCO = np.diag([1.0, -1.0, -1.0])
"""MuJoCo cameras look along -z, with y up."""


@dataclass(frozen=True, eq=False)
class Placement:
    """World poses for B = frames x cameras images, cameras varying fastest. World frame, metres, float32."""

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

    @classmethod
    def of(
        cls,
        model: Any,
        numbers: Int64Array,
        world_T_objects: NDArray[np.floating],
        world_T_cameras: NDArray[np.floating],
    ) -> Placement:
        """Compute the world poses of a model.

        Args:
            model: `mujoco.MjModel`; geoms without an object are fixed in the world.
            numbers: (G,) object number of each geom, from 1; 0 = none.
            world_T_objects: (F, N, 4, 4).
            world_T_cameras: (C, 4, 4), x right, y down, z forward.
        """
        frames, cameras = len(world_T_objects), len(world_T_cameras)
        # The identity comes first, as the pose of the world (number 0).
        world = np.broadcast_to(np.eye(4), (frames, 1, 4, 4))
        world_T_body = np.concatenate([world, world_T_objects], axis=1)[:, numbers]
        body_R_geom = Rotation.from_quat(model.geom_quat, scalar_first=True).as_matrix()
        rotation = world_T_body[..., :3, :3] @ body_R_geom
        position = (world_T_body[..., :3, :3] @ model.geom_pos[:, :, None])[..., 0] + world_T_body[..., :3, 3]
        worlds = frames * cameras
        return cls(
            geom_position=_float(np.repeat(position, cameras, axis=0)),
            geom_rotation=_float(np.repeat(rotation, cameras, axis=0)),
            camera_position=_tile(world_T_cameras[:, None, :3, 3], frames, int(model.ncam)),
            camera_rotation=_tile((world_T_cameras[:, :3, :3] @ _OPENCV_R_MUJOCO)[:, None], frames, int(model.ncam)),
            light_position=_tile(model.light_pos[None], worlds, 1),
            light_direction=_tile(model.light_dir[None], worlds, 1),
        )


def object_numbers(model: Any) -> Int64Array:
    """(G,) object number of each geom of a `mujoco.MjModel`: k for the body obj_k, 0 = none."""
    bodies = [re.fullmatch(r"obj_(\d+)", model.body(body).name) for body in range(model.nbody)]
    of_body = np.array([int(match[1]) if match else 0 for match in bodies], dtype=np.int64)
    return np.asarray(of_body[model.geom_bodyid], dtype=np.int64)


def _tile(values: NDArray[np.floating], times: int, along: int) -> Float32Array:
    """Repeat an array along its first axis, and along its second axis for every camera of the model."""
    tiled = np.tile(values, (times, along, *(1,) * (values.ndim - 2)))
    return _float(tiled)


def _float(values: NDArray[np.floating]) -> Float32Array:
    return np.ascontiguousarray(values, dtype=np.float32)
