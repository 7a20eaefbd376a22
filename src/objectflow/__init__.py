"""Moving objects, rigid motions and dense scene flow from two RGB-D frames."""

from objectflow.errors import ObjectflowError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.base import Estimator
from objectflow.methods.registry import DEFAULT_METHOD, METHODS, load
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
