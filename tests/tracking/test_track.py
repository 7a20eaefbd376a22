"""What a track knows of its object: points in a frame, the box around it, and how sure it is."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from objectflow import SequenceEstimator, geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.tracking import Track

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
WIDTH, HEIGHT = 0.24, 0.16
"""Metres: size of the plate, which faces the camera at 1 m."""


def plate(x: float, time: float, hidden: float = -1.0) -> tuple[RgbdFrame, np.ndarray]:
    """A plate at (x, 0, 1) before a wall at 2 m; a board at 0.5 m covers the image left of `hidden`, metres at 1 m."""
    v, u = np.mgrid[0:120, 0:160]
    along, across = (u - 79.5) / 150 - x, (v - 59.5) / 150
    inside = (np.abs(along) < WIDTH / 2) & (np.abs(across) < HEIGHT / 2)
    depth, color = np.full((120, 160), 2.0, np.float32), np.full((120, 160, 3), 120, np.uint8)
    depth[inside] = 1.0
    color[inside] = np.stack([140 + 400 * along, 120 + 500 * across, np.full_like(along, 60)], axis=-1)[inside]
    board = (u - 79.5) / 150 < hidden
    depth[board], color[board] = 0.5, 20
    return RgbdFrame(color, depth, CAMERA, timestamp=time), inside & ~board


@pytest.fixture(scope="module")
def track() -> Track:
    places = [0.02 * k for k in range(6)]
    frames = [plate(x, float(k)) for k, x in enumerate(places)]

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        number = int(curr.timestamp or 0)
        mask = frames[number][1]
        motion = geometry.make_transform(np.eye(3), [-0.02, 0.0, 0.0])
        obj = ObjectMotion(1, int(mask.sum()), 0.8, True, np.array([places[number], 0, 1]), motion)
        return SceneMotion(mask.astype(np.int32), np.zeros((120, 160, 3), np.float32), (obj,))

    sequence = SequenceEstimator(estimate)
    for frame, _ in frames:
        sequence.update(frame)
    (found,) = sequence.tracks
    return found


def test_points_are_those_of_the_visible_surface(track: Track) -> None:
    frame, mask = plate(0.1, 6.0)
    points = track.points(frame)
    assert len(points) > 0.9 * mask.sum()
    np.testing.assert_allclose(points[:, 2], 1.0)
    assert np.abs(points[:, 0] - 0.1).max() < WIDTH / 2 + 1e-6
    half, visible = plate(0.1, 6.0, hidden=0.1)
    points = track.points(half)
    assert 0.85 * visible.sum() < len(points) <= visible.sum()
    assert points[:, 0].min() > 0.09
    assert not len(track.points(plate(-0.3, 6.0)[0]))


def test_points_lie_in_the_frame_of_any_camera(track: Track) -> None:
    """A camera 5 cm to the right sees the plate 5 cm to the left."""
    frame, mask = plate(0.05, 6.0)
    points = track.points(frame, geometry.make_transform(np.eye(3), [0.05, 0.0, 0.0]))
    assert len(points) > 0.9 * mask.sum()
    assert points[:, 0].mean() == pytest.approx(0.05, abs=0.002)


def test_the_box_bounds_what_was_seen(track: Track) -> None:
    box = track.bounding_box()
    assert box is not None
    # Voxels hold means of their measurements, so that the outline is up to a voxel of two pixels narrower.
    np.testing.assert_allclose(box.extent, [WIDTH, HEIGHT, 0], atol=0.015)
    center = track.world_T_object[-1] @ box.object_T_box[:, 3]
    np.testing.assert_allclose(center[:3], [0.1, 0, 1], atol=0.005)


def test_confidence_is_the_mean_score_and_falls_with_gaps(track: Track) -> None:
    assert track.confidence == pytest.approx(0.8)
    doubted = Track(2, [0, 1, 2], [np.eye(4)] * 3, [0, 1, 1], [0.9, 0.9, 0.7], gaps=[1.5, 1.7])
    assert doubted.confidence == pytest.approx((0.9 + 0.7) / 4)
    assert Track(3).confidence == 0


def test_a_track_can_be_pickled(track: Track) -> None:
    again = pickle.loads(pickle.dumps(track))
    frame, _ = plate(0.1, 6.0)
    np.testing.assert_array_equal(again.points(frame), track.points(frame))


def test_without_a_model_there_are_no_points_and_no_box() -> None:
    empty = Track(1, [0.0], [np.eye(4)], [1], [0.9])
    assert empty.points(plate(0.0, 0.0)[0]).shape == (0, 3)
    assert empty.bounding_box() is None
