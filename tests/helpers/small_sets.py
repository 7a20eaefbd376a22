"""A miniature generated set: two boxes in front of a wall, one of them moving."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from helpers.cameras import small_camera
from helpers.pair_sets import write_part
from objectflow.dataset.pairing import pair_of_frames
from objectflow.dataset.schema import FrameObject, SequenceRow
from objectflow.frame import RgbdFrame
from objectflow.geometry.symmetry import SymmetryAxis

WIDTH, HEIGHT = 64, 48
CAMERA = small_camera(WIDTH, HEIGHT, focal=60.0)
FRAMES = (20, 30, 40, 50, 60, 70, 80, 90)
SPEED = 0.001
"""Metres per frame number by which object 1 moves to the right; object 2 is static."""


def make_frame(sequence: str, frame: int, seed: int = 0) -> SequenceRow:
    """A wall at 1 m; at half that distance, label 1 moves along x and label 2 is static."""
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


def write_box_pairs(folder: Path, count: int = 3, seed: int = 0, split: str = "test") -> Path:
    """Pairs of frames 20 and 80, between which object 1 moves 6 cm."""
    rows = []
    for number in range(count):
        name = f"{split}-{number:06d}"
        prev, curr = (make_frame(name, frame, seed + number) for frame in (20, 80))
        rows.append(pair_of_frames(prev, curr, key=name, scene=name).to_dict())
    return write_part(folder, "pairs", rows, split)


def write_sequences(folder: Path, count: int = 2, frames: tuple[int, ...] = FRAMES) -> Path:
    """Sequences of the same scene, of the split test."""
    names = [f"test-{number:06d}" for number in range(count)]
    rows = [make_frame(name, frame).to_dict() for name in names for frame in frames]
    return write_part(folder, "sequences", rows, "test")


def digest(folder: Path) -> str:
    """Hash of all files in a folder, of their names and contents."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    parts = [f"{path.relative_to(folder)} {hashlib.sha256(path.read_bytes()).hexdigest()}" for path in files]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()
