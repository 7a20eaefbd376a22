"""Let objects come to rest, then carry out actions on some of them, and record the poses from the first action on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics.mjcf import build_model, import_mujoco
from objectflow.synth.physics.mujoco_engine import deepest_penetration, object_poses, velocity_factors
from objectflow.synth.physics.recording import FRAME, GRAVITY, Recording
from objectflow.synth.physics.simulate import MAX_SPEED, RejectedSceneError, top_speed
from objectflow.synth.scenes.actions import Action, driven_velocity, is_driven
from objectflow.synth.scenes.scene_data import Scene
from objectflow.typing import Float64Array

SETTLING_FRAMES = 75
"""Number of unrecorded frames in which everything comes to rest."""
SETTLING_DAMPING = 0.995
"""Share of its velocity that an object loses per second while it settles; it ends rolling and rocking early."""
FOOT_HEIGHT = 0.01
"""Height above an object's lowest point below which its points may be the tipping edge, metres."""
CORNER_POINTS = 400
"""Approximate number of points of the collision shape among which the tipping edge is searched."""


def simulate_actions(scene: Scene, models: Sequence[ObjectModel], actions: Sequence[Action], last: int) -> Recording:
    """Let a scene come to rest, then carry out the actions and record frames 0 to `last`.

    Driven objects keep the action's velocity on contact; other objects are pushed aside or carried.

    Raises:
        RejectedSceneError: the simulation does not stay finite, or an object becomes too fast.
        MissingExtraError: MuJoCo is not installed.
    """
    mujoco = import_mujoco()
    model = build_model(scene, models, visible=False)
    data = mujoco.MjData(model)
    count, step = len(scene.objects), float(model.opt.timestep)
    substeps = round(FRAME / step)
    points = [_collision_points(m, o.scale) for m, o in zip(models, scene.objects, strict=True)]
    stepper = _Stepper(mujoco, model, data, actions, points)
    settling = np.full(6 * count, (1 - SETTLING_DAMPING) ** step)
    for _ in range(SETTLING_FRAMES * substeps):
        stepper.step(-1.0, settling)
    keep = velocity_factors(count, step)
    data.qvel[:] = 0
    poses, penetration = np.empty((last + 1, count, 4, 4)), np.zeros(last + 1)
    for frame in range(last + 1):
        mujoco.mj_kinematics(model, data)
        poses[frame] = object_poses(data, count)
        penetration[frame] = deepest_penetration(data)
        for action in actions:
            if action.kind == "push" and action.start == frame:
                first = 6 * action.object
                data.qvel[first : first + 3] += action.speed * action.direction
        if frame < last:
            for sub in range(substeps):
                stepper.step(frame + sub / substeps, keep)
    speed = top_speed(poses[..., :3, 3])
    if not np.isfinite(poses).all() or speed > MAX_SPEED:
        raise RejectedSceneError("explodes", f"top speed {speed:.1f} m/s")
    # Energy is not recorded: actions change it.
    return Recording(poses, penetration, np.zeros(last + 1))


class _Stepper:
    """Advances the simulation while actions drive some of the objects."""

    def __init__(
        self, mujoco: Any, model: Any, data: Any, actions: Sequence[Action], points: Sequence[Float64Array]
    ) -> None:
        self._mujoco, self._model, self._data = mujoco, model, data
        self._actions = actions
        self._points = points
        self._edges: dict[int, Float64Array] = {}

    def step(self, time: float, keep: Float64Array) -> None:
        """Advance by one step from a time in frames; velocities are multiplied by the factors `keep` (6 N,)."""
        driven = [action for action in self._actions if is_driven(action, time)]
        data, model = self._data, self._model
        data.xfrc_applied[:] = 0
        for action in driven:
            body = action.object + 1
            data.xfrc_applied[body, 2] = GRAVITY * model.body_mass[body]
        self._mujoco.mj_step(model, data)
        data.qvel *= keep
        for action in driven:
            self._drive(action, time)

    def _drive(self, action: Action, time: float) -> None:
        data, first, body = self._data, 6 * action.object, action.object + 1
        velocity, angular = driven_velocity(action, time, FRAME, self._arm(action))
        data.qvel[first : first + 3] = velocity
        # MuJoCo expresses the angular velocity of a free body in the body's own axes.
        data.qvel[first + 3 : first + 6] = data.xmat[body].reshape(3, 3).T @ angular

    def _arm(self, action: Action) -> Float64Array:
        """(3,) metres from the tipping edge, the foremost of an object's lowest points at the start, to its origin."""
        if action.kind != "topple":
            return np.zeros(3)
        body = action.object + 1
        position, rotation = self._data.xpos[body], self._data.xmat[body].reshape(3, 3)
        if action.object not in self._edges:
            points = self._points[action.object] @ rotation.T + position
            foot = points[points[:, 2] < points[:, 2].min() + FOOT_HEIGHT]
            self._edges[action.object] = foot[np.argmax(foot @ action.direction)]
        return np.asarray(position - self._edges[action.object])


def _collision_points(model: ObjectModel, scale: float) -> Float64Array:
    """(P, 3) points of the collision shape, metres."""
    points = np.concatenate(model.parts) * scale
    return np.asarray(points[:: max(1, len(points) // CORNER_POINTS)])
