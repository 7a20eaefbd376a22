"""`objectflow generate`: a simulated data set as Parquet shards, continued by the same command."""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from objectflow.cli.arguments import option
from objectflow.errors import DatasetError

EXAMPLES = """\
  objectflow generate --out data --split train --pairs 2000
  objectflow generate --out data --split val --pairs 200 --workers 2
  objectflow generate --out data --split test --sequences 30
  objectflow generate --out data --split train --pairs 25000 --shard 3/16
  objectflow generate --out own --pairs 100 --mesh-folder meshes --texture-folder photographs
  objectflow generate --out wild --preset wild --pairs 1000 --mesh-folder meshes --mesh-share 0.3
  objectflow generate --out unseen --preset wild --split test --pairs 40 --mesh-folder meshes --every-mesh
"""


@dataclass(frozen=True)
class Generate:
    """Simulate scenes of falling objects and store pairs of frames with exact masks and motions.

    The same seed gives the same bytes, whatever the number of workers. A run that was cut off is continued by the same
    command; a folder that holds another seed's or other settings' shards is refused.
    """

    out: Annotated[Path, option("DIR")]
    """Folder of the data set: Parquet shards and manifest.json."""

    split: str = "train"
    """train, val or test; their object models are disjoint."""

    pairs: int = 0
    """How many pairs of frames, one second apart."""

    sequences: int = 0
    """How many sequences of eight frames."""

    views: int = 1
    """Cameras a scene: cheaper pairs, marked as siblings."""

    seed: int = 0
    """Of everything random."""

    preset: str = "paper"
    """paper (1-30 objects fall, 320x240), small (1-6 objects, 160x120), or wild: tables, floors, bins and walls, 1-20
    objects of which 0-8 move in many ways, some cameras too; 3 to 60 frames of 60 Hz between the two of a pair."""

    workers: int = max(1, os.cpu_count() or 1)
    """Processes on this machine."""

    ray: str | None = None
    """Address of a Ray cluster ("auto", "host:6379"), or "local"; --workers is then the number of actors."""

    device: Literal["cpu", "cuda"] = "cpu"
    """Where pictures are rendered."""

    samples: Literal[1, 4] = 4
    """Colour samples a pixel: 4 is anti-aliased, 1 is faster."""

    shard: str = "1/1"
    """i/n: make only every n-th shard file, for batch queues."""

    mesh_folder: Path | None = None
    """Meshes (ShapeNet layout, or any OBJ, STL, PLY, GLB) instead of the procedural objects."""

    mesh_share: float = 1.0
    """Share of the objects that are meshes, where there is a folder of them; the others are procedural."""

    every_mesh: bool = False
    """Take all meshes of the folder, whatever the split: for a test set of shapes that nothing was trained on."""

    texture_folder: Path | None = None
    """Pictures for half of the floors; in wild scenes for furniture, walls and some objects too."""

    def run(self) -> None:
        """Make the shards that are missing, with a progress bar."""
        from objectflow.synth.generation.clutter_maker import ClutterScenes
        from objectflow.synth.generation.generate import GenerationJob, generate
        from objectflow.synth.generation.paper_maker import PaperScenes
        from objectflow.synth.objects.mixed_library import Meshes
        from objectflow.synth.physics.simulate import SEQUENCE_FRAMES
        from objectflow.synth.scenes.clutter_scene import WildSettings

        if self.pairs < 1 and self.sequences < 1:
            raise DatasetError("nothing to generate: give --pairs N or --sequences N")
        if self.views < 1 or self.workers < 1:
            raise DatasetError("--views and --workers must be at least 1")
        if self.mesh_folder is None and (self.mesh_share != 1 or self.every_mesh):
            raise DatasetError("--mesh-share and --every-mesh are about meshes: give --mesh-folder DIR")
        meshes = None
        if self.mesh_folder is not None:
            meshes = Meshes(self.mesh_folder, self.mesh_share, self.every_mesh)
        common: dict[str, Any] = {
            "seed": self.seed,
            "split": self.split,
            "views": self.views,
            "samples": self.samples,
            "device": self.device,
            "meshes": meshes,
            "texture_folder": self.texture_folder,
        }
        settings = preset_settings(self.preset)
        settings = dataclasses.replace(settings, views=max(settings.views, 2 * self.views))
        scenes: Any
        wild = None
        if self.preset == WILD:
            if self.sequences:
                raise DatasetError("the preset wild makes pairs: leave --sequences out")
            wild = WildSettings(settings)
            scenes = ClutterScenes(settings=wild, **common)
        else:
            scenes = PaperScenes(settings=settings, **common)
        jobs = []
        if self.pairs:
            jobs.append(GenerationJob("pairs", self.split, self.pairs, self.views))
        if self.sequences:
            jobs.append(GenerationJob("sequences", self.split, self.sequences, len(SEQUENCE_FRAMES)))
        console = Console()
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        notes: set[str] = set()
        with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
            bar = progress.add_task("rows")

            def report(now: Any) -> None:
                progress.update(bar, completed=now.done, total=now.total)
                speed = progress.tasks[bar].speed
                if speed:
                    progress.update(bar, description=f"rows, {speed:.2f}/s")
                if now.scene:
                    notes.update(now.scene.notes)

            pool = self._pool(scenes)
            try:
                manifest = generate(
                    self.out, jobs, pool, seed=self.seed, settings=self._recorded(settings, wild), shard=self._shard(),
                    report=report,
                )  # fmt: skip
            finally:
                pool.close()
        for note in sorted(notes):
            console.print(note, markup=False)
        if notes:
            console.print(f"{len(notes)} models could not be used")
        if manifest is None:
            console.print(f"{self.out}: this run's shards are done; other runs of the queue still have theirs to make")
            return
        for name, part in manifest.parts.items():
            redrawn = ", ".join(f"{count} {reason}" for reason, count in part.rejected.items()) or "none"
            console.print(f"{self.out}: {name}: {part.rows} rows in {len(part.shards)} shards; drawn anew: {redrawn}")

    def _pool(self, scenes: Any) -> Any:
        from objectflow.runtime.pool import InProcess, Processes

        if self.ray is not None:
            from objectflow.runtime.ray_pool import RayActors

            return RayActors(scenes, self.ray, self.workers, cuda=self.device == "cuda")
        return InProcess(scenes) if self.workers == 1 else Processes(scenes, self.workers)

    def _recorded(self, settings: Any, wild: Any) -> dict[str, Any]:
        """What shards must have in common; neither workers nor device change a byte of the labels."""
        plain = _plain(settings)
        # Only what is not as it ever was: sets made before there was a choice are continued.
        more: dict[str, Any] = {} if self.mesh_share == 1 else {"mesh_share": self.mesh_share}
        more |= {"every_mesh": True} if self.every_mesh else {}
        if wild is not None:
            more["wild"] = {key: value for key, value in _plain(wild).items() if key != "scene"}
        return {
            "preset": self.preset,
            **more,
            "samples": self.samples,
            "meshes": None if self.mesh_folder is None else str(self.mesh_folder),
            "textures": None if self.texture_folder is None else str(self.texture_folder),
            "scene": {key: value for key, value in plain.items() if key != "images"},
        }

    def _shard(self) -> tuple[int, int]:
        try:
            number, total = (int(word) for word in self.shard.split("/"))
        except ValueError:
            raise DatasetError(f"--shard must be i/n, for example 3/16, not {self.shard!r}") from None
        if not 1 <= number <= total:
            raise DatasetError(f"--shard i/n needs 1 <= i <= n, not {self.shard!r}")
        return number, total


WILD = "wild"


def _plain(settings: Any) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in vars(settings).items()}


def preset_settings(name: str) -> Any:
    """The `SceneSettings` of a preset.

    Raises:
        DatasetError: an unknown name.
    """
    from objectflow.synth.scenes.clutter_scene import SCENE
    from objectflow.synth.scenes.paper_scene import SceneSettings

    presets = {
        "paper": SceneSettings(),
        "small": SceneSettings(objects=(1, 6), width=160, height=120, focal=(118.23, 118.23)),
        WILD: SCENE,
    }
    if name not in presets:
        raise DatasetError(f"unknown preset {name!r}: choose one of {', '.join(presets)}")
    return presets[name]
