"""Steps of a flat patch that neither depth nor grey levels show."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from objectflow import geometry
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.tracking.earlier_settings import EarlierSettings
from objectflow.tracking.fine_step import NeighbourFrame, fine_step
from objectflow.tracking.known_settings import KnownSettings
from objectflow.tracking.model_fit import FrameView
from objectflow.tracking.surface_model import new_model
from objectflow.typing import BoolMask

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
SHIFT = 0.08
"""Metres; a pixel has 7 mm."""


def patch(x: float) -> tuple[FrameView, BoolMask]:
    """A red patch of 12 x 20 cm on a green table of the same grey level at 1 m, and its mask."""
    v, u = np.mgrid[0:120, 0:160]
    mask = (np.abs((u - 79.5) / 150 - x) < 0.06) & (np.abs(v - 59.5) / 150 < 0.1)
    color = np.full((120, 160, 3), (60, 124, 60), np.uint8)
    color[mask] = 180, 64, 59
    frame = RgbdFrame(color, np.ones((120, 160), np.float32), CAMERA)
    return FrameView(PreparedFrame(frame), KnownSettings()), mask


def test_the_patch_has_the_grey_level_of_the_table() -> None:
    gray = cv2.cvtColor(patch(0)[0].frame.frame.color, cv2.COLOR_RGB2GRAY)
    assert np.ptp(gray.astype(int)) <= 1


@pytest.mark.parametrize("moved", [True, False])
def test_hue_shows_a_step(moved: bool) -> None:
    """Both the pose at rest and that one step back are tried; one of them is true."""
    later, mask = patch(SHIFT)
    earlier, _ = patch(0 if moved else SHIFT)
    rest = geometry.make_transform(np.eye(3), [SHIFT, 0, 1])
    before = geometry.make_transform(np.eye(3), [0, 0, 1])
    model = new_model(later.frame, mask, rest, 20_000)
    step = fine_step(earlier, NeighbourFrame(later, np.eye(4)), model, rest, [before], EarlierSettings())
    assert step is not None
    assert step.moved is moved
    np.testing.assert_allclose(step.camera_T_object, before if moved else rest, atol=0.004)
    assert step.present > 0.6  # the blur mixes colours at the edge
