"""The likelihood of many motions at once on a few points: coarse, blurred and fast, for a search."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.postprocess.search_settings import SearchLikelihoodSettings
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.typing import Float32Array, Float64Array, UInt8Array

DEFAULTS = SearchLikelihoodSettings()


class SearchLikelihood:
    """Both frames at the width of the search.

    Attributes:
        camera: of the previous frame at that width.
        prev_points: (H, W, 3) float32 metres of the previous frame; NaN without depth.
        prev_appearance, curr_appearance: (H, W, 3) float32 CIELAB, blurred, with reduced lightness.
        changed: (H, W) bool: pixels of the previous frame whose colour or depth changed.
    """

    def __init__(
        self,
        pair: FramePair,
        *,
        cost_out_of_view: float,
        free_space_violation: float,
        settings: SearchLikelihoodSettings = DEFAULTS,
    ) -> None:
        prev, curr = pair.prev.frame, pair.curr.frame
        self._out_of_view, self._violation, self._settings = cost_out_of_view, free_space_violation, settings
        self.camera = prev.camera
        self.prev_points = pair.prev.points
        self.prev_appearance, self.curr_appearance = (_appearance(frame.color, settings) for frame in (prev, curr))
        known = (prev.depth > 0) & (curr.depth > 0)
        moved = known & (np.abs(prev.depth - curr.depth) > settings.changed_depth)
        limits = np.array([settings.changed_lightness, *[settings.changed_color] * 2], np.float32)
        self.changed = moved | (np.abs(self.prev_appearance - self.curr_appearance) > limits).any(-1)
        depth = np.where(prev.depth > 0, prev.depth, np.float32(np.nan))
        self._table = np.concatenate([depth[..., None], self.prev_appearance], -1).reshape(-1, 4)

    @classmethod
    def of(cls, pair: FramePair, settings: PostprocessSettings) -> SearchLikelihood:
        """The likelihood of a pair at the width of the search, which all steps with the same settings share."""
        search, violation = settings.motion_search, settings.likelihood.free_space_violation
        key = (cls, search.width, search.cost_out_of_view, violation, search.likelihood)
        if key not in pair.memo:
            pair.memo[key] = cls(
                pair.at_width(search.width),
                cost_out_of_view=search.cost_out_of_view,
                free_space_violation=violation,
                settings=search.likelihood,
            )
        found: SearchLikelihood = pair.memo[key]
        return found

    def __call__(
        self,
        rotations: Float64Array,
        translations: Float64Array,
        points: Float32Array,
        appearance: Float32Array,
        *,
        depth_scale: float,
        color_scale: float,
    ) -> Float32Array:
        """The mean cost of points under each motion.

        Each point is compared with one pixel by squared differences of depth and colour, each up to a highest cost, as
        in `alignment.likelihood.motion_cost`.

        Args:
            rotations, translations: (K, 3, 3) and (K, 3): P_prev = rotation P_curr + translation.
            points: (N, 3) metres in the current frame.
            appearance: (N, 3), theirs in `curr_appearance`.
            depth_scale: metres of depth difference that cost 0.5.
            color_scale: difference in appearance that costs 0.5.

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
        offset = (z - seen[..., 0]) / np.float32(depth_scale)
        apart = seen[..., 1:] - appearance
        apart *= apart
        color = (apart[..., 0] + apart[..., 1] + apart[..., 2]) * np.float32(0.5 / color_scale**2)
        settings = self._settings
        cost = np.minimum(offset * offset, settings.outlier_sigmas**2) * np.float32(0.5)
        cost += np.minimum(color, settings.max_color)
        before = offset < -settings.outlier_sigmas
        cost[before] = self._violation
        cost[~(inside & (offset <= settings.hidden_sigmas) | before)] = self._out_of_view
        return np.asarray(cost.mean(axis=1))


def _appearance(color: UInt8Array, settings: SearchLikelihoodSettings) -> Float32Array:
    lab = cv2.GaussianBlur(cv2.cvtColor(color, cv2.COLOR_RGB2LAB).astype(np.float32), (0, 0), settings.blur_px)
    return np.asarray(lab * np.array([settings.lightness_weight, 1, 1], np.float32))
