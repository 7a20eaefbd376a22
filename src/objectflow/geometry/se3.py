"""Rigid motions in NumPy: SO(3), SE(3) and weighted Kabsch.

Functions accept leading batch dimensions where this is useful. Angles are in radians, lengths in metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from objectflow.errors import GeometryError
from objectflow.typing import BoolMask, Float64Array

ROTATION_TOLERANCE = 1e-3
"""Largest difference of `R @ R.T` from the identity, per entry, of a matrix that counts as a rotation."""
MAX_DISTANCE = 1e6
"""Metres: largest coordinate of a translation that counts as rigid motion; float32 resolves 6 cm there."""

_SMALL_ANGLE = 1e-4
"""Radians below which the series of sin and cos are exact to double precision, while the quotients are not."""


def hat(vector: ArrayLike) -> Float64Array:
    """(..., 3) -> (..., 3, 3): the skew matrix with `hat(a) @ b = a x b`."""
    v = np.asarray(vector, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def so3_exp(rotation_vector: ArrayLike) -> Float64Array:
    """Axis-angle (..., 3) in radians -> rotation matrix (..., 3, 3), by Rodrigues' formula and its series near 0."""
    w = np.asarray(rotation_vector, dtype=np.float64)
    a, b, _ = _rodrigues_coefficients(w)
    K = hat(w)
    return np.eye(3) + a * K + b * (K @ K)


def so3_log(rotation: ArrayLike) -> Float64Array:
    """Rotation matrix (..., 3, 3) -> axis-angle (..., 3) with an angle in [0, pi].

    It uses the quaternion of Shepperd's method, and is therefore exact to rounding both near 0 and near pi.
    """
    q = quaternion_from_matrix(rotation)
    vector, scalar = q[..., 1:], q[..., :1]
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, scalar)
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(sine > 1e-12, angle / sine, 2.0)
    return np.asarray(factor * vector)


def quaternion_from_matrix(rotation: ArrayLike) -> Float64Array:
    """Rotation matrix (..., 3, 3) -> unit quaternion (..., 4) as (w, x, y, z) with w >= 0."""
    R = np.asarray(rotation, dtype=np.float64)
    diagonal = np.stack([R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]], axis=-1)
    trace = diagonal.sum(-1)
    # Four times the outer product of the quaternion with itself; the row of the largest diagonal entry is well
    # conditioned.
    outer = np.empty((*R.shape[:-2], 4, 4))
    outer[..., 0, 0] = 1 + trace
    for i in range(3):
        outer[..., i + 1, i + 1] = 1 - trace + 2 * diagonal[..., i]
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        outer[..., 0, i + 1] = outer[..., i + 1, 0] = R[..., k, j] - R[..., j, k]
        outer[..., i + 1, j + 1] = outer[..., j + 1, i + 1] = R[..., i, j] + R[..., j, i]
    best = np.argmax(np.stack([outer[..., i, i] for i in range(4)], axis=-1), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def se3_exp(twist: ArrayLike) -> Float64Array:
    """Twist (..., 6) as [translation part, rotation part] -> (..., 4, 4)."""
    xi = np.asarray(twist, dtype=np.float64)
    rho, w = xi[..., :3], xi[..., 3:]
    a, b, c = _rodrigues_coefficients(w)
    K = hat(w)
    K2 = K @ K
    out = np.zeros((*xi.shape[:-1], 4, 4))
    out[..., :3, :3] = np.eye(3) + a * K + b * K2
    out[..., :3, 3] = ((np.eye(3) + b * K + c * K2) @ rho[..., None])[..., 0]
    out[..., 3, 3] = 1
    return out


def se3_log(a_T_b: ArrayLike) -> Float64Array:
    """(..., 4, 4) -> twist (..., 6) as [translation part, rotation part]; the inverse of `se3_exp`."""
    T = np.asarray(a_T_b, dtype=np.float64)
    w = so3_log(T[..., :3, :3])
    _, b, c = _rodrigues_coefficients(w)
    K = hat(w)
    V = np.eye(3) + b * K + c * (K @ K)
    rho = np.linalg.solve(V, T[..., :3, 3, None])[..., 0]
    return np.concatenate([rho, w], axis=-1)


def _rodrigues_coefficients(w: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3 of (..., 3) vectors, shaped (..., 1, 1)."""
    t = np.linalg.norm(w, axis=-1)[..., None, None]
    t2 = t * t
    small = t < _SMALL_ANGLE
    safe = np.where(small, 1.0, t)
    a = np.where(small, 1 - t2 / 6, np.sin(safe) / safe)
    # 2 sin^2(t/2) keeps the digits that 1 - cos t loses.
    b = np.where(small, 0.5 - t2 / 24, 2 * np.sin(safe / 2) ** 2 / safe**2)
    c = np.where(t < 1e-2, 1 / 6 - t2 / 120 + t2 * t2 / 5040, (safe - np.sin(safe)) / safe**3)
    return a, b, c


def make_transform(rotation: ArrayLike, translation: ArrayLike) -> Float64Array:
    """(..., 3, 3) and (..., 3) -> (..., 4, 4)."""
    R, t = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    out = np.zeros((*R.shape[:-2], 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = R, t, 1
    return out


def inverse(a_T_b: ArrayLike) -> Float64Array:
    """Rigid inverse of (..., 4, 4): `b_T_a`."""
    T = np.asarray(a_T_b, dtype=np.float64)
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    return make_transform(R, -(R @ T[..., :3, 3, None])[..., 0])


def transform(a_T_b: ArrayLike, points: NDArray[Any]) -> NDArray[Any]:
    """Map points (..., 3) from frame b to frame a with one (4, 4) transform, in the dtype of the points."""
    T = np.asarray(a_T_b).astype(points.dtype)
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def is_rigid(matrix: object) -> bool:
    """Whether a value is a (4, 4) array of a rotation and a translation, up to the rounding of stored numbers."""
    if not isinstance(matrix, np.ndarray) or matrix.shape != (4, 4) or matrix.dtype.kind not in "fiu":
        return False
    with np.errstate(over="ignore"):  # Numbers beyond float64 become infinite, which is refused.
        T = matrix.astype(np.float64)  # `MAX_DISTANCE` exceeds the range of float16.
    R = T[:3, :3]
    # Written so that NaN fails too.
    if not (np.abs(R).max() < 2 and np.abs(T[:3, 3]).max() <= MAX_DISTANCE):
        return False
    is_rotation = np.abs(R @ R.T - np.eye(3)).max() < ROTATION_TOLERANCE and np.linalg.det(R) > 0
    return bool(is_rotation and np.array_equal(T[3], [0, 0, 0, 1]))


def rotation_angle(rotation: ArrayLike) -> Float64Array:
    """Angle in radians of rotation matrices (..., 3, 3)."""
    return np.asarray(np.linalg.norm(so3_log(rotation), axis=-1))


def kabsch(
    curr: NDArray[Any], prev: NDArray[Any], weights: NDArray[Any] | None = None
) -> tuple[Float64Array, BoolMask]:
    """Weighted least-squares rigid motion `prev_T_curr` of matched points; batched.

    It minimises `sum w |R curr + t - prev|^2` (Kabsch 1976).

    Args:
        curr, prev: (..., N, 3) metres.
        weights: (..., N), not negative; ones when None.

    Returns:
        (..., 4, 4) transforms, and (...,) bool: whether the points determine the rotation; fewer than three points
        of positive weight, or points on one line, do not. The transform is then one of many minimisers.

    Raises:
        GeometryError: shapes that do not fit, points that are not finite, or weights that are negative or not finite.
    """
    p, q = np.asarray(curr, dtype=np.float64), np.asarray(prev, dtype=np.float64)
    if p.shape != q.shape or p.ndim < 2 or p.shape[-1] != 3:
        raise GeometryError(f"kabsch needs two (..., N, 3) arrays of one shape, not {p.shape} and {q.shape}")
    if not (np.isfinite(p).all() and np.isfinite(q).all()):
        raise GeometryError("kabsch needs finite points: leave out those without depth")
    w = np.ones(p.shape[:-1]) if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape != p.shape[:-1] or not np.isfinite(w).all() or (w < 0).any():
        raise GeometryError(f"kabsch needs finite weights >= 0 of shape {p.shape[:-1]}")
    total = w.sum(-1)[..., None]
    w = w / np.where(total > 0, total, 1)
    p_mean, q_mean = (w[..., None] * p).sum(-2), (w[..., None] * q).sum(-2)
    p0, q0 = p - p_mean[..., None, :], q - q_mean[..., None, :]
    R, S = nearest_rotation(np.swapaxes(w[..., None] * q0, -1, -2) @ p0)
    out = make_transform(R, q_mean - (R @ p_mean[..., None])[..., 0])
    # Rank 2 (points on a plane) is sufficient: the third axis follows, since reflections are excluded.
    spread = (w[..., None] * p0**2).sum((-1, -2))
    determined = (S[..., 1] > 1e-6 * np.maximum(S[..., 0], 1e-300)) & (spread > 1e-16) & (total[..., 0] > 0)
    return out, np.asarray(determined)


def nearest_rotation(matrix: ArrayLike) -> tuple[Float64Array, Float64Array]:
    """The rotations nearest to matrices in the Frobenius norm: R maximises tr(R^T matrix).

    Reflections are excluded as in Umeyama 1991, equation 43.

    Args:
        matrix: (..., 3, 3).

    Returns:
        (..., 3, 3) rotations, and (..., 3) singular values of the matrices, in descending order.
    """
    U, singular, Vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    U[..., 2] *= np.where(np.linalg.det(U @ Vt) < 0, -1.0, 1.0)[..., None]
    return np.asarray(U @ Vt), singular


def nearest_rigid(matrix: Float64Array) -> Float64Array:
    """(4, 4) transform with its rotation orthonormal again, as after long products."""
    return make_transform(nearest_rotation(matrix[:3, :3])[0], matrix[:3, 3])
