"""Live tracking of a replayed recording: latency, rate and dropped frames, or memory over a long run.

    python benchmarks/live.py
    python benchmarks/live.py --memory --widths 160 --methods truth dense-flow

The recording shows four textured plates that circle in front of a wall, at 30 frames per second, and is rendered on
access. Latency is the time from the arrival of a frame to its motion and track ids; each row runs in a separate
process. For memory, the next frame is delivered after the last result, so that every frame is processed. The method
`truth` returns the true masks and motions, of every pair.
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

from objectflow.cli.live import KEPT_FRAMES
from objectflow.evaluation.methods import parse_methods
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.live import NewestFrame, follow, replay
from objectflow.methods.base import Estimator
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.tracking.tracker import Tracker
from objectflow.tracking.tracker_settings import TrackerSettings
from objectflow.typing import Int64Array, UInt8Array

RATE = 30.0
TRUTH = "truth"
REFERENCE = "dense-flow"
"""Method to whose CPU time the others are compared, where it is among them."""
CIRCLE_RADIUS = 0.05
"""Radius of the plates' circular paths, metres; the speed is 3 cm in 0.3 s."""
PERIOD = 3.0
"""Duration of one revolution, seconds."""
WALL, PLATE = 1.1, 0.8
"""Depth of the wall and of the plates, metres."""
SIDE = 0.12
"""Side length of a plate, metres."""
CENTERS = ((-0.2, -0.14), (0.2, -0.14), (-0.2, 0.14), (0.2, 0.14))
"""Centres of the circles, x and y in metres."""
DETAILS = (1.5, 4.0, 12.0)
"""Pixels: standard deviations of the blur of the textures' noise."""
WALL_CONTRAST, PLATE_CONTRAST = 12.0, 60.0
"""Grey levels: standard deviations of the textures; walls have little."""
SAMPLES = 8
"""Number of memory measurements per run."""
T = TypeVar("T")


@dataclasses.dataclass
class Settings:
    """Tracks objects in a replayed recording."""

    methods: tuple[str, ...] = ("dense-flow", "consensus", "rigidmatch")
    """Methods as in `objectflow evaluate`, or `truth`."""
    widths: tuple[int, ...] = (320, 640)
    """Widths of the images, pixels; heights are three quarters of the widths."""
    seconds: float = 20.0
    """Duration of the recording for each row, seconds."""
    min_gap: float = 0.2
    """Smallest time between two compared frames, seconds, as in `objectflow live`."""
    every_pair: bool = False
    """Estimate every pair, also those that known objects explain."""
    memory: bool = False
    """Print memory over a long run instead of latencies."""
    frames: int = 2000
    """Number of frames of the long run."""


class Recording:
    """Four plates that circle in front of a wall, rendered on access."""

    def __init__(self, width: int, count: int) -> None:
        self.count, focal = count, 0.74 * width
        self.camera = Camera(width, width * 3 // 4, focal, focal, (width - 1) / 2, (width * 3 // 4 - 1) / 2)
        self.depth_scale = 1000.0
        self.cuts: tuple[int, ...] = ()
        self.notes: tuple[str, ...] = ()
        rng = np.random.default_rng(0)
        side = round(SIDE / PLATE * focal)
        self.wall = texture(rng, self.camera.height, width, WALL_CONTRAST)
        self.plates = [texture(rng, side, side, PLATE_CONTRAST) for _ in CENTERS]

    def __len__(self) -> int:
        return self.count

    def timestamp(self, index: int) -> float:
        """Seconds."""
        return index / RATE

    def corners(self, index: int) -> Int64Array:
        """(plates, 2) first row and column of each plate, integer pixels."""
        angles = 2 * np.pi * (index / RATE / PERIOD + np.arange(len(CENTERS)) / 7)
        corners = np.array(CENTERS) + CIRCLE_RADIUS * np.stack([np.cos(angles), np.sin(angles)], axis=1) - SIDE / 2
        pixels = corners * self.camera.fx / PLATE + (self.camera.cx, self.camera.cy)
        return np.rint(pixels[:, ::-1]).astype(np.int64)

    def __getitem__(self, index: int) -> RgbdFrame:
        color, depth = self.wall.copy(), np.full(self.wall.shape[:2], WALL, np.float32)
        for plate, (row, column) in zip(self.plates, self.corners(index), strict=True):
            window = slice(row, row + len(plate)), slice(column, column + len(plate))
            color[window], depth[window] = plate, PLATE
        return RgbdFrame(color, depth, self.camera, timestamp=self.timestamp(index), name=f"frame {index}")

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))

    def motion(self, prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        """The true motion between two frames."""
        before, after = (self.corners(round((frame.timestamp or 0.0) * RATE)) for frame in (prev, curr))
        labels, flow = np.zeros(curr.depth.shape, np.int32), np.zeros((*curr.depth.shape, 3), np.float32)
        objects = []
        for number, (plate, start, end) in enumerate(zip(self.plates, before, after, strict=True), start=1):
            window = slice(end[0], end[0] + len(plate)), slice(end[1], end[1] + len(plate))
            prev_T_curr = np.eye(4)
            prev_T_curr[:2, 3] = (start - end)[::-1] * PLATE / self.camera.fx
            labels[window], flow[window] = number, prev_T_curr[:3, 3]
            center = (end[::-1] + len(plate) / 2 - (self.camera.cx, self.camera.cy)) * PLATE / self.camera.fx
            objects.append(
                ObjectMotion(number, plate[..., 0].size, 1.0, True, np.array([*center, PLATE]), prev_T_curr)
            )
        return SceneMotion(labels, flow, tuple(objects))


def texture(rng: np.random.Generator, height: int, width: int, contrast: float) -> UInt8Array:
    """Colour noise with details of several sizes, as real surfaces have, also at the size of a network's input."""
    noise = np.zeros((height, width, 3))
    for sigma in DETAILS:
        blurred = cv2.GaussianBlur(rng.normal(size=(height, width, 3)), (0, 0), sigma)
        noise += blurred / blurred.std()
    return np.asarray(np.clip(128 + contrast * noise / noise.std(), 0, 255), dtype=np.uint8)


def make(method: str, recording: Recording) -> Estimator:
    """The estimator of a method; `truth` depends on the recording."""
    return recording.motion if method == TRUTH else parse_methods([method], camera="static")[0].make()


def measure_latency(
    method: str, width: int, seconds: float, min_gap: float, every_pair: bool
) -> tuple[list[float], int, float, int]:
    """Latencies, number of dropped frames, total CPU seconds, and number of tracks."""
    recording = Recording(width, round(seconds * RATE))
    estimator, tracker = make(method, recording), Tracker(TrackerSettings(history=2))
    estimator(recording[0], recording[9])  # Warm-up.
    latencies, dropped, start = [], 0, time.process_time()
    skip = not every_pair and method != TRUTH
    with NewestFrame(replay(recording), keep=KEPT_FRAMES, spacing=min_gap) as newest:
        for step in follow(newest, estimator, tracker, min_gap=min_gap, skip_explained=skip):
            latencies.append(step.latency)
            dropped += step.dropped
    return latencies, dropped, time.process_time() - start, len(tracker.tracks)


def measure_memory(method: str, width: int, count: int) -> tuple[list[float], int, int, float]:
    """Memory in MiB after equal shares of the frames, number of estimates and tracks, and CPU seconds."""
    recording, processed = Recording(width, count), threading.Semaphore(1)
    estimator, tracker = make(method, recording), Tracker(TrackerSettings(history=2))

    def one_by_one() -> Iterator[RgbdFrame]:
        for number, frame in enumerate(recording):
            processed.acquire()
            yield frame
            if number == 0:
                time.sleep(0.2)  # The first frame must be taken, which causes no estimate.
                processed.release()

    used, start, estimates = [], time.process_time(), 0
    with NewestFrame(one_by_one()) as newest:
        for estimates, _ in enumerate(follow(newest, estimator, tracker), start=1):
            if estimates % max(1, count // SAMPLES) == 0 or estimates == 1:
                used.append(memory())
            processed.release()
    return used, estimates, len(tracker.tracks), time.process_time() - start


def memory() -> float:
    """Resident memory of this process, MiB (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def in_process(function: Callable[..., T], *arguments: object) -> T:
    """Call a function in a separate process."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def main(settings: Settings) -> None:
    """Measure, print."""
    table = Table(title="memory" if settings.memory else f"{settings.seconds:g} s at {RATE:g} frames per second")
    heads: tuple[str, ...] = (
        "estimates",
        "tracks",
        "first MiB",
        "MiB at equal shares of the run",
        "CPU s per estimate",
    )
    if not settings.memory:
        heads = (
            "estimates",
            "median latency s",
            "95% s",
            "CPU s per estimate",
            f"times {REFERENCE}",
            "per second",
            "dropped frames",
            "tracks",
        )
    table.add_column("method")
    for head in ("size", *heads):
        table.add_column(head, justify="right")
    reference: dict[int, float] = {}
    for method in settings.methods:
        for width in settings.widths:
            cells = [method, f"{width}x{width * 3 // 4}"]
            if settings.memory:
                used, count, tracks, seconds = in_process(measure_memory, method, width, settings.frames)
                shares = " ".join(f"{value:.0f}" for value in used[1:])
                cells += [str(count), str(tracks), f"{used[0]:.0f}", shares, f"{seconds / count:.3f}"]
            else:
                latencies, dropped, cpu, tracks = in_process(
                    measure_latency, method, width, settings.seconds, settings.min_gap, settings.every_pair
                )
                high = float(np.percentile(latencies, 95))
                rate = f"{len(latencies) / settings.seconds:.2f}"
                share = f"{dropped} of {round(settings.seconds * RATE)}"
                cells += [str(len(latencies)), f"{statistics.median(latencies):.2f}", f"{high:.2f}"]
                each = cpu / len(latencies)
                if method == REFERENCE:
                    reference[width] = each
                ratio = f"{each / reference[width]:.1f}" if width in reference else ""
                cells += [f"{each:.2f}", ratio, rate, share, str(tracks)]
            table.add_row(*cells)
    Console(width=120).print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
