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
    # Bullet's damping, applied to the velocities as Bullet does: MuJoCo's own is a force, in other units, and would
    # depend on each body's inertia.
    step = FRAME / SUBSTEPS
    keep = np.tile([(1 - LINEAR_DAMPING) ** step] * 3 + [(1 - ANGULAR_DAMPING) ** step] * 3, count)
    poses, depth, energy = np.empty((last + 1, count, 4, 4)), np.zeros(last + 1), np.empty(last + 1)
    for frame in range(last + 1):
        # The first half of a step finds where things are, what touches and the energy; the second moves on. Recording
        # in between costs nothing.
        mujoco.mj_step1(model, data)
        poses[frame] = _poses(data, count)
        depth[frame] = max(0.0, -float(data.contact.dist.min(initial=0.0)))
        energy[frame] = data.energy.sum()
        if frame == last:
            break
        mujoco.mj_step2(model, data)
        data.qvel *= keep
        for _ in range(SUBSTEPS - 1):
            mujoco.mj_step(model, data)
            data.qvel *= keep
    return Recording(poses, depth, energy)


def _poses(data: Any, count: int) -> Float64Array:
    """(N, 4, 4): every body but the world is an object."""
    return make_transform(data.xmat[1 : count + 1].reshape(-1, 3, 3), data.xpos[1 : count + 1])
