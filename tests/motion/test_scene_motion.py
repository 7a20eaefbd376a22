"""`SceneMotion` in use: access by id, equality, and the forms for other programs."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from objectflow import Camera, ObjectMotion, RgbdFrame, SceneMotion, geometry
from objectflow.errors import ResultError
from objectflow.motion.export import run_lengths
from objectflow.motion.palette import object_color

CAMERA = Camera(width=8, height=6, fx=10.0, fy=10.0, cx=3.5, cy=2.5)


def make_frame() -> RgbdFrame:
    random = np.random.default_rng(0)
    depth = np.full((6, 8), 0.5, np.float32)
    depth[0, 0] = 0
    return RgbdFrame(random.integers(0, 255, (6, 8, 3), dtype=np.uint8), depth, CAMERA)


def make_motion() -> SceneMotion:
    labels = np.zeros((6, 8), np.int32)
    labels[1:4, 2:5] = 1
    labels[4:, 6:] = 3
    turn = geometry.make_transform(geometry.so3_exp([0, 0, 0.2]), [0.1, 0, 0])
    objects = (
        ObjectMotion(1, 9, 0.9, True, np.array([0.0, 0, 0.5]), turn),
        ObjectMotion(3, 4, 0.4, False, np.array([0.1, 0.1, 0.5]), np.eye(4)),
    )
    points = geometry.back_project(make_frame().depth, CAMERA)
    flow = geometry.flow_from_motions(points, labels, {obj.id: obj.prev_T_curr for obj in objects})
    return SceneMotion(labels, flow, objects, method="consensus", settings={"camera": "static"})


def test_objects_are_found_by_their_ids() -> None:
    motion = make_motion()
    assert len(motion) == 2
    assert [obj.id for obj in motion] == [1, 3]
    assert motion[3] is motion.objects[1]
    assert [obj.id for obj in motion.moving] == [1]
    np.testing.assert_array_equal(motion.mask(3), motion.labels == 3)
    with pytest.raises(ResultError, match="no object 2: the ids are 1, 3"):
        motion[2]


def test_points_are_those_of_the_mask() -> None:
    motion, frame = make_motion(), make_frame()
    points = motion.points(1, frame)
    assert points.shape == (9, 3)
    pixels = geometry.project(points.astype(np.float64), CAMERA)
    assert (np.rint(pixels[:, 0]) >= 2).all()
    assert (np.rint(pixels[:, 1]) <= 3).all()
    with pytest.raises(ResultError, match="shape"):
        motion.points(1, frame.resized(4, 3))


def test_motions_are_inverted() -> None:
    obj = make_motion()[1]
    np.testing.assert_allclose(obj.curr_T_prev @ obj.prev_T_curr, np.eye(4), atol=1e-12)
    np.testing.assert_array_equal(make_motion().curr_T_prev, np.eye(4))
    moved = dataclasses.replace(make_motion(), camera_motion=obj.prev_T_curr)
    np.testing.assert_allclose(moved.curr_T_prev @ obj.prev_T_curr, np.eye(4), atol=1e-12)


def test_results_are_compared_by_value(tmp_path: Path) -> None:
    motion = make_motion()
    assert motion == make_motion()
    assert motion == dataclasses.replace(motion, seconds=3.0)
    motion.save(tmp_path / "result")
    loaded = SceneMotion.load(tmp_path / "result")
    assert loaded == motion
    assert loaded.settings == {"camera": "static"}
    other = motion.labels.copy()
    other[1, 2] = 0
    assert motion != dataclasses.replace(motion, labels=other)
    assert motion != dataclasses.replace(motion, camera_motion=np.eye(4))
    assert motion[1] != dataclasses.replace(motion[1], score=0.8)
    assert motion != "a result"


def test_texts_are_short() -> None:
    motion = make_motion()
    assert repr(motion) == "SceneMotion(8x6, 2 objects, 1 moving, static camera, 'consensus')"
    assert repr(motion[1]) == "ObjectMotion(1: moved 10.0 cm, 11.5 deg, score 0.90, 9 pixels)"
    assert "median 0.50 m" in repr(make_frame())
    assert repr(CAMERA) == "Camera(8x6, fx=10, fy=10, cx=3.5, cy=2.5)"


def test_notebooks_show_labels_and_a_table() -> None:
    page = make_motion()._repr_html_()
    data = re.search(r"base64,([^']*)'", page)
    assert data is not None
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data.group(1)), np.uint8), cv2.IMREAD_COLOR)
    assert tuple(image[2, 3][::-1].tolist()) == object_color(1)
    assert page.count("<tr>") == 3
    assert "<td>10.0</td>" in page


def decode_runs(counts: list[int], size: list[int]) -> np.ndarray:
    """Run lengths in column-major order as a mask, by the definition of the format."""
    values = np.concatenate([np.full(count, bool(k % 2)) for k, count in enumerate(counts)])
    return values.reshape(size, order="F")


def test_coco_masks_decode_to_the_labels() -> None:
    motion = make_motion()
    entries = json.loads(json.dumps(motion.to_coco(image_id=7)))
    assert [entry["id"] for entry in entries] == [1, 3]
    for entry in entries:
        segmentation = entry["segmentation"]
        np.testing.assert_array_equal(
            decode_runs(segmentation["counts"], segmentation["size"]), motion.mask(entry["id"])
        )
        assert entry["area"] == motion.mask(entry["id"]).sum()
        assert entry["image_id"] == 7
    assert entries[0]["bbox"] == [2, 1, 3, 3]


@pytest.mark.parametrize("corner", [True, False])
def test_runs_begin_with_background(corner: bool) -> None:
    mask = np.zeros((3, 2), bool)
    mask[0, 0] = corner
    assert run_lengths(mask) == ([0, 1, 5] if corner else [6])


def test_ply_is_read_by_another_library(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="reading PLY needs the extra [synth]")
    motion, frame = make_motion(), make_frame()
    motion.to_ply(tmp_path / "scene.ply", frame)
    cloud = trimesh.load(tmp_path / "scene.ply")
    np.testing.assert_allclose(cloud.vertices, geometry.back_project(frame.depth, CAMERA)[frame.valid], atol=1e-6)
    np.testing.assert_array_equal(cloud.colors[:, :3], frame.color[frame.valid])
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.ravel(raw["label"]), motion.labels[frame.valid])
    np.testing.assert_allclose(np.ravel(raw["flow_x"]), motion.scene_flow[frame.valid][:, 0], atol=1e-6)
