"""Small data sets on disk for tests of what reads them: random images, or one written by hand."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from objectflow import geometry
from objectflow.dataset import manifest as manifests
from objectflow.dataset.manifest import Manifest, Part, Shard
from objectflow.dataset.schema import PairObject, PairRow
from objectflow.dataset.shards import Shards, open_pairs, write_shard
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.storage import files

CAMERA = Camera(width=32, height=24, fx=23.6, fy=24.2, cx=15.1, cy=11.9)


def random_object(label: int, rng: np.random.Generator) -> PairObject:
    prev_pose, curr_pose = geometry.se3_exp(rng.normal(size=(2, 6)))
    vector = geometry.so3_log((prev_pose @ geometry.inverse(curr_pose))[:3, :3])
    shift = prev_pose[:3, 3] - curr_pose[:3, 3]
    return PairObject(
        label, "box", f"box-{label}", curr_pose[:3, 3], shift, vector, vector, (), prev_pose, curr_pose, label != 3
    )


def random_pair(number: int, *, objects: int, camera: Camera = CAMERA) -> PairRow:
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


def write_pairs(folder: Path, rows: Sequence[PairRow], *, rows_a_shard: int = 10) -> Shards[PairRow]:
    folder.mkdir(exist_ok=True)
    chunks = [rows[i : i + rows_a_shard] for i in range(0, len(rows), rows_a_shard)]
    shards = []
    for i, chunk in enumerate(chunks):
        path = folder / manifests.shard_name("train", i, len(chunks))
        write_shard(path, [row.to_dict() for row in chunk], "pairs", {})
        shards.append(Shard(path.name, len(chunk), path.stat().st_size, files.hash_file(path)))
    part = Part("pairs", "train", len(rows), len(rows), 1, {}, tuple(shards))
    Manifest(seed=0, settings={}, parts={"train": part}, objectflow="0").write(folder)
    return open_pairs(folder, "train")


def without_objects(row: PairRow) -> PairRow:
    none = np.zeros_like(row.curr_labels)
    return dataclasses.replace(row, prev_labels=none, curr_labels=none, objects=())
