"""The two Siamese encoders, ResNet-50 to stride 8 for colour and a VGG for XYZ; pretrained weights for the former."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor, nn

from objectflow.errors import MethodError
from objectflow.networks.sceneflownet.settings import NetworkSettings, Stages
from objectflow.storage import files
from objectflow.storage.foreign import foreign_errors

MAX_BYTES = 1 << 30
"""Largest file of pretrained weights, in bytes; ResNet-50 has 100 MB."""
_EXPANSION = 4
"""Channels of a bottleneck's output relative to its 3x3 layer (He et al. 2016)."""
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet's colours, 0..1, by which pretrained trunks expect colours normalised."""


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 with a shortcut (He et al. 2016, figure 5); the stride is in the 3x3 layer as in pretrained files.

    (B, inputs, H, W) -> (B, 4 width, H / stride, W / stride).
    """

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        outputs = width * _EXPANSION
        self.conv1 = nn.Conv2d(inputs, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.relu = nn.ReLU(inplace=True)
        self.downsample: nn.Module = nn.Identity()
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """The block."""
        out = self.relu(self.bn1(self.conv1(x)))
        out = self.relu(self.bn2(self.conv2(out)))
        return torch.relu(self.bn3(self.conv3(out)) + self.downsample(x))


class Trunk(nn.Module):
    """ResNet-50 up to stride 8, with torchvision's names: `conv1`, `bn1`, `layer1`, `layer2`.

    (B, 3, H, W) normalised colour -> (B, 8 width, H / 8, W / 8). H and W are multiples of 8.
    """

    def __init__(self, width: int = 64, blocks: tuple[int, int] = (3, 4), *, frozen_norm: bool = False) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        self.layer1 = _layer(width, width, blocks[0], stride=1)
        self.layer2 = _layer(width * _EXPANSION, 2 * width, blocks[1], stride=2)
        self.channels = 2 * width * _EXPANSION
        self.frozen_norm = frozen_norm
        self.train()

    def train(self, mode: bool = True) -> Trunk:
        """As in torch, except that frozen normalisation stays frozen."""
        super().train(mode)
        if self.frozen_norm:
            for module in self.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eval()
        return self

    def forward(self, x: Tensor) -> Tensor:
        """Features at stride 8."""
        x = self.maxpool(self.relu(self.bn1(self.conv1(x))))
        out: Tensor = self.layer2(self.layer1(x))
        return out


def _layer(inputs: int, width: int, blocks: int, stride: int) -> nn.Sequential:
    first = Bottleneck(inputs, width, stride)
    rest = [Bottleneck(width * _EXPANSION, width, 1) for _ in range(blocks - 1)]
    return nn.Sequential(first, *rest)


class ColorEncoder(nn.Module):
    """Colour features for the correlation: the trunk, then a 1x1 layer to the paper's 256 channels.

    (B, 3, H, W) colour in 0..1 -> (B, color_channels, H / 8, W / 8), without ReLU. H and W are multiples of 8.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.trunk = Trunk(settings.trunk_width, settings.trunk_blocks, frozen_norm=settings.trunk_norm == "frozen")
        self.project = nn.Conv2d(self.trunk.channels, settings.color_channels, 1)
        self.register_buffer("mean", torch.tensor(_MEAN).reshape(1, 3, 1, 1), persistent=False)
        self.register_buffer("deviation", torch.tensor(_DEVIATION).reshape(1, 3, 1, 1), persistent=False)

    def forward(self, color: Tensor) -> Tensor:
        """Features at stride 8."""
        out: Tensor = self.project(self.trunk((color - self.mean) / self.deviation))
        return out


def shape_encoder(inputs: int, stages: Stages) -> nn.Sequential:
    """VGG of 3x3 layers with ReLU, the last of each stage with stride 2: (B, inputs, H, W) -> (B, C, H / 8, W / 8)."""
    layers: list[nn.Module] = []
    for stage in stages:
        for i, width in enumerate(stage):
            layers += [nn.Conv2d(inputs, width, 3, 2 if i == len(stage) - 1 else 1, 1), nn.ReLU(inplace=True)]
            inputs = width
    return nn.Sequential(*layers)


def load_backbone(trunk: Trunk, path: str | Path) -> None:
    """Load a file with torchvision's `resnet50` state dict (.pth or .safetensors) into the trunk.

    Every tensor of the trunk must be present with its size, and the parts used must hold no other tensors; `layer3`,
    `layer4` and `fc` are ignored. Pickled code is never run.

    Raises:
        MethodError: no such file, not a state dict, or one of another network (the message names the tensor).
    """
    path = Path(path)
    state = _read(path)
    unused = ("layer3.", "layer4.", "fc.")
    found = {name: value for name, value in state.items() if not name.startswith(unused)}
    wanted = trunk.state_dict()
    for name, value in wanted.items():
        if name.endswith("num_batches_tracked"):
            found.setdefault(name, value)  # absent from torchvision's older files, and not used here
        elif name not in found:
            raise MethodError(f"{path}: not a ResNet-50 state dict: {name} is missing")
        elif found[name].layout != torch.strided or not found[name].is_floating_point():
            raise MethodError(f"{path}: {name} is not a dense tensor of floating-point numbers")
        elif found[name].shape != value.shape:
            raise MethodError(
                f"{path}: {name} is {tuple(found[name].shape)}, but this trunk has {tuple(value.shape)}: "
                "set trunk_width and trunk_blocks to the file's"
            )
    stray = sorted(set(found) - set(wanted))
    if stray:
        raise MethodError(f"{path}: {stray[0]} has no place in this trunk: set trunk_blocks to the file's")
    trunk.load_state_dict(found, strict=True)


def _read(path: Path) -> dict[str, Tensor]:
    try:
        data = files.read_bytes(path, MAX_BYTES)
    except FileNotFoundError:
        raise MethodError(f"{path}: no such file: give the path of torchvision's resnet50 weights") from None
    except OSError as error:
        raise MethodError(f"{path}: cannot be read as weights: {error.strerror or error}") from error
    with foreign_errors(MethodError, f"{path}: cannot be read as weights"):
        if path.suffix == ".safetensors":
            state = safetensors.torch.load(data)
        else:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of the unpickler, about versions
                state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    if not isinstance(state, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in state.items()
    ):
        raise MethodError(f"{path}: not a state dict: expected names of tensors, as torchvision's resnet50 file has")
    return state
