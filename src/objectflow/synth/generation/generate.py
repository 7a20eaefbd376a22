"""Scenes to shards: a fixed layout, finished shards kept, the same bytes whoever made them, killed or not."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any

from objectflow.dataset import manifest as manifests
from objectflow.dataset.manifest import Kind, Manifest, Part, Shard, part_name, shard_name
from objectflow.dataset.shards import read_metadata, write_shard
from objectflow.errors import DatasetError, StorageError
from objectflow.runtime.pool import Pool
from objectflow.storage import files
from objectflow.synth.generation.tasks import SceneRows, Task

ROWS_A_SHARD = 512
"""At most; a scene's rows are never spread over two shards."""


@dataclass(frozen=True)
class GenerationJob:
    """One part of a data set to be made: all its pairs or all its sequences.

    Attributes:
        kind: "pairs" or "sequences".
        split: "train", "val" or "test".
        count: pairs, or sequences.
        rows_a_scene: views of one scene (the last scene gives as many as are left), or frames of one sequence.
    """

    kind: Kind
    split: str
    count: int
    rows_a_scene: int

    @property
    def part(self) -> str:
        """The name of the part, which its shards' names start with."""
        return part_name(self.split, self.kind)

    @property
    def rows(self) -> int:
        """Rows of the whole part."""
        return self.count if self.kind == "pairs" else self.count * self.rows_a_scene

    @property
    def shards(self) -> list[range]:
        """The scenes of each shard: the layout depends on nothing but the job."""
        scenes = -(-self.rows // self.rows_a_scene)
        step = max(1, ROWS_A_SHARD // self.rows_a_scene)
        return [range(start, min(start + step, scenes)) for start in range(0, scenes, step)]

    def rows_of(self, scene: int) -> int:
        """How many rows a scene gives."""
        return min(self.rows_a_scene, self.rows - scene * self.rows_a_scene)


@dataclass(frozen=True)
class GenerationProgress:
    """How far a run is: rows of this run's shards, and what the last scene brought (None: shards found finished)."""

    done: int
    total: int
    scene: SceneRows | None


def generate(
    out: Path,
    jobs: Sequence[GenerationJob],
    pool: Pool,
    *,
    seed: int,
    settings: dict[str, Any],
    shard: tuple[int, int] = (1, 1),
    report: Callable[[GenerationProgress], None] = lambda progress: None,
) -> Manifest | None:
    """Make a data set, or what is missing of it.

    Args:
        out: the data set's folder. Finished shards in it are kept; so are other splits of the same seed and settings.
        jobs: the parts to make.
        pool: makes the scenes; closed by the caller.
        seed, settings: what the makers in the pool were built with; recorded, and compared with what `out` holds.
        shard: (i, n), i from 1: make only every n-th shard, for batch queues.
        report: called at the start and after every scene.

    Returns:
        The manifest, or None if shards of other runs of the queue are still missing: the last run writes it.

    Raises:
        DatasetError: the folder holds shards of another seed, of other settings, or of another count.
        StorageError: the disk refused; finished shards stay, nothing half-made does.
    """
    if out.exists() and not out.is_dir():
        raise DatasetError(f"{out} is a file, not a folder: name another output folder")
    origin = {"seed": seed, "settings": settings, "version": manifests.VERSION}
    for job in jobs:
        if job.count < 1:
            raise DatasetError(f"{job.kind} must be at least 1, not {job.count}")
        _check_folder(out, origin, job)
    ours = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make the folder {out}: {error.strerror or error}") from error
    try:
        mine = [
            (job, number) for job in jobs for number in range(len(job.shards)) if number % shard[1] == shard[0] - 1
        ]
        _remove_temporaries(out, [_name(job, number) for job, number in mine])
        _make_shards(out, mine, pool, origin, report)
        return _write_manifest(out, origin, jobs)
    finally:
        if ours:
            with suppress(OSError):  # not empty: then it stays
                out.rmdir()


def _make_shards(
    out: Path,
    mine: list[tuple[GenerationJob, int]],
    pool: Pool,
    origin: dict[str, Any],
    report: Callable[[GenerationProgress], None],
) -> None:
    total = sum(job.rows_of(scene) for job, number in mine for scene in job.shards[number])
    missing = [(job, number) for job, number in mine if not (out / _name(job, number)).exists()]
    left = sum(job.rows_of(scene) for job, number in missing for scene in job.shards[number])
    done = total - left
    report(GenerationProgress(done, total, None))
    tasks = (Task(job.kind, scene) for job, number in missing for scene in job.shards[number])
    scenes = pool.run(tasks) if missing else iter(())
    for job, number in missing:
        rows: list[dict[str, Any]] = []
        rejected: dict[str, int] = {}
        for scene, made in _take(scenes, job.shards[number]):
            rows += made.rows[: job.rows_of(scene)]
            for reason, count in made.rejected.items():
                rejected[reason] = rejected.get(reason, 0) + count
            done += job.rows_of(scene)
            report(GenerationProgress(done, total, made))
        write_shard(out / _name(job, number), rows, job.kind, {**origin, **_identity(job), "rejected": rejected})


def _take(scenes: Iterator[SceneRows], indices: range) -> Iterator[tuple[int, SceneRows]]:
    return zip(indices, islice(scenes, len(indices)), strict=True)


def _name(job: GenerationJob, number: int) -> str:
    return shard_name(job.part, number, len(job.shards))


def _identity(job: GenerationJob) -> dict[str, Any]:
    return {"kind": job.kind, "split": job.split, "count": job.count, "rows_a_scene": job.rows_a_scene}


def _check_folder(out: Path, origin: dict[str, Any], job: GenerationJob) -> None:
    """Refuse a folder whose shards would not belong together with the job's."""
    for path in sorted(out.glob("*.parquet")):
        found, _ = read_metadata(path)
        for name in ("version", "seed", "settings"):
            if found.get(name) != origin[name]:
                raise DatasetError(
                    f"{out} holds shards of {_difference(name, found.get(name), origin[name])}: "
                    "name another output folder"
                )
        if part_name(found["split"], found["kind"]) == job.part and _identity(job) != {
            name: found[name] for name in _identity(job)
        }:
            raise DatasetError(
                f"{out} holds {found['kind']} of split {found['split']} made as {found['count']} of "
                f"{found['rows_a_scene']} a scene, not {job.count} of {job.rows_a_scene}: name another output folder"
            )


def _difference(name: str, found: Any, ours: Any) -> str:
    if isinstance(found, dict) and isinstance(ours, dict):
        for key in sorted({*found, *ours}):
            if found.get(key) != ours.get(key):
                return _difference(f"{name}.{key}" if name != "settings" else key, found.get(key), ours.get(key))
    return f"{name} {found!r}, not {ours!r}"


def _remove_temporaries(out: Path, names: list[str]) -> None:
    """Remove what a killed run left beside the given files; another run that still lives keeps its own."""
    for path in out.glob(".*.tmp"):
        match = re.fullmatch(r"\.(.+)\.(\d+)\.tmp", path.name)
        if match and match[1] in {*names, manifests.FILE} and not _alive(int(match[2])):
            path.unlink(missing_ok=True)


def _alive(process: int) -> bool:
    if process == os.getpid():
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _write_manifest(out: Path, origin: dict[str, Any], jobs: Sequence[GenerationJob]) -> Manifest | None:
    """Make the manifest from the shards alone, so that it is the same however they came about."""
    while True:
        if any(not (out / _name(job, number)).exists() for job in jobs for number in range(len(job.shards))):
            return None
        names = _finished(out)
        parts = {part: _part(out, files) for part, files in _by_part(names).items()}
        made = Manifest(int(origin["seed"]), origin["settings"], parts, version("objectflow"))
        made.write(out)
        # A run of another split may have finished meanwhile, and have written its manifest before ours.
        if _finished(out) == names:
            return made


def _finished(out: Path) -> list[str]:
    return sorted(path.name for path in out.glob("*-of-*.parquet"))


def _by_part(names: list[str]) -> dict[str, list[str]]:
    """The parts all of whose shards are there."""
    parts: dict[str, list[str]] = {}
    totals: dict[str, int] = {}
    for name in names:
        match = re.fullmatch(r"(.+)-(\d{5})-of-(\d{5})\.parquet", name)
        if match:
            parts.setdefault(match[1], []).append(name)
            totals[match[1]] = int(match[3])
    return {part: files for part, files in parts.items() if len(files) == totals[part]}


def _part(out: Path, names: list[str]) -> Part:
    shards: list[Shard] = []
    rejected: dict[str, int] = {}
    for name in names:
        metadata, rows = read_metadata(out / name)
        shards.append(Shard(name, rows, (out / name).stat().st_size, files.hash_file(out / name)))
        for reason, count in metadata["rejected"].items():
            rejected[reason] = rejected.get(reason, 0) + count
    rows = sum(shard.rows for shard in shards)
    each = int(metadata["rows_a_scene"])
    return Part(
        kind=metadata["kind"],
        split=metadata["split"],
        rows=rows,
        scenes=-(-rows // each),
        views=each if metadata["kind"] == "pairs" else 1,
        rejected=dict(sorted(rejected.items())),
        shards=tuple(shards),
    )
