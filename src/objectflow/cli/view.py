"""`objectflow view`: a result, a run or a data set in the rerun viewer."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from objectflow.cli.arguments import CameraArguments, open_location, open_two, option
from objectflow.cli.run_folder import (
    PAIR_NAME,
    model_files,
    open_run_source,
    read_known,
    read_model_index,
    read_tracks,
    registered_track,
    run_pairs,
)
from objectflow.errors import DatasetError, ReaderError, ResultError
from objectflow.motion import SceneMotion
from objectflow.readers import FrameSource
from objectflow.runtime.quiet import silence_stderr
from objectflow.storage.locked_folder import SETTINGS
from objectflow.tracking.trajectory_files import TRACKS
from objectflow.view.run_frames import RunFrames, UnfinishedRunFrames
from objectflow.view.viewer import open_viewer
from objectflow.view.viewer_frames import ViewerFrame, pair_frames

EXAMPLES = """\
  objectflow view result
  objectflow view result --frames PAIR_DIR
  objectflow view run_folder
  objectflow view run_folder/pair_000000_000001
  objectflow view data --key test-000012
  objectflow view data --key test-sequence-000003 --save sequence.rrd
  objectflow view run_folder --web
"""


@dataclass(frozen=True)
class View(CameraArguments):
    """Show frames, masks, motions and points in 3D and over time, in rerun's window, in a browser or as a file.

    PATH is a result of `objectflow estimate`, a folder of `objectflow run` or one pair in it, or a data set of
    `objectflow generate`.
    """

    path: Annotated[Positional[Path], option("RESULT_DIR | RUN_DIR | DATASET")]
    """What to show; its kind is detected."""

    frames: Annotated[tuple[Path, ...] | None, option("PAIR_DIR | COLOR0 DEPTH0 COLOR1 DEPTH1 | SOURCE")] = None
    """The frames of a result or the source of a run; needed only if they were moved since."""

    key: Annotated[str | None, option("KEY", "the first row")] = None
    """Key of a pair or name of a sequence in a data set."""

    save: Annotated[Path | None, option("FILE.rrd", "a window")] = None
    """Write a file instead of opening a window; `rerun FILE.rrd` opens it."""

    web: bool = False
    """Serve the web viewer instead of opening a window, until Ctrl-C."""

    def run(self) -> None:
        """Detect the kind, open the viewer, show."""
        with silence_stderr():
            make = self._find()
        window = self.save is None and not self.web
        name, models = self.path.resolve().name, bool(model_files(self.path))
        with open_viewer(name, window=window, save=self.save, web=self.web, models=models) as viewer:
            viewer.show(make)
            address = getattr(viewer, "address", None)
            if address is not None:
                print(f"open {address}\nCtrl-C stops", flush=True)
                with suppress(KeyboardInterrupt):
                    while True:
                        time.sleep(3600)
        if self.save is not None:
            print(f"written to {self.save}")

    def _find(self) -> Callable[[], Iterable[ViewerFrame]]:
        path = self.path
        if not path.is_dir():
            raise ResultError(f"{path}: {'not a folder' if path.exists() else 'no such folder'}")
        if (path / "manifest.json").is_file() or any(path.glob("*-of-*.parquet")):
            return self._rows()
        if self.key is not None:
            raise DatasetError(f"{path}: --key is for data sets only")
        pair = PAIR_NAME.fullmatch(path.resolve().name)
        if (path / "objects.json").is_file():
            if pair and self.frames is None and (path.resolve().parent / SETTINGS).is_file():
                return self._run(path.resolve().parent, (int(pair[1]), int(pair[2])))
            return self._pair()
        if (path / SETTINGS).is_file():
            return self._run(path)
        raise ResultError(
            f"{path}: nothing to view: expected a result (objects.json), a run (settings.json and pair folders) "
            "or a data set (manifest.json)"
        )

    def _pair(self) -> Callable[[], Iterable[ViewerFrame]]:
        motion = SceneMotion.load(self.path)
        if self.frames is not None:
            prev, curr = open_two(self.frames, self.camera_options())
        elif motion.frames:
            try:
                prev, curr = open_location(motion.frames)
            except ReaderError as error:
                raise ReaderError(f"{error}; add --frames if the frames were moved") from error
        else:
            raise ReaderError(
                f"{self.path}: the result was not made from files: add --frames with the pair folder or the four files"
            )
        return partial(pair_frames, prev, curr, motion)

    def _run(self, run: Path, only: tuple[int, int] | None = None) -> Callable[[], Iterable[ViewerFrame]]:
        """The frames of a run, or of one of its pairs."""
        pairs = run_pairs(run)
        source = self._source(run)
        if not (run / TRACKS).is_file():
            unfinished = UnfinishedRunFrames(source)
            return lambda: (
                frame
                for prev, curr, folder in pairs
                if only in (None, (prev, curr))
                for frame in unfinished.read(folder, prev, curr)
            )
        index = read_model_index(run)
        tracks = [registered_track(track, index) for track in read_tracks(run)]
        frames = RunFrames(source, tracks, read_known, model_files(run))

        def make() -> Iterator[ViewerFrame]:
            for prev, curr, folder in pairs:
                if only in (None, (prev, curr)):
                    yield from frames.read(folder, prev, curr)
                    if only is not None:
                        return
                else:
                    frames.skip(folder, prev, curr)

        return make

    def _source(self, run: Path) -> FrameSource:
        """Open the frames of a run with the run's settings."""
        if self.frames is not None and len(self.frames) != 1:
            raise ReaderError(f"--frames of a run must be one path, its source, not {len(self.frames)}")
        return open_run_source(run, None if self.frames is None else self.frames[0], "--frames")

    def _rows(self) -> Callable[[], Iterable[ViewerFrame]]:
        # pyarrow is slow to import, and only data sets need it.
        from objectflow.dataset.manifest import Manifest
        from objectflow.dataset.shards import open_pairs, open_sequences
        from objectflow.view.truth_frames import pair_row_frames, sequence_frames

        known = list[str]()
        for part in Manifest.read(self.path).parts.values():
            if part.rows == 0:
                continue
            if part.kind == "pairs":
                pairs = open_pairs(self.path, part.split)
                known += (keys := pairs.keys())
                key = self.key or keys[0]
                if key in keys:
                    return partial(pair_row_frames, pairs[keys.index(key)])
            else:
                frames = open_sequences(self.path, part.split)
                names = [name.split("/")[0] for name in frames.keys()]  # noqa: SIM118 - not a mapping
                known += dict.fromkeys(names)
                key = self.key or names[0]
                if key in names:
                    return partial(sequence_frames, [frames[i] for i, name in enumerate(names) if name == key])
        if not known:
            raise DatasetError(f"{self.path}: the data set is empty")
        raise DatasetError(f"{self.path}: no row {self.key!r}; rows: {known[0]} to {known[-1]}")
