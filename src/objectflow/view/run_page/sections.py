"""The HTML of a run's report: the table of tracks, the links to files, and a section for each object."""

from __future__ import annotations

import html
from collections.abc import Collection, Mapping, Sequence
from typing import Any
from urllib.parse import quote

from objectflow.tracking.model_files import INDEX, MODELS
from objectflow.tracking.track import Track
from objectflow.tracking.trajectory_files import TRACKS, TRAJECTORIES
from objectflow.view.colors import object_color
from objectflow.view.report_page.assemble import escape
from objectflow.view.run_page.contents import RunContents, net_motion, path_length, steps
from objectflow.view.run_page.model_blocks import frame_words
from objectflow.view.run_page.strips import Crop
from objectflow.view.run_page.track_plot import AXES, track_plot

RUN_FILES = ("summary.csv", TRACKS, "segmentation.png", "overlay.mp4", "notes.txt", "settings.json")
"""Files of a run that the page links to, if they exist."""
COLUMNS = (
    ("steps", "moving steps"),
    ("gaps", "gaps"),
    ("from", "moves from"),
    ("to", "to"),
    ("path", "path, cm"),
    ("displacement", "displacement, cm"),
    ("rotation", "rotation, °"),
    ("confidence", "confidence"),
    ("extent", "model, cm"),
    ("residual", "residual, mm"),
)


def track_table(run: RunContents, linked: Collection[int]) -> str:
    """A table with a row per track; the objects in `linked` have a section to go to."""
    if not run.tracks:
        return '<p class="empty">No object moved.</p>'
    heads = "".join(f'<th scope="col">{escape(heading)}</th>' for _, heading in COLUMNS)
    rows = "".join(_track_row(run, track, track.id in linked) for track in run.tracks)
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="Tracks"><table id="table-tracks">'
        f'<thead><tr><th scope="col">object</th>{heads}<th scope="col">files</th></tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def links_html(run: RunContents) -> str:
    """Links to the files of the run that exist."""
    names = [name for name in RUN_FILES if (run.folder / name).is_file()]
    if (run.folder / MODELS / INDEX).is_file():
        names.append(f"{MODELS}/{INDEX}")
    return " &middot; ".join(_link(name, name) for name in names)


def object_section(run: RunContents, track: Track, strip: Sequence[Crop]) -> str:
    """The strip, the plot and the 3D view of one object."""
    frames = run.part(run.part_of(track))
    name = f"Object {track.id}"
    moves = steps(track)
    shift, turn = net_motion(track)
    facts = (
        f"{_count(len(moves), 'moving step')}, path {_cm(path_length(track))} cm, displacement {_cm(shift)} cm, "
        f"rotation {turn:.0f}°, confidence {track.confidence:.2f}"
    )
    if track.gaps:
        facts += f", {_count(len(track.gaps), 'gap')}"
    pictures = "".join(_crop(run, crop, name, frames[0].time) for crop in strip)
    if not strip:
        pictures = '<p class="note">In no frame is its mask large enough to be shown.</p>'
    keys = "".join(f'<span><i class="line axis-{axis}"></i>{axis}</span>' for axis in AXES)
    keys += '<span><i class="band"></i>moving step</span>'
    if track.gaps:
        keys += '<span><i class="dash"></i>gap</span>'
    plot = track_plot(track, [frame.time for frame in frames], run.has_times)
    return (
        f'<article class="card object" id="object-{track.id}" aria-labelledby="object-{track.id}-title">'
        f'<div class="card-head"><h3 id="object-{track.id}-title">{_swatch(track.id)}{name}</h3>'
        f'<span class="note">{escape(facts)}</span></div>'
        f'<div class="strip" tabindex="0" role="group" aria-label="Frames of object {track.id}">{pictures}</div>'
        '<div class="object-body">'
        f'<figure class="track"><figcaption>Position since its first pose, cm</figcaption>{plot}'
        f'<div class="legend">{keys}</div></figure>'
        f"{_model(run.model(track.id), track.id)}</div></article>"
    )


def _track_row(run: RunContents, track: Track, linked: bool) -> str:
    moves = steps(track)
    shift, turn = net_motion(track)
    origin = run.part(run.part_of(track))[0].time if run.has_times else 0.0
    unit = " s" if run.has_times else ""
    digits = 2 if run.has_times else 0
    entry = run.model(track.id)
    cells = {
        "steps": str(len(moves)),
        "gaps": str(len(track.gaps)),
        "from": f"{moves[0].start - origin:.{digits}f}{unit}" if moves else "–",
        "to": f"{moves[-1].end - origin:.{digits}f}{unit}" if moves else "–",
        "path": _cm(path_length(track)),
        "displacement": _cm(shift),
        "rotation": f"{turn:.0f}",
        "confidence": f"{track.confidence:.2f}",
        "extent": _extent(entry) if entry else "–",
        "residual": f"{entry['residual_mm']:.1f}" if entry and entry["residual_mm"] is not None else "–",
    }
    links = [_link(f"{TRAJECTORIES}/object_{track.id:03d}.txt", "poses")]
    links += [_link(f"{MODELS}/{name}", name.rsplit(".", 1)[-1]) for name in (entry["files"] if entry else ())]
    title = f"object {track.id}"
    head = f'<a href="#object-{track.id}">{title}</a>' if linked else title
    body = "".join(f'<td data-column="{name}">{escape(cells[name])}</td>' for name, _ in COLUMNS)
    return (
        f'<tr data-track="{track.id}"><th scope="row">{_swatch(track.id)}{head}</th>{body}'
        f'<td class="files">{" ".join(links)}</td></tr>'
    )


def _crop(run: RunContents, crop: Crop, name: str, start: float) -> str:
    first = crop.frame._replace(time=start)
    words = frame_words(crop.frame, first, run.has_times)
    state = "moves" if crop.moves else "rests"
    image = f'<img src="{crop.uri}" width="160" height="160" decoding="async" alt="{escape(f"{name} in {words}")}">'
    overlay = f"{crop.frame.pair}/overlay.png"
    if (run.folder / overlay).is_file():
        image = f'<a href="{_address(overlay)}">{image}</a>'
    return f'<figure class="crop {state}">{image}<figcaption>{escape(words)}<b>{state}</b></figcaption></figure>'


def _model(entry: Mapping[str, Any] | None, number: int) -> str:
    if entry is None:
        return (
            '<figure class="model"><figcaption>Model</figcaption><p class="note">No model of this object.</p></figure>'
        )
    facts = (
        f"{_extent(entry)} cm, fused from {_count(len(entry['frames']), 'frame')}, "
        f"at most {100 * entry['seen_share_at_most']:.0f}% of the surface seen"
    )
    label = (
        f"3D view of the model of object {number}. Drag to rotate, wheel to zoom, right button or arrow keys to pan."
    )
    return (
        '<figure class="model"><figcaption>Model</figcaption>'
        f'<canvas class="view" data-model="{number}" tabindex="0" aria-label="{escape(label)}"></canvas>'
        f'<p class="note">{escape(facts)}</p></figure>'
    )


def _extent(entry: Mapping[str, Any]) -> str:
    return " x ".join(_cm(float(value)) for value in entry["extent"])


def _cm(metres: float) -> str:
    """Centimetres with one digit, without a negative zero."""
    return f"{round(100 * metres, 1) + 0.0:.1f}"


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'s' * (number != 1)}"


def _swatch(number: int) -> str:
    red, green, blue = object_color(number)
    return f'<i class="swatch" style="background:rgb({red} {green} {blue})"></i>'


def _link(path: str, words: str) -> str:
    return f'<a href="{_address(path)}">{escape(words)}</a>'


def _address(path: str) -> str:
    return html.escape(quote(path))
