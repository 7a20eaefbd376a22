"""`objectflow live`: track objects live, from a camera or a recording."""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import Positional

from objectflow.cli.arguments import MethodArguments, SourceArguments, ViewArguments, option
from objectflow.cli.output import check_not_below_a_file
from objectflow.errors import ReaderError
from objectflow.frame import RgbdFrame
from objectflow.live import NewestFrame, Step, follow, replay
from objectflow.readers.camera_driver import StreamRequest, read_camera
from objectflow.readers.camera_registry import CAMERAS, make_driver, suggestion
from objectflow.runtime.quiet import silence_stderr
from objectflow.storage import files
from objectflow.storage.temporaries import sweep
from objectflow.tracking.tracker import Tracker
from objectflow.tracking.tracker_settings import TrackerSettings
from objectflow.tracking.trajectory_files import write_tracks
from objectflow.view.viewer_frames import tracked_frames

EXAMPLES = """\
  objectflow live realsense
  objectflow live realsense --view
  objectflow live orbbec --size 1280 720 --rate 30
  objectflow live oak --serial 14442C1051B665D700
  objectflow live realsense:recorded.bag
  objectflow live realsense --min-gap 0.5 --seconds 60 --out session
  objectflow live table.bag --method consensus
  objectflow live rgbd_dataset_freiburg1_desk --camera-file fr1 --speed 0.5
"""

REALSENSE = "realsense"
"""The camera whose own recordings are read."""
KEPT_FRAMES = 12
"""Number of frames, `--min-gap` apart, in which known objects are followed after an estimate; 25 MB at 640x480."""
HISTORY = 100_000
"""Number of poses kept per object for `--out`: one hour at the rate of the fastest method."""


@dataclass(frozen=True)
class Live(ViewArguments, SourceArguments, MethodArguments):
    """Track objects on the newest frames; frames that arrive during an estimate are dropped.

    Prints one line per estimate with the objects' ids, speeds and rotation rates, and the known objects at rest.
    Ctrl-C stops. With --out, trajectories are written at the end.
    """

    source: Annotated[Positional[str], option(f"{' | '.join(CAMERAS)} | {REALSENSE}:FILE | SOURCE")]
    """A camera (RealSense, Orbbec or OAK-D), a recording of RealSense's driver (.bag, .db3), or any source of
    `objectflow run`; recordings are played in real time."""

    serial: Annotated[str | None, option("TEXT", "any connected camera of the kind")] = None
    """Serial number of the camera."""

    size: Annotated[tuple[int, int] | None, option("WIDTH HEIGHT", "the driver's")] = None
    """Size of the colour image of a camera, pixels."""

    rate: Annotated[int | None, option("HZ", "the driver's")] = None
    """Frames per second of a camera."""

    min_gap: float = 0.2
    """Smallest time between two compared frames, seconds, so that slow objects move measurably."""

    every_pair: bool = False
    """Estimate every pair. Otherwise, pairs in which the known objects explain every change are not estimated; their
    motion comes from the models of these objects, in a fraction of the time."""

    speed: float = 1.0
    """Playback speed of a recording; 2 is twice as fast."""

    loop: bool = False
    """Restart a recording at its end."""

    seconds: Annotated[float | None, option("S", "until the source ends")] = None
    """Stop after this time of the source, seconds."""

    def run(self) -> None:
        """Open, track, print."""
        if not self.speed > 0 or not self.min_gap >= 0 or (self.seconds is not None and not self.seconds > 0):
            raise ReaderError("--speed and --seconds must be above 0, --min-gap at least 0")
        if self.out is not None:
            check_not_below_a_file(self.out)
            sweep(self.out.parent)
        estimator = self.estimator()
        tracker = Tracker(TrackerSettings(history=2 if self.out is None else HISTORY))
        steps: list[tuple[float, float, int]] = []
        with silence_stderr():
            source = self._open()
        number = 0
        newest_frame = NewestFrame(source, keep=KEPT_FRAMES, spacing=self.min_gap)
        with self.viewer(Path(self.source).stem) as viewer, newest_frame as newest, suppress(KeyboardInterrupt):
            start: float | None = None
            skip = not self.every_pair
            for step in follow(newest, estimator, tracker, min_gap=self.min_gap, skip_explained=skip):
                start = step.times[0] if start is None else start
                print(step_line(step), flush=True)
                numbers = (number, number := number + step.dropped + 1)
                seconds = (step.times[0] - start, step.times[1] - start)
                frames = (step.prev, step.curr)
                viewer.show(
                    partial(tracked_frames, tracker, step.tracks, frames, step.motion, numbers, seconds, step.known)
                )
                steps = [*steps[-999:], (step.latency, step.times[1] - step.times[0], step.dropped)]
                if self.seconds is not None and step.times[1] - start >= self.seconds:
                    break
        if not steps:
            raise ReaderError(f"{self.source}: no two frames at least {self.min_gap:g} s apart")
        latency, gap = (statistics.median(values) for values in zip(*[(a, b) for a, b, _ in steps], strict=True))
        dropped = sum(count for _, _, count in steps)
        print(
            f"{len(steps)} estimates, median latency {latency:.2f} s, interval {gap:.2f} s; {dropped} frames dropped"
        )
        if self.out is not None:
            with files.new_folder(self.out) as folder:
                write_tracks(folder, tracker)
            print(f"{len(tracker.tracks)} objects followed, written to {self.out}")

    def _open(self) -> Iterable[RgbdFrame]:
        kind, _, recording = self.source.partition(":")
        if kind in CAMERAS and not recording:
            return read_camera(make_driver(kind), StreamRequest(self.serial, self.size, self.rate, self.max_depth))
        if (self.serial, self.size, self.rate) != (None, None, None):
            raise ReaderError(f"--serial, --size and --rate are for cameras ({', '.join(CAMERAS)})")
        if kind == REALSENSE:
            from objectflow.readers.realsense import read_realsense

            return read_realsense(Path(recording), real_time=True)
        if kind in CAMERAS:
            raise ReaderError(f"{self.source}: only recordings of {REALSENSE} can be played: record a bag instead")
        path, hint = Path(self.source), suggestion(kind)
        if hint and not path.exists():
            raise ReaderError(
                f"{self.source}: no such folder, recording or camera: {hint}cameras: {', '.join(CAMERAS)}"
            )
        return replay(self.open_path(path), speed=self.speed, loop=self.loop)


def step_line(step: Step) -> str:
    """Format an estimate as one line: the time, and each object's id, speed and rotation rate."""
    seconds = step.times[1] - step.times[0]
    parts = []
    for obj in step.motion.objects:
        if obj.id in step.tracks:
            speed, rate = 100 * obj.displacement / seconds, obj.rotation_deg / seconds
            parts.append(f"#{step.tracks[obj.id]} {speed:.1f} cm/s {rate:.0f} deg/s")
    objects = ", ".join(parts) or ("camera unknown" if step.motion.camera == "unknown" else "no motion")
    shown = [] if step.known is None else np.unique(step.known).tolist()
    resting = sorted(set(shown) - {0} - set(step.tracks.values()))
    if resting:
        objects += "; at rest: " + ", ".join(f"#{number}" for number in resting)
    return f"{step.times[1]:.2f} s  (latency {step.latency:.2f} s, {step.dropped} dropped)  {objects}"
