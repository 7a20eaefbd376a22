"""The part of a scene that mujoco-warp's renderer reads, on Warp's device.

mujoco-warp's `put_model` and `make_data` also copy what a simulation needs, which takes a tenth of a scene's time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np

from objectflow.synth.rendering.placement import Placement
from objectflow.typing import Float32Array

MARGIN = 1e-4
"""Margin of the bounding boxes, metres; protects against rounding errors."""
_MESH = 7
"""`mjtGeom.mjGEOM_MESH`."""


class WarpModel:
    """Replaces `mujoco_warp.put_model(model)`: each array is copied when the renderer first reads it."""

    def __init__(
        self, tracer: ModuleType, warp: ModuleType, model: Any, light_colors: Mapping[str, Float32Array] | None = None
    ) -> None:
        """`light_colors` replaces arrays of the model by values for each image; see `Placement`."""
        self._tracer, self._warp, self._model = tracer, warp, model
        self._light_colors = light_colors or {}
        self._types = {field.name: field.type for field in dataclasses.fields(tracer.Model)}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        # Python calls this only for missing attributes, so that each is copied once.
        self.__dict__[name] = value = self._read(name)
        return value

    def _read(self, name: str) -> Any:
        kind: Any = self._types.get(name)
        if name in self._light_colors:
            return self._warp.array(self._light_colors[name], dtype=self._warp.vec3)
        value = getattr(self._model, name, None)
        if isinstance(value, int):
            return value
        if isinstance(value, np.ndarray) and hasattr(kind, "dtype"):
            # Arrays that may differ between worlds have a leading axis; here one row holds for all worlds.
            shared = value[None] if kind.shape[:1] == ("*",) else value
            return self._warp.array(shared, dtype=kind.dtype, ndim=len(kind.shape))
        if name == "block_dim" and isinstance(kind, type):
            return kind()
        # The current release reads nothing else; a later one might.
        return getattr(self._tracer.put_model(self._model), name)


@dataclasses.dataclass
class WarpData:
    """Replaces `mujoco_warp.make_data(model)`: world poses for each image."""

    nworld: int
    geom_xpos: Any
    geom_xmat: Any
    cam_xpos: Any
    cam_xmat: Any
    light_xpos: Any
    light_xdir: Any
    flexvert_xpos: Any

    @classmethod
    def of(cls, warp: ModuleType, placement: Placement) -> WarpData:
        """Copy a placement to Warp's current device."""
        worlds = len(placement.camera_position)
        return cls(
            nworld=worlds,
            geom_xpos=warp.array(placement.geom_position, dtype=warp.vec3),
            geom_xmat=warp.array(placement.geom_rotation, dtype=warp.mat33),
            cam_xpos=warp.array(placement.camera_position, dtype=warp.vec3),
            cam_xmat=warp.array(placement.camera_rotation, dtype=warp.mat33),
            light_xpos=warp.array(placement.light_position, dtype=warp.vec3),
            light_xdir=warp.array(placement.light_direction, dtype=warp.vec3),
            flexvert_xpos=warp.zeros((worlds, 0), dtype=warp.vec3),
        )


def tighten_bounds(model: Any, placement: Placement, context: Any) -> None:
    """Shrink the bounding boxes of meshes in the renderer's hierarchy to the meshes' extent.

    mujoco-warp bounds a box that is centred on the mesh's frame. Every ray that enters a bounding box is intersected
    with its mesh, so that tighter boxes save time; the images stay the same.
    """
    geoms = context.enabled_geom_ids.numpy()
    shape = (len(placement.geom_position), len(geoms), 3)
    lower, upper = (np.array(bound.numpy()).reshape(shape) for bound in (context.lower, context.upper))
    for place, geom in enumerate(geoms):
        mesh = int(model.geom_dataid[geom])
        if int(model.geom_type[geom]) != _MESH or mesh < 0:
            continue
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        rotated = model.mesh_vert[first : first + count] @ placement.geom_rotation[:, geom].swapaxes(-1, -2)
        lower[:, place] = rotated.min(axis=1) + placement.geom_position[:, geom] - MARGIN
        upper[:, place] = rotated.max(axis=1) + placement.geom_position[:, geom] + MARGIN
    context.lower.assign(lower.reshape(-1, 3))
    context.upper.assign(upper.reshape(-1, 3))
    context.bvh.refit()
