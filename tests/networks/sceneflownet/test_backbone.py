"""Pretrained weights with torchvision's names, loaded strictly for the parts used."""

from __future__ import annotations

from pathlib import Path

import pytest
import safetensors.torch
import torch
from torch import Tensor

from objectflow.errors import MethodError
from objectflow.networks import NetworkSettings, SceneFlowNet, load_backbone
from objectflow.networks.sceneflownet.backbone import Trunk


def _torchvision_names() -> dict[str, tuple[int, ...]]:
    """Names and sizes of torchvision's resnet50 up to layer2, from its definition (width 64)."""
    sizes: dict[str, tuple[int, ...]] = {"conv1.weight": (64, 3, 7, 7)}

    def norm(name: str, channels: int) -> None:
        for part in ("weight", "bias", "running_mean", "running_var"):
            sizes[f"{name}.{part}"] = (channels,)

    norm("bn1", 64)
    inputs = 64
    for layer, width, blocks in (("layer1", 64, 3), ("layer2", 128, 4)):
        for block in range(blocks):
            name = f"{layer}.{block}"
            for i, size in ((1, (width, inputs, 1, 1)), (2, (width, width, 3, 3)), (3, (4 * width, width, 1, 1))):
                sizes[f"{name}.conv{i}.weight"] = size
                norm(f"{name}.bn{i}", size[0])
            if block == 0:
                sizes[f"{name}.downsample.0.weight"] = (4 * width, inputs, 1, 1)
                norm(f"{name}.downsample.1", 4 * width)
            inputs = 4 * width
    return sizes


def _file_state(trunk: Trunk) -> dict[str, Tensor]:
    """The tensors of an older pretrained file: no batch counts, and the layers that are not used here."""
    generator = torch.Generator().manual_seed(3)
    state = {
        name: torch.rand(value.shape, generator=generator)
        for name, value in trunk.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }
    return state | {
        "layer3.0.conv1.weight": torch.zeros(2),
        "layer4.0.bn1.bias": torch.zeros(2),
        "fc.bias": torch.ones(2),
    }


def test_default_trunk_has_torchvisions_names_and_sizes() -> None:
    state = Trunk().state_dict()
    found = {name: tuple(value.shape) for name, value in state.items() if not name.endswith("num_batches_tracked")}
    assert found == _torchvision_names()


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_loads_every_tensor_of_the_parts_used(tmp_path: Path, suffix: str) -> None:
    trunk = Trunk(8, (2, 1))
    state = _file_state(trunk)
    path = tmp_path / f"resnet50{suffix}"
    if suffix == ".pth":
        torch.save(state, path)
    else:
        safetensors.torch.save_file(state, path)
    load_backbone(trunk, path)
    for name, value in trunk.state_dict().items():
        if not name.endswith("num_batches_tracked"):
            assert torch.equal(value, state[name]), name


def test_refuses_files_that_do_not_fit(tmp_path: Path) -> None:
    trunk = Trunk(8, (2, 1))
    state = _file_state(trunk)
    path = tmp_path / "weights.pth"
    before = {name: value.clone() for name, value in trunk.state_dict().items()}
    cases = [
        (
            {name: value for name, value in state.items() if name != "layer1.1.bn2.bias"},
            "layer1.1.bn2.bias is missing",
        ),
        (state | {"layer2.0.conv1.weight": torch.zeros(3)}, "layer2.0.conv1.weight is"),
        (state | {"layer2.1.conv1.weight": torch.zeros(3)}, "layer2.1.conv1.weight has no place"),
        ({"epoch": 3}, "not a state dict"),
    ]
    for bad, message in cases:
        torch.save(bad, path)
        with pytest.raises(MethodError, match=message):
            load_backbone(trunk, path)
    for name, content in (("cut.pth", path.read_bytes()[:40]), ("text.safetensors", b"hello, this is text")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(MethodError, match="cannot be read as weights"):
            load_backbone(trunk, tmp_path / name)
    with pytest.raises(MethodError, match="no such file"):
        load_backbone(trunk, tmp_path / "absent.pth")
    assert all(torch.equal(value, before[name]) for name, value in trunk.state_dict().items())


def test_simple_network_has_no_backbone(tmp_path: Path) -> None:
    settings = NetworkSettings(correlation=False).scaled(0.1)
    with pytest.raises(MethodError, match="no colour trunk"):
        SceneFlowNet(settings).load_backbone(tmp_path / "any.pth")
