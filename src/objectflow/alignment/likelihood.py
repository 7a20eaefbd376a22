"""How badly a motion fits each pixel, as a negative log-likelihood of depth and colour."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment.appearance import AppearanceFeatures
from objectflow.frame import RgbdFrame
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, Float64Array

Box = tuple[slice, slice]
EVERYWHERE: Box = (slice(None), slice(None))


@dataclass(frozen=True)
class LikelihoodSettings(Settings):
    """Costs of the outcomes of comparing a pixel with the previous frame, in nats."""

    width: int = setting(320, minimum=16)
    """Pixels: wider frames are downscaled to it before motions are judged."""
    free_space_violation: float = setting(6.0, above=0)
    """A point in front of the surface that the previous frame measured there: impossible. The highest cost."""
    hidden: float = setting(2.0, minimum=0)
    """A point behind the measured surface: possible, but weaker evidence than a visible match."""
    hidden_sigmas: float = setting(2.0, above=0)
    """Standard deviations behind the measured surface from which a point counts as hidden."""
    unseen: float = setting(1.0, minimum=0)
    """A point outside the previous image or without depth there: no evidence."""
    noise_factor: float = setting(1.4, above=0)
    """Factor on the depth noise; 1.4 accounts for the noise of both frames."""
    extra_noise: float = setting(0.001, minimum=0)
    """Metres added to the standard deviation, for interpolation and registration of depth to colour."""
    max_color: float = setting(2.0, minimum=0)
    """Highest cost of a colour difference."""
    outlier_sigmas: float = setting(3.0, above=0)
    """Standard deviations from which a depth difference costs no more; in front of the surface, it violates free
    space from there."""
    far_behind_sigmas: float = setting(6.0, above=0)
    """Standard deviations behind the measured surface up to which being hidden costs 1 more."""
    texture_tolerance: float = setting(8.0, above=0)
    """Grey levels: difference of texture, which is lightness minus its local mean, that costs 0.5."""
    lightness_tolerance: float = setting(40.0, above=0)
    """The same of lightness; it is large since shadows change lightness."""
    color_tolerance: float = setting(8.0, above=0)
    """The same of each colour-opponent channel of CIELAB."""
    contrast_tolerance: float = setting(0.35, minimum=0)
    """Share of the local contrast that is added to each of these tolerances; it allows for half a pixel at edges."""

    light_cost: float = setting(0.3, minimum=0)
    """Cost of a change of light, such as a shadow: what the colours of a surface that stood still cost at least, where
    only the amount of light may have changed."""
    light_sigmas: float = setting(2.0, minimum=0)
    """Standard deviations of depth up to which a surface may have stood still under another light."""
    light_texture: float = setting(0.1, above=0)
    """Difference of the logarithm of lightness, minus its local mean, that costs 0.5 under another light."""
    light_chroma: float = setting(0.03, above=0)
    """Difference of chromaticity that costs 0.5 under another light."""


DEFAULTS = LikelihoodSettings()


def motion_cost(
    prev: RgbdFrame,
    points: Float32Array,
    prev_T_curr: Float64Array,
    appearance: tuple[AppearanceFeatures, AppearanceFeatures] | None,
    box: Box = EVERYWHERE,
    *,
    out_of_view: float | None = None,
    light: bool = False,
    noise: DepthNoise = STRUCTURED_LIGHT,
    settings: LikelihoodSettings = DEFAULTS,
) -> tuple[Float32Array, BoolMask]:
    """Cost of each pixel under a motion.

    Args:
        prev: the previous frame.
        points: (H, W, 3) metres of the current frame, at the same size.
        prev_T_curr: (4, 4) the motion.
        appearance: of the previous and the current frame; None leaves colour out.
        box: rows and columns of the current frame to evaluate.
        out_of_view: cost of points that the previous frame does not show, in place of `hidden` and `unseen`.
        light: whether the amount of light may differ where depth agrees, as it does on the background.
        noise: of the depth.
        settings: the costs.

    Returns:
        Both of the size of the box. (h, w) float32: 0 is a perfect fit, `free_space_violation` an impossible one;
        pixels without depth get `unseen` or `out_of_view`. (h, w) bool: whether the point would have been hidden.
    """
    camera = prev.camera
    hidden_cost, unseen_cost = (settings.hidden, settings.unseen) if out_of_view is None else (out_of_view,) * 2
    carried = geometry.transform(prev_T_curr, points[box])
    pixels = geometry.project(carried, camera)
    z = carried[..., 2]
    sigma = settings.noise_factor * noise.sigma(np.nan_to_num(z, nan=1.0)) + settings.extra_noise
    with np.errstate(invalid="ignore"):
        inside = (
            (pixels[..., 0] > 0)
            & (pixels[..., 1] > 0)
            & (pixels[..., 0] < camera.width - 1)
            & (pixels[..., 1] < camera.height - 1)
        )
    u, v = np.where(inside, pixels[..., 0], 0), np.where(inside, pixels[..., 1], 0)
    first, measured = v.astype(np.intp) * camera.width + u.astype(np.intp), prev.depth.ravel()
    right, below = min(1, camera.width - 1), camera.width * min(1, camera.height - 1)  # images may be one pixel wide
    offset = np.full(z.shape, np.inf, np.float32)
    # The best of the four neighbours: at a depth edge, interpolated depth would lie on neither surface.
    for step in (0, right, below, below + right):
        seen = measured.take(first + step)
        candidate = np.where(seen > 0, z - seen, np.inf)
        offset = np.where(np.abs(candidate) < np.abs(offset), candidate, offset)
    known = inside & np.isfinite(offset) & np.isfinite(z)
    scaled = np.where(known, offset, 0) / sigma
    cost = 0.5 * np.minimum(scaled**2, settings.outlier_sigmas**2)
    if appearance is not None:
        at = u.astype(np.float32), v.astype(np.float32)
        color = _color_cost(*appearance, *at, box, settings)
        if light:
            relit = _relit_cost(*appearance, *at, box, settings)
            color = np.where(np.abs(scaled) < settings.light_sigmas, np.minimum(color, relit), color)
        cost = cost + color
    # At `hidden_sigmas` behind the surface, being hidden becomes more probable than a measurement error. Far behind is
    # more probable than just behind, which takes a thin object or a wrong motion.
    hidden = known & (scaled > settings.hidden_sigmas)
    worst = settings.free_space_violation
    cost = np.where(hidden, hidden_cost + (scaled < settings.far_behind_sigmas), cost)
    cost = np.where(scaled < -settings.outlier_sigmas, worst, cost)
    cost = np.where(known, np.minimum(cost, worst), unseen_cost).astype(np.float32)
    return cost, hidden


EXPLAINED_COST = 2.0
"""Default of the largest cost of a pixel that a motion explains."""


def motion_confidence(cost: Float32Array, gain: Float32Array, explained_cost: float = EXPLAINED_COST) -> float:
    """Confidence that pixels follow a motion: the share that it explains, less where a rival explains them as well.

    Args:
        cost: (N,) of the pixels under the motion.
        gain: (N,) cost under the rival minus `cost`.
        explained_cost: largest cost of a pixel that the motion explains.

    Returns:
        0..1, to four digits.
    """
    fit = float((cost < explained_cost).mean())
    return round(fit * (1 - float(np.exp(-2 * max(0.0, float(gain.mean()))))), 4)


def _color_cost(
    prev: AppearanceFeatures,
    curr: AppearanceFeatures,
    u: Float32Array,
    v: Float32Array,
    box: Box,
    settings: LikelihoodSettings,
) -> Float32Array:
    """Colour at (u, v) in `prev` compared with the box of `curr`."""
    color = settings.color_tolerance
    tolerances = (settings.texture_tolerance, settings.lightness_tolerance, color, color)
    cost = np.zeros(u.shape, np.float32)
    for channel, tolerance in enumerate(tolerances):
        warped = cv2.remap(prev.channels[channel], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        own, contrast = curr.channels[channel][box], curr.contrast[channel][box]
        cost += ((warped - own) / (tolerance + settings.contrast_tolerance * contrast)) ** 2
    return np.asarray(np.minimum(0.5 * cost, settings.max_color), dtype=np.float32)


def _relit_cost(
    prev: AppearanceFeatures,
    curr: AppearanceFeatures,
    u: Float32Array,
    v: Float32Array,
    box: Box,
    settings: LikelihoodSettings,
) -> Float32Array:
    """Colour at (u, v) in `prev` compared with the box of `curr`, whatever the amount of light."""
    tolerances = (settings.light_texture, settings.light_chroma, settings.light_chroma)
    cost = np.zeros(u.shape, np.float32)
    for before, after, tolerance in zip(prev.light_free, curr.light_free, tolerances, strict=True):
        warped = cv2.remap(before, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        cost += ((warped - after[box]) / tolerance) ** 2
    return np.asarray(np.minimum(settings.light_cost + 0.5 * cost, settings.max_color), dtype=np.float32)
