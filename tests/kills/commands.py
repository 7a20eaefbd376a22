"""The commands that are killed, on inputs as small as they can be."""

from __future__ import annotations

import dataclasses
import functools
import json
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from helpers.fake_scenes import FRAMES, SETTINGS, FakeScenes
from helpers.plate_recordings import PLATE_PATH, missing_steps, write_plates
from helpers.plate_scenes import CAMERA as PLATE_CAMERA
from helpers.plate_scenes import PlateScene
from helpers.training_runs import RECIPE, job, write_set
from kills.harness import Command, Make
from objectflow.cli import main
from objectflow.evaluation.cache import encode
from objectflow.runtime.pool import InProcess
from objectflow.synth.generation import jobs as generation_jobs
from objectflow.synth.generation.generate import generate
from objectflow.synth.generation.jobs import GenerationJob
from objectflow.training import loop

CAMERA = {"width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "depth_scale": 1000}
TINY = [
    "--size", "24", "32", "--batch-size", "2", "--steps", "2", "--validate-every", "1", "--validation-pairs", "2",
    "--checkpoint-minutes", "0", "--log-every", "1", "--model.network.trunk-width", "8",
    "--model.network.trunk-blocks", "1", "1", "--model.network.color-channels", "8", "--model.network.reach", "2",
    "--device", "cpu",
]  # fmt: skip
"""Options of a training run of seconds."""


@contextmanager
def stopped_clocks() -> Iterator[None]:
    """Durations are part of the results, as is whether a prediction was the first of its process; both are fixed."""
    still = types.SimpleNamespace(perf_counter=lambda: 0.0, monotonic=lambda: 0.0)
    with pytest.MonkeyPatch.context() as patch:
        for module in ("methods.baselines.zero", "evaluation.predict", "training.loop"):
            patch.setattr(f"objectflow.{module}.time", still)
        patch.setattr(loop, "Run", functools.partial(loop.Run, started=0.0))
        patch.setattr(
            "objectflow.evaluation.predict.encode", lambda motion, **facts: encode(motion, **{**facts, "cold": False})
        )
        patch.setattr(generation_jobs, "ROWS_A_SHARD", 2)
        yield


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


def write_frames_and_result(folder: Path) -> None:
    """An earlier result, which `estimate` replaces."""
    write_frames(folder)
    (folder / "out").mkdir()
    for name in ("labels.png", "scene_flow.npy", "objects.json", "overlay.png", "flow.png"):
        (folder / "out" / name).write_text("earlier")


def write_pairs(folder: Path) -> None:
    write_set(folder / "data", pairs=4)


def run(folder: Path, *options: str) -> None:
    out = folder / "deep" / "out"
    raise SystemExit(main(["run", str(folder / "in"), "--method", "zero", "--out", str(out), *options]))


def run_with_video_and_report(folder: Path) -> None:
    run(folder, "--video", "--report")


def write_plate_frames(folder: Path) -> None:
    write_plates(folder / "in", PLATE_PATH)
    camera = PLATE_CAMERA.to_dict()
    (folder / "in" / "camera.json").write_text(json.dumps({**camera, "depth_scale": 1000}))


def run_finding_later(folder: Path) -> None:
    """An object is found late, so that masks in the folders of earlier pairs are completed."""
    scene = PlateScene()
    for number, here in enumerate(PLATE_PATH):
        scene.frame(number, here)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("objectflow.cli.arguments.load", lambda *_, **__: missing_steps(scene, first=5))
        run(folder, "--no-pictures")


def estimate(folder: Path) -> None:
    images = [str(folder / "in" / kind / f"{i}.png") for i in range(2) for kind in ("color", "depth")]
    camera = ["--camera-file", str(folder / "in" / "camera.json")]
    raise SystemExit(main(["estimate", *images, *camera, "--method", "zero", "--out", str(folder / "out")]))


def evaluate(folder: Path, *options: str) -> None:
    words = ["evaluate", "--data", "tiny", "--limit", "2", "--methods", "zero", "--out", str(folder / "out"), *options]
    raise SystemExit(main(words))


def evaluate_without_report(folder: Path) -> None:
    evaluate(folder, "--no-report")


def generate_fake_scenes(folder: Path) -> None:
    """What `generate` does with scenes that need neither physics nor rendering."""
    jobs = [GenerationJob("pairs", "train", 3, 1), GenerationJob("sequences", "train", 1, len(FRAMES))]
    generate(folder / "set", jobs, InProcess(FakeScenes()), seed=0, settings=SETTINGS)


def generate_scenes(folder: Path) -> None:
    options = ["--preset", "small", "--samples", "1", "--pairs", "3", "--workers", "1"]
    raise SystemExit(main(["generate", "--out", str(folder / "set"), *options]))


def fit(folder: Path, **changes: Any) -> None:
    """What `train` does, with every feature whose state a resumed run must restore."""
    torch.set_num_threads(1)
    recipe = dataclasses.replace(
        RECIPE, steps=2, batch_size=2, validate_every=1, validation_pairs=2, log_every=1, keep_checkpoints=1,
        checkpoint_minutes=0.0,
    )  # fmt: skip
    recipe = dataclasses.replace(recipe, **changes)
    loop.train(job(folder / "data", folder / "out", recipe, resume=True))


def fit_without_validation(folder: Path) -> None:
    """The last weights are kept instead of the best."""
    fit(folder, steps=1, validation_pairs=0)


def train(folder: Path) -> None:
    torch.set_num_threads(1)
    words = ["train", "--data", str(folder / "data"), "--out", str(folder / "out"), *TINY, "--resume"]
    raise SystemExit(main(words))


COMMANDS: dict[str, tuple[Command, Make]] = {
    "estimate": (estimate, write_frames),
    "estimate, replacing a result": (estimate, write_frames_and_result),
    "run": (run, write_frames),
    "run with a video and a report": (run_with_video_and_report, write_frames),
    "run finding an object later": (run_finding_later, write_plate_frames),
    "evaluate": (evaluate, nothing),
    "evaluate without a report": (evaluate_without_report, nothing),
    "generate": (generate_scenes, nothing),
    "generate fake scenes": (generate_fake_scenes, nothing),
    "train": (train, write_pairs),
    "train with every feature": (fit, write_pairs),
    "train without validation": (fit_without_validation, write_pairs),
}
