"""Time to open a bag, relative to reading its file once: `python benchmarks/bag_opening.py --megabytes 300`.

Writes a recording of raw colour and depth in every kind of bag, and opens each. Reading means reading all bytes of the
file in blocks of 1 MiB, and decompressing means decompressing every message once by rosbags, without interpreting it.
The files are in the page cache, the times are those of the CPU, and the shortest of several alternating runs counts.
With `--cold` the file is dropped from the page cache before each run, and the times are those of the clock.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from objectflow.geometry.camera import Camera
from objectflow.readers.bag import open_bag

CAMERA = Camera(640, 480, 615.0, 615.0, 319.5, 239.5)
FRAME_BYTES = CAMERA.width * CAMERA.height * 5
"""Bytes of a raw colour image and its depth."""
BLOCK = 1 << 20
"""Bytes that are read at once."""
KINDS = ("ros1", "ros1 lz4", "ros1 bz2", "sqlite3", "sqlite3 zstd", "mcap", "mcap zstd")


@dataclasses.dataclass
class Settings:
    """Writes bags and measures how long they take to open."""

    megabytes: int = 300
    """Size of the plain recording, megabytes."""
    kinds: tuple[str, ...] = KINDS
    """Kinds of bags: the container, and its compression."""
    repeats: int = 5
    """Number of runs of each measurement."""
    cold: bool = False
    """Drop the file from the page cache before each run."""


def main(settings: Settings) -> None:
    table = Table(title=f"{settings.megabytes} MB of 640x480 colour and depth")
    for name in ("bag", "file MB", "read s", "unpack s", "open s", "open / read", "open / (read + unpack)"):
        table.add_column(name, justify="left" if name == "bag" else "right")
    for kind in settings.kinds:
        with tempfile.TemporaryDirectory() as folder:
            path = write(Path(folder) / "recording", kind, settings.megabytes * 10**6)
            table.add_row(kind, *measure(path, kind, settings))
    Console().print(table)


def measure(path: Path, kind: str, settings: Settings) -> list[str]:
    files = [path] if path.is_file() else [one for one in path.iterdir() if one.suffix != ".yaml"]
    open_bag(path)  # imports what this kind needs
    runs: dict[str, list[float]] = {"read": [], "open": [], "decompress": []}
    for _ in range(settings.repeats):
        # The runs alternate, since other work on the machine changes over time.
        runs["read"].append(clock(partial(read_all, files), files, settings.cold))
        runs["open"].append(clock(lambda: open_bag(path), files, settings.cold))
        if " " in kind:
            runs["decompress"].append(clock(lambda: decompress(path, kind), files, settings.cold))
    reading, opening = min(runs["read"]), min(runs["open"])
    # Decompression reads the file as well.
    decompressing = max(0.0, min(runs["decompress"], default=reading) - reading)
    size = sum(one.stat().st_size for one in files) / 1e6
    numbers = [f"{size:.0f}", f"{reading:.3f}", f"{decompressing:.3f}", f"{opening:.3f}"]
    return [*numbers, f"{opening / reading:.2f}", f"{opening / (reading + decompressing):.2f}"]


def clock(work: Callable[[], Any], files: list[Path], cold: bool) -> float:
    """Seconds of a run: of the CPU, or of the clock if the files are read from the disk."""
    if cold:
        for path in files:
            with path.open("rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    now = time.perf_counter if cold else time.process_time
    start = now()
    work()
    return now() - start


def read_all(files: list[Path]) -> None:
    for path in files:
        with path.open("rb", buffering=0) as file:
            while file.read(BLOCK):
                pass


def decompress(path: Path, kind: str) -> None:
    """Read every message with rosbags, which decompresses it."""
    with Reader1(path) if kind.startswith("ros1") else Reader2(path) as reader:
        for _ in reader.messages():
            pass


def write(path: Path, kind: str, size: int) -> Path:
    """Write a recording of about `size` bytes before compression."""
    container, _, compression = kind.partition(" ")
    writer: Any
    if container == "ros1":
        store = get_typestore(Stores.ROS1_NOETIC)
        path = path.with_suffix(".bag")
        writer, serialize = Writer1(path), store.serialize_ros1
        if compression:
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    else:
        store = get_typestore(Stores.ROS2_HUMBLE)
        writer = Writer2(path, version=9, storage_plugin=StoragePlugin[container.upper()])
        serialize = store.serialize_cdr
        if compression:
            mode = CompressionMode.MESSAGE if container == "sqlite3" else CompressionMode.STORAGE
            writer.set_compression(mode, CompressionFormat[compression.upper()])
    images = scene()
    with writer:
        types = dict.fromkeys(("/color/image_raw", "/depth/image_raw"), "sensor_msgs/msg/Image")
        types["/color/camera_info"] = "sensor_msgs/msg/CameraInfo"
        known = {topic: writer.add_connection(topic, name, typestore=store) for topic, name in types.items()}
        for number in range(size // FRAME_BYTES):
            time_ns = 10**9 + number * 33_000_000
            found = [image_message(store, image, time_ns, number) for image in images]
            for (topic, name), message in zip(types.items(), [*found, info_message(store, time_ns)], strict=True):
                writer.write(known[topic], time_ns, serialize(message, name))
    return path


def scene() -> tuple[NDArray[Any], NDArray[Any]]:
    """Colour and depth of a slanted wall with the noise of a camera, which determines how well they compress."""
    rng = np.random.default_rng(0)
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    smooth = np.stack([u / 4, v / 3, (u + v) / 6], axis=-1) + rng.normal(0, 2, (CAMERA.height, CAMERA.width, 3))
    depth = 900 + u / 2 + rng.normal(0, 2, u.shape)
    return np.clip(smooth, 0, 255).astype(np.uint8), depth.astype(np.uint16)


def header(store: Any, time_ns: int) -> Any:
    stamp = store.types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    kind = store.types["std_msgs/msg/Header"]
    extra = {"seq": 0} if "seq" in kind.__dataclass_fields__ else {}
    return kind(stamp=stamp, frame_id="camera", **extra)


def image_message(store: Any, image: NDArray[Any], time_ns: int, number: int) -> Any:
    """An image that moves to the left by a pixel per frame."""
    pixels = np.roll(image, -number, axis=1)
    return store.types["sensor_msgs/msg/Image"](
        header=header(store, time_ns),
        height=CAMERA.height,
        width=CAMERA.width,
        encoding="rgb8" if image.ndim == 3 else "16UC1",
        is_bigendian=0,
        step=pixels[0].nbytes,
        data=pixels.view(np.uint8).ravel(),
    )


def info_message(store: Any, time_ns: int) -> Any:
    kind = store.types["sensor_msgs/msg/CameraInfo"]
    K = CAMERA.matrix
    values = {"D": np.zeros(5), "K": K.ravel(), "R": np.eye(3).ravel(), "P": np.hstack([K, np.zeros((3, 1))]).ravel()}
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return kind(
        header=header(store, time_ns),
        height=CAMERA.height,
        width=CAMERA.width,
        distortion_model="plumb_bob",
        binning_x=0,
        binning_y=0,
        roi=roi,
        **{name if name in kind.__dataclass_fields__ else name.lower(): value for name, value in values.items()},
    )


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
