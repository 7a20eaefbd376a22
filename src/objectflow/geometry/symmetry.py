"""Rotational symmetry: symmetry axes and the paper's reduction of rotations.

Source: the paper's appendix "Annotating Objects with Rotational Symmetry". Rotations of an object's symmetry group are
invisible, so the training target is the smallest of all rotations that explain a pair of frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from objectflow.errors import GeometryError
from objectflow.geometry.se3 import quaternion_from_matrix, rotation_angle, so3_exp
from objectflow.typing import Float64Array

_MIN_REDUCTION = 1e-9
"""Radians: minimum reduction of the rotation angle per pass; passes end below it."""


@dataclass(frozen=True)
class SymmetryAxis:
    """A symmetry axis of an object, through the origin of the object frame."""

    axis: tuple[float, float, float]
    """Unit vector in the object frame."""
    order: int
    """n >= 2 for C_n (rotations by 2 pi / n), 0 for continuous (any rotation)."""


def reduce_motion(
    prev_R_object: ArrayLike, curr_R_object: ArrayLike, symmetry: Sequence[SymmetryAxis]
) -> Float64Array:
    """The smallest rotation `prev_R_curr` (3, 3) that cannot be distinguished from the object's own.

    Args:
        prev_R_object, curr_R_object: (3, 3) object orientations in one camera or world frame.
        symmetry: the object's axes, in the object frame.
    """
    Rp, Rc = np.asarray(prev_R_object, dtype=np.float64), np.asarray(curr_R_object, dtype=np.float64)
    axes = np.array([axis.axis for axis in symmetry], dtype=np.float64).reshape(-1, 3)
    return reduce_rotation(Rp @ Rc.T, axes @ Rp.T, axes @ Rc.T, [axis.order for axis in symmetry])


def reduce_rotation(raw: ArrayLike, prev_axes: ArrayLike, curr_axes: ArrayLike, orders: Sequence[int]) -> Float64Array:
    """Reduce a rotation about every symmetry axis.

    Each pass wraps the twist about every axis into (-pi/n, pi/n], which is the paper's rule; passes repeat until none
    reduces the rotation further. For one axis this is the paper's result. For a finite group listed with all of its
    axes it is the smallest rotation of all, since every element of the group is a rotation about one of them. Two
    cases are special because the list is not the whole group: a half turn across a continuous axis may be about any
    perpendicular axis, and two continuous axes make a ball, whose rotation is invisible.

    Args:
        raw: (3, 3) `prev_R_curr` as simulated.
        prev_axes, curr_axes: (A, 3) unit axes in the two frames: `prev_axes = curr_axes @ raw.T`.
        orders: n >= 2 for C_n, 0 for continuous; one for each axis.

    Returns:
        (3, 3): `raw @ g`, where g rotates the object in the current frame by an element of its group.

    Raises:
        GeometryError: shapes that do not fit, axes that `raw` does not map onto each other, an order of 1 or below 0.
    """
    R = np.array(raw, dtype=np.float64)
    prev, curr = np.asarray(prev_axes, dtype=np.float64), np.asarray(curr_axes, dtype=np.float64)
    if R.shape != (3, 3) or prev.shape != (len(orders), 3) or curr.shape != prev.shape:
        raise GeometryError(
            f"reduce_rotation needs a (3, 3) rotation and two (A, 3) lists of axes for A = {len(orders)} orders, "
            f"not {R.shape}, {prev.shape} and {curr.shape}"
        )
    if any(order < 0 or order == 1 for order in orders):
        raise GeometryError(f"symmetry orders are 0 (continuous) or at least 2, not {list(orders)}")
    if not np.allclose(curr @ R.T, prev, atol=1e-4):
        raise GeometryError("the rotation does not map the current symmetry axes to the previous ones")
    continuous = [axis for axis, order in zip(curr, orders, strict=True) if order == 0]
    if any(np.linalg.norm(np.cross(continuous[0], axis)) > 1e-3 for axis in continuous[1:]):
        return np.eye(3)
    angle = float(rotation_angle(R))
    for first_pass in (True, *([False] * 100)):
        for axis, order in zip(curr, orders, strict=True):
            R = reduce_about_axis(R, axis, order)
        if continuous and 2 in orders:
            R = _flip_axis(R, continuous[0])
        smaller = float(rotation_angle(R))
        if not first_pass and smaller > angle - _MIN_REDUCTION:
            break
        angle = smaller
    return R


def reduce_about_axis(rotation: Float64Array, curr_axis: Float64Array, order: int) -> Float64Array:
    """Wrap the twist of `prev_R_curr` about one axis into (-pi/n, pi/n]; to 0 for a continuous axis.

    Args:
        rotation: (3, 3).
        curr_axis: (3,) unit vector in the current frame.
        order: n >= 2, or 0 for continuous.
    """
    alpha = twist_angle(rotation, curr_axis)
    return np.asarray(rotation @ so3_exp((wrap(alpha, order) - alpha) * curr_axis))


def twist_angle(rotation: Float64Array, curr_axis: Float64Array) -> float:
    """The twist of a rotation (3, 3) about an axis, in (-pi, pi].

    alpha = 2 atan((r_x q_x + r_y q_y + r_z q_z) / q_0); the printed formula has r_z q_z twice and lacks r_y q_y. The
    axis before and after the rotation give the same value, since the rotation maps the vector part of q to itself.
    """
    q = quaternion_from_matrix(rotation)
    return float(2 * np.arctan2(curr_axis @ q[1:], q[0]))


def wrap(alpha: float, order: int) -> float:
    """Wrap an angle into (-pi/n, pi/n] by a multiple of 2 pi / n; 0 for order 0."""
    if order == 0:
        return 0.0
    step = 2 * np.pi / order
    # The small term resolves the tie between both ends to +pi/n, whatever the rounding.
    return float(alpha - step * np.ceil(alpha / step - 0.5 - 1e-12))


def _flip_axis(rotation: Float64Array, curr_axis: Float64Array) -> Float64Array:
    """Swap the ends of a continuous axis (a half turn across it) where this makes the rotation smaller."""
    prev_axis = rotation @ curr_axis
    if prev_axis @ curr_axis >= 0:
        return rotation
    across = np.cross(curr_axis, prev_axis)
    if np.linalg.norm(across) < 1e-9:  # exactly upside down: the half turn undoes the whole rotation
        return np.eye(3)
    across /= np.linalg.norm(across)
    return np.asarray(rotation @ so3_exp(-np.pi * across))
