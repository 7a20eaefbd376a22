"""A finished run with known tracks, masks and models, as its report is made of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.tracking.model_files import ply_bytes
from objectflow.tracking.track import Track
from objectflow.tracking.volume_meshing import TriangleMesh
from objectflow.typing import Float64Array, LabelImage
from objectflow.view.run_page.contents import ReportFrame, RunContents

SIZE = (72, 96)
CAMERA = Camera(96, 72, 90.0, 90.0, 47.5, 35.5)
FRAMES = 6
START = 100.0
"""Time of the first frame; frames are half a second apart."""


def times() -> list[float]:
    return [START + 0.5 * k for k in range(FRAMES)]


def pose(x: float, degrees: float = 0.0) -> Float64Array:
    return geometry.make_transform(geometry.so3_exp([0.0, np.radians(degrees), 0.0]), [x, 0.1, 0.8])


def make_tracks() -> list[Track]:
    """Object 1 moves 3 cm and 10 degrees in each of two steps, rests, and moves once more; object 2 moves once."""
    first = Track(
        1,
        [START, START + 0.5, START + 1.0, START + 2.0, START + 2.5],
        [pose(0.0), pose(0.03, 10), pose(0.06, 20), pose(0.06, 20), pose(0.05, 20)],
        [0, 1, 1, 0, 2],
        [0.9, 0.9, 0.8, 0.8, 1.0],
        [START + 1.5],
    )
    second = Track(2, [START + 1.5, START + 2.0], [pose(-0.2), pose(-0.2 + 0.04)], [0, 1], [0.5, 0.5])
    return [first, second]


def read_frame(number: int) -> RgbdFrame:
    color = np.random.default_rng(number).integers(0, 255, (*SIZE, 3), dtype=np.uint8)
    return RgbdFrame(color, np.full(SIZE, 0.8, np.float32), CAMERA)


def read_known(pair: str) -> LabelImage:
    """A square of 20 pixels that moves to the right by 4 pixels a frame; object 2 is seen from frame 4 on."""
    number = int(pair.rsplit("_", maxsplit=1)[-1])
    known = np.zeros(SIZE, np.int32)
    known[30:50, 10 + 4 * number : 30 + 4 * number] = 1
    if number >= 4:
        known[5:15, 60:72] = 2
    return known


def make_run(folder: Path, *, title: str = "recording", notes: tuple[str, ...] = ()) -> RunContents:
    """The run, with a box as the model of object 1 and a plane of points as its background."""
    pairs = [f"pair_{k - 1:06d}_{k:06d}" for k in range(1, FRAMES)]
    frames = [ReportFrame(k, time, 0, pairs[k - 1] if k else "") for k, time in enumerate(times())]
    tracks = make_tracks()
    (folder / "models").mkdir(parents=True)
    box = trimesh.creation.box((0.04, 0.06, 0.08))
    for _ in range(2):
        box = box.subdivide()
    colors = np.full((len(box.vertices), 3), (200, 40, 90), np.uint8)
    mesh = TriangleMesh(
        box.vertices.astype(np.float32), box.vertex_normals.astype(np.float32), colors, box.faces.astype(np.int32)
    )
    (folder / "models" / "object_001.ply").write_bytes(ply_bytes(mesh.vertices, mesh.normals, mesh.colors, mesh))
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 20), np.linspace(-0.4, 0.4, 15))
    plane = np.stack([x.ravel(), y.ravel(), np.ones(300)], axis=1).astype(np.float32)
    normals = np.tile(np.array([0, 0, -1], np.float32), (300, 1))
    (folder / "models" / "background.ply").write_bytes(ply_bytes(plane, normals, np.full((300, 3), 90, np.uint8)))
    index = {
        "objects": [
            {
                "id": 1,
                "files": ["object_001.ply", "object_001.glb"],
                "frames": [1, 2],
                "times": [START + 0.5, START + 1.0],
                "world_T_object": [pose(0.031, 10).tolist(), pose(0.062, 20).tolist()],
                "extent": [0.04, 0.06, 0.08],
                "seen_share_at_most": 0.6,
                "residual_mm": 1.25,
            }
        ],
        "background": {"file": "background.ply", "points": 300, "voxel": 0.05},
    }
    return RunContents(
        folder=folder,
        title=title,
        facts=(title, "6 frames"),
        notes=notes,
        frames=frames,
        tracks=tracks,
        has_times=True,
        read_frame=read_frame,
        read_known=read_known,
        models=index,
    )
