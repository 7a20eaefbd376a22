"""Rendered models of tilted planes against the planes' equations."""

from __future__ import annotations

import numpy as np
import pytest

from objectflow import geometry
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.tracking.surface_model import SurfaceModel

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)


@pytest.mark.parametrize("slope", [0.0, 0.5, 1.0])
def test_the_depth_of_a_tilted_plane_is_rendered_without_bias(slope: float) -> None:
    """z = 1 + slope * y: over a voxel of two pixels, depth changes by more than a centimetre."""
    rows, columns = np.mgrid[0:120, 0:160]
    ray = (rows - 59.5) / 150
    depth = 1 / (1 - slope * ray)
    inside = (np.abs(columns - 79.5) < 40) & (np.abs(rows - 59.5) < 25)
    noisy = depth * (1 + 0.002 * np.random.default_rng(3).standard_normal(depth.shape))
    frame = PreparedFrame(RgbdFrame(np.full((120, 160, 3), 90, np.uint8), noisy.astype(np.float32), CAMERA))
    model = SurfaceModel(2 / 150, 20_000)
    for _ in range(3):
        model.integrate(frame, inside, np.eye(4))
    # A translation along x leaves the plane as it is.
    pose = geometry.make_transform(np.eye(3), np.array([0.02, 0.0, 0.0]))
    shown, index = model.render(pose, frame)
    seen = index >= 0
    shifted = (np.abs(columns - 79.5 - 0.02 * 150 / depth) < 40) & (np.abs(rows - 59.5) < 25)
    assert (seen & shifted).sum() > 0.93 * (seen | shifted).sum()
    inner = seen & (np.abs(rows - 59.5) < 20)
    error = shown[inner] - depth[inner]
    assert abs(np.median(error)) < 0.001 * (1 + slope)
    assert np.quantile(np.abs(error), 0.9) < 0.004 * (1 + slope)
