"""Placement of an object's motion arrow and caption in the 3D view, free of occlusion."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.typing import Float64Array
from objectflow.view.viewer_frames import ViewerFrame


def place_arrow(shown: ViewerFrame, object_id: int, center: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Where to draw an object's arrow and caption so that neither occludes the object nor is occluded by it.

    Args:
        shown: the frame.
        object_id: the object.
        center: (3,) its centre, world frame, metres.

    Returns:
        (3,) shift of the arrow, which moves the centre towards the camera until it lies 1 cm in front of the surface,
        and (3,) position of the caption above the object's top edge in the image; world frame, metres.
    """
    frame = shown.frame
    mask = np.zeros_like(frame.valid) if shown.ids is None else (shown.ids == object_id) & frame.valid
    if not mask.any():
        return np.zeros(3), center
    eye = shown.world_T_camera[:3, 3]
    surface = geometry.transform(shown.world_T_camera, geometry.back_project(frame.depth, frame.camera)[mask])
    ranges, center_range = np.linalg.norm(surface - eye, axis=1), float(np.linalg.norm(center - eye))
    shift_length = min(0.0, float(np.percentile(ranges, 2)) - 0.01 - center_range)
    shift = shift_length * (center - eye) / max(center_range, 1e-9)
    rows, columns = np.nonzero(mask)
    camera, row, depth = frame.camera, rows[0] - 0.04 * frame.camera.height, frame.depth[rows[0], columns[0]]
    above = geometry.back_project_pixels(np.array([columns.mean(), row]), depth, camera)
    return shift, geometry.transform(shown.world_T_camera, above)
