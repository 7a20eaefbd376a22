"""ONNX files agree with torch on frames that the export did not use, and are written atomically."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.small_networks import TINY, save
from objectflow.cli import main
from objectflow.errors import MethodError, MissingExtraError, StorageError
from objectflow.networks import SceneFlowNet, SceneFlowNetOutput, export
from objectflow.networks.weights import save_weights

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")


def network(**changes: Any) -> SceneFlowNet:
    """A network without zero parameters, so that every layer has an effect."""
    made = SceneFlowNet(dataclasses.replace(TINY, **changes), generator=torch.Generator().manual_seed(3))
    for parameter in made.parameters():
        if not parameter.any():
            torch.nn.init.constant_(parameter, 0.1)
    return made


@pytest.mark.parametrize(
    ("changes", "size"),
    [
        ({}, (40, 56)),
        ({"correlation_cosine": True, "displacement": True, "details": True}, (37, 50)),
        (
            {
                "correlation_cosine": True,
                "displacement": True,
                "displacement_window": 1,
                "local_motion_window": 1,
            },
            (40, 48),
        ),
        ({"correlation": False}, (40, 56)),
    ],
)
def test_onnxruntime_agrees_with_torch(tmp_path: Path, changes: dict[str, Any], size: tuple[int, int]) -> None:
    path, made = tmp_path / "n.onnx", network(**changes).train()
    differences = export.export_onnx(path, made, size, {"variant": "one"})
    assert made.training
    assert list(differences) == list(SceneFlowNetOutput._fields)
    assert 0 < max(differences.values()) < 1e-5
    model = onnx.load(path)
    assert model.opset_import[0].version == 17
    (about,) = model.metadata_props
    assert json.loads(about.value) == {
        "network": made.settings.to_dict(), "size": list(size), "metadata": {"variant": "one"}
    }  # fmt: skip
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(9)
    frames = {name: rng.normal(1, 0.5, (1, 3, *size)).astype(np.float32) for name in export.INPUTS}
    frames["prev_points"][:, :, 5:20, 10:30] = np.nan
    frames["curr_points"][:, :, 15:35, :9] = np.nan
    found = session.run(None, frames)
    with torch.no_grad():
        expected = made.eval()(*(torch.from_numpy(frames[name]) for name in export.INPUTS))
    assert [one.name for one in session.get_outputs()] == list(SceneFlowNetOutput._fields)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other.numpy(), rtol=0, atol=1e-5 * float(other.abs().max()))


class ChangedByExport(SceneFlowNet):
    """A network whose graph differs from its results."""

    def forward(self, *frames: torch.Tensor) -> SceneFlowNetOutput:
        maps = super().forward(*frames)
        return maps._replace(translation=maps.translation + 0.5) if torch.onnx.is_in_onnx_export() else maps


def test_a_graph_with_other_results_is_not_written(tmp_path: Path) -> None:
    changed = ChangedByExport(TINY, generator=torch.Generator().manual_seed(3))
    with pytest.raises(MethodError, match=r"not written: translation differs from torch by \S+ of its largest value"):
        export.export_onnx(tmp_path / "n.onnx", changed, (16, 16))
    assert not list(tmp_path.iterdir())


def test_an_export_that_fails_names_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MethodError, match="export needs a size of at least 8x8, not 4x64"):
        export.export_onnx(tmp_path / "n.onnx", network(), (4, 64))
    with pytest.raises(StorageError):
        export.export_onnx(tmp_path / "none" / "n.onnx", network(), (16, 16))
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    with pytest.raises(MissingExtraError, match=r'pip install ".+\[onnx\]"'):
        export.export_onnx(tmp_path / "n.onnx", network(), (16, 16))
    assert not list(tmp_path.iterdir())


def test_the_command_exports_and_reports(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    weights, out = save(tmp_path / "w.safetensors", size=[24, 32]), tmp_path / "n.onnx"
    assert main(["export", "--format", "onnx", "--weights", str(weights), "--out", str(out)]) == 0
    printed = capfd.readouterr()
    assert f"written to {out}: 24x32, opset 17" in printed.out
    assert "differs from torch by at most" in printed.out
    command = ["export", "--weights", str(weights), "--size", "16", "40", "--out", str(out)]
    assert main(command) == 0
    (curr_points,) = (one for one in onnx.load(out).graph.input if one.name == "curr_points")
    assert [one.dim_value for one in curr_points.type.tensor_type.shape.dim] == [1, 3, 16, 40]
    out.unlink()
    capfd.readouterr()
    save_weights(weights, SceneFlowNet(TINY), {"size": "large"})
    assert main(["export", "--weights", str(weights), "--out", str(out)]) == 2
    assert main(["export", "--weights", str(tmp_path / "nothing"), "--out", str(out)]) == 2
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "its size must be" in lines[0]
    assert "no such file or folder of weights" in lines[1]
    assert not out.exists()


def test_the_default_is_the_released_network_of_the_default_method(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", "--out", str(tmp_path / "n.onnx"), "--size", "64", "80"]) == 0
    assert "64x80" in capfd.readouterr().out
    assert "anchors" in [output.name for output in onnx.load(tmp_path / "n.onnx").graph.output]


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("rigidmach", "unknown method 'rigidmach': did you mean 'rigidmatch'?"),
        ("consensus", "the method consensus has no network to export: choose one of rigidmatch, sceneflownet-c-vl"),
    ],
)
def test_methods_without_a_network_are_named(
    method: str, message: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", "--method", method, "--out", str(tmp_path / "n.onnx")]) == 2
    assert message in capfd.readouterr().err
    assert not list(tmp_path.iterdir())
