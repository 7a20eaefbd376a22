"""Whether a rigid motion is large enough to count as one."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.typing import BoolMask, Float64Array

_LEVER_ARM = 0.05
"""Metres: how far from its centre a small object's surface lies."""


STATIC_DISPLACEMENT = 0.004
"""Metres: an object whose points move by less stands still, as far as a depth camera can tell."""


def is_moving(rotation: Float64Array, translation: Float64Array, still: float = STATIC_DISPLACEMENT) -> BoolMask:
    """(..., 3, 3) and (..., 3) metres of the centre -> (...,) bool: see `still` of `average_motions`."""
    turn = geometry.rotation_angle(rotation)
    return np.asarray((np.linalg.norm(translation, axis=-1) > still) | (turn * _LEVER_ARM > still))
