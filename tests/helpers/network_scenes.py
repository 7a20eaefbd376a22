"""Analytic scenes with holes in their depth, and before a static and a moving camera."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import analytic


@cache
def scene(width: int = 160, height: int = 120) -> analytic.AnalyticPair:
    pair = analytic.make_scene(5, objects=(4, 4), width=width, height=height)
    depth = pair.curr.depth.copy()
    depth[height // 3 : height // 2, width // 2 : width // 2 + 9] = 0
    depth[::11, ::7] = 0
    return dataclasses.replace(pair, curr=dataclasses.replace(pair.curr, depth=depth))


def moving_pairs() -> tuple[analytic.AnalyticPair, analytic.AnalyticPair]:
    """One scene from a static and from a moving camera."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("xyz", (2, -2, 1), degrees=True).as_matrix()
    motion[:3, 3] = (0.02, -0.01, 0.02)
    options: dict[str, Any] = {"objects": (4, 4), "width": 160, "height": 120}
    return analytic.make_scene(5, **options), analytic.make_scene(5, camera_motion=motion, **options)
