"""Cameras, rigid transforms and projection in NumPy; `torch_se3` and `torch_pinhole` are the torch forms."""

from objectflow.geometry.camera import Camera
from objectflow.geometry.pinhole import (
    back_project,
    back_project_pixels,
    flow_from_motions,
    pixel_grid,
    pixel_rays,
    project,
)
from objectflow.geometry.se3 import (
    MAX_DISTANCE,
    hat,
    inverse,
    is_rigid,
    kabsch,
    make_transform,
    nearest_rigid,
    nearest_rotation,
    quaternion_from_matrix,
    rotation_angle,
    se3_exp,
    se3_log,
    so3_exp,
    so3_log,
    transform,
)
from objectflow.geometry.surface import surface_centers

__all__ = [
    "MAX_DISTANCE",
    "Camera",
    "back_project",
    "back_project_pixels",
    "flow_from_motions",
    "hat",
    "inverse",
    "is_rigid",
    "kabsch",
    "make_transform",
    "nearest_rigid",
    "nearest_rotation",
    "pixel_grid",
    "pixel_rays",
    "project",
    "quaternion_from_matrix",
    "rotation_angle",
    "se3_exp",
    "se3_log",
    "so3_exp",
    "so3_log",
    "surface_centers",
    "transform",
]
