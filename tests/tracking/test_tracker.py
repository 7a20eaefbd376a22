"""Tracking of plates that slide in front of a wall, with known masks, motions, ids and trajectories."""

from __future__ import annotations

import dataclasses
import gc
import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objectflow import geometry
from objectflow.errors import FrameError, SettingsError
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.settings import build
from objectflow.tracking.seen_surface import footprint_overlap
from objectflow.tracking.tracker import Tracker
from objectflow.tracking.tracker_settings import TrackerSettings
from objectflow.tracking.trajectory_files import tum_lines, write_tracks
from objectflow.typing import Float64Array

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
HALF_PIXEL = 0.5 / 150
"""Half a pixel at 1 m, metres: largest distance between the mean of a plate's pixels and its centre."""


def plates(
    centers: dict[int, tuple[float, float]],
    before: dict[int, tuple[float, float]],
    *,
    camera_motion: Float64Array | None = None,
    order: tuple[int, ...] | None = None,
) -> tuple[RgbdFrame, SceneMotion, dict[int, int]]:
    """Square plates of 24 cm at 1 m in front of a wall at 2 m, keyed by plate number.

    Returns the current frame, the motion, and the object id of each plate number; `order` permutes the ids.
    """
    depth = np.full((120, 160), 2.0, np.float32)
    labels = np.zeros((120, 160), np.int32)
    ids = {number: k for k, number in enumerate(order or tuple(centers), start=1)}
    objects = []
    v, u = np.mgrid[0:120, 0:160]
    for number in sorted(ids, key=lambda n: ids[n]):
        x, y = centers[number]
        inside = (np.abs((u - 79.5) / 150 - x) < 0.12) & (np.abs((v - 59.5) / 150 - y) < 0.12)
        labels[inside], depth[inside] = ids[number], 1.0
        motion = np.eye(4)
        motion[:2, 3] = np.array(before[number]) - centers[number]
        if camera_motion is not None:
            motion = camera_motion @ motion
        center = np.array([x, y, 1.0])
        objects.append(ObjectMotion(ids[number], int(inside.sum()), 0.9, True, center, motion))
    frame = RgbdFrame(np.zeros((120, 160, 3), np.uint8), depth, CAMERA)
    flow = np.zeros((120, 160, 3), np.float32)
    return frame, SceneMotion(labels, flow, tuple(objects), camera_motion), ids


def test_track_ids_persist_when_pairs_number_their_objects_differently() -> None:
    tracker = Tracker()
    paths = {1: [(-0.3 + 0.03 * t, 0.0) for t in range(6)], 2: [(0.3 - 0.03 * t, 0.02 * t) for t in range(6)]}
    track_ids: dict[int, set[int]] = {1: set(), 2: set()}
    for t in range(1, 6):
        order = (1, 2) if t % 2 else (2, 1)
        frame, motion, ids = plates(
            {n: p[t] for n, p in paths.items()}, {n: p[t - 1] for n, p in paths.items()}, order=order
        )
        found = tracker.update(t - 1, frame, t, motion)
        for number, label in ids.items():
            track_ids[number].add(found[label])
    assert len(tracker.tracks) == 2
    assert sorted(map(len, track_ids.values())) == [1, 1]
    for number, path in paths.items():
        track = tracker.tracks[track_ids[number].pop() - 1]
        assert track.times == [0, 1, 2, 3, 4, 5]
        positions = np.array([pose[:2, 3] for pose in track.world_T_object])
        # The mean of a plate's pixels deviates from its centre by up to half a pixel.
        np.testing.assert_allclose(positions, path, atol=HALF_PIXEL)
        np.testing.assert_allclose(np.diff(positions, axis=0), np.diff(path, axis=0), atol=1e-9)


@pytest.mark.parametrize("jump", [0.06, 0.24])
def test_an_object_whose_motion_is_wrong_goes_on_with_a_gap_in_its_place(jump: float) -> None:
    """The motion of the second pair leads to a place 30 cm away; the plate covers its last place by 60 % or not."""
    tracker = Tracker()
    first = plates({1: (0.0, 0.0)}, {1: (-0.03, 0.0)})
    tracker.update(0, first[0], 1, first[1])
    second = plates({1: (jump, 0.0)}, {1: (jump, 0.3)})
    found = tracker.update(1, second[0], 2, second[1])
    if jump > 0.2:
        assert found == {1: 2}
        return
    assert found == {1: 1}
    (track,) = tracker.tracks
    assert track.gaps == [2]
    np.testing.assert_allclose(track.world_T_object[-1][:3, 3], [jump, 0, 1], atol=2 * HALF_PIXEL)
    # The wrong motion predicts nothing.
    third = plates({1: (jump + 0.03, 0.0)}, {1: (jump, 0.0)})
    assert tracker.update(2, third[0], 3, third[1]) == {1: 1}


def test_an_object_of_other_colours_does_not_go_on_in_the_place_of_a_track() -> None:
    tracker = Tracker()
    first = plates({1: (0.0, 0.0)}, {1: (-0.03, 0.0)})
    tracker.update(0, first[0], 1, first[1])
    frame, motion, _ = plates({1: (0.03, 0.0)}, {1: (0.03, 0.3)})
    red = dataclasses.replace(frame, color=np.full_like(frame.color, (200, 30, 30)))
    assert tracker.update(1, red, 2, motion) == {1: 2}


def test_rotations_are_chained() -> None:
    tracker = Tracker()
    frame, motion, _ = plates({1: (0.0, 0.0)}, {1: (0.0, 0.0)})
    rotation = np.eye(4)
    rotation[:3, :3] = Rotation.from_euler("z", -10, degrees=True).as_matrix()
    rotated = ObjectMotion(1, motion.objects[0].pixels, 0.9, True, motion.objects[0].center, rotation)
    for t in range(1, 4):
        tracker.update(t - 1, frame, t, SceneMotion(motion.labels, motion.scene_flow, (rotated,)))
    pose = tracker.tracks[0].world_T_object[-1]
    np.testing.assert_allclose(Rotation.from_matrix(pose[:3, :3]).as_rotvec(), [0, 0, np.radians(30)], atol=1e-9)


def test_an_object_that_rests_keeps_its_id_when_it_moves_again() -> None:
    tracker = Tracker()
    first = plates({1: (0.03, 0.0)}, {1: (0.0, 0.0)})
    rest = plates({}, {})
    again = plates({1: (0.08, 0.0)}, {1: (0.03, 0.0)})
    tracker.update(0, first[0], 1, first[1])
    for t in range(1, 20):
        assert tracker.update(t, rest[0], t + 1, rest[1]) == {}
    assert tracker.update(20, again[0], 21, again[1]) == {1: 1}
    assert tracker.tracks[0].times == [0, 1, 20, 21]
    positions = [pose[0, 3] for pose in tracker.tracks[0].world_T_object]
    np.testing.assert_allclose(positions, [0, 0.03, 0.03, 0.08], atol=HALF_PIXEL)
    np.testing.assert_allclose(np.diff(positions), [0.03, 0, 0.05], atol=1e-9)


def test_an_object_hidden_while_it_moves_is_searched_where_its_motion_predicts() -> None:
    path = [(-0.38 + 0.12 * t, 0.0) for t in range(8)]
    results = {}
    for coast in (0, 3):
        tracker = Tracker(TrackerSettings(coast=coast))
        for t in range(1, 8):
            hidden = t in (3, 4)
            frame, motion, _ = plates({} if hidden else {1: path[t]}, {} if hidden else {1: path[t - 1]})
            tracker.update(t - 1, frame, t, motion)
        results[coast] = len(tracker.tracks)
    assert results == {0: 2, 3: 1}


def test_the_cameras_motion_is_compensated() -> None:
    # The camera moves to the right by 5 cm per frame; an object that moves with it is static in the image.
    prev_T_curr = np.eye(4)
    prev_T_curr[0, 3] = 0.05
    tracker = Tracker()
    frame, motion, _ = plates({1: (0.0, 0.0)}, {1: (0.0, 0.0)}, camera_motion=np.eye(4))
    carried = ObjectMotion(1, motion.objects[0].pixels, 0.9, True, motion.objects[0].center, np.eye(4))
    for t in range(1, 4):
        tracker.update(t - 1, frame, t, SceneMotion(motion.labels, motion.scene_flow, (carried,), prev_T_curr))
    np.testing.assert_allclose([pose[0, 3] for pose in tracker.world_T_camera], [0, 0.05, 0.1, 0.15], atol=1e-12)
    np.testing.assert_allclose(np.diff([pose[0, 3] for pose in tracker.tracks[0].world_T_object]), 0.05, atol=1e-9)


def test_static_and_low_score_objects_get_no_track() -> None:
    frame, motion, _ = plates({1: (0.0, 0.0), 2: (0.3, 0.0)}, {1: (0.0, 0.0), 2: (0.25, 0.0)})
    static, moving = motion.objects
    objects = (
        ObjectMotion(1, static.pixels, 0.9, False, static.center, static.prev_T_curr),
        ObjectMotion(2, moving.pixels, 0.1, True, moving.center, moving.prev_T_curr),
    )
    tracker = Tracker()
    assert tracker.update(0, frame, 1, SceneMotion(motion.labels, motion.scene_flow, objects)) == {}
    assert tracker.tracks == []


@pytest.mark.parametrize(("absent", "tracks"), [(4, 1), (6, 2)])
def test_tracks_end_after_their_maximum_age(absent: int, tracks: int) -> None:
    """An object that reappears keeps its track up to the maximum age and gets a new one afterwards."""
    tracker = Tracker(TrackerSettings(max_age=5))
    visible, gone = plates({1: (0.02, 0.0)}, {1: (0.0, 0.0)}), plates({}, {})
    again = plates({1: (0.04, 0.0)}, {1: (0.02, 0.0)})
    tracker.update(0, visible[0], 1, visible[1])
    for t in range(1, 1 + absent):
        tracker.update(t, gone[0], t + 1, gone[1])
    assert tracker.update(absent + 1, again[0], absent + 2, again[1]) == {1: tracks}
    assert len(tracker.tracks) == tracks


def test_memory_is_bounded_while_objects_appear_and_disappear() -> None:
    tracker = Tracker(TrackerSettings(max_age=5, history=2))
    rng = np.random.default_rng(0)
    positions = rng.uniform(-0.4, 0.4, (150, 2)) * (1, 0.7)
    results = [plates({1: (x, y)}, {1: (x + 0.02, y)}) for x, y in positions]
    empty = [plates({}, {})] * 6  # Long enough for all tracks to end.
    time, largest_id, most_tracks = 0, 0, 0

    def track(results: list[tuple[RgbdFrame, SceneMotion, dict[int, int]]]) -> int:
        """Bytes in use after all tracks have ended."""
        nonlocal time, largest_id, most_tracks
        for frame, motion, _ in [*results, *empty]:
            tracker.update(time, frame, time + 1, motion)
            time += 1
            largest_id = max([largest_id, *(track.id for track in tracker.tracks)])
            most_tracks = max(most_tracks, len(tracker.tracks))
        assert tracker.tracks == []
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        used = [track(results[first : first + 50]) for first in (0, 50, 100)]
    finally:
        tracemalloc.stop()
    assert largest_id > 30
    assert most_tracks <= 6
    # A surface of 600 points takes 14 KB, and each window has dozens. A one-time allocation of a library would
    # increase one window only; surfaces kept by the tracker would increase all.
    assert min(np.diff(used)) < 20_000


def test_footprint_overlap() -> None:
    v, u = np.mgrid[0:40, 0:40]
    plate = geometry.back_project(np.ones((120, 160), np.float32), CAMERA)[v, u].reshape(-1, 3).astype(np.float64)
    half = plate + np.array([20 / 150, 0, 0])
    assert footprint_overlap(plate, plate, CAMERA, 64) == 1
    assert abs(footprint_overlap(plate, half, CAMERA, 64) - 1 / 3) < 0.08
    assert footprint_overlap(plate, plate + np.array([1, 0, 0]), CAMERA, 64) == 0
    assert footprint_overlap(plate, half, CAMERA, 1) == 1  # one cell


def test_invalid_settings_are_named() -> None:
    with pytest.raises(SettingsError, match="setting history must be at least 1, not 0"):
        TrackerSettings(history=0)
    with pytest.raises(SettingsError, match=r"unknown setting cells: choose one of min_overlap, .*, footprint_cells"):
        build(TrackerSettings, {"cells": 32})


def test_files(tmp_path: Path) -> None:
    tracker = Tracker()
    frame, motion, _ = plates({1: (0.03, 0.0)}, {1: (0.0, 0.0)})
    tracker.update(10.0, frame, 10.5, motion)
    write_tracks(tmp_path, tracker)
    write_tracks(tmp_path, tracker)
    tracks = json.loads((tmp_path / "tracks.json").read_text())["tracks"]
    assert [track["id"] for track in tracks] == [1]
    lines = np.loadtxt(tmp_path / "trajectories" / "object_001.txt")
    np.testing.assert_allclose(lines[:, 0], [10.0, 10.5])
    np.testing.assert_allclose(lines[1, 1:4] - lines[0, 1:4], [0.03, 0, 0], atol=1e-6)
    assert sorted(p.name for p in (tmp_path / "trajectories").iterdir()) == ["object_001.txt"]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    numbers = tum_lines([1.0], [pose]).splitlines()[1].split()
    np.testing.assert_allclose([float(x) for x in numbers[4:]], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-6)


def test_bad_input() -> None:
    frame, motion, _ = plates({1: (0.0, 0.0)}, {1: (0.0, 0.0)})
    tracker = Tracker()
    with pytest.raises(FrameError, match="in order of time"):
        tracker.update(2, frame, 1, motion)
    tracker.update(0, frame, 1, motion)
    with pytest.raises(FrameError, match="consecutive"):
        tracker.update(2, frame, 3, motion)
    small = SceneMotion(np.zeros((10, 10), np.int32), np.zeros((10, 10, 3), np.float32))
    with pytest.raises(FrameError, match="do not fit"):
        tracker.update(1, frame, 2, small)


def test_a_neighbour_of_another_colour_does_not_take_over_the_id_of_an_object_that_left() -> None:
    """The red plate leaves; the blue one slides to where the red one was."""

    def painted(centers: dict[int, tuple[float, float]], before: dict[int, tuple[float, float]]) -> RgbdFrame:
        frame, motion, ids = plates(centers, before)
        color = frame.color.copy()
        for number, rgb in ((1, (200, 30, 30)), (2, (30, 30, 200))):
            if number in ids:
                color[motion.labels == ids[number]] = rgb
        results.append((motion, ids))
        return RgbdFrame(color, frame.depth, CAMERA)

    results: list[tuple[SceneMotion, dict[int, int]]] = []
    tracker = Tracker()
    first = painted({1: (0.0, 0.0)}, {1: (-0.05, 0.0)})
    red = tracker.update(0, first, 1, results[0][0])[results[0][1][1]]
    second = painted({2: (0.05, 0.0)}, {2: (0.0, 0.0)})
    blue = tracker.update(1, second, 2, results[1][0])[results[1][1][2]]
    assert red != blue
    # Without the test of colours the id is taken over.
    naive = Tracker(TrackerSettings(min_color_similarity=0.0))
    assert list(naive.update(0, first, 1, results[0][0]).values()) == [1]
    assert list(naive.update(1, second, 2, results[1][0]).values()) == [1]


def test_steps_of_low_score_are_marked_as_gaps() -> None:
    tracker = Tracker()
    for t, score in ((1, 0.9), (2, 0.1), (3, 0.9)):
        frame, motion, _ = plates({1: (0.02 * t, 0.0)}, {1: (0.02 * (t - 1), 0.0)})
        objects = tuple(dataclasses.replace(obj, score=score) for obj in motion.objects)
        tracker.update(t - 1, frame, t, dataclasses.replace(motion, objects=objects))
    (track,) = tracker.tracks
    assert track.gaps == [2]
    assert track.times == [0, 1, 2, 3]  # the pose at 2 is that before the last step
    assert track.labels == [0, 1, 0, 1]


def test_tracks_start_anew_where_the_camera_is_unknown() -> None:
    tracker = Tracker()
    frame, motion, _ = plates({1: (0.02, 0.0)}, {1: (0.0, 0.0)})
    assert list(tracker.update(0, frame, 1, motion).values()) == [1]
    nothing = SceneMotion(np.zeros((120, 160), np.int32), motion.scene_flow * np.nan, camera_known=False)
    assert tracker.update(1, frame, 2, nothing) == {}
    assert list(tracker.update(2, frame, 3, motion).values()) == [2]
