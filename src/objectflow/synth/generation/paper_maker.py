"""From a scene's number to its rows: draw, let fall, render, label; what went wrong is drawn anew."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from objectflow.synth.generation.rejection import draw_until_kept, library_and_broken
from objectflow.synth.generation.rows import Clock, Draft, make_pairs, make_sequence
from objectflow.synth.generation.tasks import Maker, SceneRows, Task
from objectflow.synth.objects.library import SPLIT_SIZES, check_split
from objectflow.synth.objects.mixed_library import Meshes
from objectflow.synth.rendering.renderer import Device, Renderer
from objectflow.synth.scenes.paper_scene import SceneSettings, draw_scene_and_models


@dataclass(frozen=True)
class PaperScenes:
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
        check_split(self.split)

    def __call__(self) -> Maker:
        """The maker, with its library open and its renderer ready."""
        library, broken = library_and_broken(self.meshes)
        renderer = Renderer(self.settings.width, self.settings.height, samples=self.samples, device=self.device)
        settings = dataclasses.replace(self.settings, images=self.texture_folder)

        def make(task: Task) -> SceneRows:
            # (split, index); a split's sequences count as a split of their own, or they would be its pairs' scenes.
            part = list(SPLIT_SIZES).index(self.split) + (0 if task.kind == "pairs" else len(SPLIT_SIZES))
            scene_rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(part, task.scene)))
            word = "" if task.kind == "pairs" else "sequence-"
            name = f"{self.split}-{word}{task.scene:06d}"

            def draw(rng: np.random.Generator, clock: Clock, skip: Callable[[str], None]) -> list[dict[str, Any]]:
                scene, models = draw_scene_and_models(rng, library, self.split, settings, skip)
                clock.lap("draw")
                draft = Draft(name, scene, models, renderer, clock)
                return make_pairs(draft, self.views) if task.kind == "pairs" else make_sequence(draft)

            where = f"{self.split} scene {task.scene}"
            return draw_until_kept(scene_rng, draw, where=where, broken=broken, clock=Clock())

        return make
