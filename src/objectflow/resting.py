"""What moved and what did not: each object's motion against standing still, by what the previous frame shows.

A network is never wholly still: where depth is noisy, or where something else was lifted away, it says that things
moved a little. The frames can refute that.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.averaging import moves
from objectflow.consensus.cost import COST_FLOATING, Look, motion_cost
from objectflow.frame import RgbdFrame
from objectflow.instances import nearest
from objectflow.motion import ObjectMotion

Labels = NDArray[np.int32]

WIDTH = 320
"""Pixels: wider frames are narrowed to it; what is asked are means over objects."""
GAIN = 0.2
"""Mean log-likelihood a pixel that a motion has to win over standing still."""
FITS = 1.0
"""Cost up to which a pixel is explained."""
STANDS = 0.2
"""Share of an object's pixels that standing still explains: with as many it does not speak against it."""
IMPOSSIBLE = 0.02
"""Share of the pixels that, standing still, would hang in front of what was seen: a few do at any depth edge."""
SURE = 0.6
"""Probability of an object from which the network is believed where the frames say nothing."""


class Evidence(NamedTuple):
    """What the previous frame says of one object.

    Attributes:
        gain: mean log-likelihood of a pixel under the object's motion, less that of standing still.
        stands: share of the pixels that standing still explains.
        impossible: share of the pixels that, had they stood still, would hang in front of what was seen.
    """

    gain: float
    stands: float
    impossible: float

    def moved(self, score: float) -> bool:
        """Whether the object moved.

        It did if its motion explains it better than standing still does. A wrong motion explains nothing; then it
        moved if it cannot have stood still, or, if it would merely have been hidden, by the network's word: what was
        lifted away leaves hidden things behind that never moved.

        Args:
            score: 0..1, how sure the network is.
        """
        if self.gain > GAIN:
            return True
        return self.stands < STANDS and (self.impossible > IMPOSSIBLE or score > SURE)


def bring_to_rest(
    prev: RgbdFrame, curr: RgbdFrame, labels: Labels, objects: tuple[ObjectMotion, ...]
) -> tuple[ObjectMotion, ...]:
    """Give objects that stand still, as far as the frames can tell, the identity for a motion, and say so.

    Args:
        prev, curr: the frames, of one size, of a camera that stands still.
        labels: (H, W) int32 on their pixels.
        objects: with their final motions.

    Returns:
        The same objects. `moving` is decided anew: by the motion's size, and by `Evidence`.
    """
    if not objects:
        return ()
    if curr.camera.width > WIDTH:
        height = max(1, round(curr.camera.height * WIDTH / curr.camera.width))
        rows, columns = nearest(labels.shape, (height, WIDTH))
        labels = labels[rows[:, None], columns]
        prev, curr = prev.resized(WIDTH, height), curr.resized(WIDTH, height)
    points = geometry.back_project(curr.depth, curr.camera)
    looks = Look(prev.color), Look(curr.color)
    still = motion_cost(prev, points, np.eye(4), looks)[0]
    out = []
    for obj in objects:
        moving = bool(moves(obj.prev_T_curr[:3, :3], obj.translation))
        motion = obj.prev_T_curr
        if moving:
            seen = evidence(prev, points, looks, still, (labels == obj.id) & curr.valid, motion)
            moving = seen is None or seen.moved(obj.score)
            motion = motion if moving else np.eye(4)
        out.append(dataclasses.replace(obj, prev_T_curr=motion, moving=moving))
    return tuple(out)


def evidence(
    prev: RgbdFrame,
    points: NDArray[np.float32],
    looks: tuple[Look, Look],
    still: NDArray[np.float32],
    mask: NDArray[np.bool_],
    prev_T_curr: NDArray[np.float64],
) -> Evidence | None:
    """The evidence on one object; None where its mask is empty.

    Args:
        prev: the previous frame.
        points: (H, W, 3) metres, of the current frame.
        looks: of the previous and the current frame.
        still: (H, W) `motion_cost` of the identity.
        mask: (H, W) bool: the object's pixels with depth.
        prev_T_curr: its motion.
    """
    rows, columns = np.nonzero(mask)
    if not len(rows):
        return None
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    cost = motion_cost(prev, points, prev_T_curr, looks, box)[0][mask[box]]
    at_rest = still[mask]
    return Evidence(
        gain=float((at_rest - cost).mean()),
        stands=float((at_rest < FITS).mean()),
        impossible=float((at_rest >= COST_FLOATING).mean()),
    )
