"""Simulation with Bullet, the engine of the paper; needs the extra `[bullet]`."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from objectflow.errors import MissingExtraError
from objectflow.geometry.se3 import inverse, make_transform
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics.mjcf import build_model
from objectflow.synth.physics.recording import (
    ANGULAR_DAMPING,
    FRAME,
    FRICTION,
    GRAVITY,
    LINEAR_DAMPING,
    SUBSTEPS,
    Recording,
)
from objectflow.synth.scenes.scene_data import Scene
from objectflow.typing import Float64Array


def record(scene: Scene, models: Sequence[ObjectModel], last: int) -> Recording:
    """Simulate frames 0 to `last`, with the masses and inertias of the MuJoCo model.

    Raises:
        MissingExtraError: PyBullet or MuJoCo is not installed.
    """
    bullet = _import_bullet()
    inertial = build_model(scene, models, visible=False)
    mass = inertial.body_mass[1:]
    object_T_mass = make_transform(
        Rotation.from_quat(inertial.body_iquat[1:], scalar_first=True).as_matrix(), inertial.body_ipos[1:]
    )
    mass_T_object = inverse(object_T_mass)
    world_T_mass = np.stack([item.world_T_object for item in scene.objects]) @ object_T_mass
    with _world(bullet) as world, tempfile.TemporaryDirectory() as folder:
        bodies = []
        for i, (item, model) in enumerate(zip(scene.objects, models, strict=True)):
            parts = [
                (part * item.scale) @ mass_T_object[i, :3, :3].T + mass_T_object[i, :3, 3] for part in model.parts
            ]
            file = Path(folder) / f"{i}.obj"
            file.write_text("".join(_wavefront(parts)))
            bodies.append(_add_object(bullet, world, file, float(mass[i]), world_T_mass[i]))
        for body, weight, diagonal in zip(bodies, mass, inertial.body_inertia[1:], strict=True):
            # Bullet would use the inertia of the shape's box. The mass must be set in the same call, or it is reset.
            bullet.changeDynamics(
                body, -1, mass=float(weight), localInertiaDiagonal=diagonal.tolist(), physicsClientId=world
            )
        poses = np.empty((last + 1, len(bodies), 4, 4))
        penetration, energy = np.zeros(last + 1), np.empty(last + 1)
        for frame in range(last + 1):
            if frame:
                for _ in range(SUBSTEPS):
                    bullet.stepSimulation(physicsClientId=world)
            world_T_mass = np.stack([_pose(bullet, world, body) for body in bodies])
            poses[frame] = world_T_mass @ mass_T_object
            contacts = bullet.getContactPoints(physicsClientId=world)
            penetration[frame] = max([0.0, *(-contact[8] for contact in contacts)])
            energy[frame] = _energy(bullet, world, bodies, world_T_mass, mass, inertial.body_inertia[1:])
    return Recording(poses, penetration, energy)


def _import_bullet() -> ModuleType:
    try:
        import pybullet
    except ImportError as error:
        raise MissingExtraError("the engine 'bullet' needs PyBullet", "bullet") from error
    module: ModuleType = pybullet
    return module


@contextmanager
def _world(bullet: ModuleType) -> Iterator[int]:
    """Open a world with a floor, without a window."""
    world = bullet.connect(bullet.DIRECT)
    try:
        bullet.setGravity(0, 0, -GRAVITY, physicsClientId=world)
        # Caching by file name is wrong here: different objects use the same names.
        bullet.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=world)
        bullet.setTimeStep(FRAME / SUBSTEPS, physicsClientId=world)
        plane = bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=world)
        floor = bullet.createMultiBody(0, plane, physicsClientId=world)
        bullet.changeDynamics(floor, -1, lateralFriction=FRICTION, physicsClientId=world)
        yield world
    finally:
        bullet.disconnect(physicsClientId=world)


def _add_object(bullet: ModuleType, world: int, file: Path, mass: float, world_T_mass: Float64Array) -> int:
    """Add a body whose frame is its centre-of-mass frame, as Bullet requires."""
    # A shape of several hulls can only be loaded from a file, each of whose objects becomes a convex hull.
    shape = bullet.createCollisionShape(bullet.GEOM_MESH, fileName=str(file), physicsClientId=world)
    body: int = bullet.createMultiBody(
        mass,
        shape,
        basePosition=world_T_mass[:3, 3].tolist(),
        baseOrientation=Rotation.from_matrix(world_T_mass[:3, :3]).as_quat().tolist(),
        # Bodies in reduced coordinates, the default, are damped by another formula.
        useMaximalCoordinates=True,
        physicsClientId=world,
    )
    bullet.changeDynamics(
        body,
        -1,
        lateralFriction=FRICTION,
        linearDamping=LINEAR_DAMPING,
        angularDamping=ANGULAR_DAMPING,
        physicsClientId=world,
    )
    return body


def _wavefront(parts: Sequence[Float64Array]) -> Iterator[str]:
    """Lines of an OBJ file with the convex hulls of point sets (P, 3)."""
    first = 1
    for number, points in enumerate(parts):
        yield f"o part_{number}\n"
        yield from (f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in points)
        yield from (f"f {a + first} {b + first} {c + first}\n" for a, b, c in ConvexHull(points).simplices)
        first += len(points)


def _pose(bullet: ModuleType, world: int, body: int) -> Float64Array:
    position, quaternion = bullet.getBasePositionAndOrientation(body, physicsClientId=world)
    return make_transform(Rotation.from_quat(quaternion).as_matrix(), position)


def _energy(
    bullet: ModuleType,
    world: int,
    bodies: Sequence[int],
    world_T_mass: Float64Array,
    mass: Float64Array,
    inertia: Float64Array,
) -> float:
    """Kinetic plus potential energy, joules."""
    velocity = np.array([bullet.getBaseVelocity(body, physicsClientId=world) for body in bodies])
    angular = np.einsum("nji,nj->ni", world_T_mass[:, :3, :3], velocity[:, 1])
    kinetic = 0.5 * (mass * np.square(velocity[:, 0]).sum(-1) + (inertia * np.square(angular)).sum(-1))
    return float((kinetic + mass * GRAVITY * world_T_mass[:, 2, 3]).sum())
