"""What a depth sensor's errors depend on: slant, depth steps, shadow, returned light; batched torch.

Everything works on inverse depth `w = 1 / z`, which is linear in pixel coordinates on a plane: slopes taken from it
are exact there, whatever the perspective. Missing depth is `w = 0`.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def inverse_depth(depth: Tensor) -> Tensor:
    """Planar depth (B, H, W) in metres, 0 = missing -> inverse depth (B, H, W) in 1/m, 0 = missing."""
    return torch.where(depth > 0, 1 / depth.clamp_min(1e-6), torch.zeros_like(depth))


def depth_of(inverse: Tensor) -> Tensor:
    """The inverse of `inverse_depth`; values at or below 0 become missing."""
    return torch.where(inverse > 0, 1 / inverse.clamp_min(1e-6), torch.zeros_like(inverse))


def slopes(inverse: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Slope of inverse depth along x and y, and the height of the depth step at a pixel.

    Of the two one-sided differences the smaller one is the slope of the pixel's own surface, and what the larger one
    has beyond it is a step. A missing neighbour says nothing.

    Args:
        inverse: (B, H, W) in 1/m.

    Returns:
        slope along x and along y in 1/m a pixel, and the larger step of the two directions in 1/m; each (B, H, W).
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
    """Cosine of the angle between each pixel's ray and its surface's normal, (B, H, W) in 0..1.

    On the plane `w = a u + b v + c` the normal is `(fx a, fy b, w - a (u - cx) - b (v - cy))`, and its product with
    the ray through the pixel is `w` itself.

    Args:
        inverse, slope_x, slope_y: (B, H, W), as `slopes` gives them.
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


def shadow(inverse: Tensor, pixel_metres: Tensor) -> Tensor:
    """Pixels that a second viewpoint on the camera's +x axis cannot see: projector shadow, stereo occlusion.

    A pixel lies `d = f b w` columns further left there. Each row is drawn into the second view's columns, the
    nearest surface wins, and a pixel that lies more than one column of disparity behind the winner is hidden. Lower
    steps would cast shadows narrower than a pixel.

    Args:
        inverse: (B, H, W) in 1/m.
        pixel_metres: (B,) focal length in pixels times baseline in metres; negative for a viewpoint at -x.

    Returns:
        (B, H, W) bool; missing pixels are False.
    """
    disparity = pixel_metres[:, None, None] * inverse
    width = inverse.shape[-1]
    margin = width  # surfaces nearer than this many columns of disparity fall outside of the drawing
    column = torch.arange(width, device=inverse.device, dtype=inverse.dtype) - disparity + margin
    left = column.floor().long().clamp(0, width + 2 * margin - 2)
    size = (*inverse.shape[:-1], width + 2 * margin)
    nearest = torch.zeros(size, device=inverse.device, dtype=inverse.dtype)
    nearest.scatter_reduce_(-1, left, disparity.abs(), "amax")
    nearest.scatter_reduce_(-1, left + 1, disparity.abs(), "amax")
    cover = nearest.gather(-1, column.round().long().clamp(0, size[-1] - 1))
    return (inverse > 0) & (cover - disparity.abs() > 1)


def returned_light(luminance: Tensor, cos: Tensor, depth: Tensor) -> Tensor:
    """Light that comes back, relative to a white, facing surface at 0.5 m: albedo x cosine / distance squared.

    The albedo is guessed from the image's brightness, as nothing else is stored; so shade counts as dark paint.

    Args:
        luminance: (B, H, W) 0..1, as displayed (gamma 2.2).
        cos: (B, H, W) of `cosine`.
        depth: (B, H, W) metres.
    """
    return luminance.clamp(0, 1) ** 2.2 * cos * (0.5 / depth.clamp_min(0.05)) ** 2


def displaced(inverse: Tensor, slope_x: Tensor, slope_y: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    """Inverse depth at pixels shifted by (dx, dy): the nearest pixel's surface, carried on by its own slope.

    So edges stay edges: no value between the front and the back is made up.
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
    """Standard normal noise shaped like (B, H, W), smooth over about `2 spread + 1` pixels; variance stays 1."""
    batch, height, width = like.shape
    noise = torch.randn(
        (batch, height + 2 * spread, width + 2 * spread), generator=generator, device=like.device, dtype=like.dtype
    )
    if spread == 0:
        return noise
    size = 2 * spread + 1
    return functional.avg_pool2d(noise[:, None], size, stride=1)[:, 0] * size


def lost(probability: Tensor, generator: torch.Generator, spread: int = 1) -> Tensor:
    """Draw (B, H, W) bool with the given probability, in blobs of about `2 spread + 1` pixels as sensors lose them."""
    level: Tensor = torch.special.ndtr(normal_noise(probability, generator, spread))
    return level < probability


def widened(mask_or_map: Tensor, radius: int) -> Tensor:
    """The largest value within `radius` pixels (square window), (B, H, W)."""
    size = 2 * radius + 1
    return functional.max_pool2d(mask_or_map[:, None].float(), size, stride=1, padding=radius)[:, 0]
