"""Resampling in NumPy and torch, against SciPy, torch and definitions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch.nn import functional

from objectflow.geometry import torch_resample
from objectflow.geometry.resample import (
    bilinear_corners,
    nearest_indices,
    resize_color,
    resize_nearest,
    sample_bilinear,
    upsample_mask,
)

RNG = np.random.default_rng(0)
IMAGE = RNG.normal(size=(7, 9)).astype(np.float32)


@pytest.mark.parametrize("size", [(7, 9), (14, 27), (3, 4), (1, 1), (20, 5)])
def test_nearest_pixels_have_the_nearest_centres(size: tuple[int, int]) -> None:
    for found, source, target in zip(nearest_indices((7, 9), size), (7, 9), size, strict=True):
        centers = (np.arange(target) + 0.5) * source / target - 0.5
        distance = np.abs(centers[:, None] - np.arange(source))
        np.testing.assert_allclose(distance[np.arange(target), found], distance.min(1), atol=1e-12)
    resized = resize_nearest(IMAGE, size)
    assert resized.shape == size
    assert np.isin(resized, IMAGE).all()


def test_shrinking_colour_averages_and_equal_sizes_change_nothing() -> None:
    color = RNG.integers(0, 256, (6, 8, 3), dtype=np.uint8)
    blocks = color.reshape(3, 2, 4, 2, 3).mean((1, 3))
    np.testing.assert_allclose(resize_color(color, (3, 4)), blocks, atol=0.51)
    assert resize_color(color, (6, 8)) is color
    assert resize_nearest(IMAGE, (7, 9)) is IMAGE


def test_enlarging_a_mask_by_whole_factors_repeats_its_pixels() -> None:
    mask = RNG.random((4, 5)) > 0.5
    np.testing.assert_array_equal(upsample_mask(mask, (12, 10)), mask.repeat(3, axis=0).repeat(2, axis=1))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bilinear_samples_agree_with_scipy(dtype: type[np.floating]) -> None:
    pixels = RNG.uniform([0, 0], [8, 6], (60, 2)).astype(dtype)
    pixels[:4] = [[0, 0], [8, 6], [8, 0], [3, 6]]
    expected = ndimage.map_coordinates(IMAGE.astype(np.float64), pixels[:, ::-1].T, order=1)
    found = sample_bilinear(IMAGE, pixels)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, expected, atol=1e-6)
    channels = np.stack([IMAGE, 2 * IMAGE], axis=-1)
    np.testing.assert_allclose(sample_bilinear(channels, pixels), np.stack([expected, 2 * expected], -1), atol=2e-6)


def test_images_may_be_one_pixel_wide() -> None:
    column = np.array([[1.0], [3.0]])
    np.testing.assert_allclose(sample_bilinear(column, np.array([[0.0, 0.25], [0.0, 1.0]])), [1.5, 3])
    np.testing.assert_allclose(sample_bilinear(column.T, np.array([[0.75, 0.0]])), [2.5])
    index, _ = bilinear_corners(np.zeros((1, 2)), (1, 1))
    assert index.tolist() == [[0], [0], [0], [0]]


def test_torch_samples_agree_with_numpy_and_with_grid_sample() -> None:
    image = torch.from_numpy(RNG.normal(size=(2, 3, 7, 9)))
    u, v = torch.from_numpy(RNG.uniform(0, 8, (2, 4, 5))), torch.from_numpy(RNG.uniform(0, 6, (2, 4, 5)))
    found = torch_resample.sample_bilinear(image, u, v)
    assert found.shape == (2, 3, 4, 5)
    for b in range(2):
        pixels = torch.stack([u[b], v[b]], -1).reshape(-1, 2).numpy()
        expected = sample_bilinear(image[b].permute(1, 2, 0).numpy(), pixels)
        np.testing.assert_allclose(found[b].flatten(1).T, expected, atol=1e-12)
    grid = torch_resample.sampling_grid(u, v, 7, 9)
    sampled = functional.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=False)
    np.testing.assert_allclose(sampled, found, atol=1e-12)
