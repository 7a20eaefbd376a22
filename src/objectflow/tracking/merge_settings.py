"""Thresholds by which two known objects are recognised as pieces of one."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.settings import Settings, setting


@dataclass(frozen=True)
class MergeSettings(Settings):
    """When two known objects are pieces of one."""

    min_steps: int = setting(3, minimum=1)
    """Minimum number of steps of both, in all of which their relative pose was constant. With fewer, objects that one
    push moves would be united."""
    min_step: float = setting(0.005, above=0)
    """Metres: smallest mean displacement of the points of a model in such a step."""
    max_shift: float = setting(0.003, above=0)
    """Metres: largest mean displacement of one relative to the other in any step."""
    max_delay: int = setting(1, minimum=0)
    """Largest number of frames between those in which both became known; beyond it, one has moved alone."""
    max_distance: float = setting(0.01, minimum=0)
    """Metres, beside the size of a voxel: largest distance between the surfaces of two that touch."""
