"""Rigid transforms between the frames of a recording, from `/tf_static` and `/tf`."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from objectflow import geometry
from objectflow.readers.camera_info import frame_name
from objectflow.typing import Float64Array


class TransformTree:
    """Transforms between named frames; the first transform of each pair of frames is kept."""

    def __init__(self) -> None:
        self._edges: dict[str, dict[str, Float64Array]] = {}

    def add(self, message: Any) -> None:
        """Add the transforms of a `tf2_msgs/TFMessage`; those that are no rigid transforms are ignored."""
        for stamped in message.transforms:
            parent, child = frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id)
            q, t = stamped.transform.rotation, stamped.transform.translation
            quaternion, offset = np.array([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z])
            if not np.isfinite([*quaternion, *offset]).all() or not np.linalg.norm(quaternion) > 0.5:
                continue
            parent_T_child = np.eye(4)
            parent_T_child[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
            parent_T_child[:3, 3] = offset
            self._edges.setdefault(parent, {}).setdefault(child, parent_T_child)
            self._edges.setdefault(child, {}).setdefault(parent, geometry.inverse(parent_T_child))

    def find(self, target: str, source: str) -> Float64Array | None:
        """`target_T_source` (4, 4) along the shortest chain of transforms; None if the frames are not connected."""
        target, source = frame_name(target), frame_name(source)
        found = {target: np.eye(4)}
        queue = deque([target])
        while queue:
            frame = queue.popleft()
            if frame == source:
                return found[frame]
            for neighbour, frame_T_neighbour in self._edges.get(frame, {}).items():
                if neighbour not in found:
                    found[neighbour] = found[frame] @ frame_T_neighbour
                    queue.append(neighbour)
        return None


def extrinsics_matrix(message: Any) -> Float64Array | None:
    """The (4, 4) transform of the RealSense driver's `Extrinsics`, whose rotation is stored column by column.

    Returns:
        `to_T_from` of a topic named `extrinsics/from_to_to`; None if it is no rigid transform.
    """
    rotation = np.asarray(message.rotation, dtype=np.float64).reshape(3, 3).T
    offset = np.asarray(message.translation, dtype=np.float64)
    if not np.isfinite(offset).all() or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        return None
    to_T_from = np.eye(4)
    to_T_from[:3, :3], to_T_from[:3, 3] = rotation, offset
    return to_T_from
