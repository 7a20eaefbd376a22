"""Boxes hung close together in the air, none touching another: where a scene's objects start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.typing import Float64Array

CLEARANCE = 0.002
"""Metres that boxes keep from each other."""


@dataclass(frozen=True, eq=False)
class Box:
    """An oriented box in the world."""

    center: Float64Array
    """(3,) metres."""
    axes: Float64Array
    """(3, 3) rotation; its columns are the box's axes."""
    half: Float64Array
    """(3,) half its sides, metres."""

    @property
    def reach_down(self) -> float:
        """Metres from the centre down to the lowest corner."""
        return float(np.abs(self.axes[2]) @ self.half)


def hang(
    rng: np.random.Generator, axes: Float64Array, half: Float64Array, lowest: float, radius: float, tries: int
) -> Float64Array:
    """Find places for boxes in turn: each as low as it can hang, at the best of a few random points of a disc.

    Args:
        axes: (N, 3, 3) orientations, `world_R_box`.
        half: (N, 3) half sides, metres.
        lowest: height that no corner is below.
        radius: of the disc.
        tries: points a box is tried at.

    Returns:
        (N, 3) centres of the boxes.
    """
    placed: list[Box] = []
    for box_axes, box_half in zip(axes, half + CLEARANCE / 2, strict=True):
        best: Box | None = None
        for _ in range(tries):
            angle, distance = rng.uniform(0, 2 * np.pi), radius * np.sqrt(rng.random())
            box = Box(np.array([distance * np.cos(angle), distance * np.sin(angle), 0.0]), box_axes, box_half)
            box.center[2] = lowest + box.reach_down
            box.center[2] += _lift(box, placed)
            if best is None or box.center[2] < best.center[2]:
                best = box
        if best is not None:
            placed.append(best)
    return np.stack([box.center for box in placed])


def _lift(box: Box, placed: list[Box]) -> float:
    """The least way up, from 0, at which the box meets none of the others."""
    if not placed:
        return 0.0
    low, high = meeting_heights(
        box,
        np.stack([b.center for b in placed]),
        np.stack([b.axes for b in placed]),
        np.stack([b.half for b in placed]),
    )
    lift = 0.0
    for i in np.argsort(low):
        # Sorted, so that once there is a gap above `lift`, no later stretch begins in it.
        if low[i] < lift + 1e-12 < high[i]:
            lift = float(high[i])
    return lift


def meeting_heights(
    box: Box, centers: Float64Array, axes: Float64Array, half: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """For which lifts along z a box meets each of M others: the stretches (low, high), both +inf where never.

    Two boxes are apart if and only if they are along one of 15 axes (Gottschalk, Lin and Manocha, SIGGRAPH 1996).
    Along each, they meet for one stretch of lifts; in space they meet for the lifts that all 15 share.
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
    # Along a level direction the lift changes nothing: apart for all lifts, or for none. (Edges that are parallel
    # cross to 0 and separate nothing.)
    apart = flat & (np.abs(offset) >= reach) & (np.linalg.norm(directions, axis=-1) > 1e-9)
    low = np.where(flat, -np.inf, np.minimum(a, b)).max(axis=1)
    high = np.where(flat, np.inf, np.maximum(a, b)).min(axis=1)
    never = apart.any(axis=1) | (low >= high)
    return np.where(never, np.inf, low), np.where(never, np.inf, high)
