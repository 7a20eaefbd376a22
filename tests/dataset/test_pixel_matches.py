"""True matches of scenes that can be computed by hand."""

from __future__ import annotations

import numpy as np
import torch

from objectflow.dataset.pixel_matches import previous_pixels
from objectflow.geometry.torch_pinhole import back_project

INTRINSICS = torch.tensor([[40.0, 50.0, 15.5, 11.5]])
HEIGHT, WIDTH = 24, 32


def plane(depth: float) -> torch.Tensor:
    return torch.full((1, HEIGHT, WIDTH), depth)


def test_a_sideways_shift_is_focal_length_by_shift_over_depth() -> None:
    points = back_project(plane(2.0)[:, None], INTRINSICS)
    flow = torch.tensor([0.1, -0.2, 0.0]).reshape(1, 3, 1, 1).expand_as(points)
    found = previous_pixels(points, flow, plane(2.0), INTRINSICS)
    column, row = 10, 12
    np.testing.assert_allclose(
        found[0, :, row, column].numpy(), [column + 40 * 0.1 / 2, row - 50 * 0.2 / 2], atol=1e-4
    )
    # The shift is 2 columns to the right and 5 rows up; pixels that leave the image have no match.
    assert torch.isnan(found[0, :, :, WIDTH - 2 :]).all()
    assert torch.isnan(found[0, :, :5]).all()
    assert torch.isfinite(found[0, :, 5:, : WIDTH - 2]).all()


def test_a_point_behind_the_previous_surface_is_occluded() -> None:
    points = back_project(plane(1.0)[:, None], INTRINSICS)
    still = torch.zeros_like(points)
    before = plane(1.0)
    before[:, 5:9, 5:9] = 0.8
    before[:, 15:18, 15:18] = 0.98  # within the tolerance of 1 cm and 2 percent
    before[:, 20, 20] = 0  # missing depth occludes nothing
    occluded = torch.isnan(previous_pixels(points, still, before, INTRINSICS)[0, 0])
    expected = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    expected[5:9, 5:9] = True
    assert torch.equal(occluded, expected)


def test_points_without_depth_or_behind_the_camera_have_no_match() -> None:
    depth = plane(1.0)
    depth[:, 3, 4] = 0
    points = back_project(depth[:, None], INTRINSICS)
    points[:, :, 3, 4] = torch.nan
    flow = torch.zeros_like(points)
    flow[:, 2, 6, 6] = -1.5
    found = torch.isfinite(previous_pixels(points, flow, plane(1.0), INTRINSICS)).all(1)[0]
    assert not found[3, 4]
    assert not found[6, 6]
    assert int(found.sum()) == HEIGHT * WIDTH - 2
