"""Validation of `SceneMotion`, and result folders that round-trip or are refused."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from objectflow import ObjectMotion, SceneMotion
from objectflow.errors import ResultError, StorageError


def make_object(label: int, rng: np.random.Generator) -> ObjectMotion:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    return ObjectMotion(label, int(rng.integers(100)), float(rng.random()), label % 2 == 0, rng.normal(size=3), T)


def make_motion(**changes: Any) -> SceneMotion:
    rng = np.random.default_rng(0)
    flow = rng.normal(size=(6, 8, 3)).astype(np.float32)
    flow[2, 3:5] = np.nan
    objects = tuple(make_object(label, rng) for label in (1, 3, 65535))
    values: dict[str, Any] = {
        "labels": rng.choice(np.array([0, 1, 3, 65535], np.int32), (6, 8)),
        "scene_flow": flow,
        "objects": objects,
        "camera_motion": objects[0].prev_T_curr,
        "method": "made up",
        "seconds": 0.1 + 0.2,
    }
    return SceneMotion(**(values | changes))


def test_rotation_and_translation_are_about_the_center() -> None:
    obj = make_object(1, np.random.default_rng(1))
    R = Rotation.from_rotvec(obj.rotation_vector).as_matrix()
    np.testing.assert_allclose(R, obj.prev_T_curr[:3, :3], atol=1e-12)
    point = np.array([0.3, 0.2, 1.0])
    moved = R @ (point - obj.center) + obj.center + obj.translation
    np.testing.assert_allclose(moved, obj.prev_T_curr[:3, :3] @ point + obj.prev_T_curr[:3, 3], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"labels": np.zeros((6, 8), np.int64)}, r"labels must be \(H, W\) int32"),
        ({"labels": np.zeros((6, 8, 1), np.int32)}, r"labels must be \(H, W\) int32"),
        ({"scene_flow": np.zeros((8, 6, 3), np.float32)}, r"scene_flow must be \(6, 8, 3\) float32"),
        ({"scene_flow": np.zeros((6, 8, 3))}, "scene_flow must be .* float32, not .* float64"),
        ({"objects": ()}, r"labels \[1, 3, 65535\] belong to no object"),
        ({"labels": np.full((6, 8), -1, np.int32)}, "belong to no object"),
        ({"objects": make_motion().objects[::-1]}, "ids must be rising"),
        ({"objects": (make_object(0, np.random.default_rng(0)),)}, "from 1"),
        ({"camera_motion": np.eye(3)}, "camera_motion must be a rigid 4x4 transform"),
    ],
)
def test_an_inconsistent_result_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ResultError, match=message):
        make_motion(**changes)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", ["e", "f", "d", "g"])
def test_objects_take_every_float_type_and_refuse_what_is_not_finite(kind: str) -> None:
    # The largest distance exceeds the range of half precision, and the numbers of long double exceed float64.
    T, center = np.eye(4, dtype=kind), np.array([0.1, 0.2, 60000], kind)
    obj = ObjectMotion(1, 5, 0.5, True, center, T)
    np.testing.assert_allclose(obj.translation, 0, atol=1e-12)
    largest = np.finfo(np.dtype(kind)).max if kind != "e" else np.float16(np.inf)
    with pytest.raises(ResultError, match="its center is not finite"):
        ObjectMotion(1, 5, 0.5, True, np.array([0, largest, 0], kind), T)
    T[1, 3] = largest
    with pytest.raises(ResultError, match="not a rigid 4x4"):
        ObjectMotion(1, 5, 0.5, True, center, T)


@pytest.mark.parametrize(
    "motion",
    [
        make_motion(),
        make_motion(camera_motion=None),
        make_motion(labels=np.zeros((6, 8), np.int32), objects=(), camera_motion=None),
    ],
    ids=["full", "static camera", "no objects"],
)
def test_a_result_round_trips_bit_by_bit(tmp_path: Path, motion: SceneMotion) -> None:
    motion.save(tmp_path / "deep" / "out")
    assert {path.name for path in (tmp_path / "deep" / "out").iterdir()} == {
        "labels.png",
        "scene_flow.npy",
        "objects.json",
    }
    loaded = SceneMotion.load(str(tmp_path / "deep" / "out"))
    assert loaded.labels.dtype == np.int32
    assert loaded.labels.tobytes() == motion.labels.tobytes()
    assert loaded.scene_flow.tobytes() == motion.scene_flow.tobytes()
    assert (loaded.method, loaded.seconds) == (motion.method, motion.seconds)
    assert len(loaded.objects) == len(motion.objects)
    for a, b in zip(loaded.objects, motion.objects, strict=True):
        assert (a.id, a.pixels, a.score, a.moving) == (b.id, b.pixels, b.score, b.moving)
        assert a.center.tobytes() == b.center.tobytes()
        assert a.prev_T_curr.tobytes() == b.prev_T_curr.tobytes()
    if motion.camera_motion is None:
        assert loaded.camera_motion is None
    else:
        assert loaded.camera_motion is not None
        assert loaded.camera_motion.tobytes() == motion.camera_motion.tobytes()


def test_the_files_have_the_documented_content(tmp_path: Path) -> None:
    motion = make_motion()
    motion.save(tmp_path / "out")
    labels = cv2.imread(str(tmp_path / "out" / "labels.png"), cv2.IMREAD_UNCHANGED)
    assert labels is not None
    assert labels.dtype == np.uint16
    np.testing.assert_array_equal(labels, motion.labels)
    np.testing.assert_array_equal(np.load(tmp_path / "out" / "scene_flow.npy"), motion.scene_flow)
    summary = json.loads((tmp_path / "out" / "objects.json").read_text())
    assert (summary["width"], summary["height"], summary["method"]) == (8, 6, "made up")
    assert sorted(summary["objects"][1]) == sorted(
        [
            *("id", "pixels", "score", "moving", "motion_known", "rigid", "center", "displacement_m", "rotation_deg"),
            *("own_prev_T_curr", "rotation_vector", "translation", "prev_T_curr"),
        ]
    )
    assert summary["format_version"] == 2
    assert summary["units"]["length"] == "metres"
    np.testing.assert_array_equal(summary["objects"][1]["translation"], motion.objects[1].translation)


def test_labels_that_do_not_fit_the_file_are_refused(tmp_path: Path) -> None:
    objects = (make_object(65536, np.random.default_rng(0)),)
    motion = make_motion(labels=np.full((6, 8), 65536, np.int32), objects=objects)
    with pytest.raises(ResultError, match="above 65535"):
        motion.save(tmp_path / "a" / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_content_is_refused_and_unchanged(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "labels.png").write_bytes(b"precious")
    with pytest.raises(ResultError, match="exists and is not empty"):
        make_motion().save(tmp_path / "out")
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "labels.png"]
    assert (tmp_path / "out" / "labels.png").read_bytes() == b"precious"


def refuse(*_: Any, **__: Any) -> None:
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize(
    ("owner", "step"),
    [(np, "save"), (Path, "write_bytes"), (Path, "write_text"), (os, "fsync"), (os, "rename")],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_nothing_is_left_behind_after_a_disk_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, owner: Any, step: str
) -> None:
    monkeypatch.setattr(owner, step, refuse)
    with pytest.raises(StorageError, match="No space left"):
        make_motion().save(tmp_path / "new" / "out")
    assert list(tmp_path.iterdir()) == []


def edit(**changes: Any) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        path = folder / "objects.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


def edit_object(**changes: Any) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        summary = json.loads((folder / "objects.json").read_text())
        summary["objects"][0] |= changes
        (folder / "objects.json").write_text(json.dumps(summary))

    return change


def put(name: str, content: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(content)


def cut(name: str, count: int) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-count])


def header(shape: str) -> bytes:
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


BROKEN: dict[str, tuple[Callable[[Path], object], str]] = {
    "no labels": (lambda folder: (folder / "labels.png").unlink(), "labels.png: no such file"),
    "no flow": (lambda folder: (folder / "scene_flow.npy").unlink(), "scene_flow.npy is missing"),
    "no objects": (lambda folder: (folder / "objects.json").unlink(), "objects.json is missing"),
    "no json": (put("objects.json", b"hello"), "Expecting value"),
    "json of bytes": (put("objects.json", b"\xff\xfe"), "can't decode byte|Expecting value"),
    "a list": (put("objects.json", b"[]"), "list indices"),
    "deep json": (put("objects.json", b"[" * 200_000), "nested too deeply"),
    "no method": (put("objects.json", b'{"width": 8, "height": 6}'), "is missing|has shape"),
    "endless number": (edit(seconds=10**400), "seconds must lie in"),
    "no seconds": (edit(seconds=None), "seconds must be a number"),
    "camera of 3": (edit(camera_motion=[1, 2, 3]), "rigid 4x4 transform"),
    "ragged camera": (edit(camera_motion=[[1], [1, 2]]), "inhomogeneous shape"),
    "other size": (edit(width=9), "another size"),
    "objects of nothing": (edit(objects=[]), "belong to no object"),
    "objects of text": (edit(objects="abc"), "string indices"),
    "infinite id": (edit_object(id=float("inf")), "whole number"),
    "center of 2": (edit_object(center=[1, 2]), "no center"),
    "no motion": (edit_object(prev_T_curr=None), "not a rigid 4x4 transform"),
    "motion of NaN": (edit_object(prev_T_curr=[[float("nan")] * 4] * 4), "not a rigid 4x4 transform"),
    "labels cut": (cut("labels.png", 20), "cut off"),
    "labels empty": (put("labels.png", b""), "not an image"),
    "labels in colour": (put("labels.png", cv2.imencode(".png", np.zeros((6, 8, 3)))[1].tobytes()), "shape"),
    "flow cut": (cut("scene_flow.npy", 4), "bytes follow"),
    "flow empty": (put("scene_flow.npy", b""), "reading magic string"),
    "flow a zip": (put("scene_flow.npy", b"PK\x03\x04 and more"), "magic"),
    "flow too large": (put("scene_flow.npy", header("(600000000, 80000000, 3)")), "bytes follow"),
    "flow's header torn": (put("scene_flow.npy", header("(6, 8, 3")), "EOF|never closed"),
    "flow of objects": (
        put("scene_flow.npy", header("(1,)").replace(b"'<f4'", b"'|O' ") + b"cos\nsystem\n(S'true'\ntR."),
        "a pickle",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_the_error_for_a_broken_folder_is_one_line_and_names_it(tmp_path: Path, case: str) -> None:
    damage, message = BROKEN[case]
    make_motion().save(tmp_path / "out")
    SceneMotion.load(tmp_path / "out")
    damage(tmp_path / "out")
    with pytest.raises(ResultError, match=message) as caught:
        SceneMotion.load(tmp_path / "out")
    assert str(tmp_path / "out") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_paths_that_are_not_result_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "nowhere", tmp_path / "file", "nul\0byte"):
        with pytest.raises(ResultError, match="not a result folder"):
            SceneMotion.load(path)


def test_notes_and_the_state_of_the_camera_survive_a_round_trip(tmp_path: Path) -> None:
    flow = np.full((6, 8, 3), np.nan, np.float32)
    notes = ("camera: unknown: nothing fits", "light: exposure changed")
    unknown = SceneMotion(np.zeros((6, 8), np.int32), flow, camera_known=False, notes=notes)
    states = {"unknown": unknown, "static": make_motion(camera_motion=None), "moving": make_motion()}
    for state, motion in states.items():
        motion.save(tmp_path / state)
        loaded = SceneMotion.load(tmp_path / state)
        assert loaded.camera == motion.camera == state
        assert loaded.notes == motion.notes
        assert json.loads((tmp_path / state / "objects.json").read_text())["camera"] == state
    assert unknown != SceneMotion(unknown.labels, flow)
