"""`ObjectMotion` and `SceneMotion`: the result of an estimate, in memory and as a result folder."""

from objectflow.motion.object_motion import ObjectMotion
from objectflow.motion.scene_motion import SceneMotion

__all__ = ["ObjectMotion", "SceneMotion"]
