"""`objectflow run`: every consecutive pair of a sequence; the same command continues an interrupted run."""

from __future__ import annotations

import itertools
import json
import statistics
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.console import Console
from rich.table import Table
from tyro.conf import Positional

from objectflow import __version__
from objectflow.cli.arguments import MethodArguments, ResultArguments, SourceArguments, ViewArguments, option
from objectflow.cli.findings import warn_of
from objectflow.cli.output import (
    OUTPUT_ROOT,
    Export,
    check_not_below_a_file,
    link_latest,
    print_written,
    write_result,
)
from objectflow.cli.progress import show_progress
from objectflow.cli.reconstruct import write_run_models
from objectflow.cli.run_estimates import estimate_pairs, read_pairs
from objectflow.cli.run_folder import KNOWN, NOTES, RUN_FOLDER, read_longer, write_known, write_longer
from objectflow.cli.run_pairs import ReadablePairs, select_frames
from objectflow.cli.run_report import REPORT, write_report_page
from objectflow.errors import FrameError, ReaderError, ResultError
from objectflow.methods.base import Estimator
from objectflow.motion import SceneMotion
from objectflow.readers import CutOffWarning, FrameSource
from objectflow.readers.read_ahead import ReadAhead
from objectflow.runtime.make_pool import check_workers
from objectflow.runtime.ordered_thread import OrderedThread
from objectflow.runtime.quiet import silence_stderr
from objectflow.settings import Settings, flat
from objectflow.storage import files
from objectflow.storage.files import hash_file
from objectflow.storage.images import encode_png
from objectflow.storage.locked_folder import locked_folder
from objectflow.tracking.sequence_estimator import SequenceStep
from objectflow.tracking.trajectory_files import TRACKS, TRAJECTORIES, write_tracks
from objectflow.tracking.volume_meshing import check_extra
from objectflow.typing import LabelImage
from objectflow.view.known import draw_known
from objectflow.view.overlay import TrackMarks
from objectflow.view.run_tracks import RunTracks
from objectflow.view.video import write_video

EXAMPLES = """\
  objectflow run rgbd_dataset_freiburg1_desk --camera-file fr1
  objectflow run recording --every 5 --camera moving --out result
  objectflow run recording --intrinsics 615,615,320,240 --depth-scale 1000
  objectflow run table.bag --dt 0.5
  objectflow run table.bag --dt 0.5 --view
  objectflow run table.bag --dt 0.5 --video
  objectflow run table.bag --dt 0.5 --models --report
  objectflow run table.mcap --color-topic /camera/color/image_raw --depth-topic /camera/depth_registered/image
"""

SUMMARY = "summary.csv"
VIDEO = "overlay.mp4"
SEGMENTATION = "segmentation.png"
"""Picture of all known objects in the last frame."""
MAX_TABLE_ROWS = 40
"""Maximum number of rows that are printed; a longer table shows only pairs with motion."""
MAX_NEW_WORLDS = 5
"""Maximum number of printed frames at which a new world starts."""
MAX_LEFT_OUT_LINES = 5
"""Maximum number of frames left out that are printed, one line each."""


@dataclass(frozen=True)
class Run(ViewArguments, ResultArguments, SourceArguments, MethodArguments):
    """Estimate every consecutive pair of a sequence: a result folder per pair, a table, and a trajectory per object.

    Objects that have moved once stay known: known.png of each pair holds the masks of all of them, also at rest, and
    segmentation.png shows those of the last frame.

    The source is a pair folder, a TUM RGB-D directory (rgb.txt, depth.txt), a folder of numbered frames
    (color/0001.png + depth/0001.png, or color_0001.png + depth_0001.png), or a ROS 1 bag, a ROS 2 bag or an MCAP file.
    Finished pairs are skipped. Frames that cannot be read are left out and named at the end.
    """

    source: Annotated[Positional[Path], option("SOURCE")]
    """The sequence; its kind is detected."""

    every: int = 1
    """Take every N-th frame."""

    dt: Annotated[float | None, option("SECONDS", "every frame")] = None
    """Take a frame every SECONDS instead; objects must have moved between two frames."""

    video: bool = False
    """Also write overlay.mp4, the overlays of all pairs."""

    models: bool = False
    """Also write models, the shapes of the objects and of the background (extra `models`)."""

    report: bool = False
    """Also write report.html, a page with each object's frames, trajectory and model."""

    workers: int = 1
    """Number of pairs that are estimated side by side, for recordings of twenty pairs or more; their objects are then
    linked in order."""

    ray: Annotated[str | None, option("ADDRESS", "this machine")] = None
    """Address of a Ray cluster ("auto", "host:6379"), or "local"; --workers is then the number of actors."""

    start: int = 0
    """First frame; the first one of the source is 0."""

    stop: Annotated[int | None, option("N", "the end")] = None
    """Frame before which to stop."""

    limit: Annotated[int | None, option("N", "all")] = None
    """Largest number of pairs."""

    def run(self) -> None:
        """Read, estimate and write, pair by pair."""
        self.check_method()
        check_workers(self.workers)
        if self.video and not self.pictures:
            raise ReaderError("--video is made of the pictures: leave out --no-pictures")
        if self.models:
            check_extra()
        out = self.out or OUTPUT_ROOT / self.source.resolve().name
        with silence_stderr(), warnings.catch_warnings():
            warnings.simplefilter("ignore", CutOffWarning)  # the notes say the same
            source = self.open_path(self.source)
            parts = self._select(source)
        with ReadAhead(source, [index for part in parts for index in part]) as sequence:
            pairs = ReadablePairs(sequence, parts, is_done=lambda prev, curr: (out / _name((prev, curr))).is_dir())
            count = sum(max(0, len(part) - 1) for part in parts)
            todo = itertools.islice(pairs, count if self.limit is None else self.limit)
            # The first pair is read before the output folder is created.
            with silence_stderr():
                first = next(todo, None)
            if first is None:
                raise next(iter(pairs.left_out.values()), None) or ReaderError(f"{self.source}: no pair of frames")
            for note in source.notes:
                print(f"note: {note}")
            # A wrong path is reported before the method, which is slow to load.
            estimator = self.estimator()
            with self.viewer(self.source.stem) as viewer, _opened(out, self._settings(sequence, estimator)):
                if self.out is None:
                    link_latest(out)
                finished: list[tuple[int, int]] = []
                folders: dict[int, Path] = {}
                skipped = 0
                step: SequenceStep | None = None
                is_first = True
                tracks = RunTracks(sequence, parts, estimator)
                numbers = itertools.chain([first], todo)
                read = read_pairs(numbers, pairs, lambda prev, curr: (out / _name((prev, curr))).is_dir())
                with (
                    show_progress("pairs", count if self.limit is None else min(count, self.limit)) as advance,
                    closing(estimate_pairs(read, estimator, self.workers, self.ray)) as estimates,
                    OrderedThread() as writer,
                ):
                    for prev_index, curr_index, prev, curr, motion in estimates:
                        result = out / _name((prev_index, curr_index))
                        if prev is None or curr is None:
                            skipped += 1
                            stored = SceneMotion.load(result)
                            longer = read_longer(result)
                            step, _ = tracks.add(prev_index, curr_index, sequence[curr_index], stored, longer)
                        else:
                            if is_first:
                                warn_of(prev, curr)
                            is_first = False
                            step, marks = tracks.add(prev_index, curr_index, curr, motion)
                            # Files and pictures are made in another thread while the next pair is estimated.
                            older = None if step.longer is None else tracks.index_at(step.longer.prev_time)
                            writer.submit(partial(_write_step, result, step, marks, older, self.pictures, self.export))
                        finished.append((prev_index, curr_index))
                        folders[curr_index] = result
                        _complete_masks(folders, tracks.final_masks(), writer)
                        advance()
                        viewer.show(partial(tracks.frames, step, prev_index, curr_index))
                    _complete_masks(folders, tracks.final_masks(is_last=True), writer)
                write_tracks(out, tracks.sequence.tracker)
                followed = len(tracks.sequence.tracks)
                if self.pictures and step is not None:
                    files.write_bytes(out / SEGMENTATION, encode_png(draw_known(step.curr, step.known)))
                if self.video:
                    overlays = [out / _name(pair) / "overlay.png" for pair in finished]
                    write_video(out / VIDEO, overlays, tracks.frame_rate)
                worlds = _summarise(out, finished, skipped=skipped)
                _report(out, (*source.notes, *worlds), pairs.left_out)
                if followed:
                    print(f"{followed} object{'s' * (followed != 1)} followed: {TRACKS}, {TRAJECTORIES}")
                if self.models:
                    write_run_models(out, sequence)
                if self.report:
                    write_report_page(out, sequence)
        print_written(out, f", report {out / REPORT}" if self.report else "")

    def _select(self, sequence: FrameSource) -> list[list[int]]:
        """The selected frames of each part of the sequence."""
        if self.every < 1 or (self.dt is not None and not self.dt > 0):
            raise ReaderError("--every must be at least 1 and --dt above 0")
        if self.dt is not None and self.every > 1:
            raise ReaderError("both --every and --dt are given: leave one out")
        if self.start < 0 or (self.stop is not None and self.stop < 1) or (self.limit is not None and self.limit < 1):
            raise ReaderError("--start must be at least 0, --stop and --limit at least 1")
        if self.dt is not None and any(sequence.timestamp(index) is None for index in range(len(sequence))):
            raise ReaderError(f"{self.source} has no times: use --every instead of --dt")
        parts = select_frames(sequence, self.every, self.dt, self.start, self.stop)
        if all(len(part) < 2 for part in parts):
            taken = f"every {self.every} taken" if self.dt is None else f"one every {self.dt:g} s taken"
            if self.start or self.stop is not None:
                taken += f" from --start {self.start}" + (f" to --stop {self.stop}" if self.stop is not None else "")
            raise ReaderError(
                f"{self.source}: {len(sequence)} frame{'s' * (len(sequence) != 1)}, {taken}: a pair needs two"
            )
        return parts

    def _settings(self, sequence: FrameSource, estimator: Estimator) -> dict[str, Any]:
        """Everything that the results depend on."""
        weights = getattr(estimator, "weights", None)
        return {
            "source": str(self.source.resolve()),
            "every": self.every,
            "dt": self.dt,
            "start": self.start,
            "topics": [self.color_topic, self.depth_topic],
            "method": self.method,
            "camera": self.camera,
            "intrinsics": sequence.camera.to_dict(),
            "depth_scale": sequence.depth_scale,
            "options": self.camera_options().to_dict(),
            "rigid": self.rigid,
            "weights_sha256": None if weights is None else hash_file(Path(weights)),
            "version": __version__,
            "settings": _method_settings(estimator),
        }


def _write_step(
    result: Path,
    step: SequenceStep,
    marks: TrackMarks,
    older: int | None,
    pictures: bool,
    exports: Collection[Export],
) -> None:
    """Write the folder of a pair, whole or not at all."""
    with files.new_folder(result) as folder:
        write_result(folder, step.curr, step.motion, tracks=marks, pictures=pictures, exports=exports)
        (folder / KNOWN).write_bytes(encode_png(step.known.astype(np.uint16)))
        if step.longer is not None and older is not None:
            write_longer(folder, older, step.longer.motion)


def _complete_masks(
    folders: Mapping[int, Path], masks: Iterable[tuple[int, LabelImage]], writer: OrderedThread
) -> None:
    """Write the masks of objects that were found later, into the folders of the pairs that end with these frames."""
    for index, known in masks:
        if index in folders:  # no pair ends with the first frame of a part
            writer.submit(partial(write_known, folders[index], known))


@contextmanager
def _opened(out: Path, settings: dict[str, Any]) -> Iterator[None]:
    """Create the output folder, or continue an earlier run with the same settings; see `locked_folder`."""
    check_not_below_a_file(out)
    if out.exists() and not out.is_dir():
        raise ResultError(f"{out} is a file, not a folder: name another output folder")

    def check(earlier: dict[str, Any]) -> None:
        for name, value in settings.items():
            if name == "settings" and isinstance(earlier.get(name), dict):
                before, now = flat(earlier[name]), flat(value)
                for path in sorted({*before, *now}):
                    compare(path, before.get(path), now.get(path))
            else:
                compare(name, earlier.get(name), value)

    def compare(name: str, before: Any, now: Any) -> None:
        if before != now:
            raise ResultError(f"{out} was made with {name} = {before}, now it is {now}: name another output folder")

    with locked_folder(out, settings, RUN_FOLDER, check=check):
        yield


def _method_settings(estimator: Estimator) -> dict[str, Any]:
    """The settings of a method on which results depend, as JSON; weights are recorded by their hash."""
    found = estimator.to_dict() if isinstance(estimator, Settings) else {}
    kept: dict[str, Any] = json.loads(json.dumps(found, default=str))
    return {name: value for name, value in kept.items() if name not in ("weights", "device", "explain")}


def _name(pair: tuple[int, int]) -> str:
    return f"pair_{pair[0]:06d}_{pair[1]:06d}"


def _summarise(out: Path, pairs: list[tuple[int, int]], skipped: int) -> list[str]:
    """Write and print one line per pair, read back from the results, so that a continued run prints the same.

    Returns:
        A line for each frame at which a new world starts.
    """
    columns = ("prev", "curr", "objects", "moving", "largest displacement, cm", "camera, cm", "time, s")
    rows = [_row(pair, SceneMotion.load(out / _name(pair))) for pair in pairs]
    lines = [",".join(name.replace(",", "").replace(" ", "_") for name in columns)] + [",".join(row) for row in rows]
    files.write_text(out / SUMMARY, "\n".join(lines) + "\n")
    shown = rows if len(rows) <= MAX_TABLE_ROWS else [row for row in rows if row[3] != "0"][:MAX_TABLE_ROWS]
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in columns:
        table.add_column(name, justify="right")
    for row in shown:
        table.add_row(*row)
    console = Console(highlight=False)
    console.print(table)
    if len(shown) < len(rows):
        console.print(f"({len(rows) - len(shown)} more rows in {out / SUMMARY})")
    moving = sum(row[3] != "0" for row in rows)
    seconds = statistics.median(float(row[6]) for row in rows)
    again = f", {skipped} of them done before" if skipped else ""
    console.print(f"{len(rows)} pairs{again}; something moved in {moving}; median {seconds:.2f} s a pair")
    lost = [pair for pair, row in zip(pairs, rows, strict=True) if row[5] == "unknown"]
    if lost:
        frames = ", ".join(str(curr) for _, curr in lost[:MAX_NEW_WORLDS]) + ", ..." * (len(lost) > MAX_NEW_WORLDS)
        console.print(
            f"note: the camera's motion is unknown in {len(lost)}, so no object is reported there; "
            f"a new world starts at frame{'s' * (len(lost) != 1)} {frames}"
        )
    return [
        f"frame {curr}: a new world starts, as the camera's motion from frame {prev} is unknown" for prev, curr in lost
    ]


def _report(out: Path, notes: tuple[str, ...], left_out: dict[int, ReaderError | FrameError]) -> None:
    """Print the frames that were left out, and write them with the notes on the source to `notes.txt`, if any."""
    lines = [f"frame {index} left out: {' '.join(str(error).split())}" for index, error in left_out.items()]
    if notes or lines:
        files.write_text(out / NOTES, "\n".join([*notes, *lines]) + "\n")
    if lines:
        print(f"{len(lines)} frame{'s' * (len(lines) != 1)} left out, which could not be used:")
        print("\n".join(f"  {line}" for line in lines[:MAX_LEFT_OUT_LINES]))
        if len(lines) > MAX_LEFT_OUT_LINES:
            print(f"  ({len(lines) - MAX_LEFT_OUT_LINES} more in {out / NOTES})")


def _row(pair: tuple[int, int], motion: SceneMotion) -> tuple[str, ...]:
    moving = [obj for obj in motion.objects if obj.moving]
    largest = 100 * max((obj.displacement for obj in moving), default=0.0)
    camera = 100 * motion.camera_displacement
    return (
        str(pair[0]),
        str(pair[1]),
        str(len(motion.objects)),
        str(len(moving)),
        f"{largest:.1f}",
        "unknown" if motion.camera == "unknown" else f"{camera:.1f}",
        f"{motion.seconds:.2f}",
    )
