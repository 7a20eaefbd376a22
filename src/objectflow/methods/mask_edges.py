"""Labels of a downscaled image, upsampled to the full image with borders that follow its depth and colour."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.frame import RgbdFrame
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise
from objectflow.geometry.resample import nearest_indices
from objectflow.settings import Settings, setting
from objectflow.typing import LabelImage


@dataclass(frozen=True)
class MaskEdgeSettings(Settings):
    """How similar a small pixel must be to give a pixel of the full image its label."""

    depth_sigmas: float = setting(3.0, above=0)
    """Scale of depth differences, in standard deviations of depth."""
    extra_depth: float = setting(0.002, minimum=0)
    """Metres added to that scale."""
    color_scale: float = setting(20.0, above=0)
    """Scale of colour differences, in grey levels."""
    neighbour_weight: float = setting(0.6, minimum=0, maximum=1)
    """Weight of the eight neighbours relative to the nearest small pixel."""
    max_hole_share: float = setting(0.002, minimum=0, maximum=1)
    """Share of the image up to which a hole in the depth inside one object is labelled."""


DEFAULTS = MaskEdgeSettings()


def upsample_labels(
    labels: LabelImage,
    frame: RgbdFrame | PreparedFrame,
    noise: DepthNoise = STRUCTURED_LIGHT,
    settings: MaskEdgeSettings = DEFAULTS,
) -> LabelImage:
    """Upsample labels; near borders, each pixel takes the label of nearby small pixels with similar depth and colour.

    Args:
        labels: (h, w) on the frame downscaled to that size.
        frame: at its full size (H, W).
        noise: of its depth.
        settings: see there.

    Returns:
        (H, W) int32; 0 where depth is missing, except for holes inside an object.
    """
    prepared, (h, w) = PreparedFrame.of(frame), labels.shape
    full, small = prepared.frame, prepared.resized(w, h).frame
    height, width = full.depth.shape
    rows, columns = nearest_indices((h, w), (height, width))
    out = labels[rows[:, None], columns[None, :]]
    if (h, w) != (height, width):
        size = np.ones((3, 3))
        as_float = labels.astype(np.float32)
        border = (cv2.dilate(as_float, size) != cv2.erode(as_float, size))[rows[:, None], columns[None, :]]
        y, x = np.nonzero(border & full.valid)
        scale = settings.depth_sigmas * noise.sigma(full.depth[y, x]) + settings.extra_depth
        depth, color, place = full.depth[y, x], full.color[y, x].astype(np.float32), np.arange(len(y))
        votes = np.zeros((labels.max() + 1, len(y)), np.float32)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                yy, xx = np.clip(rows[y] + dy, 0, h - 1), np.clip(columns[x] + dx, 0, w - 1)
                gap = np.abs(depth - small.depth[yy, xx]) / scale
                change = np.abs(color - small.color[yy, xx]).mean(-1)
                change /= settings.color_scale
                closeness = 1.0 if dx == dy == 0 else settings.neighbour_weight
                vote = closeness * np.exp(-(np.minimum(gap, 6) ** 2) / 2 - np.minimum(change, 6) ** 2 / 2)
                # Each pixel votes once, so that indices do not repeat and the slow `np.add.at` is not needed.
                votes[labels[yy, xx], place] += vote * (small.depth[yy, xx] > 0) + 1e-9
        out[y, x] = votes.argmax(0)
    out = np.where(full.valid, out, 0).astype(np.int32)
    return _fill_holes(out, full, settings.max_hole_share)


def snap_to_edges(
    labels: LabelImage,
    frame: RgbdFrame | PreparedFrame,
    size: tuple[int, int],
    noise: DepthNoise = STRUCTURED_LIGHT,
    settings: MaskEdgeSettings = DEFAULTS,
) -> LabelImage:
    """Align the borders of labels that were found on a smaller image with the depth and colour of the full one.

    Args:
        labels: (H, W) int32 on the frame, upsampled by nearest pixels.
        frame: at its full size.
        size: (h, w) at which the labels were found.
        noise: of its depth.
        settings: see there.

    Returns:
        (H, W) int32. Pixels without depth keep their label, as do all pixels where `size` is no smaller.
    """
    if size[0] >= labels.shape[0] or size[1] >= labels.shape[1]:
        return labels
    prepared = PreparedFrame.of(frame)
    rows, columns = nearest_indices(labels.shape, size)
    sharp = upsample_labels(labels[rows[:, None], columns], prepared, noise, settings)
    return np.where(prepared.valid, sharp, labels).astype(np.int32)


def _fill_holes(labels: LabelImage, full: RgbdFrame, max_share: float) -> LabelImage:
    """Label holes in the depth that one object encloses."""
    count, numbers, boxes, _ = cv2.connectedComponentsWithStats((~full.valid).astype(np.uint8), connectivity=4)
    for number in range(1, count):
        x, y, w, h, area = boxes[number]
        if area > max_share * labels.size or x == 0 or y == 0 or x + w == labels.shape[1] or y + h == labels.shape[0]:
            continue
        window = slice(y - 1, y + h + 1), slice(x - 1, x + w + 1)
        hole = (numbers[window] == number).astype(np.uint8)
        rim = (cv2.dilate(hole, np.ones((3, 3))) > 0) & (hole == 0)
        around = np.unique(labels[window][rim])
        if len(around) == 1 and around[0] > 0:
            labels[window][hole > 0] = around[0]
    return labels
