"""Changes between two frames that neither standing still nor the known objects explain."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment.likelihood import LikelihoodSettings, motion_cost
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.geometry.depth_noise import DepthNoise
from objectflow.geometry.resample import resize_nearest
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float64Array


@dataclass(frozen=True)
class UnexplainedChangeSettings(Settings):
    """Which changes count."""

    likelihood: LikelihoodSettings = LikelihoodSettings()
    """Costs of standing still, by which changes are found."""
    changed_cost: float = setting(1.5, minimum=0)
    """Cost of standing still from which a pixel counts as changed."""
    min_share: float = setting(0.0005, minimum=0, maximum=1)
    """Share of the image: smallest region that counts."""
    rim: int = setting(3, minimum=0)
    """Pixels, at the width of the likelihood, around known objects whose changes these explain."""
    max_shift_px: float = setting(0.6, minimum=0)
    """Pixels, at a width of 320: median shift of the edges from which the camera may have moved, so that a pair is
    always estimated."""
    depth_change: float = setting(0.04, above=0)
    """Relative change of depth from which a pixel may show something that moves by itself, whose edges do not count
    for the shift."""
    moving_rim: int = setting(4, minimum=0)
    """Pixels, at a width of 320, around known objects and such pixels, whose edges do not count either."""


def has_unexplained_change(
    frames: tuple[PreparedFrame, PreparedFrame],
    prev_T_curr: Float64Array,
    known: tuple[BoolMask, BoolMask],
    noise: DepthNoise,
    settings: UnexplainedChangeSettings,
) -> bool:
    """Whether a region of the current frame cannot have stood still; see `unexplained_regions`."""
    return bool(unexplained_regions(frames, prev_T_curr, known, noise, settings))


def unexplained_regions(
    frames: tuple[PreparedFrame, PreparedFrame],
    prev_T_curr: Float64Array,
    known: tuple[BoolMask, BoolMask],
    noise: DepthNoise,
    settings: UnexplainedChangeSettings,
) -> list[BoolMask]:
    """Regions of the current frame that cannot have stood still, beside the objects known in either frame.

    Args:
        frames: the previous and the current one.
        prev_T_curr: (4, 4) motion of the static background.
        known: (H, W) bool of any size, the pixels of known objects in the previous and in the current frame.
        noise: of the depth.
        settings: see there.

    Returns:
        (h, w) bool each, at the width of the likelihood; the largest first.
    """
    prev, curr = (frame.at_width(settings.likelihood.width) for frame in frames)
    cost, hidden = motion_cost(
        prev.frame,
        curr.points,
        prev_T_curr,
        (prev.appearance, curr.appearance),
        light=True,
        noise=noise,
        settings=settings.likelihood,
    )
    known_before, known_now = (_at_size(mask, cost.shape) for mask in known)
    explained = known_now | _seen_before(curr, prev, prev_T_curr, known_before)
    size = 2 * settings.rim + 1
    around = cv2.dilate(explained.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    changed = (cost >= settings.changed_cost) & ~hidden & curr.valid & ~around
    opened = cv2.morphologyEx(changed.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    areas = stats[:, cv2.CC_STAT_AREA]
    large = [k for k in range(1, len(areas)) if areas[k] >= settings.min_share * cost.size]
    return [labels == k for k in sorted(large, key=lambda k: -areas[k])]


def _at_size(mask: BoolMask, shape: tuple[int, ...]) -> BoolMask:
    return np.asarray(resize_nearest(mask.astype(np.uint8), shape) > 0)


def _seen_before(
    curr: PreparedFrame, prev: PreparedFrame, prev_T_curr: Float64Array, known_before: BoolMask
) -> BoolMask:
    """(H, W) bool: the current pixels in whose place the previous frame shows a known object."""
    camera = prev.frame.camera
    pixels = np.rint(geometry.project(geometry.transform(prev_T_curr, curr.points), camera))
    column = np.nan_to_num(pixels[..., 0], nan=-1).clip(-1, camera.width).astype(np.int64)
    row = np.nan_to_num(pixels[..., 1], nan=-1).clip(-1, camera.height).astype(np.int64)
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return np.asarray(inside & known_before[np.where(inside, row, 0), np.where(inside, column, 0)])
