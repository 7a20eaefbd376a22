"""Killed at any change of the file system, each command makes the same files when it is repeated, and no others."""

from __future__ import annotations

import dataclasses
import functools
import json
import types
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.fake_scenes import FRAMES, SETTINGS, FakeScenes
from helpers.training_runs import RECIPE, job, write_set
from kill_points import kill_everywhere
from objectflow.cli import main
from objectflow.evaluation.cache import encode
from objectflow.runtime.pool import InProcess
from objectflow.synth.generation import jobs as generation_jobs
from objectflow.synth.generation.generate import generate
from objectflow.synth.generation.jobs import GenerationJob
from objectflow.training import loop

Command = Callable[[Path], None]
CAMERA = {"width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "depth_scale": 1000}


@pytest.fixture(autouse=True)
def stopped_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Durations are part of the results, as is whether a prediction was the first of its process."""
    still = types.SimpleNamespace(perf_counter=lambda: 0.0, monotonic=lambda: 0.0)
    for module in ("methods.baselines.zero", "evaluation.predict", "training.loop"):
        monkeypatch.setattr(f"objectflow.{module}.time", still)
    monkeypatch.setattr(loop, "Run", functools.partial(loop.Run, started=0.0))
    monkeypatch.setattr(
        "objectflow.evaluation.predict.encode", lambda motion, **facts: encode(motion, **{**facts, "cold": False})
    )
    monkeypatch.setattr(generation_jobs, "ROWS_A_SHARD", 2)


def nothing(folder: Path) -> None:
    """The command needs no input."""


def write_frames(folder: Path) -> None:
    rng = np.random.default_rng(0)
    for kind in ("color", "depth"):
        (folder / "in" / kind).mkdir(parents=True)
    for index in range(3):
        cv2.imwrite(str(folder / "in/color" / f"{index}.png"), rng.integers(0, 255, (24, 32, 3), dtype=np.uint8))
        cv2.imwrite(str(folder / "in/depth" / f"{index}.png"), np.full((24, 32), 1000 - 20 * index, np.uint16))
    (folder / "in" / "camera.json").write_text(json.dumps(CAMERA))


def run(folder: Path) -> None:
    raise SystemExit(main(["run", str(folder / "in"), "--method", "zero", "--out", str(folder / "deep" / "out")]))


def estimate(folder: Path) -> None:
    images = [str(folder / "in" / kind / f"{i}.png") for i in range(2) for kind in ("color", "depth")]
    camera = ["--camera-file", str(folder / "in" / "camera.json")]
    raise SystemExit(main(["estimate", *images, *camera, "--method", "zero", "--out", str(folder / "out")]))


def write_frames_and_result(folder: Path) -> None:
    """An earlier result, which `estimate` replaces."""
    write_frames(folder)
    (folder / "out").mkdir()
    for name in ("labels.png", "scene_flow.npy", "objects.json", "overlay.png", "flow.png"):
        (folder / "out" / name).write_text("earlier")


def evaluate(folder: Path) -> None:
    options = ["--data", "tiny", "--limit", "2", "--methods", "zero", "--no-report"]
    raise SystemExit(main(["evaluate", *options, "--out", str(folder / "out")]))


def make_set(folder: Path) -> None:
    jobs = [GenerationJob("pairs", "train", 3, 1), GenerationJob("sequences", "train", 1, len(FRAMES))]
    generate(folder / "set", jobs, InProcess(FakeScenes()), seed=0, settings=SETTINGS)


def write_pairs(folder: Path) -> None:
    write_set(folder / "data", pairs=4)


def fit(folder: Path) -> None:
    torch.set_num_threads(1)
    recipe = dataclasses.replace(
        RECIPE, steps=2, batch_size=2, validate_every=1, validation_pairs=2, log_every=1, keep_checkpoints=1,
        checkpoint_minutes=0.0,
    )  # fmt: skip
    loop.train(job(folder / "data", folder / "out", recipe, resume=True))


@pytest.mark.parametrize(
    ("command", "make", "least", "stride"),
    [
        (estimate, write_frames, 8, 3),
        (estimate, write_frames_and_result, 14, 3),
        (run, write_frames, 13, 7),
        (evaluate, nothing, 6, 11),
        (make_set, nothing, 11, 3),
        (fit, write_pairs, 4, 17),
    ],
)
def test_the_same_command_finishes_the_work(
    tmp_path: Path, command: Command, make: Command, least: int, stride: int
) -> None:
    kills, differences = kill_everywhere(command, make, tmp_path, stride=stride)
    assert not differences
    assert kills >= least
