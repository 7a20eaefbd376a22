"""Selection of two frames of a recording between which every object either clearly moves or stands still.

`geometry.moved.is_moving` compares a motion with one tolerance. Selection leaves a gap between static and moving
objects instead: the mean displacement of an object's surface is compared with two limits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from objectflow.geometry.symmetry import reduce_motion
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics.recording import Recording
from objectflow.synth.physics.simulate import MAX_PENETRATION
from objectflow.typing import BoolMask, Float64Array

MAX_STATIC_DISPLACEMENT = 0.0025
"""Maximum mean displacement of a static object's surface, metres. Its pose is then made exactly constant."""
MIN_MOVING_DISPLACEMENT = 0.005
"""Minimum mean displacement of a moving object's surface after symmetry reduction, metres. No pair contains an object
between the two limits."""
MAX_TRIES = 24
"""Number of frame pairs that are tried."""
SURFACE_POINTS = 60
"""Approximate number of vertices over which displacements are averaged."""


@dataclass(frozen=True, eq=False)
class SelectedFrames:
    """Two frames of a scene.

    Attributes:
        prev, curr: frame numbers.
        world_T_object: (2, N, 4, 4) metres; static objects have the same pose twice.
        moving: (N,) bool.
    """

    prev: int
    curr: int
    world_T_object: Float64Array
    moving: BoolMask


def select_frames(
    rng: np.random.Generator,
    recording: Recording,
    models: Sequence[ObjectModel],
    scales: Sequence[float],
    *,
    gap: tuple[int, int],
    movers: tuple[int, int],
    least_motion: float = MIN_MOVING_DISPLACEMENT,
    most_rest: float = MAX_STATIC_DISPLACEMENT,
) -> SelectedFrames | None:
    """Select two frames; gaps are log-uniformly distributed. None if `MAX_TRIES` tries fail.

    Args:
        rng: source of randomness.
        recording: of the scene.
        models, scales: of the scene's objects.
        gap: minimum and maximum number of frames between the two.
        movers: minimum and maximum number of moving objects. (0, 0) selects the first frame twice.
        least_motion: see `MIN_MOVING_DISPLACEMENT`, metres; it may differ for scenes of another scale.
        most_rest: see `MAX_STATIC_DISPLACEMENT`, metres.
    """
    poses = recording.world_T_object
    if movers[1] == 0:
        return SelectedFrames(0, 0, poses[[0, 0]], np.zeros(poses.shape[1], np.bool_))
    clouds = [_surface_points(model, scale) for model, scale in zip(models, scales, strict=True)]
    last = len(poses) - 1
    for _ in range(MAX_TRIES):
        frames = min(last, round(math.exp(rng.uniform(math.log(gap[0]), math.log(gap[1])))))
        prev = int(rng.integers(0, last - frames + 1))
        pair = poses[[prev, prev + frames]].copy()
        displacement = np.array([_mean_displacement(cloud, *pair[:, k]) for k, cloud in enumerate(clouds)])
        moving, static = displacement >= least_motion, displacement < most_rest
        if not movers[0] <= moving.sum() <= movers[1] or not (moving | static).all():
            continue
        if max(recording.penetration[prev], recording.penetration[prev + frames]) > MAX_PENETRATION:
            continue
        if any(
            _reduced_displacement(clouds[k], pair[0, k], pair[1, k], models[k]) < least_motion
            for k in map(int, np.flatnonzero(moving))
        ):
            continue
        pair[1, static] = pair[0, static]
        return SelectedFrames(prev, prev + frames, pair, moving)
    return None


def _surface_points(model: ObjectModel, scale: float) -> Float64Array:
    return np.asarray(model.vertices[:: max(1, len(model.vertices) // SURFACE_POINTS)] * scale)


def _mean_displacement(cloud: Float64Array, prev: Float64Array, curr: Float64Array) -> float:
    """Mean distance in metres between the positions of points (P, 3) in two poses (4, 4)."""
    moved = cloud @ (prev[:3, :3] - curr[:3, :3]).T + prev[:3, 3] - curr[:3, 3]
    return float(np.linalg.norm(moved, axis=1).mean())


def _reduced_displacement(cloud: Float64Array, prev: Float64Array, curr: Float64Array, model: ObjectModel) -> float:
    """The same for the symmetry-reduced motion: a ball that spins in place appears static."""
    if not model.symmetry:
        return math.inf
    reduced = prev.copy()
    reduced[:3, :3] = reduce_motion(prev[:3, :3], curr[:3, :3], model.symmetry) @ curr[:3, :3]
    return _mean_displacement(cloud, reduced, curr)
