"""Colour as a real camera would see it: exposure, white balance, blur, shot and read noise; batched torch."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class ColorSensor:
    """Ranges from which each image's errors are drawn.

    Sources: noise whose variance is linear in the linear signal, `gain I + read^2`: Foi et al., IEEE TIP 2008. The
    display curve is taken as gamma 2.2. The ranges are chosen here, for indoor webcams.
    """

    exposure: float = 0.35
    """Stops (factors of two): standard deviation of the exposure."""
    balance: float = 0.04
    """Standard deviation of the logarithm of the red and blue gains."""
    blur: tuple[float, float] = (0.0, 1.0)
    """Pixels: range of the standard deviation of the lens's blur."""
    gain: tuple[float, float] = (0.0, 0.004)
    """Range of the shot noise's variance at full signal, linear signal 0..1."""
    read: tuple[float, float] = (0.0, 0.004)
    """Range of the read noise's standard deviation, linear signal 0..1."""


def observe_color(color: Tensor, sensor: ColorSensor, generator: torch.Generator, images_each: int = 1) -> Tensor:
    """Colour with a camera's errors.

    Args:
        color: (B, 3, H, W) float, 0..1 as displayed, RGB.
        sensor: the ranges.
        generator: on the tensor's device; the only source of randomness.
        images_each: this many consecutive images share exposure, white balance, blur and noise level, as the two
            frames of a pair do; each still has noise of its own. B must be divisible by it.

    Returns:
        (B, 3, H, W) float, 0..1 in steps of 1/255.
    """
    groups = color.shape[0] // images_each

    def draw(*shape: int) -> Tensor:
        return torch.rand(groups, *shape, generator=generator, device=color.device, dtype=color.dtype)

    def draw_normal() -> Tensor:
        return torch.randn(groups, 1, 1, 1, generator=generator, device=color.device, dtype=color.dtype)

    def each(values: Tensor) -> Tensor:
        return values.repeat_interleave(images_each, 0)

    # 1. Light: exposure for all channels, balance for red and blue.
    linear = color.clamp(0, 1) ** 2.2
    exposure = torch.exp2(sensor.exposure * draw_normal())
    balance = torch.cat([draw_normal(), torch.zeros_like(exposure), draw_normal()], 1)
    linear = linear * each(exposure * torch.exp(sensor.balance * balance))
    # 2. Lens.
    sigma = each(_within(sensor.blur, draw(1)))[:, 0]
    linear = _blur_each(linear, sigma)
    # 3. Chip: noise in the linear signal, saturation, then the display curve and 8 bits.
    gain, read = each(_within(sensor.gain, draw(1, 1, 1))), each(_within(sensor.read, draw(1, 1, 1)))
    noise = torch.randn(color.shape, generator=generator, device=color.device, dtype=color.dtype)
    linear = (linear + noise * (gain * linear + read**2).sqrt()).clamp(0, 1)
    return (linear ** (1 / 2.2) * 255).round() / 255


def luminance(color: Tensor) -> Tensor:
    """(B, 3, H, W) RGB in 0..1 -> (B, H, W), ITU-R BT.709 weights."""
    return 0.2126 * color[:, 0] + 0.7152 * color[:, 1] + 0.0722 * color[:, 2]


def _within(bounds: tuple[float, float], unit: Tensor) -> Tensor:
    return bounds[0] + (bounds[1] - bounds[0]) * unit


def _blur_each(image: Tensor, sigma: Tensor) -> Tensor:
    """Gaussian blur of (B, C, H, W) with one sigma (B,) an image, in pixels; edges repeated."""
    largest = float(sigma.max())
    if largest <= 0:
        return image
    batch, channels, height, width = image.shape
    radius = max(1, math.ceil(2.5 * largest))
    x = torch.arange(-radius, radius + 1, device=image.device, dtype=image.dtype)
    kernel = torch.exp(-0.5 * (x / sigma.clamp_min(1e-3)[:, None]) ** 2)
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(channels, 0)
    # One group a channel of an image, so that every image has its own kernel in one call.
    flat = functional.pad(image.reshape(1, batch * channels, height, width), (radius,) * 4, mode="replicate")
    flat = functional.conv2d(flat, kernel[:, None, None, :], groups=batch * channels)
    flat = functional.conv2d(flat, kernel[:, None, :, None], groups=batch * channels)
    return flat.view(batch, channels, height, width)
