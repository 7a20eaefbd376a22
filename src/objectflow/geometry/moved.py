"""Whether a rigid motion exceeds a tolerance: the one rule by which an object or the camera counts as moving.

A tolerance in metres decides for objects (`is_moving`). For a camera, whose motion changes every pixel, the noise of
the image and of its depth decides (`exceeds_noise`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise
from objectflow.geometry.pinhole import project
from objectflow.geometry.se3 import rotation_angle, transform
from objectflow.typing import BoolMask, Float64Array

STATIC_DISPLACEMENT = 0.004
"""Metres: default tolerance. A depth camera cannot tell a smaller displacement of an object from none."""
STATIC_SHIFT_PX, STATIC_SIGMAS = 0.7, 3.0
"""Pixels, and standard deviations of depth: default tolerances of a camera's motion; a motion within both is noise."""
LEVER_ARM = 0.05
"""Metres: default distance from the centre at which a rotation counts as a displacement; a small object's radius."""
_END_QUANTILE = 0.9
"""Quantile of the displacements of an object's points that is that of its ends; stray pixels move farther."""


def is_moving(
    rotation: Float64Array,
    translation: Float64Array,
    tolerance: float = STATIC_DISPLACEMENT,
    *,
    lever_arm: float = LEVER_ARM,
) -> BoolMask:
    """Whether a motion displaces an object's centre, or a point beside it, by more than a tolerance.

    Args:
        rotation: (..., 3, 3).
        translation: (..., 3) metres, of the centre.
        tolerance: metres.
        lever_arm: metres from the centre to the point that the rotation displaces.

    Returns:
        (...,) bool.
    """
    angle = rotation_angle(rotation)
    return np.asarray((np.linalg.norm(translation, axis=-1) > tolerance) | (angle * lever_arm > tolerance))


def displaces(
    prev_T_curr: Float64Array,
    points: NDArray[np.floating],
    center: Float64Array,
    tolerance: float = STATIC_DISPLACEMENT,
) -> bool:
    """Whether a motion displaces an object by more than a tolerance: by `is_moving`, or at its ends.

    Args:
        prev_T_curr: (4, 4).
        points: (N, 3) metres, of its surface; may be empty.
        center: (3,) metres, of the object.
        tolerance: metres.
    """
    if is_moving(prev_T_curr[:3, :3], transform(prev_T_curr, center) - center, tolerance):
        return True
    if not len(points):
        return False
    shift = np.linalg.norm(transform(prev_T_curr, points) - points, axis=1)
    return bool(np.quantile(shift, _END_QUANTILE) > tolerance)


def exceeds_noise(
    prev_T_curr: Float64Array,
    points: NDArray[np.floating],
    camera: Camera,
    *,
    noise: DepthNoise = STRUCTURED_LIGHT,
    shift_px: float = STATIC_SHIFT_PX,
    sigmas: float = STATIC_SIGMAS,
) -> bool:
    """Whether a motion displaces the median of points by more than noise, in the image or in space.

    Args:
        prev_T_curr: (4, 4).
        points: (N, 3) metres in the current frame.
        camera: projects them.
        noise: of the depth.
        shift_px: tolerance of the displacement in the image, in pixels.
        sigmas: tolerance of the displacement in space, in standard deviations of depth.

    Returns:
        False without points.
    """
    if not len(points):
        return False
    moved = transform(prev_T_curr, points)
    slide = np.linalg.norm(project(moved, camera) - project(points, camera), axis=1)
    shift = np.linalg.norm(moved - points, axis=1) / noise.sigma(points[:, 2])
    return bool(np.nanmedian(slide) >= shift_px or np.median(shift) >= sigmas)
