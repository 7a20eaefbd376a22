"""Turned frames of the benchmark of real pairs show the same points, and results on them are turned back."""

from __future__ import annotations

import numpy as np
import pytest

from objectflow import Camera, ObjectMotion, RgbdFrame, SceneMotion, geometry
from quarter_turns import turn_back, turn_frame

CAMERA = Camera(width=7, height=5, fx=6.0, fy=5.5, cx=3.2, cy=1.9)


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_motions_of_turned_points_are_those_of_the_points(quarters: int) -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 2, (5, 7)).astype(np.float32)
    frame = RgbdFrame(rng.integers(0, 255, (5, 7, 3), dtype=np.uint8), depth, CAMERA)
    motion = geometry.make_transform(geometry.so3_exp(np.array([0.1, -0.2, 0.3])), [0.02, 0.01, -0.03])
    points = geometry.back_project(depth, CAMERA)
    flow = geometry.transform(motion, points) - points

    turned = turn_frame(frame, quarters)
    seen = geometry.back_project(turned.depth, turned.camera)
    # The rotation between the cameras, from the points that both see.
    same = np.rot90(points, quarters).reshape(-1, 3)
    turned_T_frame, _ = geometry.kabsch(same, seen.reshape(-1, 3), np.ones(35))
    np.testing.assert_allclose(geometry.transform(turned_T_frame, same), seen.reshape(-1, 3), atol=1e-6)
    np.testing.assert_array_equal(np.rot90(turned.color, -quarters), frame.color)

    expected = turned_T_frame @ motion @ geometry.inverse(turned_T_frame)
    found = SceneMotion(
        labels=np.ones(turned.depth.shape, np.int32),
        scene_flow=(geometry.transform(expected, seen) - seen).astype(np.float32),
        objects=(ObjectMotion(1, 35, 0.5, True, seen.reshape(-1, 3)[0].astype(np.float64), expected),),
        camera_motion=expected,
    )
    back = turn_back(found, quarters)
    np.testing.assert_allclose(back.scene_flow, flow, atol=1e-6)
    np.testing.assert_allclose(back.objects[0].prev_T_curr, motion, atol=1e-6)
    np.testing.assert_allclose(back.objects[0].center, same[0], atol=1e-6)
    assert back.camera_motion is not None
    np.testing.assert_allclose(back.camera_motion, motion, atol=1e-6)
