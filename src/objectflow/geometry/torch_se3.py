"""Rigid motions in torch: batched, on any device, with finite gradients; the differentiable form of `se3`.

Matrices and point lists have their components last, (..., 3); dense maps follow the networks, batch first and channels
second, (B, 3, H, W). Angles are in radians, lengths in metres.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from objectflow.errors import GeometryError

_SERIES_BELOW = 0.25
"""Squared radians below which series are used: eight terms are exact to double precision there, while the quotients
lose digits, in single precision at much larger angles already."""


def hat(vector: Tensor) -> Tensor:
    """(..., 3) -> (..., 3, 3): the skew matrix with `hat(a) @ b = a x b`."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*vector.shape, 3)


def so3_exp(rotation_vector: Tensor) -> Tensor:
    """Axis-angle (..., 3) in radians -> rotation matrices (..., 3, 3); smooth at 0."""
    a, b = (c[..., None] for c in rodrigues_coefficients(rotation_vector.square().sum(-1, keepdim=True), 2))
    K = hat(rotation_vector)
    return torch.eye(3, dtype=K.dtype, device=K.device) + a * K + b * (K @ K)


def se3_exp(twist: Tensor) -> Tensor:
    """Twists (..., 6) as [translation part, rotation part] -> (..., 4, 4); smooth at 0."""
    rho, w = twist[..., :3], twist[..., 3:]
    a, b, c = (x[..., None] for x in rodrigues_coefficients(w.square().sum(-1, keepdim=True)))
    K = hat(w)
    K2 = K @ K
    eye = torch.eye(3, dtype=K.dtype, device=K.device)
    return make_transform(eye + a * K + b * K2, ((eye + b * K + c * K2) @ rho[..., None])[..., 0])


def make_transform(rotation: Tensor, translation: Tensor) -> Tensor:
    """(..., 3, 3) and (..., 3) -> (..., 4, 4)."""
    top = torch.cat([rotation, translation[..., None]], dim=-1)
    last = top.new_tensor([0, 0, 0, 1]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, last], dim=-2)


def nearest_rotation(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """The rotations R (..., 3, 3) that maximise tr(R^T matrix), and the singular values (..., 3) of the matrices.

    The gradient is that of the rotation itself rather than of the singular vectors: it is exact where singular values
    are equal, and 0 in the directions that the matrix does not determine. Singular values have no gradient.
    """
    rotation, singular = _NearestRotation.apply(matrix)  # type: ignore[no-untyped-call]
    return rotation, singular


class _NearestRotation(torch.autograd.Function):
    """See `nearest_rotation`."""

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
        # H = R P with P = V S V^T symmetric. The skew part of R^T dH = (R^T dR) P + dP is a Sylvester equation that is
        # diagonal in the basis V: entry (i, j) of R^T dR is that of the skew part, divided by s_i + s_j.
        R, S, Vt = ctx.saved_tensors
        sums = S[..., :, None] + S[..., None, :]
        fixed = sums > 1e-6 * S[..., :1, None]
        K = Vt @ R.mT @ grad @ Vt.mT * torch.where(fixed, 1 / torch.where(fixed, sums, 1.0), 0.0)
        out: Tensor = R @ Vt.mT @ (K - K.mT) @ Vt
        return out


def rigid_flow(points: Tensor, rotation_vector: Tensor, translation: Tensor, center: Tensor) -> Tensor:
    """Scene flow `P_prev - P_curr = R (P - X) + X + T - P` of every pixel (equation 1 of the paper).

    It is computed as (R - I)(P - X) + T without forming R, so that small motions of distant points keep their digits.

    Args:
        points: P, (B, 3, ...) metres, current camera frame; NaN where unknown.
        rotation_vector: Q, axis-angle in radians. This and the next two are (B, 3, ...) or broadcast to it.
        translation: T, metres: displacement of the object's centre.
        center: X, metres: the object's centre in the current frame.

    Returns:
        (B, 3, ...) metres; NaN where points are. The gradient is finite at rotation 0.

    Raises:
        GeometryError: shapes that do not fit.
    """
    try:
        shapes = (points.shape, rotation_vector.shape, translation.shape, center.shape)
        shape: torch.Size = torch.broadcast_shapes(*shapes)  # type: ignore[no-untyped-call]
    except RuntimeError as error:
        raise GeometryError(f"rigid_flow needs maps of one shape (B, 3, H, W): {error}") from error
    if len(shape) < 2 or shape[1] != 3:
        raise GeometryError(f"rigid_flow needs maps (B, 3, H, W), not {tuple(shape)}")
    Q, arm = rotation_vector.expand(shape), (points - center).expand(shape)
    a, b = rodrigues_coefficients(Q.square().sum(1, keepdim=True), 2)
    turned = torch.linalg.cross(Q, arm, dim=1)
    flow: Tensor = a * turned + b * torch.linalg.cross(Q, turned, dim=1) + translation
    return flow


def rodrigues_coefficients(angle2: Tensor, count: int = 3) -> tuple[Tensor, ...]:
    """The first `count` of sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3, for squared angles t^2 of any shape.

    Of a rotation vector w: R = I + a hat(w) + b hat(w)^2, and V = I + b hat(w) + c hat(w)^2 maps the translation part
    of a twist to the translation. Gradients are finite at 0.
    """
    small = angle2 < _SERIES_BELOW
    x = torch.where(small, angle2, 0.0)
    # The unused branch must be finite as well: 0 times an infinite gradient is NaN.
    t = torch.where(small, 1.0, angle2).sqrt()
    sine = torch.sin(t)
    quotients = (lambda: sine / t, lambda: 2 * torch.sin(t / 2).square() / t.square(), lambda: (t - sine) / t**3)
    return tuple(torch.where(small, _series(x, k + 1), quotients[k]()) for k in range(count))


def _series(x: Tensor, first: int) -> Tensor:
    """1/first! - x/(first + 2)! + x^2/(first + 4)! - ..., eight terms by Horner's method."""
    out = torch.zeros_like(x)
    for k in reversed(range(8)):
        out = 1 / math.factorial(first + 2 * k) - x * out
    return out
