"""Folders of generated sets of fake scenes, and their bytes."""

from __future__ import annotations

from pathlib import Path

from helpers import fake_scenes
from helpers.fake_scenes import FRAMES, SETTINGS
from objectflow.dataset.manifest import Manifest
from objectflow.runtime.pool import Pool
from objectflow.synth.generation.generate import generate
from objectflow.synth.generation.jobs import GenerationJob

SCRIPT = Path(fake_scenes.__file__)
PAIRS, SEQUENCES = GenerationJob("pairs", "train", 20, 1), GenerationJob("sequences", "train", 5, len(FRAMES))


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def run(out: Path, pool: Pool, jobs: tuple[GenerationJob, ...] = (PAIRS, SEQUENCES)) -> Manifest | None:
    return generate(out, jobs, pool, seed=0, settings=SETTINGS)
