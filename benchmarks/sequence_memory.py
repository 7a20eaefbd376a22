"""Memory of a sequence estimator over many frames: `python benchmarks/sequence_memory.py --frames 2000`.

A textured plate slides to and fro before a wall, rests in between, and is hidden for a while; every motion is given.
The table shows the size of the pickled state, the memory in use by Python and NumPy, and the time of a frame.
"""

from __future__ import annotations

import dataclasses
import gc
import pickle
import time
import tracemalloc

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from objectflow import SequenceEstimator, geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.tracking import Tracker, TrackerSettings

CAMERA = Camera(96, 72, 90.0, 90.0, 47.5, 35.5)
HALF = 0.1
"""Metres: half the edge length of the plate, which slides at a depth of 1 m."""
NOISE = 0.002
"""Metres: standard deviation of depth."""
PERIOD = 40
"""Frames of a slide to and fro and the rest after it."""


@dataclasses.dataclass
class Settings:
    """Feeds generated frames to a sequence estimator."""

    frames: int = 2000
    """Number of frames."""
    rows: int = 10
    """Number of rows of the table."""
    history: int = 2
    """Number of poses kept per track, as in `objectflow live`."""


def main(settings: Settings) -> None:
    """Feed, measure, print."""
    motions: list[SceneMotion] = []
    tracker = Tracker(TrackerSettings(history=settings.history))
    sequence = SequenceEstimator(lambda prev, curr: motions[-1], tracker=tracker)
    table = Table("frames", "tracks", "pickled state kB", "in use MB", "ms a frame")
    tracemalloc.start()
    every, spent = max(1, settings.frames // settings.rows), 0.0
    for number in range(settings.frames):
        frame, motion = scene(number)
        motions[:] = [motion]
        start = time.perf_counter()
        sequence.update(frame, float(number))
        spent += time.perf_counter() - start
        if (number + 1) % every == 0:
            gc.collect()
            size = len(pickle.dumps(sequence.state())) / 1e3
            used = tracemalloc.get_traced_memory()[0] / 1e6
            table.add_row(
                str(number + 1), str(len(sequence.tracks)), f"{size:.0f}", f"{used:.1f}", f"{1e3 * spent / every:.0f}"
            )
            spent = 0.0
    Console().print(table)


def position(number: int) -> float:
    """Metres: where the plate is; it rests in the second half of each period."""
    phase = min(number % PERIOD, PERIOD // 2)
    return 0.12 * float(np.sin(2 * np.pi * phase / (PERIOD // 2)))


def scene(number: int) -> tuple[RgbdFrame, SceneMotion]:
    """A frame and its motion since the frame before."""
    rng = np.random.default_rng(number)
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    x, before = position(number), position(number - 1) if number else position(0)
    along, across = (u - CAMERA.cx) / CAMERA.fx - x, (v - CAMERA.cy) / CAMERA.fy
    plate = (np.abs(along) < HALF) & (np.abs(across) < HALF)
    board = np.full(plate.shape, number % (3 * PERIOD) > 3 * PERIOD - 5)
    depth = np.where(plate, 1.0, 2.0) + NOISE * rng.standard_normal(plate.shape)
    color = np.full((*plate.shape, 3), 120, np.uint8)
    color[plate] = (120 + 60 * np.sin(40 * along) * np.cos(50 * across))[plate][:, None]
    board &= v > CAMERA.height // 4
    depth[board], color[board] = 0.5, 30
    moving = plate & ~board
    objects: tuple[ObjectMotion, ...] = ()
    if x != before and moving.sum() > 50:
        motion = geometry.make_transform(np.eye(3), [before - x, 0.0, 0.0])
        objects = (ObjectMotion(1, int(moving.sum()), 0.9, True, np.array([x, 0.0, 1.0]), motion),)
    labels = np.where(moving, len(objects), 0).astype(np.int32)
    frame = RgbdFrame(color, depth.astype(np.float32), CAMERA)
    return frame, SceneMotion(labels, np.zeros((*labels.shape, 3), np.float32), objects)


if __name__ == "__main__":
    main(tyro.cli(Settings))
