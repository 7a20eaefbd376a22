"""Objects without an outline: what looks like the surface around it is background."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.postprocess.outline import drop_without_outline
from objectflow.methods.postprocess.settings import OutlineSettings, PostprocessSettings
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, Float32Array

DEFAULTS = PostprocessSettings()
CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
ROW, COLUMN = np.mgrid[:240, :320]
PATCH: BoolMask = np.hypot(COLUMN - 150, ROW - 110) < 25
LABELS = np.where(PATCH, 2, np.where((ROW < 20) & (COLUMN < 20), 1, 0)).astype(np.int32)
ALONG = geometry.make_transform(np.eye(3), [0.05, 0.0, 0.0])


def plane(tilt: float = 0.0) -> Float32Array:
    """(240, 320) depth of a plane at 1 m in the middle, whose normal is tilted by this many degrees."""
    slope = np.tan(np.radians(tilt))
    return np.asarray(1 / (1 + slope * (ROW - 119.5) / 300), np.float32)


def frame(grey: int, depth: Float32Array, *, shade: float = 0.0) -> RgbdFrame:
    """A grey surface whose brightness falls off, with a patch that is darker or brighter by some grey levels."""
    brightness = 170.0 - 0.1 * COLUMN + grey * PATCH + shade * cv2.GaussianBlur(PATCH.astype(np.float64), (0, 0), 6)
    return RgbdFrame(np.repeat(np.rint(brightness).astype(np.uint8)[..., None], 3, axis=2), depth, CAMERA)


def objects(*, moving: bool = True) -> tuple[ObjectMotion, ...]:
    center = np.array([0.0, 0.0, 1.0])
    return (
        ObjectMotion(1, 400, 0.9, False, center, np.eye(4)),
        ObjectMotion(2, int(PATCH.sum()), 0.9, moving, center, ALONG),
    )


def kept(prev: RgbdFrame, curr: RgbdFrame, settings: PostprocessSettings = DEFAULTS, *, moving: bool = True) -> bool:
    labels, found = drop_without_outline(FramePair(prev, curr), LABELS, objects(moving=moving), settings)
    assert (found[0].id, found[0].pixels, found[0].moving) == (1, 400, False)
    assert np.array_equal(labels == 1, LABELS == 1)
    assert np.array_equal(labels == 2, PATCH if len(found) == 2 else np.zeros_like(PATCH))
    return len(found) == 2


@pytest.mark.parametrize("tilt", [0.0, 50.0])
def test_a_surface_that_a_shadow_left_is_background(tilt: float) -> None:
    depth = plane(tilt)
    assert not kept(frame(0, depth, shade=-60), frame(0, depth))


def test_what_moves_onto_a_surface_has_an_outline() -> None:
    """A sheet of paper that is hardly brighter than the table, and what came nearer without a change of colour."""
    assert kept(frame(0, plane()), frame(12, plane()))
    assert not kept(frame(0, plane()), frame(2, plane()))
    raised = (plane() - 0.04 * PATCH).astype(np.float32)
    assert kept(frame(0, raised), frame(0, raised))


def test_what_changed_in_depth_needs_no_outline() -> None:
    assert kept(frame(0, (plane() - 0.2 * PATCH).astype(np.float32)), frame(0, plane()))


def test_objects_at_rest_stay() -> None:
    assert kept(frame(0, plane(), shade=-60), frame(0, plane()), moving=False)


def test_the_settings_decide() -> None:
    prev, curr = frame(0, plane(), shade=-60), frame(0, plane())
    for outline in (
        OutlineSettings(min_contrast=0),
        OutlineSettings(min_sigmas=0),
        OutlineSettings(min_border=10_000),
    ):
        assert kept(prev, curr, dataclasses.replace(DEFAULTS, outline=outline))
    strict = dataclasses.replace(DEFAULTS, outline=OutlineSettings(min_contrast=30))
    assert not kept(frame(0, plane()), frame(12, plane()), strict)
