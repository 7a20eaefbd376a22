"""Whether a rigid motion is large enough to count as one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from objectflow import geometry

Array = NDArray[np.float64]


_LEVER = 0.05
"""Metres: how far from its centre a small object's surface lies."""


STILL = 0.004
"""Metres: an object whose points move by less stands still, as far as a depth camera can tell."""


def moves(rotation: Array, translation: Array, still: float = STILL) -> NDArray[np.bool_]:
    """(..., 3, 3) and (..., 3) metres of the centre -> (...,) bool: see `still` of `average_motions`."""
    turn = geometry.rotation_angle(rotation)
    return np.asarray((np.linalg.norm(translation, axis=-1) > still) | (turn * _LEVER > still))
