"""The match loss against a loop over cells, and its gradient."""

from __future__ import annotations

import math

import pytest
import torch

from objectflow.errors import MethodError
from objectflow.training.sceneflownet_match_loss import match_loss

REACH, HEIGHT, WIDTH = 2, 3, 4
SIDE = 2 * REACH + 1


def slow(correlation: torch.Tensor, matches: torch.Tensor, inside: torch.Tensor) -> float:
    """The definition, cell by cell and neighbour by neighbour."""
    pairs = []
    for b in range(len(correlation)):
        losses = []
        for i in range(HEIGHT):
            for j in range(WIDTH):
                if not inside[b, 8 * i, 8 * j]:
                    continue
                logits = correlation[b, :, i, j].tolist()
                total = math.log(sum(math.exp(one) for one in logits))
                column = float(matches[b, 0, 8 * i, 8 * j]) / 8 - j
                row = float(matches[b, 1, 8 * i, 8 * j]) / 8 - i
                if math.isnan(column) or max(abs(column), abs(row)) > REACH:
                    continue
                loss = 0.0
                for k in range(-REACH, REACH + 1):
                    for m in range(-REACH, REACH + 1):
                        share = max(0.0, 1 - abs(row - k)) * max(0.0, 1 - abs(column - m))
                        loss += share * (total - logits[(k + REACH) * SIDE + m + REACH])
                losses.append(loss)
        pairs.append(sum(losses) / max(8, len(losses)))
    return sum(pairs) / len(pairs)


def some(seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    correlation = torch.randn(3, SIDE**2, HEIGHT, WIDTH, generator=generator)
    size = (8 * HEIGHT, 8 * WIDTH)
    shift = 40 * torch.rand(3, 2, *size, generator=generator) - 20  # some beyond the patch of 16 pixels
    grid = torch.stack(torch.meshgrid(torch.arange(size[1]), torch.arange(size[0]), indexing="xy"))
    matches = grid + shift
    matches[:, :, 8, 8] = torch.nan
    matches[0, :, 0, 0] = 0.0  # exactly the same cell
    matches[0, :, 0, 8] = torch.tensor([8.0 + 8 * REACH, 8 * REACH])  # the last corner of the patch
    inside = torch.rand(3, *size, generator=generator) < 0.7
    inside[0, 0, 0] = inside[0, 0, 8] = inside[0, 8, 8] = True
    inside[2] = False
    return correlation, matches, inside


@pytest.mark.parametrize("seed", range(4))
def test_it_equals_a_loop(seed: int) -> None:
    correlation, matches, inside = some(seed)
    assert float(match_loss(correlation, matches, inside)) == pytest.approx(
        slow(correlation, matches, inside), rel=1e-5
    )


def test_the_gradient_raises_the_true_cell_and_lowers_the_others() -> None:
    correlation, matches, inside = (one[:1] for one in some(0))
    correlation = torch.zeros_like(correlation).requires_grad_()
    match_loss(correlation, matches, inside).backward()
    assert correlation.grad is not None
    wanted = correlation.grad[0, :, 0, 0]
    assert int(wanted.argmin()) == (SIDE**2) // 2
    assert int((wanted < 0).sum()) == 1
    assert not correlation.grad[0, :, 1, 1].any()  # no match


def test_a_pair_without_foreground_costs_nothing() -> None:
    correlation, matches, inside = some(1)
    assert float(match_loss(correlation[2:], matches[2:], inside[2:])) == 0


def test_a_patch_of_one_cell_is_refused() -> None:
    correlation, matches, inside = some(1)
    with pytest.raises(MethodError, match="reach"):
        match_loss(correlation[:, :1], matches, inside)
