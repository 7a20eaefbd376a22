"""Preparation of a batch for one step: augmentation, sensor noise and targets; without randomness for validation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from objectflow.dataset.augment import augment, network_inputs, normalize_depth
from objectflow.dataset.batches import Batch
from objectflow.dataset.pixel_matches import previous_pixels
from objectflow.dataset.targets import Targets, make_targets, with_camera
from objectflow.training.recipe import Recipe


class Prepared(NamedTuple):
    """A batch in the form that the network and the losses need.

    Attributes:
        images: the network's four arguments.
        points: (B, 3, H, W) metres, the current frame's exact points; NaN where depth is missing.
        targets: made from them.
        matches: (B, 2, H, W) column and row of each point in the previous image, NaN where it is not visible there.
        batch: the exact frames, after augmentation and scaling.
        scale: (B,) factor by which all lengths of each pair were multiplied.
    """

    images: tuple[Tensor, Tensor, Tensor, Tensor]
    points: Tensor
    targets: Targets
    matches: Tensor
    batch: Batch
    scale: Tensor


def step_generator(seed: int, step: int, rank: int, device: torch.device) -> torch.Generator:
    """The random numbers of one step of one process; they depend on no earlier step."""
    mixed = np.random.SeedSequence([seed, step, rank]).generate_state(1, np.uint64)[0]
    return torch.Generator(device).manual_seed(int(mixed) >> 1)


def prepare(batch: Batch, recipe: Recipe, generator: torch.Generator | None) -> Prepared:
    """Augment a batch, add sensor noise to the network's inputs, and make the targets.

    Args:
        batch: on the device.
        recipe: its augmentation and model.
        generator: on the device; None leaves frames as they are stored.
    """
    if generator is not None:
        batch = augment(batch, recipe.augment, generator)
    seen = network_inputs(batch, recipe.augment, generator)
    batch, seen, scale = normalize_depth(batch, seen, recipe.model.median_depth, recipe.augment, generator)
    targets = make_targets(
        batch.table, batch.curr_labels, seen.exact_points, rotation_weight=recipe.model.rotation_weight
    )
    targets = with_camera(targets, seen.exact_points, batch.camera_motion)
    images = (seen.prev_color, seen.prev_points, seen.curr_color, seen.curr_points)
    if recipe.channels_last:
        a, b, c, d = (image.contiguous(memory_format=torch.channels_last) for image in images)
        images = (a, b, c, d)
    matches = previous_pixels(seen.exact_points, targets.flow, batch.prev_depth, batch.intrinsics)
    return Prepared(images, seen.exact_points, targets, matches, batch, scale)
