"""From scenes to shards: finished rows are kept; the bytes depend on neither workers, interruptions nor growth."""

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
from objectflow.synth.generation.growth import StoredShard, is_finished, remove_replaced_shards, stored_shards
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
        out: the data set's folder. Finished rows in it are kept, as are other splits of the same seed and settings.
            If a job has a larger count than the folder, the part grows: the folder stays a valid data set of the
            smaller count until the larger manifest is written, and ends with the bytes of a set made at once.
        jobs: the parts to generate.
        pool: makes the scenes; closed by the caller.
        seed, settings: of the makers in the pool; recorded, and compared with those of the shards in `out`.
        shard: (i, n), i from 1: make only every n-th shard, for batch queues.
        report: called at the start and after every scene.

    Returns:
        The manifest, or None if shards of the queue's other runs are still missing: the last run writes it.

    Raises:
        DatasetError: the folder holds shards of another seed, of other settings or of a larger count.
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
        _make_shards(out, _plans(out, mine), pool, origin, report)
        made = write_manifest(out, origin, jobs)
        if made is not None:
            remove_replaced_shards(out, jobs)
        return made
    finally:
        if is_new:
            with suppress(OSError):  # rmdir fails, as intended, on a folder with finished shards
                out.rmdir()


@dataclass(frozen=True)
class _ShardPlan:
    """A shard of this run: what is stored of it, and the scenes that are still to be made."""

    job: GenerationJob
    number: int
    stored: StoredShard | None
    kept: int
    """Number of scenes whose rows are taken from `stored`."""

    @property
    def finished(self) -> bool:
        return self.stored is not None and is_finished(self.stored, self.job)

    @property
    def missing(self) -> range:
        """The scenes to make."""
        return self.job.shards[self.number][self.kept :]

    @property
    def missing_rows(self) -> int:
        return sum(self.job.rows_of(scene) for scene in self.missing)


def _plans(out: Path, mine: Sequence[tuple[GenerationJob, int]]) -> list[_ShardPlan]:
    """The plans of shards; those with scenes to make come first.

    A part that grows within its last shard keeps its file names. Its complete shards are then rewritten last, directly
    before the manifest, so that readers of the folder meet an outdated manifest for the shortest possible time.
    """
    stored = {job.part: stored_shards(out, job) for job, _ in mine}
    plans = []
    for job, number in mine:
        shard = stored[job.part].get(number)
        plans.append(_ShardPlan(job, number, shard, 0 if shard is None else shard.whole_scenes(job)))
    return sorted(plans, key=lambda plan: not plan.missing)


def _make_shards(
    out: Path,
    plans: Sequence[_ShardPlan],
    pool: Pool[Task, SceneRows],
    origin: dict[str, Any],
    report: Callable[[GenerationProgress], None],
) -> None:
    total = sum(plan.job.rows_of(scene) for plan in plans for scene in plan.job.shards[plan.number])
    done = total - sum(plan.missing_rows for plan in plans)
    report(GenerationProgress(done, total, None))
    tasks = [Task(plan.job.kind, scene) for plan in plans for scene in plan.missing]
    scenes = pool.run(iter(tasks)) if tasks else iter(())
    for plan in plans:
        if plan.finished:
            continue
        job = plan.job
        rows: list[dict[str, Any]] = []
        rejected: dict[str, int] = {}
        counted = 0
        if plan.stored is not None:
            rows, rejected = plan.stored.read_rows(job, plan.kept), dict(plan.stored.rejected)
            counted = plan.stored.begun_scenes(job)
        for place, (scene, made) in enumerate(zip(plan.missing, islice(scenes, len(plan.missing)), strict=True)):
            rows += made.rows[: job.rows_of(scene)]
            # A scene of which some rows were stored is made again; its attempts are counted already.
            if plan.kept + place >= counted:
                for reason, count in made.rejected.items():
                    rejected[reason] = rejected.get(reason, 0) + count
            done += job.rows_of(scene)
            report(GenerationProgress(done, total, made))
        metadata = {**origin, **job.metadata, "rejected": rejected}
        write_shard(out / job.shard_name(plan.number), rows, job.kind, metadata)
