"""Whether a rigid motion exceeds a tolerance: the one rule by which anything counts as moving."""

from __future__ import annotations

import numpy as np

from objectflow.geometry.se3 import rotation_angle
from objectflow.typing import BoolMask, Float64Array

STATIC_DISPLACEMENT = 0.004
"""Metres: default tolerance. A depth camera cannot tell a smaller displacement of an object from none."""
LEVER_ARM = 0.05
"""Metres: default distance from the centre at which a rotation counts as a displacement; a small object's radius."""


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
