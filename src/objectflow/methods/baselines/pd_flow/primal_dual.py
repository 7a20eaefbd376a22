"""The primal-dual solver of one level: Chambolle-Pock with diagonal preconditioning."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from objectflow.methods.baselines.pd_flow.linearise import Level

LAMBDA = (0.04, 0.04, 0.35)
"""Weights of the total variation of u, v (pixels) and w (metres)."""


class State(NamedTuple):
    """The variables of a level, (B, C, H, W); the duals lie within the unit ball.

    Attributes:
        flow: 3 channels: increments of u and v to `Level.warp` in pixels, and the total w in metres.
        depth_dual: 1 channel.
        smooth_dual: 6 channels: along u for u, v, w, then along v.
    """

    flow: Tensor
    depth_dual: Tensor
    smooth_dual: Tensor


def solve(level: Level, state: State, iterations: int) -> State:
    """Minimise the level's energy over u, v, w.

        sum |I_t + I_u u + I_v v| + mu |Z_t + Z_u u + Z_v v - w| + sum_f lambda_f |r grad f|

    with the last sum over f = u_warp + u, v_warp + v and w. The brightness term is minimised exactly in every step
    (shrinkage along its gradient), the depth and smoothness terms through their duals.
    """
    weight = smooth_weights(level.metric)
    depth_row = torch.cat([level.depth[:, :2], -torch.ones_like(level.mu)], 1)
    depth_t, depth_step = level.depth[:, 2:], 1 / (1 + level.depth[:, :2].abs().sum(1, keepdim=True))
    weighted_depth_row = level.mu * depth_row
    tau = 1 / (weighted_depth_row.abs() + _sum_of_neighbours(weight)).clamp(min=1e-10)
    gray_row, gray_t = level.gray[:, :2], level.gray[:, 2:]
    gray_step = tau[:, :2] * gray_row
    gray_norm = (gray_step * gray_row).sum(1, keepdim=True).clamp(min=1e-10)
    warp = torch.cat([level.warp, torch.zeros_like(level.mu)], 1)

    flow, depth_dual, smooth_dual = (tensor.clone() for tensor in state)
    extrapolated = flow.clone()
    for _ in range(iterations):
        # Dual step: sigma = 0.5 / (lambda r) and 1 / (mu (1 + |Z_u| + |Z_v|)) cancel the weights.
        depth_dual += depth_step * (depth_t + (depth_row * extrapolated).sum(1, keepdim=True))
        depth_dual.clamp_(-1, 1)
        smooth_dual += 0.5 * _differences(extrapolated + warp)
        smooth_dual = _project_to_unit_ball(smooth_dual)
        # Primal step, followed by exact shrinkage of the brightness term.
        new = flow - tau * (weighted_depth_row * depth_dual - _divergence(weight * smooth_dual))
        brightness = gray_t + (gray_row * new[:, :2]).sum(1, keepdim=True)
        new[:, :2] -= gray_step * (brightness / gray_norm).clamp_(-1, 1)
        extrapolated = 2 * new - flow
        flow = new
    return State(flow, depth_dual, smooth_dual)


def energy(level: Level, flow: Tensor) -> Tensor:
    """(B,) energy that `solve` minimises, of a `State.flow`."""
    brightness = level.gray[:, 2] + (level.gray[:, :2] * flow[:, :2]).sum(1)
    depth = level.depth[:, 2] + (level.depth[:, :2] * flow[:, :2]).sum(1) - flow[:, 2]
    total_flow = flow + torch.cat([level.warp, torch.zeros_like(level.mu)], 1)
    slope = smooth_weights(level.metric) * _differences(total_flow)
    variation = torch.hypot(slope[:, :3], slope[:, 3:])
    total: Tensor = (
        brightness.abs().sum((1, 2)) + (level.mu[:, 0] * depth.abs()).sum((1, 2)) + variation.sum((1, 2, 3))
    )
    return total


def smooth_weights(metric: Tensor) -> Tensor:
    """Weights lambda r of the differences, (B, 6, H, W); 0 where there is no next pixel."""
    factor = torch.tensor(LAMBDA, dtype=metric.dtype, device=metric.device)[None, :, None, None]
    out = torch.cat([factor * metric[:, :1], factor * metric[:, 1:]], 1)
    out[:, :3, :, -1] = 0
    out[:, 3:, -1] = 0
    return out


def _differences(field: Tensor) -> Tensor:
    """(B, 3, H, W) -> (B, 6, H, W): differences to the next pixel along u, then along v; 0 where there is none."""
    out = torch.zeros_like(field).repeat(1, 2, 1, 1)
    torch.sub(field[..., 1:], field[..., :-1], out=out[:, :3, :, :-1])
    torch.sub(field[..., 1:, :], field[..., :-1, :], out=out[:, 3:, :-1])
    return out


def _divergence(dual: Tensor) -> Tensor:
    """(B, 6, H, W) -> (B, 3, H, W): negative adjoint of `_differences`, for duals that are 0 at the last pixel."""
    along_u, along_v = dual[:, :3], dual[:, 3:]
    out = along_u + along_v
    out[..., 1:] -= along_u[..., :-1]
    out[..., 1:, :] -= along_v[..., :-1, :]
    return out


def _project_to_unit_ball(dual: Tensor) -> Tensor:
    length = torch.hypot(dual[:, :3], dual[:, 3:]).clamp_(min=1)
    return dual / torch.cat([length, length], 1)


def _sum_of_neighbours(weight: Tensor) -> Tensor:
    """(B, 6, H, W) -> (B, 3, H, W): sum of the weights of all differences that involve a variable."""
    along_u, along_v = weight[:, :3], weight[:, 3:]
    out = along_u + along_v
    out[..., 1:] += along_u[..., :-1]
    out[..., 1:, :] += along_v[..., :-1, :]
    return out
