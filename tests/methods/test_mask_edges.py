"""A disc before a wall, labelled on a quarter of the pixels: borders of the full image from its depth and colour."""

from __future__ import annotations

import numpy as np
import pytest

from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.mask_edges import snap_to_edges
from objectflow.typing import LabelImage

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)


def disc(step: float, shade: int) -> tuple[RgbdFrame, LabelImage]:
    """A frame with a disc that lies `step` metres before a wall and is so much brighter, and its true labels."""
    v, u = np.mgrid[0:120, 0:160]
    labels = (np.hypot(u - 71.3, v - 58.8) < 33.4).astype(np.int32)
    depth = np.where(labels, 1.0 - step, 1.0).astype(np.float32)
    color = np.repeat((100 + shade * labels[..., None]).astype(np.uint8), 3, axis=2)
    return RgbdFrame(color, depth, CAMERA), labels


def on_fewer_pixels(frame: RgbdFrame, labels: LabelImage) -> tuple[RgbdFrame, LabelImage]:
    """The frame at 40x30, and labels of the full image that were found there."""
    small = frame.resized(40, 30)
    down, back = nearest_indices((120, 160), (30, 40)), nearest_indices((30, 40), (120, 160))
    found = labels[down[0][:, None], down[1]]
    return small, found[back[0][:, None], back[1]]


def iou(a: LabelImage, b: LabelImage) -> float:
    return float(((a > 0) & (b > 0)).sum() / ((a > 0) | (b > 0)).sum())


@pytest.mark.parametrize(("step", "shade"), [(0.1, 0), (0.0, 60), (0.1, 60)])
def test_borders_follow_depth_or_colour(step: float, shade: int) -> None:
    frame, true = disc(step, shade)
    small, blocky = on_fewer_pixels(frame, true)
    assert iou(blocky, true) < 0.97
    assert iou(snap_to_edges(blocky, small, frame), true) > 0.99


def test_where_nothing_shows_a_border_it_stays_within_a_pixel_of_the_smaller_image() -> None:
    frame, true = disc(0.0, 0)
    small, blocky = on_fewer_pixels(frame, true)
    changed = snap_to_edges(blocky, small, frame) != true
    v, u = np.nonzero(changed)
    assert (np.abs(np.hypot(u - 71.3, v - 58.8) - 33.4) < 8).all()


def test_pixels_without_depth_keep_their_label() -> None:
    frame, true = disc(0.1, 60)
    depth = frame.depth.copy()
    depth[20:30, 60:80] = 0
    depth[50:60, :10] = 0
    holed = RgbdFrame(frame.color, depth, CAMERA)
    small, blocky = on_fewer_pixels(holed, true)
    np.testing.assert_array_equal(snap_to_edges(blocky, small, holed)[depth == 0], blocky[depth == 0])


@pytest.mark.parametrize("size", [(160, 120), (320, 240), (160, 60)])
def test_labels_of_an_image_that_is_no_smaller_stay(size: tuple[int, int]) -> None:
    frame, true = disc(0.1, 60)
    assert snap_to_edges(true, frame.resized(*size), frame) is true
