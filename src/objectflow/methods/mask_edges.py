"""Labels of a downscaled image brought to the full one, with borders that follow its depth and colour."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow.frame import RgbdFrame
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise
from objectflow.geometry.resample import nearest_indices
from objectflow.typing import LabelImage


def upsample_labels(
    labels: LabelImage, small: RgbdFrame, full: RgbdFrame, noise: DepthNoise = STRUCTURED_LIGHT
) -> LabelImage:
    """Upsample labels; near borders, each pixel takes the label of nearby small pixels with similar depth and colour.

    Args:
        labels: (h, w) on `small`.
        small: the downscaled frame.
        full: the frame itself.
        noise: of its depth.

    Returns:
        (H, W) int32 on `full`; 0 where depth is missing, except for holes inside an object.
    """
    height, width = full.depth.shape
    h, w = labels.shape
    rows, columns = nearest_indices((h, w), (height, width))
    out = labels[rows[:, None], columns[None, :]]
    if (h, w) != (height, width):
        size = np.ones((3, 3))
        as_float = labels.astype(np.float32)
        border = (cv2.dilate(as_float, size) != cv2.erode(as_float, size))[rows[:, None], columns[None, :]]
        y, x = np.nonzero(border & full.valid)
        votes = np.zeros((labels.max() + 1, len(y)), np.float32)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                yy, xx = np.clip(rows[y] + dy, 0, h - 1), np.clip(columns[x] + dx, 0, w - 1)
                gap = np.abs(full.depth[y, x] - small.depth[yy, xx]) / (3 * noise.sigma(full.depth[y, x]) + 0.002)
                change = np.abs(full.color[y, x].astype(np.float32) - small.color[yy, xx]).mean(-1) / 20
                closeness = 1.0 if dx == dy == 0 else 0.6
                vote = closeness * np.exp(-(np.minimum(gap, 6) ** 2) / 2 - np.minimum(change, 6) ** 2 / 2)
                np.add.at(votes, (labels[yy, xx], np.arange(len(y))), vote * (small.depth[yy, xx] > 0) + 1e-9)
        out[y, x] = votes.argmax(0)
    out = np.where(full.valid, out, 0).astype(np.int32)
    return _fill_holes(out, full)


def snap_to_edges(
    labels: LabelImage, small: RgbdFrame, full: RgbdFrame, noise: DepthNoise = STRUCTURED_LIGHT
) -> LabelImage:
    """Align the borders of labels that were found on a smaller image with the depth and colour of the full one.

    Args:
        labels: (H, W) int32 on `full`, upsampled by nearest pixels.
        small: the frame on which they were found.
        full: the frame itself.
        noise: of its depth.

    Returns:
        (H, W) int32. Pixels without depth keep their label, as do all pixels where `small` is no smaller.
    """
    if small.depth.shape[0] >= full.depth.shape[0] or small.depth.shape[1] >= full.depth.shape[1]:
        return labels
    rows, columns = nearest_indices(labels.shape, small.depth.shape)
    sharp = upsample_labels(labels[rows[:, None], columns], small, full, noise)
    return np.where(full.valid, sharp, labels).astype(np.int32)


def _fill_holes(labels: LabelImage, full: RgbdFrame) -> LabelImage:
    """Label holes in the depth that one object encloses."""
    count, numbers, boxes, _ = cv2.connectedComponentsWithStats((~full.valid).astype(np.uint8), connectivity=4)
    for number in range(1, count):
        x, y, w, h, area = boxes[number]
        if area > 0.002 * labels.size or x == 0 or y == 0 or x + w == labels.shape[1] or y + h == labels.shape[0]:
            continue
        window = slice(y - 1, y + h + 1), slice(x - 1, x + w + 1)
        hole = (numbers[window] == number).astype(np.uint8)
        rim = (cv2.dilate(hole, np.ones((3, 3))) > 0) & (hole == 0)
        around = np.unique(labels[window][rim])
        if len(around) == 1 and around[0] > 0:
            labels[window][hole > 0] = around[0]
    return labels
