"""Start poses of a scene's objects: their boxes are placed close together in the air without touching each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from objectflow.synth.objects.model import ObjectModel
from objectflow.typing import Float64Array

CLEARANCE = 0.002
"""Minimum distance between two boxes, metres."""


@dataclass(frozen=True, eq=False)
class Box:
    """An oriented box in the world frame."""

    center: Float64Array
    """(3,) metres."""
    axes: Float64Array
    """(3, 3) rotation; its columns are the box's axes."""
    half: Float64Array
    """(3,) half its side lengths, metres."""

    @property
    def center_height(self) -> float:
        """Height of the centre above the lowest corner, metres."""
        return float(np.abs(self.axes[2]) @ self.half)


def bounding_boxes(models: Sequence[ObjectModel], scales: Sequence[float]) -> tuple[Float64Array, Float64Array]:
    """Axis-aligned boxes in the object frames, metres: (N, 3) centres and (N, 3) half side lengths."""
    low = np.stack([model.vertices.min(axis=0) * scale for model, scale in zip(models, scales, strict=True)])
    high = np.stack([model.vertices.max(axis=0) * scale for model, scale in zip(models, scales, strict=True)])
    return (high + low) / 2, (high - low) / 2


def covered_radius(half: Float64Array) -> float:
    """Radius in metres of a disc with the area of all boxes (N, 3) laid side by side on their largest faces."""
    sides = np.sort(2 * half, axis=1)
    return math.sqrt(float((sides[:, 1] * sides[:, 2]).sum()) / math.pi)


def place_objects(
    rng: np.random.Generator,
    rotations: Float64Array,
    boxes: tuple[Float64Array, Float64Array],
    lowest: float,
    radius: float,
    tries: int,
) -> Float64Array:
    """Place objects above a disc so that their boxes do not touch.

    Args:
        rng: source of randomness.
        rotations: (N, 3, 3) `world_R_object`.
        boxes: the objects' boxes; see `bounding_boxes`.
        lowest, radius, tries: see `place_boxes`.

    Returns:
        (N, 3) positions of the object frames' origins in the world, metres.
    """
    center, half = boxes
    centers = place_boxes(rng, rotations, half, lowest, radius, tries)
    return np.asarray(centers - np.einsum("nij,nj->ni", rotations, center))


def place_boxes(
    rng: np.random.Generator, axes: Float64Array, half: Float64Array, lowest: float, radius: float, tries: int
) -> Float64Array:
    """Place boxes one after the other, each as low as possible at the best of several random points of a disc.

    Args:
        rng: source of randomness.
        axes: (N, 3, 3) orientations, `world_R_box`.
        half: (N, 3) half side lengths, metres.
        lowest: minimum height of any corner, metres.
        radius: radius of the disc, metres.
        tries: number of points tried per box.

    Returns:
        (N, 3) centres of the boxes, metres.
    """
    placed: list[Box] = []
    for box_axes, box_half in zip(axes, half + CLEARANCE / 2, strict=True):
        best: Box | None = None
        for _ in range(tries):
            angle, distance = rng.uniform(0, 2 * np.pi), radius * np.sqrt(rng.random())
            box = Box(np.array([distance * np.cos(angle), distance * np.sin(angle), 0.0]), box_axes, box_half)
            box.center[2] = lowest + box.center_height
            box.center[2] += _free_lift(box, placed)
            if best is None or box.center[2] < best.center[2]:
                best = box
        if best is not None:
            placed.append(best)
    return np.stack([box.center for box in placed])


def _free_lift(box: Box, placed: list[Box]) -> float:
    """The smallest lift, from 0, at which the box overlaps none of the others."""
    if not placed:
        return 0.0
    low, high = overlapping_lifts(
        box,
        np.stack([b.center for b in placed]),
        np.stack([b.axes for b in placed]),
        np.stack([b.half for b in placed]),
    )
    lift = 0.0
    for i in np.argsort(low):
        # The intervals are sorted: once there is a gap above `lift`, no later interval starts within it.
        if low[i] < lift + 1e-12 < high[i]:
            lift = float(high[i])
    return lift


def overlapping_lifts(
    box: Box, centers: Float64Array, axes: Float64Array, half: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """The intervals of lifts along z at which a box overlaps each of M others.

    Two boxes are disjoint if and only if they are separated along one of 15 axes (Gottschalk, Lin and Manocha,
    SIGGRAPH 1996). The overlap along each axis is one interval of lifts; the boxes overlap in their intersection.

    Args:
        box: the box that is lifted.
        centers: (M, 3) of the others, metres.
        axes: (M, 3, 3) of the others, `world_R_box`.
        half: (M, 3) of the others, metres.

    Returns:
        (M,) lower and (M,) upper ends in metres; both are +inf where the boxes never overlap.
    """
    count = len(centers)
    crossed = np.cross(axes.swapaxes(1, 2)[:, :, None], box.axes.T[None, None]).reshape(count, 9, 3)
    own = np.broadcast_to(box.axes.T, (count, 3, 3))
    directions = np.concatenate([axes.swapaxes(1, 2), own, crossed], axis=1)
    reach = np.einsum("mki,mi->mk", np.abs(directions @ axes), half) + np.abs(directions @ box.axes) @ box.half
    offset = np.einsum("mkd,md->mk", directions, box.center - centers)
    slope = directions[..., 2]
    flat = np.abs(slope) < 1e-9
    safe = np.where(flat, 1.0, slope)
    a, b = (-reach - offset) / safe, (reach - offset) / safe
    # Along a horizontal direction the lift has no effect: the boxes are separated for all lifts or for none.
    # The cross product of parallel edges is 0 and separates nothing.
    apart = flat & (np.abs(offset) >= reach) & (np.linalg.norm(directions, axis=-1) > 1e-9)
    low = np.where(flat, -np.inf, np.minimum(a, b)).max(axis=1)
    high = np.where(flat, np.inf, np.maximum(a, b)).min(axis=1)
    never = apart.any(axis=1) | (low >= high)
    return np.where(never, np.inf, low), np.where(never, np.inf, high)
