"""The result of a simulation, and the constants that both engines share."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.typing import Float64Array

GRAVITY = 9.81
"""Downward acceleration, m/s^2."""
FRAME = 1 / 60
"""Duration of a frame, seconds."""
SUBSTEPS = 6
"""Simulation steps per frame. With four, Bullet's usual number, falling objects penetrate the floor by up to two
centimetres; six give as few rejected scenes as eight in less time."""
FRICTION = 1.0
LINEAR_DAMPING, ANGULAR_DAMPING = 0.9, 0.8
"""Damping of the paper's code, as Bullet defines it: a velocity is multiplied by (1 - d)^t within t seconds."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames 0..L of a simulation of N objects."""

    world_T_object: Float64Array
    """(L + 1, N, 4, 4) metres."""
    penetration: Float64Array
    """(L + 1,) deepest penetration, metres; 0 without contact."""
    energy: Float64Array
    """(L + 1,) kinetic plus potential energy above the floor, joules."""
