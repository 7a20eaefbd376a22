"""Depth as three kinds of sensor would see it: structured light, time of flight, stereo; batched torch.

Each function takes exact depth (B, H, W) in metres with 0 = missing, luminance (B, H, W) in 0..1, intrinsics
(B, 4) as fx, fy, cx, cy in pixels, and returns noisy depth of the same form. A lost pixel becomes 0.
Randomness comes from the generator alone, which must live on the tensors' device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from objectflow.sensors import depth_maps as maps


@dataclass(frozen=True)
class StructuredLight:
    """A projector beside a camera, as in the RealSense SR300 and the first Kinect.

    Sources: baseline, focal length and range: SR300, as in the paper's generator. Quantisation in steps of 1/8 pixel,
    disparity noise of 1/6 step and lateral noise: Barron and Malik, CVPR 2013, used again by Handa et al., ICRA 2014.
    Lateral noise that grows with slant: Nguyen, Izadi and Lovell, 3DIMPVT 2012. Losses at edges and on dark or slanted
    surfaces: their form is known from all such sensors, their thresholds are chosen here.
    """

    baseline: float = 0.048
    """Metres from the camera to the projector, along +x."""
    focal: float = 472.93
    """Pixels, of the sensor's own image (640x480). Noise in pixels is scaled to the image at hand."""
    steps: float = 8.0
    """Disparity steps a pixel of the sensor."""
    disparity_sigma: float = 1 / 6
    """Disparity noise, in steps."""
    lateral_sigma: float = 0.8
    """Pixels of the sensor, facing surface."""
    lateral_slant: float = 0.035
    """Pixels of the sensor, times slant / (90 degrees - slant)."""
    edge_loss: float = 0.5
    """Probability that a pixel beside a depth step of more than one pixel of disparity is lost."""
    dark: float = 0.012
    """Returned light (white, facing, 0.5 m: 1) at which half of the pixels are lost."""
    grazing: float = 0.17
    """Cosine of slant (about 80 degrees) at which half of the pixels are lost."""
    near: float = 0.2
    """Metres: nothing nearer is measured."""
    far: float = 1.5
    """Metres: nothing further is measured."""


@dataclass(frozen=True)
class TimeOfFlight:
    """A phase-measuring camera, as in the second Kinect and the Azure Kinect.

    Sources: noise inverse to the returned amplitude: Lange and Seitz, IEEE JQE 2001. The periodic 'wiggling' error:
    Lindner et al., CVIU 2010. Mixed 'flying' pixels at edges: Sabov and Kruger, SCCG 2008. The amounts are chosen here
    to lie within the Azure Kinect's published random error (17 mm at most) and systematic error (11 mm at most).
    """

    sigma: float = 0.001
    """Metres, for the returned light of a white, facing surface at 0.5 m."""
    sigma_limit: float = 0.017
    """Metres: a pixel with more noise than this is dropped."""
    wiggle: float = 0.002
    """Metres, amplitude of the periodic error."""
    modulation: float = 80e6
    """Hz; the range is unique up to c / 2f, and the error has four periods in it."""
    spread: float = 0.6
    """Pixels: standard deviation of the lens's blur, which mixes front and back at edges."""
    stray: float = 0.01
    """Share of a pixel's light that came by its surroundings, on a longer way."""
    near: float = 0.15
    """Metres: nothing nearer is measured."""
    far: float = 3.0
    """Metres: nothing further is measured."""


@dataclass(frozen=True)
class Stereo:
    """Two cameras and a matching window, as in the RealSense D400; with or without a pattern projector.

    Sources: baseline, and sub-pixel error of 0.08 pixel, which makes depth noise `z^2 0.08 / (f b)`: Intel's D400
    tuning guide. Steps of 1/32 pixel: the D4 processor's data sheet. Errors as wide as the window and edges fattened
    by it: Scharstein and Szeliski, IJCV 2002. Thresholds are chosen here.
    """

    baseline: float = 0.05
    """Metres from the left to the right camera, along +x."""
    focal: float = 640.0
    """Pixels, of the sensor's own image. Noise in pixels is scaled to the image at hand."""
    steps: float = 32.0
    """Disparity steps a pixel of the sensor."""
    disparity_sigma: float = 0.08
    """Pixels of the sensor."""
    window: int = 2
    """Pixels: half of the matching window; noise is smooth over it."""
    wobble: float = 1.0
    """Pixels: how far edges wander off, smooth over the window."""
    edge_loss: float = 0.3
    """Probability that a pixel beside a depth step of more than one pixel of disparity is lost."""
    active: bool = True
    """A projected pattern gives plain surfaces texture. Without it they are lost."""
    texture: float = 0.01
    """Standard deviation of luminance in the window at which half of the pixels are lost, without a pattern."""
    near: float = 0.15
    """Metres: nothing nearer is measured."""
    far: float = 4.0
    """Metres: nothing further is measured."""


DepthSensor = StructuredLight | TimeOfFlight | Stereo


def structured_light(
    depth: Tensor, luminance: Tensor, intrinsics: Tensor, sensor: StructuredLight, generator: torch.Generator
) -> Tensor:
    """Depth (B, H, W) in metres as a structured-light sensor sees it."""
    inverse = maps.inverse_depth(depth)
    slope_x, slope_y, step = maps.slopes(inverse)
    cos = maps.cosine(inverse, slope_x, slope_y, intrinsics)
    pixel_metres = intrinsics[:, 0] * sensor.baseline
    scale = (intrinsics[:, 0] / sensor.focal)[:, None, None]

    # 1. What the projector does not reach, cannot be told apart at edges, or comes back too weakly.
    gone = maps.shadow(inverse, pixel_metres) | (depth < sensor.near) | (depth > sensor.far)
    gone |= _edge_loss(step, pixel_metres, sensor.edge_loss, generator)
    light = maps.returned_light(luminance, cos, depth)
    gone |= maps.lost(torch.sigmoid(4 * (1 - light / sensor.dark)), generator)
    gone |= maps.lost(torch.sigmoid(12 * (1 - cos / sensor.grazing)), generator)

    # 2. The lateral error: the surface is measured at a pixel beside.
    slant = torch.acos(cos).clamp_max(math.radians(85))
    sigma = scale * (sensor.lateral_sigma + sensor.lateral_slant * slant / (math.pi / 2 - slant))
    dx, dy = (maps.normal_noise(depth, generator) * sigma for _ in range(2))
    inverse = maps.displaced(inverse, slope_x, slope_y, dx, dy)

    # 3. The axial error: disparity in whole steps, after noise.
    unit = sensor.focal * sensor.baseline * sensor.steps
    noisy = unit * inverse + sensor.disparity_sigma * maps.normal_noise(depth, generator)
    inverse = torch.where(inverse > 0, noisy.round() / unit, torch.zeros_like(inverse))
    return torch.where(gone, torch.zeros_like(depth), maps.depth_of(inverse))


def time_of_flight(
    depth: Tensor, luminance: Tensor, intrinsics: Tensor, sensor: TimeOfFlight, generator: torch.Generator
) -> Tensor:
    """Depth (B, H, W) in metres as a time-of-flight camera sees it."""
    inverse = maps.inverse_depth(depth)
    slope_x, slope_y, _ = maps.slopes(inverse)
    light = maps.returned_light(luminance, maps.cosine(inverse, slope_x, slope_y, intrinsics), depth)

    # 1. The lens mixes neighbours, each as bright as it is: flying pixels between front and back.
    known = (depth > 0).to(depth.dtype)
    weight = (light + 1e-4) * known
    mixed = _blur(depth * weight, sensor.spread) / _blur(weight, sensor.spread).clamp_min(1e-9)
    # 2. Stray light arrives later than the direct light, never sooner.
    around = _blur(depth * known, 8.0) / _blur(known, 8.0).clamp_min(1e-9)
    mixed = mixed + sensor.stray * (around - mixed).clamp_min(0)
    # 3. Imperfect modulation, then shot noise.
    period = 299_792_458 / (2 * sensor.modulation) / 4
    mixed = mixed + sensor.wiggle * torch.sin(2 * math.pi * mixed / period)
    sigma = sensor.sigma / light.clamp_min(1e-6).sqrt()
    noisy = mixed + sigma.clamp_max(sensor.sigma_limit) * maps.normal_noise(depth, generator)
    gone = (known == 0) | (depth < sensor.near) | (depth > sensor.far) | (sigma > sensor.sigma_limit)
    return torch.where(gone, torch.zeros_like(depth), noisy.clamp_min(0))


def stereo(depth: Tensor, luminance: Tensor, intrinsics: Tensor, sensor: Stereo, generator: torch.Generator) -> Tensor:
    """Depth (B, H, W) in metres as a stereo camera sees it from its left eye."""
    inverse = maps.inverse_depth(depth)
    slope_x, slope_y, step = maps.slopes(inverse)
    pixel_metres = intrinsics[:, 0] * sensor.baseline
    scale = (intrinsics[:, 0] / sensor.focal)[:, None, None]

    # 1. What the right eye does not see, and what has nothing to match.
    gone = maps.shadow(inverse, pixel_metres) | (depth < sensor.near) | (depth > sensor.far)
    gone |= _edge_loss(step, pixel_metres, sensor.edge_loss, generator)
    if not sensor.active:
        mean = _window_mean(luminance, sensor.window)
        contrast = (_window_mean(luminance**2, sensor.window) - mean**2).clamp_min(0).sqrt()
        gone |= maps.lost(torch.sigmoid(4 * (1 - contrast / sensor.texture)), generator, sensor.window)

    # 2. The matching window: edges wander, errors are as wide as it is.
    dx, dy = (maps.normal_noise(depth, generator, sensor.window) * sensor.wobble * scale for _ in range(2))
    wandered = maps.displaced(inverse, slope_x, slope_y, dx, dy)
    near_edge = maps.widened(step * pixel_metres[:, None, None] > 1, sensor.window) > 0
    inverse = torch.where(near_edge, wandered, inverse)
    unit = sensor.focal * sensor.baseline * sensor.steps
    noise = sensor.steps * sensor.disparity_sigma * maps.normal_noise(depth, generator, sensor.window)
    noisy = unit * inverse + noise
    inverse = torch.where(inverse > 0, noisy.round() / unit, torch.zeros_like(inverse))
    return torch.where(gone, torch.zeros_like(depth), maps.depth_of(inverse))


def _edge_loss(step: Tensor, pixel_metres: Tensor, probability: float, generator: torch.Generator) -> Tensor:
    at_edge = maps.widened(step * pixel_metres.abs()[:, None, None] > 1, 1)
    return maps.lost(probability * at_edge, generator)


def _blur(image: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of (B, H, W), edges repeated."""
    radius = max(1, math.ceil(2.5 * sigma))
    x = torch.arange(-radius, radius + 1, device=image.device, dtype=image.dtype)
    kernel = torch.exp(-0.5 * (x / sigma) ** 2)
    kernel = kernel / kernel.sum()
    padded = functional.pad(image[:, None], (radius, radius, radius, radius), mode="replicate")
    rows = functional.conv2d(padded, kernel.view(1, 1, 1, -1))
    return functional.conv2d(rows, kernel.view(1, 1, -1, 1))[:, 0]


def _window_mean(image: Tensor, radius: int) -> Tensor:
    padded = functional.pad(image[:, None], (radius, radius, radius, radius), mode="replicate")
    return functional.avg_pool2d(padded, 2 * radius + 1, stride=1)[:, 0]
