"""Depth noise measured from a pair: how much depth differs where the colour did not change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.warping import warp_previous
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise, MeasuredDepthNoise
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, Float64Array


@dataclass(frozen=True)
class MeasuredNoiseSettings(Settings):
    """Which pixels are compared, and the depth bins."""

    width: int = setting(320, minimum=16)
    """Pixels: width at which the frames are compared."""
    max_color_change: float = setting(8.0, above=0)
    """Grey levels: largest difference in any channel of a pixel whose colour counts as unchanged."""
    max_depth_change: float = setting(0.1, above=0)
    """Relative difference of depth above which a pixel shows another surface rather than noise."""
    bin_width: float = setting(0.25, above=0)
    """Width of a bin in the natural logarithm of depth."""
    min_pixels: int = setting(200, minimum=1)
    """Fewest pixels of a bin that is used."""


DEFAULTS = MeasuredNoiseSettings()


def measure_depth_noise(
    pair: FramePair,
    prev_T_curr: Float64Array | None = None,
    *,
    floor: DepthNoise = STRUCTURED_LIGHT,
    settings: MeasuredNoiseSettings = DEFAULTS,
) -> DepthNoise:
    """The noise of one frame's depth by bins of depth, from pixels whose colour did not change.

    The standard deviation of a difference is the larger of median / 0.6745 and 90th percentile / 1.645 of its absolute
    value, as the noise of stereo cameras has heavy tails; that of one frame is smaller by the square root of 2.

    Args:
        pair: the frames.
        prev_T_curr: (4, 4) motion of the static background; None for a static camera.
        floor: a lower bound.
        settings: see there.

    Returns:
        `floor` where too few pixels can be compared.
    """
    pair = pair.at_width(settings.width)
    difference, depth, used = _differences(pair, prev_T_curr, settings)
    if used.sum() < settings.min_pixels:
        return floor
    difference, depth = np.abs(difference[used]), depth[used]
    bins = np.floor(np.log(depth) / settings.bin_width).astype(np.int64)
    depths, sigmas = [], []
    for number in np.unique(bins):
        inside = bins == number
        if inside.sum() < settings.min_pixels:
            continue
        median, tail = np.quantile(difference[inside], [0.5, 0.9])
        depths.append(float(np.median(depth[inside])))
        sigmas.append(float(max(median / 0.6745, tail / 1.645) / np.sqrt(2)))
    if not depths:
        return floor
    # The noise of a depth camera grows with depth, so a bin with more noise than a farther one shows moving objects.
    sigmas = np.minimum.accumulate(sigmas[::-1])[::-1].tolist()
    return MeasuredDepthNoise(floor.base, floor.growth, floor.near, tuple(depths), tuple(sigmas))


def _differences(
    pair: FramePair, prev_T_curr: Float64Array | None, settings: MeasuredNoiseSettings
) -> tuple[Float32Array, Float32Array, BoolMask]:
    """(H, W) depth difference in metres, depth, and the pixels that can be compared."""
    curr = pair.curr.frame
    if prev_T_curr is None:
        color, depth = pair.prev.frame.color.astype(np.float32), pair.prev.frame.depth
        expected, visible = curr.depth, pair.prev.valid
    else:
        moved = geometry.transform(prev_T_curr, pair.curr.points)
        tolerance = np.nan_to_num(settings.max_depth_change * moved[..., 2], nan=1.0).clip(min=1e-3)
        warped = warp_previous(pair.prev.frame, moved, tolerance=tolerance)
        color, depth, visible = warped.color, warped.depth, warped.visible
        expected = np.nan_to_num(moved[..., 2], nan=0).astype(np.float32)
    unchanged = np.abs(color - curr.color).max(axis=-1) < settings.max_color_change
    difference = expected - depth
    near = np.abs(difference) < settings.max_depth_change * np.maximum(curr.depth, 1e-6)
    if prev_T_curr is not None:
        difference /= _interpolated_noise(moved, pair.prev.frame.camera)
    return difference, curr.depth, visible & curr.valid & unchanged & near


def _interpolated_noise(points: Float32Array, camera: Camera) -> Float32Array:
    """(H, W) noise of a difference from depth interpolated at points, relative to one without interpolation.

    A bilinear mean of four pixels varies less than each of them.
    """
    with np.errstate(invalid="ignore"):
        fraction = geometry.project(points, camera) % 1
    kept = (fraction**2 + (1 - fraction) ** 2).prod(axis=-1)
    return np.asarray(np.sqrt((1 + kept) / 2), dtype=np.float32)
