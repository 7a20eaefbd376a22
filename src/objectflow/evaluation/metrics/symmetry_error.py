"""Errors of rotations and displacements up to an object's symmetry group."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from objectflow.errors import GeometryError
from objectflow.geometry.se3 import inverse, rotation_angle, so3_exp, transform
from objectflow.typing import Float64Array

_ALIGNED = np.deg2rad(2.0)
"""Radians within which axes count as parallel or orthogonal, since axes found on meshes are not exact."""
_SAME_ROTATION = np.deg2rad(5.0)
"""Radians within which two rotations of a group count as one."""
_LARGEST_GROUP = 60
"""Order of the icosahedral rotation group."""


def rotation_error(predicted: ArrayLike, true: ArrayLike, axes: ArrayLike = (), orders: Sequence[int] = ()) -> float:
    """Degrees between two rotations `prev_R_curr`, the smallest over the object's symmetry group.

    A rotation g of the group, applied in the current frame, is not observable, so `true @ g` is as correct as `true`.

    Args:
        predicted, true: (3, 3).
        axes: (A, 3) symmetry axes in the current camera frame, through the object's centre; generators suffice.
        orders: of each axis, n >= 2 for C_n, 0 for continuous.

    Raises:
        GeometryError: axes and orders of different number, invalid ones, or axes that generate no finite group.
    """
    P, T = np.asarray(predicted, dtype=np.float64), np.asarray(true, dtype=np.float64)
    a = _unit_axes(axes, orders)
    E = T.T @ P  # the error as a rotation in the current frame
    continuous = [axis for axis, order in zip(a, orders, strict=True) if order == 0]
    if continuous:
        return _error_of_revolution(E, continuous, [(x, n) for x, n in zip(a, orders, strict=True) if n != 0])
    if len(a) == 0:
        return float(np.degrees(rotation_angle(E)))
    return float(np.degrees(rotation_angle(np.swapaxes(rotation_group(a, orders), -1, -2) @ E).min()))


def displacement_error(
    predicted: ArrayLike,
    true: ArrayLike,
    points: ArrayLike,
    center: ArrayLike,
    axes: ArrayLike = (),
    orders: Sequence[int] = (),
) -> float:
    """Mean distance in metres between the ends of points under two motions, the smallest over the symmetry group.

    True rotations are reduced by symmetry, but the texture of a surface may show how far it really turned.

    Args:
        predicted, true: (4, 4) `prev_T_curr`.
        points: (N, 3) metres of the object in the current frame, N > 0.
        center: (3,) metres, on every symmetry axis.
        axes: (A, 3) symmetry axes in the current camera frame; generators suffice.
        orders: of each axis, n >= 2 for C_n, 0 for continuous.

    Raises:
        GeometryError: axes and orders of different number, invalid ones, or axes that generate no finite group.
    """
    a = _unit_axes(axes, orders)
    c = np.asarray(center, dtype=np.float64)
    x = np.asarray(points, dtype=np.float64) - c
    # The true motion undone: a rotation of the group carries x there if the prediction is right.
    y = transform(inverse(np.asarray(true, np.float64)) @ np.asarray(predicted, np.float64), x + c) - c
    continuous = [axis for axis, order in zip(a, orders, strict=True) if order == 0]
    if continuous:
        others = [(axis, order) for axis, order in zip(a, orders, strict=True) if order != 0]
        group = _best_of_revolution(x, y, continuous, others)
    else:
        group = rotation_group(a, orders)
    return float(np.linalg.norm(x @ np.swapaxes(group, -1, -2) - y, axis=-1).mean(-1).min())


def rotation_group(axes: ArrayLike, orders: Sequence[int]) -> Float64Array:
    """(G, 3, 3) all rotations of the finite group that C_n axes generate, the identity first.

    Args:
        axes: (A, 3).
        orders: n >= 2 of each axis.

    Raises:
        GeometryError: the axes generate more rotations than the group of any solid has.
    """
    a = _unit_axes(axes, orders)
    powers = [2 * np.pi * k / n * axis for axis, n in zip(a, orders, strict=True) for k in range(1, n)]
    rotations = so3_exp(np.array(powers).reshape(-1, 3))
    generators = so3_exp(2 * np.pi * a / np.array(orders, dtype=np.float64)[:, None])
    # Different rotations of a group with C_n are at least 2 pi / n apart.
    same = min(_SAME_ROTATION, np.pi / max(orders, default=2))
    limit = max(_LARGEST_GROUP, 2 * max(orders, default=0))
    group = np.eye(3)[None]
    fresh = _new_rotations(rotations, group, same)
    while len(fresh):
        group = np.concatenate([group, fresh])
        if len(group) > limit:
            raise GeometryError(f"symmetry axes of orders {list(orders)} generate no finite group: check their angles")
        products = (fresh[:, None] @ generators[None]).reshape(-1, 3, 3)
        fresh = _new_rotations(products, group, same)
    return group


def _new_rotations(candidates: Float64Array, known: Float64Array, same: float) -> Float64Array:
    """The candidates that differ from all known rotations and from each other."""
    floor = 1 + 2 * np.cos(same)  # trace(A^T B) = 1 + 2 cos of the angle between A and B
    new = candidates[~(_traces(candidates, known) > floor).any(1)]
    equal = _traces(new, new) > floor
    fresh: list[int] = []
    for i in range(len(new)):
        if not equal[i, fresh].any():
            fresh.append(i)
    return np.asarray(new[fresh])


def _traces(a: Float64Array, b: Float64Array) -> Float64Array:
    """trace(a^T b) of all pairs of (A, 3, 3) and (B, 3, 3), as (A, B)."""
    product: Float64Array = a.reshape(-1, 9) @ b.reshape(-1, 9).T
    return product


def _error_of_revolution(
    E: Float64Array, continuous: Sequence[Float64Array], others: Sequence[tuple[Float64Array, int]]
) -> float:
    """The smallest angle of E up to rotations about a continuous axis, which is the tilt of that axis."""
    axis = continuous[0]
    may_flip = False
    for other, order in [*((x, 0) for x in continuous[1:]), *others]:
        cosine = abs(float(axis @ other))
        if cosine > np.cos(_ALIGNED):
            continue
        if order == 2 and cosine < np.sin(_ALIGNED):
            may_flip = True
        else:  # any other rotation moves the axis; two continuous axes generate all rotations
            return 0.0
    moved = E @ axis
    tilt = float(np.arctan2(np.linalg.norm(np.cross(axis, moved)), axis @ moved))
    return float(np.degrees(min(tilt, np.pi - tilt) if may_flip else tilt))


def _best_of_revolution(
    x: Float64Array, y: Float64Array, continuous: Sequence[Float64Array], others: Sequence[tuple[Float64Array, int]]
) -> Float64Array:
    """(G, 3, 3) rotations that carry points x (N, 3) best to y: about a continuous axis, with and without a flip."""
    axis = continuous[0]
    flips = [np.eye(3)]
    for other, order in [*((one, 0) for one in continuous[1:]), *others]:
        cosine = abs(float(axis @ other))
        if cosine > np.cos(_ALIGNED):
            continue
        if order != 2 or cosine >= np.sin(_ALIGNED):  # the group is that of a ball
            U, _, Vt = np.linalg.svd(y.T @ x)
            return np.asarray((U * [1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt)[None]
        flips.append(so3_exp(np.pi * other))
    best = []
    for flip in flips:
        across = x @ flip.T
        across = across - np.outer(across @ axis, axis)
        angle = np.arctan2((np.cross(axis, across) * y).sum(), (across * y).sum())
        best.append(so3_exp(angle * axis) @ flip)
    return np.array(best)


def _unit_axes(axes: ArrayLike, orders: Sequence[int]) -> Float64Array:
    a = np.asarray(axes, dtype=np.float64).reshape(-1, 3)
    if len(a) != len(orders) or any(order < 0 or order == 1 for order in orders):
        raise GeometryError(f"{len(a)} symmetry axes need an order each, 0 or at least 2, not {list(orders)}")
    length = np.linalg.norm(a, axis=1, keepdims=True)
    if not (np.isfinite(length).all() and (length > 0).all()):
        raise GeometryError("symmetry axes must be finite and not 0")
    return np.asarray(a / length)
