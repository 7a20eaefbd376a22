"""Plain folders of numbered frames, and the detection of a folder's kind."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from objectflow.errors import ReaderError
from objectflow.readers import CameraOptions, FrameSequence, open_source

OPTIONS = CameraOptions(intrinsics=(16, 16, 8, 6))


def write_frame(color: Path, depth: Path, value: int) -> None:
    for path in (color, depth):
        path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(color), np.full((12, 16, 3), value, np.uint8))
    cv2.imwrite(str(depth), np.full((12, 16), 1000 + value, np.uint16))


def values(sequence: FrameSequence) -> list[tuple[int, int]]:
    """The value with which each frame was written, from its colour and from its depth."""
    return [(int(frame.color[0, 0, 0]), round(1000 * float(frame.depth[0, 0])) - 1000) for frame in sequence]


@pytest.mark.parametrize(
    ("color", "depth"),
    [
        ("color/{:04d}.png", "depth/{:04d}.png"),
        ("rgb/frame_{}.png", "depth/frame_{}.png"),
        ("images/left{}.png", "depth/{:06d}.png"),
        ("color_{:04d}.png", "depth_{:04d}.png"),
        ("{:04d}_rgb.png", "{:04d}_depth.png"),
        ("frame-{:06d}.color.png", "frame-{:06d}.depth.png"),
        ("Color{}.png", "Depth{}.png"),
        ("rgb/1305031102.{}.png", "depth/1305031102.{}.png"),
    ],
)
def test_known_layouts_in_the_order_of_numbers(tmp_path: Path, color: str, depth: str) -> None:
    # Decimals are compared as fractions: .10 sorts before .9.
    numbers = [8, 9, 10, 11] if "1305031102" not in color else [11, 12, 13, 14]
    for number in numbers:
        write_frame(tmp_path / color.format(number), tmp_path / depth.format(number), number)
    assert values(open_source(tmp_path, OPTIONS)) == [(number, number) for number in numbers]


def test_a_pair_folder_with_a_third_frame_is_a_sequence(tmp_path: Path) -> None:
    for index in range(3):
        write_frame(tmp_path / f"color{index}.png", tmp_path / f"depth{index}.png", index + 1)
    assert values(open_source(tmp_path, OPTIONS)) == [(1, 1), (2, 2), (3, 3)]


def test_the_error_for_an_unpaired_image_names_it(tmp_path: Path) -> None:
    for index in (1, 2):
        write_frame(tmp_path / f"color_{index}.png", tmp_path / f"depth_{index}.png", index)
    (tmp_path / "depth_2.png").unlink()
    with pytest.raises(ReaderError, match=r"color_2\.png: no depth image with number 2"):
        open_source(tmp_path, OPTIONS)


@pytest.mark.parametrize("name", ["first", "\u0663\u0663"])
def test_images_whose_names_have_no_number_are_refused(tmp_path: Path, name: str) -> None:
    # Only the digits 0 to 9 number a frame.
    write_frame(tmp_path / "color" / f"{name}.png", tmp_path / "depth" / f"{name}.png", 1)
    with pytest.raises(ReaderError, match="its name has no number"):
        open_source(tmp_path, OPTIONS)


def test_two_images_with_the_same_number_are_refused(tmp_path: Path) -> None:
    write_frame(tmp_path / "color_1.png", tmp_path / "depth_1.png", 1)
    write_frame(tmp_path / "color_01.png", tmp_path / "depth_1.png", 1)
    with pytest.raises(ReaderError, match="same number"):
        open_source(tmp_path, OPTIONS)


def test_paths_without_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ReaderError, match="no RGB-D frames"):
        open_source(tmp_path)
    with pytest.raises(ReaderError, match="no such folder"):
        open_source(tmp_path / "missing")
    (tmp_path / "file").write_text("")
    with pytest.raises(ReaderError, match="not a folder"):
        open_source(tmp_path / "file")
