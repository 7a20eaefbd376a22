"""The two frames as witnesses: how badly each pixel of an object fits a motion, and which objects touch."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.alignment.likelihood import AppearanceFeatures, motion_cost
from objectflow.frame import RgbdFrame
from objectflow.geometry.resample import nearest_indices
from objectflow.typing import BoolMask, Float32Array, Float64Array, LabelImage

LIKELIHOOD_WIDTH = 320
"""Pixels: wider frames are narrowed to it; what is asked are means over objects."""
DEPTH_STEP = 0.01
"""Metres between neighbouring pixels at which a surface ends."""


class PairLikelihood:
    """Both frames of a camera that stands still, and the current one's labels, at most `LIKELIHOOD_WIDTH` wide.

    Attributes:
        prev, curr: the frames.
        labels: (H, W) int32 on their pixels.
        points: (H, W, 3) float32 metres, the current frame's; NaN without depth.
        appearance: of both.
    """

    def __init__(self, prev: RgbdFrame, curr: RgbdFrame, labels: LabelImage) -> None:
        if curr.camera.width > LIKELIHOOD_WIDTH:
            height = max(1, round(curr.camera.height * LIKELIHOOD_WIDTH / curr.camera.width))
            prev, curr = prev.resized(LIKELIHOOD_WIDTH, height), curr.resized(LIKELIHOOD_WIDTH, height)
        self.prev, self.curr = prev, curr
        self.show(labels)
        self.points = geometry.back_project(curr.depth, curr.camera)
        self.appearance = AppearanceFeatures(prev.color), AppearanceFeatures(curr.color)

    def show(self, labels: LabelImage) -> None:
        """Take other labels (H, W), on the input's pixels."""
        rows, columns = nearest_indices(labels.shape, self.curr.depth.shape)
        self.labels: LabelImage = labels[rows[:, None], columns]

    def mask(self, number: int) -> BoolMask:
        """(H, W) bool: the pixels of a label that have depth."""
        return np.asarray((self.labels == number) & self.curr.valid)

    def cost(self, prev_T_curr: Float64Array, mask: BoolMask, *, blind: float | None = None) -> Float32Array:
        """(N,) of the mask's pixels, row by row: how badly they fit a motion; see `consensus.cost.motion_cost`."""
        rows, columns = np.nonzero(mask)
        if not len(rows):
            return np.zeros(0, np.float32)
        box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
        return motion_cost(self.prev, self.points, prev_T_curr, self.appearance, box, blind=blind)[0][mask[box]]

    def contact(self, mask: BoolMask) -> dict[int, float]:
        """Labels that touch a mask, each with the share of the common border over which the surface goes on.

        Two pixels touch in a row or a column, at most one apart: at a fold or a printed line labels leave gaps.
        """
        border: dict[int, list[int]] = {}
        reach = np.ones((5, 5), np.uint8)
        rows, columns = np.nonzero(cv2.dilate(mask.astype(np.uint8), reach))
        box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
        own, depth, labels = mask[box], self.curr.depth[box], np.where(mask, 0, self.labels)[box]
        labels = np.where(depth > 0, labels, 0)
        for axis in (0, 1):
            for gap in (1, 2):
                near, far = _shifted(own, axis, gap), _shifted(labels, axis, gap)
                step = np.abs(np.subtract(*_shifted(depth, axis, gap)))
                for mine, other in ((near[0], far[1]), (near[1], far[0])):
                    touch = mine & (other > 0)
                    for number in np.unique(other[touch]):
                        these = touch & (other == number)
                        counts = border.setdefault(int(number), [0, 0])
                        counts[0] += int((step[these] < DEPTH_STEP).sum())
                        counts[1] += int(these.sum())
        return {number: level / whole for number, (level, whole) in border.items()}


def _shifted(image: NDArray[Any], axis: int, gap: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Two views of an image whose pixels lie `gap` apart."""
    length = image.shape[axis]
    return image.take(range(max(0, length - gap)), axis), image.take(range(min(gap, length), length), axis)
