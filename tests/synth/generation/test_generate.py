"""Generated data sets: the same bytes with any workers and after interruptions; errors in one line."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from helpers.fake_scenes import SETTINGS, FakeScenes
from helpers.generated_folders import PAIRS, SCRIPT, SEQUENCES, content, run
from helpers.small_disk import small_disk
from objectflow.dataset import manifest as manifests
from objectflow.dataset.manifest import Manifest
from objectflow.dataset.shards import open_pairs, open_sequences
from objectflow.errors import DatasetError, ObjectflowError, StorageError
from objectflow.runtime.pool import InProcess, Pool, Processes
from objectflow.storage.temporaries import temporary_file
from objectflow.synth.generation import jobs as generation_jobs
from objectflow.synth.generation.generate import GenerationProgress, generate
from objectflow.synth.generation.jobs import GenerationJob


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generation_jobs, "ROWS_A_SHARD", 8)


@pytest.fixture
def pool() -> Pool:
    return InProcess(FakeScenes())


def test_layout_counts_and_order(tmp_path: Path, pool: Pool) -> None:
    seen: list[GenerationProgress] = []
    made = generate(tmp_path / "a", [PAIRS, SEQUENCES], pool, seed=0, settings=SETTINGS, report=seen.append)
    assert sorted(content(tmp_path / "a")) == [
        "manifest.json",
        "train-00000-of-00003.parquet",
        "train-00001-of-00003.parquet",
        "train-00002-of-00003.parquet",
        "train-sequences-00000-of-00002.parquet",
        "train-sequences-00001-of-00002.parquet",
    ]
    assert made is not None
    assert made == Manifest.read(tmp_path / "a")
    assert [shard.rows for shard in made.parts["train"].shards] == [8, 8, 4]
    # The frames of a sequence stay in one shard: 4 sequences of 2 frames, then the fifth.
    assert [shard.rows for shard in made.parts["train-sequences"].shards] == [8, 2]
    assert made.parts["train"].scenes == 20
    assert made.parts["train"].rejected["sinks"] > 0
    assert open_pairs(tmp_path / "a").keys() == [f"train-{i:06d}-0" for i in range(20)]
    assert open_sequences(tmp_path / "a", "train").keys()[:3] == [
        "train-000000/20",
        "train-000000/30",
        "train-000001/20",
    ]
    assert [step.done for step in seen[:3]] == [0, 1, 2]
    assert (seen[-1].done, seen[-1].total) == (30, 30)


def test_views_share_a_scene_and_stay_in_one_shard(tmp_path: Path) -> None:
    job = GenerationJob("pairs", "train", 13, 3)
    made = generate(tmp_path / "a", [job], InProcess(FakeScenes(views=3)), seed=0, settings=SETTINGS)
    assert made is not None
    assert [shard.rows for shard in made.parts["train"].shards] == [6, 6, 1]
    rows = open_pairs(tmp_path / "a")
    assert [rows[i].scene for i in (0, 1, 2, 3, 12)] == [f"train-{i:06d}" for i in (0, 0, 0, 1, 4)]
    assert len(set(rows.keys())) == 13


def test_two_workers_give_the_same_bytes_as_one(tmp_path: Path, pool: Pool) -> None:
    run(tmp_path / "one", pool)
    two = Processes(FakeScenes(delay=0.002), 2)
    try:
        run(tmp_path / "two", two)
    finally:
        two.close()
    assert content(tmp_path / "one") == content(tmp_path / "two")


def test_ray_gives_the_same_bytes_as_one_process(tmp_path: Path, pool: Pool, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="Ray is not installed (pip install objectflow[ray])")
    from objectflow.runtime.ray_pool import RayActors

    monkeypatch.setenv("PYTHONPATH", str(SCRIPT.parents[1]))  # the actors must find the fake scenes
    run(tmp_path / "one", pool)
    actors = RayActors(FakeScenes(delay=0.002), "local", 2)
    try:
        run(tmp_path / "ray", actors)
    finally:
        actors.close()
    assert content(tmp_path / "one") == content(tmp_path / "ray")
    failing = RayActors(FakeScenes(fails_at=3), "local", 2)
    try:
        with pytest.raises(ObjectflowError, match=r"^the scene cannot be made$"):
            run(tmp_path / "failing", failing)
    finally:
        failing.close()


def test_a_missing_ray_cluster_is_a_one_line_error() -> None:
    pytest.importorskip("ray", reason="Ray is not installed (pip install objectflow[ray])")
    from objectflow.runtime.ray_pool import RayActors

    with pytest.raises(DatasetError, match="no Ray cluster there"):
        RayActors(FakeScenes(), "auto")


def test_runs_of_a_queue_make_the_same_bytes(tmp_path: Path, pool: Pool) -> None:
    run(tmp_path / "one", pool)
    for i in (3, 1, 2):
        made = generate(tmp_path / "queue", [PAIRS, SEQUENCES], pool, seed=0, settings=SETTINGS, shard=(i, 3))
        assert (made is not None) == (i == 2)
    assert content(tmp_path / "one") == content(tmp_path / "queue")


def test_a_run_that_is_killed_ten_times_and_continued_gives_the_same_bytes(tmp_path: Path, pool: Pool) -> None:
    run(tmp_path / "one", pool)
    out = tmp_path / "killed"
    moments = random.Random(0)
    command = [sys.executable, str(SCRIPT), str(out), "20", "2", "0.02"]
    begin = time.monotonic()
    subprocess.run([*command[:2], str(tmp_path / "whole"), *command[3:]], check=True)
    whole = time.monotonic() - begin
    kills = 0
    for _ in range(10):
        process = subprocess.Popen(command)
        try:
            process.wait(timeout=moments.uniform(0.1, 0.9) * whole)
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            kills += 1
    subprocess.run(command, check=True)
    assert kills > 0
    assert content(out) == content(tmp_path / "one")


def test_temporary_files_of_killed_runs_alone_are_removed(tmp_path: Path, pool: Pool) -> None:
    run(tmp_path / "one", pool)
    (tmp_path / "a").mkdir()
    dead, foreign = tmp_path / "a" / ".objectflow-0123456789abcdef.tmp", tmp_path / "a" / ".notes.1.tmp"
    for path in (dead, foreign):
        path.write_bytes(b"half")
    alive = temporary_file(tmp_path / "a")
    run(tmp_path / "a", pool)
    assert not dead.exists()
    assert alive.path.exists()
    assert foreign.exists()
    alive.remove()


def test_finished_shards_are_kept_and_a_removed_one_is_made_again(tmp_path: Path, pool: Pool) -> None:
    run(tmp_path / "a", pool)
    before = content(tmp_path / "a")
    stamps = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "a").glob("*.parquet")}
    (tmp_path / "a" / "train-00001-of-00003.parquet").unlink()
    run(tmp_path / "a", pool)
    assert content(tmp_path / "a") == before
    changed = [p.name for p in (tmp_path / "a").glob("*.parquet") if p.stat().st_mtime_ns != stamps[p.name]]
    assert changed == ["train-00001-of-00003.parquet"]


def test_splits_of_one_seed_share_a_folder(tmp_path: Path, pool: Pool) -> None:
    run(tmp_path / "a", pool, (PAIRS,))
    made = run(tmp_path / "a", pool, (GenerationJob("pairs", "val", 3, 1),))
    assert made is not None
    assert sorted(made.parts) == ["train", "val"]
    assert manifests.verify(tmp_path / "a", made) == 4


@pytest.mark.parametrize(
    ("seed", "settings", "count", "message"),
    [
        (1, SETTINGS, 20, "holds shards of seed 0, not 1: name another output folder"),
        (0, {**SETTINGS, "size": [32, 24]}, 20, r"holds shards of size \[16, 12\], not \[32, 24\]"),
        (0, SETTINGS, 19, "holds pairs of split train made as 20 of 1 a scene, not 19 of 1: ask for 20 or more"),
    ],
)
def test_a_folder_of_another_run_is_refused_and_left_alone(
    tmp_path: Path, seed: int, settings: dict[str, object], count: int, message: str
) -> None:
    pool = InProcess(FakeScenes())
    run(tmp_path / "a", pool)
    before = content(tmp_path / "a")
    with pytest.raises(DatasetError, match=message):
        generate(tmp_path / "a", [GenerationJob("pairs", "train", count, 1)], pool, seed=seed, settings=settings)
    assert content(tmp_path / "a") == before


def test_another_number_of_views_is_refused(tmp_path: Path, pool: Pool) -> None:
    run(tmp_path / "a", pool, (PAIRS,))
    with pytest.raises(DatasetError, match="made as 20 of 1 a scene, not 24 of 2: name another output folder"):
        run(tmp_path / "a", InProcess(FakeScenes(views=2)), (GenerationJob("pairs", "train", 24, 2),))


def test_a_set_of_the_preset_s_former_name_is_continued(tmp_path: Path, pool: Pool) -> None:
    old = {"preset": "wild", "wild": {"gap": [3, 60]}, "size": [16, 12]}
    new = {"preset": "clutter", "clutter": {"gap": [3, 60]}, "size": [16, 12]}
    generate(tmp_path / "a", [PAIRS], pool, seed=0, settings=old)
    assert Manifest.read(tmp_path / "a").settings == new
    kept = tmp_path / "a" / "train-00000-of-00003.parquet"
    before = kept.read_bytes()
    (tmp_path / "a" / "train-00001-of-00003.parquet").unlink()
    made = generate(tmp_path / "a", [PAIRS], pool, seed=0, settings=new)
    assert made is not None
    assert made.settings == new
    assert json.loads((tmp_path / "a" / "manifest.json").read_text())["settings"] == new
    assert kept.read_bytes() == before
    generate(tmp_path / "b", [PAIRS], pool, seed=0, settings=new)
    for a, b in zip(open_pairs(tmp_path / "a"), open_pairs(tmp_path / "b"), strict=True):
        assert a.key == b.key
        assert (a.curr.color == b.curr.color).all()
    with pytest.raises(DatasetError, match=r"clutter\.gap \[3, 60\], not \[3, 30\]"):
        generate(tmp_path / "a", [PAIRS], pool, seed=0, settings={**new, "clutter": {"gap": [3, 30]}})


def test_a_file_as_output_and_zero_rows_are_refused(tmp_path: Path, pool: Pool) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match="is a file, not a folder"):
        run(tmp_path / "file", pool)
    with pytest.raises(DatasetError, match="pairs must be at least 1, not 0"):
        run(tmp_path / "a", pool, (GenerationJob("pairs", "train", 0, 1),))
    assert not (tmp_path / "a").exists()


def test_a_worker_that_dies_is_a_one_line_error_and_leaves_no_folder(tmp_path: Path) -> None:
    two = Processes(FakeScenes(dies_at=2), 2)
    try:
        with pytest.raises(DatasetError, match=r"worker process ended \(exit code 9"):
            run(tmp_path / "a", two)
    finally:
        two.close()
    assert not (tmp_path / "a").exists()


def test_a_workers_error_reaches_the_caller_unchanged(tmp_path: Path) -> None:
    two = Processes(FakeScenes(fails_at=12), 2)
    try:
        with pytest.raises(ObjectflowError, match=r"^the scene cannot be made$"):
            run(tmp_path / "a", two)
    finally:
        two.close()
    assert sorted(content(tmp_path / "a")) == ["train-00000-of-00003.parquet"]


def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, str(SCRIPT), str(tmp_path / "a"), "2000", "2", "0.01"])
    deadline = time.monotonic() + 60
    while not list((tmp_path / "a").glob("*.parquet")) and time.monotonic() < deadline:
        time.sleep(0.02)
    workers = [pid for pid in _children(process.pid) if b"spawn_main" in _command(pid)]
    assert len(workers) == 2
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    deadline = time.monotonic() + 60
    while any(b"spawn_main" in _command(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not any(b"spawn_main" in _command(pid) for pid in workers)


def _children(parent: int) -> list[int]:
    return [int(pid) for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b""


def test_a_full_disk_is_a_one_line_error_and_keeps_finished_shards(
    tmp_path: Path, pool: Pool, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path / "one", pool)
    sync, calls = os.fsync, []

    def full(descriptor: int) -> None:
        calls.append(descriptor)
        if len(calls) > 2:  # after the first shard's file and folder, at the second shard's file
            raise OSError(28, "No space left on device")
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match=r"train-00001-of-00003\.parquet: No space left on device"):
        run(tmp_path / "a", pool)
    monkeypatch.setattr(os, "fsync", sync)
    assert sorted(content(tmp_path / "a")) == ["train-00000-of-00003.parquet"]
    run(tmp_path / "a", pool)
    assert content(tmp_path / "a") == content(tmp_path / "one")


def test_a_really_full_disk_keeps_finished_shards(tmp_path: Path, pool: Pool) -> None:
    run(tmp_path / "one", pool)
    with small_disk(tmp_path / "disk", "48k") as disk:
        with pytest.raises(StorageError, match="No space left on device"):
            run(disk / "a", pool)
        kept = content(disk / "a")
        assert set(kept) < set(content(tmp_path / "one"))
        assert all(data == (tmp_path / "one" / name).read_bytes() for name, data in kept.items())
        assert any(name.endswith(".parquet") for name in kept)
        subprocess.run(["mount", "-o", "remount,size=8m", str(disk)], check=True)
        run(disk / "a", pool)
        assert content(disk / "a") == content(tmp_path / "one")
