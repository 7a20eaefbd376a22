"""The folder of a data set in the making: refuse other sets, clean up after killed runs, write the manifest."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from objectflow.dataset.manifest import Manifest, Part, Shard, current_settings, part_name
from objectflow.dataset.shards import read_metadata
from objectflow.errors import DatasetError
from objectflow.storage import files
from objectflow.synth.generation.growth import is_finished, parse_shard_name, stored_shards
from objectflow.synth.generation.jobs import GenerationJob


def check_folder(out: Path, origin: Mapping[str, Any], job: GenerationJob) -> None:
    """Check that the shards in a folder and those of a job belong to one data set.

    Args:
        out: the folder; it may be missing.
        origin: version, seed and settings of the job.
        job: the part to generate.

    Raises:
        DatasetError: they do not.
    """
    for path in sorted(out.glob("*.parquet")):
        found, _ = read_metadata(path)
        found["settings"] = current_settings(found.get("settings") or {})
        for name in ("version", "seed", "settings"):
            if found.get(name) != origin[name]:
                raise DatasetError(
                    f"{out} holds shards of {_difference(name, found.get(name), origin[name])}: "
                    "name another output folder"
                )
        if part_name(found["split"], found["kind"]) == job.part:
            _check_count(out, found, job)


def _check_count(out: Path, found: Mapping[str, Any], job: GenerationJob) -> None:
    """Refuse shards of another number of rows per scene, or of a larger count: a part grows, but does not shrink."""
    made = f"{out} holds {job.kind} of split {job.split} made as {found['count']} of {found['rows_a_scene']} a scene"
    wanted = f"not {job.count} of {job.rows_a_scene}"
    if found["rows_a_scene"] != job.rows_a_scene:
        raise DatasetError(f"{made}, {wanted}: name another output folder")
    if found["count"] > job.count:
        raise DatasetError(f"{made}, {wanted}: ask for {found['count']} or more, or name another output folder")


def _difference(name: str, found: Any, ours: Any) -> str:
    if isinstance(found, dict) and isinstance(ours, dict):
        for key in sorted({*found, *ours}):
            if found.get(key) != ours.get(key):
                return _difference(f"{name}.{key}" if name != "settings" else key, found.get(key), ours.get(key))
    return f"{name} {found!r}, not {ours!r}"


def write_manifest(out: Path, origin: Mapping[str, Any], jobs: Sequence[GenerationJob]) -> Manifest | None:
    """Write the manifest from the shards alone, so that it does not depend on how they were made.

    Returns:
        The manifest, or None if shards of the jobs are still missing.
    """
    while True:
        if not all(_is_complete(out, job) for job in jobs):
            return None
        names = _shard_files(out)
        parts = {part: _read_part(out, shards) for part, shards in _complete_parts(names).items()}
        made = Manifest(int(origin["seed"]), origin["settings"], parts, version("objectflow"))
        made.write(out)
        # A run of another split may have finished meanwhile and have written its manifest before this one.
        if _shard_files(out) == names:
            return made


def _is_complete(out: Path, job: GenerationJob) -> bool:
    stored = stored_shards(out, job)
    return all(number in stored and is_finished(stored[number], job) for number in range(len(job.shards)))


def _shard_files(out: Path) -> list[str]:
    return sorted(path.name for path in out.glob("*-of-*.parquet"))


def _complete_parts(names: Iterable[str]) -> dict[str, list[str]]:
    """The shards of each part of which none is missing; of a part that has just grown, the larger set."""
    groups: dict[tuple[str, int], list[str]] = {}
    for name in sorted(names):
        shard = parse_shard_name(name)
        if shard is not None:
            groups.setdefault((shard[0], shard[2]), []).append(name)
    # The larger totals of a part come last and replace the smaller ones.
    return {part: shards for (part, total), shards in sorted(groups.items()) if len(shards) == total}


def _read_part(out: Path, names: Iterable[str]) -> Part:
    shards: list[Shard] = []
    rejected: dict[str, int] = {}
    for name in names:
        metadata, rows = read_metadata(out / name)
        shards.append(Shard(name, rows, (out / name).stat().st_size, files.hash_file(out / name)))
        for reason, count in metadata["rejected"].items():
            rejected[reason] = rejected.get(reason, 0) + count
    rows = sum(shard.rows for shard in shards)
    rows_a_scene = int(metadata["rows_a_scene"])
    return Part(
        kind=metadata["kind"],
        split=metadata["split"],
        rows=rows,
        scenes=-(-rows // rows_a_scene),
        views=rows_a_scene if metadata["kind"] == "pairs" else 1,
        rejected=dict(sorted(rejected.items())),
        shards=tuple(shards),
    )
