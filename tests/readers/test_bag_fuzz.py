"""Damaged bags raise only `ObjectflowError`, in bounded time and memory."""

from __future__ import annotations

import random
import struct
import tracemalloc
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from backports import zstd

from helpers.bags import COLOR, INFO, BagBuilder, Kind
from objectflow.errors import ObjectflowError, ReaderError
from objectflow.geometry.camera import Camera
from objectflow.readers import CutOffWarning, open_source
from objectflow.readers.mcap_scan import MCAP_MAGIC

CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)
DEPTH_CAMERA = Camera(32, 24, 22.0, 22.0, 15.0, 12.0)
TRIALS = 60
"""Number of damaged bags of each kind."""


def bag_file(folder: Path, kind: Kind) -> Path:
    """A bag with a lens, a transform, raw colour and compressed depth."""
    rng = np.random.default_rng(1)
    bag = BagBuilder(kind)
    for number in range(2):
        bag.frame_id = "color"
        bag.image(COLOR, 5 + number, rng.integers(0, 255, (24, 32, 3), dtype=np.uint8), "rgb8")
        bag.info(INFO, 5 + number, CAMERA, D=(-0.1, 0.01, 0, 0, 0))
        bag.frame_id = "depth"
        done, png = cv2.imencode(".png", rng.integers(500, 900, (24, 32)).astype(np.uint16))
        assert done
        bag.compressed("/d/image/compressedDepth", 5 + number, bytes(12) + png.tobytes(), "16UC1; compressedDepth png")
        bag.info("/d/camera_info", 5 + number, DEPTH_CAMERA)
    bag.transform("depth", "color", np.eye(4) + 0.05 * np.eye(4, k=3))
    path = bag.write(folder / ("a.bag" if kind == "ros1" else "a"))
    return path if path.is_file() else next(file for file in path.iterdir() if file.suffix != ".yaml")


def damaged(data: bytes, draw: random.Random) -> bytes:
    """Flip bits, write extreme lengths, delete and repeat bytes."""
    out = bytearray(data)
    for _ in range(draw.choice((1, 1, 2, 5, 20))):
        at = draw.randrange(len(out))
        kind = draw.randrange(4)
        if kind == 0:
            out[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            word = draw.choice((b"\xff" * 4, bytes(8), b"\xff" * 7 + b"\x7f", (100 << 30).to_bytes(8, "little")))
            out[at : at + len(word)] = word
        elif kind == 2:
            del out[at : at + draw.randrange(1, 200)]
        else:
            start = draw.randrange(len(out))
            out[at:at] = out[start : start + draw.randrange(1, 500)]
    return bytes(out)


def read_all(path: Path) -> tuple[int, list[str]]:
    """The number of frames that can be read, and the messages of the errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CutOffWarning)
        try:
            source = open_source(path)
        except ObjectflowError as error:
            return 0, [str(error)]
    count, messages = 0, []
    for index in range(len(source)):
        try:
            count += source[index].depth.shape == (24, 32)
        except ObjectflowError as error:
            messages.append(str(error))
    return count, messages


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite3"])
def test_damaged_bags(tmp_path: Path, kind: Kind) -> None:
    file = bag_file(tmp_path, kind)
    assert read_all(file) == (2, [])
    data, draw = file.read_bytes(), random.Random(kind)
    target = tmp_path / f"damaged{file.suffix}"
    read = 0
    for _ in range(TRIALS):
        target.write_bytes(damaged(data, draw))
        count, messages = read_all(target)
        read += count > 0
        assert not any("\n" in message for message in messages)
    # Most damage leaves something to read, and some leaves nothing.
    assert 0 < read < TRIALS


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def chunk(data: bytes, stated: int) -> bytes:
    packed = zstd.compress(data)
    name = b"zstd"
    head = struct.pack("<QQQII", 0, 0, stated, 0, len(name)) + name + struct.pack("<Q", len(packed))
    return record(0x06, head + packed)


@pytest.mark.parametrize(
    "chunks",
    [
        # A chunk that states 100 GB; many small chunks that expand to a gigabyte each; a chunk in a chunk.
        chunk(bytes(1000), 100 << 30),
        chunk(bytes(1 << 26), 1 << 30) * 20,
        chunk(chunk(bytes(1 << 20), 1 << 20), len(chunk(bytes(1 << 20), 1 << 20))),
        record(0x05, b"")[:-1] + b"\xff" * 8,
    ],
)
def test_chunks_that_expand_without_limit_take_bounded_memory(tmp_path: Path, chunks: bytes) -> None:
    file = tmp_path / "a.mcap"
    file.write_bytes(MCAP_MAGIC + chunks + record(0x02, bytes(20)) + MCAP_MAGIC)
    tracemalloc.start()
    try:
        with pytest.raises(ReaderError, match="not a bag that can be read"):
            open_source(file)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 300 << 20
