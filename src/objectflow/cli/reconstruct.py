"""`objectflow reconstruct`: the shapes of a run's objects, from its results and its frames."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from objectflow.cli.arguments import option
from objectflow.cli.output import print_written
from objectflow.cli.run_folder import RUN_FOLDER, open_run_source, read_tracks, run_pairs, run_views
from objectflow.errors import ResultError
from objectflow.readers import FrameSource
from objectflow.runtime.quiet import silence_stderr
from objectflow.storage.locked_folder import SETTINGS, locked_folder
from objectflow.tracking.model_files import MODELS, write_models
from objectflow.tracking.reconstruction import ReconstructionSettings, fuse_background, fuse_objects
from objectflow.tracking.volume_meshing import check_extra

EXAMPLES = """\
  objectflow reconstruct result
  objectflow reconstruct result --source recording
"""


@dataclass(frozen=True)
class Reconstruct:
    """Fuse the objects and the background of a run into models: coloured meshes in metres, and an index.

    RUN_DIR is a finished folder of `objectflow run`. `objectflow run --models` writes the same files.
    """

    run_dir: Annotated[Positional[Path], option("RUN_DIR")]
    """Folder of a run."""

    source: Annotated[Path | None, option("SOURCE", "where it lay during the run")] = None
    """The run's sequence; needed only if it was moved since."""

    def run(self) -> None:
        """Read the run, fuse, write."""
        check_extra()
        if not self.run_dir.is_dir() or not (self.run_dir / SETTINGS).is_file():
            raise ResultError(f"{self.run_dir}: not a folder of objectflow run: {SETTINGS} is missing")
        with silence_stderr():
            source = open_run_source(self.run_dir, self.source, "--source")
        # A run that is still writing there holds the folder.
        with locked_folder(self.run_dir, {}, RUN_FOLDER, check=lambda _: None):
            write_run_models(self.run_dir, source)
        print_written(self.run_dir / MODELS)


def write_run_models(run: Path, source: FrameSource) -> None:
    """Fuse and write the models of a finished run, and print a line for each object without one.

    Args:
        run: its folder.
        source: its frames.

    Raises:
        ResultError: the run is damaged or not finished, or its source has changed.
    """
    settings = ReconstructionSettings()
    pairs, tracks = run_pairs(run), read_tracks(run)
    models = fuse_objects(run_views(source, pairs), tracks, settings)
    # The background lies in one world: that of the longest part.
    parts = Counter(view.part for view in run_views(source, pairs))
    longest = min(parts, key=lambda part: (-parts[part], part)) if parts else 0
    views = (view for view in run_views(source, pairs) if view.part == longest)
    written, reasons = write_models(run, models, fuse_background(views, models, settings), settings)
    print(f"models of {len(written)} of {len(models)} object{'s' * (len(models) != 1)}: {MODELS}")
    for number, reason in reasons.items():
        print(f"  object {number} has no model: {reason}")
