"""The '+Refine' step: objects' motions aligned with the depth and the colour of the previous frame."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from objectflow import rigid
from objectflow.averaging import moves
from objectflow.frame import RgbdFrame
from objectflow.instances import nearest
from objectflow.motion import ObjectMotion
from objectflow.noise import depth_sigma

WIDTH = 640
"""Pixels: wider frames are narrowed to it first. More adds time, no exactness that the depth would bear."""
POINTS = 2000
"""Of each object at most, spread evenly."""


def refine_objects(
    prev: RgbdFrame, curr: RgbdFrame, labels: NDArray[np.int32], objects: tuple[ObjectMotion, ...]
) -> tuple[ObjectMotion, ...]:
    """Refine each object's motion from where it stands; see `rigid.refine`.

    A motion that explains the previous depth worse than the one that it started from is dropped, so that no object's
    truncated depth error grows.

    Args:
        prev, curr: the frames, of one size.
        labels: (H, W) int32 on their pixels.
        objects: with the motions to start from.

    Returns:
        The same objects with refined `prev_T_curr`, and `moving` decided anew; centres and scores stay.
    """
    if not objects:
        return ()
    if curr.camera.width > WIDTH:
        height = max(1, round(curr.camera.height * WIDTH / curr.camera.width))
        rows, columns = nearest(labels.shape, (height, WIDTH))
        labels = labels[rows[:, None], columns]
        prev, curr = prev.resized(WIDTH, height), curr.resized(WIDTH, height)
    target = rigid.Target(prev)
    out = []
    for obj in objects:
        source = rigid.make_source(curr, labels == obj.id, limit=POINTS)
        motion = refine_one(target, source, obj.prev_T_curr)
        refined = dataclasses.replace(obj, prev_T_curr=motion)
        out.append(dataclasses.replace(refined, moving=bool(moves(motion[:3, :3], refined.translation))))
    return tuple(out)


def refine_one(target: rigid.Target, source: rigid.Source, start: NDArray[np.float64]) -> NDArray[np.float64]:
    """The refined motion if it explains the depth at least as well as `start`, else `start`."""
    if not len(source.points):
        return start
    refined = rigid.refine(target, source, start)
    before = rigid.judge(target, source, start)
    better = np.isfinite(refined.prev_T_curr).all() and depth_cost(refined, source) <= depth_cost(before, source)
    return refined.prev_T_curr if better else start


def depth_cost(found: rigid.Refined, source: rigid.Source) -> float:
    """Mean over the points of the squared distance to the previous surface, in metres squared, truncated at 3 sigma.

    Points that the previous frame does not see count as much as those that it contradicts: else a motion would win by
    hiding what it cannot explain.
    """
    limit = 9 * float(depth_sigma(np.array(np.median(source.points[:, 2])))) ** 2
    share = found.explained * found.visible
    return limit if share == 0 else share * min(found.depth_error**2, limit) + (1 - share) * limit
