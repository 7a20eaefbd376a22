"""Depth registered to a colour camera, compared with the ray-cast truth of an analytic scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import analytic
from analytic_solids import Solid, draw_texture
from objectflow.errors import FrameError
from objectflow.geometry.camera import Camera
from objectflow.readers.register_depth import DepthRegistration
from objectflow.typing import Float32Array, Float64Array

COLOR = Camera(320, 240, 262.0, 262.0, 159.5, 119.5)
DEPTH = Camera(320, 240, 190.0, 190.0, 161.0, 118.0)
SMALL = Camera(160, 120, 95.0, 95.0, 79.75, 59.75)


def world() -> analytic.World:
    """A box and a sphere on a table, seen from above at an angle."""
    rng = np.random.default_rng(4)
    cells = np.array([16, 16, 16])
    view = np.eye(4)
    view[:3, :3] = Rotation.from_euler("x", 215, degrees=True).as_matrix()
    view[:3, 3] = (0.0, -0.55, 0.75)
    box, ball = np.eye(4), np.eye(4)
    box[:3, 3], ball[:3, 3] = (0.12, 0.0, 0.09), (-0.14, 0.05, 0.08)
    solids = [
        Solid("box", np.array([0.07, 0.05, 0.09]), draw_texture(rng, cells)),
        Solid("sphere", np.array([0.08, 0.08, 0.08]), draw_texture(rng, cells)),
    ]
    return analytic.World(
        solids, [box, ball], view, draw_texture(rng, cells[:2], plane=True), np.array([0.0, 0.0, 1.0])
    )


def cast(scene: analytic.World, camera: Camera, color_T_camera: Float64Array) -> Float32Array:
    """Depth of the scene from a camera beside the colour camera."""
    seen = replace(scene, world_T_camera=scene.world_T_camera @ color_T_camera)
    depth, _, _ = seen.cast(analytic.pixel_rays(camera).reshape(-1, 3))
    return np.where(np.isfinite(depth), depth, 0).reshape(camera.height, camera.width).astype(np.float32)


def offset(degrees: tuple[float, float, float] = (0, 0, 0)) -> Float64Array:
    color_T_depth = np.eye(4)
    color_T_depth[:3, :3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    color_T_depth[:3, 3] = (-0.05, 0.004, 0.01)
    return color_T_depth


@pytest.mark.parametrize("camera", [DEPTH, SMALL], ids=["full", "half"])
@pytest.mark.parametrize("degrees", [(0, 0, 0), (1.5, -2.0, 3.0)], ids=["parallel", "turned"])
def test_registered_depth_equals_the_ray_cast_truth(camera: Camera, degrees: tuple[float, float, float]) -> None:
    scene, color_T_depth = world(), offset(degrees)
    registration = DepthRegistration(camera, COLOR, color_T_depth)
    color = np.zeros((240, 320, 3), np.uint8)
    _, found = registration(color, cast(scene, camera, color_T_depth))
    truth = cast(scene, COLOR, np.eye(4))
    known = found > 0
    error = np.abs(found - truth)[known]
    assert np.median(error) < 0.0003
    # Edges of objects are uncertain by a pixel of the depth camera.
    limit = 0.985 if camera is DEPTH else 0.95
    assert (error < 0.003).mean() > limit
    # Nothing lies in front of what the colour camera sees by more than such a pixel, except at edges.
    assert (found < truth - 0.01)[known].mean() < 1.5 * (1 - limit)

    # Every surface that both cameras see is found, without gaps.
    v, u = np.nonzero(truth > 0)
    points = analytic.pixel_rays(COLOR).reshape(240, 320, 3)[v, u] * truth[v, u, None]
    inside = (points - color_T_depth[:3, 3]) @ color_T_depth[:3, :3]
    du = np.rint(inside[:, 0] / inside[:, 2] * camera.fx + camera.cx).astype(int)
    dv = np.rint(inside[:, 1] / inside[:, 2] * camera.fy + camera.cy).astype(int)
    in_view = (du >= 1) & (dv >= 1) & (du < camera.width - 1) & (dv < camera.height - 1)
    # Half a depth pixel on the table.
    tolerance = 0.003 if camera is DEPTH else 0.006
    seen = in_view.copy()
    seen[in_view] = (
        np.abs(cast(scene, camera, color_T_depth)[dv[in_view], du[in_view]] - inside[in_view, 2]) < tolerance
    )
    assert seen.mean() > 0.7
    assert known[v[seen], u[seen]].mean() > 0.999


def test_what_only_the_colour_camera_sees_has_no_depth() -> None:
    """A post in front of a wall hides a strip of the wall from the depth camera, to the left of the post."""
    color_T_depth = np.eye(4)
    color_T_depth[0, 3] = 0.1  # the depth camera is to the right of the colour camera
    camera = Camera(200, 100, 200.0, 200.0, 99.5, 49.5)
    depth = np.full((100, 200), 2.0, np.float32)
    depth[:, 80:100] = 1.0
    _, found = DepthRegistration(camera, camera, color_T_depth)(np.zeros((100, 200, 3), np.uint8), depth)
    row = found[50]
    # The post moves by 0.1 * 200 / 1 = 20 pixels, the wall by 10: the columns 90 to 99 of the wall remain unseen.
    np.testing.assert_allclose(row[100:120], 1.0)
    np.testing.assert_array_equal(row[:10], 0)
    np.testing.assert_array_equal(row[90:100], 0)
    np.testing.assert_allclose(row[10:90], 2.0)
    np.testing.assert_allclose(row[120:], 2.0)


def test_identical_cameras_leave_depth_unchanged() -> None:
    depth = cast(world(), COLOR, np.eye(4))
    depth[10:20, 30:50] = 0
    _, found = DepthRegistration(COLOR, COLOR, np.eye(4))(np.zeros((240, 320, 3), np.uint8), depth)
    np.testing.assert_allclose(found, depth, atol=2e-6)
    with pytest.raises(FrameError, match="depth is 4x3"):
        DepthRegistration(COLOR, COLOR, np.eye(4))(np.zeros((240, 320, 3), np.uint8), np.ones((3, 4), np.float32))
