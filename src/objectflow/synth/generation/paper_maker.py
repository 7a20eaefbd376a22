"""Makes the rows of the paper's scenes: draw, simulate the fall, render, label."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from objectflow.synth.generation.rejection import DrawRows
from objectflow.synth.generation.rows import DrawnScene, make_pairs, make_sequence
from objectflow.synth.generation.scene_factory import SceneFactory
from objectflow.synth.generation.stage_timer import StageTimer
from objectflow.synth.generation.tasks import Task
from objectflow.synth.objects.library import Library
from objectflow.synth.rendering.renderer import Renderer
from objectflow.synth.scenes.paper_scene import SceneSettings, draw_paper_scene


@dataclass(frozen=True)
class PaperScenes(SceneFactory[SceneSettings]):
    """Scenes of falling objects; see `SceneFactory`. Texture images cover floors only."""

    settings: SceneSettings = field(default_factory=SceneSettings)

    @property
    def scene_settings(self) -> SceneSettings:
        """See `SceneFactory.scene_settings`."""
        return dataclasses.replace(self.settings, images=self.texture_folder)

    def begin(self, task: Task, rng: np.random.Generator, library: Library, renderer: Renderer) -> DrawRows:
        """See `SceneFactory.begin`."""
        settings = self.scene_settings

        def draw(rng: np.random.Generator, timer: StageTimer, skip: Callable[[str], None]) -> list[dict[str, Any]]:
            scene, models = draw_paper_scene(rng, library, self.split, settings, skip)
            timer.lap("draw")
            drawn = DrawnScene(self.scene_name(task), scene, models, renderer, timer)
            return make_pairs(drawn, self.views) if task.kind == "pairs" else make_sequence(drawn)

        return draw
