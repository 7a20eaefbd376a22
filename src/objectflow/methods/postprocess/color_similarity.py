"""Whether the colours of an object lie where its motion takes them: the structural similarity of aligned pixels."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.geometry.resample import sample_bilinear
from objectflow.methods.postprocess.pair_likelihood import PairLikelihood
from objectflow.methods.postprocess.settings import ColorSimilaritySettings
from objectflow.typing import BoolMask, Float32Array, Float64Array


def color_similarity(
    likelihood: PairLikelihood, mask: BoolMask, prev_T_curr: Float64Array, settings: ColorSimilaritySettings
) -> float:
    """The similarity of an object's colours to those that its motion pairs them with, in lightness or in hue.

    Pixels whose depth the motion explains are compared: the colours a in the current frame and b in the previous one
    have the similarity (2 cov(a, b) + s^2) / (var(a) + var(b) + s^2), where s is the noise of colour, as in SSIM (Wang
    et al. 2004). It is near 1 where the colours vary alike, or not at all, and near 0 where they vary independently.
    Light changes lightness, and many objects have one hue, so the higher similarity counts.

    Args:
        likelihood: of the pair.
        mask: (H, W) bool, the object's pixels with depth, at the width of the likelihood.
        prev_T_curr: (4, 4) the motion.
        settings: see there.

    Returns:
        0..1; 0 where the motion explains the depth of too few pixels.
    """
    explained = likelihood.depth_cost(prev_T_curr, mask) < settings.explained_cost
    if explained.sum() < settings.min_pixels:
        return 0.0
    prev, curr = likelihood.pair.prev, likelihood.pair.curr
    pixels = geometry.project(geometry.transform(prev_T_curr, likelihood.points[mask][explained]), prev.frame.camera)
    pixels = np.clip(pixels, 0, [prev.frame.camera.width - 1, prev.frame.camera.height - 1])  # rims round beyond it
    pairs = [
        (there[mask][explained], sample_bilinear(before, pixels))
        for there, before in zip(curr.appearance.channels, prev.appearance.channels, strict=True)
    ]
    _, lightness, *hue = pairs
    alike = structural_similarity([lightness], settings.lightness_noise)
    return max(alike, structural_similarity(hue, settings.hue_noise), 0.0)


def structural_similarity(channels: list[tuple[Float32Array, Float32Array]], noise: float) -> float:
    """The structural similarity of values a (N,) and b (N,) in one or more channels, without their means.

    Args:
        channels: of a and b.
        noise: standard deviation of the noise, in the units of the values.

    Returns:
        -1..1.
    """
    stability = noise**2
    covariance = sum(float(((a - a.mean()) * (b - b.mean())).mean()) for a, b in channels)
    variance = sum(float(a.var() + b.var()) for a, b in channels)
    return (2 * covariance + stability) / (variance + stability)
