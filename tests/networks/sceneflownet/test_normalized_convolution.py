"""Masked convolutions against a loop over windows, and the encoder that is made of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from objectflow.errors import MethodError
from objectflow.networks import NetworkSettings, SceneFlowNet
from objectflow.networks.sceneflownet.backbone import shape_encoder
from objectflow.networks.sceneflownet.normalized_convolution import MaskedConv2d, MaskedShapeEncoder

SMALL = NetworkSettings().scaled(0.125)


@pytest.mark.parametrize("stride", [1, 2])
def test_layer_equals_a_loop_over_windows(stride: int) -> None:
    generator = torch.Generator().manual_seed(0)
    layer = MaskedConv2d(2, 3, 3, stride, 1)
    known = (torch.rand(1, 1, 8, 10, generator=generator) < 0.3).float()
    known[..., :3, :4] = 0
    x = torch.randn(1, 2, 8, 10, generator=generator) * known
    out, some = layer.masked(x, known)
    weight, bias = layer.weight.detach().numpy(), layer.bias.detach().numpy()  # type: ignore[union-attr]
    padded, mask = np.pad(x[0], ((0, 0), (1, 1), (1, 1))), np.pad(known[0, 0], 1)
    for v in range(out.shape[2]):
        for u in range(out.shape[3]):
            rows, columns = slice(v * stride, v * stride + 3), slice(u * stride, u * stride + 3)
            count = mask[rows, columns].sum()
            expected = np.zeros(3)
            if count > 0:
                expected = (weight * padded[:, rows, columns]).sum(axis=(1, 2, 3)) * 9 / count + bias
            np.testing.assert_allclose(out.detach()[0, :, v, u], expected, atol=1e-5)
            assert float(some[0, 0, v, u]) == float(count > 0)


def test_with_all_depth_only_the_border_differs_from_the_plain_encoder() -> None:
    """There the zeros of the padding count as unknown."""
    stages = ((8, 8), (8,), (8,))
    plain, masked = shape_encoder(3, stages), MaskedShapeEncoder(stages)
    weights = [layer for layer in plain if isinstance(layer, torch.nn.Conv2d)]
    for mine, other in zip(masked, weights, strict=True):
        mine.load_state_dict(other.state_dict())
    points = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    found = masked(torch.cat([points, torch.ones(1, 1, 64, 64)], 1))
    torch.testing.assert_close(found[..., 2:-2, 2:-2], plain(points)[..., 2:-2, 2:-2], atol=1e-5, rtol=1e-4)


def test_network_with_masked_convolutions() -> None:
    settings = dataclasses.replace(SMALL, missing="masked")
    assert NetworkSettings.from_dict(settings.to_dict()) == settings
    network = SceneFlowNet(settings, generator=torch.Generator().manual_seed(0))
    color, points = torch.rand(1, 3, 64, 80), torch.rand(1, 3, 64, 80)
    points[..., 20:30, 10:60] = torch.nan
    out = network(color, points, color, points)
    assert all(bool(one.isfinite().all()) for one in out)
    sum(one.square().mean() for one in out).backward()
    assert all(bool(p.grad is not None and p.grad.isfinite().all()) for p in network.parameters())
    for change in ({"missing": "zero"}, {"missing": "masked", "correlation": False}):
        with pytest.raises(MethodError, match="network setting missing"):
            dataclasses.replace(SMALL, **change)  # type: ignore[arg-type]
