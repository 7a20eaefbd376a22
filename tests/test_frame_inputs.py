"""The forms in which images and cameras may be given."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from objectflow import Camera, RgbdFrame
from objectflow.errors import CameraError, FrameError

CAMERA = Camera(width=4, height=3, fx=5.0, fy=5.0, cx=1.5, cy=1.0)
COLOR = np.arange(36, dtype=np.uint8).reshape(3, 4, 3)
MILLIMETRES = (np.arange(12).reshape(3, 4) + 500).astype(np.uint16)
DEPTH = MILLIMETRES.astype(np.float32) / np.float32(1000)


def check(frame: RgbdFrame) -> None:
    np.testing.assert_array_equal(frame.color, COLOR)
    np.testing.assert_array_equal(frame.depth, DEPTH)
    assert frame.color.dtype == np.uint8
    assert frame.depth.dtype == np.float32


def test_tensors() -> None:
    check(RgbdFrame(torch.from_numpy(COLOR), torch.from_numpy(DEPTH).requires_grad_(), CAMERA))  # type: ignore[arg-type]


def test_lists() -> None:
    check(RgbdFrame(COLOR.tolist(), DEPTH.tolist(), CAMERA))


def test_depth_with_a_channel() -> None:
    check(RgbdFrame(COLOR, DEPTH[..., None], CAMERA))


def test_whole_numbers_with_a_scale() -> None:
    check(RgbdFrame(COLOR, MILLIMETRES, CAMERA, depth_scale=1000))
    check(RgbdFrame(COLOR, torch.from_numpy(MILLIMETRES.astype(np.int32)), CAMERA, depth_scale=1000))  # type: ignore[arg-type]
    check(RgbdFrame(COLOR, DEPTH * 1000, CAMERA, depth_scale=1000.0))


def test_whole_numbers_without_a_scale_are_refused() -> None:
    with pytest.raises(FrameError, match="give depth_scale"):
        RgbdFrame(COLOR, MILLIMETRES, CAMERA)
    with pytest.raises(FrameError, match="depth_scale"):
        RgbdFrame(COLOR, MILLIMETRES, CAMERA, depth_scale=0)


@pytest.mark.parametrize("color", [[[1, 2], [3]], "picture", None, [[[300, 0, 0]] * 4] * 3])
def test_other_things_are_refused(color: object) -> None:
    with pytest.raises(FrameError, match="colour must be"):
        RgbdFrame(color, DEPTH, CAMERA)  # type: ignore[arg-type]


def test_cameras_from_matrices() -> None:
    assert Camera.from_matrix(CAMERA.matrix, (4, 3)) == CAMERA
    assert Camera.from_matrix(torch.from_numpy(CAMERA.matrix), (4, 3)) == CAMERA  # type: ignore[arg-type]
    assert Camera.from_matrix(CAMERA.matrix.tolist(), (4, 3)) == CAMERA


@pytest.mark.parametrize(
    "matrix",
    [np.eye(4), "K", [[5, 0.1, 1], [0, 5, 1], [0, 0, 1]], [[5, 0, 1], [0, 5, 1], [0, 0, 2]], np.full((3, 3), np.nan)],
)
def test_other_matrices_are_refused(matrix: object) -> None:
    with pytest.raises(CameraError):
        Camera.from_matrix(matrix, (4, 3))  # type: ignore[arg-type]
