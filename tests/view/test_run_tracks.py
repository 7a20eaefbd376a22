"""Trails in the overlays of a run: they end at the object's arrow and pass through its start."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.methods.base import Estimator
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.view.run_tracks import RunTracks

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


class Wall:
    """Three frames of a wall."""

    def __len__(self) -> int:
        return 3

    def timestamp(self, index: int) -> float | None:
        return 10.0 + index

    def __getitem__(self, index: int) -> RgbdFrame:
        color = np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        return RgbdFrame(color, np.full((48, 64), 1.0, np.float32), CAMERA)


def motion_to(left: int) -> SceneMotion:
    """A patch that moved 3 cm to the right and turned by 10 degrees about the optical axis."""
    labels = np.zeros((48, 64), np.int32)
    labels[15:30, left : left + 20] = 1
    center = np.array([(left + 9.5 - 31.5) / 60, (22 - 23.5) / 60, 1.0])
    rotation = geometry.so3_exp([0.0, 0.0, np.radians(10)])
    back = geometry.make_transform(rotation, center + np.array([-0.03, 0.0, 0.0]) - rotation @ center)
    flow = np.zeros((48, 64, 3), np.float32)
    return SceneMotion(labels, flow, (ObjectMotion(1, 300, 0.9, True, center, back),))


def test_a_trail_ends_at_the_arrow() -> None:
    def never(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        raise AssertionError("a known motion was estimated")

    source = Wall()
    estimator: Estimator = never  # type: ignore[assignment]
    tracks = RunTracks(source, [[0, 1, 2]], estimator)  # type: ignore[arg-type]
    for prev, left in ((0, 20), (1, 22)):
        motion = motion_to(left)
        step, marks = tracks.add(prev, prev + 1, source[prev + 1], motion)
        obj = step.motion.objects[0]
        (trail,) = marks.trails.values()
        assert len(trail) == prev + 2
        np.testing.assert_allclose(trail[-1], obj.center, atol=1e-9)
        if not prev:
            np.testing.assert_allclose(trail[-2], obj.prev_center, atol=1e-9)
    first, second = tracks.frames(step, 1, 2)
    assert (first.seconds, second.seconds) == (1.0, 2.0)
    assert second.objects[0].path is not None
