"""Objects fall, collide and slide: their poses frame by frame, and what makes a simulation not worth keeping."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from objectflow.errors import DatasetError, ObjectflowError
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics.recording import Recording
from objectflow.synth.scenes.scene_data import Scene
from objectflow.typing import BoolMask, Float64Array

Engine = Literal["mujoco", "bullet"]

PAIR_FRAMES = (20, 80)
"""Of a pair, at 60 Hz (section IV-A)."""
SEQUENCE_FRAMES = (20, 30, 40, 50, 60, 70, 80, 90)
"""Of a sequence."""

REACH = 1.0
"""Metres from the scene's centre, to the side, that no object may be; no camera sees it there."""
MAX_DEPTH = 0.006
"""Metres that one thing may be inside another at a frame that is kept; soft contacts of a hard hit come to half."""
MAX_GAIN = 0.02
"""Share of the scene's energy at the start that may come from nowhere between two frames."""
MAX_SPEED = 4.0
"""Metres a second: a fall from 0.8 m ends at this speed."""
SHAKE = 0.0005
"""Metres a frame that an object must move for a change of direction to count as shaking."""
SHAKES = 8
"""Changes of direction within a quarter of a second, 15 frames, that nothing which rocks or bounces comes to."""


class RejectedSceneError(ObjectflowError):
    """A simulation that must not become data; draw the scene anew.

    Attributes:
        reason: one word, to be counted: "escapes", "sinks", "explodes" or "jitters".
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The objects' poses at the frames that were asked for.

    Attributes:
        frames: their numbers, at 60 Hz; frame 0 is the start.
        world_T_object: (F, N, 4, 4) float64, metres.
        depth: deepest penetration at any of the frames, in metres.
        gain: largest rise of the energy from one frame to the next, as a share of that at the start.
    """

    frames: tuple[int, ...]
    world_T_object: Float64Array
    depth: float
    gain: float

    @property
    def displacement(self) -> Float64Array:
        """(N,) metres between where each object's centre is at the first frame and at the last."""
        return np.asarray(
            np.linalg.norm(self.world_T_object[-1, :, :3, 3] - self.world_T_object[0, :, :3, 3], axis=-1)
        )


def simulate(
    scene: Scene, models: Sequence[ObjectModel], frames: Sequence[int] = PAIR_FRAMES, engine: Engine = "mujoco"
) -> Trajectory:
    """Let a scene's objects fall and give their poses.

    Friction 1, linear damping 0.9 and angular damping 0.8, as in the paper's simulation with Bullet, whose damping
    multiplies velocities by (1 - d)^dt every step; gravity 9.81 m/s^2; 60 frames a second.

    Args:
        scene: where they start.
        models: of its objects, in order.
        frames: rising numbers from 0.
        engine: "mujoco", or "bullet", which the paper used.

    Raises:
        RejectedSceneError: an object leaves, sinks in, or jitters, or energy comes from nowhere.
        MissingExtraError: the engine is not installed.
        DatasetError: frames that do not rise, or an unknown engine.
    """
    if not frames or min(frames) < 0 or list(frames) != sorted(set(frames)):
        raise DatasetError(f"frames must rise from 0, not {list(frames)}")
    recording = _find_engine(engine)(scene, models, frames[-1])
    return check(recording, tuple(frames))


def check(recording: Recording, frames: tuple[int, ...]) -> Trajectory:
    """Pick the frames of a recording that is sound.

    Raises:
        RejectedSceneError: it is not.
    """
    poses, first = recording.world_T_object, frames[0]
    depth = float(recording.depth[list(frames)].max())
    scale = max(float(np.abs(recording.energy[0])), 1e-9)
    gain = float(np.diff(recording.energy).max(initial=0.0)) / scale
    position = poses[..., :3, 3]
    if not np.isfinite(poses).all():
        raise RejectedSceneError("explodes", "the simulation does not stay finite")
    speed = float(np.linalg.norm(np.diff(position, axis=0), axis=-1).max(initial=0.0)) * 60
    if gain > MAX_GAIN or speed > MAX_SPEED:
        raise RejectedSceneError("explodes", f"energy rises by {gain:.1%} of the start's; top speed {speed:.1f} m/s")
    if float(np.abs(position[..., :2]).max()) > REACH or float(position[..., 2].min()) < 0:
        raise RejectedSceneError("escapes", f"an object is more than {REACH} m away, or below the floor")
    if depth > MAX_DEPTH:
        raise RejectedSceneError("sinks", f"an object is {1000 * depth:.1f} mm inside another or the floor")
    shaking = int(_jitters(position[first:]).sum())
    if shaking:
        raise RejectedSceneError("jitters", f"{shaking} objects shake where they lie")
    return Trajectory(frames, poses[list(frames)], depth, gain)


def _jitters(position: Float64Array) -> BoolMask:
    """(N,) which objects go to and fro from frame to frame, at any time."""
    window = 15
    steps = np.diff(position, axis=0)
    far = np.linalg.norm(steps, axis=-1) > SHAKE
    back = (np.einsum("fnd,fnd->fn", steps[1:], steps[:-1]) < 0) & far[1:] & far[:-1]
    if len(back) < window:
        return np.zeros(position.shape[1], dtype=bool)
    total = np.concatenate([np.zeros((1, back.shape[1]), dtype=np.int64), np.cumsum(back, axis=0)])
    return np.asarray((total[window:] - total[:-window] >= SHAKES).any(axis=0))


def _find_engine(engine: str) -> Callable[[Scene, Sequence[ObjectModel], int], Recording]:
    if engine == "mujoco":
        from objectflow.synth.physics.mujoco_engine import record

        return record
    if engine == "bullet":
        from objectflow.synth.physics.bullet_engine import record as record_with_bullet

        return record_with_bullet
    raise DatasetError(f"there is no physics engine {engine!r}: choose mujoco or bullet")
