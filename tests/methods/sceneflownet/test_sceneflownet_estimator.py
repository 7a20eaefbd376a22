"""The paper's networks as estimators: exact with true maps, settings, and the files that they reject."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch

import analytic
import objectflow
from helpers.network_scenes import moving_pairs, scene
from helpers.small_networks import TINY, save
from objectflow import RgbdFrame, geometry
from objectflow.errors import MethodError, SettingsError
from objectflow.geometry.resample import nearest_indices
from objectflow.methods.labels import with_surface_centers
from objectflow.methods.network_io import scaled_size, to_tensors
from objectflow.methods.sceneflownet.decoding import decode
from objectflow.methods.sceneflownet.estimator import SceneFlowEstimator
from objectflow.motion import SceneMotion
from objectflow.typing import LabelImage
from true_maps import Truth

NAME = "sceneflownet-c-vl"


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(tmp_path_factory.mktemp("weights") / "tiny.safetensors")


def truthful(weights: Path, pair: analytic.AnalyticPair, labels: LabelImage, **options: Any) -> Any:
    estimator = objectflow.load(NAME, camera="static", weights=weights, **options)
    object.__setattr__(estimator, "network", Truth(pair, labels))
    return estimator


def agree(found: LabelImage, true: LabelImage) -> dict[int, int]:
    """Found label -> true label, by most pixels; each at most once."""
    pairs = {int(k): int(np.bincount(true[found == k]).argmax()) for k in np.unique(found[found > 0])}
    assert len(set(pairs.values())) == len(pairs)
    return pairs


def check_motions(motion: SceneMotion, pair: analytic.AnalyticPair, names: dict[int, int], metres: float) -> None:
    for obj in motion.objects:
        true = pair.prev_T_curr[names[obj.id]]
        points = pair.centers[names[obj.id]] + 0.05 * np.eye(3)
        off = geometry.transform(obj.prev_T_curr, points) - geometry.transform(true, points)
        assert np.linalg.norm(off, axis=1).max() < metres
        assert obj.pixels == (motion.labels == obj.id).sum()
        assert obj.moving
        assert obj.score == pytest.approx(1 / (1 + np.exp(-6)))


# --- a network that predicts the truth ---


@pytest.mark.parametrize("rigid", ["none", "average"])
def test_true_maps_give_exact_masks_motions_and_flow(weights: Path, rigid: str) -> None:
    pair = scene()
    motion = truthful(weights, pair, pair.labels, rigid=rigid)(pair.prev, pair.curr)
    names = agree(motion.labels, pair.labels)
    np.testing.assert_array_equal(np.vectorize({0: 0, **names}.get)(motion.labels), pair.labels)
    check_motions(motion, pair, names, 1e-5)
    for obj in motion.objects:
        surface = geometry.back_project(pair.curr.depth, pair.curr.camera)[(motion.labels == obj.id) & pair.curr.valid]
        np.testing.assert_allclose(obj.center, surface.mean(axis=0), atol=1e-5)
    np.testing.assert_array_equal(np.isnan(motion.scene_flow).any(-1), ~pair.curr.valid)
    seen = pair.curr.valid
    np.testing.assert_allclose(motion.scene_flow[seen], pair.scene_flow[seen], atol=2e-6)
    assert not motion.scene_flow[seen & (pair.labels == 0)].any()
    assert (motion.method, motion.camera_motion) == (NAME, None)
    assert motion.seconds > 0


def test_refinement_keeps_the_truth(weights: Path) -> None:
    pair = scene(320, 240)
    motion = truthful(weights, pair, pair.labels[1::2, 1::2], rigid="refine")(pair.prev, pair.curr)
    check_motions(motion, pair, agree(motion.labels, pair.labels), 2e-3)


@pytest.mark.parametrize("rigid", ["none", "average"])
@pytest.mark.parametrize(
    ("width", "height", "rows", "columns"),
    [
        (320, 240, slice(1, None, 2), slice(1, None, 2)),  # halved: the pixel behind the middle of each block
        (80, 60, np.repeat(np.arange(60), 2), np.repeat(np.arange(80), 2)),  # doubled
        (212, 90, None, None),  # other proportions: 213 x 90, about as many pixels as at training
    ],
)
def test_results_lie_on_the_pixels_of_any_input_size(
    weights: Path, rigid: str, width: int, height: int, rows: Any, columns: Any
) -> None:
    pair = scene(width, height)
    if rows is None:
        labels = pair.labels[:, np.minimum((np.arange(213) + 0.5) * 212 / 213, 211).astype(int)]
    else:
        labels = pair.labels[rows][:, columns]
    motion = truthful(weights, pair, labels, rigid=rigid)(pair.prev, pair.curr)
    assert motion.labels.shape == (height, width)
    names = agree(motion.labels, pair.labels)
    found = np.vectorize({0: 0, **names}.get)(motion.labels)
    same = found == pair.labels
    assert same.mean() > (0.98 if width == 320 else 0.9999)
    check_motions(motion, pair, names, 1e-5)
    seen = same & pair.curr.valid
    np.testing.assert_allclose(motion.scene_flow[seen], pair.scene_flow[seen], atol=2e-6)
    assert np.isnan(motion.scene_flow[~pair.curr.valid]).all()


def test_decode_is_what_the_estimator_does_without_resizing(weights: Path) -> None:
    pair = scene()
    estimator = truthful(weights, pair, pair.labels)
    maps = estimator.predict([pair.prev], [pair.curr])
    points = torch.from_numpy(geometry.back_project(pair.curr.depth, pair.curr.camera)).permute(2, 0, 1)[None]
    rigid: Literal["none", "average"]
    for rigid in ("none", "average"):
        expected = dataclasses.replace(estimator, rigid=rigid)
        object.__setattr__(expected, "network", estimator.network)
        one, other = decode(maps, points, rigid=rigid), expected(pair.prev, pair.curr)
        np.testing.assert_array_equal(one.labels, other.labels)
        np.testing.assert_array_equal(one.scene_flow, other.scene_flow)
        centered = with_surface_centers(
            one.labels, one.objects, geometry.back_project(pair.curr.depth, pair.curr.camera)
        )
        assert [a.to_dict() for a in centered] == [b.to_dict() for b in other.objects]
    with pytest.raises(MethodError, match="one pair's maps and points are needed"):
        decode(maps, points[..., :-1])
    with pytest.raises(MethodError, match="rigid must be none or average here, not 'refine'"):
        decode(maps, points, rigid="refine")  # type: ignore[arg-type]


def test_predictions_that_are_not_finite_are_background(weights: Path) -> None:
    pair = scene()
    estimator = truthful(weights, pair, pair.labels)
    maps = estimator.predict([pair.prev], [pair.curr])
    points = torch.from_numpy(geometry.back_project(pair.curr.depth, pair.curr.camera)).permute(2, 0, 1)[None]
    for name in ("rotation", "translation", "center", "radius", "centrality", "mask"):
        value = getattr(maps, name).clone()
        value[:, :, 40:60, 60:90] = torch.nan
        motion = decode(maps._replace(**{name: value}), points)
        assert not motion.labels[40:60, 60:90].any()
        assert np.isfinite(motion.scene_flow[pair.curr.valid]).all()
        assert motion.objects


def test_an_object_without_depth_is_left_out(weights: Path) -> None:
    pair = scene()
    depth = np.where(pair.labels == 1, 0, pair.curr.depth).astype(np.float32)
    motion = truthful(weights, pair, pair.labels)(pair.prev, dataclasses.replace(pair.curr, depth=depth))
    assert len(motion.objects) == len(np.unique(pair.labels[pair.labels > 1]))
    assert not motion.labels[pair.labels == 1].any()
    assert [obj.id for obj in motion.objects] == list(range(1, len(motion.objects) + 1))


@pytest.mark.parametrize(("metadata", "count"), [({}, 1), ({"grouping": {"rotation_weight": 0.1}}, 2)])
def test_weights_trained_with_rotation_separate_objects_on_one_path(
    tmp_path: Path, metadata: dict[str, Any], count: int
) -> None:
    """The paper's discussion: a lid and its jar share X and T, and only the lid rotates."""
    pair = scene()
    labels = np.zeros_like(pair.labels)
    labels[20:60, 20:60], labels[20:60, 60:100] = 1, 2
    X, T, turn = pair.centers[1], np.array([0.0, 0.02, 0.03]), np.array([0.0, 0.8, 0.0])
    motions = {
        k: geometry.make_transform(R := geometry.so3_exp(q), T + X - R @ X) for k, q in ((1, 0 * turn), (2, turn))
    }
    made = dataclasses.replace(pair, labels=labels, centers={1: X, 2: X}, prev_T_curr=motions)
    truth = Truth(made, labels)
    estimator: Any = objectflow.load(NAME, camera="static", weights=save(tmp_path / "w.safetensors", **metadata))

    def network(*images: torch.Tensor) -> Any:
        maps = truth(*images)
        return maps._replace(radius=torch.full_like(maps.radius, 0.03))

    cpu = torch.device("cpu")
    object.__setattr__(
        estimator, "predict", lambda prev, curr: network(*to_tensors(prev, cpu), *to_tensors(curr, cpu))
    )
    motion = estimator(pair.prev, pair.curr)
    assert len(motion.objects) == count
    if count == 2:
        check_motions(motion, made, agree(motion.labels, labels), 1e-5)


def test_nearest_indices_are_those_of_the_nearest_centres() -> None:
    for source, size in (((5, 9), (11, 4)), ((6, 6), (6, 6)), ((3, 4), (30, 41))):
        for got, n, m in zip(nearest_indices(source, size), source, size, strict=True):
            centers, wanted = (np.arange(n) + 0.5) / n, (np.arange(m) + 0.5) / m
            distance = np.abs(centers[None] - wanted[:, None])
            np.testing.assert_allclose(distance[np.arange(m), got], distance.min(axis=1), atol=1e-12)


# --- a network with random weights ---


def test_results_are_deterministic_and_inputs_unchanged(tmp_path: Path) -> None:
    """At a size that the network pads."""
    pair, weights = scene(100, 75), save(tmp_path / "w.safetensors", size=[75, 101])
    kept = pair.prev.color.copy(), pair.curr.depth.copy()
    state = torch.get_rng_state()
    first, second = (objectflow.load(NAME, weights=weights)(pair.prev, pair.curr) for _ in range(2))
    np.testing.assert_array_equal(first.labels, second.labels)
    np.testing.assert_array_equal(first.scene_flow, second.scene_flow)
    assert torch.equal(torch.get_rng_state(), state)
    np.testing.assert_array_equal(pair.prev.color, kept[0])
    np.testing.assert_array_equal(pair.curr.depth, kept[1])


def test_the_networks_inputs(weights: Path) -> None:
    """By hand: colour in 0..1, points in metres, the previous frame first."""
    pair = scene()
    estimator = objectflow.load(NAME, camera="static", weights=weights)
    assert isinstance(estimator, SceneFlowEstimator)
    found = estimator.predict([pair.prev], [pair.curr])
    arguments = []
    for frame in (pair.prev, pair.curr):
        z = np.where(frame.depth > 0, frame.depth, np.nan).astype(np.float64)
        v, u = np.mgrid[0:120, 0:160]
        x, y = (u - frame.camera.cx) / frame.camera.fx * z, (v - frame.camera.cy) / frame.camera.fy * z
        for image in (frame.color / 255, np.stack([x, y, z], axis=-1)):
            arguments.append(torch.tensor(image.transpose(2, 0, 1)[None], dtype=torch.float32))
    with torch.no_grad():
        expected = estimator.network(*arguments)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


# --- settings and weights ---


def test_weights_bring_the_settings_of_their_training(tmp_path: Path) -> None:
    path = save(tmp_path / "w.safetensors", size=[60, 80], grouping={"rotation_weight": 0.07})
    estimator: Any = objectflow.load(NAME, camera="static", weights=path)
    assert (estimator.size, estimator.grouping.rotation_weight) == ((60, 80), 0.07)
    assert scaled_size(scene().curr, estimator.size) == (60, 80)
    other: Any = objectflow.load(NAME, camera="static", weights=str(path), rotation_weight=0.0, min_pixels=3)
    assert (other.grouping.rotation_weight, other.grouping.min_pixels) == (0, 3)
    bare = save(tmp_path / "bare.safetensors", size=[240, 320])
    assert objectflow.load(NAME, camera="static", weights=bare).size == (240, 320)  # type: ignore[attr-defined]


def test_the_output_folder_of_training_can_be_loaded(tmp_path: Path) -> None:
    """Trained with rotation in the trajectory feature, which the header passes on to the grouping."""
    pytest.importorskip("pyarrow")
    from helpers.training_runs import RECIPE, job, write_set
    from objectflow.training.loop import train

    loss = dataclasses.replace(RECIPE.model.loss, rotation_weight=0.05)
    model = dataclasses.replace(RECIPE.model, loss=loss)
    recipe = dataclasses.replace(RECIPE, model=model, steps=2, validation_pairs=2)
    train(job(write_set(tmp_path / "set", pairs=4), tmp_path / "run", recipe))
    estimator: Any = objectflow.load(NAME, camera="static", weights=tmp_path / "run")
    assert (estimator.size, estimator.grouping.rotation_weight) == ((24, 32), 0.05)
    assert estimator.weights == tmp_path / "run" / "weights.safetensors"
    estimator(scene().prev, scene().curr)
    with pytest.raises(MethodError, match="weights of sceneflownet-c-vl, not of sceneflownet-s"):
        objectflow.load("sceneflownet-s", weights=tmp_path / "run")


@pytest.mark.parametrize(
    ("name", "changes", "metadata", "message"),
    [
        ("sceneflownet-c", {}, {}, "weights of sceneflownet-c-vl, not of sceneflownet-c: load them by their own name"),
        (NAME, {"correlation": False}, {}, "correlation is False there, but sceneflownet-c-vl has True"),
        (NAME, {}, {"size": 240}, r"its size must be \[height, width\], not 240"),
        (NAME, {}, {"size": [240, "a"]}, r"its size must be \[height, width\]"),
        (NAME, {}, {"size": [240, 4]}, "its size must be at least 8x8"),
        (NAME, {}, {"grouping": 3}, "its grouping must be settings, not 3"),
        (NAME, {}, {"grouping": {"rotation_weight": -1}}, "rotation_weight must be finite and >= 0"),
    ],
)
def test_weights_that_do_not_fit_are_rejected(
    tmp_path: Path, name: str, changes: dict[str, Any], metadata: dict[str, Any], message: str
) -> None:
    path = save(tmp_path / "w.safetensors", dataclasses.replace(TINY, **changes), **metadata)
    with pytest.raises(MethodError, match=message):
        objectflow.load(name, weights=path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera": "handheld"}, "setting camera must be one of auto, static, moving, not 'handheld'"),
        ({"rigid": "soft"}, "setting rigid must be one of none, average, refine, not 'soft'"),
        ({"min_pixels": 0}, "setting min_pixels must be at least 1, not 0"),
        ({"rotation_weight": -1}, "setting rotation_weight must be at least 0, not -1"),
        ({"rotation_weight": float("nan")}, "setting rotation_weight must be a finite number or none, not nan"),
        ({"refine.max_shift": "far"}, "setting refine.max_shift must be a finite number, not 'far'"),
        ({"seed": -1}, "setting seed must be at least 0, not -1"),
    ],
)
def test_invalid_settings_are_named(weights: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError) as caught:
        objectflow.load(NAME, **{"weights": weights, **options})
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"device": "abacus"}, "unknown device 'abacus'"),
        ({"device": "cuda:99"}, "device cuda:99 is not available, since there is"),
        ({"device": "xpu"}, "device xpu cannot be used"),
        ({"weights": "nowhere.safetensors"}, "nowhere.safetensors: no such file or folder of weights"),
    ],
)
def test_devices_and_files_that_are_missing_are_named(weights: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(MethodError, match=message):
        objectflow.load(NAME, **{"weights": weights, **options})


def test_frames_almost_without_depth_have_a_result(weights: Path) -> None:
    pair = scene()
    depth = np.zeros_like(pair.curr.depth)
    depth[0, 0] = 1.0
    sparse = RgbdFrame(pair.curr.color, depth, pair.curr.camera)
    motion = objectflow.load(NAME, weights=weights)(sparse, sparse)
    assert np.isnan(motion.scene_flow).any(-1).sum() == depth.size - 1


def test_the_cameras_motion_is_compensated_and_composed(weights: Path) -> None:
    static, moved = moving_pairs()
    estimator: Any = objectflow.load(NAME, weights=weights)
    object.__setattr__(estimator, "network", Truth(static, static.labels))
    found = estimator(moved.prev, moved.curr)
    assert found.camera_motion is not None
    off = np.linalg.norm(found.scene_flow - moved.scene_flow, axis=-1)
    assert np.nanmean(off) < 0.002
    for obj in found.objects:
        true = moved.prev_T_curr[int(np.bincount(moved.labels[found.labels == obj.id]).argmax())]
        np.testing.assert_allclose(obj.prev_T_curr, true, atol=0.01)
