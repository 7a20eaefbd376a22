"""Normals of known surfaces."""

from __future__ import annotations

import numpy as np

from objectflow import Camera, geometry
from objectflow.geometry.normals import surface_normals

CAMERA = Camera(width=320, height=240, fx=236.46, fy=236.46, cx=159.5, cy=119.5)


def test_normals_of_a_tilted_plane_are_exact() -> None:
    normal = np.array([0.3, -0.4, -0.866])
    normal /= np.linalg.norm(normal)
    rays = np.concatenate([geometry.pixel_grid(CAMERA), np.ones((240, 320, 1), np.float32)], axis=-1)
    depth = (-0.7 / (rays @ normal)).astype(np.float32)
    depth[depth < 0] = 0
    normals = surface_normals(depth, CAMERA)
    known = np.isfinite(normals[..., 0])
    assert known.mean() > 0.5
    np.testing.assert_allclose(normals[known] @ normal, 1, atol=1e-4)
    assert (normals[known][:, 2] < 0).all()


def test_normals_stop_at_holes_and_depth_steps() -> None:
    depth = np.full((60, 80), 0.6, np.float32)
    depth[:, 40:] = 0.9
    depth[10, 10] = 0
    camera = CAMERA.scaled(80, 60)
    known = np.isfinite(surface_normals(depth, camera)[..., 2])
    assert not known[8:13, 8:13].any()
    assert not known[20:40, 38:42].any()
    assert known[20:40, 5:35].all()
