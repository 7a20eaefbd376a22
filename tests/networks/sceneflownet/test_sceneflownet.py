"""The network: sizes, settings, missing depth, and equation 1 against NumPy."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from objectflow import geometry
from objectflow.errors import MethodError
from objectflow.networks import NetworkSettings, SceneFlowNet, SceneFlowNetOutput, scene_flow
from objectflow.networks.sceneflownet.decoder import Hourglass
from objectflow.networks.sceneflownet.network import expected_displacement, fill_holes
from objectflow.networks.xfeat import sample_cells

SMALL = dataclasses.replace(NetworkSettings().scaled(0.125), reach=2, trunk_blocks=(1, 1))


def _network(**changes: Any) -> Any:
    return SceneFlowNet(dataclasses.replace(SMALL, **changes), generator=torch.Generator().manual_seed(0))


def _frames(height: int, width: int, batch: int = 2) -> list[Tensor]:
    generator = torch.Generator().manual_seed(1)
    shape = (batch, 3, height, width)
    frames = [torch.rand(shape, generator=generator) for _ in range(4)]
    frames[1][:, :, :9, :7] = torch.nan
    frames[3][:, :, 11:30, 5:22] = torch.nan
    return frames


@pytest.mark.parametrize(
    ("correlation", "details", "cosine"),
    [(True, False, False), (False, False, True), (True, True, True), (False, True, False)],
)
@pytest.mark.parametrize(("height", "width"), [(48, 64), (33, 50), (8, 8)])
def test_maps_have_the_inputs_size_and_every_weight_learns(
    correlation: bool, details: bool, cosine: bool, height: int, width: int
) -> None:
    network = _network(
        correlation=correlation,
        details=details,
        correlation_cosine=cosine,
        displacement=cosine,
        displacement_window=1,
        local_motion_window=2 if cosine else 0,
        length_unit=0.1,
    )
    for parameter in network.parameters():  # residual blocks start as their shortcuts: activate the other layers
        if not parameter.any():
            torch.nn.init.constant_(parameter, 0.1)
    out = network(*_frames(height, width))
    channels = SceneFlowNetOutput(3, 3, 3, 2, 2, 1)  # type: ignore[arg-type]
    for name, value in out._asdict().items():
        assert value.shape == (2, getattr(channels, name), height, width), name
        assert torch.isfinite(value).all(), name
    assert out.trajectory.shape == (2, 6, height, width)
    torch.testing.assert_close(out.trajectory[:, 3:], out.center + out.translation)
    if height > 8:
        sum(value.square().sum() for value in out).backward()
        silent = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
        assert not silent


def test_default_is_the_papers_size() -> None:
    hourglass: Any = Hourglass(192, NetworkSettings())
    shapes = [stage[0](torch.zeros(1, stage[0].in_channels, n, m)).shape[1:] for stage, (n, m) in zip(
        hourglass.down, ((30, 40), (30, 40), (15, 20), (8, 10)), strict=True
    )]  # fmt: skip
    assert [tuple(shape) for shape in shapes] == [(64, 30, 40), (128, 15, 20), (256, 8, 10), (512, 4, 5)]
    network: Any = SceneFlowNet()
    assert network.hourglass.down[0][0].in_channels == 192
    assert network.color_encoder is not None
    assert network.color_encoder.project.out_channels == 256
    strides = [layer.stride[0] for layer in network.shape_encoder if isinstance(layer, torch.nn.Conv2d)]
    assert strides == [1, 1, 2, 1, 1, 2, 1, 1, 2]


def test_a_detail_reaches_its_surroundings_alone() -> None:
    """The finest link passes on a single pixel, which stride 8 cannot resolve."""
    generator = torch.Generator().manual_seed(2)
    network = _network(details=True)
    features = torch.rand(1, 3 * SMALL.shape_stages[-1][-1], 6, 8, generator=generator)
    details = [torch.rand(1, 7, 48 // step, 64 // step, generator=generator) for step in (4, 2, 1)]
    changed = [*details[:2], details[2].clone()]
    changed[2][:, :, 21, 33] += 1
    with torch.no_grad():
        off = (network.hourglass(features, details) - network.hourglass(features, changed)).abs().sum(1)[0]
    reach = len(SMALL.fine[-1])  # the 3x3 layers of the link and of every width after the first
    around = off[21 - reach : 22 + reach, 33 - reach : 34 + reach]
    assert float(around.max()) > 0
    assert float(off.sum()) == pytest.approx(float(around.sum()))


def test_the_correlation_comes_with_the_maps() -> None:
    network = _network().eval()
    frames = _frames(48, 64)
    with torch.no_grad():
        maps, correlation = network.predict(*frames)
        torch.testing.assert_close(maps, network(*frames))
        assert correlation.shape == (2, 25, 6, 8)
        curr, prev = network.color_encoder(torch.cat([frames[2], frames[0]])).chunk(2)
        # Displacement (1, -2): cell (3, 4) of the current frame with cell (4, 2) of the previous one.
        expected = (curr[:, :, 3, 4] * prev[:, :, 4, 2]).sum(1)
    torch.testing.assert_close(correlation[:, (1 + 2) * 5 + (-2 + 2), 3, 4], expected)
    assert _network(correlation=False).predict(*frames)[1] is None


def test_expected_displacement_of_certain_matches_is_the_match() -> None:
    """With one certain match per cell, it is a lookup; matches without depth are ignored."""
    generator = torch.Generator().manual_seed(3)
    reach, height, width = 2, 5, 7
    points = torch.rand(2, 1, 3, height, width, generator=generator)
    prev, curr = (torch.cat([one, torch.ones(1, 1, height, width)], 1) for one in points)
    correlation = torch.zeros(1, 25, height, width)
    correlation[0, (1 + reach) * 5 - 2 + reach, 3, 4] = 80.0  # cell (4, 2)
    correlation[0, (0 + reach) * 5 + 1 + reach, 2, 2] = 80.0  # cell (2, 3), without depth
    correlation[0, (-1 + reach) * 5 + 0 + reach, 2, 2] = 60.0  # cell (1, 2)
    prev[:, :, 2, 3] = 0
    curr[:, :, 0, 0] = 0
    found = expected_displacement(correlation, prev, curr, reach)
    torch.testing.assert_close(found[0, :3, 3, 4], prev[0, :3, 4, 2] - curr[0, :3, 3, 4])
    torch.testing.assert_close(found[0, :3, 2, 2], prev[0, :3, 1, 2] - curr[0, :3, 2, 2])
    torch.testing.assert_close(found[0, 3, 3, 4], torch.tensor(1.0))
    assert not found[0, :3, 0, 0].any()
    # Equal correlations give the mean over the patch's points inside the image.
    around = prev[0, :3, 2:5, 4:7].flatten(1).mean(1)  # cell (4, 6) with reach 2, cut by two edges
    torch.testing.assert_close(found[0, :3, 4, 6], around - curr[0, :3, 4, 6])
    nothing = expected_displacement(correlation, torch.zeros_like(prev), curr, reach)
    assert not nothing.any()


def test_a_window_leaves_other_candidates_out_of_the_expected_displacement() -> None:
    """With two distant candidates, the window's mean is the likelier one, and the whole patch's lies between them."""
    generator = torch.Generator().manual_seed(4)
    reach, height, width = 3, 7, 7
    prev, curr = (
        torch.cat([torch.rand(1, 3, height, width, generator=generator), torch.ones(1, 1, height, width)], 1)
        for _ in range(2)
    )
    correlation = torch.full((1, 49, height, width), -80.0)
    likely = {(1, 1): 0.5, (1, 2): 0.125, (6, 5): 0.375}  # cells of the previous frame, seen from cell (3, 3)
    for (row, column), probability in likely.items():
        correlation[0, (row - 3 + reach) * 7 + column - 3 + reach, 3, 3] = math.log(probability)
    found = expected_displacement(correlation, prev, curr, reach, window=1)[0, :, 3, 3]
    near = (0.5 * prev[0, :3, 1, 1] + 0.125 * prev[0, :3, 1, 2]) / 0.625
    torch.testing.assert_close(found[:3], near - curr[0, :3, 3, 3])
    torch.testing.assert_close(found[3], torch.tensor(0.625))
    everywhere = expected_displacement(correlation, prev, curr, reach)[0, :, 3, 3]
    mean = sum(probability * prev[0, :3, row, column] for (row, column), probability in likely.items())
    torch.testing.assert_close(everywhere[:3], mean - curr[0, :3, 3, 3])
    torch.testing.assert_close(everywhere[3], torch.tensor(0.5))


def test_maps_are_in_metres_for_any_length_unit() -> None:
    plain, other = _network(), _network(length_unit=0.1, origin_depth=0.5)
    frames = _frames(48, 64)
    for network in (plain, other):
        for parameter in network.heads.parameters():
            torch.nn.init.zeros_(parameter)
        torch.nn.init.ones_(network.heads.maps["translation"].bias)
        network.eval()
    with torch.no_grad():
        before, after = plain(*frames), other(*frames)
    torch.testing.assert_close(after.center, before.center)  # the pixel's own point, or its replacement
    torch.testing.assert_close(after.translation, 0.1 * before.translation)


def test_cosines_do_not_depend_on_the_features_lengths() -> None:
    network = _network(correlation_cosine=True).eval()
    frames = _frames(48, 64)
    with torch.no_grad():
        before, correlation = network.predict(*frames)
        inside = correlation[correlation != 0]  # 0 beyond the image's edge
        assert float(inside.abs().max()) <= float(network.sharpness.exp()) * (1 + 1e-5)
        for parameter in network.color_encoder.project.parameters():
            parameter.mul_(3)
        after, same = network.predict(*frames)
    torch.testing.assert_close(same, correlation)
    torch.testing.assert_close(after, before)


@pytest.mark.parametrize(("height", "width"), [(48, 64), (36, 52)])
def test_xfeat_adds_its_scaled_cosines(height: int, width: int) -> None:
    """Each sum over a patch is written out for each shift, zero beyond the image."""
    plain, with_xfeat = _network(correlation_cosine=True), _network(correlation_cosine=True, xfeat=True)
    tensors = {**with_xfeat.state_dict(), **plain.state_dict()}
    with_xfeat.load_state_dict(tensors)
    frames = _frames(height, width)
    cells, reach = (-(-height // 8), -(-width // 8)), SMALL.reach
    with torch.no_grad():
        added = with_xfeat.predict(*frames)[1] - plain.predict(*frames)[1]
        descriptors = with_xfeat.xfeat(torch.cat([frames[2], frames[0]]))
    curr, prev = F.normalize(sample_cells(descriptors, (height, width), 8, cells), dim=1).chunk(2)
    padded = F.pad(prev, (reach, reach, reach, reach))
    for k, (row, column) in enumerate(itertools.product(range(2 * reach + 1), repeat=2)):
        moved = padded[..., row : row + cells[0], column : column + cells[1]]
        torch.testing.assert_close(added[:, k], 10 * (curr * moved).sum(1), atol=1e-4, rtol=1e-4)


def test_images_may_be_padded_before_the_network() -> None:
    network = _network().eval()
    frames = _frames(33, 50)
    padded = [torch.nn.functional.pad(frame, (0, 6, 0, 7), value=torch.nan if i % 2 else 0.0)
              for i, frame in enumerate(frames)]  # fmt: skip
    with torch.no_grad():
        out, whole = network(*frames), network(*padded)
    torch.testing.assert_close(out.translation, whole.translation[..., :33, :50])


def test_missing_depth_is_told_from_depth_zero() -> None:
    network = _network().eval()
    frames = _frames(32, 40)
    zeros = [torch.nan_to_num(frame, 0.0) for frame in frames]
    with torch.no_grad():
        assert not torch.allclose(network(*frames).rotation, network(*zeros).rotation)


def test_frozen_normalisation_treats_every_pair_independently() -> None:
    frames = _frames(32, 40)
    for norm, same in (("frozen", True), ("batch", False)):
        network = _network(trunk_norm=norm).train()
        torch.nn.init.constant_(network.color_encoder.trunk.layer2[0].bn3.weight, 0.5)
        together = network(*frames).radius[:1]
        alone = network(*(frame[:1] for frame in frames)).radius
        assert torch.allclose(together, alone, atol=1e-6, rtol=1e-4) is same


def test_bfloat16_inside_gives_float32_maps_near_the_exact_ones() -> None:
    network, frames = _network().eval(), _frames(32, 40)
    exact = network(*frames)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rough = network(*frames)
    for one, other in zip(rough, exact, strict=True):
        assert one.dtype == torch.float32
        assert 0 < (one - other).norm() < 0.2 * other.norm()  # about 0.4% per layer, over 25 layers
    sum(one.square().sum() for one in rough).backward()
    assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in network.parameters())


def test_same_generator_same_network() -> None:
    first, second = _network().state_dict(), _network().state_dict()
    assert all(torch.equal(value, second[name]) for name, value in first.items())


def test_settings_go_through_json() -> None:
    settings = dataclasses.replace(SMALL, details=True, trunk_norm="frozen")
    assert NetworkSettings.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings
    assert NetworkSettings.from_dict({}) == NetworkSettings()
    assert NetworkSettings.from_dict(dict(NetworkSettings.RETIRED)) == NetworkSettings()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"deep": 3}, "unknown network setting 'deep'"),
        ({"reach": -1}, "reach must lie in 0..[0-9]+, not -1"),
        ({"reach": "10"}, "reach must be of type int"),
        ({"reach": True}, "reach must be of type int"),
        ({"down": 3}, "down must be a list"),
        ({"down": [[64], [128]]}, "up needs 1 stages, not 3"),
        ({"fine": [[64]]}, "fine needs 3 stages"),
        ({"fine": [[64], [], [3]]}, "stage without layers"),
        ({"trunk_norm": "group"}, "trunk_norm must be batch or frozen"),
        ({"xfeat": True}, "xfeat needs correlation_cosine"),
        ({"displacement_window": 65}, "displacement_window must lie in 0..64, not 65"),
        ({"local_motion_window": 3}, "local_motion_window needs displacement"),
        ({"local_motion_window": -1}, "local_motion_window must lie in 0..64, not -1"),
        ({"local_motion_scale": 0.0}, "local_motion_scale must be finite and above 0"),
        ({"local_motion_tolerance": float("nan")}, "local_motion_tolerance must be finite and above 0"),
        ({"missing": "masked"}, "missing is 'masked', which this version no longer implements: it needs 'channel'"),
        ({"correlation_mean": True}, "correlation_mean is True, which this version no longer implements"),
    ],
)
def test_bad_settings_are_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(MethodError, match=message):
        NetworkSettings.from_dict(values)


def test_fill_holes_takes_the_surrounding_mean() -> None:
    valid = torch.ones(1, 1, 9, 10)
    valid[..., 2:5, 2:4] = 0
    valid[..., 8, 9] = 0  # the only pixel of its block of two; the block of four has one more row
    points = torch.arange(270.0).reshape(1, 3, 9, 10) * valid
    filled = fill_holes(points, valid)
    assert torch.equal(filled * valid, points)
    torch.testing.assert_close(filled[0, :, 4, 2], points[0, :, 5, 2:4].mean(-1))  # its block of 2x2
    torch.testing.assert_close(filled[0, :, 8, 9], points[0, :, 8, 8])
    block = points[0, :, :4, :4].reshape(3, -1).sum(-1) / valid[0, 0, :4, :4].sum()
    torch.testing.assert_close(filled[0, :, 2, 2], block)
    assert not fill_holes(torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 4, 4)).any()


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.0099, 0.0101, 1.0, 3.1])
def test_scene_flow_is_equation_one(angle: float) -> None:
    rng = np.random.default_rng(4)
    axis, translation, center, points = rng.normal(size=(4, 7, 3))
    rotation = axis / np.linalg.norm(axis, axis=1, keepdims=True) * angle
    R = geometry.so3_exp(rotation)
    expected = np.einsum("nij,nj->ni", R, points - center) + center + translation - points
    tensors = [torch.from_numpy(x.T[None].copy()).requires_grad_() for x in (rotation, translation, center, points)]
    found = scene_flow(*tensors)
    np.testing.assert_allclose(found.detach()[0].T.numpy(), expected, atol=1e-12)
    assert torch.autograd.gradcheck(scene_flow, tensors)


def test_heads_applied_at_once_are_the_layers_one_by_one() -> None:
    network = _network()
    features = torch.randn(2, network.hourglass.channels, 6, 7, generator=torch.Generator().manual_seed(2))
    together = network.heads(features)
    for name, value in together._asdict().items():
        torch.testing.assert_close(value, network.heads.maps[name](features), rtol=1e-5, atol=1e-7)
