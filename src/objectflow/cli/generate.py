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
  objectflow generate --out data --split train --pairs 4000    # 2000 more
  objectflow generate --out data --split val --pairs 200 --workers 2
  objectflow generate --out data --split test --sequences 30
  objectflow generate --out data --split train --pairs 25000 --shard 3/16
  objectflow generate --out own --pairs 100 --mesh-folder meshes --texture-folder photographs
  objectflow generate --out pushes --preset clutter --split test --sequences 20 --frames 30
  objectflow generate --out moving --preset clutter --split test --sequences 20 --camera-turn 1 --camera-shift 0.005
  objectflow generate --out clutter --preset clutter --pairs 1000 --mesh-folder meshes --mesh-share 0.3
  objectflow generate --out unseen --preset clutter --split test --pairs 40 --mesh-folder meshes --every-mesh
"""

CLUTTER, TABLETOP = "clutter", "tabletop"
MAX_SEQUENCE_FRAMES = 500
"""Largest number of frames of a sequence, which fit one shard."""
MAX_CAMERA_TURN = 10.0
"""Largest rotation of a sequence's camera from frame to frame, degrees."""
MAX_CAMERA_SHIFT = 0.1
"""Largest translation of a sequence's camera from frame to frame, metres."""
_RENAMED_PRESETS = {"wild": CLUTTER}
"""Former names of presets, which are still accepted."""


@dataclass(frozen=True)
class Generate:
    """Simulate scenes of moving objects and store pairs of frames with exact masks and motions.

    The same seed gives the same bytes for any number of workers. The same command continues an interrupted run, and
    the same command with a larger --pairs or --sequences lets a finished set grow; a folder with shards of another
    seed or of other settings is refused.
    """

    out: Annotated[Path, option("DIR")]
    """Folder of the data set: Parquet shards and manifest.json."""

    split: str = "train"
    """train, val or test; their object models are disjoint."""

    pairs: int = 0
    """Number of pairs of frames. If the folder has fewer, only the missing ones are made."""

    sequences: int = 0
    """Number of sequences."""

    frames: Annotated[int | None, option("N", "8; 30 in the preset clutter")] = None
    """Number of frames of a sequence; another one than the default is for the preset clutter only."""

    views: int = 1
    """Number of cameras per scene; pairs of one scene are faster to make and are marked as siblings."""

    camera_turn: float = 0.0
    """Degrees by which the camera of a sequence turns from frame to frame; for the preset clutter only."""

    camera_shift: float = 0.0
    """Metres by which the camera of a sequence moves from frame to frame; for the preset clutter only."""

    seed: int = 0
    """Random seed."""

    preset: str = "paper"
    """paper (1-30 falling objects, 320x240), small (1-6 objects, 160x120), or clutter: 1-20 objects on tables, on
    floors or in bins, of which 0-8 move in various ways; some cameras move; 3 to 60 frames of 60 Hz between the two
    frames of a pair; tabletop: 1-12 objects, many of them food packages, mostly on plain light tables, with hands that
    move them, hard shadows, light and exposure that change between the frames, at distances of 0.15 to 4 m."""

    workers: int = max(1, os.cpu_count() or 1)
    """Number of processes on this machine."""

    ray: str | None = None
    """Address of a Ray cluster ("auto", "host:6379"), or "local"; --workers is then the number of actors."""

    device: Literal["cpu", "cuda"] = "cpu"
    """Device for rendering."""

    samples: Literal[1, 4] = 4
    """Number of colour samples per pixel: 4 is anti-aliased, 1 is faster."""

    shard: str = "1/1"
    """i/n: make only every n-th shard file, for batch queues."""

    mesh_folder: Path | None = None
    """Meshes (ShapeNet layout, or any OBJ, STL, PLY, GLB) instead of the procedural objects."""

    mesh_share: float = 1.0
    """Share of objects that are meshes, if there is a folder of them; the others are procedural."""

    every_mesh: bool = False
    """Use all meshes of the folder in any split: for a test set of shapes that are in no training set."""

    mesh_hulls: bool = False
    """Use the convex hull of each mesh in collisions: faster to prepare, but objects cannot lie in hollow ones."""

    texture_folder: Path | None = None
    """Images for half of the floors; in clutter and tabletop scenes also for furniture, walls and some
    objects."""

    def run(self) -> None:
        """Make the missing shards, with a progress bar."""
        from objectflow.synth.generation.credits import write_credits
        from objectflow.synth.generation.generate import generate
        from objectflow.synth.generation.jobs import GenerationJob

        if self.pairs < 1 and self.sequences < 1:
            raise DatasetError("nothing to generate: give --pairs N or --sequences N")
        if self.views < 1 or self.workers < 1:
            raise DatasetError("--views and --workers must be at least 1")
        if self.mesh_folder is None and (self.mesh_share != 1 or self.every_mesh or self.mesh_hulls):
            raise DatasetError("--mesh-share, --every-mesh and --mesh-hulls are about meshes: give --mesh-folder DIR")
        preset = _RENAMED_PRESETS.get(self.preset, self.preset)
        if preset == TABLETOP and self.sequences:
            raise DatasetError(f"the preset {preset} makes pairs: leave --sequences out")
        if self.frames is not None and (preset != CLUTTER or not self.sequences):
            raise DatasetError("--frames is for the sequences of the preset clutter: leave it out")
        if (self.camera_turn or self.camera_shift) and (preset != CLUTTER or not self.sequences):
            raise DatasetError("--camera-turn and --camera-shift are for the sequences of the preset clutter")
        if not 0 <= self.camera_turn <= MAX_CAMERA_TURN or not 0 <= self.camera_shift <= MAX_CAMERA_SHIFT:
            raise DatasetError(
                f"--camera-turn must be from 0 to {MAX_CAMERA_TURN:g} degrees, --camera-shift from 0 to "
                f"{MAX_CAMERA_SHIFT:g} m, not {self.camera_turn:g} and {self.camera_shift:g}"
            )
        if self.frames is not None and not 2 <= self.frames <= MAX_SEQUENCE_FRAMES:
            raise DatasetError(f"--frames must be from 2 to {MAX_SEQUENCE_FRAMES}, not {self.frames}")
        scenes = self._make_scenes(preset)
        jobs = []
        if self.pairs:
            jobs.append(GenerationJob("pairs", self.split, self.pairs, self.views))
        if self.sequences:
            jobs.append(GenerationJob("sequences", self.split, self.sequences, self._sequence_frames(preset)))
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

            pool = self._open_pool(scenes)
            try:
                manifest = generate(
                    self.out, jobs, pool, seed=self.seed, settings=self._recorded(preset, scenes.settings),
                    shard=self._shard(), report=report,
                )  # fmt: skip
            finally:
                pool.close()
        for note in sorted(notes):
            console.print(note, markup=False)
        if notes:
            console.print(f"{len(notes)} models could not be used")
        if manifest is None:
            console.print(f"{self.out}: the shards of this run are done; other runs of the queue are unfinished")
            return
        if self.mesh_folder is not None and write_credits(self.out, self.mesh_folder, manifest):
            console.print(f"{self.out}: credits.json names the authors and licences of the meshes")
        for name, part in manifest.parts.items():
            rejected = ", ".join(f"{count} {reason}" for reason, count in part.rejected.items()) or "none"
            console.print(f"{self.out}: {name}: {part.rows} rows in {len(part.shards)} shards; rejected: {rejected}")

    def _make_scenes(self, preset: str) -> Any:
        """The factory of the preset's scenes."""
        from objectflow.synth.generation.clutter_maker import ClutterScenes
        from objectflow.synth.generation.paper_maker import PaperScenes
        from objectflow.synth.generation.tabletop_maker import TabletopScenes
        from objectflow.synth.objects.mixed_library import MeshFolder
        from objectflow.synth.scenes.clutter_scene import ClutterSettings
        from objectflow.synth.scenes.tabletop_scene import TabletopSettings

        meshes = None
        if self.mesh_folder is not None:
            meshes = MeshFolder(self.mesh_folder, self.mesh_share, self.every_mesh, self.mesh_hulls)
        common: dict[str, Any] = {
            "seed": self.seed,
            "split": self.split,
            "views": self.views,
            "samples": self.samples,
            "device": self.device,
            "meshes": meshes,
            "texture_folder": self.texture_folder,
        }
        settings = preset_settings(preset)
        settings = dataclasses.replace(settings, views=max(settings.views, 2 * self.views))
        if preset == CLUTTER:
            frames = self._sequence_frames(preset)
            return ClutterScenes(
                settings=ClutterSettings(settings),
                sequence_frames=frames,
                camera_turn=self.camera_turn,
                camera_shift=self.camera_shift,
                **common,
            )
        if preset == TABLETOP:
            return TabletopScenes(settings=TabletopSettings(settings), **common)
        return PaperScenes(settings=settings, **common)

    def _sequence_frames(self, preset: str) -> int:
        from objectflow.synth.generation import clutter_sequences
        from objectflow.synth.physics.simulate import SEQUENCE_FRAMES

        if preset == CLUTTER:
            return clutter_sequences.SEQUENCE_FRAMES if self.frames is None else self.frames
        return len(SEQUENCE_FRAMES)

    def _open_pool(self, scenes: Any) -> Any:
        from objectflow.runtime.pool import InProcess, Processes

        if self.ray is not None:
            from objectflow.runtime.ray_pool import RayActors

            return RayActors(scenes, self.ray, self.workers, cuda=self.device == "cuda")
        return InProcess(scenes) if self.workers == 1 else Processes(scenes, self.workers)

    def _recorded(self, preset: str, settings: Any) -> dict[str, Any]:
        """Settings that all shards of a set share. Workers and device are left out: labels do not depend on them.

        Newer options are recorded only if they are used, so that older sets can be continued.
        """
        more: dict[str, Any] = {} if self.mesh_share == 1 else {"mesh_share": self.mesh_share}
        more |= {"every_mesh": True} if self.every_mesh else {}
        more |= {"mesh_hulls": True} if self.mesh_hulls else {}
        more |= {"camera_turn": self.camera_turn} if self.camera_turn else {}
        more |= {"camera_shift": self.camera_shift} if self.camera_shift else {}
        scene = settings
        if preset in (CLUTTER, TABLETOP):
            scene = settings.scene
            more[preset] = {key: value for key, value in _json_values(settings).items() if key != "scene"}
        return {
            "preset": preset,
            **more,
            "samples": self.samples,
            "meshes": None if self.mesh_folder is None else str(self.mesh_folder),
            "textures": None if self.texture_folder is None else str(self.texture_folder),
            "scene": {key: value for key, value in _json_values(scene).items() if key != "images"},
        }

    def _shard(self) -> tuple[int, int]:
        try:
            number, total = (int(word) for word in self.shard.split("/"))
        except ValueError:
            raise DatasetError(f"--shard must be i/n, for example 3/16, not {self.shard!r}") from None
        if not 1 <= number <= total:
            raise DatasetError(f"--shard i/n needs 1 <= i <= n, not {self.shard!r}")
        return number, total


def _json_values(settings: Any) -> dict[str, Any]:
    """The fields of a settings dataclass as JSON has them: tuples as lists, nested settings as dictionaries."""

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value):
            return _json_values(value)
        return list(value) if isinstance(value, tuple) else value

    return {key: plain(value) for key, value in vars(settings).items()}


def preset_settings(name: str) -> Any:
    """The `SceneSettings` of a preset.

    Raises:
        DatasetError: an unknown name.
    """
    from objectflow.synth.scenes import clutter_scene, tabletop_scene
    from objectflow.synth.scenes.paper_scene import SceneSettings

    presets = {
        "paper": SceneSettings(),
        "small": SceneSettings(objects=(1, 6), width=160, height=120, focal=(118.23, 118.23)),
        CLUTTER: clutter_scene.SCENE,
        TABLETOP: tabletop_scene.SCENE,
    }
    if name not in presets:
        raise DatasetError(f"unknown preset {name!r}: choose one of {', '.join(presets)}")
    return presets[name]
