"""`vo-sf` and `pd-flow` compared with the output of the authors' VO-SF program: `python benchmarks/vo_sf_program.py`.

Reads pair folders (VGA) and the program's output for each at 320x240: `flow.npy` (3, 240, 320) in metres, `labels.npy`
(cluster of each pixel), `b.npy` (24) and `camera.npy` (4x4, frame 1 to frame 0).
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import objectflow
from objectflow import Camera, RgbdFrame, geometry
from objectflow.typing import BoolMask, Float32Array, Float64Array

SHARED = Path(__file__).resolve().parents[2] / "shared"
PAIRS = ("robot", "person_standing")


@dataclasses.dataclass
class Settings:
    """Compares with the authors' program."""

    data: Path = SHARED / "data"
    """Folder of pair folders."""
    program: Path = SHARED / "reference" / "vosf"
    """Folder with the program's output, one folder per pair."""


@dataclasses.dataclass(frozen=True, eq=False)
class Output:
    """Output of the program: flow (240, 320, 3) in metres, moving pixels (240, 320), and frame 1 to frame 0 (4, 4)."""

    flow: Float32Array
    moving: BoolMask
    camera: Float64Array


def read_pair(folder: Path) -> tuple[RgbdFrame, RgbdFrame]:
    """Read the previous and the current frame, which are the program's second and first frame.

    Frames are downsampled as in the program: its pixel (r, c) is VGA pixel (2r + 1, 2c), with its own focal length.
    """
    camera, scale = Camera.read(folder / "camera.json")
    program_camera = Camera(320, 240, 263.672, 263.672, 159.5, 119.5)
    frames = []
    for k in (1, 0):
        vga = RgbdFrame.read(
            folder / f"color{k}.png", folder / f"depth{k}.png", camera=camera, depth_scale=scale or 1000
        )
        frames.append(RgbdFrame(vga.color[1::2, ::2], vga.depth[1::2, ::2], program_camera))
    return frames[0], frames[1]


def read_output(folder: Path) -> Output:
    moving = np.append(np.load(folder / "b.npy") > 0.667, False)
    return Output(
        flow=np.moveaxis(np.load(folder / "flow.npy"), 0, -1),
        moving=moving[np.load(folder / "labels.npy")],
        camera=np.load(folder / "camera.npy").astype(np.float64),
    )


def compare(motion: objectflow.SceneMotion, output: Output) -> dict[str, float]:
    """IoU of the moving pixels, difference of the flow on common moving pixels, and of the camera motion if known."""
    moving = motion.labels > 0
    both = moving & output.moving if moving.any() else output.moving
    difference = np.linalg.norm(motion.scene_flow - output.flow, axis=-1)[both]
    a, b = motion.scene_flow[output.moving], output.flow[output.moving]
    cosine = (a * b).sum(-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))
    out = {
        "iou": float((moving & output.moving).sum() / (moving | output.moving).sum()),
        "flow mm": 1000 * float(np.median(difference)),
        "angle deg": float(np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1)))),
    }
    if motion.camera_motion is not None:
        error = motion.camera_motion @ output.camera  # prev_T_curr times the program's curr_T_prev.
        out["camera mm"] = 1000 * float(np.linalg.norm(error[:3, 3]))
        out["camera deg"] = float(np.degrees(geometry.rotation_angle(error[:3, :3])))
    return out


def main(settings: Settings) -> None:
    columns = ("iou", "flow mm", "angle deg", "camera mm", "camera deg", "seconds")
    table = Table(title="difference from the authors' VO-SF program, medians on moving pixels")
    for column in ("pair", "method", *columns):
        table.add_column(column, justify="left" if column in ("pair", "method") else "right")
    for name in PAIRS:
        prev, curr = read_pair(settings.data / name)
        output = read_output(settings.program / name)
        for method, camera in (("vo-sf", "moving"), ("pd-flow", "auto")):
            estimator = objectflow.load(method, camera=camera)
            estimator(prev, curr)
            start = time.perf_counter()
            row = compare(estimator(prev, curr), output)
            row["seconds"] = time.perf_counter() - start
            if method == "pd-flow":
                del row["iou"]  # It segments no objects.
            table.add_row(name, method, *(f"{row[c]:.3f}" if c in row else "" for c in columns))
    Console(width=110).print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
