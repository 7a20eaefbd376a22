"""The training loop: its files, its learning, its error messages, and agreement between processes."""

from __future__ import annotations

import dataclasses
import json
import os
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.paths import HELPERS_ON_PATH
from helpers.training_runs import PLAIN, RECIPE, RIGID, job, write_set
from objectflow.dataset.batches import Batches
from objectflow.dataset.manifest import Manifest
from objectflow.dataset.shards import open_pairs
from objectflow.errors import DatasetError, TrainingError
from objectflow.networks.rigidmatch import RigidMatch
from objectflow.networks.weights import load_weights
from objectflow.training.adapters import NetworkAdapter
from objectflow.training.callbacks import Callback
from objectflow.training.ema import ExponentialMovingAverage
from objectflow.training.job import TrainJob, open_data
from objectflow.training.loop import train
from objectflow.training.model_config import SceneFlowNetModel
from objectflow.training.parallel import Process
from objectflow.training.prefetch import on_device
from objectflow.training.recipe import Recipe
from objectflow.training.setup import build_adapter, compiled
from objectflow.training.step import prepare

ALONE = Process(0, 1, torch.device("cpu"))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("set"))


def lines_of(run: Path, kind: str) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [line for line in lines if line["kind"] == kind]


def test_a_run_learns_and_records_what_it_did(data: Path, tmp_path: Path) -> None:
    recipe = dataclasses.replace(PLAIN, steps=40, validate_every=20, learning_rate=5e-3, ema_decay=0.5)
    outcome = train(job(data, tmp_path / "run", recipe))
    losses = [line["losses"]["total"] for line in lines_of(tmp_path / "run", "train")]
    assert len(losses) == 8
    assert losses[-1] < 0.95 * losses[0]
    validations = lines_of(tmp_path / "run", "validation")
    assert [line["step"] for line in validations] == [20, 40]
    scores = [line["epe_cm"] / line["zero_epe_cm"] - line["mean_f"] for line in validations]
    assert outcome.state.best == pytest.approx(min(scores), rel=1e-9)
    network, metadata = load_weights(tmp_path / "run" / "weights.safetensors")
    assert network.settings == recipe.model.network
    assert (metadata["variant"], metadata["size"]) == ("sceneflownet-c-vl", [24, 32])
    assert metadata["grouping"] == dataclasses.asdict(paper_model(recipe.model).grouping)
    best = validations[int(np.argmin(scores))]
    assert (metadata["step"], metadata["metrics"]["epe_cm"]) == (best["step"], best["epe_cm"])
    assert metadata["data"] == Manifest.read(data).sha256
    assert metadata["recipe"]["learning_rate"] == 5e-3
    assert (tmp_path / "run" / "loss_curve.png").stat().st_size > 1000


def paper_model(model: object) -> SceneFlowNetModel:
    assert isinstance(model, SceneFlowNetModel)
    return model


@pytest.mark.parametrize(("recipe", "correlation"), [(RECIPE, True), (RIGID, False)])
def test_an_adapter_gives_losses_and_a_result_per_pair(data: Path, recipe: Recipe, correlation: bool) -> None:
    adapter: NetworkAdapter = build_adapter(recipe, ALONE, backbone=None, start=None)
    assert isinstance(adapter.network, RigidMatch) is not correlation
    batch = next(Batches(open_pairs(data), 2, size=recipe.size, seed=0).iterate())
    prepared = prepare(batch, recipe, None)
    output = adapter.module(*prepared.images)
    losses = adapter.losses(output, prepared)
    assert losses["total"].requires_grad
    assert not any(value.requires_grad for name, value in losses.items() if name != "total")
    for index in range(2):
        motion = adapter.to_motion(output, prepared, index)
        assert motion.labels.shape == recipe.size
        depth = torch.isfinite(prepared.points[index]).all(dim=0).numpy()
        np.testing.assert_array_equal(np.isfinite(motion.scene_flow).all(axis=-1), depth)


def test_without_a_split_to_validate_on_the_last_weights_are_kept(data: Path, tmp_path: Path) -> None:
    notes: list[str] = []

    class Notes(Callback):
        def note(self, text: str) -> None:
            notes.append(text)

    train(job(data, tmp_path / "run", dataclasses.replace(PLAIN, steps=3, validation_pairs=0)), Notes())
    assert notes == ["no validation: the last weights are kept, not the best"]
    last = load_weights(tmp_path / "run" / "checkpoints" / "step-00000003" / "weights.safetensors")[0].state_dict()
    kept = load_weights(tmp_path / "run" / "weights.safetensors")[0].state_dict()
    assert all(torch.equal(last[name], kept[name]) for name in last)


def test_extra_data_is_mixed_in_and_recorded(data: Path, tmp_path: Path) -> None:
    more = write_set(tmp_path / "more", pairs=6)
    recipe = dataclasses.replace(RECIPE, steps=4, validation_pairs=0)
    both = job(data, tmp_path / "both", recipe, extra_data=(more,))
    assert train(both).state.step == 4
    found = json.loads((both.out / "settings.json").read_text())["data"]
    alone = json.loads((_trained(job(more, tmp_path / "alone", recipe)) / "settings.json").read_text())["data"]
    assert found["extra_data"] == [alone["train"]]
    with pytest.raises(TrainingError, match="data"):
        train(dataclasses.replace(both, extra_data=(), resume=True))


def _trained(one: TrainJob) -> Path:
    train(one)
    return one.out


def test_minutes_end_a_run(data: Path, tmp_path: Path) -> None:
    rates: list[float] = []

    class Rates(Callback):
        def line(self, step: int, progress: float, line: Mapping[str, Any]) -> None:
            rates.append(line["learning_rate"])

    recipe = dataclasses.replace(PLAIN, steps=None, minutes=1e-3, log_every=1, validation_pairs=0, warm_up=0.0)
    outcome = train(job(data, tmp_path / "run", recipe), Rates())
    assert outcome.finished
    assert outcome.state.seconds >= 0.06
    # The schedule spans the time, so the learning rate falls.
    assert rates == sorted(rates, reverse=True)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_a_loss_that_is_not_finite_names_the_pairs(data: Path, tmp_path: Path, precision: Any) -> None:
    recipe = dataclasses.replace(
        PLAIN, learning_rate=1e30, schedule="constant", warm_up=0.0, clip=None, precision=precision, log_every=4
    )
    with pytest.raises(TrainingError) as caught:
        train(job(data, tmp_path / "run", recipe))
    # The first update ruins the weights, and the second loss reveals it, although four steps are read at once.
    keys = ", ".join(Batches(open_pairs(data), 4, size=None, seed=0).keys[row] for row in rows_of(data, 1))
    assert str(caught.value).startswith("step 2: ")
    assert f"the pairs were {keys}: " in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run" / "weights.safetensors").exists()
    assert not (tmp_path / "run").exists()  # nothing in it was worth keeping


def rows_of(data: Path, step: int) -> list[int]:
    return Batches(open_pairs(data), 4, size=None, seed=0).rows(step)


def test_bfloat16_trains_like_float32(data: Path, tmp_path: Path) -> None:
    totals = []
    for precision in ("fp32", "bf16"):
        recipe = dataclasses.replace(PLAIN, steps=4, precision=precision, log_every=4, validation_pairs=0)
        train(job(data, tmp_path / precision, recipe))
        totals.append(lines_of(tmp_path / precision, "train")[0]["losses"]["total"])
    assert totals[0] != totals[1]
    assert totals[1] == pytest.approx(totals[0], rel=0.03)


def test_two_processes_train_as_one(data: Path, tmp_path: Path) -> None:
    together = dataclasses.replace(PLAIN, steps=4, validate_every=2, log_every=1)
    train(job(data, tmp_path / "one", together))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    script = [sys.executable, "-m", "helpers.training_runs", "together", str(data), str(tmp_path / "two")]
    place = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "OMP_NUM_THREADS": "1"}
    processes = [
        subprocess.Popen(script, env={**os.environ, **HELPERS_ON_PATH, **place, "RANK": str(rank)})
        for rank in range(2)
    ]
    assert [process.wait(timeout=120) for process in processes] == [0, 0]
    one, two = lines_of(tmp_path / "one", "train"), lines_of(tmp_path / "two", "train")
    for left, right in zip(one, two, strict=True):
        # The first gradient must be that of the joint batch; later ones agree only if the steps were the same.
        assert right["gradient"] == pytest.approx(left["gradient"], rel=1e-4)
        assert right["losses"] == pytest.approx(left["losses"], rel=1e-4)
    validations = (lines_of(tmp_path / name, "validation") for name in ("one", "two"))
    for left, right in zip(*validations, strict=True):
        assert right["pairs"] == left["pairs"] == 4
        assert right["losses"] == pytest.approx(left["losses"], rel=1e-4)
        assert right["epe_cm"] == pytest.approx(left["epe_cm"], rel=1e-3)


def test_compilation_that_fails_leaves_the_network_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(network: torch.nn.Module) -> torch.nn.Module:
        network(*images)  # changes the running statistics
        raise RuntimeError("no compiler here\nsecond line")

    recipe, notes = dataclasses.replace(RECIPE, compile=True), list[str]()
    module = build_adapter(recipe, ALONE, backbone=None, start=None).module
    images = tuple(torch.rand(2, 3, 24, 32) for _ in range(4))
    before = {name: value.clone() for name, value in module.state_dict().items()}
    monkeypatch.setattr(torch, "compile", refuse)
    assert compiled(module, recipe, images, torch.device("cpu"), notes.append) is module
    assert notes == ["torch.compile failed, running uncompiled: RuntimeError: no compiler here"]
    assert all(torch.equal(before[name], value) for name, value in module.state_dict().items())
    assert all(parameter.grad is None for parameter in module.parameters())


def test_the_moving_average_follows_the_weights() -> None:
    adapter = build_adapter(RECIPE, ALONE, backbone=None, start=None)
    average = ExponentialMovingAverage(adapter, 0.6)
    assert average.adapter.module is not adapter.module
    parameter = next(adapter.network.parameters())
    values, expected = np.random.default_rng(0).normal(size=12), float(parameter.detach().flatten()[0])
    for n, value in enumerate(values, start=1):
        with torch.no_grad():
            parameter.fill_(float(value))
        average.update()
        decay = min(0.6, n / (n + 9))
        expected = decay * expected + (1 - decay) * float(value)
    averaged = next(average.network.parameters())
    assert float(averaged.flatten()[0]) == pytest.approx(expected, rel=1e-5)
    # The adapter of the average computes with the averaged weights.
    assert any(averaged is one for one in average.adapter.module.parameters())


def test_closing_the_feed_closes_the_batches(data: Path) -> None:
    batches = Batches(open_pairs(data), 2, size=None, seed=0)
    feed = on_device(batches.iterate(), torch.device("cpu"))
    assert next(feed).keys == tuple(batches.keys[row] for row in batches.rows(0))


def test_a_batch_that_processes_cannot_share(data: Path, tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="a batch of 4 pairs cannot be shared by 3 processes"):
        open_data(job(data, tmp_path), Process(0, 3, torch.device("cpu")), Manifest.read(data))


def test_a_row_that_breaks_during_a_run(tmp_path: Path) -> None:
    folder = write_set(tmp_path / "set")
    shard = next(folder.glob("*.parquet"))
    whole = shard.read_bytes()

    class Break(Callback):
        def line(self, step: int, progress: float, line: Mapping[str, Any]) -> None:
            # The same size with other bytes, as from a disk that fails during a run.
            with open(shard, "r+b") as file:
                file.write(bytes(len(whole) - 4096))

    recipe = dataclasses.replace(PLAIN, log_every=1, steps=6)
    with pytest.raises(DatasetError, match=r"000000|row"):
        train(job(folder, tmp_path / "run", recipe), Break())
