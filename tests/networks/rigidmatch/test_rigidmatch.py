"""Every step of `rigidmatch` against something independent; and the whole for every setting."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.small_networks import TINY_RIGID
from objectflow.errors import MethodError
from objectflow.methods.rigidmatch.decoding import decode, select
from objectflow.networks.rigidmatch import RigidMatch, RigidMatchSettings
from objectflow.networks.rigidmatch.dual_softmax import dual_softmax_mean, dual_softmax_mean_of_product
from objectflow.networks.rigidmatch.inputs import Grid, cells, encode_inputs, grid
from objectflow.networks.rigidmatch.matching import GlobalMatching
from objectflow.networks.rigidmatch.outputs import pixel_masks
from objectflow.networks.rigidmatch.seeds import choose_seeds


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def images(height: int, width: int, batch: int = 2) -> list[Tensor]:
    made = [torch.rand(batch, 3, height, width, generator=generator(k)) for k in range(4)]
    for points in (made[1], made[3]):
        points[:, 2] += 0.5
        points[:, :, 3:9, 5:11] = torch.nan
    return made


# --- settings ---


def test_settings_survive_json() -> None:
    for settings in (RigidMatchSettings(), TINY_RIGID):
        assert RigidMatchSettings.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings


def test_headers_of_the_first_generation_describe_its_networks() -> None:
    old = {"stride": 4, "key_pool": 2, "matching": "global", "reach": 10, "objects": "queries", "motion": "solve"}
    found = RigidMatchSettings.from_dict(old)
    assert (found.stride, found.key_pool) == (4, 2)
    assert (found.xfeat, found.window_geometry, found.detail_channels, found.median_depth) == ("none", False, 0, 0.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"stride": 6}, "stride must be 4 or 8, not 6"),
        ({"heads": 5}, "multiple of heads"),
        ({"queries": 0}, "queries must lie in 1..1024, not 0"),
        ({"blocks": [1, 1]}, "blocks needs three numbers"),
        ({"blocks": [1, 1, "a"]}, "blocks must be of type int"),
        ({"xfeat": "only"}, "xfeat must be one of none, input, score, both, not 'only'"),
        ({"matching": "windowed"}, "matching 'windowed' is no longer supported, only 'global'"),
        ({"stride": 4}, "detail_channels needs a stride of 8"),
        ({"median_depth": -1.0}, "median_depth must be finite and >= 0"),
        ({"seed_radius": float("nan")}, "seed_radius must be finite"),
        ({"widths": 3}, "unknown network setting 'widths'"),
        ({"stride": "8"}, "stride must be of type int"),
    ],
)
def test_settings_that_make_no_network_are_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(MethodError, match=message):
        RigidMatchSettings.from_dict(values)


def test_the_full_size_keeps_to_its_budget() -> None:
    assert sum(one.numel() for one in RigidMatch().state_dict().values()) < 6e6


# --- the inputs ---


def test_normals_of_a_plane_face_the_camera() -> None:
    normal = torch.tensor([0.3, -0.5, -0.8])
    normal = normal / normal.norm()
    ray = torch.cat([cells(9, 12, torch.device("cpu")) / 10 - 0.5, torch.ones(1, 9, 12)])
    points = ray * (-0.9 / (normal[:, None, None] * ray).sum(0))
    points[:, 4, 6] = torch.nan
    image, safe, valid = encode_inputs(torch.zeros(1, 3, 9, 12), points[None], 4)
    assert image.shape == (1, 8, 12, 12)
    found = image[0, 5:, 1:8, 1:11]
    alone = torch.ones(7, 10, dtype=torch.bool)
    for row, column in ((2, 5), (4, 5), (3, 4), (3, 6)):
        alone[row, column] = False  # next to the hole
    torch.testing.assert_close(found[:, alone], normal[:, None].expand(-1, int(alone.sum())), rtol=0, atol=1e-4)
    assert not found[:, ~alone].any()
    assert valid.sum() == 9 * 12 - 1
    assert (safe[0, :, 4, 6] == 0).all()
    torch.testing.assert_close(image[0, 3, 0, 0], 1 / points[2, 0, 0])


def test_a_grid_takes_single_points_and_fills_holes_from_near() -> None:
    points = torch.arange(3 * 8 * 8, dtype=torch.float32).reshape(1, 3, 8, 8)
    valid = torch.ones(1, 1, 8, 8)
    valid[..., 4, 4] = 0
    found = grid(points * valid, valid, 4)
    assert torch.equal(found.points[..., 0, 1], points[..., 0, 4])
    torch.testing.assert_close(found.points[0, :, 1, 1], points[0, :, (0, 0, 4), (0, 4, 0)].mean(-1))
    assert found.valid.sum() == 3


# --- matching ---


def test_dual_softmax_is_that_of_its_definition_with_the_true_gradient() -> None:
    rng = generator(1)
    scores = torch.randn(2, 5, 6, dtype=torch.float64, generator=rng).mul(3).requires_grad_()
    dustbin = torch.randn(2, 5, dtype=torch.float64, generator=rng).requires_grad_()
    values = torch.randn(2, 6, 3, dtype=torch.float64, generator=rng).requires_grad_()
    sums, rows, columns = dual_softmax_mean(scores, dustbin, values)
    with_hidden = torch.cat([scores, dustbin[..., None]], dim=2)
    weights = with_hidden.softmax(2)[..., :-1] * scores.softmax(1)
    torch.testing.assert_close(sums, weights @ values)
    torch.testing.assert_close(rows, with_hidden.logsumexp(2))
    torch.testing.assert_close(columns, scores.logsumexp(1))
    with torch.no_grad():
        torch.testing.assert_close(dual_softmax_mean(scores, dustbin, values)[0], sums)
    assert torch.autograd.gradcheck(dual_softmax_mean, (scores, dustbin, values))


@torch.no_grad()
@pytest.mark.parametrize("cells", [5, 128, 300])
def test_without_a_table_the_dual_softmax_is_the_same(cells: int) -> None:
    rng = generator(2)
    left, right = (torch.randn(2, n, 9, dtype=torch.float64, generator=rng) for n in (cells, 70))
    dustbin = torch.randn(2, cells, dtype=torch.float64, generator=rng)
    values = torch.randn(2, 70, 3, dtype=torch.float64, generator=rng)
    whole = dual_softmax_mean(left @ right.mT, dustbin, values)
    for one, other in zip(dual_softmax_mean_of_product(left, right, dustbin, values), whole, strict=True):
        torch.testing.assert_close(one, other)


@torch.no_grad()
def test_the_network_says_the_same_without_the_table() -> None:
    made, seen = RigidMatch(TINY_RIGID, generator=generator()).eval(), images(48, 64)
    whole, spared = made(*seen), made(*seen, table=False)
    assert spared.scores.numel() == 0
    assert len(whole.masks) > len(spared.masks) == 1
    expected = whole._replace(scores=spared.scores, masks=whole.masks[-1:])
    for name, one in spared._asdict().items():
        torch.testing.assert_close(one, getattr(expected, name), atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_unlikely_queries_are_left_out_and_the_others_stay_the_same() -> None:
    made, seen = RigidMatch(TINY_RIGID, generator=generator()).eval(), images(48, 64)
    every = made(*seen, table=False)
    probability = every.objectness[-1].sigmoid()
    least = float(probability.max(0).values.sort().values[probability.shape[1] // 2])
    kept = (probability > least).any(0)
    assert 0 < kept.sum() < len(kept)
    some = made(*seen, table=False, min_probability=least)
    for name in ("objectness", "masks"):
        torch.testing.assert_close(getattr(some, name), getattr(every, name)[:, :, kept])
    for name in ("anchors", "moves", "rotation", "translation", "detail_queries"):
        torch.testing.assert_close(getattr(some, name), getattr(every, name)[:, kept], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(some.match, every.match)


@torch.no_grad()
def test_without_a_likely_query_there_is_none() -> None:
    made, seen = RigidMatch(TINY_RIGID, generator=generator()).eval(), images(48, 64)
    none = made(*seen, table=False, min_probability=1.0)
    assert none.masks.shape[2] == none.rotation.shape[1] == 0
    labels, objects = decode(select(none, 0), (48, 64))
    assert not labels.any()
    assert objects == ()


def test_barred_cells_and_large_logits_keep_everything_finite() -> None:
    scores = torch.full((1, 3, 4), -1e4)
    scores[0, 0, 1] = 60.0
    scores[0, 1, 2] = -60.0
    scores.requires_grad_()
    sums, rows, columns = dual_softmax_mean(scores, torch.zeros(1, 3), torch.ones(1, 4, 2))
    (sums.sum() + rows.sum() + columns.sum()).backward()  # type: ignore[no-untyped-call]
    assert scores.grad is not None
    assert all(bool(one.isfinite().all()) for one in (sums, rows, columns, scores.grad))
    assert float(sums[0, 0, 0].detach()) == pytest.approx(1)


def matcher(**changes: Any) -> GlobalMatching:
    """Tokens are their own descriptors; nothing is expected, and nothing dustbin."""
    made = GlobalMatching(dataclasses.replace(TINY_RIGID, **changes))
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.zero_()
        made.project.weight.copy_(torch.eye(16))
        made.log_scale.fill_(4.0)
        made.prior.bias[0] = -20.0
        made.dustbin.bias.fill_(-20.0)
    return made


def test_matching_finds_shuffled_cells_and_their_points() -> None:
    size = (4, 5)
    curr = torch.randn(1, 20, 16, generator=generator(2))
    order = torch.randperm(20, generator=generator(3))
    prev = curr[:, order]
    points = [torch.rand(1, 3, *size, generator=generator(k)) + 0.5 for k in (4, 5)]
    grids = [Grid(one, torch.ones(1, 1, *size)) for one in points]
    found = matcher()(torch.cat([curr, prev]), *grids)
    true = order.argsort()
    assert torch.equal(found.scores[0].argmax(1), true)
    assert float(found.confidence.detach().min()) > 0.99
    there = points[1].flatten(2)[0, :, true].reshape(3, *size)
    torch.testing.assert_close(points[0][0] + found.shift[0, 2:], there, rtol=0, atol=0.01)
    place = cells(*size, torch.device("cpu"))
    moved = place.flatten(1)[:, true].reshape(2, *size) - place
    torch.testing.assert_close(found.shift[0, :2], moved, rtol=0, atol=0.05)
    torch.testing.assert_close(found.feature[0].flatten(1).T, curr[0], rtol=0, atol=0.05)


def test_cells_without_depth_are_never_matched() -> None:
    size = (1, 8)
    tokens = torch.eye(8, 16)[None]
    points = torch.ones(1, 3, *size)
    valid = torch.ones(1, 1, *size)
    valid[..., 5] = 0
    found = matcher()(
        torch.cat([tokens, tokens.roll(4, 1)]), Grid(points, torch.ones_like(valid)), Grid(points, valid)
    )
    assert (found.scores[0][:, 5] < -5e3).all()


def test_the_prior_prefers_cells_where_it_expects_them() -> None:
    made = matcher()
    with torch.no_grad():
        made.project.weight.zero_()  # a table: all looks alike
        made.prior.bias.copy_(torch.tensor([3.0, 0.5, -0.25]))  # two columns on, one row up
    one = Grid(torch.ones(1, 3, 4, 6), torch.ones(1, 1, 4, 6))
    found = made(torch.ones(2, 24, 16), one, one)
    best = found.scores[0].argmax(1)
    column, row = best % 6, best // 6
    place = cells(4, 6, torch.device("cpu")).flatten(1).long()
    assert torch.equal(column, (place[0] + 2).clamp(max=5))
    assert torch.equal(row, (place[1] - 1).clamp(min=0))
    distance = torch.stack([column - place[0] - 2, row - place[1] + 1]).float()
    expected = -torch.nn.functional.softplus(torch.tensor(3.0)) / 16 * distance.square().sum(0)
    torch.testing.assert_close(found.scores[0].amax(1), expected, rtol=0, atol=1e-4)


# --- seeds ---


def test_seeds_are_the_greedy_ones() -> None:
    rng = np.random.default_rng(0)
    votes, sure = rng.uniform(0, 0.3, (40, 6)), rng.uniform(0, 1, 40)
    left, expected = sure.copy(), []
    for _ in range(7):
        best = int(left.argmax())
        expected.append(best)
        left = left * (1 - np.exp(-np.square(votes - votes[best]).sum(1) / 0.05**2))
    found = choose_seeds(torch.from_numpy(votes)[None], torch.from_numpy(sure)[None], 7, 0.05)
    assert found[0].tolist() == expected


# --- the whole ---


FORMS: list[dict[str, Any]] = [
    {},
    {"xfeat": "input"},
    {"xfeat": "score", "window_geometry": False},
    {"xfeat": "both", "stride": 8, "detail_channels": 6},
    {"updates": 0},
    {"updates": 2, "window": 2, "stride": 8, "rounds": 0, "key_pool": 1},
    {"decoder_layers": 0, "attention_layers": 0},
]


@pytest.mark.parametrize("changes", FORMS, ids=str)
def test_every_form_of_the_network_speaks_and_learns(changes: dict[str, Any]) -> None:
    settings = dataclasses.replace(TINY_RIGID, **changes)
    network = RigidMatch(settings, generator=generator())
    output = network(*images(37, 50))
    H, W = (-(-one // (2 * settings.stride)) * 4 for one in (37, 50))
    assert output.match.shape == (2, 3, H, W)
    assert output.masks.shape[1:] == (2, 4, H, W)
    assert output.upsampling.shape == (2, 9, (settings.fine_stride // settings.mask_stride) ** 2, H, W)
    assert pixel_masks(output.masks[-1], output.upsampling, output.detail_queries, output.details).shape == (
        2,
        4,
        settings.fine_stride * H,
        settings.fine_stride * W,
    )
    numbers = [one for one in output if one.is_floating_point() and one.numel()]
    assert all(bool(one.isfinite().all()) for one in numbers)
    torch.testing.assert_close(torch.linalg.det(output.rotation), torch.ones(2, 4), rtol=0, atol=1e-4)
    torch.stack([one.clamp(-1e3, 1e3).square().mean() for one in numbers]).sum().backward()  # type: ignore[no-untyped-call]
    without = [name for name, one in network.named_parameters() if one.grad is None]
    assert without == []
    assert all(bool(one.grad.isfinite().all()) for one in network.parameters() if one.grad is not None)


def test_frames_without_any_depth_do_no_harm() -> None:
    seen = images(32, 48)
    for index in (1, 3):
        seen[index] = torch.full_like(seen[index], torch.nan)
    output = RigidMatch(TINY_RIGID, generator=generator()).eval()(*seen)
    assert all(bool(one.isfinite().all()) for one in output)


def test_pairs_of_a_batch_do_not_see_each_other() -> None:
    network = RigidMatch(TINY_RIGID, generator=generator()).eval()
    seen = images(32, 48)
    with torch.no_grad():
        both, one = network(*seen), network(*(image[1:] for image in seen))
    torch.testing.assert_close(both.match[1:], one.match, rtol=0, atol=1e-5)
    torch.testing.assert_close(both.masks[:, 1:], one.masks, rtol=0, atol=1e-3)
    torch.testing.assert_close(both.translation[1:], one.translation, rtol=0, atol=1e-4)


def test_in_bfloat16_places_keep_their_digits() -> None:
    network = RigidMatch(TINY_RIGID, generator=generator()).eval()
    seen = images(32, 48)
    with torch.no_grad():
        exact = network(*seen)
        with torch.autocast("cpu", torch.bfloat16):
            coarse = network(*seen)
    assert {one.dtype for one in coarse if one.is_floating_point()} == {torch.float32}
    # Votes are offsets from points; with bfloat16 points they would be off by millimetres.
    where = exact.window_center.eq(coarse.window_center).all(1, keepdim=True)
    assert float(where.float().mean()) > 0.9
    assert float(((exact.votes - coarse.votes).abs() * where).median()) < 2e-3
