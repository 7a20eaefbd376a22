"""Twist fields: moving points by them, and many small symmetric systems at once.

A twist (B, 6, H, W) is [translation part in cm, rotation part in radians] about the level's pivot,
and a point is given as its arm from there.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def motions(twist: Tensor) -> tuple[Tensor, Tensor]:
    """(B, 6, H, W) -> rotations less the identity (B, 3, 3, H, W), to keep digits, and shifts (B, 3, H, W).

    Rodrigues' formula by components: matrix products of 3x3 matrices, one a pixel, are slow.
    """
    rho, w = twist[:, :3].unbind(1), twist[:, 3:].unbind(1)
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = angle2.sqrt()
    a, b = torch.sinc(angle / math.pi), torch.sinc(angle / (2 * math.pi)).square() / 2
    c = torch.where(angle2 > 1e-9, (1 - a) / angle2, 1 / 6)
    turn = twist.new_empty(len(twist), 3, 3, *twist.shape[2:])
    shift = twist.new_empty(len(twist), 3, *twist.shape[2:])
    c_along = c * (w[0] * rho[0] + w[1] * rho[1] + w[2] * rho[2])
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        turn[:, i, i] = b * (w[i] * w[i] - angle2)
        symmetric, skew = b * (w[i] * w[j]), a * w[k]
        turn[:, i, j], turn[:, j, i] = symmetric - skew, symmetric + skew
        shift[:, i] = a * rho[i] + b * (w[j] * rho[k] - w[k] * rho[j]) + c_along * w[i]
    return turn, shift


def displace(turn: Tensor, shift: Tensor, points: Tensor) -> Tensor:
    """(R - I) P + t of what `motions` returns and points (B, 3, H, W)."""
    out = torch.addcmul(shift, turn[:, :, 0], points[:, None, 0])
    out.addcmul_(turn[:, :, 1], points[:, None, 1])
    return out.addcmul_(turn[:, :, 2], points[:, None, 2])


def jacobian(gradient: Tensor, moved: Tensor) -> Tensor:
    """Gradient along moved points (B, 3, H, W) -> along a small twist after the motion (B, 6, H, W): [g, Y x g]."""
    out = gradient.new_empty(len(gradient), 6, *gradient.shape[2:])
    out[:, :3] = gradient
    # Written out: `torch.linalg.cross` takes its vectors one by one on the CPU.
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        torch.mul(moved[:, j], gradient[:, k], out=out[:, 3 + i])
        out[:, 3 + i].addcmul_(moved[:, k], gradient[:, j], value=-1)
    return out


def normal_equations(residual: Tensor, J: Tensor, weight: Tensor) -> Tensor:
    """Sums of w J J^T and of w J r over windows: (K, N), (6, K, N) and (K, N) -> (27, N), N systems of six unknowns.

    The rows of the upper triangle, each from the diagonal on, and then the right side.
    """
    weighted = J * weight
    parts = [(J[i:] * weighted[i]).sum(1) for i in range(6)]
    return torch.cat([*parts, (weighted * residual).sum(1)])


def solve(equations: Tensor, diagonal: Tensor, right: Tensor, damping: Tensor) -> Tensor:
    """(A + D + damping * diag(A + D)) x = -(b + right), by Cholesky with square roots left out.

    Args:
        equations: A and b of N systems, as `normal_equations` gives them, (27, N).
        diagonal: D, (6, N or 1), positive.
        right: (6, N), added to the right side.
        damping: (N,), not negative.

    Returns:
        (6, N).
    """
    # Windows of a few pixels fix a rotation about a far camera badly: single precision would not do.
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
