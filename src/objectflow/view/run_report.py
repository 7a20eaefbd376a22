"""`report.html` of a run: each object's frames, trajectory and model, as one self-contained file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from objectflow import __version__
from objectflow.storage import files
from objectflow.tracking.track import Track
from objectflow.view.known import draw_known
from objectflow.view.report_page.assemble import assemble, escape, json_block
from objectflow.view.report_page.packing import pack_photo
from objectflow.view.run_page.contents import RunContents, path_length
from objectflow.view.run_page.model_blocks import model_block, scene_block
from objectflow.view.run_page.sections import links_html, object_section, track_table
from objectflow.view.run_page.strips import make_strips

MAX_OBJECTS = 60
"""Largest number of objects with a section of their own: those with the longest paths. The table lists all."""
LAST_WIDTH = 640
"""Largest width of the picture of the last frame, pixels."""
SCRIPTS = ("data.js", "theme.js", "run_models.js", "run_main.js")


def write_run_report(path: Path, run: RunContents, *, max_objects: int = MAX_OBJECTS) -> None:
    """Write the report as one self-contained file, atomically; the same run gives the same bytes.

    Args:
        path: of the HTML file, in the folder of the run.
        run: the run.
        max_objects: largest number of objects with a strip, a plot and a model.

    Raises:
        MissingExtraError: the run has models, but trimesh is not installed.
        ResultError: a file of the run is damaged.
        ReaderError: a frame cannot be read.
        StorageError: the file cannot be written.
    """
    shown = _longest(run.tracks, max_objects)
    strips = make_strips(run, [track.id for track in shown])
    entries = {track.id: entry for track in shown if (entry := run.model(track.id)) is not None}
    blocks = [json_block("report-data", {"tracks": [track.id for track in shown]})]
    blocks += [
        json_block(f"model-{track.id}", model_block(run, track, entries[track.id]))
        for track in shown
        if track.id in entries
    ]
    part = _main_part(run)
    scene = scene_block(run, part, [number for number in entries if run.part_of(_track(run, number)) == part])
    blocks.append(json_block("scene-data", scene))
    page = assemble(
        {
            "title": escape(f"objectflow run: {run.title}"),
            "facts": " &middot; ".join(escape(fact) for fact in run.facts),
            "last": _last_picture(run),
            "table": track_table(run, {track.id for track in shown}),
            "links": links_html(run),
            "objects": "\n".join(object_section(run, track, strips[track.id]) for track in shown),
            "objects_note": escape(_objects_note(run, shown)),
            "scene_note": escape(_scene_note(run, part)),
            "notes": "".join(f"<li>{escape(note)}</li>" for note in run.notes),
            "footer": escape(f"Written by objectflow {__version__}. 3D views: three.js (MIT licence)."),
            "data": "\n".join(blocks),
        },
        template="run.html",
        scripts=SCRIPTS,
        styles=("page.css", "run.css"),
    )
    files.write_text(path, page)


def _longest(tracks: Sequence[Track], count: int) -> list[Track]:
    """The tracks with the longest paths, in order of id."""
    ranked = sorted(tracks, key=lambda track: (-path_length(track), track.id))
    return sorted(ranked[:count], key=lambda track: track.id)


def _track(run: RunContents, number: int) -> Track:
    return next(track for track in run.tracks if track.id == number)


def _main_part(run: RunContents) -> int:
    """The part with most frames, in which the background lies."""
    counts = Counter(frame.part for frame in run.frames)
    return min(counts, key=lambda part: (-counts[part], part))


def _last_picture(run: RunContents) -> str:
    """The known objects in the last frame, as an image element."""
    last = run.frames[-1]
    if not last.pair:
        return ""
    picture = draw_known(run.read_frame(last.number), run.read_known(last.pair))
    height, width = picture.shape[:2]
    if width > LAST_WIDTH:
        size = (LAST_WIDTH, max(1, round(height * LAST_WIDTH / width)))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    height, width = picture.shape[:2]
    alternative = f"known objects in frame {last.number}"
    return f'<img src="{pack_photo(picture)}" width="{width}" height="{height}" alt="{escape(alternative)}">'


def _objects_note(run: RunContents, shown: Sequence[Track]) -> str:
    if not run.tracks:
        return "No object moved."
    if len(shown) == len(run.tracks):
        return f"All {len(shown)} objects." if len(shown) > 1 else "One object."
    return f"The {len(shown)} of {len(run.tracks)} objects with the longest paths."


def _scene_note(run: RunContents, part: int) -> str:
    frames = run.part(part)
    words = "The world is the camera of the first frame: x right, y down, z forward, metres."
    if run.frames[-1].part:
        words = (
            f"The run has {run.frames[-1].part + 1} worlds, as the camera was lost or the sequence was cut; this is "
            f"the longest, frames {frames[0].number} to {frames[-1].number}. {words}"
        )
    if not run.models:
        words += " Models are added by `objectflow run --models` or `objectflow reconstruct`, followed by this report."
    return words
