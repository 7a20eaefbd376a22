"""What a physics engine reports of a simulation, and the damping that every engine applies alike."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.typing import Float64Array

GRAVITY = 9.81
"""Metres a second squared, down."""
FRAME = 1 / 60
"""Seconds."""
SUBSTEPS = 6
"""Steps of an engine a frame. With four, Bullet's usual number, what falls enters the floor by up to two centimetres;
six reject as few scenes as eight do, in less time."""
FRICTION = 1.0
LINEAR_DAMPING, ANGULAR_DAMPING = 0.9, 0.8
"""The paper's, from its code: Bullet's, which leaves (1 - d)^t of a velocity after t seconds."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames 0..L of a simulation of N objects."""

    world_T_object: Float64Array
    """(L + 1, N, 4, 4) metres."""
    depth: Float64Array
    """(L + 1,) deepest penetration in metres, 0 where nothing touches."""
    energy: Float64Array
    """(L + 1,) kinetic and potential energy in joules, the latter from the floor up."""
