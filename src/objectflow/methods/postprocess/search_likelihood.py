"""How badly many motions fit a few points of an object, all at once: coarse, blurred and fast, for a search."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.frame import RgbdFrame

Floats = NDArray[np.float32]
Array = NDArray[np.float64]

WIDTH = 160
"""Pixels: wider frames are narrowed to it."""
_BLUR = 2.0
"""Pixels: colour then pulls over several of them."""
_LIGHTNESS = 0.25
"""What a grey level of lightness counts for beside one of hue: it changes when a thing turns in the light."""
COST_FLOATING = 6.0
"""As in `consensus.cost`: ruled out."""
BLIND = 3.0
"""What a point costs that the previous frame does not show: as much as one that fits badly. Else the cheapest motion
would be one that hides the object, or takes it out of the image."""
_COLOR_LIMIT = 2.0


class SampledCost:
    """Both frames, `WIDTH` wide.

    Attributes:
        camera: of the previous frame at that width.
        prev_points: (H, W, 3) float32 metres of the previous frame; NaN without depth.
        prev_looks, curr_looks: (H, W, 3) float32 CIELAB, blurred, lightness weighed down.
        changed: (H, W) bool: the previous pixel looks or lies different now.
    """

    def __init__(self, prev: RgbdFrame, curr: RgbdFrame) -> None:
        prev, curr = prev.narrowed(WIDTH), curr.narrowed(WIDTH)
        self.camera = prev.camera
        self.prev_points = geometry.back_project(prev.depth, prev.camera)
        self.prev_looks, self.curr_looks = _look(prev.color), _look(curr.color)
        known = (prev.depth > 0) & (curr.depth > 0)
        off = known & (np.abs(prev.depth - curr.depth) > 0.015)
        self.changed = off | (np.abs(self.prev_looks - self.curr_looks) > _UNLIKE).any(-1)
        depth = np.where(prev.depth > 0, prev.depth, np.float32(np.nan))
        self._table = np.concatenate([depth[..., None], self.prev_looks], -1).reshape(-1, 4)

    def __call__(
        self, rotations: Array, translations: Array, points: Floats, looks: Floats, *, reach: float, shade: float
    ) -> Floats:
        """The mean cost of the points under each motion.

        Each point looks at one pixel: squared distance in depth up to 4.5, like `consensus.cost.motion_cost`, and
        squared distance in colour up to 2; `COST_FLOATING` in front of what was seen, `BLIND` where nothing is seen.

        Args:
            rotations, translations: (K, 3, 3) and (K, 3): P_prev = rotation P_curr + translation.
            points: (N, 3) metres, in the current frame.
            looks: (N, 3), theirs in `curr_looks`.
            reach: metres in depth that cost 0.5.
            shade: difference in looks that costs 0.5.

        Returns:
            (K,) float32.
        """
        camera = self.camera
        moved = rotations.astype(np.float32) @ points.T + translations.astype(np.float32)[..., None]
        z = moved[:, 2]
        near = np.maximum(z, np.float32(0.05))
        u = moved[:, 0] / near * np.float32(camera.fx) + np.float32(camera.cx + 0.5)
        v = moved[:, 1] / near * np.float32(camera.fy) + np.float32(camera.cy + 0.5)
        inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        index = np.where(inside, v.astype(np.int32) * camera.width + u.astype(np.int32), 0)
        seen = self._table[index]
        offset = (z - seen[..., 0]) / np.float32(reach)
        apart = seen[..., 1:] - looks
        apart *= apart
        color = (apart[..., 0] + apart[..., 1] + apart[..., 2]) * np.float32(0.5 / shade**2)
        cost = np.minimum(offset * offset, 9) * np.float32(0.5) + np.minimum(color, _COLOR_LIMIT)
        cost[offset < -3] = COST_FLOATING
        cost[~(inside & (offset <= 2) | (offset < -3))] = BLIND
        return np.asarray(cost.mean(axis=1))


_UNLIKE = np.array([3.0, 12.0, 12.0], np.float32)
"""Differences in looks from which a pixel has changed."""


def _look(color: NDArray[np.uint8]) -> Floats:
    lab = cv2.GaussianBlur(cv2.cvtColor(color, cv2.COLOR_RGB2LAB).astype(np.float32), (0, 0), _BLUR)
    return np.asarray(lab * np.array([_LIGHTNESS, 1, 1], np.float32))
