"""Frames turned by quarter turns about the optical axis, and results turned back."""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow import Camera, RgbdFrame, SceneMotion, geometry

_TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Rotation of points by which an image turns anticlockwise by a quarter."""


def turn_frame(frame: RgbdFrame, quarters: int) -> RgbdFrame:
    """The frame of a camera that is mounted turned, so that its image is turned anticlockwise."""
    for _ in range(quarters % 4):
        old = frame.camera
        camera = Camera(width=old.height, height=old.width, fx=old.fy, fy=old.fx, cx=old.cy, cy=old.width - 1 - old.cx)
        color, depth = np.ascontiguousarray(np.rot90(frame.color)), np.ascontiguousarray(np.rot90(frame.depth))
        frame = RgbdFrame(color=color, depth=depth, camera=camera)
    return frame


def turn_back(motion: SceneMotion, quarters: int) -> SceneMotion:
    """A result on turned frames as one on the frames themselves."""
    rotation = np.linalg.matrix_power(_TURN, quarters % 4)
    turned_T_frame = geometry.make_transform(rotation, np.zeros(3))

    def back(prev_T_curr: np.ndarray) -> np.ndarray:
        return np.asarray(geometry.inverse(turned_T_frame) @ prev_T_curr @ turned_T_frame)

    return dataclasses.replace(
        motion,
        labels=np.ascontiguousarray(np.rot90(motion.labels, -quarters)),
        scene_flow=np.ascontiguousarray(np.rot90(motion.scene_flow, -quarters) @ rotation.astype(np.float32)),
        objects=tuple(
            dataclasses.replace(obj, prev_T_curr=back(obj.prev_T_curr), center=rotation.T @ obj.center)
            for obj in motion.objects
        ),
        camera_motion=None if motion.camera_motion is None else back(motion.camera_motion),
    )
