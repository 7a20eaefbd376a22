"""Pairs whose camera is lost, in runs and in the viewer."""

from __future__ import annotations

import numpy as np

import analytic
from objectflow.methods.labels import unknown_motion
from objectflow.tracking import Tracker
from objectflow.view.viewer_frames import tracked_frames


def test_a_pair_with_an_unknown_camera_is_shown_without_objects() -> None:
    scene = analytic.make_scene(5, width=80, height=60)
    tracker, motion = Tracker(), unknown_motion((60, 80))
    ids = tracker.update(0.0, scene.curr, 1.0, motion)
    shown = tracked_frames(tracker, ids, (scene.prev, scene.curr), motion, (0, 1), (0.0, 1.0))
    for frame in shown:
        np.testing.assert_array_equal(frame.world_T_camera, np.eye(4))
        assert frame.objects == ()
