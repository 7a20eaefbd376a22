"""Tiny scenes without physics or rendering, for tests of the generator. As a script it generates a data set."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from objectflow.dataset.schema import PairRow, SequenceRow
from objectflow.errors import ObjectflowError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.runtime.pool import InProcess, Processes
from objectflow.synth.generation import jobs as generation_jobs
from objectflow.synth.generation.generate import generate
from objectflow.synth.generation.jobs import GenerationJob
from objectflow.synth.generation.tasks import Maker, SceneRows, Task

SETTINGS = {"preset": "fake", "size": [16, 12]}
FRAMES = (20, 30)


@dataclass(frozen=True)
class FakeScenes:
    """Rows that depend on seed, kind and number alone; with a delay, workers finish out of order."""

    seed: int = 0
    views: int = 1
    delay: float = 0.0
    dies_at: int = -1
    fails_at: int = -1

    def __call__(self) -> Maker:
        return self.make

    def make(self, task: Task) -> SceneRows:
        if task.scene == self.dies_at:
            os._exit(9)
        if task.scene == self.fails_at:
            raise ObjectflowError("the scene cannot be made")
        time.sleep(self.delay * (1 + task.scene % 3))
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(task.kind == "pairs", task.scene)))
        name = f"{task.scene:06d}"
        rejected = {"sinks": int(rng.integers(2))}
        if task.kind == "pairs":
            rows = [self._pair(rng, f"train-{name}", view) for view in range(self.views)]
            return SceneRows([row.to_dict() for row in rows], rejected)
        return SceneRows([self._frame(rng, f"train-{name}", frame).to_dict() for frame in FRAMES], rejected)

    def _pair(self, rng: np.random.Generator, scene: str, view: int) -> PairRow:
        (prev, prev_labels), (curr, curr_labels) = _image(rng), _image(rng)
        return PairRow(f"{scene}-{view}", scene, prev, prev_labels, curr, curr_labels, ())

    def _frame(self, rng: np.random.Generator, scene: str, frame: int) -> SequenceRow:
        image, labels = _image(rng)
        return SequenceRow(scene, frame, image, labels, ())


def _image(rng: np.random.Generator) -> tuple[RgbdFrame, np.ndarray]:
    camera = Camera(width=16, height=12, fx=12.0, fy=12.0, cx=7.5, cy=5.5)
    depth = rng.uniform(0.3, 0.9, (12, 16)).astype(np.float32)
    color = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    return RgbdFrame(color=color, depth=depth, camera=camera), np.zeros((12, 16), np.int32)


def main(out: str, count: str, workers: str, delay: str) -> int:
    generation_jobs.ROWS_A_SHARD = 8
    factory = FakeScenes(delay=float(delay))
    pool = Processes(factory, int(workers)) if int(workers) > 1 else InProcess(factory)
    jobs = [GenerationJob("pairs", "train", int(count), 1), GenerationJob("sequences", "train", 5, len(FRAMES))]
    try:
        generate(Path(out), jobs, pool, seed=0, settings=SETTINGS)
    except ObjectflowError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    finally:
        pool.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
