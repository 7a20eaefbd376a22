"""The report page of a finished run, made from the files of its folder and its frames."""

from __future__ import annotations

from pathlib import Path

from objectflow.cli.run_folder import NOTES, read_known, read_model_index, read_settings, read_tracks, run_pairs
from objectflow.errors import ResultError
from objectflow.motion import SceneMotion
from objectflow.readers import FrameSource
from objectflow.view.run_page.contents import ReportFrame, RunContents
from objectflow.view.run_report import write_run_report

REPORT = "report.html"


def write_report_page(run: Path, source: FrameSource) -> None:
    """Write `report.html` of a finished run.

    Args:
        run: its folder.
        source: its frames.

    Raises:
        MissingExtraError: the run has models, but the extra `models` is not installed.
        ResultError: the run is damaged or not finished.
        ReaderError: a frame cannot be read.
        StorageError: the file cannot be written.
    """
    tracks = read_tracks(run)
    settings = read_settings(run)
    frames, moved = _frames(run, source)
    pairs = sum(frame.pair != "" for frame in frames)
    followed = len(tracks)
    facts = (
        f"{len(frames)} frames, {pairs} pair{'s' * (pairs != 1)}, something moved in {moved}",
        f"{followed} object{'s' * (followed != 1)} followed",
        f"method {settings.get('method')}, camera {settings.get('camera')}",
        f"{source.camera.width}x{source.camera.height}",
        f"objectflow {settings.get('version')}",
    )
    notes = (run / NOTES).read_text(encoding="utf-8").splitlines() if (run / NOTES).is_file() else []
    contents = RunContents(
        folder=run,
        title=Path(str(settings.get("source"))).name,
        facts=facts,
        notes=notes,
        frames=frames,
        tracks=tracks,
        has_times=all(source.timestamp(frame.number) is not None for frame in frames),
        read_frame=lambda number: source[number],
        read_known=lambda pair: read_known(run / pair),
        models=read_model_index(run),
    )
    write_run_report(run / REPORT, contents)


def _frames(run: Path, source: FrameSource) -> tuple[list[ReportFrame], int]:
    """All frames of a run in order, and the number of pairs in which something moved."""
    pairs = run_pairs(run)
    numbers = sorted({index for prev, curr, _ in pairs for index in (prev, curr)})
    if numbers[-1] >= len(source):
        raise ResultError(f"{run}: its source has only {len(source)} frames now: the source has changed")
    times = {index: source.timestamp(index) for index in numbers}
    known = {index: time for index, time in times.items() if time is not None}
    if len(known) < len(times):
        known = {index: float(index) for index in times}
    frames: list[ReportFrame] = []
    part, moved = -1, 0
    for prev, curr, folder in pairs:
        motion = SceneMotion.load(folder)
        moved += any(obj.moving for obj in motion.objects)
        if not motion.camera_known:
            # A new world starts at the current frame.
            if not frames or frames[-1].number != prev:
                part += 1
                frames.append(ReportFrame(prev, known[prev], part))
            part += 1
            frames.append(ReportFrame(curr, known[curr], part, folder.name))
            continue
        if not frames or frames[-1].number != prev:
            part += 1
            frames.append(ReportFrame(prev, known[prev], part))
        frames.append(ReportFrame(curr, known[curr], part, folder.name))
    return frames, moved
