"""Response of a camera with automatic exposure: its tone curve, and the changes between two frames of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.typing import Float64Array, UInt8Array


@dataclass(frozen=True)
class ResponseSettings:
    """Distributions of a camera's response, shared by both frames of a pair, and of its change between them."""

    exposure: float = 0.25
    """Standard deviation of the exposure, stops."""
    gamma: float = 0.12
    """Standard deviation of the natural logarithm of the exponent applied to display values."""
    balance: float = 0.05
    """Standard deviation of the natural logarithm of the red and blue gains."""
    saturation: tuple[float, float] = (0.65, 1.2)
    """Range of the factor on the colours' distance from grey."""
    steady: float = 0.35
    """Share of pairs whose response does not change between the frames, 0..1."""
    exposure_change: float = 0.14
    """Standard deviation of the change of the exposure, stops."""
    gamma_change: float = 0.05
    """Standard deviation of the change of the exponent's natural logarithm."""
    balance_change: float = 0.025
    """Standard deviation of the change of the natural logarithm of the red and blue gains."""


@dataclass(frozen=True, eq=False)
class ColorResponse:
    """The response in one frame: `out = (gain * in ^ 2.2) ^ (exponent / 2.2)`, then the saturation."""

    gain: Float64Array
    """(3,) factors on linear red, green and blue."""
    exponent: float
    saturation: float

    def apply(self, color: UInt8Array) -> UInt8Array:
        """Map an image (H, W, 3) uint8 RGB to the camera's image of the same form."""
        levels = (np.arange(256) / 255) ** 2.2
        table = np.minimum(levels[:, None] * self.gain, 1.0) ** (self.exponent / 2.2)
        out = np.stack([table[color[..., channel], channel] for channel in range(3)], axis=-1)
        grey = out.mean(axis=-1, keepdims=True)
        display = np.rint(255 * np.clip(grey + self.saturation * (out - grey), 0, 1))
        return np.asarray(display, dtype=np.uint8)


def draw_responses(rng: np.random.Generator, settings: ResponseSettings) -> tuple[ColorResponse, ColorResponse]:
    """Draw the response in the previous and in the current frame of a pair."""
    base = rng.normal(size=4) * (settings.exposure, settings.gamma, settings.balance, settings.balance)
    changes = (settings.exposure_change, settings.gamma_change, settings.balance_change, settings.balance_change)
    change = rng.normal(size=4) * changes * (rng.random() >= settings.steady)
    saturation = float(rng.uniform(*settings.saturation))
    previous, current = (
        ColorResponse(
            gain=2.0**exposure * np.exp([red, 0.0, blue]), exponent=float(np.exp(gamma)), saturation=saturation
        )
        for exposure, gamma, red, blue in (base, base + change)
    )
    return previous, current
