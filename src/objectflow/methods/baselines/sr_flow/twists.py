"""Twist fields: their motion of points, and a solver for many small symmetric systems.

A twist (B, 6, H, W) is [translation in cm, rotation in radians] about the level's pivot. Points are given by their
arms, i.e. relative to the pivot.
"""

from __future__ import annotations

import torch
from torch import Tensor

from objectflow.geometry.torch_se3 import rodrigues_coefficients


def motions(twist: Tensor) -> tuple[Tensor, Tensor]:
    """(B, 6, H, W) -> R - I (B, 3, 3, H, W), which keeps precision for small angles, and shifts (B, 3, H, W).

    Rodrigues' formula is evaluated by components, since 3x3 matrix products per pixel are slow.
    """
    rho, w = twist[:, :3].unbind(1), twist[:, 3:].unbind(1)
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    a, b, c = rodrigues_coefficients(angle2)
    rotation = twist.new_empty(len(twist), 3, 3, *twist.shape[2:])
    shift = twist.new_empty(len(twist), 3, *twist.shape[2:])
    c_along = c * (w[0] * rho[0] + w[1] * rho[1] + w[2] * rho[2])
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rotation[:, i, i] = b * (w[i] * w[i] - angle2)
        symmetric, skew = b * (w[i] * w[j]), a * w[k]
        rotation[:, i, j], rotation[:, j, i] = symmetric - skew, symmetric + skew
        shift[:, i] = a * rho[i] + b * (w[j] * rho[k] - w[k] * rho[j]) + c_along * w[i]
    return rotation, shift


def displace(rotation: Tensor, shift: Tensor, points: Tensor) -> Tensor:
    """Displacements (R - I) P + t of points (B, 3, H, W), given R - I and t as returned by `motions`."""
    out = torch.addcmul(shift, rotation[:, :, 0], points[:, None, 0])
    out.addcmul_(rotation[:, :, 1], points[:, None, 1])
    return out.addcmul_(rotation[:, :, 2], points[:, None, 2])


def jacobian(gradient: Tensor, moved: Tensor) -> Tensor:
    """Gradient g w.r.t. moved points Y (B, 3, H, W) -> w.r.t. a twist after the motion (B, 6, H, W): [g, Y x g]."""
    out = gradient.new_empty(len(gradient), 6, *gradient.shape[2:])
    out[:, :3] = gradient
    # Written out because `torch.linalg.cross` is slow on the CPU.
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        torch.mul(moved[:, j], gradient[:, k], out=out[:, 3 + i])
        out[:, 3 + i].addcmul_(moved[:, k], gradient[:, j], value=-1)
    return out


def normal_equations(residual: Tensor, J: Tensor, weight: Tensor) -> Tensor:
    """Normal equations of N systems of six unknowns: sums of w J J^T and w J r over windows of K pixels.

    Args:
        residual, weight: (K, N).
        J: (6, K, N).

    Returns:
        (27, N): the rows of the upper triangle from the diagonal on, then the right side.
    """
    weighted = J * weight
    parts = [(J[i:] * weighted[i]).sum(1) for i in range(6)]
    return torch.cat([*parts, (weighted * residual).sum(1)])


def solve(equations: Tensor, diagonal: Tensor, right: Tensor, damping: Tensor) -> Tensor:
    """Solve (A + D + damping * diag(A + D)) x = -(b + right) by LDL^T decomposition.

    Args:
        equations: A and b of N systems, as returned by `normal_equations`, (27, N).
        diagonal: D, (6, N or 1), positive.
        right: (6, N), added to the right side.
        damping: (N,), not negative.

    Returns:
        (6, N).
    """
    # Small windows constrain rotations poorly, so single precision is insufficient.
    *rows, b = torch.split(equations.double(), [6, 5, 4, 3, 2, 1, 6])
    for i in range(6):
        rows[i][0] = (rows[i][0] + diagonal[i]) * (1 + damping)
    x = -(b + right)
    for i in range(6):
        scaled = rows[i] / rows[i][0]
        for j in range(i + 1, 6):
            rows[j] -= scaled[j - i] * rows[i][j - i :]
        x[i + 1 :] -= scaled[1:] * x[i]
        x[i] /= rows[i][0]
        rows[i] = scaled
    for i in reversed(range(5)):
        x[i] -= (rows[i][1:] * x[i + 1 :]).sum(0)
    return x.to(right.dtype)
