"""What mujoco-warp's renderer reads of a scene, and no more.

Its own `put_model` and `make_data` copy all that a simulation needs, which takes a tenth of a scene's time.
"""

from __future__ import annotations

import dataclasses
from types import ModuleType
from typing import Any

import numpy as np

from objectflow.synth.rendering.placement import Placement

MARGIN = 1e-4
"""Metres around a mesh, so that rounding never takes a ray past what it would hit."""
_MESH = 7
"""`mjtGeom.mjGEOM_MESH`."""


class TracedModel:
    """Stands for `mujoco_warp.put_model(model)`: each array is copied when the renderer first asks for it."""

    def __init__(self, tracer: ModuleType, warp: ModuleType, model: Any) -> None:
        self._tracer, self._warp, self._model = tracer, warp, model
        self._types = {field.name: field.type for field in dataclasses.fields(tracer.Model)}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        # Python asks here only for what is not an attribute yet.
        self.__dict__[name] = found = self._read(name)
        return found

    def _read(self, name: str) -> Any:
        kind: Any = self._types.get(name)
        value = getattr(self._model, name, None)
        if isinstance(value, int):
            return value
        if isinstance(value, np.ndarray) and hasattr(kind, "dtype"):
            # Arrays that may differ from world to world have an axis for it; here one row serves all.
            every = value[None] if kind.shape[:1] == ("*",) else value
            return self._warp.array(every, dtype=kind.dtype, ndim=len(kind.shape))
        if name == "block_dim" and isinstance(kind, type):
            return kind()
        # Nothing that the present release reads; a later one may.
        return getattr(self._tracer.put_model(self._model), name)


@dataclasses.dataclass
class TracedData:
    """Stands for `mujoco_warp.make_data(model)`: where things are in each of the worlds."""

    nworld: int
    geom_xpos: Any
    geom_xmat: Any
    cam_xpos: Any
    cam_xmat: Any
    light_xpos: Any
    light_xdir: Any
    flexvert_xpos: Any

    @classmethod
    def of(cls, warp: ModuleType, placement: Placement) -> TracedData:
        """Put a placement on Warp's present device."""
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


def tighten(model: Any, placement: Placement, context: Any) -> None:
    """Shrink the boxes in which a ray looks for meshes to what the meshes fill.

    mujoco-warp takes the box of a box that is centred on the mesh's frame. Every ray that enters a box searches the
    mesh in it, so that smaller boxes spare searches; what is hit stays the same.
    """
    geoms = context.enabled_geom_ids.numpy()
    shape = (len(placement.geom_position), len(geoms), 3)
    lower, upper = (np.array(bound.numpy()).reshape(shape) for bound in (context.lower, context.upper))
    for place, geom in enumerate(geoms):
        mesh = int(model.geom_dataid[geom])
        if int(model.geom_type[geom]) != _MESH or mesh < 0:
            continue
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        turned = model.mesh_vert[first : first + count] @ placement.geom_rotation[:, geom].swapaxes(-1, -2)
        lower[:, place] = turned.min(axis=1) + placement.geom_position[:, geom] - MARGIN
        upper[:, place] = turned.max(axis=1) + placement.geom_position[:, geom] + MARGIN
    context.lower.assign(lower.reshape(-1, 3))
    context.upper.assign(upper.reshape(-1, 3))
    context.bvh.refit()
