"""Moving objects, rigid motions and dense scene flow from two RGB-D frames."""

from objectflow.errors import ObjectflowError
from objectflow.estimator import DEFAULT_METHOD, METHODS, Estimator, load
from objectflow.frame import Camera, RgbdFrame
from objectflow.motion import ObjectMotion, SceneMotion

__version__ = "0.1.0"

__all__ = [
    "DEFAULT_METHOD",
    "METHODS",
    "Camera",
    "Estimator",
    "ObjectMotion",
    "ObjectflowError",
    "RgbdFrame",
    "SceneMotion",
    "load",
]
