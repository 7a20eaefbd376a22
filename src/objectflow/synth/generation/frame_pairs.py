"""Which two frames of a recording make a pair in which every object either moves or stands still."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from objectflow.geometry.symmetry import reduce_motion
from objectflow.synth.objects.model import ObjectModel
from objectflow.synth.physics.recording import Recording
from objectflow.synth.physics.simulate import MAX_DEPTH
from objectflow.typing import BoolMask, Float64Array

MIN_DISPLACEMENT = 0.0025
"""Metres, mean over an object's surface: who moves less is put exactly where it was."""
MOVED = 0.005
"""Metres: who moves further, its symmetry taken off, counts as moving. Between the two lies what no pair may show."""
TRIES = 24
POINTS = 60


@dataclass(frozen=True, eq=False)
class FramePairChoice:
    """Two frames of a scene.

    Attributes:
        prev, curr: their numbers.
        world_T_object: (2, N, 4, 4) metres; what stands still has the same pose twice.
        moves: (N,) bool.
    """

    prev: int
    curr: int
    world_T_object: Float64Array
    moves: BoolMask


def pick_moment(
    rng: np.random.Generator,
    recording: Recording,
    models: Sequence[ObjectModel],
    scales: Sequence[float],
    *,
    gap: tuple[int, int],
    movers: tuple[int, int],
) -> FramePairChoice | None:
    """Find two frames; gaps are drawn evenly in their logarithm. None if a number of tries finds none.

    Args:
        rng: chance.
        recording: of the scene.
        models, scales: of its objects.
        gap: frames between the two, from and to.
        movers: how many objects may move, from and to. (0, 0) takes one frame twice, the first.
    """
    poses = recording.world_T_object
    if movers[1] == 0:
        return FramePairChoice(0, 0, poses[[0, 0]], np.zeros(poses.shape[1], np.bool_))
    clouds = [_points(model, scale) for model, scale in zip(models, scales, strict=True)]
    last = len(poses) - 1
    for _ in range(TRIES):
        frames = min(last, round(math.exp(rng.uniform(math.log(gap[0]), math.log(gap[1])))))
        prev = int(rng.integers(0, last - frames + 1))
        pair = poses[[prev, prev + frames]].copy()
        raw = np.array([_shift(cloud, *pair[:, k]) for k, cloud in enumerate(clouds)])
        moves, still = raw >= MOVED, raw < MIN_DISPLACEMENT
        if not movers[0] <= moves.sum() <= movers[1] or not (moves | still).all():
            continue
        if max(recording.depth[prev], recording.depth[prev + frames]) > MAX_DEPTH:
            continue
        if any(
            _reduced_shift(clouds[k], pair[0, k], pair[1, k], models[k]) < MOVED
            for k in map(int, np.flatnonzero(moves))
        ):
            continue
        pair[1, still] = pair[0, still]
        return FramePairChoice(prev, prev + frames, pair, moves)
    return None


def _points(model: ObjectModel, scale: float) -> Float64Array:
    return np.asarray(model.vertices[:: max(1, len(model.vertices) // POINTS)] * scale)


def _shift(cloud: Float64Array, prev: Float64Array, curr: Float64Array) -> float:
    """Metres between where points are in two poses, on average."""
    moved = cloud @ (prev[:3, :3] - curr[:3, :3]).T + prev[:3, 3] - curr[:3, 3]
    return float(np.linalg.norm(moved, axis=1).mean())


def _reduced_shift(cloud: Float64Array, prev: Float64Array, curr: Float64Array, model: ObjectModel) -> float:
    """The same for the least motion that looks like it: a ball that spins on the spot does not seem to move."""
    if not model.symmetry:
        return math.inf
    reduced = prev.copy()
    reduced[:3, :3] = reduce_motion(prev[:3, :3], curr[:3, :3], model.symmetry) @ curr[:3, :3]
    return _shift(cloud, reduced, curr)
