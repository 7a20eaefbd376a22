"""Rigid motions of small neighbourhoods from uncertain displacements, as features for the hourglass.

The network's heads predict rotations, but a rotation is a quotient of differences between displacements, which
convolutions approximate poorly. Here, the displacements around each cell that keep their mutual distances are selected
by spectral matching (Leordeanu and Hebert, ICCV 2005), and a rigid motion is fitted to them in closed form (Horn,
JOSA A 1987). The paper's network has no such layer.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

CHANNELS = 7
"""Channels of `local_motion`: rotation vector, displacement, and support."""
_SPECTRAL_ROUNDS = 6
"""Power iterations of spectral matching; more do not change the selection visibly."""
_SQUARINGS = 8
"""Squarings of Horn's matrix: its eigenvector is that of power 256."""
_PRIOR = 0.02
"""Weight of the identity in the fit, relative to one certain displacement at the distance `scale`: without enough
displacements, the rotation is none."""


@torch.no_grad()
def local_motion(displacement: Tensor, curr_cells: Tensor, *, window: int, scale: float, tolerance: float) -> Tensor:
    """Fit a rigid motion to the displacements around each cell, without gradient.

    Args:
        displacement: (B, 4, h, w), of `expected_displacement`.
        curr_cells: (B, 4, h, w) points, and 1 where there is a point; in the unit of the displacements.
        window: rows and columns of the neighbourhood, in each direction.
        scale: distance at which the weight of a neighbour falls to exp(-1/2).
        tolerance: change of the distance between two points at which their agreement falls to exp(-1/2).

    Returns:
        (B, 7, h, w): rotation vector from the current to the previous frame, displacement of the cell's point under
        the motion, and the support in 0..1, the share of the neighbourhood's weight that follows it. All are 0 where
        the point is missing.
    """
    with torch.autocast(displacement.device.type, enabled=False):
        height, width = displacement.shape[-2:]
        # A column of neighbours per cell: (B h w, K, channels).
        joined = torch.cat([curr_cells, displacement], dim=1).float()
        side = 2 * window + 1
        columns = F.unfold(joined, side, padding=window).transpose(1, 2)
        columns = columns.reshape(-1, joined.shape[1], side * side).transpose(1, 2)
        center = curr_cells.float().permute(0, 2, 3, 1).reshape(-1, 4)
        rotation, moved, support = _fit(columns, center, scale, tolerance)
        fitted = torch.cat([rotation, moved, support], dim=1) * center[:, 3:]
        return fitted.reshape(-1, height, width, CHANNELS).permute(0, 3, 1, 2)


def _fit(columns: Tensor, center: Tensor, scale: float, tolerance: float) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation vectors (N, 3), displacements of the centres (N, 3) and support (N, 1)."""
    curr, valid, offset, probability = columns[..., :3], columns[..., 3], columns[..., 4:7], columns[..., 7]
    prev = curr + offset
    square = (curr - center[:, None, :3]).square().sum(-1)
    near = valid * (-square / (2 * scale**2)).exp()
    weight = near * probability
    # Pairs of displacements agree if the distance between their points is the same in both frames.
    change = _distances(curr) - _distances(prev)
    agreement = (-change.square() / (2 * tolerance**2)).exp() * weight[:, None, :]
    chosen = torch.ones_like(weight)
    for _ in range(_SPECTRAL_ROUNDS):
        chosen = (agreement @ chosen[..., None])[..., 0]
        chosen = chosen / chosen.amax(1, keepdim=True).clamp_min(torch.finfo(chosen.dtype).tiny)
    weight = weight * chosen
    total = weight.sum(1, keepdim=True)
    share = (weight / total.clamp_min(1e-6))[..., None]
    curr_mean, prev_mean = (share * curr).sum(1), (share * prev).sum(1)
    H = ((share * (prev - prev_mean[:, None])).transpose(1, 2) @ (curr - curr_mean[:, None])) * total[..., None]
    H = H + _PRIOR * scale**2 * torch.eye(3, dtype=H.dtype, device=H.device)
    quaternion = _quaternion(H)
    moved = prev_mean + _turn(quaternion, center[:, :3] - curr_mean) - center[:, :3]
    known = total > 1e-6
    support = total / near.sum(1, keepdim=True).clamp_min(1e-6)
    return _rotation_vector(quaternion), torch.where(known, moved, 0.0), support


def _distances(points: Tensor) -> Tensor:
    """(N, K, 3) -> (N, K, K) distances, exact also between near points."""
    return torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")


def _quaternion(H: Tensor) -> Tensor:
    """(N, 3, 3) sums of prev curr^T -> (N, 4) unit quaternion, real part first and not negative (Horn 1987)."""
    xx, yx, zx = H[:, 0, 0], H[:, 0, 1], H[:, 0, 2]  # S_ab of Horn: a of the current, b of the previous point
    xy, yy, zy = H[:, 1, 0], H[:, 1, 1], H[:, 1, 2]
    xz, yz, zz = H[:, 2, 0], H[:, 2, 1], H[:, 2, 2]
    rows = (
        (xx + yy + zz, yz - zy, zx - xz, xy - yx),
        (yz - zy, xx - yy - zz, xy + yx, zx + xz),
        (zx - xz, xy + yx, yy - xx - zz, yz + zy),
        (xy - yx, zx + xz, yz + zy, zz - xx - yy),
    )
    N = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    # Shifted by its norm, the largest eigenvalue is the largest in magnitude too.
    norm = N.square().sum((1, 2), keepdim=True).sqrt().clamp_min(1e-12)
    power = N / norm + torch.eye(4, dtype=N.dtype, device=N.device)
    for _ in range(_SQUARINGS):
        power = power @ power
        power = power / power.abs().amax((1, 2), keepdim=True)
    # Every column is a multiple of the eigenvector; that of the largest diagonal entry is the most accurate.
    column = power.diagonal(dim1=1, dim2=2).argmax(1)
    quaternion = power.gather(2, column[:, None, None].expand(-1, 4, 1))[..., 0]
    quaternion = F.normalize(quaternion, dim=1)
    return torch.where(quaternion[:, :1] < 0, -quaternion, quaternion)


def _turn(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotate vectors (N, 3) by unit quaternions (N, 4)."""
    real, axis = quaternion[:, :1], quaternion[:, 1:]
    twice = 2 * torch.linalg.cross(axis, vector)
    turned: Tensor = vector + real * twice + torch.linalg.cross(axis, twice)
    return turned


def _rotation_vector(quaternion: Tensor) -> Tensor:
    """(N, 4) unit quaternions with a real part >= 0 -> (N, 3) radians."""
    sine = quaternion[:, 1:].norm(dim=1, keepdim=True)
    angle = 2 * torch.atan2(sine, quaternion[:, :1])
    factor: Tensor = torch.where(sine > 1e-8, angle / sine.clamp_min(1e-8), 2.0)
    return factor * quaternion[:, 1:]
