"""Thresholds by which an object that has just been found is followed back in time."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.settings import Settings, setting


@dataclass(frozen=True)
class EarlierSettings(Settings):
    """How far an object is followed back, and which earlier steps count."""

    frames: int = setting(8, minimum=1)
    """Number of frames before the current one that are kept; objects are followed back through these."""
    min_step: float = setting(0.002, minimum=0)
    """Metres: smallest mean displacement of a model's points that counts as a step."""
    min_step_sigmas: float = setting(1.0, minimum=0)
    """The same in standard deviations of the depth noise at the object; the larger of both applies."""
    max_rests: int = setting(2, minimum=0)
    """Number of consecutive frames at rest after which an object is not followed farther back."""
    min_present: float = setting(0.7, minimum=0, maximum=1)
    """Minimum share of the model's visible points that an earlier frame must confirm."""
    min_visible: float = setting(0.3, minimum=0, maximum=1)
    """Minimum share of the facing points that nothing may hide in an earlier frame."""
