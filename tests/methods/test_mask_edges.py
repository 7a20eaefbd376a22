"""A disc in front of a wall, labelled at a quarter of the width: borders follow the full image's depth and colour."""

from __future__ import annotations

import numpy as np
import pytest

from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import DepthNoise
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.mask_edges import snap_to_edges, upsample_labels
from objectflow.typing import LabelImage

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
SMALL = (30, 40)
"""Height and width at which labels are found."""


def disc(step: float, shade: int) -> tuple[RgbdFrame, LabelImage]:
    """A frame with a disc `step` metres in front of a wall and brighter by `shade`, and its true labels."""
    v, u = np.mgrid[0:120, 0:160]
    labels = (np.hypot(u - 71.3, v - 58.8) < 33.4).astype(np.int32)
    depth = np.where(labels, 1.0 - step, 1.0).astype(np.float32)
    color = np.repeat((100 + shade * labels[..., None]).astype(np.uint8), 3, axis=2)
    return RgbdFrame(color, depth, CAMERA), labels


def on_fewer_pixels(labels: LabelImage) -> LabelImage:
    """Labels found at 40x30, upsampled to the full image."""
    down, back = nearest_indices((120, 160), SMALL), nearest_indices(SMALL, (120, 160))
    found = labels[down[0][:, None], down[1]]
    return found[back[0][:, None], back[1]]


def iou(a: LabelImage, b: LabelImage) -> float:
    return float(((a > 0) & (b > 0)).sum() / ((a > 0) | (b > 0)).sum())


@pytest.mark.parametrize(("step", "shade"), [(0.1, 0), (0.0, 60), (0.1, 60)])
def test_borders_follow_depth_or_colour(step: float, shade: int) -> None:
    frame, true = disc(step, shade)
    blocky = on_fewer_pixels(true)
    assert iou(blocky, true) < 0.97
    assert iou(snap_to_edges(blocky, frame, SMALL), true) > 0.99


def test_an_invisible_border_stays_within_a_pixel_of_the_smaller_image() -> None:
    frame, true = disc(0.0, 0)
    blocky = on_fewer_pixels(true)
    changed = snap_to_edges(blocky, frame, SMALL) != true
    v, u = np.nonzero(changed)
    assert (np.abs(np.hypot(u - 71.3, v - 58.8) - 33.4) < 8).all()


def test_pixels_without_depth_keep_their_label() -> None:
    frame, true = disc(0.1, 60)
    depth = frame.depth.copy()
    depth[20:30, 60:80] = 0
    depth[50:60, :10] = 0
    holed = RgbdFrame(frame.color, depth, CAMERA)
    blocky = on_fewer_pixels(true)
    np.testing.assert_array_equal(snap_to_edges(blocky, holed, SMALL)[depth == 0], blocky[depth == 0])


@pytest.mark.parametrize("size", [(120, 160), (240, 320), (60, 160)])
def test_labels_found_on_an_image_that_is_no_smaller_stay(size: tuple[int, int]) -> None:
    frame, true = disc(0.1, 60)
    assert snap_to_edges(true, frame, size) is true


def test_the_noise_decides_which_depth_step_is_a_border() -> None:
    """A step of 1 cm is a border for a camera with 1 mm of noise, and none for one with 2 cm."""
    frame, true = disc(0.01, 0)
    blocky = on_fewer_pixels(true)
    precise, noisy = DepthNoise(base=0.001, growth=0.0), DepthNoise(base=0.02, growth=0.0)
    assert iou(snap_to_edges(blocky, frame, SMALL, precise), true) > 0.99
    assert iou(snap_to_edges(blocky, frame, SMALL, noisy), true) < 0.98


def test_holes_that_one_object_encloses_are_labelled() -> None:
    frame, true = disc(0.1, 60)
    depth = frame.depth.copy()
    depth[57:60, 70:73] = 0  # inside the disc
    depth[57:60, 103:107] = 0  # across its border
    depth[5:8, 5:8] = 0  # in the wall
    holed = RgbdFrame(frame.color, depth, CAMERA)
    down = nearest_indices((120, 160), SMALL)
    labels = upsample_labels(true[down[0][:, None], down[1]], holed)
    assert labels.dtype == np.int32
    assert (labels[57:60, 70:73] == 1).all()
    assert not labels[57:60, 103:107].any()
    assert not labels[5:8, 5:8].any()
    assert iou(np.where(depth > 0, labels, 0).astype(np.int32), np.where(depth > 0, true, 0).astype(np.int32)) > 0.99
