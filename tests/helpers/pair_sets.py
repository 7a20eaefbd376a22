"""Small data sets on disk for tests of their readers: the writer of one split, and pairs of random images."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from objectflow import geometry
from objectflow.dataset import manifest as manifests
from objectflow.dataset.manifest import Kind, Manifest, Part, Shard
from objectflow.dataset.schema import PairObject, PairRow
from objectflow.dataset.shards import Shards, open_pairs, write_shard
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.storage import files

CAMERA = Camera(width=32, height=24, fx=23.6, fy=24.2, cx=15.1, cy=11.9)


def write_part(
    folder: Path, kind: Kind, rows: Sequence[dict[str, Any]], split: str, *, rows_per_shard: int = 512
) -> Path:
    """Write one split of one kind as shards, and add it to the manifest."""
    folder.mkdir(parents=True, exist_ok=True)
    name = manifests.part_name(split, kind)
    chunks = [rows[i : i + rows_per_shard] for i in range(0, len(rows), rows_per_shard)] or [rows]
    shards = []
    for i, chunk in enumerate(chunks):
        path = folder / manifests.shard_name(name, i, len(chunks))
        write_shard(path, chunk, kind, {})
        shards.append(Shard(path.name, len(chunk), path.stat().st_size, files.hash_file(path)))
    parts = Manifest.read(folder).parts if (folder / manifests.FILE).exists() else {}
    part = Part(kind, split, len(rows), len(rows), 1, {}, tuple(shards))
    Manifest(seed=0, settings={}, parts={**parts, name: part}, objectflow="0").write(folder)
    return folder


def write_pairs(folder: Path, rows: Sequence[PairRow], *, rows_per_shard: int = 10) -> Shards[PairRow]:
    """Write the split train, and open it."""
    write_part(folder, "pairs", [row.to_dict() for row in rows], "train", rows_per_shard=rows_per_shard)
    return open_pairs(folder, "train")


def random_object(label: int, rng: np.random.Generator) -> PairObject:
    """A random motion; the third object is not visible in the previous frame."""
    prev_pose, curr_pose = geometry.se3_exp(rng.normal(size=(2, 6)))
    vector = geometry.so3_log((prev_pose @ geometry.inverse(curr_pose))[:3, :3])
    shift = prev_pose[:3, 3] - curr_pose[:3, 3]
    return PairObject(
        label, "box", f"box-{label}", curr_pose[:3, 3], shift, vector, vector, (), prev_pose, curr_pose, label != 3
    )


def random_pair(number: int, *, objects: int, camera: Camera = CAMERA) -> PairRow:
    """Random colours, depths with holes, labels and motions; `number` is the seed."""
    rng = np.random.default_rng(number)
    shape = (camera.height, camera.width)

    def frame() -> RgbdFrame:
        depth = rng.uniform(0.3, 1.5, shape).astype(np.float32)
        depth[rng.random(shape) < 0.1] = 0
        return RgbdFrame(color=rng.integers(0, 256, (*shape, 3), dtype=np.uint8), depth=depth, camera=camera)

    def labels() -> np.ndarray:
        return rng.integers(0, objects + 1, shape).astype(np.int32)

    entries = tuple(random_object(k + 1, rng) for k in range(objects))
    key = f"train-{number:06d}"
    return PairRow(key, key, frame(), labels(), frame(), labels(), entries)


def without_objects(row: PairRow) -> PairRow:
    """The same frames with background only."""
    none = np.zeros_like(row.curr_labels)
    return dataclasses.replace(row, prev_labels=none, curr_labels=none, objects=())
