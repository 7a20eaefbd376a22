"""Objects come to rest, then some of them are moved: the poses from the first action on, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from objectflow.geometry.se3 import make_transform
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics.mjcf import build_model, import_mujoco
from objectflow.synth.physics.recording import ANGULAR_DAMPING, FRAME, GRAVITY, LINEAR_DAMPING, Recording
from objectflow.synth.physics.simulate import MAX_SPEED, RejectedSceneError
from objectflow.synth.scenes.actions import Action, is_led, led_velocity
from objectflow.synth.scenes.scene_data import Scene
from objectflow.typing import Float64Array

SETTLE = 75
"""Frames in which everything comes to rest, unseen."""
SETTLE_DAMPING = 0.995
"""Share of its speed that a thing loses a second meanwhile: rolling and rocking end soon."""


def act(scene: Scene, models: Sequence[ObjectModel], actions: Sequence[Action], last: int) -> Recording:
    """Let a scene come to rest, then carry out the actions and record frames 0 to `last`.

    Objects that are led have the action's velocity, whatever is in their way: the others give way or are carried.

    Raises:
        RejectedSceneError: the simulation does not stay finite, or something becomes too fast.
        MissingExtraError: MuJoCo is not installed.
    """
    mujoco = import_mujoco()
    model = build_model(scene, models, visible=False)
    data = mujoco.MjData(model)
    count, step = len(scene.objects), float(model.opt.timestep)
    substeps = round(FRAME / step)
    low = [_lowest(m, o.scale) for m, o in zip(models, scene.objects, strict=True)]
    settle = _Phase(mujoco, model, data, step, actions, low)
    calm = np.full(6 * count, (1 - SETTLE_DAMPING) ** step)
    for _ in range(SETTLE * substeps):
        settle.step(-1.0, calm)
    keep = np.tile([(1 - LINEAR_DAMPING) ** step] * 3 + [(1 - ANGULAR_DAMPING) ** step] * 3, count)
    data.qvel[:] = 0
    poses, depth, energy = np.empty((last + 1, count, 4, 4)), np.zeros(last + 1), np.zeros(last + 1)
    for frame in range(last + 1):
        mujoco.mj_kinematics(model, data)
        poses[frame] = make_transform(data.xmat[1 : count + 1].reshape(-1, 3, 3), data.xpos[1 : count + 1])
        depth[frame] = max(0.0, -float(data.contact.dist.min(initial=0.0)))
        for action in actions:
            if action.kind == "push" and action.start == frame:
                first = 6 * action.object
                data.qvel[first : first + 3] += action.speed * action.direction
        if frame < last:
            for sub in range(substeps):
                settle.step(frame + sub / substeps, keep)
    speed = np.linalg.norm(np.diff(poses[..., :3, 3], axis=0), axis=-1).max(initial=0.0) / FRAME
    if not np.isfinite(poses).all() or speed > MAX_SPEED:
        raise RejectedSceneError("explodes", f"top speed {speed:.1f} m/s")
    return Recording(poses, depth, energy)


class _Phase:
    """Steps of the engine in which some objects are led."""

    def __init__(
        self, mujoco: Any, model: Any, data: Any, step: float, actions: Sequence[Action], low: Sequence[Float64Array]
    ) -> None:
        self._mujoco, self._model, self._data, self._step = mujoco, model, data, step
        self._actions = actions
        self._low = low
        self._edges: dict[int, Float64Array] = {}

    def step(self, time: float, keep: Float64Array) -> None:
        """One step at a time in frames; every velocity keeps a share."""
        led = [action for action in self._actions if is_led(action, time)]
        data, model = self._data, self._model
        data.xfrc_applied[:] = 0
        for action in led:
            body = action.object + 1
            data.xfrc_applied[body, 2] = GRAVITY * model.body_mass[body]
        self._mujoco.mj_step(model, data)
        data.qvel *= keep
        for action in led:
            self._lead(action, time)

    def _lead(self, action: Action, time: float) -> None:
        data, first, body = self._data, 6 * action.object, action.object + 1
        velocity, spin = led_velocity(action, time, FRAME, self._arm(action))
        data.qvel[first : first + 3] = velocity
        # MuJoCo has a free body's angular velocity in the body's own axes.
        data.qvel[first + 3 : first + 6] = data.xmat[body].reshape(3, 3).T @ spin

    def _arm(self, action: Action) -> Float64Array:
        """From the edge over which an object is tipped, the lowest foremost point at the start, to its origin."""
        if action.kind != "topple":
            return np.zeros(3)
        body = action.object + 1
        position, rotation = self._data.xpos[body], self._data.xmat[body].reshape(3, 3)
        if action.object not in self._edges:
            points = self._low[action.object] @ rotation.T + position
            ground = points[points[:, 2] < points[:, 2].min() + 0.01]
            self._edges[action.object] = ground[np.argmax(ground @ action.direction)]
        return np.asarray(position - self._edges[action.object])


def _lowest(model: ObjectModel, scale: float) -> Float64Array:
    """(P, 3) points of the collision shape, metres, some hundred at most."""
    points = np.concatenate(model.parts) * scale
    return np.asarray(points[:: max(1, len(points) // 400)])
