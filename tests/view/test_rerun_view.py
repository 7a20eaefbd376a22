"""The rerun viewer: content of a saved recording, read back with rerun's reader; and the null viewer."""

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
from numpy.typing import NDArray

from objectflow import Camera, RgbdFrame, geometry
from objectflow.motion import ObjectMotion, SceneMotion
from objectflow.tracking.tracker import Tracker
from objectflow.view.colors import object_color
from objectflow.view.viewer import NoViewer, open_viewer
from objectflow.view.viewer_frames import NO_TRACK, ViewerFrame, pair_frames, tracked_frames

CAMERA = Camera(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)


def frame(time: float) -> RgbdFrame:
    color = np.random.default_rng(7).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    return RgbdFrame(color=color, depth=np.full((24, 32), 0.9, np.float32), camera=CAMERA, timestamp=time)


def make_motion(*, camera_moves: bool = False) -> SceneMotion:
    """Object 1 moved 3 cm to the right and rotated by 0.2 rad; object 2 is static."""
    labels = np.zeros((24, 32), np.int32)
    labels[4:12, 4:14], labels[14:20, 18:28] = 1, 2
    center = np.array([-0.2, -0.1, 0.9])
    rotation = geometry.so3_exp([0.0, 0.0, 0.2])
    moved = geometry.make_transform(rotation, center + np.array([-0.03, 0.0, 0.0]) - rotation @ center)
    flow = np.zeros((24, 32, 3), np.float32)
    flow[labels == 1] = [-0.03, 0, 0]
    camera = geometry.make_transform(np.eye(3), [0.0, 0.0, 0.05]) if camera_moves else None
    rest = np.eye(4) if camera is None else camera
    objects = (
        ObjectMotion(1, 80, 0.9, True, center, moved),
        ObjectMotion(2, 60, 0.9, False, np.array([0.2, 0.15, 0.9]), rest),
    )
    return SceneMotion(labels, flow, objects, camera)


def test_a_pair_has_the_objects_previous_and_current_poses() -> None:
    before, after = pair_frames(frame(5.0), frame(5.5), make_motion(camera_moves=True))
    assert (before.seconds, after.seconds) == (0.0, 0.5)
    np.testing.assert_allclose(after.world_T_camera[:3, 3], [0, 0, 0.05])
    start, pose = before.objects[0].world_T_object, after.objects[0].world_T_object
    np.testing.assert_allclose(start[:3, 3], [-0.23, -0.1, 0.9])
    # Forward in time the rotation is inverted, and the camera moved by 5 cm.
    np.testing.assert_allclose(pose[:3, 3], [-0.2, -0.1, 0.95])
    np.testing.assert_allclose(pose[:3, :3], geometry.so3_exp([0, 0, -0.2]), atol=1e-12)
    assert after.objects[0].path is not None
    np.testing.assert_allclose(after.objects[0].path, [start[:3, 3], pose[:3, 3]])
    assert after.objects[0].caption == "5.8 cm, 11°"  # sqrt(3**2 + 5**2) cm, 0.2 rad
    assert after.objects[1].path is None


def test_tracked_frames_have_track_ids() -> None:
    tracker, motion = Tracker(), make_motion()
    tracks = tracker.update(5.0, frame(5.5), 5.5, motion)
    before, after = tracked_frames(tracker, tracks, (frame(5.0), frame(5.5)), motion, (3, 8), (0.0, 0.5))
    assert [obj.id for obj in after.objects] == [tracker.tracks[0].id]
    assert (before.number, after.number) == (3, 8)
    assert after.ids is not None
    np.testing.assert_array_equal(after.ids == tracker.tracks[0].id, motion.labels == 1)
    np.testing.assert_array_equal(after.ids == NO_TRACK, motion.labels == 2)
    np.testing.assert_allclose(after.objects[0].world_T_object, tracker.tracks[0].world_T_object[-1])


def test_the_null_viewer_makes_no_frames(tmp_path: Path) -> None:
    def never() -> Iterable[ViewerFrame]:
        raise AssertionError("frames were made although there is no viewer")

    before = set(sys.modules)
    with open_viewer("nothing") as viewer:
        assert isinstance(viewer, NoViewer)
        viewer.show(never)
    assert not {name for name in set(sys.modules) - before if name.startswith("rerun")}
    assert list(tmp_path.iterdir()) == []


def test_the_error_for_a_missing_rerun_names_the_extra(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['rerun'] = None\n"
        "from pathlib import Path\nfrom objectflow.view.viewer import open_viewer\n"
        f"open_viewer('x', save=Path({str(tmp_path / 'x.rrd')!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "MissingExtraError" in done.stderr.splitlines()[-1]
    assert '[view]"' in done.stderr.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


def read_back(path: Path) -> dict[str, list[Any]]:
    """The chunks of a recording by entity."""
    module = pytest.importorskip("rerun.chunk")
    found = defaultdict(list)
    for chunk in module.RrdReader(str(path)).stream():
        found[chunk.entity_path].append(chunk)
    return found


def static_values(chunks: list[Any], name: str) -> list[Any]:
    """The values of a component that is logged without a time."""
    tables = [chunk.to_record_batch() for chunk in chunks]
    columns = [table.column(field) for table in tables for field in table.schema.names if field.endswith(name)]
    return [value for column in columns for value in column.to_pylist()]


def column(chunks: list[Any], name: str) -> list[Any]:
    """The values of a component in order of frame number."""
    rows: list[tuple[int, Any]] = []
    for chunk in chunks:
        table = chunk.to_record_batch()
        names = [field for field in table.schema.names if field.endswith(name)]
        if names and "frame" in table.schema.names:
            rows += zip(table.column("frame").to_pylist(), table.column(names[0]).to_pylist(), strict=True)
    return [value for _, value in sorted(rows, key=lambda row: row[0]) if value is not None]


def test_a_saved_file_holds_images_points_arrows_and_poses(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")
    path = tmp_path / "view.rrd"
    with open_viewer("test", save=path) as viewer:
        viewer.show(lambda: pair_frames(frame(5.0), frame(5.5), make_motion()))
        viewer.show(lambda: pair_frames(frame(5.0), frame(5.5), make_motion()))  # Has been shown.
    assert [file.name for file in tmp_path.iterdir()] == ["view.rrd"]
    found = read_back(path)
    timed = {"world/camera", "world/camera/color", "world/camera/depth", "world/camera/labels", "world/motion"}
    timed |= {"world/points/by_object", "world/points/by_flow", "world/objects/001", "world/objects/002"}
    assert {f"/{name}" for name in timed} | {"/world"} <= set(found)
    for name in timed:
        assert all({"frame", "seconds"} <= set(chunk.timeline_names) for chunk in found[f"/{name}"])
    points = column(found["/world/points/by_object"], "Points3D:positions")
    assert [len(positions) for positions in points] == [24 * 32, 24 * 32]  # Logged once per frame.
    np.testing.assert_allclose(np.array(points[1])[:, 2], 0.9, atol=1e-6)
    arrows = column(found["/world/motion"], "Arrows3D:vectors")
    assert [len(vectors) for vectors in arrows] == [0, 1]
    np.testing.assert_allclose(arrows[1][0], [0.03, 0, 0], atol=1e-6)
    poses = column(found["/world/objects/001"], "Transform3D:translation")
    np.testing.assert_allclose(np.array(poses).reshape(2, 3), [[-0.23, -0.1, 0.9], [-0.2, -0.1, 0.9]], atol=1e-6)
    labels = column(found["/world/camera/labels"], "SegmentationImage:buffer")
    raw = np.array(labels[1]).ravel().astype(np.uint8).tobytes()
    np.testing.assert_array_equal(np.frombuffer(raw, np.uint16).reshape(24, 32), make_motion().labels)


def test_only_objects_that_disappear_are_cleared(tmp_path: Path) -> None:
    """rerun hides a pose if a `Clear` is logged at the same time, in any order."""
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")
    path = tmp_path / "view.rrd"
    before, after = pair_frames(frame(5.0), frame(5.5), make_motion())
    with open_viewer("test", save=path) as viewer:
        viewer.show(lambda: [before, dataclasses.replace(after, objects=after.objects[:1])])
    found = read_back(path)
    assert column(found["/world/objects/001"], "Clear:is_recursive") == []
    assert column(found["/world/objects/002"], "Clear:is_recursive") == [[False]]
    assert not any(
        "Clear" in name for chunk in found["/world/objects"] for name in chunk.to_record_batch().schema.names
    )


def test_arrows_lie_in_front_of_their_objects(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")
    path = tmp_path / "view.rrd"
    with open_viewer("test", save=path) as viewer:
        viewer.show(lambda: pair_frames(frame(5.0), frame(5.5), make_motion()))
    found = read_back(path)
    tip = np.add(column(found["/world/motion"], "Arrows3D:origins")[1][0], [0.03, 0, 0])
    # The tip lies on the ray through the centre, 1 cm in front of the object's nearest points.
    center = np.array([-0.2, -0.1, 0.9])
    np.testing.assert_allclose(np.cross(tip, center), 0, atol=1e-6)
    mask = make_motion().labels == 1
    ranges = np.linalg.norm(geometry.back_project(frame(0).depth, CAMERA)[mask], axis=1)
    assert np.linalg.norm(tip) == pytest.approx(np.percentile(ranges, 2) - 0.01, abs=1e-5)
    assert column(found["/world/captions"], "Points3D:labels")[1] == ["object 1: 3.0 cm, 11°"]
    caption = column(found["/world/captions"], "Points3D:positions")[1][0]
    assert geometry.project(np.array([caption], np.float64), CAMERA)[0, 1] < np.nonzero(mask)[0].min()


def test_points_of_objects_are_coloured_and_others_are_grey(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")
    path = tmp_path / "view.rrd"
    with open_viewer("test", save=path) as viewer:
        viewer.show(lambda: pair_frames(frame(5.0), frame(5.5), make_motion()))
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
            viewer.show(lambda: pair_frames(frame(5.0), frame(5.5), make_motion()))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        show_then_fail()
    assert os.listdir(tmp_path) == []


def point_colors(entity: Any, row: int) -> NDArray[Any]:
    """(N, 3) colours of the points that an entity has in one of its frames."""
    rgba = np.array(column(entity, "Points3D:colors")[row], np.uint32).ravel()
    return np.stack([rgba >> 24, (rgba >> 16) & 255, (rgba >> 8) & 255], -1)


def test_trails_and_photographic_colours_are_logged(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")
    path = tmp_path / "view.rrd"
    before, after = pair_frames(frame(5.0), frame(5.5), make_motion())
    with open_viewer("test", save=path) as viewer:
        viewer.show(lambda: [before, after])
    found = read_back(path)
    strips = column(found["/world/trails"], "LineStrips3D:strips")
    assert [len(frame_strips) for frame_strips in strips] == [0, 1]  # Object 2 rests.
    expected = [obj.world_T_object[:3, 3] for obj in (before.objects[0], after.objects[0])]
    np.testing.assert_allclose(strips[1][0], expected, atol=1e-6)
    np.testing.assert_array_equal(
        point_colors(found["/world/points/by_color/rest"], 1), frame(5.5).color.reshape(-1, 3)
    )


def test_models_are_logged_at_the_poses_of_their_objects(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")
    path, model = tmp_path / "view.rrd", tmp_path / "object_001.glb"
    model.write_bytes(b"glTF, as read by the viewer")
    before, after = (
        dataclasses.replace(shown, objects=(dataclasses.replace(shown.objects[0], model=model), *shown.objects[1:]))
        for shown in pair_frames(frame(5.0), frame(5.5), make_motion())
    )
    with open_viewer("test", save=path, models=True) as viewer:
        viewer.show(lambda: [before, after, dataclasses.replace(after, number=2, objects=())])
    found = read_back(path)
    assert not any(name.startswith("/world/models/002") for name in found)
    blobs = column(found["/world/models/001"], "Asset3D:blob")
    assert len(blobs) == 1  # Once, when the object appears.
    assert bytes(np.array(blobs[0], np.uint8).ravel()) == model.read_bytes()
    poses = column(found["/world/models/001"], "Transform3D:translation")
    expected = [shown.objects[0].world_T_object[:3, 3] for shown in (before, after)]
    np.testing.assert_allclose(np.array(poses).reshape(2, 3), expected, atol=1e-6)
    assert column(found["/world/models/001"], "Clear:is_recursive") == [[False]]
    # Points of an object without a model stay.
    labels = make_motion().labels
    for name, mask in (("modelled", labels == 1), ("rest", labels != 1)):
        rgb = point_colors(found[f"/world/points/by_color/{name}"], 1)
        np.testing.assert_array_equal(rgb, frame(5.5).color[mask])


def test_masks_without_a_track_stay_grey_when_objects_appear(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed (extra `view`)")
    path = tmp_path / "view.rrd"
    before, after = pair_frames(frame(5.0), frame(5.5), make_motion())
    with open_viewer("test", save=path) as viewer:
        viewer.show(lambda: [dataclasses.replace(before, objects=before.objects[:1]), after])
    contexts = static_values(read_back(path)["/world"], "AnnotationContext:context")
    assert len(contexts) == 2
    (context,) = contexts[-1]
    colors = [(entry["class_id"], entry["class_description"]["info"]["color"]) for entry in context]
    assert [number for number, _ in colors] == [0, NO_TRACK, 1, 2]
    assert colors[1][1] == 0xADB5BDFF
    assert colors[2][1] >> 8 == int.from_bytes(bytes(object_color(1)), "big")
