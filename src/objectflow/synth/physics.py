"""How a scene falls: poses of every object in the frames that are wanted, or a reason to draw another scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from objectflow.errors import ObjectflowError
from objectflow.synth.mjcf import STEPS_A_FRAME, import_mujoco

PAIR_FRAMES = (20, 80)
SEQUENCE_FRAMES = tuple(range(20, 91, 10))
LINEAR_DAMPING, ANGULAR_DAMPING = 0.9, 0.8
"""Share of speed lost in a second, as Bullet means it and the paper's scenes have it."""
MAX_SPEED = 4.0
"""Metres a second; free fall from twice the drop height stays below."""
MAX_SINK = 0.006
"""Metres that two things may overlap in a wanted frame."""
MAX_DISTANCE = 1.5
"""Metres from the middle; what rolls further has left the scene."""


class RejectedScene(ObjectflowError):  # noqa: N818
    """The simulation went wrong in a known way; the message is the reason, in a word or two."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Where everything was.

    Attributes:
        frames: the frame numbers, at 60 Hz.
        world_T_object: (F, N, 4, 4) metres.
    """

    frames: tuple[int, ...]
    world_T_object: NDArray[np.float64]

    @property
    def displacement(self) -> NDArray[np.float64]:
        """(N,) metres between the first and the last frame."""
        position = self.world_T_object[:, :, :3, 3]
        return np.asarray(np.linalg.norm(position[-1] - position[0], axis=-1))


def simulate(model: Any, frames: Sequence[int]) -> Trajectory:
    """Let a scene fall, with MuJoCo.

    Args:
        model: `mujoco.MjModel` of `mjcf.build_model`.
        frames: rising frame numbers; 0 is the start.

    Raises:
        RejectedScene: something flew off, sank in, or left the scene.
    """
    mujoco = import_mujoco()
    data = mujoco.MjData(model)
    keep_linear = (1 - LINEAR_DAMPING) ** float(model.opt.timestep)
    keep_angular = (1 - ANGULAR_DAMPING) ** float(model.opt.timestep)
    keep = np.tile([keep_linear] * 3 + [keep_angular] * 3, model.nv // 6)
    poses = []
    for frame in range(max(frames) + 1):
        if frame in frames:
            mujoco.mj_forward(model, data)
            _check(model, data)
            poses.append(_poses(model, data))
        for _ in range(STEPS_A_FRAME):
            mujoco.mj_step(model, data)
            data.qvel *= keep
        if not np.isfinite(data.qvel).all() or np.abs(_linear(data.qvel)).max(initial=0) > MAX_SPEED:
            raise RejectedScene("exploded")
    return Trajectory(tuple(frames), np.stack(poses))


def _check(model: Any, data: Any) -> None:
    if data.ncon and float(data.contact.dist[: data.ncon].min()) < -MAX_SINK:
        raise RejectedScene("sank in")
    positions = data.xpos[1:]
    if len(positions) and (np.linalg.norm(positions[:, :2], axis=1).max() > MAX_DISTANCE or positions[:, 2].min() < 0):
        raise RejectedScene("left the scene")


def _poses(model: Any, data: Any) -> NDArray[np.float64]:
    poses = np.tile(np.eye(4), (model.nbody - 1, 1, 1))
    poses[:, :3, :3] = data.xmat[1:].reshape(-1, 3, 3)
    poses[:, :3, 3] = data.xpos[1:]
    return poses


def _linear(qvel: NDArray[np.float64]) -> NDArray[np.float64]:
    return qvel.reshape(-1, 6)[:, :3]
