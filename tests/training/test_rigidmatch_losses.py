"""The losses of `rigidmatch` against slow references, for the true result, and in the training loop."""

from __future__ import annotations

import dataclasses
import itertools
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from helpers.pair_sets import random_pair, write_pairs
from helpers.small_networks import TINY_RIGID
from helpers.training_runs import RIGID, checkpoint_tensors, job, write_set
from objectflow.dataset.augment import AugmentSettings
from objectflow.dataset.batches import Batches
from objectflow.dataset.transforms import rescale
from objectflow.errors import MethodError
from objectflow.networks.rigidmatch import RigidMatch, RigidMatchOutput
from objectflow.networks.weights import read_header
from objectflow.networks.xfeat import XFeat
from objectflow.training.hungarian import assign_queries, mask_costs
from objectflow.training.loop import train
from objectflow.training.model_config import RigidMatchModel
from objectflow.training.recipe import Recipe
from objectflow.training.rigidmatch_loss_settings import RigidMatchLossSettings
from objectflow.training.rigidmatch_losses import (
    flow_term,
    match_term,
    position_term,
    rigidmatch_losses,
    vote_terms,
    window_term,
)
from objectflow.training.rigidmatch_targets import make_rigidmatch_targets
from objectflow.training.step import Prepared, prepare

SETTINGS = TINY_RIGID
STRIDE = SETTINGS.stride


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Prepared:
    """Two pairs whose motions are small enough for matches to be visible."""
    rows = []
    for number in range(2):
        row = random_pair(number, objects=2)
        depth = np.where(row.curr.depth > 0, np.float32(0.8), np.float32(0))
        blocks = np.kron(np.arange(12).reshape(3, 4) % 3, np.ones((8, 8), int)).astype(np.int32)
        frames = {name: dataclasses.replace(getattr(row, name), depth=depth) for name in ("prev", "curr")}
        objects = tuple(
            dataclasses.replace(
                obj, center=np.array([0, 0, 0.8]), translation=np.array([0.02 * k, -0.01, 0.0]),
                rotation_vector=np.zeros(3), in_both=True,
            )
            for k, obj in enumerate(row.objects)
        )  # fmt: skip
        rows.append(dataclasses.replace(row, prev_labels=blocks, curr_labels=blocks, objects=objects, **frames))
    shards = write_pairs(tmp_path_factory.mktemp("set"), rows)
    batch = next(Batches(shards, 2, size=None, seed=0, shuffle=False).iterate())
    return prepare(batch, Recipe(augment=AugmentSettings.nothing(), model=RigidMatchModel()), None)


@cache
def network() -> RigidMatch:
    return RigidMatch(SETTINGS, generator=torch.Generator().manual_seed(0)).eval()


def output_of(prepared: Prepared) -> RigidMatchOutput:
    with torch.no_grad():
        out: RigidMatchOutput = network()(*prepared.images)
    return out


def true_cells_of(prepared: Prepared, stride: int, b: int, row: int, column: int) -> tuple[str, dict[int, float]]:
    """The kind of a cell's match and its bilinear shares, by the definition."""
    if not torch.isfinite(prepared.points[b, 2, row * stride, column * stride]):
        return "unknown", {}
    x, y = (prepared.matches[b, :, row * stride, column * stride] / stride).tolist()
    if math.isnan(x):
        return "occluded", {}
    labels, before = (
        prepared.batch.curr_labels[b, ::stride, ::stride],
        prepared.batch.prev_labels[b, ::stride, ::stride],
    )
    shown = torch.isfinite(prepared.images[1][b, 2, ::stride, ::stride])
    shares = {}
    for r, c in itertools.product((math.floor(y), math.floor(y) + 1), (math.floor(x), math.floor(x) + 1)):
        if (
            0 <= r < labels.shape[0]
            and 0 <= c < labels.shape[1]
            and before[r, c] == labels[row, column]
            and shown[r, c]
        ):
            shares[r * labels.shape[1] + c] = (1 - abs(y - r)) * (1 - abs(x - c))
    total = sum(shares.values())
    return "seen", {cell: share / total for cell, share in shares.items()} if total > 0.1 else {}


def test_true_cells_and_the_match_term_are_those_of_a_loop(prepared: Prepared) -> None:
    output, truth = output_of(prepared), make_rigidmatch_targets(prepared, STRIDE, 0.25)
    width = output.coarse_match.shape[-1]
    own_height, own_width = truth.coarse_weight.shape[1:]
    top = bottom = 0.0
    kinds = []
    for b, row, column in np.ndindex(2, own_height, own_width):
        kind, shares = true_cells_of(prepared, STRIDE, b, row, column)
        kinds.append(kind)
        assert bool(truth.coarse.occluded[b, row, column]) == (kind == "occluded")
        pairs = zip(
            truth.coarse.cell[b, :, row, column].tolist(), truth.coarse.share[b, :, row, column].tolist(), strict=True
        )
        expected = {cell: share for cell, share in shares.items() if share > 0}
        assert {cell: share for cell, share in pairs if share > 0} == pytest.approx(expected, abs=1e-5)
        weight = 1.0 if prepared.targets.mask[b, row * STRIDE, column * STRIDE] else 0.25
        at = row * width + column
        logits = torch.cat([output.scores[b, at], output.dustbin[b, at : at + 1]]).log_softmax(0)
        if kind == "occluded":
            top, bottom = top - weight * float(logits[-1]), bottom + weight
        elif shares:
            for cell, share in shares.items():
                there = cell // own_width * width + cell % own_width
                other = float(output.scores[b, :, there].log_softmax(0)[at])
                top -= weight * share * 0.5 * (float(logits[there]) + other)
            bottom += weight
    assert {"seen", "unknown"} <= set(kinds)
    assert float(match_term(output, truth)) == pytest.approx(top / bottom, rel=1e-4)


def test_the_window_term_is_that_of_a_loop(prepared: Prepared) -> None:
    output, truth = output_of(prepared), make_rigidmatch_targets(prepared, STRIDE, 1.0)
    own_height, own_width = truth.owner.shape[1:]
    values = []
    for b, row, column in np.ndindex(2, own_height, own_width):
        _, shares = true_cells_of(prepared, STRIDE // 2, b, row, column)
        x, y = output.window_center[b, :, row, column].tolist()
        inside = {}
        for cell, share in shares.items():
            r, c = cell // own_width - y + 1, cell % own_width - x + 1
            if 0 <= r < 3 and 0 <= c < 3:
                inside[r * 3 + c] = share
        if sum(inside.values()) > 0.5:
            logs = output.window_logits[b, :, row, column].log_softmax(0)
            values.append(-sum(s * float(logs[k]) for k, s in inside.items()) / sum(inside.values()))
    assert len(values) > 20
    cut = output._replace(
        window_logits=output.window_logits[..., :own_height, :own_width],
        window_center=output.window_center[..., :own_height, :own_width],
    )
    assert float(window_term(cut, truth)) == pytest.approx(np.mean(values), rel=1e-4)


def test_mask_costs_are_those_of_each_pair() -> None:
    logits = torch.randn(2, 1, 3, 40, generator=torch.Generator().manual_seed(1))
    masks = (torch.rand(1, 2, 40, generator=torch.Generator().manual_seed(2)) < 0.3).float()
    costs = mask_costs(logits, masks)
    for layer, q, k in np.ndindex(2, 3, 2):
        p, t = logits[layer, 0, q].sigmoid(), masks[0, k]
        entropy = -(t * p.log() + (1 - t) * (1 - p).log()).sum() / (t.sum() + 40 / 32)
        dice = 1 - (2 * (p * t).sum() + 1) / (p.sum() + t.sum() + 1)
        torch.testing.assert_close(costs.cross_entropy[layer, 0, q, k], entropy)
        torch.testing.assert_close(costs.dice[layer, 0, q, k], dice)


def test_the_assignment_is_the_cheapest_of_all() -> None:
    costs = torch.randn(1, 1, 5, 4, generator=torch.Generator().manual_seed(3))
    present = torch.tensor([[True, False, True, True]])
    found = assign_queries(costs, present)[0, 0].tolist()
    assert found[1] == -1
    best = min(
        itertools.permutations(range(5), 3),
        key=lambda queries: sum(float(costs[0, 0, q, k]) for q, k in zip(queries, (0, 2, 3), strict=True)),
    )
    assert (found[0], found[2], found[3]) == best


def test_with_more_objects_than_queries_some_go_without() -> None:
    found = assign_queries(torch.zeros(1, 1, 2, 3), torch.ones(1, 3, dtype=torch.bool))[0, 0].tolist()
    assert sorted(found) == [-1, 0, 1]


def test_the_flow_term_is_the_mean_of_objects_means(prepared: Prepared) -> None:
    output, truth = output_of(prepared), make_rigidmatch_targets(prepared, STRIDE, 1.0)
    query = torch.tensor([[1, 3], [0, 2]])
    kept = torch.tensor([[True, True], [True, False]])
    means = []
    for b, k in ((0, 0), (0, 1), (1, 0)):
        R, t = output.rotation[b, query[b, k]], output.translation[b, query[b, k]]
        errors = [
            float((R @ truth.points[b, :, r, c] + t - truth.fine_position[b, :, r, c]).norm())
            for r, c in np.ndindex(*truth.owner.shape[1:])
            if truth.owner[b, r, c] == k and truth.measured[b, r, c]
        ]
        means.append(np.mean(errors))
    assert float(flow_term(output, truth, query, kept)) == pytest.approx(np.mean(means), rel=1e-4)


def test_the_truth_costs_nothing(prepared: Prepared) -> None:
    truth = make_rigidmatch_targets(prepared, STRIDE, 0.1)
    made = output_of(prepared)
    height, width = truth.owner.shape[1:]
    made = made._replace(
        match=truth.fine_position,
        coarse_match=truth.coarse_position,
        votes=truth.votes,
        rotation=torch.eye(3).expand_as(made.rotation),
        translation=prepared.batch.table.translation[:, [0, 1, 0, 0]],
    )
    assert (height, width) == (12, 16)
    assert float(position_term(made, truth)) < 1e-5
    assert float(vote_terms(made, truth)["votes"]) < 1e-5
    both = torch.ones(2, 2, dtype=torch.bool)
    assert float(flow_term(made, truth, torch.tensor([[0, 1], [0, 1]]), both)) < 1e-5
    assert truth.moving.all()


def test_all_terms_are_finite_and_weighted_into_the_total(prepared: Prepared) -> None:
    learner = RigidMatch(SETTINGS, generator=torch.Generator().manual_seed(1))
    settings = RigidMatchLossSettings()
    losses = rigidmatch_losses(learner(*prepared.images), prepared, STRIDE, settings)
    weighted = sum(getattr(settings, name) * float(value) for name, value in losses.items() if name != "total")
    assert float(losses["total"].detach()) == pytest.approx(weighted, rel=1e-5)
    losses["total"].backward()  # type: ignore[no-untyped-call]
    gradients = {name: parameter.grad for name, parameter in learner.named_parameters()}
    assert [name for name, gradient in gradients.items() if gradient is None or not gradient.isfinite().all()] == []


def test_a_weight_that_is_not_finite_is_refused() -> None:
    with pytest.raises(MethodError, match="loss setting flow must be finite and >= 0, not nan"):
        RigidMatchLossSettings(flow=math.nan)


def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(tmp_path: Path) -> None:
    data = write_set(tmp_path / "set")
    recipe = dataclasses.replace(RIGID, steps=4, validate_every=4, log_every=1, checkpoint_minutes=0.0)
    train(job(data, tmp_path / "whole", recipe))
    parts = tmp_path / "parts"
    train(job(data, parts, recipe))
    newest = sorted((parts / "checkpoints").iterdir())[-1]
    for file in newest.iterdir():
        file.unlink()
    newest.rmdir()
    train(job(data, parts, recipe, resume=True))
    left, right = checkpoint_tensors(tmp_path / "whole"), checkpoint_tensors(parts)
    assert left.keys() == right.keys()
    assert [name for name in left if not torch.equal(left[name], right[name])] == []
    _, metadata = read_header(parts / "weights.safetensors")
    assert (metadata["variant"], metadata["size"]) == ("rigidmatch", [24, 32])
    assert metadata["recipe"]["model"]["network"] == SETTINGS.to_dict()


def test_xfeat_is_needed_stays_frozen_and_travels_with_the_weights(tmp_path: Path) -> None:
    data, path = write_set(tmp_path / "set"), tmp_path / "xfeat.safetensors"
    model = RigidMatchModel(dataclasses.replace(SETTINGS, xfeat="both"))
    recipe = dataclasses.replace(RIGID, model=model, steps=2, validate_every=2)
    with pytest.raises(MethodError, match=r"network needs the filters of XFeat: .*--backbone-weights"):
        train(job(data, tmp_path / "none", recipe))
    filters = XFeat(torch.Generator().manual_seed(3)).state_dict()
    safetensors.torch.save_file(filters, path)
    train(dataclasses.replace(job(data, tmp_path / "run", recipe), backbone=path))
    found = checkpoint_tensors(tmp_path / "run")
    assert all(torch.equal(found[f"best xfeat.{name}"], value) for name, value in filters.items())


def test_a_scaled_batch_has_the_losses_of_the_batch(prepared: Prepared) -> None:
    """Depth is normalised before losses: the scale of the scene does not weigh."""
    recipe = dataclasses.replace(RIGID, model=RigidMatchModel(SETTINGS))
    losses = []
    for factor in (1.0, 5.0):
        batch = rescale(prepared.batch, torch.full((2,), factor))
        one = prepare(batch, recipe, None)
        torch.testing.assert_close(one.scale * factor, prepare(prepared.batch, recipe, None).scale)
        with torch.no_grad():
            losses.append(rigidmatch_losses(network()(*one.images), one, STRIDE))
    for name, value in losses[0].items():
        torch.testing.assert_close(losses[1][name], value, rtol=1e-3, atol=1e-4)
