"""Results for other programs: COCO annotations and PLY point clouds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.motion.object_motion import ObjectMotion
from objectflow.typing import BoolMask, Float32Array, LabelImage


def to_coco(labels: LabelImage, objects: Sequence[ObjectMotion], image_id: int) -> list[dict[str, Any]]:
    """COCO annotations of the objects; see `SceneMotion.to_coco`."""
    out = []
    for obj in objects:
        mask = labels == obj.id
        rows, columns = np.nonzero(mask)
        left, top = (int(one.min()) if len(one) else 0 for one in (columns, rows))
        width, height = (int(one.max()) + 1 - low if len(one) else 0 for one, low in ((columns, left), (rows, top)))
        out.append(
            {
                "id": obj.id,
                "image_id": image_id,
                "category_id": 1,
                "segmentation": {"size": list(labels.shape), "counts": run_lengths(mask)},
                "area": int(mask.sum()),
                "bbox": [left, top, width, height],
                "iscrowd": 0,
                "score": obj.score,
                "attributes": {
                    "moving": obj.moving,
                    "displacement_m": obj.displacement,
                    "rotation_deg": obj.rotation_deg,
                    "own_prev_T_curr": obj.own_prev_T_curr.tolist(),
                },
            }
        )
    return out


def run_lengths(mask: BoolMask) -> list[int]:
    """Lengths of the runs of a mask in column-major order, beginning with a run of False that may be empty."""
    flat = np.concatenate([[False], mask.ravel(order="F")])
    changes = np.flatnonzero(flat[1:] != flat[:-1])
    return [int(length) for length in np.diff(np.concatenate([[0], changes, [mask.size]]))]


_VERTEX = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
        ("red", "u1"), ("green", "u1"), ("blue", "u1"),
        ("label", "<i4"),
        ("flow_x", "<f4"), ("flow_y", "<f4"), ("flow_z", "<f4"),
        ("own_flow_x", "<f4"), ("own_flow_y", "<f4"), ("own_flow_z", "<f4"),
    ]
)  # fmt: skip
_PLY_TYPES = {"<f4": "float", "|u1": "uchar", "<i4": "int"}


def to_ply(frame: RgbdFrame, valid: BoolMask, labels: LabelImage, flow: Float32Array, own_flow: Float32Array) -> bytes:
    """A binary PLY file of the pixels `valid`, which have depth: position and flows in metres, colour, and label."""
    points = geometry.back_project(frame.depth, frame.camera)[valid]
    vertices = np.zeros(len(points), _VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name], vertices[f"flow_{name}"] = points[:, axis], flow[valid][:, axis]
        vertices[f"own_flow_{name}"] = own_flow[valid][:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = frame.color[valid][:, channel]
    vertices["label"] = labels[valid]
    kinds = [(name, _VERTEX.fields[name][0].str) for name in _VERTEX.names or ()]  # type: ignore[index]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property {_PLY_TYPES[kind]} {name}" for name, kind in kinds]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii") + vertices.tobytes()
