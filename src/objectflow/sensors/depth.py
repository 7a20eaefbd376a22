"""Depth errors of three kinds of sensor: structured light, time of flight, stereo; batched torch.

Each function takes exact depth (B, H, W) in metres with 0 = missing, luminance (B, H, W) in 0..1 and intrinsics
(B, 4) as fx, fy, cx, cy in pixels, and returns noisy depth of the same form. Invalid pixels become 0.
The generator, on the tensors' device, is the only source of randomness.
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
    """A camera and a pattern projector, as in the RealSense SR300 and the first Kinect.

    Sources: baseline, focal length and range of the SR300, as in the paper's generator. Quantisation in steps of 1/8
    pixel, disparity noise of 1/6 step and lateral noise: Barron and Malik, CVPR 2013, also used by Handa et al., ICRA
    2014. Lateral noise that grows with slant: Nguyen, Izadi and Lovell, 3DIMPVT 2012. Dropout at edges and on dark or
    slanted surfaces is common to these sensors; its thresholds are our choice.
    """

    baseline: float = 0.048
    """Distance from the camera to the projector along +x, metres."""
    focal: float = 472.93
    """Focal length of the sensor's own image (640x480), pixels. Noise in pixels is scaled to the given image."""
    steps: float = 8.0
    """Number of disparity steps per pixel of the sensor."""
    disparity_sigma: float = 1 / 6
    """Standard deviation of the disparity noise, steps."""
    lateral_sigma: float = 0.8
    """Standard deviation of the lateral noise on a frontal surface, pixels of the sensor."""
    lateral_slant: float = 0.035
    """Additional lateral noise in units of slant / (90 degrees - slant), pixels of the sensor."""
    edge_loss: float = 0.5
    """Dropout probability of pixels at a depth step of more than one pixel of disparity."""
    dark: float = 0.012
    """Returned light at which half of the pixels drop out; 1 for a white frontal surface at 0.5 m."""
    grazing: float = 0.17
    """Cosine of the slant at which half of the pixels drop out; 0.17 is about 80 degrees."""
    near: float = 0.2
    """Minimum measured depth, metres."""
    far: float = 1.5
    """Maximum measured depth, metres."""


@dataclass(frozen=True)
class TimeOfFlight:
    """A phase-measuring camera, as in the second Kinect and the Azure Kinect.

    Sources: noise inversely proportional to the returned amplitude: Lange and Seitz, IEEE JQE 2001. Periodic
    'wiggling' error: Lindner et al., CVIU 2010. Mixed 'flying' pixels at edges: Sabov and Kruger, SCCG 2008. The
    magnitudes are our choice within the Azure Kinect's published random (at most 17 mm) and systematic errors (at most
    11 mm).
    """

    sigma: float = 0.001
    """Standard deviation of the noise for the returned light of a white frontal surface at 0.5 m, metres."""
    sigma_limit: float = 0.017
    """Standard deviation of the noise above which pixels are invalid, metres."""
    wiggle: float = 0.002
    """Amplitude of the periodic error, metres."""
    modulation: float = 80e6
    """Modulation frequency f, Hz; depth is unambiguous up to c / 2f, which contains four periods of the error."""
    spread: float = 0.6
    """Standard deviation of the lens blur, which mixes front and back at edges, pixels."""
    stray: float = 0.01
    """Share of multi-path light from a pixel's surroundings, 0..1."""
    near: float = 0.15
    """Minimum measured depth, metres."""
    far: float = 3.0
    """Maximum measured depth, metres."""


@dataclass(frozen=True)
class Stereo:
    """Two cameras and window matching, as in the RealSense D400, with or without a pattern projector.

    Sources: baseline and sub-pixel error of 0.08 pixel, which gives a depth noise of `z^2 0.08 / (f b)`: Intel's D400
    tuning guide. Steps of 1/32 pixel: the D4 processor's data sheet. Errors correlated over the window, and edge
    fattening: Scharstein and Szeliski, IJCV 2002. The thresholds are our choice.
    """

    baseline: float = 0.05
    """Distance from the left to the right camera along +x, metres."""
    focal: float = 640.0
    """Focal length of the sensor's own image, pixels. Noise in pixels is scaled to the given image."""
    steps: float = 32.0
    """Number of disparity steps per pixel of the sensor."""
    disparity_sigma: float = 0.08
    """Standard deviation of the disparity noise, pixels of the sensor."""
    window: int = 2
    """Radius of the matching window, over which noise is correlated, pixels."""
    wobble: float = 1.0
    """Standard deviation of the displacement of edges, correlated over the window, pixels of the sensor."""
    edge_loss: float = 0.3
    """Dropout probability of pixels at a depth step of more than one pixel of disparity."""
    active: bool = True
    """Whether a pattern is projected; without one, surfaces without texture drop out."""
    texture: float = 0.01
    """Standard deviation of luminance in the window at which half of the pixels drop out without a pattern."""
    patch: int = 0
    """Radius of the patches over which a part of the errors is correlated by the matcher's smoothing, pixels."""
    patch_share: float = 0.0
    """Share of the noise variance that is correlated over patches, 0..1."""
    unevenness: float = 0.0
    """Standard deviation of the natural logarithm of the noise level, which varies over patches and between frames."""
    fattening: float = 0.0
    """Mean width by which foreground grows over background at depth steps, pixels of the sensor."""
    hole_loss: float = 0.0
    """Dropout probability, in patches, of surfaces without texture, although a pattern is projected."""
    near: float = 0.15
    """Minimum measured depth, metres."""
    far: float = 4.0
    """Maximum measured depth, metres."""


DepthSensor = StructuredLight | TimeOfFlight | Stereo


def structured_light(
    depth: Tensor, luminance: Tensor, intrinsics: Tensor, sensor: StructuredLight, generator: torch.Generator
) -> Tensor:
    """Depth (B, H, W) in metres as measured by a structured-light sensor."""
    inverse = maps.inverse_depth(depth)
    slope_x, slope_y, step = maps.slopes(inverse)
    cos = maps.cosine(inverse, slope_x, slope_y, intrinsics)
    pixel_metres = intrinsics[:, 0] * sensor.baseline
    scale = (intrinsics[:, 0] / sensor.focal)[:, None, None]

    # 1. Dropout: projector shadow, range, edges, dark or slanted surfaces.
    invalid = maps.occluded(inverse, pixel_metres) | (depth < sensor.near) | (depth > sensor.far)
    invalid |= _edge_dropout(step, pixel_metres, sensor.edge_loss, generator)
    light = maps.returned_light(luminance, cos, depth)
    invalid |= maps.draw_dropout(torch.sigmoid(4 * (1 - light / sensor.dark)), generator)
    invalid |= maps.draw_dropout(torch.sigmoid(12 * (1 - cos / sensor.grazing)), generator)

    # 2. Lateral error: the surface is measured at a neighbouring pixel.
    slant = torch.acos(cos).clamp_max(math.radians(85))
    sigma = scale * (sensor.lateral_sigma + sensor.lateral_slant * slant / (math.pi / 2 - slant))
    dx, dy = (maps.normal_noise(depth, generator) * sigma for _ in range(2))
    inverse = maps.shift_surface(inverse, slope_x, slope_y, dx, dy)

    # 3. Axial error: noise, then quantisation of disparity.
    unit = sensor.focal * sensor.baseline * sensor.steps
    noisy = unit * inverse + sensor.disparity_sigma * maps.normal_noise(depth, generator)
    inverse = torch.where(inverse > 0, noisy.round() / unit, torch.zeros_like(inverse))
    return torch.where(invalid, torch.zeros_like(depth), maps.depth_of(inverse))


def time_of_flight(
    depth: Tensor, luminance: Tensor, intrinsics: Tensor, sensor: TimeOfFlight, generator: torch.Generator
) -> Tensor:
    """Depth (B, H, W) in metres as measured by a time-of-flight camera."""
    inverse = maps.inverse_depth(depth)
    slope_x, slope_y, _ = maps.slopes(inverse)
    light = maps.returned_light(luminance, maps.cosine(inverse, slope_x, slope_y, intrinsics), depth)

    # 1. Lens blur mixes pixels, weighted by their light, which gives flying pixels between front and back.
    known = (depth > 0).to(depth.dtype)
    weight = (light + 1e-4) * known
    mixed = _blur(depth * weight, sensor.spread) / _blur(weight, sensor.spread).clamp_min(1e-9)
    # 2. Multi-path light arrives later than direct light, so that it only increases depth.
    around = _blur(depth * known, 8.0) / _blur(known, 8.0).clamp_min(1e-9)
    mixed = mixed + sensor.stray * (around - mixed).clamp_min(0)
    # 3. Imperfect modulation, then shot noise.
    period = 299_792_458 / (2 * sensor.modulation) / 4
    mixed = mixed + sensor.wiggle * torch.sin(2 * math.pi * mixed / period)
    sigma = sensor.sigma / light.clamp_min(1e-6).sqrt()
    noisy = mixed + sigma.clamp_max(sensor.sigma_limit) * maps.normal_noise(depth, generator)
    invalid = (known == 0) | (depth < sensor.near) | (depth > sensor.far) | (sigma > sensor.sigma_limit)
    return torch.where(invalid, torch.zeros_like(depth), noisy.clamp_min(0))


def stereo(depth: Tensor, luminance: Tensor, intrinsics: Tensor, sensor: Stereo, generator: torch.Generator) -> Tensor:
    """Depth (B, H, W) in metres as measured by a stereo camera, in its left image."""
    inverse = maps.inverse_depth(depth)
    slope_x, slope_y, step = maps.slopes(inverse)
    pixel_metres = intrinsics[:, 0] * sensor.baseline
    scale = (intrinsics[:, 0] / sensor.focal)[:, None, None]

    # 1. Dropout: occlusion in the right image, range, edges, missing texture.
    invalid = maps.occluded(inverse, pixel_metres) | (depth < sensor.near) | (depth > sensor.far)
    invalid |= _edge_dropout(step, pixel_metres, sensor.edge_loss, generator)
    if not sensor.active:
        invalid |= maps.draw_dropout(_textureless(luminance, sensor), generator, sensor.window)
    if sensor.hole_loss > 0:
        holes = sensor.hole_loss * _textureless(luminance, sensor)
        invalid |= maps.draw_dropout(holes, generator, max(sensor.patch, sensor.window))

    # 2. The matching window displaces edges, fattens the foreground and correlates errors.
    dx, dy = (maps.normal_noise(depth, generator, sensor.window) * sensor.wobble * scale for _ in range(2))
    displaced = maps.shift_surface(inverse, slope_x, slope_y, dx, dy)
    near_edge = maps.dilate(step * pixel_metres[:, None, None] > 1, sensor.window) > 0
    inverse = torch.where(near_edge, displaced, inverse)
    if sensor.fattening > 0:
        inverse = _fattened(inverse, step * pixel_metres[:, None, None] > 1, sensor.fattening * scale, generator)
    unit = sensor.focal * sensor.baseline * sensor.steps
    noisy = unit * inverse + sensor.steps * sensor.disparity_sigma * _matching_noise(depth, sensor, generator)
    inverse = torch.where(inverse > 0, noisy.round() / unit, torch.zeros_like(inverse))
    return torch.where(invalid, torch.zeros_like(depth), maps.depth_of(inverse))


def _textureless(luminance: Tensor, sensor: Stereo) -> Tensor:
    """Probability (B, H, W) that a pixel's matching window has too little texture for passive matching, 0..1."""
    mean = _window_mean(luminance, sensor.window)
    contrast = (_window_mean(luminance**2, sensor.window) - mean**2).clamp_min(0).sqrt()
    return torch.sigmoid(4 * (1 - contrast / sensor.texture))


def _matching_noise(like: Tensor, sensor: Stereo, generator: torch.Generator) -> Tensor:
    """Noise (B, H, W) of about unit variance: correlated over the window and over patches, of uneven level."""
    noise = maps.normal_noise(like, generator, sensor.window)
    if sensor.patch_share > 0:
        patches = maps.normal_noise(like, generator, sensor.patch)
        noise = math.sqrt(1 - sensor.patch_share) * noise + math.sqrt(sensor.patch_share) * patches
    if sensor.unevenness > 0:
        level = maps.normal_noise(like, generator, 2 * sensor.patch)
        # The median of the level is 1: most surfaces have the stated noise, some have much more.
        noise = noise * torch.exp(sensor.unevenness * level)
    return noise


def _fattened(inverse: Tensor, at_step: Tensor, width: Tensor, generator: torch.Generator) -> Tensor:
    """Inverse depth (B, H, W) in which foreground has grown at steps by `width` (B, 1, 1) pixels on average."""
    most = max(1, math.ceil(2 * float(width.max())))
    reach = (
        torch.special.ndtr(maps.normal_noise(inverse, generator, 2)) * 2 * width
    )  # uniform from 0 to twice the width
    for radius in range(most, 0, -1):
        near = maps.dilate(at_step, radius) > 0
        inverse = torch.where(near & (reach >= radius - 0.5), maps.dilate(inverse, radius).to(inverse.dtype), inverse)
    return inverse


def _edge_dropout(step: Tensor, pixel_metres: Tensor, probability: float, generator: torch.Generator) -> Tensor:
    at_edge = maps.dilate(step * pixel_metres.abs()[:, None, None] > 1, 1)
    return maps.draw_dropout(probability * at_edge, generator)


def _blur(image: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of (B, H, W) with sigma in pixels; edges are repeated."""
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
