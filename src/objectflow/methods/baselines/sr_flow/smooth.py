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
    dual = field.new_zeros(len(field), 2, *field.shape[1:]) if dual is None else dual.clone()
    ahead, stepped, primal, lengths = dual.clone(), torch.empty_like(dual), torch.empty_like(field), None
    momentum = 1.0
    for _ in range(iterations):
        _primal(field, ahead, eta, out=primal)
        stepped.copy_(ahead)
        _add_gradient(primal, STEP / eta, out=stepped)
        shrink = torch.mul(stepped[:, 0], stepped[:, 0], out=lengths)
        lengths = shrink.addcmul_(stepped[:, 1], stepped[:, 1])
        if vectorial:
            shrink = shrink.sum(1, keepdim=True)
        stepped *= shrink.rsqrt_().clamp_(max=1)[:, None]
        following = (1 + math.sqrt(1 + 4 * momentum**2)) / 2
        torch.lerp(dual, stepped, 1 + (momentum - 1) / following, out=ahead)
        dual, stepped, momentum = stepped, dual, following
    return _primal(field, dual, eta, out=primal), dual


def _gradient(field: Tensor) -> Tensor:
    """Forward differences, 0 beyond the border: (B, C, H, W) -> (B, 2, C, H, W)."""
    out = field.new_zeros(len(field), 2, *field.shape[1:])
    _add_gradient(field, 1.0, out=out)
    return out


def _add_gradient(field: Tensor, factor: float, *, out: Tensor) -> None:
    out[:, 0, ..., :-1].add_(field[..., 1:], alpha=factor).sub_(field[..., :-1], alpha=factor)
    out[:, 1, ..., :-1, :].add_(field[..., 1:, :], alpha=factor).sub_(field[..., :-1, :], alpha=factor)


def _primal(field: Tensor, dual: Tensor, eta: float, *, out: Tensor) -> Tensor:
    """What a dual says the minimiser is: f + eta div p, where the divergence is minus the adjoint of `_gradient`."""
    out.copy_(field)
    along_u, along_v = dual[:, 0, ..., :-1], dual[:, 1, ..., :-1, :]
    out[..., :-1].add_(along_u, alpha=eta)
    out[..., 1:].sub_(along_u, alpha=eta)
    out[..., :-1, :].add_(along_v, alpha=eta)
    out[..., 1:, :].sub_(along_v, alpha=eta)
    return out
