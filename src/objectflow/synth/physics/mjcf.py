"""The MuJoCo model of a scene: free bodies with convex hulls that collide and meshes that are seen."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from objectflow.errors import DatasetError, MissingExtraError
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics.recording import FRAME, FRICTION, GRAVITY, SUBSTEPS
from objectflow.synth.scenes.scene_data import Scene, SceneObject, Slab
from objectflow.synth.scenes.textures import TextureSpec, draw_texture
from objectflow.typing import Float32Array, Float64Array, LabelImage, UInt8Array

FLOOR_HALF = 2.0
"""Metres; what is seen of the floor ends there, so that depth stays finite. Nothing falls off: it collides further."""
LIGHTS = 4
"""Always as many, some of them dark: their number is compiled into the renderer's kernel."""
VISIBLE_GROUP, SOLID_GROUP = 0, 3
TEXTURE_SIZE, FLOOR_TEXTURE_SIZE = 128, 512
"""Pixels a side: about one to a pixel of the image, for the renderer has no mip maps."""


def import_mujoco() -> Any:
    """The `mujoco` module.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import mujoco
    except ImportError as error:
        raise MissingExtraError('simulation needs MuJoCo: pip install "objectflow[synth]"') from error
    return mujoco


def build_model(scene: Scene, models: Sequence[ObjectModel], *, solid: bool = True, visible: bool = True) -> Any:
    """Compile a scene.

    Args:
        scene: what to build.
        models: its objects' models, in order.
        solid: with collision hulls (group 3), which carry the mass.
        visible: with surfaces (group 0), textures, lights, and a camera named `camera` with the scene's intrinsics.

    Returns:
        A `mujoco.MjModel` with one free body an object, named obj_1..obj_N, whose frames are the object frames.

    Raises:
        MissingExtraError: MuJoCo is not installed.
        DatasetError: a texture's picture cannot be read, or a model's mesh or collision part is no solid.
    """
    mujoco = import_mujoco()
    spec = mujoco.MjSpec()
    spec.option.timestep = FRAME / SUBSTEPS
    spec.option.gravity = [0, 0, -GRAVITY]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    spec.visual.headlight.active = 0
    if visible:
        _add_surroundings(mujoco, spec, scene)
    floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[FLOOR_HALF, FLOOR_HALF, 0.1])
    _make_solid(floor)
    floor.group = VISIBLE_GROUP
    floor.pos = [0, 0, scene.floor.height]
    if visible:
        floor.material = "floor"
    for number, slab in enumerate(scene.slabs, 1):
        _add_slab(mujoco, spec, number, slab, solid=solid, visible=visible)
    for number, (item, model) in enumerate(zip(scene.objects, models, strict=True), 1):
        body = spec.worldbody.add_body(name=f"obj_{number}", pos=item.position, quat=item.quaternion)
        body.add_freejoint()
        if solid:
            _add_hulls(mujoco, spec, body, number, item, model)
        else:
            # A body that moves needs a mass, though nothing is simulated with this one.
            body.mass, body.inertia, body.explicitinertial = 1.0, [1.0, 1.0, 1.0], True
        if visible:
            _add_surface(mujoco, spec, body, number, item, model)
    try:
        return spec.compile()
    except ValueError as error:
        raise DatasetError(_explain(str(error), scene)) from error


def _explain(message: str, scene: Scene) -> str:
    """MuJoCo's complaint in one line, with the model that it is about."""
    match = re.search(r"'(?:hull|surface)_(\d+)", message)
    which = f"the model {scene.objects[int(match[1]) - 1].name}" if match else "the scene"
    reason = message.splitlines()[0].removeprefix("Error: ")
    return f"MuJoCo cannot build {which}: {reason}"


def _make_solid(geom: Any) -> None:
    geom.group, geom.friction, geom.condim = SOLID_GROUP, [FRICTION, 0.005, 0.0001], 4
    # Twice the time step is as stiff as MuJoCo's contacts can be.
    geom.solref, geom.solimp = [2 * FRAME / SUBSTEPS, 1], [0.9, 0.98, 0.002, 0.5, 2]


def _add_slab(mujoco: Any, spec: Any, number: int, slab: Slab, *, solid: bool, visible: bool) -> None:
    """A box to collide with, and a mesh to be seen: rays know no other shapes than those of every other scene."""
    place = {"pos": slab.center, "quat": [math.cos(slab.turn / 2), 0, 0, math.sin(slab.turn / 2)]}
    if solid:
        _make_solid(spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=slab.half, **place))
    if not visible:
        return
    name, look = f"slab_{number}", slab.surface
    vertices, faces, uv = box_mesh(slab.half)
    spec.add_mesh(
        name=name,
        uservert=_flat(vertices),
        userface=faces.ravel(),
        usertexcoord=_flat(uv / look.tile),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    _add_material(mujoco, spec, name, draw_texture(look.texture, FLOOR_TEXTURE_SIZE), look.specular, look.shininess)
    geom = spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, group=VISIBLE_GROUP, **place
    )
    geom.contype = geom.conaffinity = 0


def box_mesh(half: Sequence[float]) -> tuple[Float64Array, LabelImage, Float64Array]:
    """A box about the origin: (24, 3) vertices, (12, 3) faces that look outwards, (24, 2) metres along each side."""
    vertices: list[Float64Array] = []
    faces: list[list[int]] = []
    uv: list[tuple[float, float]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            first = len(vertices)
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                corner = np.zeros(3)
                corner[axis], corner[u], corner[v] = sign * half[axis], a * half[u], b * half[v]
                vertices.append(corner)
                uv.append((a * half[u], b * half[v]))
            order = (0, 1, 2, 3) if sign > 0 else (0, 3, 2, 1)
            faces += [[first + order[i] for i in triangle] for triangle in ((0, 1, 2), (0, 2, 3))]
    return np.array(vertices), np.array(faces, dtype=np.int32), np.array(uv)


def _add_hulls(mujoco: Any, spec: Any, body: Any, number: int, item: SceneObject, model: ObjectModel) -> None:
    for part, vertices in enumerate(model.parts):
        name = f"hull_{number}_{part}"
        spec.add_mesh(
            name=name, uservert=_flat(vertices * item.scale), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        )
        hull = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, density=item.density)
        _make_solid(hull)


def _add_surface(mujoco: Any, spec: Any, body: Any, number: int, item: SceneObject, model: ObjectModel) -> None:
    name = f"surface_{number}"
    uv = np.stack([model.uv[:, 0], 1 - model.uv[:, 1]], axis=1)  # MuJoCo's v runs downwards
    spec.add_mesh(
        name=name,
        uservert=_flat(model.vertices * item.scale),
        userface=model.faces.astype(np.int32).ravel(),
        usertexcoord=_flat(uv),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    picture = model.texture if item.texture.kind == "model" else draw_texture(item.texture, TEXTURE_SIZE)
    if picture is None:
        picture = draw_texture(TextureSpec("plain"), TEXTURE_SIZE)
    _add_material(mujoco, spec, name, picture, item.specular, item.shininess)
    geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, group=VISIBLE_GROUP)
    geom.contype = geom.conaffinity = 0
    geom.mass = 0


def _add_material(mujoco: Any, spec: Any, name: str, picture: UInt8Array, specular: float, shininess: float) -> Any:
    texture = spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=picture.shape[1],
        height=picture.shape[0],
        nchannel=3,
    )
    texture.data = np.ascontiguousarray(picture).tobytes()
    material = spec.add_material(name=name, specular=specular, shininess=shininess)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    return material


def _add_surroundings(mujoco: Any, spec: Any, scene: Scene) -> None:
    floor = scene.floor
    picture = draw_texture(floor.texture, FLOOR_TEXTURE_SIZE)
    material = _add_material(mujoco, spec, "floor", picture, floor.specular, floor.shininess)
    material.texrepeat = [2 * FLOOR_HALF / floor.tile] * 2
    for number in range(LIGHTS):
        lit = number < len(scene.lights)
        lamp = scene.lights[number if lit else 0]
        spec.worldbody.add_light(
            name=f"light_{number}",
            type=mujoco.mjtLightType.mjLIGHT_POINT,
            active=lit,
            castshadow=True,
            pos=lamp.position,
            dir=[0, 0, -1],
            attenuation=[1, 0, 0],
            diffuse=lamp.diffuse,
            specular=lamp.specular,
            ambient=lamp.ambient,
        )
    camera = scene.intrinsics
    pixel = 1e-4  # metres; only ratios count
    spec.worldbody.add_camera(
        name="camera",
        resolution=[camera.width, camera.height],
        focal_pixel=[camera.fx, camera.fy],
        sensor_size=[camera.width * pixel, camera.height * pixel],
        # MuJoCo counts from the image's middle, and the other way round.
        principal_pixel=[(camera.width - 1) / 2 - camera.cx, (camera.height - 1) / 2 - camera.cy],
    )


def _flat(values: Float64Array) -> Float32Array:
    return np.ascontiguousarray(values, dtype=np.float32).ravel()
