"""The fused correlation and pool against explicit sums, and their gradients against finite differences."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from objectflow.networks.sceneflownet import correlation as fused


def _random(*shape: int, seed: int = 0, gradient: bool = False) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_(gradient)


def _slow(curr: Tensor, prev: Tensor, values: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Both equations, number by number."""
    batch, _, height, width = curr.shape
    side = 2 * reach + 1
    correlation = torch.zeros(batch, side * side, height, width, dtype=curr.dtype)
    pooled = torch.full_like(values, -torch.inf)
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                for d in range(side * side):
                    k, l = y + d // side - reach, x + d % side - reach  # noqa: E741 - the letters of the paper
                    there = 0 <= k < height and 0 <= l < width
                    if there:
                        correlation[b, d, y, x] = (curr[b, :, y, x] * prev[b, :, k, l]).sum()
                    value = values[b, :, k, l] if there else torch.zeros_like(values[b, :, 0, 0])
                    product = correlation[b, d, y, x].clamp_min(0) * value
                    pooled[b, :, y, x] = torch.maximum(pooled[b, :, y, x], product)
    return correlation, pooled


@pytest.mark.parametrize("reach", [0, 1, 3])
def test_forward_is_the_papers_sums(reach: int) -> None:
    curr, prev, values = _random(2, 5, 3, 4), _random(2, 5, 3, 4, seed=1), _random(2, 2, 3, 4, seed=2)
    correlation, pooled = _slow(curr, prev, values, reach)
    weights = fused.correlate(curr, prev, reach)
    torch.testing.assert_close(weights, correlation)
    torch.testing.assert_close(fused.weighted_max_pool(weights.relu(), values, reach), pooled)
    torch.testing.assert_close(fused.correlate_naive(curr, prev, reach), correlation)
    torch.testing.assert_close(fused.weighted_max_pool_naive(weights.relu(), values, reach), pooled)


def test_gradients_agree_with_finite_differences() -> None:
    curr, prev = _random(2, 4, 3, 5, gradient=True), _random(2, 4, 3, 5, seed=1, gradient=True)
    values = _random(2, 3, 3, 5, seed=2, gradient=True)

    def whole(curr: Tensor, prev: Tensor, values: Tensor) -> Tensor:
        return fused.weighted_max_pool(fused.correlate(curr, prev, 2).relu(), values, 2)

    assert torch.autograd.gradcheck(whole, (curr, prev, values))


def test_gradients_are_those_of_the_naive_form() -> None:
    weights, values = _random(2, 49, 6, 5, gradient=True), _random(2, 3, 6, 5, seed=1, gradient=True)
    upstream = _random(2, 3, 6, 5, seed=2)
    expected = torch.autograd.grad(fused.weighted_max_pool_naive(weights, values, 3), (weights, values), upstream)
    found = torch.autograd.grad(fused.weighted_max_pool(weights, values, 3), (weights, values), upstream)
    for one, other in zip(found, expected, strict=True):
        assert other.abs().max() > 0
        torch.testing.assert_close(one, other)


def test_forward_is_the_same_with_and_without_gradient() -> None:
    weights, values = _random(1, 25, 4, 5, gradient=True), _random(1, 3, 4, 5, seed=1)
    with torch.no_grad():
        plain = fused.weighted_max_pool(weights, values, 2)
    assert torch.equal(fused.weighted_max_pool(weights, values, 2).detach(), plain)


def test_moved_features_are_found_at_their_displacement() -> None:
    prev = torch.eye(36, dtype=torch.float64).reshape(1, 36, 6, 6)  # every cell has a unique feature
    curr = torch.roll(prev, (1, -2), dims=(2, 3))  # the content of (y, x) comes from (y - 1, x + 2)
    weights = fused.correlate(curr, prev, 2)
    assert weights.argmax(dim=1)[0, 1:, :4].unique().tolist() == [(-1 + 2) * 5 + 2 + 2]
    values = torch.arange(1.0, 37, dtype=torch.float64).reshape(1, 1, 6, 6)
    pooled = fused.weighted_max_pool(weights, values, 2)
    assert torch.equal(pooled[..., 1:, :4], values[..., :5, 2:])
