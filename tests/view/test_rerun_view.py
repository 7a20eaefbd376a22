"""The rerun viewer: what a saved recording holds, read back with rerun's own reader; and everything off."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from objectflow import Camera, RgbdFrame, geometry
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.tracking.tracker import Tracker
from objectflow.view.colors import object_color
from objectflow.view.viewer import NoViewer, open_viewer
from objectflow.view.viewer_frames import NO_TRACK, ViewerFrame, pair_moments, tracked_moments

CAMERA = Camera(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)


def frame(time: float) -> RgbdFrame:
    color = np.random.default_rng(7).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    return RgbdFrame(color=color, depth=np.full((24, 32), 0.9, np.float32), camera=CAMERA, timestamp=time)


def make_motion(*, camera_moves: bool = False) -> SceneMotion:
    """Object 1 came 3 cm from the left and turned by 0.2; object 2 rests."""
    labels = np.zeros((24, 32), np.int32)
    labels[4:12, 4:14], labels[14:20, 18:28] = 1, 2
    center = np.array([-0.2, -0.1, 0.9])
    turn = geometry.so3_exp([0.0, 0.0, 0.2])
    moved = geometry.make_transform(turn, center + np.array([-0.03, 0.0, 0.0]) - turn @ center)
    flow = np.zeros((24, 32, 3), np.float32)
    flow[labels == 1] = [-0.03, 0, 0]
    camera = geometry.make_transform(np.eye(3), [0.0, 0.0, 0.05]) if camera_moves else None
    rest = np.eye(4) if camera is None else camera
    objects = (
        ObjectMotion(1, 80, 0.9, True, center, moved),
        ObjectMotion(2, 60, 0.9, False, np.array([0.2, 0.15, 0.9]), rest),
    )
    return SceneMotion(labels, flow, objects, camera)


def test_the_poses_of_a_pair_are_where_the_object_was_and_is() -> None:
    before, after = pair_moments(frame(5.0), frame(5.5), make_motion(camera_moves=True))
    assert (before.seconds, after.seconds) == (0.0, 0.5)
    np.testing.assert_allclose(after.world_T_camera[:3, 3], [0, 0, 0.05])
    start, pose = before.objects[0].world_T_object, after.objects[0].world_T_object
    np.testing.assert_allclose(start[:3, 3], [-0.23, -0.1, 0.9])
    # Forward in time it turns the other way about, and the camera has gone on 5 cm.
    np.testing.assert_allclose(pose[:3, 3], [-0.2, -0.1, 0.95])
    np.testing.assert_allclose(pose[:3, :3], geometry.so3_exp([0, 0, -0.2]), atol=1e-12)
    assert after.objects[0].way is not None
    np.testing.assert_allclose(after.objects[0].way, [start[:3, 3], pose[:3, 3]])
    assert after.objects[0].caption == "5.8 cm, 11°"  # sqrt(3**2 + 5**2) cm, 0.2 rad
    assert after.objects[1].way is None


def test_tracked_moments_carry_lasting_ids() -> None:
    tracker, motion = Tracker(), make_motion()
    found = tracker.update(5.0, frame(5.5), 5.5, motion)
    before, after = tracked_moments(tracker, found, (frame(5.0), frame(5.5)), motion, (3, 8), (0.0, 0.5))
    assert [obj.id for obj in after.objects] == [tracker.tracks[0].id]
    assert (before.number, after.number) == (3, 8)
    assert after.ids is not None
    np.testing.assert_array_equal(after.ids == tracker.tracks[0].id, motion.labels == 1)
    np.testing.assert_array_equal(after.ids == NO_TRACK, motion.labels == 2)
    np.testing.assert_allclose(after.objects[0].world_T_object, tracker.tracks[0].world_T_object[-1])


def test_off_means_that_nothing_is_made(tmp_path: Path) -> None:
    def never() -> Iterable[ViewerFrame]:
        raise AssertionError("made, though nobody looks")

    before = set(sys.modules)
    with open_viewer("nothing") as viewer:
        assert isinstance(viewer, NoViewer)
        viewer.show(never)
    assert not {name for name in set(sys.modules) - before if name.startswith("rerun")}
    assert list(tmp_path.iterdir()) == []


def test_a_missing_rerun_names_the_extra(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['rerun'] = None\n"
        "from pathlib import Path\nfrom objectflow.view.viewer import open_viewer\n"
        f"open_viewer('x', save=Path({str(tmp_path / 'x.rrd')!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "MissingExtraError" in done.stderr.splitlines()[-1]
    assert "objectflow[view]" in done.stderr.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


def read_back(path: Path) -> dict[str, list[Any]]:
    """The chunks of a recording by entity."""
    chunk = pytest.importorskip("rerun.chunk")
    found = defaultdict(list)
    for one in chunk.RrdReader(str(path)).stream():
        found[one.entity_path].append(one)
    return found


def column(chunks: list[Any], name: str) -> list[Any]:
    """The values of a component by frame number, later frames last."""
    rows: list[tuple[int, Any]] = []
    for one in chunks:
        table = one.to_record_batch()
        names = [field for field in table.schema.names if field.endswith(name)]
        if names and "frame" in table.schema.names:
            rows += zip(table.column("frame").to_pylist(), table.column(names[0]).to_pylist(), strict=True)
    return [value for _, value in sorted(rows, key=lambda row: row[0]) if value is not None]


def test_a_saved_file_holds_everything(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")
    path = tmp_path / "view.rrd"
    with open_viewer("test", save=path) as viewer:
        viewer.show(lambda: pair_moments(frame(5.0), frame(5.5), make_motion()))
        viewer.show(lambda: pair_moments(frame(5.0), frame(5.5), make_motion()))  # shown already
    assert [one.name for one in tmp_path.iterdir()] == ["view.rrd"]
    found = read_back(path)
    timed = {"world/camera", "world/camera/color", "world/camera/depth", "world/camera/labels", "world/motion"}
    timed |= {"world/points/by_object", "world/points/by_flow", "world/objects/001", "world/objects/002"}
    assert {f"/{name}" for name in timed} | {"/world"} <= set(found)
    for name in timed:
        assert all({"frame", "seconds"} <= set(one.timeline_names) for one in found[f"/{name}"])
    points = column(found["/world/points/by_object"], "Points3D:positions")
    assert [len(one) for one in points] == [24 * 32, 24 * 32]  # once a frame
    np.testing.assert_allclose(np.array(points[1])[:, 2], 0.9, atol=1e-6)
    arrows = column(found["/world/motion"], "Arrows3D:vectors")
    assert [len(one) for one in arrows] == [0, 1]
    np.testing.assert_allclose(arrows[1][0], [0.03, 0, 0], atol=1e-6)
    poses = column(found["/world/objects/001"], "Transform3D:translation")
    np.testing.assert_allclose(np.array(poses).reshape(2, 3), [[-0.23, -0.1, 0.9], [-0.2, -0.1, 0.9]], atol=1e-6)
    labels = column(found["/world/camera/labels"], "SegmentationImage:buffer")
    raw = np.array(labels[1]).ravel().astype(np.uint8).tobytes()
    np.testing.assert_array_equal(np.frombuffer(raw, np.uint16).reshape(24, 32), make_motion().labels)


def test_an_object_that_is_gone_is_cleared_and_no_other(tmp_path: Path) -> None:
    """The viewer does not draw a pose where the same time holds a clear of it, in whatever order they came."""
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")
    path = tmp_path / "view.rrd"
    before, after = pair_moments(frame(5.0), frame(5.5), make_motion())
    with open_viewer("test", save=path) as viewer:
        viewer.show(lambda: [before, dataclasses.replace(after, objects=after.objects[:1])])
    found = read_back(path)
    assert column(found["/world/objects/001"], "Clear:is_recursive") == []
    assert column(found["/world/objects/002"], "Clear:is_recursive") == [[False]]
    assert not any("Clear" in name for one in found["/world/objects"] for name in one.to_record_batch().schema.names)


def test_arrows_lie_before_what_they_belong_to(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")
    path = tmp_path / "view.rrd"
    with open_viewer("test", save=path) as viewer:
        viewer.show(lambda: pair_moments(frame(5.0), frame(5.5), make_motion()))
    found = read_back(path)
    tip = np.add(column(found["/world/motion"], "Arrows3D:origins")[1][0], [0.03, 0, 0])
    # On the ray through the centre, a centimetre nearer than the nearest of the object's points.
    center = np.array([-0.2, -0.1, 0.9])
    np.testing.assert_allclose(np.cross(tip, center), 0, atol=1e-6)
    mask = make_motion().labels == 1
    ranges = np.linalg.norm(geometry.back_project(frame(0).depth, CAMERA)[mask], axis=1)
    assert np.linalg.norm(tip) == pytest.approx(np.percentile(ranges, 2) - 0.01, abs=1e-5)
    assert column(found["/world/captions"], "Points3D:labels")[1] == ["object 1: 3.0 cm, 11°"]
    caption = column(found["/world/captions"], "Points3D:positions")[1][0]
    assert geometry.project(np.array([caption], np.float64), CAMERA)[0, 1] < np.nonzero(mask)[0].min()


def test_objects_points_have_their_colour_and_the_rest_is_grey(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")
    path = tmp_path / "view.rrd"
    with open_viewer("test", save=path) as viewer:
        viewer.show(lambda: pair_moments(frame(5.0), frame(5.5), make_motion()))
    values = column(read_back(path)["/world/points/by_object"], "Points3D:colors")[1]
    rgba = np.array(values, np.uint32).ravel()
    rgb = np.stack([rgba >> 24, (rgba >> 16) & 255, (rgba >> 8) & 255], -1).astype(int).reshape(24, 32, 3)
    labels = make_motion().labels
    assert (np.ptp(rgb[labels == 0], axis=-1) == 0).all()
    hue = rgb[labels == 1] / rgb[labels == 1].max(axis=-1, keepdims=True)
    np.testing.assert_allclose(hue, np.broadcast_to(np.array(object_color(1)) / 230, hue.shape), atol=0.02)


def test_a_failure_leaves_no_file(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")

    def show_then_fail() -> None:
        with open_viewer("test", save=tmp_path / "view.rrd") as viewer:
            viewer.show(lambda: pair_moments(frame(5.0), frame(5.5), make_motion()))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        show_then_fail()
    assert os.listdir(tmp_path) == []
