"""Twist fields: moving points by them, and many small symmetric systems at once.

A twist (B, 6, H, W) is [translation part in cm, rotation part in radians] about the level's pivot,
and a point is given as its arm from there.
"""

from __future__ import annotations

import torch
from torch import Tensor

from objectflow import torch_geometry


def motions(twist: Tensor) -> tuple[Tensor, Tensor]:
    """(B, 6, H, W) -> rotations less the identity (B, 3, 3, H, W), to keep digits, and shifts (B, 3, H, W)."""
    a_T_b = torch_geometry.se3_exp(twist.movedim(1, -1)).movedim((-2, -1), (1, 2))
    eye = torch.eye(3, dtype=twist.dtype, device=twist.device)[None, :, :, None, None]
    return a_T_b[:, :3, :3] - eye, a_T_b[:, :3, 3]


def displace(turn: Tensor, shift: Tensor, points: Tensor) -> Tensor:
    """(R - I) P + t of what `motions` returns and points (B, 3, H, W)."""
    out = torch.addcmul(shift, turn[:, :, 0], points[:, None, 0])
    out.addcmul_(turn[:, :, 1], points[:, None, 1])
    return out.addcmul_(turn[:, :, 2], points[:, None, 2])


def jacobian(gradient: Tensor, moved: Tensor) -> Tensor:
    """Gradient along moved points (B, 3, H, W) -> along a small twist after the motion (B, 6, H, W): [g, Y x g]."""
    return torch.cat([gradient, torch.linalg.cross(moved, gradient, dim=1)], dim=1)


class NormalEquations:
    """Sums of w J J^T and w J r over residuals, one 6x6 system a pixel."""

    def __init__(self, like: Tensor) -> None:
        """`like`: (B, H, W), for size, kind and device."""
        self.rows = [like.new_zeros(like.shape[0], 6 - i, *like.shape[1:]) for i in range(6)]
        """Row i of the upper triangle, from the diagonal on."""
        self.right = like.new_zeros(like.shape[0], 6, *like.shape[1:])

    def add(self, residual: Tensor, J: Tensor, weight: Tensor) -> None:
        """One residual a pixel: (B, H, W), (B, 6, H, W) and (B, H, W)."""
        weighted = J * weight[:, None]
        for i, row in enumerate(self.rows):
            row.addcmul_(J[:, i:], weighted[:, i : i + 1])
        self.right.addcmul_(weighted, residual[:, None])

    def take(self, other: NormalEquations, where: Tensor) -> None:
        """Become `other` where (B, 1, H, W) says so."""
        self.rows = [torch.where(where, new, old) for new, old in zip(other.rows, self.rows, strict=True)]
        self.right = torch.where(where, other.right, self.right)

    def solve(self, diagonal: Tensor, right: Tensor, damping: Tensor) -> Tensor:
        """(A + D + damping * diag(A + D)) x = -(b + right), by Cholesky with square roots left out.

        Args:
            diagonal: D, (B or 1, 6, H or 1, W or 1), positive.
            right: (B, 6, H, W), added to the right side.
            damping: (B, 1, H, W), not negative.
        """
        # Windows of a few pixels fix a rotation about a far camera badly: single precision would not do.
        rows = [row.double() for row in self.rows]
        for i in range(6):
            rows[i][:, 0] = (rows[i][:, 0] + diagonal[:, i]) * (1 + damping[:, 0])
        x = list((-(self.right + right)).double().unbind(1))
        for i in range(6):
            pivot = rows[i][:, 0].clone()
            scaled = rows[i] / pivot[:, None]
            for j in range(i + 1, 6):
                rows[j] = rows[j] - scaled[:, j - i, None] * rows[i][:, j - i :]
                x[j] = x[j] - scaled[:, j - i] * x[i]
            rows[i], x[i] = scaled, x[i] / pivot
        for i in reversed(range(5)):
            for j in range(i + 1, 6):
                x[i] = x[i] - rows[i][:, j - i] * x[j]
        return torch.stack(x, dim=1).to(self.right.dtype)
