"""Pair folders and four files."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from objectflow.errors import CameraError, ObjectflowError, ReaderError
from objectflow.readers import CameraOptions, open_files, open_pair, open_source

CAMERA = {"width": 32, "height": 24, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5}


def write_pair(folder: Path, *, suffix: str = ".png", scale: float | None = 2000) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for index in (0, 1):
        color = np.full((24, 32, 3), (10, 20, 200 + index), np.uint8)  # OpenCV writes BGR: red is 200 + index
        cv2.imwrite(str(folder / f"color{index}{suffix}"), color)
        cv2.imwrite(str(folder / f"depth{index}.png"), np.full((24, 32), 1500 + index, np.uint16))
    values = CAMERA if scale is None else {**CAMERA, "depth_scale": scale}
    (folder / "camera.json").write_text(json.dumps(values))


def test_reads_both_frames_in_metres_and_rgb(tmp_path: Path) -> None:
    write_pair(tmp_path)
    prev, curr = open_pair(tmp_path)
    assert prev.color[0, 0].tolist() == [200, 20, 10]
    assert curr.color[0, 0].tolist() == [201, 20, 10]
    np.testing.assert_allclose(prev.depth, 0.75, rtol=1e-6)
    np.testing.assert_allclose(curr.depth, 0.7505, rtol=1e-6)
    assert (curr.camera.fx, curr.camera.fy, curr.camera.width) == (30.0, 31.0, 32)


def test_jpeg_colour_and_default_scale(tmp_path: Path) -> None:
    write_pair(tmp_path, suffix=".jpg", scale=None)
    sequence = open_source(tmp_path)
    assert len(sequence) == 2
    np.testing.assert_allclose(sequence[0].depth, 1.5, rtol=1e-6)


def test_the_callers_depth_scale_overrides_the_file(tmp_path: Path) -> None:
    write_pair(tmp_path)
    sequence = open_pair(tmp_path, CameraOptions(depth_scale=500))
    np.testing.assert_allclose(sequence[0].depth, 3.0, rtol=1e-6)


def test_four_files_with_intrinsics(tmp_path: Path) -> None:
    write_pair(tmp_path)
    (tmp_path / "camera.json").unlink()
    files = [tmp_path / name for name in ("color0.png", "depth0.png", "color1.png", "depth1.png")]
    with pytest.raises(ReaderError, match=r"no camera\.json"):
        open_files(*files)
    sequence = open_files(*files, options=CameraOptions(intrinsics=(40, 41, 16, 12)))
    assert sequence.camera.to_dict() == {"width": 32, "height": 24, "fx": 40, "fy": 41, "cx": 16, "cy": 12}


def test_two_sources_of_intrinsics_are_refused(tmp_path: Path) -> None:
    write_pair(tmp_path)
    both = CameraOptions(camera_file=tmp_path / "camera.json", intrinsics=(40, 41, 16, 12))
    with pytest.raises(ReaderError, match="leave one out"):
        open_pair(tmp_path, both)


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        ({"fx": None}, CameraError, "fx missing"),
        ({"width": 64, "height": 48}, ReaderError, r"64x48.*32x24"),
        ({"width": 16}, ReaderError, r"16x24.*32x24"),
    ],
)
def test_a_camera_file_that_does_not_match_is_refused(
    tmp_path: Path, change: dict[str, int | None], kind: type[ObjectflowError], words: str
) -> None:
    write_pair(tmp_path)
    values = {name: value for name, value in {**CAMERA, **change}.items() if value is not None}
    if change.get("width") == 16:
        values["cx"] = 15.9  # Outside the 16 columns, which is legal: only the size shows the error.
    (tmp_path / "camera.json").write_text(json.dumps(values))
    with pytest.raises(kind, match=words) as caught:
        open_pair(tmp_path)
    assert "camera.json" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["color0.png", "depth0.png", "color1.png", "depth1.png", "camera.json"])
def test_each_missing_file_is_named(tmp_path: Path, name: str) -> None:
    write_pair(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(ReaderError, match=name.split(".", maxsplit=1)[0]):
        open_pair(tmp_path)
