"""A scene as a MuJoCo model: one for physics and pictures alike, so that what falls is what is seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from objectflow.errors import MissingExtraError
from objectflow.synth.model import ObjectModel
from objectflow.synth.scene import MAX_LIGHTS, PlacedObject, Scene
from objectflow.synth.textures import draw_texture

VISIBLE, HULLS = 0, 3
"""Groups of geoms: what is seen, and what collides."""
STEPS_A_FRAME = 8
FRAME_RATE = 60.0
TEXTURE_SIZE, FLOOR_TEXTURE_SIZE = 256, 512


def import_mujoco() -> Any:
    """The module, or an error that names the extra."""
    try:
        import mujoco
    except ImportError as error:
        raise MissingExtraError('physics needs MuJoCo: pip install "objectflow[synth]"') from error
    return mujoco


def build_model(scene: Scene, models: Sequence[ObjectModel]) -> Any:
    """The `mujoco.MjModel` of a scene.

    One free body an object, obj_1 to obj_N in the scene's order, with its surface in group 0 and its convex parts,
    which alone collide, in group 3; the geom `floor`; four lights; a camera `camera` at the first view's pose.

    Args:
        scene: what lies where.
        models: of the scene's objects, in order.
    """
    mujoco = import_mujoco()
    spec = mujoco.MjSpec()
    spec.option.timestep = 1 / FRAME_RATE / STEPS_A_FRAME
    # Elliptic cones and the implicit integrator keep piles at rest; nothing here is stiff enough to need more.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.visual.headlight.active = False
    _add_floor(mujoco, spec, scene)
    _add_lights(mujoco, spec, scene)
    _add_camera(spec, scene)
    for number, (entry, model) in enumerate(zip(scene.objects, models, strict=True), 1):
        _add_object(mujoco, spec, number, entry, model)
    return spec.compile()


def _add_floor(mujoco: Any, spec: Any, scene: Scene) -> None:
    _add_material(mujoco, spec, "floor", draw_texture(scene.floor, FLOOR_TEXTURE_SIZE), 0.0)
    material = spec.material("floor")
    material.texrepeat = [1 / scene.floor_size] * 2
    material.texuniform = True
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 0.1],
        material="floor",
        group=VISIBLE,
        **_contact(),
    )


def _add_lights(mujoco: Any, spec: Any, scene: Scene) -> None:
    for number in range(MAX_LIGHTS):
        on = number < len(scene.lights)
        spec.worldbody.add_light(
            name=f"light_{number}",
            type=mujoco.mjtLightType.mjLIGHT_POINT,
            pos=scene.lights[number].position if on else (0.0, 0.0, 2.0),
            dir=[0, 0, -1],
            active=on,
            castshadow=True,
            attenuation=[1, 0, 0],
            ambient=np.divide(scene.ambient, len(scene.lights)) if on else [0, 0, 0],
            diffuse=scene.lights[number].color if on else [0, 0, 0],
            specular=[0.3] * 3 if on else [0, 0, 0],
        )


def _add_camera(spec: Any, scene: Scene) -> None:
    camera = scene.camera
    width, height = int(camera["width"]), int(camera["height"])
    pose = scene.camera_poses[0]
    world_R_camera = pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])  # MuJoCo looks along -z, with y up
    spec.worldbody.add_camera(
        name="camera",
        pos=pose[:3, 3],
        xyaxes=np.concatenate([world_R_camera[:, 0], world_R_camera[:, 1]]),
        resolution=[width, height],
        focal_pixel=[camera["fx"], camera["fy"]],
        sensor_size=[width * 1e-5, height * 1e-5],
        principal_pixel=[(width - 1) / 2 - camera["cx"], (height - 1) / 2 - camera["cy"]],
    )


def _add_object(mujoco: Any, spec: Any, number: int, entry: PlacedObject, model: ObjectModel) -> None:
    body = spec.worldbody.add_body(name=f"obj_{number}", pos=entry.position, quat=entry.quaternion)
    body.add_freejoint()
    picture = model.texture if entry.texture.kind == "model" else draw_texture(entry.texture, TEXTURE_SIZE)
    if picture is None:
        raise ValueError(f"{model.name} has no picture of its own")
    _add_material(mujoco, spec, f"surface_{number}", picture, entry.shininess)
    spec.add_mesh(
        name=f"surface_{number}",
        uservert=model.vertices.astype(np.float32).ravel(),
        userface=model.faces.astype(np.int32).ravel(),
        usertexcoord=model.uv.astype(np.float32).ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=f"surface_{number}",
        material=f"surface_{number}",
        group=VISIBLE,
        contype=0,
        conaffinity=0,
        density=0,
    )
    for position, points in enumerate(model.parts):
        name = f"hull_{number}_{position}"
        spec.add_mesh(name=name, uservert=points.astype(np.float32).ravel())
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, group=HULLS, density=entry.density, **_contact())


def _add_material(mujoco: Any, spec: Any, name: str, picture: Any, shininess: float) -> None:
    texture = spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=picture.shape[1],
        height=picture.shape[0],
        nchannel=3,
    )
    # MuJoCo's first row is v = 0, pictures' first row is the top.
    texture.data = np.ascontiguousarray(picture[::-1]).tobytes()
    material = spec.add_material(name=name, specular=0.5 * shininess, shininess=shininess)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _contact() -> dict[str, Any]:
    """Friction 1 as in the paper; stiff enough that a ball dropped into a mug does not sink through its floor."""
    return {"friction": [1.0, 0.005, 0.0005], "condim": 4, "solref": [0.005, 1.0], "margin": 0.0}
