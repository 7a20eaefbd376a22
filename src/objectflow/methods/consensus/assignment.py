"""Pixels to motions: labels at the working size, from the costs of all motions and the walk along surfaces."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import cKDTree

from objectflow import geometry
from objectflow.alignment.likelihood import (
    COST_FREE_SPACE_VIOLATION,
    COST_HIDDEN,
    EVERYWHERE,
    AppearanceFeatures,
    Box,
    motion_cost,
)
from objectflow.frame import RgbdFrame
from objectflow.methods.consensus.pixel_graph import PixelGraph, split_regions
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray, LabelImage

OBJECT_PRIOR = 0.3
"""Cost of any object's motion over the background's: undecided pixels are background."""
HIDDEN_BY_KNOWN = 0.6
"""Cost of having been hidden behind an object that is known to have been there."""


class Assignment:
    """The two frames at the size where pixels are assigned, with what every round needs of them."""

    def __init__(
        self, prev: RgbdFrame, curr: RgbdFrame, camera_motion: Float64Array | None, *, min_pixels: int
    ) -> None:
        self.prev, self.curr, self.min_pixels = prev, curr, min_pixels
        self.background = np.eye(4) if camera_motion is None else camera_motion
        self._others: list[tuple[Float64Array, BoolMask]] = []
        self._costs: dict[tuple[bytes, bool], tuple[Box, Float32Array]] = {}
        self.points = geometry.back_project(curr.depth, curr.camera)
        self.valid = curr.valid
        self.graph = PixelGraph(curr)
        self.appearance = AppearanceFeatures(prev.color), AppearanceFeatures(curr.color)
        self.background_cost, self.hidden = motion_cost(prev, self.points, self.background, self.appearance)
        self.rival_cost = self.background_cost
        # Before a static camera what was hidden is uncovered by a moving thing; a moving camera uncovers by itself.
        self.camera_moved = camera_motion is not None
        self.telling = ~self.hidden if self.camera_moved else np.ones_like(self.hidden)
        self.reach = 0.02 * float(np.median(curr.depth[curr.valid])) + 0.01

    def leave_out(self, mask: BoolMask, others: list[tuple[Float64Array, BoolMask]]) -> None:
        """Take pixels for background that fits, whatever the frames say there; `others` move and hid background."""
        self._others = others
        self.background_cost = np.where(mask, np.float32(0), self.background_cost)
        self.hidden &= ~mask
        self.rival_cost = self.background_cost
        self.telling = self.telling | mask

    def cost(self, prev_T_curr: Float64Array, box: Box = EVERYWHERE, *, color: bool = True) -> Float32Array:
        """(H, W) cost of a motion within a box, ruled out elsewhere; see `motion_cost`."""
        key = (prev_T_curr.tobytes(), color)
        if key not in self._costs or not _within(box, self._costs[key][0]):
            appearance = self.appearance if color else None
            cost = np.full(self.valid.shape, COST_FREE_SPACE_VIOLATION, np.float32)
            cost[box] = motion_cost(self.prev, self.points, prev_T_curr, appearance, box)[0]
            self._costs[key] = box, cost
        return self._costs[key][1]

    def around(self, points: Float32Array) -> Box:
        """The box of pixels within a few times `reach` of points (N, 3)."""
        pixels = geometry.project(points, self.curr.camera)
        margin = 3.2 * self.reach * self.curr.camera.fx / max(0.1, float(points[:, 2].min()))
        low, high = pixels.min(axis=0) - margin, pixels.max(axis=0) + margin + 1
        height, width = self.valid.shape
        top, bottom = (int(np.clip(value, 0, height)) for value in (low[1], high[1]))
        left, right = (int(np.clip(value, 0, width)) for value in (low[0], high[0]))
        return slice(top, bottom), slice(left, right)

    def assign(
        self, motions: list[Float64Array], anchors: list[Float32Array], masks: list[BoolMask], *, fine: bool
    ) -> LabelImage:
        """Labels by cost, nearness and the walk along surfaces.

        Args:
            motions: `prev_T_curr` of each object.
            anchors: (N, 3) points that follow each.
            masks: (H, W) of each, as far as known; empty in the first round.
            fine: to the pixel, or in blocks of 2x2.

        Returns:
            (H, W) int32: 0 = background, k = the k-th motion.
        """
        self.rival_cost = self._background_cost_given(motions, masks)
        costs = [self.rival_cost]
        for motion, points in zip(motions, anchors, strict=True):
            near = nearness_cost(self.points, points, self.reach)
            costs.append(self.cost(motion, self.around(points)) + near + OBJECT_PRIOR)
        probability = self.graph.walk(np.stack(costs), fine=fine)
        return np.asarray(probability.argmax(0), dtype=np.int32)

    def anchors(self, mask: BoolMask, motion: Float64Array) -> Float32Array:
        """(N, 3) points of a mask that its motion explains and the background's cannot."""
        cost = self.cost(motion, self.around(self.points[mask & self.valid]))
        decided = mask & self.valid & (self.rival_cost - cost > 1)
        return self.points[decided] if decided.sum() >= 20 else self.points[mask & self.valid]

    def _background_cost_given(self, motions: list[Float64Array], masks: list[BoolMask]) -> Float32Array:
        """The background's cost when objects are known: what they hid in `prev` may well be background.

        Then being hidden costs only what the object's colours say: on a dull surface every motion finds the colour
        again and it says nothing, on a textured one a motion that finds it is hardly wrong.
        """
        known = [*(zip(motions, masks, strict=True) if masks else ()), *self._others]
        if not known:
            return self.background_cost
        height, width = self.valid.shape
        occupied = np.zeros((height, width), np.uint8)
        for motion, mask in known:
            column, row, inside_image = self.pixels_in_prev(motion, self.points[mask & self.valid])
            occupied[row[inside_image], column[inside_image]] = 1
        spread = cv2.dilate(occupied, np.ones((5, 5)))
        column, row, _ = self.pixels_in_prev(self.background, self.points)
        expected = self.hidden & (spread[row, column] > 0)
        texture = np.minimum(self.appearance[1].contrast[0] / 25, 1)
        cost = HIDDEN_BY_KNOWN + (COST_HIDDEN - HIDDEN_BY_KNOWN) * texture
        return np.where(expected, np.minimum(cost, self.background_cost), self.background_cost).astype(np.float32)

    def pixels_in_prev(self, motion: Float64Array, points: Float32Array) -> tuple[IndexArray, IndexArray, BoolMask]:
        """Column and row in `prev` of points under a motion, clipped to the image, and whether they lie inside."""
        pixels = np.nan_to_num(geometry.project(geometry.transform(motion, points), self.prev.camera), nan=-9)
        height, width = self.valid.shape
        column, row = np.rint(pixels[..., 0]).astype(int), np.rint(pixels[..., 1]).astype(int)
        inside_image = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        return np.clip(column, 0, width - 1), np.clip(row, 0, height - 1), inside_image

    def split(self, labels: LabelImage) -> list[tuple[int, BoolMask]]:
        """The separate objects of each label; see `split_regions`."""
        return split_regions(labels, self.points, self.graph, min_pixels=self.min_pixels, gap=max(0.03, self.reach))


def _within(box: Box, other: Box) -> bool:
    """Whether a box lies inside another."""
    if other == EVERYWHERE:
        return True
    if box == EVERYWHERE:
        return False
    return all(o.start <= b.start and b.stop <= o.stop for b, o in zip(box, other, strict=True))


def nearness_cost(points: Float32Array, anchors: Float32Array, reach: float) -> Float32Array:
    """Up to 4: distance of each pixel's point from the nearest point that is known to follow the motion.

    Args:
        points: (H, W, 3) metres.
        anchors: (N, 3) metres.
        reach: metres that cost nothing; twice as far costs 1.
    """
    height, width = points.shape[:2]
    # Distance is smooth: a third of the pixels each way, and the rest between them, at a ninth of the time.
    coarse = np.nan_to_num(points[1::3, 1::3], nan=1e3)
    thinned = anchors[:: max(1, len(anchors) // 500)]
    distance, _ = cKDTree(thinned).query(coarse.reshape(-1, 3), distance_upper_bound=4 * reach)
    far = np.clip(distance / reach - 1, 0, 2).reshape(coarse.shape[:2]) ** 2
    return np.asarray(cv2.resize(far.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR))
