"""Rigid motions and the pinhole camera in torch: batched, on any device, with gradients that stay finite.

The differentiable twin of `objectflow.geometry`. Matrices and point lists keep their components last, (..., 3); dense
maps follow the networks, batch first and channels second, (B, 3, H, W). Angles in radians, lengths in metres.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from objectflow.errors import GeometryError

_SERIES_BELOW = 0.25
"""Squared angle below which series are used: eight terms are exact to double precision there, and the quotients that
they replace lose digits, in single precision from far above."""


def hat(vector: Tensor) -> Tensor:
    """(..., 3) -> (..., 3, 3): the skew matrix with `hat(a) @ b = a x b`."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*vector.shape, 3)


def so3_exp(rotation_vector: Tensor) -> Tensor:
    """Axis-angle (..., 3) in radians -> rotation matrices (..., 3, 3); smooth through 0."""
    a, b, _ = (c[..., None] for c in _rodrigues_coefficients(rotation_vector.square().sum(-1, keepdim=True)))
    K = hat(rotation_vector)
    return torch.eye(3, dtype=K.dtype, device=K.device) + a * K + b * (K @ K)


def so3_log(rotation: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) -> axis-angle (..., 3), angle in [0, pi]; smooth through 0, finite at pi."""
    q = _quaternion(rotation)
    scalar, vector = q[..., :1], q[..., 1:]
    sine2 = vector.square().sum(-1, keepdim=True)
    small = sine2 < 1e-8
    sine = torch.where(small, 1.0, sine2).sqrt()
    # angle / sine with tan(angle / 2) = sine / scalar; no root of 0, whose gradient is infinite.
    ratio2 = sine2 / torch.where(small, scalar, 1.0).square()
    series = 2 / torch.where(small, scalar, 1.0) * (1 - ratio2 / 3)
    return torch.where(small, series, 2 * torch.atan2(sine, scalar) / sine) * vector


def se3_exp(twist: Tensor) -> Tensor:
    """Twists (..., 6) as [translation part, rotation part] -> (..., 4, 4); smooth through 0."""
    rho, w = twist[..., :3], twist[..., 3:]
    a, b, c = (x[..., None] for x in _rodrigues_coefficients(w.square().sum(-1, keepdim=True)))
    K = hat(w)
    K2 = K @ K
    eye = torch.eye(3, dtype=K.dtype, device=K.device)
    return make_transform(eye + a * K + b * K2, ((eye + b * K + c * K2) @ rho[..., None])[..., 0])


def make_transform(rotation: Tensor, translation: Tensor) -> Tensor:
    """(..., 3, 3) and (..., 3) -> (..., 4, 4)."""
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    last = top.new_tensor([0, 0, 0, 1]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, last], dim=-2)


def kabsch(curr: Tensor, prev: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Weighted least-squares rigid motion `prev_T_curr` of matched points (Kabsch 1976), batched and differentiable.

    The gradient is that of the nearest rotation itself, not of its singular vectors: it is exact where singular values
    are equal, and 0 in the directions that the points do not fix.

    Args:
        curr, prev: (..., N, 3) metres, finite.
        weights: (..., N), finite and not negative; ones when None. Neither is checked, which would stall a GPU.

    Returns:
        (..., 4, 4) transforms, and (...,) bool: False where the points do not fix the rotation.

    Raises:
        GeometryError: shapes that do not fit.
    """
    if curr.shape != prev.shape or curr.ndim < 2 or curr.shape[-1] != 3:
        raise GeometryError(
            f"kabsch needs two (..., N, 3) tensors of one shape, not {tuple(curr.shape)} and {tuple(prev.shape)}"
        )
    w = torch.ones_like(curr[..., 0]) if weights is None else weights
    if w.shape != curr.shape[:-1]:
        raise GeometryError(f"kabsch needs weights of shape {tuple(curr.shape[:-1])}, not {tuple(w.shape)}")
    # Half precision has too few digits for means and sums of products, and no SVD.
    kind = torch.promote_types(torch.promote_types(curr.dtype, prev.dtype), torch.float32)
    with torch.autocast(curr.device.type, enabled=False):
        total = w.to(kind).sum(-1, keepdim=True)
        w = (w.to(kind) / torch.where(total > 0, total, 1.0))[..., None]
        p_mean, q_mean = (w * curr).sum(-2, keepdim=True), (w * prev).sum(-2, keepdim=True)
        p, q = curr - p_mean, prev - q_mean
        R, singular = _NearestRotation.apply((w * q).mT @ p)  # type: ignore[no-untyped-call]
        out = make_transform(R, (q_mean.mT - R @ p_mean.mT)[..., 0])
    spread = (w * p.square()).sum((-1, -2))
    determined = (singular[..., 1] > 1e-6 * singular[..., 0]) & (spread > 1e-16) & (total[..., 0] > 0)
    return out, determined


def nearest_rotation(matrix: Tensor) -> Tensor:
    """(..., 3, 3) -> the rotations R that maximise tr(R^T matrix), with the gradient that `kabsch` describes."""
    out: Tensor = _NearestRotation.apply(matrix)[0]  # type: ignore[no-untyped-call]
    return out


class _NearestRotation(torch.autograd.Function):
    """The rotation R that maximises tr(R^T H), and H's singular values (without gradient)."""

    @staticmethod
    def forward(ctx: Any, H: Tensor) -> tuple[Tensor, Tensor]:
        U, S, Vt = torch.linalg.svd(H)
        sign = torch.where(torch.linalg.det(U @ Vt) < 0, -1.0, 1.0).to(H.dtype)
        D = torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], dim=-1)
        R = (U * D[..., None, :]) @ Vt
        ctx.save_for_backward(R, S * D, Vt)
        ctx.mark_non_differentiable(S)
        return R, S

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> Tensor:
        # H = R P with P = V S V^T symmetric. The skew part of R^T dH = (R^T dR) P + dP is a Sylvester equation,
        # diagonal in V's basis: entry (i, j) of R^T dR is that of the skew part over s_i + s_j.
        R, S, Vt = ctx.saved_tensors
        sums = S[..., :, None] + S[..., None, :]
        fixed = sums > 1e-6 * S[..., :1, None]
        K = Vt @ R.mT @ grad @ Vt.mT * torch.where(fixed, 1 / torch.where(fixed, sums, 1.0), 0.0)
        out: Tensor = R @ Vt.mT @ (K - K.mT) @ Vt
        return out


def rigid_flow(points: Tensor, rotation_vector: Tensor, translation: Tensor, center: Tensor) -> Tensor:
    """Scene flow `P_prev - P_curr = R (P - X) + X + T - P` of every pixel (equation 1 of the paper).

    Computed as (R - I)(P - X) + T without ever forming R: small motions of far points keep their digits.

    Args:
        points: P, (B, 3, H, W) metres, current camera frame.
        rotation_vector: Q, axis-angle in radians; as are the next two, (B, 3, H, W) or of a shape that broadcasts.
        translation: T, metres: displacement of the object's centre.
        center: X, metres: the object's centre in the current frame.

    Returns:
        (B, 3, H, W) metres.

    Raises:
        GeometryError: shapes that do not fit.
    """
    try:
        shape = np.broadcast_shapes(points.shape, rotation_vector.shape, translation.shape, center.shape)
    except ValueError as error:
        raise GeometryError(f"rigid_flow needs maps of one shape (B, 3, H, W): {error}") from error
    if len(shape) != 4 or shape[1] != 3:
        raise GeometryError(f"rigid_flow needs maps (B, 3, H, W), not {tuple(shape)}")
    Q, arm = rotation_vector.expand(shape), (points - center).expand(shape)
    a, b, _ = _rodrigues_coefficients(Q.square().sum(1, keepdim=True))
    turned = torch.linalg.cross(Q, arm, dim=1)
    flow: Tensor = a * turned + b * torch.linalg.cross(Q, turned, dim=1) + translation
    return flow


def _rodrigues_coefficients(angle2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3 of squared angles; no root of 0, whose gradient is infinite."""
    small = angle2 < _SERIES_BELOW
    x = torch.where(small, angle2, 0.0)
    a, b, c = (_series(x, first) for first in (1, 2, 3))
    t = torch.where(small, 1.0, angle2).sqrt()
    sine = torch.sin(t)
    return (
        torch.where(small, a, sine / t),
        torch.where(small, b, 2 * torch.sin(t / 2).square() / t.square()),
        torch.where(small, c, (t - sine) / t**3),
    )


def _series(x: Tensor, first: int) -> Tensor:
    """1/first! - x/(first + 2)! + x^2/(first + 4)! - ..., eight terms by Horner's rule."""
    out = torch.zeros_like(x)
    for k in reversed(range(8)):
        out = 1 / math.factorial(first + 2 * k) - x * out
    return out


def _quaternion(R: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) -> unit quaternions (..., 4) as (w, x, y, z) with w >= 0, by Shepperd's method."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in R.unbind(-2))
    # Four times the outer product of the quaternion with itself; the row of its largest entry is well conditioned.
    rows = [
        torch.stack([1 + a + e + i, h - f, c - g, d - b], dim=-1),
        torch.stack([h - f, 1 + a - e - i, b + d, c + g], dim=-1),
        torch.stack([c - g, b + d, 1 - a + e - i, f + h], dim=-1),
        torch.stack([d - b, c + g, f + h, 1 - a - e + i], dim=-1),
    ]
    outer = torch.stack(rows, dim=-2)
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = outer.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)
