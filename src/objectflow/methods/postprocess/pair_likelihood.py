"""The likelihood of motions of masks on a pair of frames from a static camera, and which objects touch."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.alignment.background_cost import background_cost
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import Box, LikelihoodSettings, motion_cost
from objectflow.geometry.resample import nearest_indices
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage


class PairLikelihood:
    """Costs of motions at the width of the likelihood.

    Attributes:
        pair: the frames at that width.
        points: (H, W, 3) float32 metres of the current frame; NaN without depth.
        settings: the costs.
    """

    def __init__(self, pair: FramePair, settings: LikelihoodSettings) -> None:
        self.pair, self.settings = pair.at_width(settings.width), settings
        self.points = self.pair.curr.points
        self._costs: dict[tuple[bytes, bytes, float | None], Float32Array] = {}
        self._static_depth: tuple[Float32Array, BoolMask] | None = None

    @classmethod
    def of(cls, pair: FramePair, settings: LikelihoodSettings) -> PairLikelihood:
        """The likelihood of a pair, which all steps with the same settings share."""
        key = (cls, settings)
        if key not in pair.memo:
            pair.memo[key] = cls(pair, settings)
        found: PairLikelihood = pair.memo[key]
        return found

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W)."""
        return self.pair.curr.frame.depth.shape

    def downscale(self, labels: LabelImage) -> LabelImage:
        """Labels of the full image at this size, by nearest pixels."""
        rows, columns = nearest_indices(labels.shape, self.shape)
        return labels[rows[:, None], columns]

    def mask(self, labels: LabelImage, number: int) -> BoolMask:
        """(H, W) bool: the pixels of a label, at this size, that have depth."""
        return np.asarray((labels == number) & self.pair.curr.valid)

    def cost(self, prev_T_curr: Float64Array, mask: BoolMask, *, out_of_view: float | None = None) -> Float32Array:
        """(N,) cost of the pixels of a mask, row by row, under a motion; see `motion_cost`. Costs are kept."""
        key = prev_T_curr.tobytes(), np.packbits(mask).tobytes(), out_of_view
        if key not in self._costs:
            rows, columns = np.any(mask, axis=1).nonzero()[0], np.any(mask, axis=0).nonzero()[0]
            if not len(rows):
                return np.zeros(0, np.float32)
            box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
            self._costs[key] = self._motion_cost(prev_T_curr, box, out_of_view)[mask[box]]
        return self._costs[key]

    def depth_cost(self, prev_T_curr: Float64Array, mask: BoolMask) -> Float32Array:
        """(N,) `cost` of depth alone; infinite where the previous frame does not show the point."""
        pair = self.pair
        cost, hidden = motion_cost(
            pair.prev.frame,
            self.points[mask][None],
            prev_T_curr,
            None,
            out_of_view=np.inf,
            noise=pair.noise,
            settings=self.settings,
        )
        return np.asarray(np.where(hidden, np.inf, cost)[0])

    def previous_cost(self, prev_T_curr: Float64Array, mask: BoolMask) -> Float32Array:
        """(M,) cost, under the inverse of a motion, of the pixels of the previous frame where a mask came from."""
        prev, curr = self.pair.prev, self.pair.curr
        area = self.footprint(prev_T_curr, mask) & prev.valid
        rows, columns = np.any(area, axis=1).nonzero()[0], np.any(area, axis=0).nonzero()[0]
        if not len(rows):
            return np.zeros(0, np.float32)
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        cost, _ = motion_cost(
            curr.frame,
            prev.points,
            geometry.inverse(prev_T_curr),
            (curr.appearance, prev.appearance),
            box,
            noise=self.pair.noise,
            settings=self.settings,
        )
        return np.asarray(cost[area[box]])

    def footprint(self, prev_T_curr: Float64Array, mask: BoolMask) -> BoolMask:
        """(H, W) bool: where a mask was in the previous frame under a motion, without gaps between its pixels."""
        camera = self.pair.prev.frame.camera
        pixels = geometry.project(geometry.transform(prev_T_curr, self.points[mask]), camera)
        column, row = np.rint(np.nan_to_num(pixels.reshape(-1, 2), nan=-9)).clip(-9, 1e6).astype(np.intp).T
        inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        occupied = np.zeros(mask.shape, np.uint8)
        occupied[row[inside], column[inside]] = 1
        return np.asarray(cv2.morphologyEx(occupied, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0)

    def static_cost(self) -> tuple[Float32Array, BoolMask]:
        """(H, W) cost of standing still under any light, and (H, W) bool: pixels that were hidden."""
        return background_cost(self.pair, np.eye(4), self.settings)

    def static_depth_cost(self) -> tuple[Float32Array, BoolMask]:
        """`static_cost` of depth alone."""
        if self._static_depth is None:
            pair = self.pair
            self._static_depth = motion_cost(
                pair.prev.frame, self.points, np.eye(4), None, noise=pair.noise, settings=self.settings
            )
        return self._static_depth

    def cost_at_rest(self, mask: BoolMask) -> Float32Array:
        """(N,) cost of the pixels of a mask, row by row, if they stood still under any light."""
        return np.asarray(self.static_cost()[0][mask])

    def _motion_cost(self, prev_T_curr: Float64Array, box: Box, out_of_view: float | None) -> Float32Array:
        prev, curr = self.pair.prev, self.pair.curr
        return motion_cost(
            prev.frame,
            self.points,
            prev_T_curr,
            (prev.appearance, curr.appearance),
            box,
            out_of_view=out_of_view,
            noise=self.pair.noise,
            settings=self.settings,
        )[0]

    def contact_ratio(self, labels: LabelImage, mask: BoolMask, max_depth_step: float) -> dict[int, float]:
        """Labels that touch a mask, with the share of the common border across which the surface is continuous.

        Pixels touch if they are at most two apart in a row or a column: labels leave gaps at folds and printed lines.

        Args:
            labels: (H, W) at this size.
            mask: (H, W).
            max_depth_step: metres between neighbouring pixels at which a surface ends.
        """
        rows, columns = np.nonzero(cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)))
        box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
        own, depth, others = mask[box], self.pair.curr.frame.depth[box], np.where(mask, 0, labels)[box]
        others = np.where(depth > 0, others, 0)
        count = 1 + int(others.max())
        level, whole = np.zeros(count, np.int64), np.zeros(count, np.int64)
        for axis in (0, 1):
            for gap in (1, 2):
                near, far = _shifted(own, axis, gap), _shifted(others, axis, gap)
                step = np.abs(np.subtract(*_shifted(depth, axis, gap)))
                for mine, other in ((near[0], far[1]), (near[1], far[0])):
                    touch = mine & (other > 0)
                    number = other[touch]
                    whole += np.bincount(number, minlength=count)
                    level += np.bincount(number[step[touch] < max_depth_step], minlength=count)
        return {int(number): int(level[number]) / int(whole[number]) for number in np.flatnonzero(whole)}


def _shifted(image: NDArray[Any], axis: int, gap: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Two views of an image whose pixels lie `gap` apart."""
    length = image.shape[axis]
    return image.take(range(max(0, length - gap)), axis), image.take(range(min(gap, length), length), axis)
