"""How badly many motions fit a few points of an object, all at once: coarse, blurred and fast, for a search."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.typing import Float32Array, Float64Array, UInt8Array

SEARCH_WIDTH = 160
"""Pixels: wider frames are narrowed to it."""
_BLUR = 2.0
"""Pixels: colour then pulls over several of them."""
_LIGHTNESS = 0.25
"""What a grey level of lightness counts for beside one of hue: it changes when a thing turns in the light."""
COST_FREE_SPACE_VIOLATION = 6.0
"""As in `consensus.cost`: ruled out."""
COST_OUT_OF_VIEW = 3.0
"""What a point costs that the previous frame does not show: as much as one that fits badly. Else the cheapest motion
would be one that hides the object, or takes it out of the image."""
_COLOR_LIMIT = 2.0


class SearchLikelihood:
    """Both frames, `SEARCH_WIDTH` wide.

    Attributes:
        camera: of the previous frame at that width.
        prev_points: (H, W, 3) float32 metres of the previous frame; NaN without depth.
        prev_appearance, curr_appearance: (H, W, 3) float32 CIELAB, blurred, lightness weighed down.
        changed: (H, W) bool: colour or depth of the pixel changed.
    """

    def __init__(self, prev: RgbdFrame, curr: RgbdFrame) -> None:
        prev, curr = prev.downscaled_to_width(SEARCH_WIDTH), curr.downscaled_to_width(SEARCH_WIDTH)
        self.camera = prev.camera
        self.prev_points = geometry.back_project(prev.depth, prev.camera)
        self.prev_appearance, self.curr_appearance = _appearance(prev.color), _appearance(curr.color)
        known = (prev.depth > 0) & (curr.depth > 0)
        off = known & (np.abs(prev.depth - curr.depth) > 0.015)
        self.changed = off | (np.abs(self.prev_appearance - self.curr_appearance) > _CHANGED_BY).any(-1)
        depth = np.where(prev.depth > 0, prev.depth, np.float32(np.nan))
        self._table = np.concatenate([depth[..., None], self.prev_appearance], -1).reshape(-1, 4)

    def __call__(
        self,
        rotations: Float64Array,
        translations: Float64Array,
        points: Float32Array,
        appearance: Float32Array,
        *,
        reach: float,
        shade: float,
    ) -> Float32Array:
        """The mean cost of the points under each motion.

        Each point is compared with one pixel: squared distance in depth up to 4.5, like
        `alignment.likelihood.motion_cost`, and squared distance in colour up to 2. A point in front of the measured
        surface costs `COST_FREE_SPACE_VIOLATION`, one without a measurement `COST_OUT_OF_VIEW`.

        Args:
            rotations, translations: (K, 3, 3) and (K, 3): P_prev = rotation P_curr + translation.
            points: (N, 3) metres, in the current frame.
            appearance: (N, 3), theirs in `curr_appearance`.
            reach: metres in depth that cost 0.5.
            shade: difference in appearance that costs 0.5.

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
        apart = seen[..., 1:] - appearance
        apart *= apart
        color = (apart[..., 0] + apart[..., 1] + apart[..., 2]) * np.float32(0.5 / shade**2)
        cost = np.minimum(offset * offset, 9) * np.float32(0.5) + np.minimum(color, _COLOR_LIMIT)
        cost[offset < -3] = COST_FREE_SPACE_VIOLATION
        cost[~(inside & (offset <= 2) | (offset < -3))] = COST_OUT_OF_VIEW
        return np.asarray(cost.mean(axis=1))


_CHANGED_BY = np.array([3.0, 12.0, 12.0], np.float32)
"""Differences in appearance from which a pixel has changed."""


def _appearance(color: UInt8Array) -> Float32Array:
    lab = cv2.GaussianBlur(cv2.cvtColor(color, cv2.COLOR_RGB2LAB).astype(np.float32), (0, 0), _BLUR)
    return np.asarray(lab * np.array([_LIGHTNESS, 1, 1], np.float32))
