"""From a scene's number to its rows: draw, let fall, render, label; what went wrong is drawn anew."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from objectflow.errors import DatasetError
from objectflow.synth.mixed_library import Meshes, open_mixed
from objectflow.synth.physics import RejectedSceneError
from objectflow.synth.render import Device, Renderer
from objectflow.synth.rows import Clock, Draft, make_pairs, make_sequence
from objectflow.synth.scene import SceneSettings, draw_scene_and_models
from objectflow.synth.workers import Maker, SceneRows, Task

SPLITS = ("train", "val", "test")
MAX_DRAFTS = 50


@dataclass(frozen=True)
class Scenes:
    """Makes the scenes of one split; each process that does calls it once, and keeps its renderer.

    Attributes:
        seed: of the data set.
        split: "train", "val" or "test".
        settings: what scenes are drawn from.
        views: pairs a scene, each through a camera of its own.
        samples: colour samples a pixel, 1 or 4.
        device: where pictures are made, "cpu" or "cuda".
        meshes: a folder of them, and how they are mixed with the procedural objects.
        texture_folder: pictures for floors.
    """

    seed: int
    split: str
    settings: SceneSettings = field(default_factory=SceneSettings)
    views: int = 1
    samples: int = 4
    device: Device = "cpu"
    meshes: Meshes | None = None
    texture_folder: Path | None = None

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise DatasetError(f"unknown split {self.split!r}: choose one of {', '.join(SPLITS)}")

    def __call__(self) -> Maker:
        """The maker, with its library open and its renderer ready."""
        library = open_mixed(self.meshes)
        renderer = Renderer(self.settings.width, self.settings.height, samples=self.samples, device=self.device)
        settings = dataclasses.replace(self.settings, images=self.texture_folder)
        # What a mesh folder has sorted out already; the procedural library has nothing broken.
        found: dict[str, str] = getattr(library, "broken", {})
        broken = [f"{name}: skipped: {reason}" for name, reason in sorted(found.items())]

        def make(task: Task) -> SceneRows:
            # (split, index); a split's sequences count as a split of their own, or they would be its pairs' scenes.
            part = SPLITS.index(self.split) + (0 if task.kind == "pairs" else len(SPLITS))
            rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(part, task.scene)))
            rejected: dict[str, int] = {}
            skipped = list(broken)
            clock = Clock()
            word = "" if task.kind == "pairs" else "sequence-"
            name = f"{self.split}-{word}{task.scene:06d}"
            for _ in range(MAX_DRAFTS):
                try:
                    clock.start()
                    scene, models = draw_scene_and_models(rng, library, self.split, settings, skipped.append)
                    clock.lap("draw")
                    draft = Draft(name, scene, models, renderer, clock)
                    rows = make_pairs(draft, self.views) if task.kind == "pairs" else make_sequence(draft)
                    return SceneRows(rows, rejected, tuple(dict.fromkeys(skipped)), clock.seconds)
                except RejectedSceneError as error:
                    rejected[error.reason] = rejected.get(error.reason, 0) + 1
            raise DatasetError(
                f"{self.split} scene {task.scene}: {MAX_DRAFTS} drafts were rejected ({rejected}): check the settings"
            )

        return make
