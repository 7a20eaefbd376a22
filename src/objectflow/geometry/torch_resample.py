"""Images at fractional pixels in torch, batch first and channels second; pixel centres lie at whole numbers."""

from __future__ import annotations

import torch
from torch import Tensor


def bilinear_corners(u: Tensor, v: Tensor, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """The four pixels around each fractional pixel.

    Args:
        u, v: (B, H, W), within 0..width-1 and 0..height-1.
        height, width: of the image that is sampled, at least 2.

    Returns:
        (B, 4, H, W) int64 indices into the flattened image: top left, top right, bottom left, bottom right; and the
        positions (B, H, W) between them along u and v, 0..1.
    """
    u0, v0 = u.floor().clamp(max=width - 2), v.floor().clamp(max=height - 2)
    first = (v0 * width + u0).long()
    return torch.stack([first, first + 1, first + width, first + width + 1], 1), u - u0, v - v0


def take_pixels(image: Tensor, index: Tensor) -> Tensor:
    """Pixels of (B, C, h, w) at flat indices (B, K, H, W) -> (B, C, K, H, W)."""
    batch, channels = image.shape[:2]
    flat = index.flatten(1)[:, None].expand(-1, channels, -1)
    return image.flatten(2).gather(2, flat).view(batch, channels, *index.shape[1:])


def bilinear_weights(du: Tensor, dv: Tensor) -> Tensor:
    """(B, 4, H, W) weights of the corners for positions (B, H, W) between them."""
    return torch.stack([(1 - du) * (1 - dv), du * (1 - dv), (1 - du) * dv, du * dv], 1)


def interpolate_corners(corners: Tensor, weights: Tensor) -> Tensor:
    """(B, C, 4, H, W) values and (B, 4, H, W) weights -> (B, C, H, W)."""
    return (corners * weights[:, None]).sum(2)


def sample_bilinear(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Sample an image (B, C, h, w) bilinearly at (B, H, W) columns u and rows v -> (B, C, H, W)."""
    index, du, dv = bilinear_corners(u, v, *image.shape[2:])
    return interpolate_corners(take_pixels(image, index), bilinear_weights(du, dv))


def sampling_grid(u: Tensor, v: Tensor, height: int, width: int) -> Tensor:
    """Columns u and rows v (B, H, W) as a grid (B, H, W, 2) for `grid_sample` with `align_corners=False`."""
    return torch.stack([(2 * u + 1) / width - 1, (2 * v + 1) / height - 1], dim=-1)
