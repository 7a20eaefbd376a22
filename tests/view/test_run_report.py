"""The report of a run: numbers of the tracks, plots, strips, models and escaping."""

from __future__ import annotations

import base64
import re
import zlib
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from helpers.page_reader import PageReader
from helpers.run_contents import FRAMES, START, make_run, make_tracks, pose, read_frame, read_known, times
from objectflow.tracking.model_files import ply_bytes
from objectflow.tracking.track import Track
from objectflow.view.colors import object_color
from objectflow.view.run_page.contents import net_motion, path_length, steps
from objectflow.view.run_page.model_blocks import MAX_VERTICES, PageMesh, read_mesh, simplify
from objectflow.view.run_page.strips import CROP_SIZE, MAX_CROPS, Sighting, choose, draw_crop, make_strips, sightings
from objectflow.view.run_page.track_plot import track_plot
from objectflow.view.run_report import write_run_report

NASTY = "</script><script>alert(1)</script><!-- <b>&amp; \"quoted\" 'name'"


class Shapes(HTMLParser):
    """Collects the elements of a plot."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str]]] = []
        self.titles: list[str] = []
        self.texts: list[str] = []
        self._tag = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._tag = tag
        self.found.append((tag, {name: value or "" for name, value in attrs}))

    def handle_data(self, data: str) -> None:
        (self.titles if self._tag == "title" else self.texts).append(data)

    def of(self, tag: str, kind: str) -> list[dict[str, str]]:
        return [values for name, values in self.found if name == tag and values.get("class") == kind]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> PageReader:
    folder = tmp_path_factory.mktemp("run")
    write_run_report(folder / "report.html", make_run(folder))
    return PageReader((folder / "report.html").read_text(encoding="utf-8"))


def words(text: str) -> np.ndarray[Any, np.dtype[np.int16]]:
    """Decode consecutive differences, low bytes before high bytes."""
    data = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    low, high = np.split(data.astype(np.int64), 2)
    return np.cumsum(low + 256 * high).astype(np.uint16).view(np.int16)


def test_steps_are_the_moving_ones() -> None:
    track = make_tracks()[0]
    found = steps(track)
    assert [(step.start - START, step.end - START) for step in found] == [(0, 0.5), (0.5, 1.0), (2.0, 2.5)]
    assert [step.shift for step in found] == pytest.approx([0.03, 0.03, 0.01])
    assert path_length(track) == pytest.approx(0.07)
    assert net_motion(track) == pytest.approx((0.05, 20.0))


def test_the_table_has_the_numbers_of_the_tracks(page: PageReader) -> None:
    assert page.rows["1"] == {
        "steps": "3",
        "gaps": "1",
        "from": "0.00 s",
        "to": "2.50 s",
        "path": "7.0",
        "displacement": "5.0",
        "rotation": "20",
        "confidence": "0.68",  # (0.9 + 0.8 + 1) / 4: the gap counts as 0
        "extent": "4.0 x 6.0 x 8.0",
        "residual": "1.2",
    }
    assert page.rows["2"]["displacement"] == "4.0"
    assert page.rows["2"]["extent"] == "–"


def test_a_plot_maps_positions_to_its_axes() -> None:
    shapes = Shapes(track_plot(make_tracks()[0], times(), True))
    x_dots = [(float(dot["cx"]), float(dot["cy"])) for dot in shapes.of("circle", "axis-x")]
    y_dots = [float(dot["cy"]) for dot in shapes.of("circle", "axis-y")]
    assert len(x_dots) == 5
    assert len(set(y_dots)) == 1  # y stays at 0
    centimetres = np.array([0, 3, 6, 6, 5])
    seconds = np.array([0, 0.5, 1.0, 2.0, 2.5])
    for values, places in ((centimetres, [v for _, v in x_dots]), (seconds, [u for u, _ in x_dots])):
        slope, start = np.polyfit(values, places, 1)
        np.testing.assert_allclose(start + slope * values, places, atol=0.1)
    # The tick labels name the places.
    labels = {
        float(values["y"]) - 4: text
        for (tag, values), text in zip([one for one in shapes.found if one[0] == "text"], shapes.texts, strict=True)
        if tag == "text" and values["text-anchor"] == "end"
    }
    assert labels[min(labels, key=lambda v: abs(v - y_dots[0]))] == "0"
    assert len(shapes.of("rect", "step")) == 3
    assert [round(float(line["x1"])) for line in shapes.of("line", "gap")] == [
        round(x_dots[0][0] + 1.5 / 2.5 * (x_dots[4][0] - x_dots[0][0]))
    ]
    assert "moves: 0.00 s to 0.50 s, 3.0 cm, score 0.90" in shapes.titles
    assert "gap: a motion of low score at 1.50 s" in shapes.titles


def test_a_plot_over_frame_numbers_has_no_seconds_and_no_negative_zero() -> None:
    track = Track(3, [2.0, 4.0], [pose(0.0), pose(-1e-9)], [0, 1], [0.5, 0.5])
    shapes = Shapes(track_plot(track, [0.0, 2.0, 4.0], False))
    assert "moves: frame 2 to frame 4, 0.0 cm, score 0.50" in shapes.titles
    assert "frame" in shapes.texts
    assert not any(text.startswith("-0") for text in shapes.texts if float_or_none(text) == 0)


def float_or_none(text: str) -> float | None:
    return float(text) if re.fullmatch(r"-?[\d.]+", text) else None


def test_strips_show_the_moving_frames_first(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    assert [one.frame for one in sightings(run)[1]] == [1, 2, 3, 4, 5]
    assert [one.frame for one in sightings(run)[2]] == [4, 5]
    strips = make_strips(run, [1, 2])
    assert [(crop.frame.number, crop.moves) for crop in strips[1]] == [
        (1, True),
        (2, True),
        (3, False),
        (4, False),
        (5, True),
    ]
    many = [Sighting(k, (0, 0, 9, 9)) for k in range(40)]
    moving = many[10:14]
    chosen = choose(many, moving)
    assert len(chosen) == MAX_CROPS
    assert set(moving) < set(chosen)
    assert chosen == sorted(chosen)
    assert choose(many, many) == [many[k] for k in (0, 6, 11, 17, 22, 28, 33, 39)]


def test_a_crop_shows_the_mask_in_the_colour_of_the_track() -> None:
    known = read_known("pair_000001_000002")
    frame = read_frame(2)
    picture = draw_crop(frame, known, 1, (18, 30, 38, 50), 64)
    assert picture.shape == (CROP_SIZE, CROP_SIZE, 3)
    # The mask's centre, pixel (40, 28), lies at the middle of the crop's rows but left of its middle column, since the
    # crop would leave the frame.
    window = np.ascontiguousarray(frame.color[8:72, 0:64])
    photo = cv2.resize(window, (CROP_SIZE, CROP_SIZE), interpolation=cv2.INTER_CUBIC)
    inside, outside = (80, 70), (80, 140)
    expected = photo[inside] + 0.28 * (np.array(object_color(1)) - photo[inside])
    np.testing.assert_allclose(picture[inside], expected, atol=1)
    np.testing.assert_array_equal(picture[outside], photo[outside])


def test_models_in_the_page_are_those_on_disk(page: PageReader) -> None:
    block = page.blocks["model-1"]
    vertices = words(block["vertices"]).view(np.uint16).reshape(3, -1).T * block["step"] + block["lower"]
    assert np.ptp(vertices, axis=0) == pytest.approx([0.04, 0.06, 0.08], abs=1e-4)
    faces = words(block["faces"]).view(np.uint16).reshape(3, -1).T
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(2 * (0.04 * 0.06 + 0.06 * 0.08 + 0.04 * 0.08), rel=1e-2)
    scene = page.blocks["scene-data"]
    assert scene["models"] == [1]
    assert scene["frames"] == list(range(FRAMES))
    first, second = scene["objects"]
    assert first["frames"] == [0, 1, 2, 4, 5]
    # Registered poses replace those of the track, and their correction holds for the later ones.
    assert [entry[3] for entry in first["poses"]] == pytest.approx([0, 0.031, 0.062, 0.062, 0.052])
    assert second["frames"] == [3, 4]
    points = words(scene["background"]["points"]).reshape(3, -1) * scene["background"]["step"]
    np.testing.assert_allclose(points[2], 1.0)
    assert np.ptp(points[0]) == pytest.approx(1.0, abs=1e-3)


def test_large_models_are_simplified_on_their_surface() -> None:
    angles = np.linspace(0, 2 * np.pi, 301)[:-1]
    heights = np.linspace(-0.1, 0.1, 200)
    turn, height = (grid.ravel() for grid in np.meshgrid(angles, heights))
    vertices = np.stack([0.05 * np.cos(turn), 0.05 * np.sin(turn), height], axis=1)
    grid = np.arange(len(vertices)).reshape(200, 300)
    right, below = np.roll(grid, -1, axis=1)[:-1], grid[1:]
    diagonal = np.roll(grid, -1, axis=1)[1:]
    faces = np.concatenate(
        [
            np.stack([grid[:-1], right, below], -1).reshape(-1, 3),
            np.stack([right, diagonal, below], -1).reshape(-1, 3),
        ]
    )
    mesh = simplify(PageMesh(vertices, np.full((len(vertices), 3), 77, np.uint8), faces), MAX_VERTICES)
    assert MAX_VERTICES / 4 < len(mesh.vertices) <= MAX_VERTICES
    assert (mesh.colors == 77).all()
    radius = np.linalg.norm(mesh.vertices[:, :2], axis=1)
    np.testing.assert_allclose(radius, 0.05, atol=0.0002)
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(2 * np.pi * 0.05 * 0.2, rel=0.03)


def test_a_mesh_is_read_as_it_was_written(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    colors = np.arange(21, dtype=np.uint8).reshape(7, 3)
    (tmp_path / "a.ply").write_bytes(ply_bytes(points, points, colors))
    found = read_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(found.vertices, points)
    np.testing.assert_array_equal(found.colors, colors)


def test_the_page_loads_nothing_and_links_only_into_its_folder(page: PageReader) -> None:
    outside = [address for address in page.addresses if not address.startswith(("#", "data:"))]
    assert set(outside) == {
        "trajectories/object_001.txt",
        "trajectories/object_002.txt",
        "models/object_001.ply",
        "models/object_001.glb",
    }


def test_texts_are_escaped(tmp_path: Path, page: PageReader) -> None:
    run = make_run(tmp_path / "nasty", title=NASTY, notes=(NASTY,))
    write_run_report(tmp_path / "report.html", replace(run, facts=(NASTY,)))
    reader = PageReader((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert reader.tags.count("script") == page.tags.count("script")
    assert reader.text.count(NASTY) == 4  # title, heading, fact, note


def test_the_same_run_gives_the_same_bytes(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    for name in ("a.html", "b.html"):
        write_run_report(tmp_path / name, run)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_the_objects_with_the_longest_paths_have_sections(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    write_run_report(tmp_path / "report.html", run, max_objects=1)
    reader = PageReader((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert set(reader.rows) == {"1", "2"}
    assert reader.blocks["report-data"] == {"tracks": [1]}
    assert "The 1 of 2 objects with the longest paths." in reader.text
    assert "#object-1" in reader.addresses
    assert "#object-2" not in reader.addresses


def test_a_track_lies_in_the_part_of_its_times(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    frames = [frame._replace(part=int(frame.number >= 3)) for frame in run.frames]
    later = Track(2, [START + 1.5, START + 2.0], [pose(0), pose(0.1)], [0, 1], [1, 1])
    assert replace(run, frames=frames, tracks=[later]).part_of(later) == 1
