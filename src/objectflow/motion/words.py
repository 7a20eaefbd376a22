"""Motions in words: the same numbers with the same digits in every table and picture."""

from __future__ import annotations

from objectflow.motion.object_motion import ObjectMotion

UNKNOWN = "unknown"
"""Displacement and rotation of a region that changed but whose motion was not found."""


def motion_texts(obj: ObjectMotion) -> tuple[str, str]:
    """Displacement in centimetres and rotation in degrees of an object's own motion, one decimal; 0 at rest."""
    if not obj.moving:
        return "0", "0"
    if not obj.motion_known:
        return UNKNOWN, UNKNOWN
    return f"{100 * obj.displacement:.1f}", f"{obj.rotation_deg:.1f}"


def motion_caption(obj: ObjectMotion) -> str:
    """Displacement and rotation of a moving object's own motion, with units; empty at rest."""
    if not obj.moving:
        return ""
    if not obj.motion_known:
        return f"motion {UNKNOWN}"
    return f"{100 * obj.displacement:.1f} cm, {obj.rotation_deg:.0f}°"
