"""How badly a motion fits each pixel: by depth, by colour, and by how far the pixel is from what follows it."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.depth_noise import depth_sigma
from objectflow.typing import BoolMask, Float32Array, Float64Array, UInt8Array

Box = tuple[slice, slice]
EVERYWHERE: Box = (slice(None), slice(None))

COST_FREE_SPACE_VIOLATION = 6.0
"""The point would hang in front of what the previous frame saw there: it was not there."""
COST_HIDDEN = 2.0
"""The point would have been hidden: possible, but a motion that shows it is better."""
HIDDEN_AT = 2.0
"""Sigmas behind the surface seen in the previous frame."""
COST_UNSEEN = 1.0
"""Outside the previous image, or no depth there: says nothing for or against."""


class AppearanceFeatures:
    """A frame's colour, taken apart so that shadows count little: they travel with what casts them.

    Attributes:
        channels: texture (lightness less its local mean), lightness, and two colour-opponent channels (CIELAB).
        contrast: of each channel around each pixel.
    """

    TOLERANCES = ((8.0, 0.35), (40.0, 0.35), (8.0, 0.35), (8.0, 0.35))
    """For each channel: grey levels that cost 0.5, and how much of the local contrast comes on top."""

    def __init__(self, color: UInt8Array) -> None:
        lab = cv2.cvtColor(color, cv2.COLOR_RGB2LAB).astype(np.float32)
        light = np.ascontiguousarray(lab[..., 0])
        texture = light - cv2.GaussianBlur(light, (0, 0), 4)
        self.channels = (texture, light, *(np.ascontiguousarray(lab[..., k]) for k in (1, 2)))
        size = np.ones((3, 3))
        self.contrast = tuple(cv2.dilate(channel, size) - cv2.erode(channel, size) for channel in self.channels)


def motion_cost(
    prev: RgbdFrame,
    points: Float32Array,
    prev_T_curr: Float64Array,
    appearance: tuple[AppearanceFeatures, AppearanceFeatures] | None,
    box: Box = EVERYWHERE,
    *,
    blind: float | None = None,
) -> tuple[Float32Array, BoolMask]:
    """How badly a motion fits each pixel, as a negative log-likelihood.

    Args:
        prev: the previous frame.
        points: (H, W, 3) of the current frame, at the same size.
        prev_T_curr: the motion.
        appearance: of the previous and the current frame; None leaves colour out.
        box: rows and columns of the current frame to look at.
        blind: cost of what the previous frame does not show, in place of `COST_HIDDEN` and `COST_UNSEEN`.

    Returns:
        Both of the size of the box. (h, w) float32: 0 is a perfect fit, `COST_FREE_SPACE_VIOLATION` an impossible one;
        pixels without depth get `COST_UNSEEN` or `blind`.
        (h, w) bool: the pixel would have been hidden behind something.
    """
    camera = prev.camera
    cost_hidden, cost_unseen = (COST_HIDDEN, COST_UNSEEN) if blind is None else (blind, blind)
    carried = geometry.transform(prev_T_curr, points[box])
    pixels = geometry.project(carried, camera)
    z = carried[..., 2]
    sigma = 1.4 * depth_sigma(np.nan_to_num(z, nan=1.0)) + 0.001
    with np.errstate(invalid="ignore"):
        inside = (
            (pixels[..., 0] > 0)
            & (pixels[..., 1] > 0)
            & (pixels[..., 0] < camera.width - 1)
            & (pixels[..., 1] < camera.height - 1)
        )
    u, v = np.where(inside, pixels[..., 0], 0), np.where(inside, pixels[..., 1], 0)
    u0, v0 = u.astype(np.int32), v.astype(np.int32)
    offset = np.full(z.shape, np.inf, np.float32)
    # The best of the four neighbours: at a depth edge a mean of two surfaces would fit neither.
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        seen = prev.depth[np.minimum(v0 + dv, camera.height - 1), np.minimum(u0 + du, camera.width - 1)]
        candidate = np.where(seen > 0, z - seen, np.inf)
        offset = np.where(np.abs(candidate) < np.abs(offset), candidate, offset)
    known = inside & np.isfinite(offset) & np.isfinite(z)
    scaled = np.where(known, offset, 0) / sigma
    cost = 0.5 * np.minimum(scaled**2, 9)
    if appearance is not None:
        cost = cost + _color_cost(*appearance, u.astype(np.float32), v.astype(np.float32), box)
    # Behind what was seen there: at two sigma being hidden costs as much as a bad measurement would, and from there on
    # it is the better reading. Just behind is odder than far behind: it takes a thin thing, or a misfit.
    hidden = known & (scaled > HIDDEN_AT)
    cost = np.where(scaled < -3, COST_FREE_SPACE_VIOLATION, np.where(hidden, cost_hidden + (scaled < 6), cost))
    cost = np.where(known, np.minimum(cost, COST_FREE_SPACE_VIOLATION), cost_unseen).astype(np.float32)
    return cost, hidden


def motion_confidence(cost: Float32Array, gain: Float32Array) -> float:
    """How sure it is that pixels follow a motion: the share that it explains, less where a rival explains them too.

    Args:
        cost: (N,) of the pixels under the motion.
        gain: (N,) by how much more they cost under the rival.

    Returns:
        0..1, to four digits.
    """
    fit = float((cost < 2).mean())
    return round(fit * (1 - float(np.exp(-2 * max(0.0, float(gain.mean()))))), 4)


def _color_cost(
    prev: AppearanceFeatures, curr: AppearanceFeatures, u: Float32Array, v: Float32Array, box: Box
) -> Float32Array:
    """Up to 2: the look at (u, v) in `prev` against the box' own; edges may be off by half a pixel."""
    cost = np.zeros(u.shape, np.float32)
    for channel, (tolerance, slack) in enumerate(AppearanceFeatures.TOLERANCES):
        warped = cv2.remap(prev.channels[channel], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        own, contrast = curr.channels[channel][box], curr.contrast[channel][box]
        cost += ((warped - own) / (tolerance + slack * contrast)) ** 2
    return np.asarray(np.minimum(0.5 * cost, 2), dtype=np.float32)
