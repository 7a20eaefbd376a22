"""The smoothness term of SR-Flow: total variation of the twist field, by the Rudin-Osher-Fatemi model.

    min over u of |u - f|^2 / 2 + eta TV(u)        (equation 16 of the paper)

solved in the dual by projected gradient steps with momentum (Chambolle 2004; Beck and Teboulle 2009). The dual is
projected per channel or, in the vectorial form, jointly for all channels (Bresson and Chan 2008), which makes the
three components of a rotation change at the same pixels.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

STEP = 0.125
"""Step size, 1 / 8, since the squared norm of the discrete gradient is at most 8."""


def total_variation(field: Tensor, *, vectorial: bool) -> Tensor:
    """(B, C, H, W) -> (B,): sum of gradient norms, per channel or (if `vectorial`) jointly over the channels."""
    squares = _gradient(field).square().sum(1)
    return (squares.sum(1, keepdim=True) if vectorial else squares).sqrt().sum((1, 2, 3))


def smooth(
    field: Tensor, eta: float, iterations: int, *, vectorial: bool, dual: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Approximate the minimiser by a number of iterations; returns it and its dual variable.

    Args:
        field: f, (B, C, H, W).
        eta: weight of the total variation, in units of the field.
        iterations: number of dual steps.
        vectorial: joint total variation of all channels.
        dual: (B, 2, C, H, W) initial dual variable, as returned for a similar field.
    """
    dual = field.new_zeros(len(field), 2, *field.shape[1:]) if dual is None else dual.clone()
    extrapolated, new_dual, primal, norms = dual.clone(), torch.empty_like(dual), torch.empty_like(field), None
    momentum = 1.0
    for _ in range(iterations):
        _primal(field, extrapolated, eta, out=primal)
        new_dual.copy_(extrapolated)
        _add_gradient(primal, STEP / eta, out=new_dual)
        norm = torch.mul(new_dual[:, 0], new_dual[:, 0], out=norms)
        norms = norm.addcmul_(new_dual[:, 1], new_dual[:, 1])
        if vectorial:
            norm = norm.sum(1, keepdim=True)
        new_dual *= norm.rsqrt_().clamp_(max=1)[:, None]
        new_momentum = (1 + math.sqrt(1 + 4 * momentum**2)) / 2
        torch.lerp(dual, new_dual, 1 + (momentum - 1) / new_momentum, out=extrapolated)
        dual, new_dual, momentum = new_dual, dual, new_momentum
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
    """The primal variable of a dual: f + eta div p, where div is the negative adjoint of `_gradient`."""
    out.copy_(field)
    along_u, along_v = dual[:, 0, ..., :-1], dual[:, 1, ..., :-1, :]
    out[..., :-1].add_(along_u, alpha=eta)
    out[..., 1:].sub_(along_u, alpha=eta)
    out[..., :-1, :].add_(along_v, alpha=eta)
    out[..., 1:, :].sub_(along_v, alpha=eta)
    return out
