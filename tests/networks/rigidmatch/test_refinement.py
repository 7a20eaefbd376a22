"""Upsampling by neighbours and the updates of matches in small windows, against loops over cells."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from objectflow.networks.rigidmatch.inputs import Grid, cells
from objectflow.networks.rigidmatch.outputs import pixel_masks, upsampled_masks
from objectflow.networks.rigidmatch.refinement import update_matches
from objectflow.networks.rigidmatch.upsampling import mix_neighbors
from objectflow.networks.rigidmatch.window_geometry import WindowGeometry


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_neighbours_are_mixed_as_a_loop_mixes_them() -> None:
    values = torch.rand(2, 3, 3, 4, generator=generator(5))
    weights = torch.rand(2, 9, 4, 3, 4, generator=generator(6))
    found = mix_neighbors(values, weights)
    for b, row, column in np.ndindex(2, 6, 8):
        r, c, sub = row // 2, column // 2, (row % 2) * 2 + column % 2
        total = sum(
            float(weights[b, k, sub, r, c])
            * values[b, :, min(max(r + k // 3 - 1, 0), 2), min(max(c + k % 3 - 1, 0), 3)]
            for k in range(9)
        )
        torch.testing.assert_close(found[b, :, row, column], total)


def test_upsampling_can_be_compiled_with_channels_innermost() -> None:
    values = torch.rand(2, 12, 3, generator=generator(5)).transpose(1, 2).reshape(2, 3, 3, 4)
    weights = torch.rand(2, 9, 4, 3, 4, generator=generator(6))
    gradients = []
    for form in (mix_neighbors, torch.compile(mix_neighbors, backend="aot_eager")):
        one = values.clone(memory_format=torch.preserve_format).requires_grad_()
        form(one, weights).square().sum().backward()
        gradients.append(one.grad)
    torch.testing.assert_close(gradients[1], gradients[0])


def test_an_update_is_the_expectation_over_its_window() -> None:
    height, width, channels = 5, 6, 4
    one, other = torch.randn(2, 1, channels, height, width, generator=generator(7))
    prev = Grid(torch.rand(1, 3, height, width, generator=generator(8)), torch.ones(1, 1, height, width))
    prev.valid[..., 2, 3] = 0
    place = cells(height, width, torch.device("cpu"))[None] + torch.tensor([1.2, -0.9])[:, None, None]
    logits, center, moved, point, peak = update_matches(one, other, prev, place, 1)
    for row, column in np.ndindex(height, width):
        middle = (min(column + 1, width - 1), max(row - 1, 0))
        assert tuple(center[0, :, row, column].tolist()) == middle
        found = [
            (float(one[0, :, row, column] @ other[0, :, y, x]), x, y)
            for y in range(middle[1] - 1, middle[1] + 2)
            for x in range(middle[0] - 1, middle[0] + 2)
            if 0 <= x < width and 0 <= y < height and (y, x) != (2, 3)
        ]
        share = torch.tensor([value for value, _, _ in found]).softmax(0)
        expected = sum(p * prev.points[0, :, y, x] for p, (_, x, y) in zip(share, found, strict=True))
        torch.testing.assert_close(point[0, :, row, column], expected)
        torch.testing.assert_close(
            moved[0, 0, row, column], sum(p * x for p, (_, x, _) in zip(share, found, strict=True))
        )
        torch.testing.assert_close(peak[0, 0, row, column], share.max())
    assert logits.shape == (1, 9, height, width)


def test_window_scores_see_offsets_from_the_current_match() -> None:
    """Logits that fall with the distance from the match make the nearest cell the best."""
    made = WindowGeometry(4)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.zero_()
        made.window.weight[0, 3] = 1.0  # the length
        made.out.weight[0, 0] = -1.0
    points, match = torch.rand(1, 6, 9, 3, generator=generator(1)), torch.rand(1, 3, 2, 3, generator=generator(2))
    with torch.no_grad():
        found = made(made.context(torch.rand(1, 4, 2, 3)), torch.zeros(1, 6, 9), points, match)
    expected = -10 * (points - match.flatten(2).mT[:, :, None]).norm(dim=-1)
    torch.testing.assert_close(found, expected)


def test_masks_get_details_and_are_linear_between_their_cells() -> None:
    masks, weights = torch.rand(1, 2, 3, 4, generator=generator(1)), torch.zeros(1, 9, 4, 3, 4)
    weights[:, 4] = 1
    queries, details = torch.rand(1, 2, 5, generator=generator(2)), torch.rand(1, 5, 6, 8, generator=generator(3))
    cells_ = upsampled_masks(masks, weights, queries, details)
    for k, row, column in np.ndindex(2, 6, 8):
        expected = masks[0, k, row // 2, column // 2] + queries[0, k] @ details[0, :, row, column] / 5**0.5
        torch.testing.assert_close(cells_[0, k, row, column], expected)
    pixels = pixel_masks(masks, weights, queries, details)
    assert pixels.shape == (1, 2, 12, 16)
    torch.testing.assert_close(pixels[..., ::2, ::2], cells_)
    torch.testing.assert_close(pixels[..., 3, 4], (cells_[..., 1, 2] + cells_[..., 2, 2]) / 2)


@pytest.mark.parametrize("window", [1, 2])
def test_blocks_of_cells_give_the_same_matches(window: int) -> None:
    """More cells than a block holds, so that the last block is smaller."""
    generator = torch.Generator().manual_seed(0)
    height, width = 30, 41
    one, other = (torch.randn(2, 6, height, width, generator=generator) for _ in range(2))
    prev = Grid(torch.randn(2, 3, height, width, generator=generator), torch.ones(2, 1, height, width))
    place = 20 * torch.rand(2, 2, height, width, generator=generator)

    def scorer(logits: torch.Tensor, points: torch.Tensor, part: slice) -> torch.Tensor:
        return points.sum(-1) + torch.arange(height * width)[part, None] / 1000

    whole, blocks = (update_matches(one, other, prev, place, window, scorer, blocks=flag) for flag in (False, True))
    for expected, found in zip(whole, blocks, strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)
