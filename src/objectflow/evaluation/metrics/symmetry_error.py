"""The error of a rotation, up to the turns of an object's symmetry group."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from objectflow.errors import GeometryError
from objectflow.geometry.se3 import rotation_angle, so3_exp
from objectflow.typing import Float64Array

_ALIGNED = np.deg2rad(2.0)
"""Axes nearer than this to parallel or to a right angle are meant to be: axes found on meshes are not exact."""
_SAME_TURN = np.deg2rad(5.0)
_LARGEST_GROUP = 60
"""The icosahedron's."""


def rotation_error(predicted: ArrayLike, true: ArrayLike, axes: ArrayLike = (), orders: Sequence[int] = ()) -> float:
    """Degrees between two rotations `prev_R_curr`, the smallest over the object's symmetry group.

    A turn g of the group, made in the current frame, cannot be seen, so `true @ g` is as true as `true`.

    Args:
        predicted, true: (3, 3).
        axes: (A, 3) symmetry axes in the current camera frame, through the object's centre.
        orders: for each axis n >= 2 for C_n, 0 for continuous. The axes need only generate the group.

    Raises:
        GeometryError: axes and orders that do not fit or generate no group of a solid.
    """
    P, T = np.asarray(predicted, dtype=np.float64), np.asarray(true, dtype=np.float64)
    a = _unit_axes(axes, orders)
    E = T.T @ P  # as a turn in the current frame
    continuous = [axis for axis, order in zip(a, orders, strict=True) if order == 0]
    if continuous:
        return _error_of_revolution(E, continuous, [(x, n) for x, n in zip(a, orders, strict=True) if n != 0])
    if len(a) == 0:
        return float(np.degrees(rotation_angle(E)))
    return float(np.degrees(rotation_angle(np.swapaxes(turn_group(a, orders), -1, -2) @ E).min()))


def turn_group(axes: ArrayLike, orders: Sequence[int]) -> Float64Array:
    """(G, 3, 3): every turn of the finite group that C_n axes generate, the identity first.

    Raises:
        GeometryError: the axes generate more turns than any solid's group has.
    """
    a = _unit_axes(axes, orders)
    powers = [2 * np.pi * k / n * axis for axis, n in zip(a, orders, strict=True) for k in range(1, n)]
    turns = so3_exp(np.array(powers).reshape(-1, 3))
    generators = so3_exp(2 * np.pi * a / np.array(orders, dtype=np.float64)[:, None])
    # Different turns of a group with C_n are 2 pi / n apart or more.
    same = min(_SAME_TURN, np.pi / max(orders, default=2))
    limit = max(_LARGEST_GROUP, 2 * max(orders, default=0))
    group = np.eye(3)[None]
    fresh = _new_turns(turns, group, same)
    while len(fresh):
        group = np.concatenate([group, fresh])
        if len(group) > limit:
            raise GeometryError(f"symmetry axes of orders {list(orders)} generate no finite group: check their angles")
        products = (fresh[:, None] @ generators[None]).reshape(-1, 3, 3)
        fresh = _new_turns(products, group, same)
    return group


def _new_turns(candidates: Float64Array, known: Float64Array, same: float) -> Float64Array:
    """The candidates that differ from all known turns and from each other."""
    floor = 1 + 2 * np.cos(same)  # trace(A^T B) = 1 + 2 cos of the angle between A and B
    new = candidates[~(_traces(candidates, known) > floor).any(1)]
    equal = _traces(new, new) > floor
    fresh: list[int] = []
    for i in range(len(new)):
        if not equal[i, fresh].any():
            fresh.append(i)
    return np.asarray(new[fresh])


def _traces(a: Float64Array, b: Float64Array) -> Float64Array:
    """(A, 3, 3) and (B, 3, 3) -> (A, B): trace(a^T b) of every two."""
    product: Float64Array = a.reshape(-1, 9) @ b.reshape(-1, 9).T
    return product


def _error_of_revolution(
    E: Float64Array, continuous: Sequence[Float64Array], others: Sequence[tuple[Float64Array, int]]
) -> float:
    """The least angle of E up to turns about a continuous axis: how far E tilts that axis."""
    axis = continuous[0]
    may_flip = False
    for other, order in [*((x, 0) for x in continuous[1:]), *others]:
        cosine = abs(float(axis @ other))
        if cosine > np.cos(_ALIGNED):
            continue
        if order == 2 and cosine < np.sin(_ALIGNED):
            may_flip = True
        else:  # any other turn moves the axis, and with two continuous axes every turn is one of the group
            return 0.0
    moved = E @ axis
    tilt = float(np.arctan2(np.linalg.norm(np.cross(axis, moved)), axis @ moved))
    return float(np.degrees(min(tilt, np.pi - tilt) if may_flip else tilt))


def _unit_axes(axes: ArrayLike, orders: Sequence[int]) -> Float64Array:
    a = np.asarray(axes, dtype=np.float64).reshape(-1, 3)
    if len(a) != len(orders) or any(order < 0 or order == 1 for order in orders):
        raise GeometryError(f"{len(a)} symmetry axes need an order each, 0 or at least 2, not {list(orders)}")
    length = np.linalg.norm(a, axis=1, keepdims=True)
    if not (np.isfinite(length).all() and (length > 0).all()):
        raise GeometryError("symmetry axes must be finite and not 0")
    return np.asarray(a / length)
