"""Batches hold the expected rows for every number of workers and ranks, and after every resume."""

from __future__ import annotations

import multiprocessing
import threading
from collections import deque
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.object_tables import object_table
from helpers.pair_sets import CAMERA, random_pair, without_objects, write_pairs
from objectflow.dataset.batches import Batch, Batches
from objectflow.dataset.schema import PairRow
from objectflow.dataset.shards import Shards, open_pairs
from objectflow.dataset.targets import ObjectTable
from objectflow.errors import DatasetError
from objectflow.geometry.camera import Camera

OBJECTS = (2, 0, 3, 1, 5)
"""Number of objects, in a cycle of five rows; label 3 is not visible in both frames."""


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Shards[PairRow]:
    rows = [random_pair(i, objects=OBJECTS[i % 5]) for i in range(23)]
    rows[1] = without_objects(rows[1])
    return write_pairs(tmp_path_factory.mktemp("set"), rows)


def same(one: Batch, other: Batch) -> bool:
    tensors = [name for name in Batch.__dataclass_fields__ if name not in ("keys", "table")]
    table = list(ObjectTable.__dataclass_fields__)
    return (
        one.keys == other.keys
        and all(torch.equal(getattr(one, name), getattr(other, name)) for name in tensors)
        and all(torch.equal(getattr(one.table, name), getattr(other.table, name)) for name in table)
    )


def test_a_batch_holds_the_rows_of_its_keys(shards: Shards[PairRow]) -> None:
    batches = Batches(shards, 4, size=None, seed=1)
    for batch in islice(batches.iterate(), 8):  # beyond the first pass: decoded and cached rows
        rows = [shards[shards.find(key)] for key in batch.keys]
        table = object_table([row.objects for row in rows])
        assert batch.table.label.shape == table.label.shape
        for name in ObjectTable.__dataclass_fields__:
            assert torch.equal(getattr(batch.table, name), getattr(table, name))
        for b, row in enumerate(rows):
            for when, frame, labels in (("prev", row.prev, row.prev_labels), ("curr", row.curr, row.curr_labels)):
                np.testing.assert_array_equal(getattr(batch, f"{when}_color")[b].permute(1, 2, 0), frame.color)
                np.testing.assert_array_equal(getattr(batch, f"{when}_depth")[b], frame.depth)
                np.testing.assert_array_equal(getattr(batch, f"{when}_labels")[b], labels)
            np.testing.assert_allclose(batch.intrinsics[b], [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy], rtol=1e-6)
        assert batch.prev_depth.dtype == torch.float32
        assert batch.prev_labels.dtype == torch.int32
        assert batch.prev_color.dtype == torch.uint8


def test_every_pass_has_every_row_once_in_an_order_of_its_own(shards: Shards[PairRow]) -> None:
    batches = Batches(shards, 23, size=None, seed=5)
    first, second = batches.rows(0), batches.rows(1)
    assert sorted(first) == sorted(second) == list(range(23))
    assert first != second
    assert Batches(shards, 23, size=None, seed=6).rows(0) != first
    assert Batches(shards, 23, size=None, seed=5, shuffle=False).rows(1) == list(range(23))
    assert Batches(shards, 4, size=None, seed=5, world_size=2).steps_per_pass == 3


def test_resume_equals_the_undisturbed_run(shards: Shards[PairRow]) -> None:
    undisturbed = list(islice(Batches(shards, 5, size=(12, 16), seed=2).iterate(), 9))
    resumed = islice(Batches(shards, 5, size=(12, 16), seed=2).iterate(start_step=4), 5)
    assert all(same(one, other) for one, other in zip(undisturbed[4:], resumed, strict=True))


def test_worker_processes_change_nothing(shards: Shards[PairRow]) -> None:
    """Without a cache, and with a cache of a few rows that the processes share."""
    alone = Batches(shards, 5, size=(12, 16), seed=2, cache_bytes=0)
    shared = Batches(shards, 5, size=(12, 16), seed=2, workers=2, cache_bytes=150_000)
    before = torch.get_rng_state()
    batches = shared.iterate()
    for one, other in zip(islice(alone.iterate(), 10), batches, strict=False):
        assert same(one, other)
    assert torch.equal(torch.get_rng_state(), before)
    assert len(multiprocessing.active_children()) == 2
    batches.close()
    assert not multiprocessing.active_children()


def test_a_killed_worker_is_reported_and_none_is_left(shards: Shards[PairRow]) -> None:
    batches = Batches(shards, 5, size=(12, 16), seed=2, workers=1).iterate()
    next(batches)
    (worker,) = multiprocessing.active_children()
    # torch raises from a signal handler, wherever the main thread is: it must be in the iteration, which is endless.
    killer = threading.Timer(0.05, worker.kill)
    killer.start()
    with pytest.raises(DatasetError, match="a process that reads data ended"):
        deque(batches, maxlen=0)
    killer.join()
    assert not multiprocessing.active_children()


def test_ranks_divide_the_joint_batch(shards: Shards[PairRow]) -> None:
    joint = Batches(shards, 6, size=None, seed=3)
    ranks = [Batches(shards, 2, size=None, seed=3, rank=r, world_size=3) for r in range(3)]
    for step in range(9):
        parts = [ranks[r].rows(step) for r in range(3)]
        assert parts[0] + parts[1] + parts[2] == joint.rows(step)


def test_one_pass_reads_every_row_once_over_all_ranks(shards: Shards[PairRow]) -> None:
    keys = [
        key
        for rank in range(2)
        for batch in Batches(shards, 4, size=None, seed=0, rank=rank, world_size=2).one_pass()
        for key in batch.keys
    ]
    assert sorted(keys) == shards.keys()


def test_resized_frames_are_those_of_the_frame_itself(shards: Shards[PairRow]) -> None:
    row = shards[4]
    batch = next(iter(Batches(shards, 5, size=(12, 16), seed=0, shuffle=False).iterate()))
    small = row.curr.resized(16, 12)
    np.testing.assert_array_equal(batch.curr_color[4].permute(1, 2, 0), small.color)
    np.testing.assert_array_equal(batch.curr_depth[4], small.depth)
    camera = small.camera
    np.testing.assert_allclose(batch.intrinsics[4], [camera.fx, camera.fy, camera.cx, camera.cy], rtol=1e-6)
    assert set(np.unique(batch.curr_depth[4])) <= set(np.unique(row.curr.depth))


def test_a_point_keeps_its_place_when_resized(tmp_path: Path) -> None:
    """The points of a slanted plane lie on the same plane at a smaller size, up to half a stored pixel."""
    camera = Camera(width=96, height=72, fx=80.0, fy=80.0, cx=47.5, cy=35.5)
    u, v = np.meshgrid(np.arange(96), np.arange(72))
    # z = 0.8 + 0.3 x + 0.2 y in the camera frame.
    depth = (0.8 / (1 - 0.3 * (u - camera.cx) / camera.fx - 0.2 * (v - camera.cy) / camera.fy)).astype(np.float32)
    row = random_pair(0, objects=1, camera=camera)
    frame = row.curr.__class__(color=row.curr.color, depth=depth, camera=camera)
    pair = PairRow("a", "a", frame, row.prev_labels, frame, row.curr_labels, row.objects)
    shards = write_pairs(tmp_path / "plane", [pair])
    for height, width in ((24, 32), (18, 48)):  # odd factors sample pixel centres exactly
        batch = next(iter(Batches(shards, 1, size=(height, width), seed=0).iterate()))
        fx, fy, cx, cy = batch.intrinsics[0].double().tolist()
        y, x = np.mgrid[:height, :width]
        z = batch.curr_depth[0].double().numpy()
        off = z - 0.8 - 0.3 * (x - cx) / fx * z - 0.2 * (y - cy) / fy * z
        exact = (height, width) == (24, 32)
        # Half a stored pixel is 1 / 160 of the depth; the slope of the plane reduces it to a third.
        assert np.abs(off).max() < (2e-4 if exact else 0.8 * 0.5 / 80 * 1.5 * (0.3 + 0.2))


def test_bad_data_is_named(shards: Shards[PairRow], tmp_path: Path) -> None:
    rows = [random_pair(i, objects=1) for i in range(12)]
    write_pairs(tmp_path / "set", rows)
    path = tmp_path / "set" / "train-00001-of-00002.parquet"
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    path.write_bytes(bytes(damaged))
    part = open_pairs(tmp_path / "set")
    with pytest.raises(DatasetError, match=r"train-00001-of-00002.parquet: its hash"):
        Batches(part, 2, size=None, seed=0)
    Batches(part, 2, size=None, seed=0, rank=0, world_size=2)  # the other rank checks the other shard
    with pytest.raises(DatasetError, match=r"no manifest.json"):
        open_pairs(tmp_path)
    empty = write_pairs(tmp_path / "empty", [without_objects(row) for row in rows])
    with pytest.raises(DatasetError, match="split 'train': no object in any row"):
        Batches(empty, 2, size=None, seed=0)
    other = random_pair(1, objects=1, camera=CAMERA.scaled(64, 48))
    mixed = write_pairs(tmp_path / "mixed", [rows[0], other])
    with pytest.raises(DatasetError, match=r"row 1: .*64x48, not 32x24"):
        next(iter(Batches(mixed, 2, size=None, seed=0).iterate()))
    assert next(iter(Batches(mixed, 2, size=(24, 32), seed=0).iterate())).prev_depth.shape == (2, 24, 32)
    for arguments in (
        {"batch_size": 0},
        {"batch_size": 1, "rank": 2, "world_size": 2},
        {"batch_size": 1, "workers": -1},
    ):
        with pytest.raises(DatasetError, match="batches need"):
            Batches(shards, size=None, seed=0, **arguments)  # type: ignore[arg-type]


def test_a_broken_row_is_named_by_a_worker_too(tmp_path: Path) -> None:
    shards = write_pairs(tmp_path / "set", [random_pair(i, objects=1) for i in range(3)])
    path = tmp_path / "set" / "train-00000-of-00001.parquet"
    path.write_bytes(path.read_bytes().replace(b"IEND", b"XEND"))
    for workers in (0, 1):
        batches = Batches(shards, 2, size=None, seed=0, workers=workers, shuffle=False, verify=False)
        with pytest.raises(DatasetError, match=r"row 0: .*the PNG is (damaged|cut off)"):
            next(iter(batches.iterate()))
