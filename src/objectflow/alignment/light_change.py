"""Changes of exposure, gamma and white balance between two frames, fitted on pixels that show the same surface."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.alignment.warping import warp_previous
from objectflow.settings import Settings, setting
from objectflow.typing import Float32Array, Float64Array, UInt8Array


@dataclass(frozen=True)
class LightSettings(Settings):
    """Which pixels are compared, and when a change of the whole image counts."""

    width: int = setting(320, minimum=16)
    """Pixels: width at which the frames are compared."""
    stride: int = setting(2, minimum=1)
    """Pixels between those that are compared."""
    max_depth_change: float = setting(0.03, above=0)
    """Relative difference of depth up to which a pixel shows the same surface in both frames."""
    darkest: float = setting(10.0, minimum=0)
    """Grey levels: darker values carry too much noise to be compared."""
    brightest: float = setting(245.0, above=0)
    """Grey levels: brighter values may be saturated."""
    min_pixels: int = setting(500, minimum=10)
    """Fewest pixels per channel that a fit uses."""
    min_change: float = setting(5.0, minimum=0)
    """Grey levels: difference at the first of the `quantiles` from which the light counts as changed."""
    min_reduction: float = setting(0.3, minimum=0, maximum=1)
    """Share by which a fit must reduce each of the `quantiles` of the difference."""
    quantiles: tuple[float, float] = (0.5, 0.75)
    """Quantiles of the difference that are compared; the first decides whether the light changed."""
    min_spread: float = setting(0.15, above=0)
    """Standard deviation of the logarithm of a channel below which its gamma cannot be observed and stays 1."""
    min_residual: float = setting(0.02, above=0)
    """Smallest standard deviation, of the logarithm of a channel, by which residuals are weighted."""
    tukey: float = setting(4.685, above=0)
    """Standard deviations from which a residual has no weight (Tukey's biweight)."""
    max_gamma: float = setting(2.5, minimum=1)
    """Largest gamma, and the inverse of the smallest."""


DEFAULTS = LightSettings()


@dataclass(frozen=True)
class LightChange:
    """`current = gain * previous ** gamma` in each channel, with values from 0 to 1.

    Attributes:
        gains, gammas: of red, green and blue.
    """

    gains: tuple[float, float, float]
    gammas: tuple[float, float, float]

    def apply(self, color: UInt8Array) -> UInt8Array:
        """(H, W, 3) RGB of the previous frame in the light of the current one."""
        levels = np.arange(256)[:, None] / 255.0
        table = np.asarray(self.gains) * levels ** np.asarray(self.gammas)
        return np.asarray(cv2.LUT(color, np.rint(255 * table).clip(0, 255).astype(np.uint8)[:, None, :]))

    def words(self) -> str:
        """The change in a few words."""
        gain = " ".join(f"{value:.2f}" for value in self.gains)
        gamma = " ".join(f"{value:.2f}" for value in self.gammas)
        return f"gain {gain}, gamma {gamma} of red, green and blue"


def fit_light_change(
    pair: FramePair, prev_T_curr: Float64Array | None = None, settings: LightSettings = DEFAULTS
) -> LightChange | None:
    """The change of light of the whole image, from pixels whose depth did not change.

    Args:
        pair: the frames.
        prev_T_curr: (4, 4) motion of the static background; None for a static camera.
        settings: see there.

    Returns:
        None where the colours of most pixels did not change, or changed in another way.
    """
    prev, curr = _compared_colors(pair.at_width(settings.width), prev_T_curr, settings)
    if len(prev) < settings.min_pixels:
        return None
    before = np.quantile(np.abs(prev - curr).max(axis=1), settings.quantiles)
    if before[0] < settings.min_change:
        return None
    found = [_fit_channel(prev[:, k], curr[:, k], settings) for k in range(3)]
    gains, gammas = zip(*found, strict=True)
    change = LightChange(gains, gammas)
    if max(gammas) >= settings.max_gamma or min(gammas) <= 1 / settings.max_gamma:
        return None  # at a bound, the model does not hold
    corrected = change.apply(prev.astype(np.uint8)[:, None])[:, 0].astype(np.float32)
    after = np.quantile(np.abs(corrected - curr).max(axis=1), settings.quantiles)
    return change if (after <= (1 - settings.min_reduction) * before).all() else None


def in_current_light(pair: FramePair, change: LightChange) -> FramePair:
    """The pair with the previous frame's colours in the light of the current one."""
    prev = pair.prev.frame
    corrected = dataclasses.replace(prev, color=change.apply(prev.color))
    return FramePair(PreparedFrame(corrected), pair.curr, noise=pair.noise, matching=pair.matching)


def _compared_colors(
    pair: FramePair, prev_T_curr: Float64Array | None, settings: LightSettings
) -> tuple[Float32Array, Float32Array]:
    """(N, 3) colours of the same points in both frames, blurred a little so that noise does not bias the fit."""
    prev, curr = pair.prev.frame, pair.curr.frame
    if prev_T_curr is None:
        color, depth = prev.color.astype(np.float32), prev.depth
        same = prev.valid & curr.valid & (np.abs(depth - curr.depth) < settings.max_depth_change * curr.depth)
    else:
        moved = geometry.transform(prev_T_curr, pair.curr.points)
        tolerance = np.nan_to_num(settings.max_depth_change * moved[..., 2], nan=1.0).clip(min=1e-3)
        warped = warp_previous(prev, moved, tolerance=tolerance)
        color, same = warped.color, warped.visible & curr.valid
    blurred = [cv2.blur(image, (3, 3)) for image in (color, curr.color.astype(np.float32))]
    grid = slice(None, None, settings.stride), slice(None, None, settings.stride)
    return np.asarray(blurred[0][grid][same[grid]]), np.asarray(blurred[1][grid][same[grid]])


def _fit_channel(prev: Float32Array, curr: Float32Array, settings: LightSettings) -> tuple[float, float]:
    """Gain and gamma of one channel, by iteratively reweighted least squares of logarithms."""
    used = (np.minimum(prev, curr) > settings.darkest) & (np.maximum(prev, curr) < settings.brightest)
    if used.sum() < settings.min_pixels:
        return 1.0, 1.0
    x, y = np.log(prev[used] / 255), np.log(curr[used] / 255)
    observable = float(x.std()) > settings.min_spread
    gamma, offset = 1.0, float(np.median(y - x))
    for _ in range(10):
        residual = y - gamma * x - offset
        scale = max(settings.min_residual, 1.4826 * float(np.median(np.abs(residual))))
        weight = np.clip(1 - (residual / (settings.tukey * scale)) ** 2, 0, None) ** 2
        total = weight.sum()
        mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
        if observable:
            variance = (weight * (x - mean_x) ** 2).sum()
            gamma = float((weight * (x - mean_x) * (y - mean_y)).sum() / max(variance, 1e-9))
            gamma = float(np.clip(gamma, 1 / settings.max_gamma, settings.max_gamma))
        offset = float(mean_y - gamma * mean_x)
    return float(np.exp(offset)), gamma
