"""Common settings of all generated scenes, and the maker of a scene's rows from its number."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from objectflow.dataset.manifest import SPLITS
from objectflow.synth.generation.rejection import DrawRows, draw_until_accepted
from objectflow.synth.generation.tasks import Maker, SceneRows, Task
from objectflow.synth.objects.library import Library, check_split
from objectflow.synth.objects.mixed_library import MeshFolder, open_library
from objectflow.synth.rendering.renderer import Device, Renderer
from objectflow.synth.scenes.paper_scene import SceneSettings

SettingsT = TypeVar("SettingsT")


@dataclass(frozen=True)
class SceneFactory(ABC, Generic[SettingsT]):
    """Builds the maker of one split's scenes; each worker process calls it once.

    Attributes:
        seed: of the data set.
        split: "train", "val" or "test".
        settings: distributions that scenes are drawn from.
        views: pairs per scene, each through its own camera.
        samples: colour samples per pixel, 1 or 4.
        device: where images are rendered, "cpu" or "cuda".
        meshes: a mesh folder and its share among the procedural objects; None for procedural objects only.
        texture_folder: images used as textures; None for procedural textures only.
    """

    seed: int
    split: str
    settings: SettingsT
    views: int = 1
    samples: int = 4
    device: Device = "cpu"
    meshes: MeshFolder | None = None
    texture_folder: Path | None = None

    def __post_init__(self) -> None:
        check_split(self.split)

    def __call__(self) -> Maker:
        """Return the maker, with its library open and its renderer ready."""
        library = open_library(self.meshes)
        notes = [f"{name}: skipped: {reason}" for name, reason in sorted(library.broken.items())]
        scene = self.scene_settings
        renderer = Renderer(scene.width, scene.height, samples=self.samples, device=self.device)

        def make(task: Task) -> SceneRows:
            # The sequences of a split use other random streams than its pairs, and so show other scenes.
            stream = SPLITS.index(self.split) + (0 if task.kind == "pairs" else len(SPLITS))
            rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(stream, task.scene)))
            draw = self.begin(task, rng, library, renderer)
            return draw_until_accepted(rng, draw, where=f"{self.split} scene {task.scene}", notes=notes)

        return make

    def scene_name(self, task: Task) -> str:
        """Name of a scene, for example "train-000012" or "train-sequence-000012"."""
        return f"{self.split}-{'' if task.kind == 'pairs' else 'sequence-'}{task.scene:06d}"

    @property
    @abstractmethod
    def scene_settings(self) -> SceneSettings:
        """Settings of objects, textures and cameras, including the texture folder."""

    @abstractmethod
    def begin(self, task: Task, rng: np.random.Generator, library: Library, renderer: Renderer) -> DrawRows:
        """Make the random choices that hold for all attempts at a scene, and return the function that makes one.

        Raises:
            DatasetError: this kind of scene does not have the task's kind of rows.
        """
