"""The rigid step of SR-Flow: one motion of the whole scene, as caused by a moving camera.

    min over G of sum_x cost(G P(x))

by damped Gauss-Newton with the weights of `residuals`, which exclude independently moving objects as outliers. Steps
are accepted only where the cost decreases.
"""

from __future__ import annotations

import torch
from torch import Tensor

from objectflow.geometry import torch_se3
from objectflow.methods.baselines.sr_flow import twists
from objectflow.methods.baselines.sr_flow.pyramid import Level
from objectflow.methods.baselines.sr_flow.residuals import Weights, compute_residuals

CONVERGED = 1e-5
"""Step size at convergence, cm, with rotations at a lever arm of 1 m; well below the measurement accuracy."""


def solve_rigid(level: Level, start: Tensor, iterations: int, weights: Weights) -> tuple[Tensor, list[Tensor]]:
    """Refine the motion of the whole scene.

    Args:
        level: both frames.
        start: G, (B, 4, 4) float64, of points relative to the pivot, cm.
        iterations: maximum number.
        weights: of the data terms.

    Returns:
        (B, 4, 4) float64, and the cost (B,) before the first step and after each.
    """
    motion = start
    damping = torch.full((len(start),), 1e-6, dtype=torch.float64, device=start.device)
    cost, A, b = _linearise(level, motion, weights)
    costs = [cost]
    for _ in range(iterations):
        diagonal = torch.diagonal(A, dim1=1, dim2=2)
        # The constant regularises scenes with an unconstrained direction, such as a single plane.
        system = A + torch.diag_embed(damping[:, None] * diagonal + 1e-9)
        step = -torch.linalg.solve(system, b)
        trial = torch_se3.se3_exp(step) @ motion
        new_cost, new_A, new_b = _linearise(level, trial, weights)
        better = new_cost < cost
        motion = torch.where(better[:, None, None], trial, motion)
        A = torch.where(better[:, None, None], new_A, A)
        b = torch.where(better[:, None], new_b, b)
        cost = torch.where(better, new_cost, cost)
        damping = torch.where(better, damping * 0.1, (damping * 10).clamp(min=1e-4)).clamp(1e-9, 1e9)
        costs.append(cost)
        size = torch.maximum(step[:, :3].abs().amax(1), 100 * step[:, 3:].abs().amax(1))
        if bool((size < CONVERGED).all()):
            break
    return motion, costs


def apply_rigid(level: Level, motion: Tensor) -> Tensor:
    """Move the level's points (B, 3, H, W) by a motion (B, 4, 4) relative to the pivot."""
    arm = level.points - level.pivot
    rotation = (motion[:, :3, :3] - torch.eye(3, dtype=motion.dtype, device=motion.device)).to(arm.dtype)
    shift = motion[:, :3, 3].to(arm.dtype)
    return level.points + twists.displace(rotation[..., None, None], shift[..., None, None], arm)


def _linearise(level: Level, motion: Tensor, weights: Weights) -> tuple[Tensor, Tensor, Tensor]:
    """Cost (B,), and the normal equations (B, 6, 6) and (B, 6) of a small twist after the motion, float64."""
    arm = apply_rigid(level, motion) - level.pivot
    residuals = compute_residuals(level, arm + level.pivot, level.gray, level.valid, weights)
    batch = len(arm)
    A = arm.new_zeros(batch, 6, 6, dtype=torch.float64)
    b = arm.new_zeros(batch, 6, dtype=torch.float64)
    for residual, gradient, weight in residuals.terms:
        J = twists.jacobian(gradient, arm).flatten(2).double()
        weighted = J * weight.flatten(1)[:, None].double()
        A += weighted @ J.mT
        b += (weighted @ residual.flatten(1)[..., None].double())[..., 0]
    return residuals.cost.double().sum((1, 2)), A, b
