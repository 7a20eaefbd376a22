"""A generated set in miniature, written row by row: two boxes of labels before a wall, one of them moving."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.dataset.manifest import Kind, Manifest, Part, Shard, part_name, shard_name
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.schema import FrameObject, SequenceRow
from objectflow.dataset.shards import write_shard
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.symmetry import SymmetryAxis
from objectflow.storage.files import hash_file

WIDTH, HEIGHT = 64, 48
CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
FRAMES = (20, 30, 40, 50, 60, 70, 80, 90)
SPEED = 0.001
"""Metres a frame number, to the right, of object 1; object 2 stands still."""


def make_frame(sequence: str, frame: int, seed: int = 0) -> SequenceRow:
    """A wall 1 m away; label 1 moves along x at half that distance, label 2 stays."""
    rng = np.random.default_rng([seed, frame])
    left = 5 + round(SPEED * frame * CAMERA.fx / 0.5)
    labels = np.zeros((HEIGHT, WIDTH), np.int32)
    labels[10:22, left : left + 12] = 1
    labels[30:42, 40:56] = 2
    depth = np.where(labels > 0, np.float32(0.5), np.float32(1.0)).astype(np.float32)
    image = RgbdFrame(
        color=rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8), depth=depth, camera=CAMERA, name=sequence
    )
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, :3, 3] = [-0.2 + SPEED * frame, -0.06, 0.55]
    poses[1, :3, 3] = [0.13, 0.1, 0.55]
    objects = (
        FrameObject(1, "box", "box-1", (), poses[0]),
        FrameObject(2, "can", "can-1", (SymmetryAxis((0.0, 1.0, 0.0), 0),), poses[1]),
    )
    return SequenceRow(sequence, frame, image, labels, objects)


def write_set(folder: Path, kind: Kind, rows: list[dict[str, Any]], split: str = "test") -> Path:
    """One shard and a manifest."""
    folder.mkdir(parents=True, exist_ok=True)
    part = part_name(split, kind)
    path = folder / shard_name(part, 0, 1)
    write_shard(path, rows, kind, {})
    shard = Shard(path.name, len(rows), path.stat().st_size, hash_file(path))
    parts = Manifest.read(folder).parts if (folder / "manifest.json").exists() else {}
    made = Part(kind, split, len(rows), len(rows), 1, {}, (shard,))
    Manifest(0, {}, {**parts, part: made}, "0").write(folder)
    return folder


def write_pairs(folder: Path, count: int = 3, seed: int = 0, split: str = "test") -> Path:
    """Pairs of frames 20 and 80: object 1 moves 6 cm."""
    rows = []
    for number in range(count):
        name = f"{split}-{number:06d}"
        prev, curr = (make_frame(name, frame, seed + number) for frame in (20, 80))
        rows.append(pair_of_frames(prev, curr, key=name, scene=name).to_dict())
    return write_set(folder, "pairs", rows, split)


def write_sequences(folder: Path, count: int = 2, frames: tuple[int, ...] = FRAMES) -> Path:
    """Sequences of eight frames."""
    names = [f"test-{number:06d}" for number in range(count)]
    return write_set(folder, "sequences", [make_frame(name, frame).to_dict() for name in names for frame in frames])


def digest(folder: Path) -> str:
    """Of all files, by name and content."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    parts = [f"{path.relative_to(folder)} {hashlib.sha256(path.read_bytes()).hexdigest()}" for path in files]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()
