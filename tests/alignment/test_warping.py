"""Warping on analytic scenes with known motion and visibility, and splatting checked by hand."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

import analytic
from objectflow import Camera, RgbdFrame, geometry
from objectflow.alignment.warping import splat, warp_previous
from objectflow.errors import GeometryError
from objectflow.typing import BoolMask, Float32Array, LabelImage

CAMERA = Camera(width=8, height=6, fx=10.0, fy=10.0, cx=3.0, cy=2.0)


@cache
def scene(seed: int) -> tuple[analytic.AnalyticPair, Float32Array]:
    """A pair, and the previous positions of the points of the current pixels."""
    pair = analytic.make_scene(seed, objects=(3, 5))
    return pair, geometry.back_project(pair.curr.depth, pair.curr.camera) + pair.scene_flow


def beside_edges(labels: LabelImage) -> BoolMask:
    return np.asarray(ndimage.maximum_filter(labels, 5) != ndimage.minimum_filter(labels, 5))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_visibility_agrees_with_ray_casting(seed: int) -> None:
    pair, points = scene(seed)
    warped = warp_previous(pair.prev, points, tolerance=0.005)
    known = pair.curr.valid & ~beside_edges(pair.labels)
    hidden = known & ~pair.visible
    assert hidden.any()
    assert warped.visible[known & pair.visible].mean() > 0.95
    assert warped.visible[hidden].mean() < 0.05
    assert not warped.visible[~pair.curr.valid].any()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_true_motion_samples_the_right_depth_and_colour(seed: int) -> None:
    pair, points = scene(seed)
    warped = warp_previous(pair.prev, points, tolerance=0.005)
    inner = warped.visible & ~beside_edges(pair.labels)
    assert np.abs(warped.depth - points[..., 2])[inner].mean() < 0.0005
    # Rotated surfaces change their shading, so colour is compared on the static background.
    static = inner & (pair.labels == 0)
    np.testing.assert_allclose(warped.color[static], pair.prev.color[static], atol=0.6)
    moved = inner & np.isin(pair.labels, list(pair.moving))
    difference = np.abs(warped.color - pair.curr.color)[moved].mean()
    unwarped = np.abs(pair.prev.color.astype(float) - pair.curr.color)[moved].mean()
    assert difference < 0.6 * unwarped


def test_invisible_pixels_are_zero() -> None:
    pair, points = scene(0)
    warped = warp_previous(pair.prev, points, tolerance=0.005)
    assert warped.color.dtype == warped.depth.dtype == np.float32
    assert (warped.color[~warped.visible] == 0).all()
    assert (warped.depth[~warped.visible] == 0).all()
    assert (warped.depth[warped.visible] > 0).all()


def wall(depth: Float32Array | None = None) -> RgbdFrame:
    color = np.random.default_rng(0).integers(1, 256, (6, 8, 3), dtype=np.uint8)
    return RgbdFrame(color, np.ones((6, 8), np.float32) if depth is None else depth, CAMERA)


def test_colour_is_sampled_bilinearly() -> None:
    prev = wall()
    points = np.array([[[0.05, 0, 1], [0.025, 0.05, 1], [0.4, 0.3, 1]]])  # pixels (3.5, 2), (3.25, 2.5), (7, 5)
    warped = warp_previous(prev, points, tolerance=0.01)
    c = prev.color.astype(float)
    top, bottom = 0.75 * c[2, 3] + 0.25 * c[2, 4], 0.75 * c[3, 3] + 0.25 * c[3, 4]
    expected = [(c[2, 3] + c[2, 4]) / 2, (top + bottom) / 2, c[5, 7]]
    np.testing.assert_allclose(warped.color[0], expected, atol=1e-3)


def test_points_in_front_behind_outside_or_unknown_are_not_visible() -> None:
    hole = np.ones((6, 8), np.float32)
    hole[4:, :2] = 0
    points = np.array(
        [
            [[0.0, 0, 1.0], [0, 0, 1.009], [0, 0, 0.991]],  # on the wall, within the tolerance
            [[0, 0, 1.02], [0, 0, 0.98], [0, 0, -1]],  # hidden, in free space, behind the camera
            [[0.5, 0, 1], [np.nan, np.nan, np.nan], [-0.3, 0.3, 1]],  # outside, unknown, in the hole
        ]
    )
    assert warp_previous(wall(hole), points, tolerance=0.01).visible.tolist() == [[True] * 3, [False] * 3, [False] * 3]
    wide = np.full((3, 3), 0.01)
    wide[1] = 0.05
    assert warp_previous(wall(hole), points, tolerance=wide).visible[1].tolist() == [True, True, False]


def test_depth_is_not_interpolated_across_an_edge() -> None:
    step = np.ones((6, 8), np.float32)
    step[:, 4:] = 2
    points = np.array([[[0.5 / 10 * 1.5, 0, 1.5]]])  # pixel (3.5, 2), where interpolation would give 1.5 m
    assert not warp_previous(wall(step), points, tolerance=0.1).visible.any()


@pytest.mark.parametrize(
    ("points", "tolerance"),
    [
        (np.ones((4, 3)), 0.01),
        (np.ones((4, 4, 2)), 0.01),
        (np.ones((4, 5, 3)), 0.0),
        (np.ones((4, 5, 3)), np.nan),
        (np.ones((4, 5, 3)), np.ones((5, 4))),
    ],
)
def test_invalid_arguments_of_warping_are_rejected(points: NDArray[Any], tolerance: Any) -> None:
    with pytest.raises(GeometryError, match="must be"):
        warp_previous(wall(), points, tolerance=tolerance)


def test_a_frame_splatted_into_its_own_camera_is_unchanged() -> None:
    pair, _ = scene(0)
    color, depth = splat(geometry.back_project(pair.curr.depth, pair.curr.camera), pair.curr.color, pair.curr.camera)
    np.testing.assert_array_equal(depth, pair.curr.depth)
    np.testing.assert_array_equal(color[pair.curr.valid], pair.curr.color[pair.curr.valid])


def test_the_nearest_point_is_kept_and_holes_are_zero() -> None:
    points = np.array([[0, 0, 2.0], [0.01, 0, 1], [0.03, 0, 1.5], [0.2, 0.1, 1], [0, 0, -1], [9, 0, 1], [np.nan] * 3])
    colors = np.arange(1, 22, dtype=np.uint8).reshape(7, 3)
    color, depth = splat(points, colors, CAMERA)
    assert depth[2, 3] == 1  # the first three fall into pixel (3, 2)
    assert color[2, 3].tolist() == colors[1].tolist()
    assert color[3, 5].tolist() == colors[3].tolist()
    assert (depth > 0).sum() == 2
    assert (color.sum(-1) > 0).sum() == 2
    backwards = splat(points[::-1], colors[::-1], CAMERA)
    np.testing.assert_array_equal(backwards[0], color)
    np.testing.assert_array_equal(backwards[1], depth)


def test_the_current_frame_splatted_by_its_motion_resembles_the_previous_one() -> None:
    pair, points = scene(1)
    color, depth = splat(points, pair.curr.color, pair.prev.camera)
    filled = (depth > 0) & pair.prev.valid
    assert filled.mean() > 0.9
    assert (np.abs(depth - pair.prev.depth)[filled] < 0.005).mean() > 0.95
    assert np.abs(color.astype(float) - pair.prev.color)[filled].mean() < 12


def test_no_points_give_an_empty_image() -> None:
    color, depth = splat(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), CAMERA)
    assert not color.any()
    assert not depth.any()
    with pytest.raises(GeometryError, match="one shape"):
        splat(np.zeros((2, 3)), np.zeros((3, 3), np.uint8), CAMERA)
