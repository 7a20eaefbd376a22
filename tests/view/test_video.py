"""Videos: the frames are the pictures, and a disk that refuses is an error."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.small_disk import small_disk
from objectflow.errors import StorageError
from objectflow.storage.images import encode_png
from objectflow.typing import UInt8Array
from objectflow.view.video import write_video


def picture(grey: int, height: int = 48, width: int = 64) -> UInt8Array:
    return np.full((height, width, 3), grey, np.uint8)


def write_pictures(folder: Path, pictures: list[UInt8Array]) -> list[Path]:
    paths = [folder / f"{index}.png" for index in range(len(pictures))]
    for path, content in zip(paths, pictures, strict=True):
        path.write_bytes(encode_png(content))
    return paths


def noise(count: int) -> list[UInt8Array]:
    """Pictures that cannot be compressed."""
    return list(np.random.default_rng(0).integers(0, 256, (count, 240, 320, 3), dtype=np.uint8))


def frames_of(path: Path) -> Iterator[UInt8Array]:
    video = cv2.VideoCapture(str(path))
    while True:
        found, image = video.read()
        if not found:
            return
        yield image.astype(np.uint8)


def test_the_frames_are_the_pictures(tmp_path: Path) -> None:
    pictures = write_pictures(tmp_path, [picture(40), picture(200, 30, 51), picture(120)])
    write_video(tmp_path / "a.mp4", [*pictures, tmp_path / "missing.png"], 5.0)
    frames = list(frames_of(tmp_path / "a.mp4"))
    assert [frame.shape for frame in frames] == [(48, 64, 3)] * 3
    assert [round(frame[:28, :48].mean() / 20) for frame in frames] == [2, 10, 6]
    assert frames[1][34:, 56:].mean() > 245  # padded with white
    assert cv2.VideoCapture(str(tmp_path / "a.mp4")).get(cv2.CAP_PROP_FPS) == 5.0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.png", "1.png", "2.png", "a.mp4"]


def test_without_pictures_there_is_no_video(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [tmp_path / "missing.png"], 5.0)
    assert not list(tmp_path.iterdir())


def test_a_video_that_is_cut_short_is_an_error_and_the_old_one_stays(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The limit on file sizes makes the encoder's writes fail, of which OpenCV says nothing."""
    pictures = write_pictures(tmp_path, noise(8))
    (tmp_path / "a.mp4").write_bytes(b"old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, limits[1]))
    try:
        with pytest.raises(StorageError, match=r"cannot write .*a\.mp4: OpenCV cannot encode mp4v"):
            write_video(tmp_path / "a.mp4", pictures, 5.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (tmp_path / "a.mp4").read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 9
    assert capfd.readouterr().err == ""


def test_a_full_disk_is_named(tmp_path: Path) -> None:
    pictures = write_pictures(tmp_path, noise(8))
    with small_disk(tmp_path / "disk", "128k") as disk:
        with pytest.raises(StorageError, match=r"cannot write .*a\.mp4: No space left on device"):
            write_video(disk / "a.mp4", pictures, 5.0)
        assert not list(disk.iterdir())
