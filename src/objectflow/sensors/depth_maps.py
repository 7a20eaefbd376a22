"""Maps that a depth sensor's errors depend on: slant, depth steps, occlusion, returned light; batched torch.

All functions use inverse depth `w = 1 / z`. It is linear in pixel coordinates on a plane, so that its slopes are exact
there under any perspective. Missing depth is `w = 0`.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def inverse_depth(depth: Tensor) -> Tensor:
    """Planar depth (B, H, W) in metres, 0 = missing -> inverse depth (B, H, W) in 1/m, 0 = missing."""
    return torch.where(depth > 0, 1 / depth.clamp_min(1e-6), torch.zeros_like(depth))


def depth_of(inverse: Tensor) -> Tensor:
    """Inverse depth (B, H, W) in 1/m -> depth in metres; values at or below 0 become missing."""
    return torch.where(inverse > 0, 1 / inverse.clamp_min(1e-6), torch.zeros_like(inverse))


def slopes(inverse: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Slopes of inverse depth along x and y, and the height of the depth step at each pixel.

    The smaller of the two one-sided differences is the slope of the pixel's own surface; the excess of the larger one
    is a step. Missing neighbours are ignored.

    Args:
        inverse: (B, H, W) in 1/m.

    Returns:
        Slopes along x and along y in 1/m per pixel, and the larger step of the two directions in 1/m; each (B, H, W).
    """
    (x, step_x), (y, step_y) = _one_sided(inverse, 2), _one_sided(inverse, 1)
    return x, y, torch.maximum(step_x, step_y)


def _one_sided(inverse: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    difference = inverse.diff(dim=dim)
    length = inverse.shape[dim]
    known = (inverse.narrow(dim, 1, length - 1) > 0) & (inverse.narrow(dim, 0, length - 1) > 0)
    difference = torch.where(known, difference, torch.full_like(difference, torch.inf))
    border = torch.full_like(inverse.narrow(dim, 0, 1), torch.inf)
    forward, backward = torch.cat([difference, border], dim), torch.cat([border, difference], dim)
    slope = torch.where(forward.abs() <= backward.abs(), forward, backward)
    other = torch.maximum(
        torch.where(forward.isinf(), torch.zeros_like(forward), forward.abs()),
        torch.where(backward.isinf(), torch.zeros_like(backward), backward.abs()),
    )
    slope = torch.where(slope.isinf(), torch.zeros_like(slope), slope)
    return slope, (other - slope.abs()).clamp_min(0)


def cosine(inverse: Tensor, slope_x: Tensor, slope_y: Tensor, intrinsics: Tensor) -> Tensor:
    """Cosine of the angle between each pixel's ray and its surface normal, (B, H, W) in 0..1.

    The plane `w = a u + b v + c` has the normal `(fx a, fy b, w - a (u - cx) - b (v - cy))`, whose dot product with
    the ray through the pixel is `w`.

    Args:
        inverse: (B, H, W) in 1/m.
        slope_x, slope_y: (B, H, W) in 1/m per pixel; see `slopes`.
        intrinsics: (B, 4): fx, fy, cx, cy in pixels.
    """
    height, width = inverse.shape[-2:]
    fx, fy, cx, cy = (intrinsics[:, i, None, None] for i in range(4))
    u = torch.arange(width, device=inverse.device, dtype=inverse.dtype) - cx
    v = torch.arange(height, device=inverse.device, dtype=inverse.dtype)[:, None] - cy
    nx, ny, nz = fx * slope_x, fy * slope_y, inverse - slope_x * u - slope_y * v
    normal = torch.sqrt(nx**2 + ny**2 + nz**2)
    ray = torch.sqrt((u / fx) ** 2 + (v / fy) ** 2 + 1)
    return (inverse / (normal * ray).clamp_min(1e-12)).clamp(0, 1)


def occluded(inverse: Tensor, pixel_metres: Tensor) -> Tensor:
    """Pixels that are occluded from a second viewpoint on the camera's x axis: projector shadow, stereo occlusion.

    In the second view a pixel is `d = f b w` columns further left. Each row is projected into that view, and a pixel
    is occluded if its disparity is more than one column below that of the nearest surface in its new column. Smaller
    steps would cast shadows narrower than a pixel.

    Args:
        inverse: (B, H, W) in 1/m.
        pixel_metres: (B,) focal length in pixels times baseline in metres; negative for a viewpoint towards -x.

    Returns:
        (B, H, W) bool; missing pixels are False.
    """
    disparity = pixel_metres[:, None, None] * inverse
    width = inverse.shape[-1]
    margin = width  # surfaces with a larger disparity, in columns, are outside the projected row
    column = torch.arange(width, device=inverse.device, dtype=inverse.dtype) - disparity + margin
    left = column.floor().long().clamp(0, width + 2 * margin - 2)
    size = (*inverse.shape[:-1], width + 2 * margin)
    nearest = torch.zeros(size, device=inverse.device, dtype=inverse.dtype)
    nearest.scatter_reduce_(-1, left, disparity.abs(), "amax")
    nearest.scatter_reduce_(-1, left + 1, disparity.abs(), "amax")
    cover = nearest.gather(-1, column.round().long().clamp(0, size[-1] - 1))
    return (inverse > 0) & (cover - disparity.abs() > 1)


def returned_light(luminance: Tensor, cos: Tensor, depth: Tensor) -> Tensor:
    """Returned light relative to a white frontal surface at 0.5 m: albedo x cosine / distance squared.

    The albedo is approximated by the image's brightness, so that a shaded surface counts as a dark one.

    Args:
        luminance: (B, H, W) display values 0..1 (gamma 2.2).
        cos: (B, H, W); see `cosine`.
        depth: (B, H, W) metres.
    """
    return luminance.clamp(0, 1) ** 2.2 * cos * (0.5 / depth.clamp_min(0.05)) ** 2


def shift_surface(inverse: Tensor, slope_x: Tensor, slope_y: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    """Inverse depth at positions shifted by (dx, dy) pixels: the nearest pixel's surface, extrapolated by its slope.

    Edges stay sharp: values between front and back do not occur.
    """
    height, width = inverse.shape[-2:]
    step_x, step_y = dx.round(), dy.round()
    u = (torch.arange(width, device=inverse.device) + step_x.long()).clamp(0, width - 1)
    v = (torch.arange(height, device=inverse.device)[:, None] + step_y.long()).clamp(0, height - 1)
    index = (v * width + u).flatten(1)

    def at(values: Tensor) -> Tensor:
        return values.flatten(1).gather(1, index).view_as(values)

    moved = at(inverse) + at(slope_x) * (dx - step_x) + at(slope_y) * (dy - step_y)
    return torch.where(at(inverse) > 0, moved, torch.zeros_like(moved))


def normal_noise(like: Tensor, generator: torch.Generator, spread: int = 0) -> Tensor:
    """Noise of unit variance shaped like (B, H, W), correlated over about `2 spread + 1` pixels."""
    batch, height, width = like.shape
    noise = torch.randn(
        (batch, height + 2 * spread, width + 2 * spread), generator=generator, device=like.device, dtype=like.dtype
    )
    if spread == 0:
        return noise
    size = 2 * spread + 1
    return functional.avg_pool2d(noise[:, None], size, stride=1)[:, 0] * size


def draw_dropout(probability: Tensor, generator: torch.Generator, spread: int = 1) -> Tensor:
    """Draw (B, H, W) bool with the given probability, in blobs of about `2 spread + 1` pixels as in real sensors."""
    level: Tensor = torch.special.ndtr(normal_noise(probability, generator, spread))
    return level < probability


def dilate(values: Tensor, radius: int) -> Tensor:
    """Maximum of (B, H, W) within a square window of the given radius in pixels; float."""
    size = 2 * radius + 1
    return functional.max_pool2d(values[:, None].float(), size, stride=1, padding=radius)[:, 0]
