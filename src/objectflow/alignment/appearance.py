"""Colour in channels that a change of light, such as a shadow, affects little."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow.typing import UInt8Array


def to_gray(color: UInt8Array) -> UInt8Array:
    """(H, W, 3) RGB -> (H, W) uint8."""
    return np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


class AppearanceFeatures:
    """Colour of a frame in four channels, of which shadows change only lightness much.

    Shadows move with the objects that cast them, so lightness is weak evidence of motion.

    Attributes:
        channels: texture (lightness minus its local mean), lightness, and the two colour-opponent channels of CIELAB.
        contrast: local range of each channel, over 3x3 pixels.
    """

    def __init__(self, color: UInt8Array) -> None:
        lab = cv2.cvtColor(color, cv2.COLOR_RGB2LAB).astype(np.float32)
        light = np.ascontiguousarray(lab[..., 0])
        texture = light - cv2.GaussianBlur(light, (0, 0), 4)
        self.channels = (texture, light, *(np.ascontiguousarray(lab[..., k]) for k in (1, 2)))
        size = np.ones((3, 3))
        self.contrast = tuple(cv2.dilate(channel, size) - cv2.erode(channel, size) for channel in self.channels)
