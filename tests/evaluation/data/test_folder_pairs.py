"""Pair folders with a `truth.npz`: made from analytic scenes, and the shared real ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import analytic
from helpers.paths import SHARED
from objectflow.errors import DatasetError, ResultError
from objectflow.evaluation.data.folder_pairs import find_center, find_pairs, read_pair, read_pairs
from objectflow.evaluation.metrics.pair_score import score_pair
from objectflow.evaluation.oracles.oracle_masks import OracleMasks

DATA = SHARED / "data"


def write_pair(folder: Path, scene: analytic.AnalyticPair, **changes: Any) -> None:
    """Write a pair folder; `changes` replaces arrays of its truth, and None removes one."""
    folder.mkdir(parents=True)
    for number, frame in enumerate((scene.prev, scene.curr)):
        cv2.imwrite(str(folder / f"color{number}.png"), frame.color[..., ::-1])
        cv2.imwrite(str(folder / f"depth{number}.png"), np.rint(frame.depth * 10_000).astype(np.uint16))
    (folder / "camera.json").write_text(json.dumps({**scene.curr.camera.to_dict(), "depth_scale": 10_000}))
    labels = sorted(scene.prev_T_curr)
    truth: dict[str, Any] = {
        "labels0": scene.prev_labels.astype(np.uint8),
        "labels1": scene.labels.astype(np.uint8),
        "prev_T_curr": np.stack([scene.prev_T_curr[label] for label in labels]),
        "background_prev_T_curr": scene.camera_motion,
        "names": np.array([scene.kinds[label] for label in labels]),
    }
    np.savez(folder / "truth.npz", **{k: v for k, v in {**truth, **changes}.items() if v is not None})


@pytest.fixture(scope="module")
def scene() -> analytic.AnalyticPair:
    return analytic.make_scene(3, objects=(4, 4), moving_share=0.5)


def test_a_written_pair_comes_back(tmp_path: Path, scene: analytic.AnalyticPair) -> None:
    write_pair(tmp_path / "b", scene)
    pair = read_pair(tmp_path / "b")
    assert pair.name == "b"
    truth = pair.truth
    assert truth is not None
    # Static objects are background; the others keep their labels.
    moving = sorted(scene.moving)
    assert sorted(truth.moving) == moving == [obj.label for obj in truth.objects]
    assert np.array_equal(truth.labels, np.where(np.isin(scene.labels, moving), scene.labels, 0))
    # The flow agrees with that of the scene, up to the rounding of depth to 0.1 mm.
    assert np.nanmax(np.abs(truth.scene_flow - scene.scene_flow)) < 2e-4
    assert np.array_equal(np.isnan(truth.scene_flow[..., 0]), ~pair.curr.valid)
    for obj in truth.objects:
        assert np.allclose(obj.prev_T_curr, scene.prev_T_curr[obj.label])
        assert obj.rotation_known == (scene.kinds[obj.label] != "sphere")


def test_objects_seen_in_one_frame_are_not_masked(tmp_path: Path, scene: analytic.AnalyticPair) -> None:
    label = min(scene.moving)
    before = np.where(scene.prev_labels == label, 0, scene.prev_labels).astype(np.uint8)
    write_pair(tmp_path / "a", scene, labels0=before)
    truth = read_pair(tmp_path / "a").truth
    assert truth is not None
    assert [obj.in_both for obj in truth.objects] == [obj.label != label for obj in truth.objects]
    assert np.array_equal(truth.masked, (truth.labels > 0) & (truth.labels != label))


def test_optional_arrays_are_used(tmp_path: Path, scene: analytic.AnalyticPair) -> None:
    count = len(scene.prev_T_curr)
    centers = np.arange(3.0 * count).reshape(count, 3)
    write_pair(
        tmp_path / "a",
        scene,
        labels0=None,
        background_prev_T_curr=None,
        names=None,
        centers=centers,
        moving=np.arange(count) == 2,
        rotation_known=np.zeros(count, np.bool_),
    )
    truth = read_pair(tmp_path / "a").truth
    assert truth is not None
    (obj,) = truth.objects
    assert (obj.label, obj.in_both, obj.rotation_known, obj.center.tolist()) == (3, True, False, centers[2].tolist())
    assert truth.moving == {3}


def test_rotations_may_be_left_out_by_name(tmp_path: Path, scene: analytic.AnalyticPair) -> None:
    write_pair(tmp_path / "a", scene, names=np.array(["pen"] * len(scene.prev_T_curr)))
    truth = read_pair(tmp_path / "a", translation_only=("pen",)).truth
    assert truth is not None
    assert not any(obj.rotation_known for obj in truth.objects)


def test_a_camera_that_moved(tmp_path: Path) -> None:
    motion = np.eye(4)
    motion[:3, 3] = [0.01, 0.02, 0.0]
    scene = analytic.make_scene(5, objects=(3, 3), moving_share=0.34, camera_motion=motion)
    write_pair(tmp_path / "a", scene)
    truth = read_pair(tmp_path / "a").truth
    assert truth is not None
    # Everything moves in the camera frame, but only objects that move in the world are labelled.
    assert truth.moving == scene.moving
    assert np.nanmax(np.abs(truth.scene_flow - scene.scene_flow)) < 2e-4


def test_folders(tmp_path: Path, scene: analytic.AnalyticPair) -> None:
    with pytest.raises(DatasetError, match="no such folder"):
        find_pairs(tmp_path / "none")
    (tmp_path / "set" / "notes").mkdir(parents=True)
    with pytest.raises(DatasetError, match="no pair folders"):
        find_pairs(tmp_path / "set")
    write_pair(tmp_path / "set" / "z", scene)
    write_pair(tmp_path / "set" / "y", scene)
    (tmp_path / "set" / "z" / "truth.npz").unlink()
    assert [path.name for path in find_pairs(tmp_path / "set")] == ["y", "z"]
    assert find_pairs(tmp_path / "set" / "z") == [tmp_path / "set" / "z"]
    assert [pair.name for pair in read_pairs(tmp_path / "set")] == ["y"]
    assert [pair.truth is None for pair in read_pairs(tmp_path / "set", with_truth=False)] == [False, True]
    with pytest.raises(DatasetError, match=r"none of its pairs has a truth\.npz"):
        read_pairs(tmp_path / "set" / "z")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"labels1": None}, "labels1 is missing"),
        ({"prev_T_curr": None}, "prev_T_curr is missing"),
        ({"labels1": np.zeros((3, 4), np.uint8)}, "labels1 must be 240x320"),
        ({"labels1": np.full((240, 320), 0.5)}, "whole numbers"),
        ({"labels1": np.full((240, 320), -1)}, "whole numbers in 0"),
        ({"labels1": np.full((240, 320), 9)}, "goes up to 9, prev_T_curr has 4 motions"),
        ({"prev_T_curr": np.full((4, 4, 4), np.nan)}, "finite"),
        ({"prev_T_curr": np.zeros((4, 3, 3))}, "prev_T_curr must be Kx4x4"),
        ({"background_prev_T_curr": np.eye(3)}, "background_prev_T_curr must be 4x4"),
        ({"names": np.array(["a"])}, "1 names for 4 motions"),
        ({"moving": np.ones(4)}, "moving must be 4 truth values"),
        ({"names": np.array([{}] * 4, dtype=object)}, "not a NumPy archive"),
    ],
)
def test_a_truth_that_does_not_fit(
    tmp_path: Path, scene: analytic.AnalyticPair, changes: dict[str, Any], message: str
) -> None:
    write_pair(tmp_path / "a", scene, **changes)
    with pytest.raises(DatasetError, match=message) as caught:
        read_pair(tmp_path / "a")
    assert "truth.npz" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9])
def test_a_truth_that_was_cut_off(tmp_path: Path, scene: analytic.AnalyticPair, keep: float) -> None:
    write_pair(tmp_path / "a", scene)
    path = tmp_path / "a" / "truth.npz"
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    with pytest.raises(DatasetError, match="not a NumPy archive"):
        read_pair(tmp_path / "a")


def test_a_truth_with_changed_bytes_is_read_or_refused(tmp_path: Path, scene: analytic.AnalyticPair) -> None:
    write_pair(tmp_path / "a", scene)
    path = tmp_path / "a" / "truth.npz"
    data = np.frombuffer(path.read_bytes(), np.uint8)
    rng = np.random.default_rng(0)
    refused = []
    for _ in range(60):
        changed = data.copy()
        # Headers are at the start of each array and the directory at the end; the middle holds pixels.
        places = np.r_[rng.integers(0, 200, 3), len(data) - rng.integers(1, 500, 3)]
        changed[places] = rng.integers(0, 256, 6)
        path.write_bytes(changed.tobytes())
        try:
            read_pair(tmp_path / "a")
        except DatasetError as error:
            refused.append(str(error))
    assert len(refused) > 30
    assert not [message for message in refused if "\n" in message or len(message) > 500]


def test_a_single_array_is_not_a_truth(tmp_path: Path, scene: analytic.AnalyticPair) -> None:
    write_pair(tmp_path / "a", scene)
    with open(tmp_path / "a" / "truth.npz", "wb") as file:
        np.save(file, scene.labels)
    with pytest.raises(DatasetError, match="not a NumPy archive"):
        read_pair(tmp_path / "a")


def test_the_center_of_a_ball_and_of_a_plate() -> None:
    rng = np.random.default_rng(0)
    # The visible half of a ball with a radius of 3 cm.
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[:, 2] = -np.abs(normals[:, 2])
    middle = np.array([0.1, -0.2, 1.3])
    center, is_ball = find_center(middle + 0.03 * normals + rng.normal(0, 0.0005, (500, 3)))
    assert is_ball
    assert np.linalg.norm(center - middle) < 0.001
    plate = middle + np.c_[rng.uniform(-0.04, 0.04, (500, 2)), np.zeros(500)]
    center, is_ball = find_center(plate)
    assert not is_ball
    assert np.allclose(center, np.median(plate, axis=0))


def test_the_oracle_is_exact_where_the_frames_are(tmp_path: Path) -> None:
    scene = analytic.make_scene(4, objects=(3, 3))
    write_pair(tmp_path / "a", scene)
    pair = read_pair(tmp_path / "a")
    assert pair.truth is not None
    motion = OracleMasks(pair.truth.labels)(pair.prev, pair.curr)
    score = score_pair(motion, pair.truth)
    assert score.segmentation.mean_f == (1, 1, 1)
    assert score.segmentation.extracted == score.segmentation.true_objects == len(scene.moving)
    assert score.flow.masked.epe_cm < 0.3
    assert all(error.translation_cm < 0.2 for error in score.objects)
    assert all(obj.moving for obj in motion.objects)


def test_the_oracle_of_a_pair_without_objects(tmp_path: Path) -> None:
    scene = analytic.make_scene(4, objects=(1, 1), moving_share=0.0)
    motion = OracleMasks(np.zeros_like(scene.labels), camera="static")(scene.prev, scene.curr)
    assert motion.objects == ()
    assert not np.nan_to_num(motion.scene_flow).any()
    full = OracleMasks(np.ones_like(scene.labels))(scene.prev, scene.curr)
    assert np.abs(full.objects[0].prev_T_curr - np.eye(4)).max() < 1e-3
    assert not full.objects[0].moving


def test_the_oracle_needs_labels_of_the_frames_size(scene: analytic.AnalyticPair) -> None:
    with pytest.raises(ResultError, match="do not match"):
        OracleMasks(np.zeros((4, 5), np.int32))(scene.prev, scene.curr)


@pytest.mark.skipif(not (DATA / "boxes_1").is_dir(), reason=f"no real pairs in {DATA}")
def test_the_oracle_on_real_pairs() -> None:
    pairs = {pair.name: pair for pair in read_pairs(DATA, translation_only=("carrot",))}
    assert set(pairs) == {"bin_1", "bin_2", "boxes_1", "boxes_2", "boxes_still"}
    moving = {name: len(pair.truth.moving) for name, pair in pairs.items() if pair.truth}
    assert moving == {"bin_1": 2, "bin_2": 2, "boxes_1": 1, "boxes_2": 1, "boxes_still": 0}
    for name in ("boxes_1", "boxes_2", "bin_1"):
        truth = pairs[name].truth
        assert truth is not None
        motion = OracleMasks(truth.labels)(pairs[name].prev, pairs[name].curr)
        # The truth itself is accurate to 1-2 degrees and 5-10 mm.
        for obj in truth.objects:
            found = motion.objects[[o.id for o in motion.objects].index(obj.label)].prev_T_curr
            error = (found - obj.prev_T_curr) @ np.array([*obj.center, 1.0])
            assert np.linalg.norm(error) < 0.01
