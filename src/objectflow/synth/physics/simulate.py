"""Simulate the fall of a scene's objects, and reject simulations that are unusable as data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from objectflow.errors import DatasetError, ObjectflowError
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics import bullet_engine, mujoco_engine
from objectflow.synth.physics.recording import FRAME, Recording
from objectflow.synth.scenes.scene_data import Scene
from objectflow.typing import BoolMask, Float64Array

Engine = Literal["mujoco", "bullet"]
_ENGINES: dict[str, Callable[[Scene, Sequence[ObjectModel], int], Recording]] = {
    "mujoco": mujoco_engine.record,
    "bullet": bullet_engine.record,
}

PAIR_FRAMES = (20, 80)
"""Frames of a pair, at 60 Hz (section IV-A)."""
SEQUENCE_FRAMES = (20, 30, 40, 50, 60, 70, 80, 90)
"""Frames of a sequence, at 60 Hz."""

MAX_OFFSET = 1.0
"""Maximum horizontal coordinate of an object, metres; no camera covers objects further away."""
MAX_PENETRATION = 0.006
"""Maximum penetration in a frame that is used, metres; the soft contacts of a hard impact reach half of it."""
MAX_ENERGY_GAIN = 0.02
"""Maximum rise of the energy between two frames, as a share of the initial energy."""
MAX_SPEED = 4.0
"""Maximum speed, m/s: that of a fall from 0.8 m."""
JITTER_STEP = 0.0005
"""Minimum displacement per frame at which a reversal of direction counts as jitter, metres."""
JITTER_WINDOW = 15
"""Length of the window in which reversals are counted, frames."""
JITTER_REVERSALS = 8
"""Number of reversals within the window that make an object jitter; rocking and bouncing objects have fewer."""


class RejectedSceneError(ObjectflowError):
    """A scene that is unusable as data and must be drawn again.

    Attributes:
        reason: one word for statistics, for example "escapes", "sinks", "explodes" or "jitters".
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The objects' poses at the requested frames.

    Attributes:
        frames: frame numbers at 60 Hz; frame 0 is the start.
        world_T_object: (F, N, 4, 4) float64, metres.
        penetration: deepest penetration at any of the frames, metres.
        energy_gain: largest rise of the energy from one frame to the next, as a share of the initial energy.
    """

    frames: tuple[int, ...]
    world_T_object: Float64Array
    penetration: float
    energy_gain: float


def simulate(
    scene: Scene, models: Sequence[ObjectModel], frames: Sequence[int] = PAIR_FRAMES, engine: Engine = "mujoco"
) -> Trajectory:
    """Simulate the fall of a scene's objects.

    Friction is 1, linear damping 0.9 and angular damping 0.8, as in the paper's simulation with Bullet, whose damping
    multiplies velocities by (1 - d)^dt in every step; gravity is 9.81 m/s^2, and there are 60 frames per second.

    Args:
        scene: start poses and surroundings.
        models: of the scene's objects, in order.
        frames: frame numbers in increasing order, from 0.
        engine: "mujoco", or "bullet", the engine of the paper.

    Raises:
        RejectedSceneError: an object escapes, sinks in or jitters, or the energy rises.
        MissingExtraError: the engine is not installed.
        DatasetError: frames that do not increase, or an unknown engine.
    """
    if not frames or min(frames) < 0 or list(frames) != sorted(set(frames)):
        raise DatasetError(f"frames must rise from 0, not {list(frames)}")
    if engine not in _ENGINES:
        raise DatasetError(f"there is no physics engine {engine!r}: choose mujoco or bullet")
    recording = _ENGINES[engine](scene, models, frames[-1])
    return check_recording(recording, tuple(frames))


def check_recording(recording: Recording, frames: tuple[int, ...]) -> Trajectory:
    """Check a recording and return the given frames of it.

    Raises:
        RejectedSceneError: the recording is unusable.
    """
    poses, first = recording.world_T_object, frames[0]
    penetration = float(recording.penetration[list(frames)].max())
    scale = max(float(np.abs(recording.energy[0])), 1e-9)
    gain = float(np.diff(recording.energy).max(initial=0.0)) / scale
    position = poses[..., :3, 3]
    if not np.isfinite(poses).all():
        raise RejectedSceneError("explodes", "the simulation does not stay finite")
    speed = top_speed(position)
    if gain > MAX_ENERGY_GAIN or speed > MAX_SPEED:
        raise RejectedSceneError("explodes", f"energy rises by {gain:.1%} of the start's; top speed {speed:.1f} m/s")
    if float(np.abs(position[..., :2]).max()) > MAX_OFFSET or float(position[..., 2].min()) < 0:
        raise RejectedSceneError("escapes", f"an object is more than {MAX_OFFSET} m away, or below the floor")
    if penetration > MAX_PENETRATION:
        raise RejectedSceneError("sinks", f"an object is {1000 * penetration:.1f} mm inside another or the floor")
    jittering = int(_jitters(position[first:]).sum())
    if jittering:
        raise RejectedSceneError("jitters", f"{jittering} objects jitter")
    return Trajectory(frames, poses[list(frames)], penetration, gain)


def top_speed(position: Float64Array) -> float:
    """Highest speed in m/s between consecutive frames of positions (L + 1, N, 3) in metres."""
    return float(np.linalg.norm(np.diff(position, axis=0), axis=-1).max(initial=0.0) / FRAME)


def _jitters(position: Float64Array) -> BoolMask:
    """(N,) which objects reverse their direction from frame to frame within some window of (F, N, 3) positions."""
    steps = np.diff(position, axis=0)
    far = np.linalg.norm(steps, axis=-1) > JITTER_STEP
    reversed_ = (np.einsum("fnd,fnd->fn", steps[1:], steps[:-1]) < 0) & far[1:] & far[:-1]
    if len(reversed_) < JITTER_WINDOW:
        return np.zeros(position.shape[1], dtype=bool)
    total = np.concatenate([np.zeros((1, reversed_.shape[1]), dtype=np.int64), np.cumsum(reversed_, axis=0)])
    return np.asarray((total[JITTER_WINDOW:] - total[:-JITTER_WINDOW] >= JITTER_REVERSALS).any(axis=0))
