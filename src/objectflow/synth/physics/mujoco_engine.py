"""Simulation with MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from objectflow.geometry.se3 import make_transform
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics.mjcf import build_model, import_mujoco
from objectflow.synth.physics.recording import ANGULAR_DAMPING, FRAME, LINEAR_DAMPING, SUBSTEPS, Recording
from objectflow.synth.scenes.scene_data import Scene
from objectflow.typing import Float64Array


def record(scene: Scene, models: Sequence[ObjectModel], last: int) -> Recording:
    """Simulate frames 0 to `last`.

    Raises:
        MissingExtraError: MuJoCo is not installed.
    """
    mujoco = import_mujoco()
    model = build_model(scene, models, visible=False)
    data = mujoco.MjData(model)
    count = len(scene.objects)
    # Velocities are damped as in Bullet. MuJoCo's own damping is a force, and would depend on each body's inertia.
    keep = velocity_factors(count, FRAME / SUBSTEPS)
    poses, penetration, energy = np.empty((last + 1, count, 4, 4)), np.zeros(last + 1), np.empty(last + 1)
    for frame in range(last + 1):
        # The first half of a step updates positions, contacts and energy, the second half integrates. Recording in
        # between needs no further computation.
        mujoco.mj_step1(model, data)
        poses[frame] = object_poses(data, count)
        penetration[frame] = deepest_penetration(data)
        energy[frame] = data.energy.sum()
        if frame == last:
            break
        mujoco.mj_step2(model, data)
        data.qvel *= keep
        for _ in range(SUBSTEPS - 1):
            mujoco.mj_step(model, data)
            data.qvel *= keep
    return Recording(poses, penetration, energy)


def velocity_factors(count: int, step: float) -> Float64Array:
    """(6 N,) factors by which damping reduces the velocities of N free bodies in a step of the given seconds."""
    return np.tile([(1 - LINEAR_DAMPING) ** step] * 3 + [(1 - ANGULAR_DAMPING) ** step] * 3, count)


def object_poses(data: Any, count: int) -> Float64Array:
    """(N, 4, 4) `world_T_object` of a `mujoco.MjData` in which body 0 is the world and bodies 1..N are objects."""
    return make_transform(data.xmat[1 : count + 1].reshape(-1, 3, 3), data.xpos[1 : count + 1])


def deepest_penetration(data: Any) -> float:
    """Deepest penetration of a `mujoco.MjData`, metres; 0 without contact."""
    return max(0.0, -float(data.contact.dist.min(initial=0.0)))
