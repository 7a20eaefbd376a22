"""The smoothness of SR-Flow: total variation of the twist field, by the Rudin-Osher-Fatemi model.

    min over u of |u - f|^2 / 2 + eta TV(u)        (equation 16 of the paper)

solved on its dual by projected gradient steps with momentum (Chambolle 2004; Beck and Teboulle 2009). Channel by
channel, each channel's gradient is bounded by itself; vectorial, the gradients of all channels are bounded together
(Bresson and Chan 2008), which makes the three components of a rotation jump in the same places.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

STEP = 0.125
"""1 / 8: the squared norm of the discrete gradient is at most 8."""


def total_variation(field: Tensor, *, vectorial: bool) -> Tensor:
    """(B, C, H, W) -> (B,): the sum of gradient lengths, of each channel or of all together."""
    squares = _gradient(field).square().sum(1)
    return (squares.sum(1, keepdim=True) if vectorial else squares).sqrt().sum((1, 2, 3))


def smooth(
    field: Tensor, eta: float, iterations: int, *, vectorial: bool, dual: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The minimiser above, as far as the iterations go, and its dual variable.

    Args:
        field: f, (B, C, H, W).
        eta: in units of the field.
        iterations: dual steps.
        vectorial: bound the gradients of all channels together.
        dual: (B, 2, C, H, W), where to start: what the last call for a field like this one returned.
    """
    if dual is None:
        dual = field.new_zeros(len(field), 2, *field.shape[1:])
    ahead, momentum = dual, 1.0
    for _ in range(iterations):
        stepped = ahead + (STEP / eta) * _gradient(field + eta * _divergence(ahead))
        squares = stepped.square().sum(1, keepdim=True)
        if vectorial:
            squares = squares.sum(2, keepdim=True)
        stepped = stepped / squares.sqrt().clamp(min=1)
        following = (1 + math.sqrt(1 + 4 * momentum**2)) / 2
        ahead = stepped + (momentum - 1) / following * (stepped - dual)
        dual, momentum = stepped, following
    return field + eta * _divergence(dual), dual


def _gradient(field: Tensor) -> Tensor:
    """Forward differences, 0 beyond the border: (B, C, H, W) -> (B, 2, C, H, W)."""
    out = field.new_zeros(len(field), 2, *field.shape[1:])
    torch.sub(field[..., :, 1:], field[..., :, :-1], out=out[:, 0, ..., :, :-1])
    torch.sub(field[..., 1:, :], field[..., :-1, :], out=out[:, 1, ..., :-1, :])
    return out


def _divergence(dual: Tensor) -> Tensor:
    """Minus the adjoint of `_gradient`."""
    out = torch.zeros_like(dual[:, 0])
    out[..., :, :-1] += dual[:, 0, ..., :, :-1]
    out[..., :, 1:] -= dual[:, 0, ..., :, :-1]
    out[..., :-1, :] += dual[:, 1, ..., :-1, :]
    out[..., 1:, :] -= dual[:, 1, ..., :-1, :]
    return out
