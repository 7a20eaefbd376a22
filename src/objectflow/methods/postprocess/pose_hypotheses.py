"""Hypotheses about an object's motion: many at once, perturbed and thinned out."""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow import geometry
from objectflow.typing import Float64Array, IndexArray


@dataclasses.dataclass(frozen=True, eq=False)
class PoseHypotheses:
    """Hypotheses about an object's motion.

    Attributes:
        rotations: (K, 3, 3) `prev_R_curr`.
        positions: (K, 3) metres: position of the object's centre in the previous frame.
    """

    rotations: Float64Array
    positions: Float64Array

    def take(self, index: IndexArray) -> PoseHypotheses:
        """Some of them."""
        return PoseHypotheses(self.rotations[index], self.positions[index])

    def __add__(self, other: PoseHypotheses) -> PoseHypotheses:
        return PoseHypotheses(
            np.concatenate([self.rotations, other.rotations]), np.concatenate([self.positions, other.positions])
        )


def perturb(
    hypotheses: PoseHypotheses, number: int, angle: float, shift: float, random: np.random.Generator
) -> PoseHypotheses:
    """About `number` hypotheses, rotated and shifted at random with standard deviations in radians and metres."""
    times = max(1, number // len(hypotheses.rotations))
    index = np.repeat(np.arange(len(hypotheses.rotations)), times)
    turns = geometry.so3_exp(random.normal(size=(len(index), 3)) * angle / np.sqrt(3))
    shifts = random.normal(size=(len(index), 3)) * shift
    return PoseHypotheses(turns @ hypotheses.rotations[index], hypotheses.positions[index] + shifts)


def suppress_duplicates(
    hypotheses: PoseHypotheses, cost: Float64Array, count: int, angle: float, shift: float
) -> IndexArray:
    """Indices of the cheapest hypotheses, no two of which lie within both `angle` (radians) and `shift` (metres)."""
    order = np.argsort(cost, kind="stable")[: 6 * count]
    rotations = hypotheses.rotations[order].reshape(len(order), 9)
    positions = hypotheses.positions[order] - hypotheses.positions[order[:1]]  # near 0, for exact distances
    squares = np.square(positions).sum(axis=1)
    distances = squares[:, None] + squares - 2 * positions @ positions.T
    near = (distances <= shift**2) & (rotations @ rotations.T >= 1 + 2 * np.cos(angle))
    left = np.ones(len(order), bool)
    kept: list[int] = []
    while left.any() and len(kept) < count:
        best = int(left.argmax())
        kept.append(int(order[best]))
        left &= ~near[best]
        left[best] = False
    return np.array(kept, dtype=np.intp)
