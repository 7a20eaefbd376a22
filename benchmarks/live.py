"""Live following of a replayed recording: latency, rate and dropped frames; or memory over a long run.

    python benchmarks/live.py
    python benchmarks/live.py --memory --widths 160 --methods truth dense-flow

The recording is drawn as it is read: four textured plates that circle before a wall, at 30 frames a second. Latency
is the time from taking a frame to having its motion and the objects' ids; each row is a process of its own. For memory
the next frame comes when the last one's motion is there, so that every frame is looked at. `truth` is the method that
knows the plates' masks and motions.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from objectflow.evaluation.methods import parse_methods
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.live import NewestFrame, follow, replay
from objectflow.methods.base import Estimator
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.tracking.tracker import Tracker, TrackerSettings
from objectflow.typing import Int64Array, UInt8Array

RATE = 30.0
TRUTH = "truth"
CIRCLE = 0.05
"""Metres, of the plates' ways; once around takes `ROUND` seconds: 3 cm in 0.3 s."""
ROUND = 3.0
WALL, PLATE = 1.1, 0.8
"""Metres from the camera."""
SIDE = 0.12
"""Metres, of a plate."""
PLACES = ((-0.2, -0.14), (0.2, -0.14), (-0.2, 0.14), (0.2, 0.14))
MARKS = 8
"""Lines of the memory table."""
T = TypeVar("T")


@dataclasses.dataclass
class Settings:
    """Follows a replayed recording."""

    methods: tuple[str, ...] = ("dense-flow", "consensus")
    """Methods as `objectflow evaluate` names them, or `truth`."""
    widths: tuple[int, ...] = (320, 640)
    """Of the images; heights are three quarters of them."""
    seconds: float = 20.0
    """Of the recording, for each row."""
    min_gap: float = 0.3
    """Seconds between two compared frames at least, as of `objectflow live`."""
    memory: bool = False
    """Print memory over a long run in place of latencies."""
    frames: int = 2000
    """Of the long run."""


class Recording:
    """Four plates that circle before a wall, drawn when a frame is asked for."""

    def __init__(self, width: int, count: int) -> None:
        self.count, focal = count, 0.74 * width
        self.camera = Camera(width, width * 3 // 4, focal, focal, (width - 1) / 2, (width * 3 // 4 - 1) / 2)
        self.depth_scale = 1000.0
        rng = np.random.default_rng(0)
        side = round(SIDE / PLATE * focal)
        self.wall = texture(rng, self.camera.height, width)
        self.plates = [texture(rng, side, side) for _ in PLACES]

    def __len__(self) -> int:
        return self.count

    def timestamp(self, index: int) -> float:
        """Seconds."""
        return index / RATE

    def corners(self, index: int) -> Int64Array:
        """(plates, 2) the first row and column of each plate, whole pixels."""
        angles = 2 * np.pi * (index / RATE / ROUND + np.arange(len(PLACES)) / 7)
        where = np.array(PLACES) + CIRCLE * np.stack([np.cos(angles), np.sin(angles)], axis=1) - SIDE / 2
        pixels = where * self.camera.fx / PLATE + (self.camera.cx, self.camera.cy)
        return np.rint(pixels[:, ::-1]).astype(np.int64)

    def __getitem__(self, index: int) -> RgbdFrame:
        color, depth = self.wall.copy(), np.full(self.wall.shape[:2], WALL, np.float32)
        for plate, (row, column) in zip(self.plates, self.corners(index), strict=True):
            here = slice(row, row + len(plate)), slice(column, column + len(plate))
            color[here], depth[here] = plate, PLATE
        return RgbdFrame(color, depth, self.camera, timestamp=self.timestamp(index), name=f"frame {index}")

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))

    def motion(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """What is true of two of its frames."""
        before, after = (self.corners(round((frame.timestamp or 0.0) * RATE)) for frame in (prev, curr))
        labels, flow = np.zeros(curr.depth.shape, np.int32), np.zeros((*curr.depth.shape, 3), np.float32)
        objects = []
        for number, (plate, start, end) in enumerate(zip(self.plates, before, after, strict=True), start=1):
            here = slice(end[0], end[0] + len(plate)), slice(end[1], end[1] + len(plate))
            prev_T_curr = np.eye(4)
            prev_T_curr[:2, 3] = (start - end)[::-1] * PLATE / self.camera.fx
            labels[here], flow[here] = number, prev_T_curr[:3, 3]
            middle = (end[::-1] + len(plate) / 2 - (self.camera.cx, self.camera.cy)) * PLATE / self.camera.fx
            objects.append(
                ObjectMotion(number, plate[..., 0].size, 1.0, True, np.array([*middle, PLATE]), prev_T_curr)
            )
        return SceneMotion(labels, flow, tuple(objects))


def texture(rng: np.random.Generator, height: int, width: int) -> UInt8Array:
    """Smooth noise in colour, as matching needs it."""
    noise = cv2.GaussianBlur(rng.normal(size=(height, width, 3)), (0, 0), 1.5)
    return np.clip(128 + 60 * noise / noise.std(), 0, 255).astype(np.uint8)


def make(method: str, recording: Recording) -> Estimator:
    """A method for a recording."""
    return recording.motion if method == TRUTH else parse_methods([method], camera="static")[0].make()


def measure_latency(method: str, width: int, seconds: float, min_gap: float) -> tuple[list[float], int, float, int]:
    """Latencies, frames that were not compared, CPU seconds in all, and tracks."""
    recording = Recording(width, round(seconds * RATE))
    estimator, tracker = make(method, recording), Tracker(TrackerSettings(history=2))
    estimator(recording[0], recording[9])  # what is loaded or compiled once
    latencies, dropped, began = [], 0, time.process_time()
    with NewestFrame(replay(recording)) as latest:
        for step in follow(latest, estimator, tracker, min_gap=min_gap):
            latencies.append(step.latency)
            dropped += step.dropped
    return latencies, dropped, time.process_time() - began, len(tracker.tracks)


def measure_memory(method: str, width: int, count: int) -> tuple[list[float], int, int, float]:
    """MiB in use after equal shares of the frames, estimates, tracks, and CPU seconds."""
    recording, turn = Recording(width, count), threading.Semaphore(1)
    estimator, tracker = make(method, recording), Tracker(TrackerSettings(history=2))

    def one_by_one() -> Iterator[RgbdFrame]:
        for number, frame in enumerate(recording):
            turn.acquire()
            yield frame
            if number == 0:
                time.sleep(0.2)  # the first one must be taken, and nobody says that it was
                turn.release()

    used, began, estimates = [], time.process_time(), 0
    with NewestFrame(one_by_one()) as latest:
        for estimates, _ in enumerate(follow(latest, estimator, tracker), start=1):
            if estimates % max(1, count // MARKS) == 0 or estimates == 1:
                used.append(memory())
            turn.release()
    return used, estimates, len(tracker.tracks), time.process_time() - began


def memory() -> float:
    """MiB of this process that are in memory (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def alone(function: Callable[..., T], *arguments: object) -> T:
    """Call in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def main(settings: Settings) -> None:
    """Measure, print."""
    table = Table(title="memory" if settings.memory else f"{settings.seconds:g} s at {RATE:g} frames a second")
    heads = ("estimates", "tracks", "first MiB", "MiB at equal shares of the run", "CPU s an estimate")
    if not settings.memory:
        heads = (
            "estimates",
            "median latency s",
            "95% s",
            "CPU s an estimate",
            "a second",
            "frames not compared",
            "tracks",
        )
    table.add_column("method")
    for head in ("size", *heads):
        table.add_column(head, justify="right")
    for method in settings.methods:
        for width in settings.widths:
            cells = [method, f"{width}x{width * 3 // 4}"]
            if settings.memory:
                used, count, tracks, seconds = alone(measure_memory, method, width, settings.frames)
                shares = " ".join(f"{one:.0f}" for one in used[1:])
                cells += [str(count), str(tracks), f"{used[0]:.0f}", shares, f"{seconds / count:.3f}"]
            else:
                latencies, dropped, cpu, tracks = alone(
                    measure_latency, method, width, settings.seconds, settings.min_gap
                )
                most = float(np.percentile(latencies, 95))
                rate = f"{len(latencies) / settings.seconds:.2f}"
                share = f"{dropped} of {round(settings.seconds * RATE)}"
                cells += [str(len(latencies)), f"{statistics.median(latencies):.2f}", f"{most:.2f}"]
                cells += [f"{cpu / len(latencies):.2f}", rate, share, str(tracks)]
            table.add_row(*cells)
    Console(width=120).print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
