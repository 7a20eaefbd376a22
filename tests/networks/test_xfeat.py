"""The frozen XFeat backbone against its published layers, and the sampling of its features at cells."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
import safetensors.torch
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from helpers.paths import ROOT
from objectflow.errors import MethodError
from objectflow.networks.xfeat import XFeat, sample_cells, xfeat_size


def published_layer(inputs: int, outputs: int, kernel: int, stride: int) -> nn.Sequential:
    """A layer as the paper's program has it, with statistics that are not trivial."""
    norm = nn.BatchNorm2d(outputs, affine=False)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    norm.running_mean.normal_(0, 0.1)
    norm.running_var.uniform_(0.5, 2.0)
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    return nn.Sequential(convolution, norm, nn.ReLU())


class Layer(nn.Module):
    def __init__(self, *sizes: int) -> None:
        super().__init__()
        self.layer = published_layer(*sizes)

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.layer(x)
        return out


class Published(nn.Module):
    """The backbone as the paper describes it, its normalisation not folded."""

    def __init__(self) -> None:
        super().__init__()
        self.skip1 = nn.Sequential(nn.AvgPool2d(4), nn.Conv2d(1, 24, 1))
        self.block1 = nn.Sequential(Layer(1, 4, 3, 1), Layer(4, 8, 3, 2), Layer(8, 8, 3, 1), Layer(8, 24, 3, 2))
        self.block2 = nn.Sequential(Layer(24, 24, 3, 1), Layer(24, 24, 3, 1))
        self.block3 = nn.Sequential(Layer(24, 64, 3, 2), Layer(64, 64, 3, 1), Layer(64, 64, 1, 1))
        self.block4 = nn.Sequential(Layer(64, 64, 3, 2), Layer(64, 64, 3, 1), Layer(64, 64, 3, 1))
        self.block5 = nn.Sequential(
            Layer(64, 128, 3, 2), Layer(128, 128, 3, 1), Layer(128, 128, 3, 1), Layer(128, 64, 1, 1)
        )
        self.block_fusion = nn.Sequential(Layer(64, 64, 3, 1), Layer(64, 64, 3, 1), nn.Conv2d(64, 64, 1))
        self.normalize = nn.InstanceNorm2d(1)

    def forward(self, image: Tensor) -> Tensor:
        x = self.normalize(image.mean(1, keepdim=True))
        x3 = self.block3(self.block2(self.block1(x) + self.skip1(x)))
        x4 = self.block4(x3)
        x5 = self.block5(x4)
        size = x3.shape[-2:]
        x4, x5 = (F.interpolate(one, size, mode="bilinear") for one in (x4, x5))
        return F.normalize(self.block_fusion(x3 + x4 + x5), dim=1)


@pytest.fixture(scope="module")
def published() -> Published:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Published().eval()


def test_converted_filters_give_the_published_features(published: Published, tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("convert_xfeat", ROOT / "scripts" / "convert_xfeat.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    path = tmp_path / "xfeat.safetensors"
    safetensors.torch.save_file(script.convert(published.state_dict()), path)
    made = XFeat()
    made.load(path)
    image = torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(1))
    larger = F.interpolate(image, xfeat_size(64, 96), mode="bilinear", align_corners=False)
    with torch.no_grad():
        torch.testing.assert_close(made(image), published(larger), rtol=0, atol=2e-4)


def test_files_that_are_none_of_it_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "xfeat.safetensors"
    safetensors.torch.save_file({"skip.weight": torch.zeros(24, 1, 1, 1)}, path)
    with pytest.raises(MethodError, match=r"no XFeat weights of scripts/convert_xfeat.py"):
        XFeat().load(path)
    with pytest.raises(MethodError, match=r"no XFeat weights"):
        XFeat().load(tmp_path / "none.safetensors")


def test_the_filters_are_frozen_and_travel_in_the_state_dict() -> None:
    made = XFeat(torch.Generator().manual_seed(0)).train()
    assert list(made.parameters()) == []
    assert len(made.state_dict()) == 40
    assert not made(torch.rand(1, 3, 32, 32).requires_grad_()).requires_grad


@pytest.mark.parametrize(
    ("size", "expected"), [((240, 320), (480, 640)), ((480, 640), (480, 640)), ((288, 384), (480, 640)),
                           ((320, 240), (640, 480)), ((48, 64), (96, 128)), ((960, 1280), (480, 640))],
)  # fmt: skip
def test_images_are_brought_to_640x480_pixels(size: tuple[int, int], expected: tuple[int, int]) -> None:
    assert xfeat_size(*size) == expected


def test_cells_take_the_feature_at_their_pixel() -> None:
    """A feature map that holds its own position in pixels gives each cell the pixel for which it stands."""
    height, width = 24, 40
    row, column = torch.meshgrid(torch.arange(6) * 4 + 1.5, torch.arange(10) * 4 + 1.5, indexing="ij")
    found = sample_cells(torch.stack([column, row])[None], (height, width), 8, (4, 6))
    torch.testing.assert_close(found[0, 0, 1, 1:5], torch.tensor([8.0, 16.0, 24.0, 32.0]))
    torch.testing.assert_close(found[0, 1, 1:3, 2], torch.tensor([8.0, 16.0]))
    assert found[0, 0, 0, 5] == 37.5  # beyond the image: the border's feature
