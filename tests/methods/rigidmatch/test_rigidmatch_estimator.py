"""`rigidmatch` as an estimator: decoding of its output, batches, settings, and the files that it rejects."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import analytic
import objectflow
from helpers.small_networks import TINY_RIGID, save, save_rigid
from objectflow import geometry
from objectflow.alignment.frame_pair import FramePair
from objectflow.errors import MethodError, SettingsError
from objectflow.methods.network_io import MAX_BATCH, same_size_groups, scaled_size
from objectflow.methods.postprocess.settings import PostprocessSettings
from objectflow.methods.rigidmatch.decoding import decode, matched_flow, select
from objectflow.motion import SceneMotion
from objectflow.networks import export
from objectflow.networks.rigidmatch import RigidMatch, RigidMatchOutput
from objectflow.networks.rigidmatch.export_form import ExportableRigidMatch
from objectflow.networks.rigidmatch.network import PRIOR
from objectflow.networks.rigidmatch.rigid_solver import solve_motions
from objectflow.networks.weights import load_network, load_weights, save_weights
from objectflow.networks.xfeat import XFeat


def network() -> RigidMatch:
    return RigidMatch(TINY_RIGID, generator=torch.Generator().manual_seed(0)).eval()


def images() -> list[torch.Tensor]:
    made = [torch.rand(2, 3, 48, 64, generator=torch.Generator().manual_seed(k)) + 0.2 for k in range(4)]
    made[3][:, :, :5, :9] = torch.nan
    return made


def two_squares() -> tuple[RigidMatchOutput, torch.Tensor]:
    """An output with two squares side by side, a second mask on the first one, and a mask below the threshold."""
    seen = images()
    with torch.no_grad():
        output = select(network()(*seen), 1)
    masks = torch.full((1, 1, 4, 24, 32), -8.0)
    masks[..., 0, 4:12, 4:12] = 8
    masks[..., 1, 4:12, 12:20] = 8
    masks[..., 2, 4:12, 4:11] = 8
    masks[..., 3, 14:20, 4:20] = 8
    middle = torch.zeros_like(output.upsampling)
    middle[:, 4] = 1
    objectness = torch.tensor([[[3.0, 2.0, 1.0, -3.0]]])
    moves = torch.tensor([[2.0, -2.0, 2.0, 2.0]])
    return output._replace(masks=masks, upsampling=middle, objectness=objectness, moves=moves), seen[3][1:]


def test_each_pixel_gets_the_most_probable_object_and_objects_without_pixels_are_dropped() -> None:
    output, _ = two_squares()
    labels, objects = decode(output, (48, 64))
    expected = np.zeros((48, 64), np.int32)
    expected[8:24, 8:24], expected[8:24, 24:40] = 1, 2
    np.testing.assert_array_equal(labels, expected)
    assert [(one.id, one.pixels, one.moving) for one in objects] == [(1, 256, True), (2, 256, False)]
    first, second, _, _ = output.objectness[0, 0].sigmoid().tolist()
    assert [one.score for one in objects] == pytest.approx([first, second])
    for k, one in enumerate(objects):
        np.testing.assert_allclose(one.prev_T_curr[:3, :3], output.rotation[0, k].numpy(), atol=1e-6)
        np.testing.assert_allclose(one.prev_T_curr[:3, 3], output.translation[0, k].numpy(), atol=1e-6)
        np.testing.assert_allclose(one.center, output.anchors[0, k, :3].numpy(), atol=1e-6)
    # The first object passes with the help of a second query, whose mask is within its own.
    assert [one.pixels for one in decode(output, (48, 64), threshold=0.97)[1]] == [256]
    assert decode(output, (48, 64), threshold=0.97, duplicate_iou=1)[1] == ()
    assert [one.pixels for one in decode(output, (48, 64), threshold=0.9)[1]] == [256]
    assert decode(output, (48, 64), min_pixels=300)[1] == ()


@pytest.mark.parametrize("changes", [{}, {"stride": 8, "detail_channels": 6}], ids=str)
def test_without_a_probable_query_there_are_no_objects(changes: dict[str, Any]) -> None:
    made = RigidMatch(dataclasses.replace(TINY_RIGID, **changes), generator=torch.Generator().manual_seed(0)).eval()
    with torch.no_grad():
        output = select(made(*images()), 1)
    labels, objects = decode(output._replace(objectness=torch.full_like(output.objectness, -9.0)), (48, 64))
    assert objects == ()
    assert not labels.any()


def test_the_flow_per_pixel_is_that_of_its_match() -> None:
    output, seen = two_squares()
    shift = torch.tensor([0.01, -0.02, 0.03])[:, None, None]
    own = seen[..., ::2, ::2]
    output = output._replace(match=own + shift)
    points = seen[0].permute(1, 2, 0).numpy()
    labels, _ = decode(output, (48, 64))
    flow = matched_flow(output, seen, 2, labels, points)
    np.testing.assert_allclose(flow[labels > 0], np.broadcast_to([0.01, -0.02, 0.03], (512, 3)), atol=1e-6)
    assert np.isnan(flow[:5, :9]).all()
    assert (flow[30:, 50:] == 0).all()


@pytest.mark.parametrize("rigid", ["none", "solve", "refine"])
def test_results_lie_on_the_pixels_of_the_input(tmp_path: Path, rigid: str) -> None:
    pair = analytic.make_scene(0, objects=(2, 4), motion=(0.005, 0.015), max_angle_deg=6)
    path = save_rigid(tmp_path / "w.safetensors")
    options: dict[str, Any] = {"weights": path, "camera": "static", "rigid": rigid, "device": "cpu", "threshold": 0.0}
    motion = objectflow.load("rigidmatch", **options)(pair.prev, pair.curr)
    assert motion.method == "rigidmatch"
    assert motion.labels.shape == pair.curr.depth.shape
    np.testing.assert_array_equal(np.isnan(motion.scene_flow).any(-1), ~pair.curr.valid)
    assert sorted(np.unique(motion.labels[motion.labels > 0])) == [one.id for one in motion.objects]


# --- batches ---

MOTION = geometry.se3_exp([0.02, -0.01, 0.02, 0.02, -0.03, 0.02])


@cache
def scenes() -> list[analytic.AnalyticPair]:
    """Frames of two sizes from a static camera, and one pair from a moving one."""
    return [
        analytic.make_scene(0, objects=(2, 4)),
        analytic.make_scene(3, width=160, height=90),
        analytic.make_scene(5, camera_motion=MOTION),
        analytic.make_scene(1, objects=(2, 4)),
    ]


class Claiming(torch.nn.Module):
    """A network with random weights whose masks each claim 40% of the pixels; by themselves they claim none."""

    def __init__(self, inner: RigidMatch) -> None:
        super().__init__()
        self.inner, self.settings = inner, inner.settings

    def forward(self, *images: torch.Tensor, table: bool, min_probability: float) -> RigidMatchOutput:
        output: RigidMatchOutput = self.inner(*images, table=table, min_probability=min_probability)
        level = output.masks.flatten(-2).quantile(0.6, dim=-1)[..., None, None]
        return output._replace(masks=20 * (output.masks - level))


def load_claiming(path: Path, **settings: Any) -> Any:
    """`rigidmatch` with such a network, every mask of which is an object."""
    estimator: Any = objectflow.load("rigidmatch", weights=path, device="cpu", threshold=0.0, **settings)
    object.__setattr__(estimator, "network", Claiming(estimator.network))
    return estimator


def assert_close(found: SceneMotion, expected: SceneMotion) -> None:
    """Labels, flow, motions and scores to within 1e-5."""
    np.testing.assert_array_equal(found.labels, expected.labels)
    np.testing.assert_allclose(found.scene_flow, expected.scene_flow, atol=1e-5)
    assert len(found.objects) == len(expected.objects)
    for one, other in zip(found.objects, expected.objects, strict=True):
        assert (one.id, one.pixels, one.moving) == (other.id, other.pixels, other.moving)
        np.testing.assert_allclose(one.prev_T_curr, other.prev_T_curr, atol=1e-5)
        np.testing.assert_allclose(one.center, other.center, atol=1e-5)
        assert one.score == pytest.approx(other.score, abs=1e-5)
    assert (found.camera_motion is None) == (expected.camera_motion is None)
    if found.camera_motion is not None:
        np.testing.assert_allclose(found.camera_motion, expected.camera_motion, atol=1e-5)
    assert found.settings == expected.settings


@pytest.mark.parametrize(
    ("rigid", "detail"), [("none", "frame"), ("solve", "frame"), ("refine", "frame"), ("refine", "crops")]
)
def test_a_batch_equals_its_pairs_one_by_one(tmp_path: Path, rigid: str, detail: str) -> None:
    estimator = load_claiming(save_rigid(tmp_path / "w.safetensors"), rigid=rigid, detail=detail)
    calls: list[int] = []
    predict = estimator.predict
    object.__setattr__(estimator, "predict", lambda prev, curr: calls.append(len(prev)) or predict(prev, curr))
    pairs = [FramePair(scene.prev, scene.curr) for scene in scenes()]
    found = estimator.estimate_batch(pairs)
    if detail == "frame":
        assert sorted(calls) == [1, 3]  # one evaluation per size
    assert [motion.camera_motion is not None for motion in found] == [False, False, True, False]
    assert sum(len(motion.objects) for motion in found) >= 4
    for scene, motion in zip(scenes(), found, strict=True):
        assert_close(motion, estimator(scene.prev, scene.curr))
    assert estimator.estimate_batch([]) == []


def test_batches_are_limited() -> None:
    sizes = [(48, 64)] * (MAX_BATCH + 1) + [(30, 40)] + [(48, 64)]
    groups = same_size_groups(sizes)
    counts = [(group.size, len(group.members)) for group in groups]
    assert counts == [((48, 64), MAX_BATCH), ((48, 64), 2), ((30, 40), 1)]
    assert sorted(k for group in groups for k in group.members) == list(range(len(sizes)))
    assert all(sizes[k] == group.size for group in groups for k in group.members)
    assert same_size_groups([]) == []


@pytest.mark.parametrize(
    ("width", "height", "expected"),
    [(320, 240, (48, 64)), (64, 48, (48, 64)), (640, 360, (42, 74)), (3, 1000, (1012, 3))],
)
def test_the_networks_size_keeps_the_proportions_of_the_frame(
    width: int, height: int, expected: tuple[int, int]
) -> None:
    """About as many pixels as at training, 48 x 64."""
    frame = analytic.make_scene(0, objects=(1, 1), width=32, height=24).prev.resized(width, height)
    assert scaled_size(frame, (48, 64)) == expected


# --- settings ---


def test_explain_records_a_line_per_step(tmp_path: Path) -> None:
    scene = analytic.make_scene(0, objects=(2, 4), motion=(0.005, 0.015), max_angle_deg=6)
    path = save_rigid(tmp_path / "w.safetensors")

    def estimate(**settings: Any) -> SceneMotion:
        motion: SceneMotion = load_claiming(path, camera="static", **settings)(scene.prev, scene.curr)
        return motion

    silent, explained = estimate(), estimate(explain=True)
    assert silent.changes == ()
    assert [line.partition(": ")[0] for line in explained.changes] == list(PostprocessSettings().steps)
    assert all("\n" not in line and line.partition(": ")[2] for line in explained.changes)
    assert any("nothing changed" not in line for line in explained.changes)
    np.testing.assert_array_equal(silent.labels, explained.labels)
    short = estimate(explain="yes", **{"postprocess.steps": ("static_test", "refine")})
    assert [line.partition(": ")[0] for line in short.changes] == ["static_test", "refine"]
    for rigid in ("none", "solve"):
        assert estimate(explain=True, rigid=rigid).changes == ()


def test_a_moving_camera_hides_no_setting(tmp_path: Path) -> None:
    path = save_rigid(tmp_path / "w.safetensors")
    estimator: Any = objectflow.load("rigidmatch", weights=path, camera="moving", threshold=0.25)
    assert estimator.threshold == 0.25
    assert estimator.camera == "moving"
    assert isinstance(estimator.network, RigidMatch)
    assert (estimator.weights, estimator.size) == (path, (48, 64))


def test_results_name_the_settings_that_made_them(tmp_path: Path) -> None:
    scene = analytic.make_scene(0, objects=(1, 1), width=160, height=120)
    settings = {"postprocess.merge.max_loss": 0.1, "postprocess.steps": ["refine"], "camera": "static"}
    path = save_rigid(tmp_path / "w.safetensors")
    motion = objectflow.load("rigidmatch", weights=path, **settings)(scene.prev, scene.curr)
    assert motion.settings["postprocess"]["merge"]["max_loss"] == 0.1
    assert motion.settings["postprocess"]["steps"] == ["refine"]
    assert motion.settings["weights"] == "w.safetensors"
    again: Any = objectflow.load("rigidmatch", **{**motion.settings, "weights": path})
    assert again.to_dict() == motion.settings


# --- files ---


def test_wrong_files_and_settings_are_rejected(tmp_path: Path) -> None:
    own, other = save_rigid(tmp_path / "own.safetensors"), save(tmp_path / "other.safetensors")
    with pytest.raises(MethodError, match="weights of sceneflownet-c-vl, not of rigidmatch"):
        objectflow.load("rigidmatch", weights=other)
    with pytest.raises(MethodError, match="weights of rigidmatch, not of a scene flow network"):
        objectflow.load("sceneflownet-c-vl", weights=own)
    for settings, message in (
        ({"rigid": "average"}, "setting rigid must be one of none, solve, refine, not 'average'"),
        ({"threshold": 1.5}, "setting threshold must be at least 0 and below 1, not 1.5"),
        ({"min_pixels": 0}, "setting min_pixels must be at least 1, not 0"),
        ({"postprocess.steps": "refine,polish"}, "setting postprocess.steps has no step 'polish': choose among "),
        ({"postprocess.merge.max_los": 0}, "unknown setting postprocess.merge.max_los: did you mean postproc"),
        ({"postprocess.merge": 0}, "setting postprocess.merge is a group, not a value: choose one of its "),
    ):
        with pytest.raises(SettingsError) as caught:
            objectflow.load("rigidmatch", weights=own, **settings)
        assert str(caught.value).startswith(message)
    with pytest.raises(MethodError, match="weights of a rigidmatch, but a sceneflownet is required"):
        load_network(own, settings=load_weights(other)[0].settings)


def test_saved_weights_load_as_the_same_network(tmp_path: Path) -> None:
    found, metadata = load_network(save_rigid(tmp_path / "w.safetensors"))
    assert isinstance(found, RigidMatch)
    assert (found.settings, metadata["variant"], metadata["size"]) == (TINY_RIGID, "rigidmatch", [48, 64])
    expected = network().state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in found.state_dict().items())


def test_the_number_of_queries_and_the_radius_of_seeds_can_be_set(tmp_path: Path) -> None:
    path = save_rigid(tmp_path / "w.safetensors")
    chosen = objectflow.load("rigidmatch", weights=path, queries=7, seed_radius=0.2, threshold=0)
    assert (chosen.network.settings.queries, chosen.network.settings.seed_radius) == (7, 0.2)
    scene = analytic.make_scene(0)
    output, _ = chosen.predict([scene.prev.resized(64, 48)], [scene.curr.resized(64, 48)])
    assert output.objectness.shape[2] == 7
    assert objectflow.load("rigidmatch", weights=path).network.settings == TINY_RIGID
    with pytest.raises(SettingsError, match="queries must be at least 1"):
        objectflow.load("rigidmatch", weights=path, queries=0)


def test_a_sequence_computes_the_features_of_each_frame_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "w.safetensors"
    made = RigidMatch(dataclasses.replace(TINY_RIGID, xfeat="both"), generator=torch.Generator().manual_seed(0)).eval()
    save_weights(path, made, {"variant": "rigidmatch", "size": [48, 64]})
    estimator = objectflow.load("rigidmatch", weights=path, camera="static", threshold=0.0)
    scenes = [analytic.make_scene(seed, width=160, height=120) for seed in (0, 1)]
    frames = [scenes[0].prev, scenes[0].curr, scenes[1].curr]
    alone = [estimator(*frames[:2]), estimator(*frames[1:])]
    calls = []
    monkeypatch.setattr(
        XFeat, "forward", lambda self, color, forward=XFeat.forward: calls.append(len(color)) or forward(self, color)
    )
    first = FramePair(*frames[:2])
    sequence = [estimator.estimate(first), estimator.estimate(first.followed_by(frames[2]))]
    assert calls == [1, 1, 1]
    for one, other in zip(sequence, alone, strict=True):
        np.testing.assert_array_equal(one.labels, other.labels)
        np.testing.assert_array_equal(one.scene_flow, other.scene_flow)


def test_a_pair_scaled_by_5_has_the_same_labels_and_5_times_the_translation(tmp_path: Path) -> None:
    pair = analytic.make_scene(0, objects=(2, 4), motion=(0.005, 0.015), max_angle_deg=6)
    made, path = network(), tmp_path / "w.safetensors"
    torch.nn.init.constant_(made.decoder.shape.bias, 20.0)  # large masks
    save_weights(path, made, {"variant": "rigidmatch", "size": [48, 64]})
    # The queries of random weights are about equally probable, so which ones are merged is left to rounding.
    settings = {"camera": "static", "rigid": "solve", "threshold": 0.0, "duplicate_iou": 1.0}
    estimator = objectflow.load("rigidmatch", weights=path, **settings)
    large = [dataclasses.replace(frame, depth=5 * frame.depth) for frame in (pair.prev, pair.curr)]
    found, scaled = estimator(pair.prev, pair.curr), estimator(*large)
    assert len(found.objects) > 0
    # Borders are snapped by the noise of true depth, so single pixels may differ.
    assert float((found.labels != scaled.labels).mean()) < 0.02
    for one, other in zip(found.objects, scaled.objects, strict=True):
        np.testing.assert_allclose(other.prev_T_curr[:3, :3], one.prev_T_curr[:3, :3], atol=1e-3)
        np.testing.assert_allclose(other.prev_T_curr[:3, 3], 5 * one.prev_T_curr[:3, 3], atol=5e-3)
        np.testing.assert_allclose(other.center, 5 * one.center, atol=1e-2)


@pytest.mark.parametrize("changes", [{}, {"stride": 8, "detail_channels": 6, "xfeat": "both"}], ids=str)
def test_the_exported_graph_outputs_what_the_solver_needs(tmp_path: Path, changes: dict[str, Any]) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    path = tmp_path / "n.onnx"
    made = RigidMatch(dataclasses.replace(TINY_RIGID, **changes), generator=torch.Generator().manual_seed(0)).eval()
    differences = export.export_onnx(path, made, (48, 64))
    assert list(differences) == list(ExportableRigidMatch(made).outputs)
    assert max(differences.values()) < 1e-4
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    seen = [one[1:] for one in images()]
    found = dict(
        zip(
            ExportableRigidMatch(made).outputs,
            session.run(None, {name: one.numpy() for name, one in zip(export.INPUTS, seen, strict=True)}),
            strict=True,
        )
    )
    points, match, weights = (torch.from_numpy(found[name]).flatten(2) for name in ("points", "match", "weights"))
    R, _ = solve_motions(weights, points.mT, match.mT, torch.from_numpy(found["anchors"]), prior=PRIOR)
    with torch.no_grad():
        expected = solving_once(made)(*seen)
    np.testing.assert_allclose(R.numpy(), expected.rotation.numpy(), atol=1e-3)


def solving_once(made: RigidMatch) -> RigidMatch:
    """The same network with one solve."""
    other = RigidMatch(dataclasses.replace(made.settings, rounds=0)).eval()
    other.load_state_dict(made.state_dict())
    return other
