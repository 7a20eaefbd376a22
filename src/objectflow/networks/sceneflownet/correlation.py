"""Correlation of the colour features, and the max-pool of XYZ features weighted by it (equations 2 and 3).

The product of a cell's 441 correlations with 64 channels is never stored: the pool iterates over the displacements
and keeps the largest value and, for the backward pass, the index of its displacement.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable


def correlate(curr: Tensor, prev: Tensor, reach: int) -> Tensor:
    """Inner products of each current cell's features with those of the previous cells around it (equation 2).

    Args:
        curr, prev: (B, C, H, W).
        reach: L, in cells.

    Returns:
        (B, (2 L + 1)^2, H, W), row of the displacement first; 0 beyond the image's edge. Channel
        `(k + L) (2 L + 1) + l + L` holds the product with the previous cell at (row + k, column + l).
    """
    batch, channels, height, width = curr.shape
    side = 2 * reach + 1
    padded = F.pad(prev, (reach, reach, reach, reach))
    rows = curr.permute(0, 2, 3, 1).reshape(batch * height, width, channels)
    out = []
    for k in range(side):
        # One matrix product of whole rows computes more sums than needed, but at the speed of BLAS.
        others = padded[:, :, k : k + height].permute(0, 2, 1, 3).reshape(batch * height, channels, width + 2 * reach)
        product = torch.bmm(rows, others)
        # Entries (column, column + l) are needed. Lengthening the rows aligns this band with the columns.
        skewed = F.pad(product.reshape(batch * height, -1), (0, width))
        band = skewed.reshape(batch, height, width, width + side)[..., :side]
        out.append(band.permute(0, 3, 1, 2))
    return torch.cat(out, dim=1)


def weighted_max_pool(weights: Tensor, values: Tensor, reach: int) -> Tensor:
    """The largest product of weight and value over each cell's patch, per channel (equation 3).

    Args:
        weights: (B, (2 L + 1)^2, H, W), as `correlate` orders them.
        values: (B, C, H, W); 0 beyond the image's edge.
        reach: L, in cells.

    Returns:
        (B, C, H, W). The gradient goes to the first displacement that attains the maximum.
    """
    # Contiguous rows are three times as fast if the rest of the network is in channels-last format.
    weights, values = weights.contiguous(), values.to(weights.dtype).contiguous()
    if torch.is_grad_enabled() and (weights.requires_grad or values.requires_grad):
        out: Tensor = _pool_with_gradient(weights, values, reach)
        return out
    return _pool(weights, values, reach, None)


@cache
def exclude_from_compilation() -> None:
    """Keep the pool out of the graphs of `torch.compile`; compiling its thousands of small steps takes minutes.

    As a decorator, `torch.compiler.disable` would import the compiler, which takes over a second, for everyone.
    """
    global _pool_with_gradient  # noqa: PLW0603
    _pool_with_gradient = torch.compiler.disable(_pool_with_gradient)  # type: ignore[no-untyped-call]


def _pool_with_gradient(weights: Tensor, values: Tensor, reach: int) -> Tensor:
    out: Tensor = _WeightedMaxPool.apply(weights, values, reach)  # type: ignore[no-untyped-call]
    return out


def _columns(values: Tensor, reach: int, shift: int) -> Tensor:
    """Values shifted by `shift` columns and padded by `reach` rows, so that a shift by rows is a slice."""
    height, width = values.shape[-2:]
    left = reach - shift
    moved = F.pad(values, (max(left, 0), max(-left, 0), reach, reach))
    return moved[..., max(-left, 0) : max(-left, 0) + width].reshape(*values.shape[:2], (height + 2 * reach) * width)


def _pool(weights: Tensor, values: Tensor, reach: int, index: Tensor | None) -> Tensor:
    """The pool; `index`, (B, C, H W) int16 if given, receives the displacement of each maximum."""
    batch, channels, height, width = values.shape
    side = 2 * reach + 1
    flat = weights.reshape(batch, side * side, height * width)
    # One pair at a time fits into a CPU's cache; a GPU is faster with all pairs at once.
    step = batch if values.is_cuda else 1
    outputs = []
    for first in range(0, batch, step):
        pairs = slice(first, first + step)
        best = values.new_full((min(step, batch - first), channels, height * width), -torch.inf)
        for shift in range(side):
            moved = _columns(values[pairs], reach, shift)
            for k in range(side):
                d = k * side + shift
                product = flat[pairs, d : d + 1] * moved[..., k * width : (k + height) * width]
                if index is not None:
                    index[pairs].masked_fill_(product > best, d)
                best = torch.maximum(best, product)
        outputs.append(best)
    return torch.cat(outputs).reshape(batch, channels, height, width)


class _WeightedMaxPool(torch.autograd.Function):
    """`weighted_max_pool` with a backward pass through the maxima only."""

    @staticmethod
    def forward(ctx: Any, weights: Tensor, values: Tensor, reach: int) -> Tensor:
        batch, channels, height, width = values.shape
        index = torch.zeros((batch, channels, height * width), dtype=torch.int16, device=values.device)
        best = _pool(weights, values, reach, index)
        ctx.reach = reach
        ctx.save_for_backward(weights, values, index)
        return best

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        weights, values, index16 = ctx.saved_tensors
        batch, channels, height, width = values.shape
        reach, side = ctx.reach, 2 * ctx.reach + 1
        index = index16.long()
        # Sums of many terms need more precision than bfloat16 has.
        dtype = torch.promote_types(values.dtype, torch.float32)
        flow = gradient.reshape(batch, channels, height * width).to(dtype)
        padded = F.pad(values, (reach, reach, reach, reach)).flatten(2)
        cell = torch.arange(height * width, device=values.device)
        corner = (cell // width) * (width + 2 * reach) + cell % width
        source = corner + (index // side) * (width + 2 * reach) + index % side
        flat = weights.reshape(batch, side * side, height * width)
        to_values = torch.zeros_like(padded, dtype=dtype).scatter_add_(2, source, flow * flat.gather(1, index))
        to_weights = torch.zeros_like(flat, dtype=dtype).scatter_add_(1, index, flow * padded.gather(2, source))
        inner = to_values.reshape(batch, channels, height + 2 * reach, width + 2 * reach)
        inner = inner[:, :, reach : reach + height, reach : reach + width]
        return to_weights.reshape(weights.shape).to(weights.dtype), inner.to(values.dtype), None


def weighted_max_pool_naive(weights: Tensor, values: Tensor, reach: int) -> Tensor:
    """`weighted_max_pool` as written in the paper, storing every product; for comparison only."""
    batch, channels, height, width = values.shape
    patches = F.unfold(values, 2 * reach + 1, padding=reach).reshape(batch, channels, -1, height, width)
    return (weights[:, None] * patches).amax(dim=2)


def correlate_naive(curr: Tensor, prev: Tensor, reach: int) -> Tensor:
    """`correlate` as written in the paper, storing every cell's patch; for comparison only."""
    batch, channels, height, width = curr.shape
    patches = F.unfold(prev, 2 * reach + 1, padding=reach).reshape(batch, channels, -1, height, width)
    return (curr[:, :, None] * patches).sum(dim=1)
