"""The guess of the image's shift: exact shifts of a smooth texture, and images without edges."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from objectflow import Camera, RgbdFrame
from objectflow.alignment.apparent_shift import apparent_shift
from objectflow.alignment.prepared_frame import PreparedFrame

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)


def frame(shift: int, contrast: float = 40.0) -> PreparedFrame:
    """A smooth texture that lies `shift` pixels farther right."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(240, 400)), (0, 0), 4.0)
    gray = np.clip(128 + contrast * noise / noise.std(), 0, 255).astype(np.uint8)[:, 40 - shift : 360 - shift]
    return PreparedFrame(RgbdFrame(np.repeat(gray[..., None], 3, axis=2), np.ones((240, 320), np.float32), CAMERA))


@pytest.mark.parametrize("shift", [0, 1, 2])
def test_shift_is_half_of_the_true_one_or_more(shift: int) -> None:
    found = apparent_shift(frame(0), frame(shift))
    assert 0.5 * shift <= found <= shift


def test_a_plain_image_has_no_shift() -> None:
    assert apparent_shift(frame(0, contrast=0.0), frame(2, contrast=0.0)) == 0.0


def test_a_small_object_is_no_shift_of_the_image() -> None:
    whole, moved = frame(0).frame, frame(6).frame
    color = whole.color.copy()
    color[100:150, 100:150] = moved.color[100:150, 100:150]
    assert apparent_shift(PreparedFrame(whole), PreparedFrame(RgbdFrame(color, whole.depth, CAMERA))) == 0.0
