"""Sets that grow: the same bytes as sets made at once, and whole at every moment."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from helpers.fake_scenes import FRAMES, SETTINGS, FakeScenes
from helpers.generated_folders import PAIRS, SCRIPT, SEQUENCES, content, run
from objectflow.dataset import manifest as manifests
from objectflow.dataset.manifest import Manifest
from objectflow.dataset.shards import open_pairs
from objectflow.errors import DatasetError, ObjectflowError
from objectflow.runtime.pool import InProcess, Pool
from objectflow.synth.generation import jobs as generation_jobs
from objectflow.synth.generation.generate import GenerationProgress, generate
from objectflow.synth.generation.jobs import GenerationJob


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generation_jobs, "ROWS_A_SHARD", 8)


@pytest.fixture
def pool() -> Pool:
    return InProcess(FakeScenes())


@pytest.mark.parametrize("counts", [(3, 4, 7), (8, 9), (5, 16, 21), (17, 20, 64)])
@pytest.mark.parametrize("views", [1, 3])
def test_a_grown_set_has_the_bytes_of_one_made_at_once(tmp_path: Path, counts: tuple[int, ...], views: int) -> None:
    pool = InProcess(FakeScenes(views=views))
    earlier: list[bytes] = []
    for count in counts:
        made = run(tmp_path / "a", pool, (GenerationJob("pairs", "train", count, views),))
        assert made is not None
        assert made == Manifest.read(tmp_path / "a")
        manifests.verify(tmp_path / "a", made)
        rows = open_pairs(tmp_path / "a")
        colors = [rows.raw(index)[0]["curr_color"] for index in range(count)]
        assert colors[: len(earlier)] == earlier
        earlier = colors
    run(tmp_path / "once", pool, (GenerationJob("pairs", "train", counts[-1], views),))
    assert content(tmp_path / "a") == content(tmp_path / "once")


def test_growth_makes_only_the_scenes_that_are_missing(tmp_path: Path) -> None:
    run(tmp_path / "a", InProcess(FakeScenes()), (PAIRS,))
    seen: list[GenerationProgress] = []
    growing = InProcess(FakeScenes(fails_at=19))  # scene 19 is in the shard that is extended
    grown = GenerationJob("pairs", "train", 30, 1)
    generate(tmp_path / "a", [grown], growing, seed=0, settings=SETTINGS, report=seen.append)
    assert [progress.done for progress in seen] == list(range(20, 31))


def test_sequences_grow_beside_the_pairs_of_the_same_split(tmp_path: Path, pool: Pool) -> None:
    run(tmp_path / "a", pool)
    more = (GenerationJob("pairs", "train", 26, 1), GenerationJob("sequences", "train", 9, len(FRAMES)))
    run(tmp_path / "a", pool, more)
    run(tmp_path / "once", pool, more)
    assert content(tmp_path / "a") == content(tmp_path / "once")


def test_a_set_stays_whole_while_it_grows_and_after_a_failure(tmp_path: Path, pool: Pool) -> None:
    run(tmp_path / "a", pool, (PAIRS,))
    before = content(tmp_path / "a")
    larger = GenerationJob("pairs", "train", 60, 1)
    with pytest.raises(ObjectflowError, match="the scene cannot be made"):
        run(tmp_path / "a", InProcess(FakeScenes(fails_at=50)), (larger,))
    after = content(tmp_path / "a")
    assert set(after) - set(before) == {f"train-{number:05d}-of-00008.parquet" for number in range(2, 6)}
    assert {name: after[name] for name in before} == before
    assert len(open_pairs(tmp_path / "a")) == 20
    # Other parts of the folder are completed meanwhile without the unfinished shards.
    made = run(tmp_path / "a", pool, (GenerationJob("pairs", "val", 3, 1),))
    assert made is not None
    assert made.parts["train"].rows == 20
    with pytest.raises(DatasetError, match="made as 60 of 1 a scene, not 20 of 1: ask for 60 or more"):
        run(tmp_path / "a", pool, (PAIRS,))
    run(tmp_path / "a", pool, (larger,))
    run(tmp_path / "one", pool, (larger, GenerationJob("pairs", "val", 3, 1)))
    assert content(tmp_path / "a") == content(tmp_path / "one")


def test_runs_of_a_queue_grow_a_set(tmp_path: Path, pool: Pool) -> None:
    larger = GenerationJob("pairs", "train", 60, 1)
    run(tmp_path / "a", pool, (PAIRS,))
    for i in (3, 1, 2):
        made = generate(tmp_path / "a", [larger], pool, seed=0, settings=SETTINGS, shard=(i, 3))
        assert (made is not None) == (i == 2)
        assert len(open_pairs(tmp_path / "a")) == (60 if i == 2 else 20)
    run(tmp_path / "one", pool, (larger,))
    assert content(tmp_path / "a") == content(tmp_path / "one")


def test_growth_that_is_killed_and_continued_gives_the_same_bytes(tmp_path: Path) -> None:
    """Killed while the set is being written; the moments differ."""
    out, moments, kills = tmp_path / "killed", random.Random(1), 0
    for count in (11, 30, 45):
        command = [sys.executable, str(SCRIPT), str(out), str(count), "1", "0.04"]
        before = set(out.glob("*.parquet"))
        process = subprocess.Popen(command)
        while process.poll() is None and set(out.glob("*.parquet")) == before:
            time.sleep(0.005)
        time.sleep(moments.uniform(0, 0.3))
        kills += process.poll() is None
        process.kill()
        process.wait()
        subprocess.run(command, check=True)
    assert kills > 0
    more = (GenerationJob("pairs", "train", 45, 1), SEQUENCES)
    run(tmp_path / "one", InProcess(FakeScenes()), more)
    assert content(out) == content(tmp_path / "one")
