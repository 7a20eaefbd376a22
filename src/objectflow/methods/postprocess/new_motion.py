"""An object with another motion."""

from __future__ import annotations

import dataclasses

from objectflow.geometry.moved import displaces
from objectflow.motion import ObjectMotion
from objectflow.typing import Float32Array, Float64Array


def with_motion(
    obj: ObjectMotion, prev_T_curr: Float64Array, points: Float32Array, static_displacement: float
) -> ObjectMotion:
    """An object with another motion, by whose size it counts as moving or as static.

    Args:
        obj: the object.
        prev_T_curr: (4, 4) its new motion.
        points: (N, 3) metres, of its surface.
        static_displacement: metres: an object that moves by less is static.
    """
    moving = displaces(prev_T_curr, points, obj.center, static_displacement)
    return dataclasses.replace(obj, prev_T_curr=prev_T_curr, moving=moving)
