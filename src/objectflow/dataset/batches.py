"""Batches of pairs for training: shuffled by row, divided among ranks, and resumable at any step."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader

from objectflow.dataset import manifest as manifests
from objectflow.dataset.concatenated import Pairs
from objectflow.dataset.records import RecordReader, Records
from objectflow.dataset.targets import ObjectTable
from objectflow.errors import DatasetError
from objectflow.geometry.camera import Camera
from objectflow.storage import files
from objectflow.typing import Int64Array

CACHE_BYTES = 2 << 30
"""Maximum size of the cache of decoded rows."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Pairs of exact frames with the motions of their objects, from the current to the previous frame.

    Attributes:
        keys: of the rows, for messages.
        prev_color, curr_color: (B, 3, H, W) uint8, RGB.
        prev_depth, curr_depth: (B, H, W) float32, planar z in metres, 0 where missing.
        prev_labels, curr_labels: (B, H, W) int32, 0 = background.
        intrinsics: (B, 4) float32: fx, fy, cx, cy in pixels, of both frames.
        table: the objects; in rows with a camera motion, only the moving ones.
        camera_motion: (B, 4, 4) float32, metres: `prev_T_curr` of the static background; None for the identity.
    """

    keys: tuple[str, ...]
    prev_color: Tensor
    curr_color: Tensor
    prev_depth: Tensor
    curr_depth: Tensor
    prev_labels: Tensor
    curr_labels: Tensor
    intrinsics: Tensor
    table: ObjectTable
    camera_motion: Tensor | None = None

    def to(self, device: torch.device | str) -> Batch:
        """The batch on another device."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        moved: dict[str, Any] = {
            name: value.to(device, non_blocking=True) for name, value in values.items() if isinstance(value, Tensor)
        }
        return replace(self, table=self.table.to(device), **moved)

    def __len__(self) -> int:
        return len(self.keys)


class Batches:
    """The batches of one part of a data set.

    Rows come in passes, each with its own order, concatenated without a gap. The joint batch of step s starts at
    position `s * batch_size * world_size`, and each rank takes its part in order, so that a single process with the
    joint batch size sees the same rows. Rows depend on nothing else, so a run resumes from the number of its step.

    A cached row costs a fraction of reading and decoding it (`benchmarks/feeding.py` prints both).
    """

    def __init__(
        self,
        shards: Pairs,
        batch_size: int,
        *,
        size: tuple[int, int] | None,
        seed: int,
        workers: int = 0,
        rank: int = 0,
        world_size: int = 1,
        shuffle: bool = True,
        cache_bytes: int = CACHE_BYTES,
        verify: bool = True,
    ) -> None:
        """Check the part and prepare to read it.

        Args:
            shards: the part, from `open_pairs` or `open_joined`.
            batch_size: pairs per batch of this rank.
            size: (H, W) to which frames are resized with their intrinsics: colour by area, depth and labels by
                nearest neighbour. None keeps the size of the first row, which all rows must share.
            seed: of the order.
            workers: processes that read ahead; 0 reads in the calling process.
            rank, world_size: the part of the joint batch that belongs to this process.
            shuffle: whether rows are shuffled; otherwise they come as stored.
            cache_bytes: maximum size of a temporary file of decoded rows, shared by the workers.
            verify: whether to compare the hashes of shards with the manifest; each rank reads its share of the files.

        Raises:
            DatasetError: invalid settings, a shard with a wrong hash, or a part without any object.
        """
        if batch_size < 1 or workers < 0 or not 0 <= rank < world_size:
            raise DatasetError(
                f"batches need batch_size >= 1, workers >= 0 and 0 <= rank < world_size, not {batch_size}, {workers}, "
                f"{rank} and {world_size}"
            )
        if size is not None and min(size) < 1:
            raise DatasetError(f"batches need a size of at least 1x1, not {size}")
        if verify:
            _verify(shards, rank, world_size)
        if shards.count_objects() == 0:
            raise DatasetError(f"{shards.where}: no object in any row: nothing can be learnt")
        self.batch_size, self.seed, self.workers, self.shuffle = batch_size, seed, workers, shuffle
        self.rank, self.world_size = rank, world_size
        self.keys = tuple(shards.keys())
        self.size = size or _stored_size(shards)
        self._reader = RecordReader(shards, self.size, cache_bytes, exact=size is None)

    @property
    def steps_per_pass(self) -> int:
        """Steps after which every row has been used by one of the ranks."""
        joint = self.batch_size * self.world_size
        return -(-len(self.keys) // joint)

    def rows(self, step: int) -> list[int]:
        """The row numbers of this rank's batch at a step."""
        first = (step * self.world_size + self.rank) * self.batch_size
        return [self._row(position) for position in range(first, first + self.batch_size)]

    def iterate(self, start_step: int = 0) -> Generator[Batch]:
        """An endless iterator of batches from a step on. Closing it ends its worker processes.

        Raises:
            DatasetError: a row cannot be read, or a worker process was killed.
        """
        return self._load(_Steps(self, start_step))

    def one_pass(self) -> Generator[Batch]:
        """Every `world_size`-th row, starting at this rank, once and as stored; the last batch may be shorter."""
        own = list(range(self.rank, len(self.keys), self.world_size))
        return self._load([own[i : i + self.batch_size] for i in range(0, len(own), self.batch_size)])

    def _row(self, position: int) -> int:
        number, place = divmod(position, len(self.keys))
        return int(_order(self.seed, number, len(self.keys))[place]) if self.shuffle else place

    def _load(self, steps: Sequence[list[int]] | _Steps) -> Generator[Batch]:
        loader: DataLoader[tuple[list[int], Tensor | str]] = DataLoader(
            _Source(self._reader),  # type: ignore[arg-type]
            batch_size=None,
            sampler=steps,
            num_workers=self.workers,
            collate_fn=_unchanged,
            # Forked children of a process with threads may hang.
            multiprocessing_context="spawn" if self.workers else None,
            generator=torch.Generator(),  # keeps the state of the global generator
        )
        try:
            for rows, records in loader:
                if isinstance(records, str):
                    raise DatasetError(records)
                keys = tuple(self.keys[row] for row in rows)
                yield _unpack(keys, records.numpy().view(self._reader.type))
            return
        except RuntimeError as error:
            if "worker" not in str(error):
                raise
        except (OSError, EOFError):  # while it passed a batch
            if not self.workers:
                raise
        # Raised here, the error keeps no frame of the loader alive, which reports a dead process at every signal.
        raise DatasetError(f"a process that reads data ended: too little memory for {self.workers}?")


class _Steps:
    """The rows of one step after another, without end."""

    def __init__(self, batches: Batches, start: int) -> None:
        self._batches, self._start = batches, start

    def __iter__(self) -> Iterator[list[int]]:
        step = self._start
        while True:
            yield self._batches.rows(step)
            step += 1


class _Source:
    """Executed by a worker process: the rows of a step in, their records out."""

    def __init__(self, reader: RecordReader) -> None:
        self._reader = reader

    def __getitem__(self, rows: list[int]) -> tuple[list[int], Tensor | str]:
        try:
            # A single tensor reaches the other process through shared memory.
            return rows, torch.from_numpy(self._reader.read(rows).view(np.uint8))
        except DatasetError as error:
            return rows, str(error)  # the loader would turn an exception into a message of many lines


def _unchanged(value: object) -> object:
    return value


@lru_cache(maxsize=2)
def _order(seed: int, number: int, count: int) -> Int64Array:
    """The order of rows in one pass."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,))).permutation(count)


def _unpack(keys: tuple[str, ...], records: Records) -> Batch:
    """Records -> tensors: channels first, depth in metres, the object table as long as the longest of the batch."""
    scale = records["depth_scale"][:, None, None]
    most = max(1, int(records["count"].max()))
    present = np.arange(most) < records["count"][:, None]
    objects = torch.from_numpy(np.where(present[..., None], records["objects"][:, :most], np.float32(0)))
    table = ObjectTable(
        label=objects[..., 0].long(),
        center=objects[..., 2:5],
        translation=objects[..., 5:8],
        rotation=objects[..., 8:11],
        in_both=objects[..., 1] > 0,
    )
    return Batch(
        keys=keys,
        prev_color=_tensor(records["prev_color"].transpose(0, 3, 1, 2)),
        curr_color=_tensor(records["curr_color"].transpose(0, 3, 1, 2)),
        prev_depth=torch.from_numpy(records["prev_depth"] / scale),
        curr_depth=torch.from_numpy(records["curr_depth"] / scale),
        prev_labels=torch.from_numpy(records["prev_labels"].astype(np.int32)),
        curr_labels=torch.from_numpy(records["curr_labels"].astype(np.int32)),
        intrinsics=_tensor(records["intrinsics"]),
        table=table,
        camera_motion=_tensor(records["camera_motion"]),
    )


def _tensor(array: NDArray[Any]) -> Tensor:
    return torch.from_numpy(array.copy(order="C"))  # torch rejects the strides that NumPy gives dimensions of size 1


def _verify(pairs: Pairs, rank: int, world_size: int) -> None:
    for path, sha256 in pairs.files()[rank::world_size]:
        if files.hash_file(path) != sha256:
            raise DatasetError(f"{path}: its hash differs from that in {manifests.FILE}: copy the file again")


def _stored_size(shards: Pairs) -> tuple[int, int]:
    columns, where = shards.raw(0)
    camera = Camera.from_dict(columns["camera"], where=where)
    return camera.height, camera.width
