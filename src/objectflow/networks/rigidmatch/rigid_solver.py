"""Rigid motions by weighted least squares over each object's matches (Kabsch 1976, Umeyama 1991)."""

from __future__ import annotations

import torch
from torch import Tensor

from objectflow.geometry.torch_se3 import nearest_rotation


def solve_motions(
    weights: Tensor, curr: Tensor, prev: Tensor, votes: Tensor, *, prior: float = 0.0, arm: float = 0.02
) -> tuple[Tensor, Tensor]:
    """Fit each object's rigid motion to its points and their matches.

    Sums over points are float64 matrix products of the weights with first and second moments, which avoids a tensor
    over objects, points and coordinates.

    Args:
        weights: (B, Q, N), non-negative.
        curr, prev: (B, N, 3) metres, finite.
        votes: (B, Q, 6) metres, [X, X + T]: the motion of the prior, which applies where there are no matches.
        prior: weight of the votes in matches; 0 is plain least squares.
        arm: lever arm in metres that weights the prior's rotation, the identity.

    Returns:
        rotation (B, Q, 3, 3) and translation (B, Q, 3): P_prev = rotation P_curr + translation. If weights and
        prior are 0, the rotation is the identity with gradient 0.
    """
    with torch.autocast(weights.device.type, enabled=False):
        w, p, q = weights.double(), curr.double(), prev.double()
        X, Y = votes[..., :3].double(), votes[..., 3:].double()
        total = w.sum(-1, keepdim=True) + prior
        safe = torch.where(total > 0, total, torch.ones_like(total))
        p_mean, q_mean = (w @ p + prior * X) / safe, (w @ q + prior * Y) / safe
        products = (q[..., :, None] * p[..., None, :]).flatten(2)
        H = (w @ products / safe).reshape(*w.shape[:2], 3, 3) - q_mean[..., :, None] * p_mean[..., None, :]
        eye = torch.eye(3, dtype=H.dtype, device=H.device)
        H = H + (prior / safe)[..., None] * (Y[..., :, None] * X[..., None, :] + arm**2 * eye)
        H = torch.where((total > 0)[..., None], H, eye)
        R, _ = nearest_rotation(H)
        t = q_mean - (R @ p_mean[..., None])[..., 0]
    return R.to(curr.dtype), t.to(curr.dtype)


@torch.no_grad()
def agreement(rotation: Tensor, translation: Tensor, curr: Tensor, prev: Tensor, scale: float) -> Tensor:
    """Compute the Cauchy weights of matches under each motion: `scale^2 / (scale^2 + error^2)`.

    Args:
        rotation, translation: (B, Q, 3, 3) and (B, Q, 3).
        curr, prev: (B, N, 3) metres.
        scale: metres.

    Returns:
        (B, Q, N) in 0..1.
    """
    # Coordinates come before points, so that all arithmetic runs along long rows.
    turned = rotation.flatten(1, 2) @ curr.transpose(-2, -1)
    off = (
        turned.reshape(*rotation.shape[:3], curr.shape[1])
        .add_(translation[..., None])
        .sub_(prev.transpose(-2, -1)[:, None])
    )
    square = off.square_().sum(2)
    return scale**2 / (scale**2 + square)
