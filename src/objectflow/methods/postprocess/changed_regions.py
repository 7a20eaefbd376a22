"""Regions that cannot have stood still: depth or colour of the previous frame contradict it."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from objectflow.alignment.frame_pair import FramePair
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.typing import BoolMask, LabelImage, UInt8Array

_MIN_JUDGED = 4
"""Fewest changed pixels of a 3x3 window, the others having no depth, for the window to count as changed."""


def changed_regions(
    likelihood: PairLikelihood, among: BoolMask, *, changed_cost: float, min_share: float
) -> LabelImage:
    """Number the larger connected regions that standing still does not explain.

    Args:
        likelihood: of the pair.
        among: (H, W) bool at the size of the likelihood: pixels that count.
        changed_cost: cost of standing still from which a pixel counts as changed.
        min_share: share of the image from which a region is large.

    Returns:
        (H, W) int32 numbers from 1; 0 elsewhere.
    """
    cost, hidden = likelihood.static_cost()
    changed = among & (cost >= changed_cost) & likelihood.pair.curr.valid & ~hidden
    numbers, count = ndimage.label(_opened(changed, likelihood.pair), structure=np.ones((3, 3)))
    sizes = np.bincount(numbers.ravel(), minlength=count + 1)
    large = sizes >= min_share * cost.size
    large[0] = False
    return np.asarray(np.where(large, np.cumsum(large), 0)[numbers], dtype=np.int32)


def _opened(changed: BoolMask, pair: FramePair) -> UInt8Array:
    """Changed pixels without thin and small parts: a 3x3 opening in which scattered holes of the depth are neutral."""
    kernel = np.ones((3, 3), np.uint8)
    # Standing still compares a pixel with the same pixel of the previous frame, which may lack depth as well.
    compared = pair.curr.valid & pair.prev.valid
    count = cv2.boxFilter(changed.astype(np.float32), -1, (3, 3), normalize=False)
    inner = (cv2.erode((changed | ~compared).astype(np.uint8), kernel) > 0) & (count >= _MIN_JUDGED)
    return np.asarray(cv2.dilate(inner.astype(np.uint8), kernel), dtype=np.uint8)
