"""The losses against a slow loop over pixels and objects in NumPy, and in edge cases."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.object_tables import object_table
from objectflow.dataset.targets import ObjectTable, Targets, make_targets
from objectflow.errors import MethodError
from objectflow.networks.sceneflownet.outputs import SceneFlowNetOutput
from objectflow.training.sceneflownet_losses import SceneFlowNetLossSettings, sceneflownet_losses

SHAPE = (14, 18)
WEIGHTS = {
    "mask": 1.0,
    "centrality": 1.0,
    "rotation": 0.1,
    "translation": 100.0,
    "center": 10.0,
    "flow": 10.0,
    "radius": 1.0,
    "trajectory": 1.0,
    "variance": 0.1,
    "violation": 0.1,
}
"""The paper's weights (section V), independent of the defaults."""


def a_batch(rotation_weight: float = 0.0) -> tuple[Targets, torch.Tensor, ObjectTable]:
    """Three pairs with three objects, one, and none; a tenth of the depth is missing."""
    generator = torch.Generator().manual_seed(0)
    label = torch.tensor([[1, 4, 5], [2, 0, 0], [0, 0, 0]])
    table = ObjectTable(
        label,
        torch.randn(3, 3, 3, generator=generator) * 0.2 + torch.tensor([0.0, 0.0, 0.7]),
        torch.randn(3, 3, 3, generator=generator) * 0.05,
        torch.randn(3, 3, 3, generator=generator) * 0.4,
        label > 0,
    )
    labels = torch.zeros(3, *SHAPE, dtype=torch.int64)
    labels[0, :5, :9], labels[0, 6:12, 2:6], labels[0, 3:9, 12:17] = 1, 4, 5
    labels[1, 4:12, 3:15] = 2
    points = torch.rand(3, 3, *SHAPE, generator=generator) + torch.tensor([-0.5, -0.5, 0.4])[:, None, None]
    points = torch.where(torch.rand(3, 1, *SHAPE, generator=generator) < 0.1, torch.nan, points)
    return make_targets(table, labels, points, nearest=20, rotation_weight=rotation_weight), points, table


def some_output(spread: float = 0.1) -> SceneFlowNetOutput:
    """Noise around 0, so that some pixels violate their sphere and some do not."""
    generator = torch.Generator().manual_seed(1)
    channels = (3, 3, 3, 2, 2, 1)
    return SceneFlowNetOutput(*(torch.randn(3, c, *SHAPE, generator=generator) * spread for c in channels))


def near_truth(targets: Targets, spread: float) -> SceneFlowNetOutput:
    noise = some_output(spread)
    return SceneFlowNetOutput(
        targets.rotation + noise.rotation,
        targets.translation + noise.translation,
        targets.center + noise.center,
        noise.mask + 60 * torch.stack([~targets.mask, targets.mask], 1),
        noise.centrality + 60 * torch.stack([~targets.eta, targets.eta], 1),
        targets.radius + noise.radius,
    )


def reference(
    output: SceneFlowNetOutput, targets: Targets, points: torch.Tensor, *, squared: bool, rotation_weight: float = 0.0
) -> dict[str, float]:
    """The terms, computed per pixel and per object in float64."""
    maps = {name: value.double().numpy() for name, value in output._asdict().items()}
    truth = {field.name: getattr(targets, field.name).numpy() for field in dataclasses.fields(targets)}
    P = points.double().numpy()
    sums = dict.fromkeys(WEIGHTS, 0.0)

    def cross_entropy(logits: np.ndarray, yes: bool) -> float:
        return float(np.log(np.exp(logits).sum()) - logits[int(yes)])

    def error(difference: np.ndarray) -> float:
        return float(np.sum(difference**2) if squared else np.sqrt(np.sum(difference**2)))

    pairs = len(P)
    for b in range(pairs):
        pixels = [(v, u) for v in range(SHAPE[0]) for u in range(SHAPE[1]) if truth["mask"][b, v, u]]
        measured = [(v, u) for v, u in pixels if np.isfinite(P[b, 2, v, u])]
        for v in range(SHAPE[0]):
            for u in range(SHAPE[1]):
                one = cross_entropy(maps["mask"][b, :, v, u], truth["mask"][b, v, u])
                sums["mask"] += one / (pairs * SHAPE[0] * SHAPE[1])
        xi, real, groups = {}, {}, {}
        for v, u in pixels:
            share = 1 / (pairs * len(pixels))
            got = {name: value[b, :, v, u] for name, value in maps.items()}
            want = {name: truth[name][b, :, v, u] for name in ("rotation", "translation", "center", "radius")}
            for name, value in want.items():
                sums[name] += share * error(got[name] - value)
            sums["centrality"] += share * cross_entropy(got["centrality"], truth["eta"][b, v, u])
            for place, source in ((xi, got), (real, want)):
                X, T, Q = source["center"], source["translation"], source["rotation"]
                place[v, u] = np.concatenate([X, X + T, rotation_weight * Q])
            sums["trajectory"] += share * error(xi[v, u] - real[v, u])
            distance = np.linalg.norm(xi[v, u] - real[v, u])
            if distance > want["radius"][0] / 5:
                sums["violation"] += share * distance
            groups.setdefault(truth["index"][b, v, u], []).append((v, u))
        for v, u in measured:
            R = Rotation.from_rotvec(maps["rotation"][b, :, v, u]).as_matrix()
            X, T, p = maps["center"][b, :, v, u], maps["translation"][b, :, v, u], P[b, :, v, u]
            flow = R @ (p - X) + X + T - p
            sums["flow"] += error(flow - truth["flow"][b, :, v, u]) / (pairs * len(measured))
        for members in groups.values():
            features = np.array([xi[pixel] for pixel in members])
            spread = np.mean(np.sum((features - features.mean(0)) ** 2, axis=1))
            sums["variance"] += spread / pairs
    return sums


@pytest.mark.parametrize("squared", [False, True])
@pytest.mark.parametrize("rotation_weight", [0.0, 0.3])
def test_terms_equal_a_loop(squared: bool, rotation_weight: float) -> None:
    targets, points, _ = a_batch(rotation_weight)
    settings = SceneFlowNetLossSettings(squared=squared, rotation_weight=rotation_weight)
    for output in (some_output(), near_truth(targets, 0.02)):
        expected = reference(output, targets, points, squared=squared, rotation_weight=rotation_weight)
        found = sceneflownet_losses(output, targets, points, settings)
        assert set(found) == {*WEIGHTS, "total"}
        for name, value in expected.items():
            assert float(found[name]) == pytest.approx(value, rel=2e-5, abs=1e-7), name
        total = sum(WEIGHTS[name] * value for name, value in expected.items())
        assert float(found["total"]) == pytest.approx(total, rel=2e-5)


def test_only_far_pixels_violate() -> None:
    targets, points, _ = a_batch()
    exact = near_truth(targets, 0.0)
    reach = targets.radius / 5
    for factor, expected in ((0.99, 0.0), (1.01, None)):
        # X and X + T move along x by the same amount, which is sqrt(2) of it in xi.
        shift = torch.cat([factor * reach / 2**0.5, torch.zeros(3, 2, *SHAPE)], 1)
        found = float(sceneflownet_losses(exact._replace(center=exact.center + shift), targets, points)["violation"])
        mean = sum(float((1.01 * reach[b, 0] * targets.mask[b]).sum() / targets.mask[b].sum()) for b in range(2))
        assert found == pytest.approx(mean / 3 if expected is None else expected, rel=1e-5)


@pytest.mark.parametrize("squared", [False, True])
def test_the_truth_costs_nothing_and_gradients_are_finite_there(squared: bool) -> None:
    targets, points, _ = a_batch()
    output = SceneFlowNetOutput(*(one.requires_grad_() for one in near_truth(targets, 0.0)))
    found = sceneflownet_losses(output, targets, points, SceneFlowNetLossSettings(squared=squared))
    for name, value in found.items():
        assert float(value.detach()) < 1e-5, name
    found["total"].backward()
    assert all(bool(one.grad is not None and one.grad.isfinite().all()) for one in output)


def test_background_teaches_the_mask_alone() -> None:
    targets, points, _ = a_batch()
    output = SceneFlowNetOutput(*(one.requires_grad_() for one in some_output()))
    sceneflownet_losses(output, targets, points)["total"].backward()
    for name, one in output._asdict().items():
        background = (one.grad.abs().sum(1) > 0)[~targets.mask]
        assert bool(background.all()) if name == "mask" else not bool(background.any()), name


def test_no_foreground_at_all() -> None:
    table = object_table([[], []])
    points = torch.full((2, 3, *SHAPE), torch.nan)
    targets = make_targets(table, torch.zeros(2, *SHAPE, dtype=torch.int64), points)
    output = SceneFlowNetOutput(*(one[:2].requires_grad_() for one in some_output()))
    found = sceneflownet_losses(output, targets, points)
    assert float(found["total"].detach()) == pytest.approx(float(found["mask"]))
    found["total"].backward()
    assert all(bool(one.grad is not None and one.grad.isfinite().all()) for one in output)


def test_the_mean_of_two_halves_is_the_whole() -> None:
    """As distributed training requires, for pairs with different numbers of pixels and objects; the last has none."""
    targets, points, _ = a_batch()
    output = some_output()
    parts = []
    for b in range(3):
        one = Targets(**{field.name: getattr(targets, field.name)[b : b + 1] for field in dataclasses.fields(targets)})
        parts.append(sceneflownet_losses(SceneFlowNetOutput(*(x[b : b + 1] for x in output)), one, points[b : b + 1]))
    for name, value in sceneflownet_losses(output, targets, points).items():
        assert float(value) == pytest.approx(np.mean([float(part[name]) for part in parts]), rel=1e-5), name


def test_low_precision_is_compared_in_float32() -> None:
    targets, points, _ = a_batch()
    output = SceneFlowNetOutput(*(one.bfloat16() for one in some_output()))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = sceneflownet_losses(output, targets, points)
    wide = sceneflownet_losses(SceneFlowNetOutput(*(one.float() for one in output)), targets, points)
    for name, value in wide.items():
        assert found[name].dtype == torch.float32
        assert torch.equal(found[name], value)


def test_vl_adds_two_terms() -> None:
    targets, points, _ = a_batch()
    both = sceneflownet_losses(some_output(), targets, points)
    without = sceneflownet_losses(some_output(), targets, points, SceneFlowNetLossSettings(vl=False))
    assert set(both) - set(without) == {"variance", "violation"}
    added = 0.1 * both["variance"] + 0.1 * both["violation"]
    assert float(both["total"] - without["total"]) == pytest.approx(float(added), rel=1e-4)


@pytest.mark.parametrize("weight", [-1.0, float("nan"), float("inf")])
def test_weights_must_be_finite(weight: float) -> None:
    with pytest.raises(MethodError, match="loss setting flow must be finite"):
        SceneFlowNetLossSettings(flow=weight)
