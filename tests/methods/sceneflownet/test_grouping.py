"""The greedy spheres against plain loops over pixels, and the variant with rotation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from objectflow.errors import MethodError
from objectflow.methods.sceneflownet import grouping
from objectflow.methods.sceneflownet.grouping import GroupingSettings, group, trajectory_feature
from objectflow.typing import LabelImage


def group_by_loops(
    feature: Tensor, foreground: Tensor, centrality: Tensor, radius: Tensor, min_pixels: int
) -> LabelImage:
    """The paper's rule by plain loops in double precision."""
    points = feature.double().flatten(1).T.numpy()
    eta, reach = centrality.flatten().numpy(), radius.double().flatten().numpy()
    left = [int(i) for i in foreground.flatten().numpy().nonzero()[0]]
    groups: list[list[int]] = []
    while left:
        seed = max(left, key=lambda i: (eta[i], -i))
        members = [i for i in left if i == seed or np.sqrt(((points[i] - points[seed]) ** 2).sum()) < reach[seed]]
        groups.append(members)
        left = [i for i in left if i not in set(members)]
    labels = np.zeros(len(points), np.int32)
    objects = [members for members in groups if len(members) >= min_pixels]
    for number, members in enumerate(objects, start=1):
        labels[members] = number
    for members in groups:
        if len(members) < min_pixels and objects:
            for i in members:
                distances = [np.linalg.norm(points[i] - points[owner].mean(axis=0)) for owner in objects]
                labels[i] = 1 + int(np.argmin(distances))
    return labels.reshape(foreground.shape)


def random_maps(seed: int, objects: int, strays: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    owner = torch.randint(objects, (15, 20), generator=generator)
    truth = torch.rand(objects, 6, generator=generator)
    feature = truth[owner].permute(2, 0, 1) + 0.02 * torch.randn(6, 15, 20, generator=generator)
    wild = torch.rand(15, 20, generator=generator) < strays
    feature = torch.where(wild, torch.rand(6, 15, 20, generator=generator), feature)
    foreground = torch.rand(15, 20, generator=generator) < 0.8
    # Few levels, so that many pixels tie; some radii below 0, as those of an untrained network.
    centrality = torch.randint(5, (15, 20), generator=generator).float()
    return feature, foreground, centrality, 0.3 * torch.rand(15, 20, generator=generator) - 0.05


@pytest.fixture(params=[0, 40, 1024])
def few(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Number of pixels from which all distances are computed at once: never, half way, from the start."""
    monkeypatch.setattr(grouping, "DIRECT_PIXELS", request.param)
    return int(request.param)


@pytest.mark.usefixtures("few")
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("strays", [0.0, 0.3])
def test_groups_equal_those_of_plain_loops(seed: int, strays: float) -> None:
    maps = random_maps(seed, 1 + seed, strays)
    for min_pixels in (1, 8):
        labels = group(*maps, GroupingSettings(min_pixels=min_pixels))
        assert labels.dtype == torch.int32
        np.testing.assert_array_equal(labels.numpy(), group_by_loops(*maps, min_pixels))


@pytest.mark.usefixtures("few")
def test_groups_equal_those_of_plain_loops_on_random_pixels() -> None:
    feature, foreground, centrality, radius = random_maps(3, 4, 1.0)
    tiny = torch.full_like(radius, 0.05)
    labels = group(feature, foreground, centrality, tiny, GroupingSettings(min_pixels=1))
    assert int(labels.max()) > 200
    np.testing.assert_array_equal(labels.numpy(), group_by_loops(feature, foreground, centrality, tiny, 1))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_gives_the_same_labels() -> None:
    maps = random_maps(2, 5, 0.2)
    on_cuda = group(*(one.cuda() for one in maps))
    assert on_cuda.is_cuda
    assert torch.equal(on_cuda.cpu(), group(*maps))


@pytest.mark.usefixtures("few")
def test_labels_are_in_the_order_of_the_seeds_and_leftovers_join_the_nearest_object() -> None:
    feature = torch.zeros(6, 2, 30)
    feature[0, 0], feature[0, 1] = 0.0, 1.0
    feature[0, 0, :3] = 0.8  # three strays, nearest to the second row's object
    centrality = torch.zeros(2, 30)
    centrality[1, 4], centrality[0, 5], centrality[0, 1] = 3.0, 2.0, 9.0
    foreground = torch.ones(2, 30, dtype=torch.bool)
    foreground[1, 29] = False
    labels = group(feature, foreground, centrality, torch.full((2, 30), 0.1))
    expected = torch.ones(2, 30, dtype=torch.int32)
    expected[0, 3:], expected[1, 29] = 2, 0
    assert torch.equal(labels, expected)


@pytest.mark.usefixtures("few")
def test_pixels_beyond_the_limit_on_seeds_join_the_nearest_object() -> None:
    feature = torch.arange(5.0).repeat_interleave(30).expand(6, 1, -1)
    centrality = -feature[0]
    foreground = torch.ones(1, 150, dtype=torch.bool)
    labels = group(feature, foreground, centrality, torch.full((1, 150), 0.5), GroupingSettings(max_seeds=2))
    assert labels[0].unique_consecutive(return_counts=True)[1].tolist() == [30, 120]


def test_only_the_variant_separates_objects_on_one_path_with_different_rotations() -> None:
    # Two halves with the same X and T, whose rotations differ by half a radian.
    center = torch.tensor([0.1, 0.0, 0.6])[:, None, None].expand(3, 12, 16)
    translation = torch.tensor([0.05, 0.0, 0.0])[:, None, None].expand(3, 12, 16)
    rotation = torch.zeros(3, 12, 16)
    rotation[2, :, 8:] = 0.5
    expected = torch.ones(12, 16, dtype=torch.int32)
    expected[:, 8:] = 2
    rest = (torch.ones(12, 16, dtype=torch.bool), torch.zeros(12, 16), torch.full((12, 16), 0.03))
    paper = trajectory_feature(center, translation, rotation)
    assert paper.shape == (6, 12, 16)
    assert torch.equal(group(paper, *rest), torch.ones(12, 16, dtype=torch.int32))
    settings = GroupingSettings(rotation_weight=0.1)
    variant = trajectory_feature(center, translation, rotation, settings.rotation_weight)
    assert variant.shape == (9, 12, 16)
    assert torch.equal(group(variant, *rest, settings), expected)


def test_both_separate_different_paths() -> None:
    center = torch.zeros(3, 12, 16)
    translation = torch.zeros(3, 12, 16)
    translation[0, :, 8:] = 0.1
    rest = (torch.ones(12, 16, dtype=torch.bool), torch.zeros(12, 16), torch.full((12, 16), 0.03))
    for weight in (0.0, 0.1):
        labels = group(trajectory_feature(center, translation, torch.zeros(3, 12, 16), weight), *rest)
        assert labels.unique_consecutive(dim=1).tolist() == [[1, 2]] * 12


def test_pixels_with_predictions_that_are_not_finite_are_background() -> None:
    feature, foreground, centrality, radius = random_maps(1, 3, 0.0)
    feature[2, 3, 4], centrality[5, 6], radius[7, 8] = torch.nan, torch.inf, torch.nan
    spoiled = torch.zeros(15, 20, dtype=torch.bool)
    spoiled[3, 4] = spoiled[5, 6] = spoiled[7, 8] = True
    labels = group(feature, foreground, centrality, radius, GroupingSettings(min_pixels=1))
    assert torch.equal(labels > 0, foreground & ~spoiled)


@pytest.mark.usefixtures("few")
def test_no_foreground_or_no_group_large_enough() -> None:
    feature, foreground, centrality, radius = random_maps(1, 3, 0.0)
    assert not group(feature, torch.zeros_like(foreground), centrality, radius).any()
    assert not group(feature, foreground, centrality, radius, GroupingSettings(min_pixels=1000)).any()


def test_invalid_input_is_rejected() -> None:
    feature, foreground, centrality, radius = random_maps(1, 3, 0.0)
    with pytest.raises(MethodError, match="one size"):
        group(feature, foreground, centrality[1:], radius)
    with pytest.raises(MethodError, match="bool foreground"):
        group(feature, foreground.float(), centrality, radius)
    for bad in ({"rotation_weight": -1.0}, {"rotation_weight": float("nan")}, {"min_pixels": 0}, {"max_seeds": 0}):
        with pytest.raises(MethodError, match="grouping setting"):
            GroupingSettings(**bad)  # type: ignore[arg-type]
