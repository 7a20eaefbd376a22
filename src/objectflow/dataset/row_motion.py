"""The ground truth of a pair in the form of a result."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.dataset.moving_objects import has_moved
from objectflow.dataset.schema import PairRow
from objectflow.motion import ObjectMotion, SceneMotion


def motion_of_row(row: PairRow) -> SceneMotion:
    """The true motion of a pair: objects visible in the current frame, with unreduced rotations.

    Objects that are not visible in the previous frame have no motion to compare with and count as static.
    """
    camera = None if row.camera_motion is None or np.array_equal(row.camera_motion, np.eye(4)) else row.camera_motion
    background = np.eye(4) if camera is None else camera
    points = geometry.back_project(row.curr.depth, row.curr.camera)
    pixels = np.bincount(row.curr_labels.ravel())
    centers = geometry.surface_centers(points, row.curr_labels)
    objects = tuple(
        ObjectMotion(
            id=obj.label,
            pixels=int(pixels[obj.label]),
            score=1.0,
            moving=obj.in_both and has_moved(obj.prev_pose, obj.curr_pose, background),
            center=centers.get(obj.label, obj.center),
            prev_T_curr=obj.prev_T_curr(raw=True) if obj.in_both else background,
        )
        for obj in sorted(row.objects, key=lambda obj: obj.label)
        if obj.label < len(pixels) and pixels[obj.label]
    )
    motions = {obj.id: obj.prev_T_curr for obj in objects if obj.moving}
    return SceneMotion(
        labels=row.curr_labels,
        scene_flow=geometry.flow_from_motions(points, row.curr_labels, motions, camera),
        objects=objects,
        camera_motion=camera,
        method="ground truth",
    )
