"""Expectations under the dual softmax of an N x M table of logits, in few passes over the table."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

_LEVEL = 30.0
"""Offset subtracted from logits of at most about 90, so that exponentials and their sums do not overflow float32."""
_LEAST = 1e-30
"""Lower bound of sums of exponentials, which avoids division by 0."""
_LOWEST = -80.0
"""Lower bound of logits minus `_LEVEL`, whose exponential is still a normal float32; processors take tens of times as
long for exponentials that underflow."""
_SMALLEST = 1e-18
"""Exponentials below this value are set to 0 at inference, as their squares would not be normal float32 numbers."""
_ROWS = 128
"""Rows per block in `dual_softmax_mean_of_product`; a block fits into the processor's cache."""


def dual_softmax_mean(scores: Tensor, dustbin: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sum values weighted by the product of the softmax over rows, including a dustbin entry, and over columns.

    Args:
        scores: (B, N, M) logits, at most 100.
        dustbin: (B, N) logits of "no match".
        values: (B, M, C).

    Returns:
        (B, N, C) sums, not normalised by the sum of the weights; (B, N) log-sum-exp over rows, including the dustbin;
        (B, M) log-sum-exp over columns.
    """
    if torch.is_grad_enabled() and (scores.requires_grad or values.requires_grad):
        sums, rows, columns = _DualSoftmaxMean.apply(scores, dustbin, values)  # type: ignore[no-untyped-call]
        return sums, rows, columns
    raised, row, column = _raise(scores, dustbin)
    # Dividing the values, not the table, by the sums of columns saves a pass over the table.
    by_row = (raised / row[:, :, None]).mul_(raised)
    return by_row @ (values / column[:, :, None]), row.log() + _LEVEL, column.log() + _LEVEL


def dual_softmax_mean_of_product(
    left: Tensor, right: Tensor, dustbin: Tensor, values: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the same for `scores = left @ right.mT` in blocks and without gradient, in half the time and memory.

    Args:
        left: (B, N, K).
        right: (B, M, K).
        dustbin, values: as in `dual_softmax_mean`.
    """
    across = right.transpose(-2, -1).contiguous()
    raised = left.new_empty(len(left), left.shape[1], right.shape[1])
    column = left.new_zeros(len(left), right.shape[1])
    sums = []
    for part, rows in zip(torch.split(raised, _ROWS, 1), torch.split(left, _ROWS, 1), strict=True):
        torch.matmul(rows, across, out=part)
        # The two additional passes within the cache make the exponential and all later products several times as fast.
        torch.threshold_(part.sub_(_LEVEL).clamp_min_(_LOWEST).exp_(), _SMALLEST, 0.0)
        column += part.sum(1)
        sums.append(part.sum(2))
    row = (torch.cat(sums, dim=1) + torch.exp(dustbin - _LEVEL)).clamp_min(_LEAST)
    column = column.clamp_min(_LEAST)
    shares = values / column[:, :, None]
    means = [
        (part / total[:, :, None]).mul_(part) @ shares
        for part, total in zip(torch.split(raised, _ROWS, 1), torch.split(row, _ROWS, 1), strict=True)
    ]
    return torch.cat(means, dim=1), row.log() + _LEVEL, column.log() + _LEVEL


def _raise(scores: Tensor, dustbin: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Exponentials and their sums over rows (with dustbin) and over columns, all divided by exp(_LEVEL)."""
    raised = torch.sub(scores, _LEVEL).clamp_min_(_LOWEST).exp_()
    row = (raised.sum(2) + torch.exp(dustbin - _LEVEL)).clamp_min(_LEAST)
    return raised, row, raised.sum(1).clamp_min(_LEAST)


class _DualSoftmaxMean(torch.autograd.Function):
    """`dual_softmax_mean` with an in-place backward pass; autograd needs three times as many passes over the table."""

    @staticmethod
    def forward(ctx: Any, scores: Tensor, dustbin: Tensor, values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        raised, row, column = _raise(scores, dustbin)
        weights = (raised / row[:, :, None]).mul_(raised / column[:, None])
        rows, columns = row.log() + _LEVEL, column.log() + _LEVEL
        ctx.save_for_backward(weights, rows, columns, raised, dustbin, values)
        return weights @ values, rows, columns

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_sums: Tensor, to_rows: Tensor, to_columns: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        weights, rows, columns, raised, dustbin, values = ctx.saved_tensors
        # d weights = weights (2 d scores - d rows - d columns)
        out = to_sums @ values.transpose(-2, -1)
        out *= weights
        by_row, by_column = to_rows - out.sum(2), to_columns - out.sum(1)
        out *= 2
        # d rows / d scores is the softmax over the row, raised / exp(rows), and likewise for columns.
        row = torch.where(rows > _LEVEL - 60, by_row * torch.exp(_LEVEL - rows), 0.0)
        column = torch.where(columns > _LEVEL - 60, by_column * torch.exp(_LEVEL - columns), 0.0)
        out.addcmul_(raised, row[:, :, None])
        out.addcmul_(raised, column[:, None])
        return out, by_row * torch.exp(dustbin - rows), weights.transpose(-2, -1) @ to_sums
