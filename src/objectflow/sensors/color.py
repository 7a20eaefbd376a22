"""Colour errors of a real camera: exposure, white balance, blur, shot and read noise; batched torch."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class ColorSensor:
    """Distributions of each image's errors.

    The noise variance is linear in the linear signal, `gain I + read^2` (Foi et al., IEEE TIP 2008). The display curve
    is gamma 2.2. The ranges are our choice for indoor webcams.
    """

    exposure: float = 0.35
    """Standard deviation of the exposure, stops (factors of two)."""
    balance: float = 0.04
    """Standard deviation of the natural logarithm of the red and blue gains."""
    blur: tuple[float, float] = (0.0, 1.0)
    """Range of the standard deviation of the lens blur, pixels."""
    gain: tuple[float, float] = (0.0, 0.004)
    """Range of the shot noise variance at full signal, for a linear signal of 0..1."""
    read: tuple[float, float] = (0.0, 0.004)
    """Range of the standard deviation of the read noise, for a linear signal of 0..1."""
    frame_exposure: float = 0.0
    """Standard deviation of the change of the exposure of each image within a group, stops: automatic exposure."""
    frame_balance: float = 0.0
    """Standard deviation of the change of the natural logarithm of the red and blue gains of each image in a group."""
    frame_gamma: float = 0.0
    """Standard deviation of the natural logarithm of each image's exponent of display values."""


def observe_color(color: Tensor, sensor: ColorSensor, generator: torch.Generator, images_each: int = 1) -> Tensor:
    """Add a camera's errors to colour images.

    Args:
        color: (B, 3, H, W) float, RGB display values 0..1.
        sensor: distributions of the errors.
        generator: on the tensor's device; the only source of randomness.
        images_each: number of consecutive images that share exposure, white balance, blur and noise level, as the two
            frames of a pair do; their noise is independent. B must be divisible by it.

    Returns:
        (B, 3, H, W) float, RGB display values 0..1 in steps of 1/255.
    """
    groups = color.shape[0] // images_each

    def draw(*shape: int) -> Tensor:
        return torch.rand(groups, *shape, generator=generator, device=color.device, dtype=color.dtype)

    def draw_normal() -> Tensor:
        return torch.randn(groups, 1, 1, 1, generator=generator, device=color.device, dtype=color.dtype)

    def each(values: Tensor) -> Tensor:
        return values.repeat_interleave(images_each, 0)

    # 1. Exposure for all channels, white balance for red and blue.
    linear = color.clamp(0, 1) ** 2.2
    exposure = torch.exp2(sensor.exposure * draw_normal())
    balance = torch.cat([draw_normal(), torch.zeros_like(exposure), draw_normal()], 1)
    linear = linear * each(exposure * torch.exp(sensor.balance * balance))
    exponent = torch.ones((), device=color.device, dtype=color.dtype)
    if max(sensor.frame_exposure, sensor.frame_balance, sensor.frame_gamma) > 0:
        own = torch.randn(color.shape[0], 4, 1, 1, generator=generator, device=color.device, dtype=color.dtype)
        tint = own[:, :3] * own.new_tensor([1.0, 0.0, 1.0])[:, None, None]
        linear = linear * torch.exp2(sensor.frame_exposure * own[:, 1:2]) * torch.exp(sensor.frame_balance * tint)
        exponent = torch.exp(sensor.frame_gamma * own[:, 3:])
    # 2. Lens blur.
    sigma = each(_within(sensor.blur, draw(1)))[:, 0]
    linear = _blur_each(linear, sigma)
    # 3. Noise in the linear signal, saturation, display curve and quantisation to 8 bits.
    gain, read = each(_within(sensor.gain, draw(1, 1, 1))), each(_within(sensor.read, draw(1, 1, 1)))
    noise = torch.randn(color.shape, generator=generator, device=color.device, dtype=color.dtype)
    linear = (linear + noise * (gain * linear + read**2).sqrt()).clamp(0, 1)
    return (linear ** (exponent / 2.2) * 255).round() / 255


def luminance(color: Tensor) -> Tensor:
    """(B, 3, H, W) RGB in 0..1 -> (B, H, W) luma, ITU-R BT.709 weights."""
    return 0.2126 * color[:, 0] + 0.7152 * color[:, 1] + 0.0722 * color[:, 2]


def _within(bounds: tuple[float, float], unit: Tensor) -> Tensor:
    return bounds[0] + (bounds[1] - bounds[0]) * unit


def _blur_each(image: Tensor, sigma: Tensor) -> Tensor:
    """Gaussian blur of (B, C, H, W) with one sigma (B,) per image, in pixels; edges are repeated."""
    largest = float(sigma.max())
    if largest <= 0:
        return image
    batch, channels, height, width = image.shape
    radius = max(1, math.ceil(2.5 * largest))
    x = torch.arange(-radius, radius + 1, device=image.device, dtype=image.dtype)
    kernel = torch.exp(-0.5 * (x / sigma.clamp_min(1e-3)[:, None]) ** 2)
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(channels, 0)
    # With one group per image and channel, a single call applies a different kernel to every image.
    flat = functional.pad(image.reshape(1, batch * channels, height, width), (radius,) * 4, mode="replicate")
    flat = functional.conv2d(flat, kernel[:, None, None, :], groups=batch * channels)
    flat = functional.conv2d(flat, kernel[:, None, :, None], groups=batch * channels)
    return flat.view(batch, channels, height, width)
