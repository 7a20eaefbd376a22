"""Growth of a part of a data set: reuse of the rows in shards of a smaller count, and removal of these shards."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from objectflow.dataset.shards import read_metadata, read_rows
from objectflow.synth.generation.jobs import GenerationJob


@dataclass(frozen=True)
class StoredShard:
    """A shard of a part with the count that it was made for.

    Attributes:
        path: of the shard.
        number: of the shard within the part.
        total: number of shards of the part, as in the file's name.
        count: number of pairs or sequences of the part, as in the shard's metadata.
        rows: number of rows in the shard.
        rejected: number of rejected attempts at the shard's scenes, by reason.
    """

    path: Path
    number: int
    total: int
    count: int
    rows: int
    rejected: dict[str, int]

    def whole_scenes(self, job: GenerationJob) -> int:
        """Number of the shard's scenes of which all rows that a job needs are stored."""
        left, scenes = self.rows, job.shards[self.number]
        for place, scene in enumerate(scenes):
            left -= job.rows_of(scene)
            if left < 0:
                return place
        return len(scenes)

    def begun_scenes(self, job: GenerationJob) -> int:
        """Number of scenes whose attempts are counted in `rejected`: the whole ones and a partial last one."""
        return -(-self.rows // job.rows_a_scene)

    def read_rows(self, job: GenerationJob, scenes: int) -> list[dict[str, Any]]:
        """The rows of the shard's first `scenes` scenes."""
        return read_rows(self.path)[: sum(job.rows_of(scene) for scene in job.shards[self.number][:scenes])]


def parse_shard_name(name: str) -> tuple[str, int, int] | None:
    """Part, number and total of a shard's file name, or None for another name."""
    match = re.fullmatch(r"(.+)-(\d{5})-of-(\d{5})\.parquet", name)
    return (match[1], int(match[2]), int(match[3])) if match else None


def stored_shards(out: Path, job: GenerationJob) -> dict[int, StoredShard]:
    """The shard with the most rows of each number of a job's part, whatever count it was made for."""
    found: dict[int, StoredShard] = {}
    for shard in _shards_of(out, job):
        best = found.get(shard.number)
        if shard.number < len(job.shards) and (best is None or _rank(shard, job) > _rank(best, job)):
            found[shard.number] = shard
    return found


def is_finished(shard: StoredShard, job: GenerationJob) -> bool:
    """Whether a stored shard is the job's own: of the job's count and under the job's name."""
    return shard.count == job.count and shard.path.name == job.shard_name(shard.number)


def remove_replaced_shards(out: Path, jobs: Sequence[GenerationJob]) -> None:
    """Remove the shards of smaller counts of complete parts; call it once the manifest lists the new ones."""
    for job in jobs:
        for shard in list(_shards_of(out, job)):
            if shard.total != len(job.shards):
                shard.path.unlink(missing_ok=True)


def _shards_of(out: Path, job: GenerationJob) -> Iterator[StoredShard]:
    for path in sorted(out.glob("*-of-*.parquet")):
        name = parse_shard_name(path.name)
        if name is not None and name[0] == job.part:
            metadata, rows = read_metadata(path)
            yield StoredShard(path, name[1], name[2], int(metadata["count"]), rows, dict(metadata["rejected"]))


def _rank(shard: StoredShard, job: GenerationJob) -> tuple[bool, int]:
    return is_finished(shard, job), shard.rows
