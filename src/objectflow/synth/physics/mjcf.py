"""The MuJoCo model of a scene: free bodies with convex hulls for collisions and meshes for rendering."""

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

LIGHTS = 4
"""Number of lights of every model, unused ones switched off: it is compiled into the renderer's kernel."""
VISIBLE_GROUP, SOLID_GROUP = 0, 3
"""Geom groups of visible surfaces and of collision shapes."""
TEXTURE_SIZE = 128
"""Side length of an object's texture, pixels: about one per image pixel, because the renderer has no mip maps."""


def import_mujoco() -> Any:
    """Import the `mujoco` module.

    Raises:
        MissingExtraError: MuJoCo is not installed.
    """
    try:
        import mujoco
    except ImportError as error:
        raise MissingExtraError("simulation needs MuJoCo", "synth") from error
    return mujoco


def build_model(scene: Scene, models: Sequence[ObjectModel], *, solid: bool = True, visible: bool = True) -> Any:
    """Compile a scene.

    Args:
        scene: the scene to compile.
        models: of the scene's objects, in order.
        solid: include collision hulls (group 3), which have the mass.
        visible: include surfaces (group 0), textures, lights, and a camera named `camera` with the scene's intrinsics.

    Returns:
        A `mujoco.MjModel` with one free body per object, named obj_1..obj_N, whose frames are the object frames.

    Raises:
        MissingExtraError: MuJoCo is not installed.
        DatasetError: a texture image cannot be read, or a mesh or collision part is not a solid.
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
    floor = spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[scene.floor.half, scene.floor.half, 0.1]
    )
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
            # MuJoCo requires a mass of a free body, although this model is only rendered.
            body.mass, body.inertia, body.explicitinertial = 1.0, [1.0, 1.0, 1.0], True
        if visible:
            _add_surface(mujoco, spec, body, number, item, model)
    try:
        return spec.compile()
    except ValueError as error:
        raise DatasetError(_explain(str(error), scene)) from error


def _explain(message: str, scene: Scene) -> str:
    """MuJoCo's error message in one line, with the name of the object model at fault."""
    match = re.search(r"'(?:hull|surface)_(\d+)", message)
    which = f"the model {scene.objects[int(match[1]) - 1].name}" if match else "the scene"
    reason = message.splitlines()[0].removeprefix("Error: ")
    return f"MuJoCo cannot build {which}: {reason}"


def _make_solid(geom: Any) -> None:
    geom.group, geom.friction, geom.condim = SOLID_GROUP, [FRICTION, 0.005, 0.0001], 4
    # MuJoCo's contacts are stiffest at a time constant of two time steps.
    geom.solref, geom.solimp = [2 * FRAME / SUBSTEPS, 1], [0.9, 0.98, 0.002, 0.5, 2]


def _add_slab(mujoco: Any, spec: Any, number: int, slab: Slab, *, solid: bool, visible: bool) -> None:
    """Add a box for collisions and a mesh for rendering: all scenes have the geom types of the compiled kernel."""
    pose = {"pos": slab.center, "quat": [math.cos(slab.yaw / 2), 0, 0, math.sin(slab.yaw / 2)]}
    if solid:
        _make_solid(spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=slab.half, **pose))
    if not visible:
        return
    name, surface = f"slab_{number}", slab.surface
    vertices, faces, uv = box_mesh(slab.half)
    spec.add_mesh(
        name=name,
        uservert=_flat(vertices),
        userface=faces.ravel(),
        usertexcoord=_flat(uv / surface.tile),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    image = draw_texture(surface.texture, surface.pixels)
    _add_material(mujoco, spec, name, image, surface.specular, surface.shininess)
    geom = spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, group=VISIBLE_GROUP, **pose
    )
    geom.contype = geom.conaffinity = 0


def box_mesh(half: Sequence[float]) -> tuple[Float64Array, LabelImage, Float64Array]:
    """Mesh of a box about the origin.

    Args:
        half: half its side lengths along x, y and z, metres.

    Returns:
        (24, 3) vertices in metres, (12, 3) outward faces, and (24, 2) texture coordinates in metres along each side.
    """
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
    uv = np.stack([model.uv[:, 0], 1 - model.uv[:, 1]], axis=1)  # v runs downwards in MuJoCo
    spec.add_mesh(
        name=name,
        uservert=_flat(model.vertices * item.scale),
        userface=model.faces.astype(np.int32).ravel(),
        usertexcoord=_flat(uv),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    image = model.texture if item.texture.kind == "model" else draw_texture(item.texture, TEXTURE_SIZE)
    if image is None:
        image = draw_texture(TextureSpec("plain"), TEXTURE_SIZE)
    _add_material(mujoco, spec, name, image, item.specular, item.shininess)
    geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, material=name, group=VISIBLE_GROUP)
    geom.contype = geom.conaffinity = 0
    geom.mass = 0


def _add_material(mujoco: Any, spec: Any, name: str, image: UInt8Array, specular: float, shininess: float) -> Any:
    texture = spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=image.shape[1],
        height=image.shape[0],
        nchannel=3,
    )
    texture.data = np.ascontiguousarray(image).tobytes()
    material = spec.add_material(name=name, specular=specular, shininess=shininess)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    return material


def _add_surroundings(mujoco: Any, spec: Any, scene: Scene) -> None:
    floor = scene.floor
    image = draw_texture(floor.texture, floor.pixels)
    material = _add_material(mujoco, spec, "floor", image, floor.specular, floor.shininess)
    material.texrepeat = [2 * floor.half / floor.tile] * 2
    for number in range(LIGHTS):
        lit = number < len(scene.lights)
        light = scene.lights[number if lit else 0]
        spec.worldbody.add_light(
            name=f"light_{number}",
            type=mujoco.mjtLightType.mjLIGHT_POINT,
            active=lit,
            castshadow=True,
            pos=light.position,
            dir=[0, 0, -1],
            attenuation=[1, 0, 0],
            diffuse=light.diffuse,
            specular=light.specular,
            ambient=light.ambient,
        )
    camera = scene.intrinsics
    pixel = 1e-4  # metres; only the ratio to the sensor size matters
    spec.worldbody.add_camera(
        name="camera",
        resolution=[camera.width, camera.height],
        focal_pixel=[camera.fx, camera.fy],
        sensor_size=[camera.width * pixel, camera.height * pixel],
        # MuJoCo's principal point is relative to the image centre and has the opposite sign.
        principal_pixel=[(camera.width - 1) / 2 - camera.cx, (camera.height - 1) / 2 - camera.cy],
    )


def _flat(values: Float64Array) -> Float32Array:
    return np.ascontiguousarray(values, dtype=np.float32).ravel()
