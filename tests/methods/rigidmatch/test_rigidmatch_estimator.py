"""`rigidmatch` as an estimator: what it makes of an output, and the files and options that it refuses."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import analytic
import objectflow
from helpers.small_networks import TINY_RIGID, save, save_rigid
from objectflow.errors import MethodError
from objectflow.methods.rigidmatch.decoding import decode, matched_flow, select
from objectflow.networks import export
from objectflow.networks.rigidmatch import RigidMatch, RigidMatchOutput
from objectflow.networks.rigidmatch.export_form import ExportableRigidMatch
from objectflow.networks.rigidmatch.network import PRIOR
from objectflow.networks.rigidmatch.rigid_solver import solve_motions
from objectflow.networks.weights import load_network, load_weights, save_weights


def network() -> RigidMatch:
    return RigidMatch(TINY_RIGID, generator=torch.Generator().manual_seed(0)).eval()


def images() -> list[torch.Tensor]:
    made = [torch.rand(2, 3, 48, 64, generator=torch.Generator().manual_seed(k)) + 0.2 for k in range(4)]
    made[3][:, :, :5, :9] = torch.nan
    return made


def two_squares() -> tuple[RigidMatchOutput, torch.Tensor]:
    """An output that says: two squares side by side, a second claim to the first one, and one that is no object."""
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


def test_each_pixel_goes_to_the_surest_claim_and_those_left_without_pixels_go() -> None:
    output, _ = two_squares()
    labels, objects = decode(output, (48, 64))
    expected = np.zeros((48, 64), np.int32)
    expected[8:24, 8:24], expected[8:24, 24:40] = 1, 2
    np.testing.assert_array_equal(labels, expected)
    assert [(one.id, one.pixels, one.moving) for one in objects] == [(1, 256, True), (2, 256, False)]
    assert objects[0].score == pytest.approx(torch.tensor(3.0).sigmoid().item())
    for k, one in enumerate(objects):
        np.testing.assert_allclose(one.prev_T_curr[:3, :3], output.rotation[0, k].numpy(), atol=1e-6)
        np.testing.assert_allclose(one.prev_T_curr[:3, 3], output.translation[0, k].numpy(), atol=1e-6)
        np.testing.assert_allclose(one.center, output.anchors[0, k, :3].numpy(), atol=1e-6)
    assert decode(output, (48, 64), threshold=0.9)[1][0].pixels == 256
    assert len(decode(output, (48, 64), threshold=0.9)[1]) == 1
    assert decode(output, (48, 64), min_pixels=300)[1] == ()


def test_a_pixels_own_flow_is_that_of_its_match() -> None:
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
def test_the_estimator_answers_on_its_inputs_pixels(tmp_path: Path, rigid: str) -> None:
    pair = analytic.make_scene(0, objects=(2, 4), motion=(0.005, 0.015), max_angle_deg=6)
    path = save_rigid(tmp_path / "w.safetensors")
    options: dict[str, Any] = {"weights": path, "camera": "static", "rigid": rigid, "device": "cpu", "threshold": 0.0}
    motion = objectflow.load("rigidmatch", **options)(pair.prev, pair.curr)
    assert motion.method == "rigidmatch"
    assert motion.labels.shape == pair.curr.depth.shape
    np.testing.assert_array_equal(np.isnan(motion.scene_flow).any(-1), ~pair.curr.valid)
    assert sorted(np.unique(motion.labels[motion.labels > 0])) == [one.id for one in motion.objects]


def test_wrong_files_and_options_are_told_in_a_line(tmp_path: Path) -> None:
    own, other = save_rigid(tmp_path / "own.safetensors"), save(tmp_path / "other.safetensors")
    with pytest.raises(MethodError, match="weights of sceneflownet-c-vl, not of rigidmatch"):
        objectflow.load("rigidmatch", weights=other)
    with pytest.raises(MethodError, match="weights of rigidmatch, not of a scene flow network"):
        objectflow.load("sceneflownet-c-vl", weights=own)
    with pytest.raises(MethodError, match="rigid must be none, solve or refine, not 'average'"):
        objectflow.load("rigidmatch", weights=own, rigid="average")
    with pytest.raises(MethodError, match="needs a threshold"):
        objectflow.load("rigidmatch", weights=own, threshold=1.5)
    with pytest.raises(MethodError, match="weights of a rigidmatch, but a sceneflownet is asked for"):
        load_network(own, settings=load_weights(other)[0].settings)


def test_weights_come_back_as_the_network_that_they_were(tmp_path: Path) -> None:
    found, metadata = load_network(save_rigid(tmp_path / "w.safetensors"))
    assert isinstance(found, RigidMatch)
    assert (found.settings, metadata["variant"], metadata["size"]) == (TINY_RIGID, "rigidmatch", [48, 64])
    expected = network().state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in found.state_dict().items())


def test_a_pair_scaled_by_5_has_the_same_labels_and_5_times_the_translation(tmp_path: Path) -> None:
    pair = analytic.make_scene(0, objects=(2, 4), motion=(0.005, 0.015), max_angle_deg=6)
    made, path = network(), tmp_path / "w.safetensors"
    torch.nn.init.constant_(made.decoder.shape.bias, 20.0)  # large masks
    save_weights(path, made, {"variant": "rigidmatch", "size": [48, 64]})
    estimator = objectflow.load("rigidmatch", weights=path, camera="static", rigid="solve", threshold=0.0)
    large = [dataclasses.replace(frame, depth=5 * frame.depth) for frame in (pair.prev, pair.curr)]
    found, scaled = estimator(pair.prev, pair.curr), estimator(*large)
    assert len(found.objects) > 0
    # Borders are snapped by the noise of true depth, so single pixels may differ.
    assert float((found.labels != scaled.labels).mean()) < 0.02
    for one, other in zip(found.objects, scaled.objects, strict=True):
        np.testing.assert_allclose(other.prev_T_curr[:3, :3], one.prev_T_curr[:3, :3], atol=1e-3)
        np.testing.assert_allclose(other.prev_T_curr[:3, 3], 5 * one.prev_T_curr[:3, 3], atol=5e-3)
        np.testing.assert_allclose(other.center, 5 * one.center, atol=5e-3)


@pytest.mark.parametrize("changes", [{}, {"stride": 8, "detail_channels": 6, "xfeat": "both"}], ids=str)
def test_the_exported_graph_has_what_the_solve_needs(tmp_path: Path, changes: dict[str, Any]) -> None:
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
    """The same network, solving once."""
    other = RigidMatch(dataclasses.replace(made.settings, rounds=0)).eval()
    other.load_state_dict(made.state_dict())
    return other
