"""Windows around what a result leaves unexplained."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from objectflow.methods.labels import Objects
from objectflow.methods.postprocess.look_settings import LookWindowSettings
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.typing import BoolMask, Float32Array, LabelImage

_MIN_JUDGED = 0.3
"""Share of a square that must have been compared for its mean cost to count."""


class Window(NamedTuple):
    """A part of the frame, in its pixels."""

    x: int
    y: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)


class Remainder(NamedTuple):
    """How well a result explains each pixel, at the size of the likelihood.

    Attributes:
        cost: (H, W) float32 nats: of the motion that the pixel follows.
        hidden: (H, W) bool: pixels at rest that were hidden before, or without depth there.
    """

    cost: Float32Array
    hidden: BoolMask


def find_remainder(likelihood: PairLikelihood, labels: LabelImage, objects: Objects) -> Remainder:
    """The cost of each pixel under the motion of its object, or of standing still.

    Args:
        likelihood: of the pair.
        labels: (H, W) int32 at its size.
        objects: of these labels.
    """
    static, may_hide = likelihood.static_cost()
    cost, hidden = static.copy(), may_hide | ~likelihood.pair.prev.valid
    for obj in objects:
        mask = likelihood.mask(labels, obj.id)
        if obj.moving and mask.any():
            cost[mask], hidden[mask] = likelihood.cost(obj.prev_T_curr, mask), False
    return Remainder(cost, hidden)


def find_windows(
    likelihood: PairLikelihood,
    labels: LabelImage,
    objects: Objects,
    remainder: Remainder,
    size: tuple[int, int],
    settings: LookWindowSettings,
) -> list[Window]:
    """Windows around the unexplained regions, the largest first; a region inside an earlier window has none.

    Args:
        likelihood: of the pair.
        labels: (H, W) int32 at its size.
        objects: of these labels.
        remainder: of these objects.
        size: (H, W) of the frame, in whose pixels windows are.
        settings: see there.
    """
    counts = likelihood.pair.curr.valid & ~remainder.hidden & ~_rims(labels, objects, settings.rim_px)
    mean = _mean_cost(np.minimum(remainder.cost, settings.max_cost), counts, settings.smoothing_px)
    typical = float(np.median(mean[counts])) if counts.any() else 0.0
    unexplained = mean >= settings.min_cost + settings.noise_ratio * typical
    numbers, count = ndimage.label(unexplained, structure=np.ones((3, 3)))
    areas = np.bincount(numbers.ravel(), minlength=count + 1)[1:]
    boxes = ndimage.find_objects(numbers)
    scale = np.array([size[0] / labels.shape[0], size[1] / labels.shape[1]])
    extent = np.maximum(1, (np.array(size) / settings.zoom).astype(np.intp))
    found: list[Window] = []
    for index in np.argsort(-areas, kind="stable"):
        if areas[index] < settings.min_share * labels.size or len(found) == settings.max_windows:
            break
        low = np.array([one.start for one in boxes[index]]) * scale
        high = np.array([one.stop for one in boxes[index]]) * scale
        if (high - low > settings.max_extent * extent).any() or any(_holds(one, low, high) for one in found):
            continue
        top, left = np.clip((low + high - extent) / 2, 0, np.array(size) - extent).astype(np.intp)
        found.append(Window(int(left), int(top), int(extent[1]), int(extent[0])))
    return found


def _rims(labels: LabelImage, objects: Objects, pixels: int) -> BoolMask:
    """(H, W) bool: pixels at the borders of moving objects."""
    movers = np.where(np.isin(labels, [obj.id for obj in objects if obj.moving]), labels, 0).astype(np.float32)
    kernel = np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)
    return np.asarray(cv2.dilate(movers, kernel) != cv2.erode(movers, kernel))


def _mean_cost(cost: Float32Array, counts: BoolMask, side: int) -> Float32Array:
    """(H, W) mean over squares of the pixels that count; 0 where too few do."""
    weight = counts.astype(np.float32)
    total = cv2.boxFilter(cost * weight, -1, (side, side), normalize=False)
    judged = cv2.boxFilter(weight, -1, (side, side), normalize=False)
    mean = total / np.maximum(judged, 1)
    return np.asarray(np.where(judged > _MIN_JUDGED * side * side, mean, 0), dtype=np.float32)


def _holds(window: Window, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether a box (rows, columns) lies well inside a window."""
    start, extent = np.array([window.y, window.x]), np.array([window.height, window.width])
    return bool((low > start + 0.1 * extent).all() and (high < start + 0.9 * extent).all())
