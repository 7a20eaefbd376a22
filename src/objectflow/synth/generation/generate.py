"""From scenes to shards: finished shards are kept, and the bytes depend on neither workers nor interruptions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from objectflow.dataset import manifest as manifests
from objectflow.dataset.manifest import Manifest
from objectflow.dataset.shards import write_shard
from objectflow.errors import DatasetError, StorageError
from objectflow.runtime.pool import Pool
from objectflow.storage.temporaries import sweep
from objectflow.synth.generation.jobs import GenerationJob
from objectflow.synth.generation.set_folder import check_folder, write_manifest
from objectflow.synth.generation.tasks import SceneRows, Task


@dataclass(frozen=True)
class GenerationProgress:
    """Progress of a run.

    Attributes:
        done, total: rows of this run's shards.
        scene: the last scene; None at the start, where only finished shards are counted.
    """

    done: int
    total: int
    scene: SceneRows | None


def generate(
    out: Path,
    jobs: Sequence[GenerationJob],
    pool: Pool[Task, SceneRows],
    *,
    seed: int,
    settings: dict[str, Any],
    shard: tuple[int, int] = (1, 1),
    report: Callable[[GenerationProgress], None] = lambda progress: None,
) -> Manifest | None:
    """Generate a data set, or the missing part of one.

    Args:
        out: the data set's folder. Finished shards in it are kept, as are other splits of the same seed and settings.
        jobs: the parts to generate.
        pool: makes the scenes; closed by the caller.
        seed, settings: of the makers in the pool; recorded, and compared with those of the shards in `out`.
        shard: (i, n), i from 1: make only every n-th shard, for batch queues.
        report: called at the start and after every scene.

    Returns:
        The manifest, or None if shards of the queue's other runs are still missing: the last run writes it.

    Raises:
        DatasetError: the folder holds shards of another seed, of other settings or of another count.
        StorageError: the disk is full or not writable; finished shards stay, and no partial file does.
    """
    if out.exists() and not out.is_dir():
        raise DatasetError(f"{out} is a file, not a folder: name another output folder")
    origin = {"seed": seed, "settings": settings, "version": manifests.VERSION}
    for job in jobs:
        if job.count < 1:
            raise DatasetError(f"{job.kind} must be at least 1, not {job.count}")
        check_folder(out, origin, job)
    is_new = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make the folder {out}: {error.strerror or error}") from error
    try:
        mine = [
            (job, number) for job in jobs for number in range(len(job.shards)) if number % shard[1] == shard[0] - 1
        ]
        sweep(out)
        _make_shards(out, mine, pool, origin, report)
        return write_manifest(out, origin, jobs)
    finally:
        if is_new:
            with suppress(OSError):  # rmdir fails, as intended, on a folder with finished shards
                out.rmdir()


def _make_shards(
    out: Path,
    mine: list[tuple[GenerationJob, int]],
    pool: Pool[Task, SceneRows],
    origin: dict[str, Any],
    report: Callable[[GenerationProgress], None],
) -> None:
    total = sum(job.rows_of(scene) for job, number in mine for scene in job.shards[number])
    missing = [(job, number) for job, number in mine if not (out / job.shard_name(number)).exists()]
    left = sum(job.rows_of(scene) for job, number in missing for scene in job.shards[number])
    done = total - left
    report(GenerationProgress(done, total, None))
    tasks = (Task(job.kind, scene) for job, number in missing for scene in job.shards[number])
    scenes = pool.run(tasks) if missing else iter(())
    for job, number in missing:
        rows: list[dict[str, Any]] = []
        rejected: dict[str, int] = {}
        numbers = job.shards[number]
        for scene, made in zip(numbers, islice(scenes, len(numbers)), strict=True):
            rows += made.rows[: job.rows_of(scene)]
            for reason, count in made.rejected.items():
                rejected[reason] = rejected.get(reason, 0) + count
            done += job.rows_of(scene)
            report(GenerationProgress(done, total, made))
        write_shard(out / job.shard_name(number), rows, job.kind, {**origin, **job.metadata, "rejected": rejected})
