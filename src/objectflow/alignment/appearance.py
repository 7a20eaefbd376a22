"""Colour in channels that a change of light, such as a shadow, affects little."""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from objectflow.typing import Float32Array, UInt8Array

_DARK = 8.0
"""Grey levels added to colours before ratios and logarithms are taken, which limits the noise of dark pixels."""


def to_gray(color: UInt8Array) -> UInt8Array:
    """(H, W, 3) RGB -> (H, W) uint8."""
    return np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


_LOCAL_MEAN = 4.0
"""Pixels: standard deviation of the window over which the local mean of lightness is taken."""
_LIGHT_FREE_BLUR = 0.8
"""Pixels: standard deviation of the blur before ratios of colours, which amplify noise, are taken."""
_LIGHT_FREE_MEAN = 2.0
"""Pixels: standard deviation of the window of the local mean of the logarithm of lightness."""


class AppearanceFeatures:
    """Colour of a frame in four channels, of which shadows change only lightness much.

    Shadows move with the objects that cast them, so lightness is weak evidence of motion.

    Attributes:
        channels: texture (lightness minus its local mean), lightness, and the two colour-opponent channels of CIELAB.
        contrast: local range of each channel, over 3x3 pixels.
    """

    def __init__(self, color: UInt8Array) -> None:
        self._color = color
        lab = cv2.cvtColor(color, cv2.COLOR_RGB2LAB).astype(np.float32)
        light = np.ascontiguousarray(lab[..., 0])
        texture = light - cv2.GaussianBlur(light, (0, 0), _LOCAL_MEAN)
        self.channels = (texture, light, *(np.ascontiguousarray(lab[..., k]) for k in (1, 2)))
        size = np.ones((3, 3))
        self.contrast = tuple(cv2.dilate(channel, size) - cv2.erode(channel, size) for channel in self.channels)

    @cached_property
    def light_free(self) -> tuple[Float32Array, Float32Array, Float32Array]:
        """Three channels that do not depend on the amount of light.

        Texture is the logarithm of lightness minus its local mean; the two chromaticities are ratios of colour
        differences to the sum of the colours.
        """
        rgb = cv2.GaussianBlur(self._color, (0, 0), _LIGHT_FREE_BLUR).astype(np.float32)
        red, green, blue = rgb[..., 0], rgb[..., 1], rgb[..., 2]
        total = red + green + blue + 3 * _DARK
        log = np.log(total)
        texture = log - cv2.GaussianBlur(log, (0, 0), _LIGHT_FREE_MEAN)
        first, second = (red - green) / total, (red + green - 2 * blue) / total
        return np.asarray(texture, dtype=np.float32), first.astype(np.float32), second.astype(np.float32)
