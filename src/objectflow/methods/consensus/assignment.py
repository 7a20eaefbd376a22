"""Assignment of pixels to motions, from the costs of all motions and a random walk along surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial import cKDTree

from objectflow import geometry
from objectflow.alignment.background_cost import background_cost
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.likelihood import EVERYWHERE, Box, LikelihoodSettings, motion_cost
from objectflow.methods.consensus.pixel_graph import PixelGraph, PixelGraphSettings, split_regions
from objectflow.methods.consensus.random_walker import RandomWalker
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray, LabelImage

_MARGIN = 12
"""Pixels around boxes that are labelled with them, farther than labels spread along surfaces."""

MovingMask = tuple[Float64Array, BoolMask]
"""`prev_T_curr` of an object and its (H, W) mask."""


@dataclass(frozen=True)
class AssignmentSettings(Settings):
    """Priors of the assignment."""

    object_prior: float = setting(0.3, minimum=0)
    """Cost of an object's motion relative to the background's: undecided pixels become background."""
    hidden_by_known: float = setting(0.6, minimum=0)
    """Cost of having been hidden behind an object that is known to have been there."""
    full_contrast: float = setting(25.0, above=0)
    """Grey levels: local contrast of a surface from which a uniform colour no longer explains that it was hidden."""
    reach_base: float = setting(0.01, above=0)
    """Metres: distance from an object's known points at which its motion costs nothing extra, at depth 0."""
    reach_slope: float = setting(0.02, minimum=0)
    """Growth of that distance with the median depth."""
    search_reach: float = setting(3.2, above=0)
    """Distance around an object, in units of its reach, within which its motion competes for pixels; farther away the
    extra cost of the distance exceeds any gain."""
    anchor_gain: float = setting(1.0, minimum=0)
    """Nats by which an object's motion must fit a point better than the background's for the point to be known to
    follow it."""
    min_anchors: int = setting(20, minimum=1)
    """Fewest such points; an object with fewer is represented by all points of its mask."""
    max_anchors: int = setting(500, minimum=1)
    """Maximum number of these points, sampled evenly, to which distances are computed."""
    min_gap: float = setting(0.03, above=0)
    """Metres: pieces of one label that lie farther apart are separate objects."""


class Assignment:
    """The frames at the size at which pixels are assigned, and the costs of motions on them.

    Attributes:
        pair: the frames.
        background: (4, 4) `prev_T_curr` of the static background.
        camera_moved: whether the background moves.
        points: (H, W, 3) metres of the current frame.
        valid: (H, W) bool: pixels with depth.
        background_cost: (H, W) cost of the background's motion.
        hidden: (H, W) bool: pixels that the background's motion hides in the previous frame.
        informative: (H, W) bool: pixels whose gain over the background counts. Before a static camera, a hidden pixel
            was uncovered by a moving object; a moving camera uncovers background by itself.
        reach: metres from an object's known points at which its motion costs nothing extra.
        min_pixels: fewest pixels of an object.
    """

    def __init__(
        self,
        pair: FramePair,
        camera_motion: Float64Array | None,
        *,
        min_pixels: int,
        likelihood: LikelihoodSettings,
        graph: PixelGraphSettings,
        settings: AssignmentSettings,
    ) -> None:
        self.pair, self.min_pixels = pair, min_pixels
        self.settings, self._likelihood = settings, likelihood
        self.camera_moved = camera_motion is not None
        self.background = np.eye(4) if camera_motion is None else camera_motion
        self.points, self.valid = pair.curr.points, pair.curr.valid
        self._box, self._graph_settings = EVERYWHERE, graph
        self._costs: dict[tuple[bytes, bool], tuple[Box, Float32Array]] = {}
        self._others: Sequence[MovingMask] = ()
        self.background_cost, hidden = background_cost(pair, self.background, likelihood)
        self.hidden = hidden.copy()  # `exclude` changes it
        self.rival_cost = self.background_cost
        self.informative = ~self.hidden if self.camera_moved else np.ones_like(self.hidden)
        depth = pair.curr.frame.depth
        self.reach = settings.reach_slope * float(np.median(depth[self.valid])) + settings.reach_base

    @cached_property
    def graph(self) -> PixelGraph:
        """The graph of the pixels that are labelled."""
        return PixelGraph(self.pair.curr, self.pair.noise, self._graph_settings, self._box)

    @cached_property
    def _walker(self) -> RandomWalker:
        return RandomWalker(self.graph)

    def limit(self, boxes: Sequence[Box]) -> None:
        """Label pixels near these boxes alone, before the first labels: motions claim no pixel elsewhere."""
        height, width = self.valid.shape
        ends = [
            (rows.start - _MARGIN, rows.stop + _MARGIN, columns.start - _MARGIN, columns.stop + _MARGIN)
            for rows, columns in boxes
        ]
        top, bottom, left, right = (
            int(part(side)) for part, side in zip((min, max) * 2, zip(*ends, strict=True), strict=True)
        )
        # The blocks of the random walk start at even pixels.
        top, left = max(0, top) // 2 * 2, max(0, left) // 2 * 2
        self._box = slice(top, min(height, bottom)), slice(left, min(width, right))

    def exclude(self, mask: BoolMask, others: Sequence[MovingMask]) -> None:
        """Treat the pixels of a mask as background that fits; `others` are moving objects that hid background."""
        self._others = others
        self.background_cost = np.where(mask, np.float32(0), self.background_cost)
        self.hidden &= ~mask
        self.rival_cost = self.background_cost
        self.informative = self.informative | mask

    def cost(self, prev_T_curr: Float64Array, box: Box = EVERYWHERE, *, color: bool = True) -> Float32Array:
        """(H, W) cost of a motion within a box, and the highest cost elsewhere; see `motion_cost`."""
        key = (prev_T_curr.tobytes(), color)
        if key not in self._costs or not _within(box, self._costs[key][0]):
            cost = np.full(self.valid.shape, self._likelihood.free_space_violation, np.float32)
            cost[box] = self._motion_cost(prev_T_curr, box, color=color)
            self._costs[key] = box, cost
        return self._costs[key][1]

    def _motion_cost(self, prev_T_curr: Float64Array, box: Box, *, color: bool) -> Float32Array:
        prev, curr = self.pair.prev, self.pair.curr
        appearance = (prev.appearance, curr.appearance) if color else None
        return motion_cost(
            prev.frame,
            self.points,
            prev_T_curr,
            appearance,
            box,
            noise=self.pair.noise,
            settings=self._likelihood,
        )[0]

    def vanished_cost(self) -> tuple[Float32Array, BoolMask]:
        """Cost of the background's motion on the pixels of the previous frame, and which of them are hidden now."""
        prev, curr = self.pair.prev, self.pair.curr
        return motion_cost(
            curr.frame,
            prev.points,
            geometry.inverse(self.background),
            (curr.appearance, prev.appearance),
            noise=self.pair.noise,
            settings=self._likelihood,
        )

    def around(self, points: Float32Array) -> Box:
        """The box of pixels within a few times `reach` of points (N, 3)."""
        camera = self.pair.curr.frame.camera
        pixels = geometry.project(points, camera)
        margin = self.settings.search_reach * self.reach * camera.fx / max(0.1, float(points[:, 2].min()))
        low, high = pixels.min(axis=0) - margin, pixels.max(axis=0) + margin + 1
        height, width = self.valid.shape
        top, bottom = (int(np.clip(value, 0, height)) for value in (low[1], high[1]))
        left, right = (int(np.clip(value, 0, width)) for value in (low[0], high[0]))
        return slice(top, bottom), slice(left, right)

    def around_mask(self, mask: BoolMask) -> Box:
        """`around` the points of a mask."""
        return self.around(self.points[mask & self.valid])

    def assign(
        self,
        motions: list[Float64Array],
        anchors: list[Float32Array],
        masks: list[BoolMask],
        *,
        fine: bool,
        priors: list[Float32Array] | None = None,
    ) -> LabelImage:
        """Label pixels by cost, nearness to known points, and the random walk along surfaces.

        Args:
            motions: `prev_T_curr` of each object.
            anchors: (N, 3) points that follow each.
            masks: (H, W) of each, as far as known; empty in the first round.
            fine: whether single pixels are labelled, or blocks of 2x2.
            priors: (H, W) of each: cost added to its motion's.

        Returns:
            (H, W) int32: 0 = background, k = the k-th motion.
        """
        self.rival_cost = self._background_cost_given(motions, masks)
        costs = [self.rival_cost]
        for number, (motion, points) in enumerate(zip(motions, anchors, strict=True)):
            near = nearness_cost(self.points, points, self.reach, self.settings.max_anchors)
            prior = self.settings.object_prior if priors is None else priors[number]
            costs.append(self.cost(motion, self.around(points)) + near + prior)
        probability = self._walker.solve(np.stack([cost[self._box] for cost in costs]), fine=fine)
        labels = np.zeros(self.valid.shape, np.int32)
        labels[self._box] = probability.argmax(0)
        return labels

    def anchors(self, mask: BoolMask, motion: Float64Array) -> Float32Array:
        """(N, 3) points of a mask that its motion explains and the background's does not."""
        cost = self.cost(motion, self.around_mask(mask))
        decided = mask & self.valid & (self.rival_cost - cost > self.settings.anchor_gain)
        return self.points[decided if decided.sum() >= self.settings.min_anchors else mask & self.valid]

    def _background_cost_given(self, motions: list[Float64Array], masks: list[BoolMask]) -> Float32Array:
        """The background's cost given known objects, behind which background may have been hidden.

        Being hidden then costs as much as the object's texture warrants: a surface without texture fits many motions
        and is weak evidence, a textured one fits few.
        """
        known = [*(zip(motions, masks, strict=True) if masks else ()), *self._others]
        if not known:
            return self.background_cost
        height, width = self.valid.shape
        occupied = np.zeros((height, width), np.uint8)
        for motion, mask in known:
            column, row, inside_image = self.pixels_in_prev(motion, self.points[mask & self.valid])
            occupied[row[inside_image], column[inside_image]] = 1
        dilated = cv2.dilate(occupied, np.ones((5, 5)))
        column, row, _ = self.pixels_in_prev(self.background, self.points)
        expected = self.hidden & (dilated[row, column] > 0)
        texture = np.minimum(self.pair.curr.appearance.contrast[0] / self.settings.full_contrast, 1)
        low = self.settings.hidden_by_known
        cost = low + (self._likelihood.hidden - low) * texture
        return np.where(expected, np.minimum(cost, self.background_cost), self.background_cost).astype(np.float32)

    def pixels_in_prev(self, motion: Float64Array, points: Float32Array) -> tuple[IndexArray, IndexArray, BoolMask]:
        """Column and row in `prev` of points under a motion, clipped to the image, and whether they lie inside."""
        camera = self.pair.prev.frame.camera
        pixels = np.nan_to_num(geometry.project(geometry.transform(motion, points), camera), nan=-9)
        height, width = self.valid.shape
        column, row = np.rint(pixels[..., 0]).astype(int), np.rint(pixels[..., 1]).astype(int)
        inside_image = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        return np.clip(column, 0, width - 1), np.clip(row, 0, height - 1), inside_image

    def split(self, labels: LabelImage) -> list[tuple[int, BoolMask]]:
        """The separate objects of each label; see `split_regions`."""
        gap = max(self.settings.min_gap, self.reach)
        return split_regions(labels, self.points, self.graph, min_pixels=self.min_pixels, gap=gap)


def _within(box: Box, other: Box) -> bool:
    """Whether a box lies inside another."""
    if other == EVERYWHERE:
        return True
    if box == EVERYWHERE:
        return False
    return all(o.start <= b.start and b.stop <= o.stop for b, o in zip(box, other, strict=True))


def nearness_cost(points: Float32Array, anchors: Float32Array, reach: float, max_anchors: int) -> Float32Array:
    """Cost of each pixel's distance from the points that are known to follow a motion, up to 4.

    Args:
        points: (H, W, 3) metres.
        anchors: (N, 3) metres.
        reach: metres that cost nothing; twice as far costs 1.
        max_anchors: maximum number of `anchors`, sampled evenly.
    """
    height, width = points.shape[:2]
    # Distance is smooth: computing it on every third row and column takes a ninth of the time.
    coarse = np.nan_to_num(points[1::3, 1::3], nan=1e3)
    thinned = anchors[:: max(1, len(anchors) // max_anchors)]
    distance, _ = cKDTree(thinned).query(coarse.reshape(-1, 3), distance_upper_bound=4 * reach)
    far = np.clip(distance / reach - 1, 0, 2).reshape(coarse.shape[:2]) ** 2
    return np.asarray(cv2.resize(far.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR))
