"""Everything that takes a device computes on it: no tensor stays on the CPU, and results agree.

The second device is simulated, since not every machine has a GPU; see `helpers.fake_device`.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import objectflow
from helpers.fake_device import FAKE_DEVICE, FakeTensor, fake_device
from helpers.small_networks import TINY_RIGID, save_all
from helpers.training_runs import RECIPE, job, write_set
from objectflow.dataset.batches import Batch
from objectflow.evaluation.data.sources import open_set
from objectflow.training import loop
from objectflow.training.loop import train
from objectflow.training.model_config import RigidMatchModel
from objectflow.training.recipe import Recipe

DEVICE = FAKE_DEVICE.type


def test_the_second_device_rejects_tensors_of_the_first() -> None:
    near = torch.arange(6.0).reshape(2, 3)
    with fake_device() as device:
        far = near.to(device)
        assert isinstance(far, FakeTensor)
        assert far.device == device
        assert isinstance(torch.zeros(3, device=device), FakeTensor)
        assert torch.equal((2 * far @ far.T).cpu(), 2 * near @ near.T)
        assert torch.equal(far[:, torch.tensor([1])].cpu(), near[:, 1:2])
        assert torch.equal(far[:, [2, 0]].cpu(), near[:, [2, 0]])
        for wrong in (
            lambda: far + near,
            lambda: far @ near.T,
            lambda: near[torch.tensor([1], device=device)],
            lambda: torch.where(near > 1, far, 0.0),
        ):
            with pytest.raises(RuntimeError, match="tensors of two devices"):
                wrong()
        for place, generator in ((device, torch.Generator()), (None, torch.Generator(device))):
            with pytest.raises(RuntimeError, match="the generator is another device's"):
                torch.rand(3, generator=generator, device=place)
        with pytest.raises(RuntimeError, match="numpy"):
            far.numpy()
        layer = torch.nn.Linear(3, 1).to(device)
        layer(far).square().sum().backward()
        assert isinstance(layer.weight.grad, FakeTensor)
        with pytest.raises(RuntimeError, match="tensors of two devices"):
            layer(near)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_all(tmp_path_factory.mktemp("weights"))


@pytest.mark.parametrize("rigid", ["none", "refine"])
def test_rigidmatch(rigid: str) -> None:
    agree("rigidmatch", rigid=rigid)


def test_the_papers_network(weights: Path) -> None:
    agree("sceneflownet-c-vl", weights=weights, rigid="refine")


def test_pd_flow() -> None:
    agree("pd-flow")


def test_sr_flow() -> None:
    agree("sr-flow", size=(64, 48), levels=2, alternations=2, smoothing_steps=10, rigid_steps=10, mode="semi-rigid")


def agree(name: str, *, size: tuple[int, int] = (320, 240), **options: Any) -> None:
    """A method gives the same result on the second device, up to rounding, which may change single pixels."""
    pairs = open_set("tiny")
    pair = pairs.pair(pairs.keys[0])
    prev, curr = pair.prev.resized(*size), pair.curr.resized(*size)
    here = objectflow.load(name, camera="static", device="cpu", **options)(prev, curr)
    with fake_device():
        there = objectflow.load(name, camera="static", device=DEVICE, **options)(prev, curr)
    np.testing.assert_array_equal(there.labels, here.labels)
    error = np.abs(there.scene_flow - here.scene_flow)
    np.testing.assert_array_equal(np.isnan(there.scene_flow), np.isnan(here.scene_flow))
    assert np.nanquantile(error, 0.95) < 1e-3
    assert np.nanmedian(error) < 1e-5


RIGID = dataclasses.replace(RECIPE, model=RigidMatchModel(TINY_RIGID), size=(48, 64))
RECIPES = {
    "the paper's network": RECIPE,
    "rigidmatch": RIGID,
    "details": dataclasses.replace(
        RIGID, model=RigidMatchModel(dataclasses.replace(TINY_RIGID, stride=8, detail_channels=6))
    ),
}


@pytest.mark.filterwarnings("ignore:for .* copying from a non-meta parameter")
@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)
def test_training_and_resuming(recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Augmentation, losses, optimiser, running mean, validation and checkpoints."""

    def carried(batches: Iterator[Batch], device: torch.device) -> Iterator[Batch]:
        return (batch.to(device) for batch in batches)

    # Batches are prefetched to CUDA devices only.
    monkeypatch.setattr(loop, "on_device", carried)
    data = write_set(tmp_path / "set")
    recipe = dataclasses.replace(
        recipe, steps=2, batch_size=2, validate_every=2, validation_pairs=2, log_every=1, checkpoint_minutes=0.0
    )
    train(job(data, tmp_path / "here", recipe))
    with fake_device():
        train(job(data, tmp_path / "there", recipe, device=DEVICE))
        newest = sorted((tmp_path / "there" / "checkpoints").iterdir())[-1]
        for file in newest.iterdir():
            file.unlink()
        newest.rmdir()
        train(job(data, tmp_path / "there", recipe, device=DEVICE, resume=True))
    here, there = (totals(tmp_path / name) for name in ("here", "there"))
    assert len(here) == len(there) == 3
    np.testing.assert_allclose(there, here, rtol=1e-3)


def totals(run: Path) -> list[float]:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [line["losses"]["total"] for line in lines]
