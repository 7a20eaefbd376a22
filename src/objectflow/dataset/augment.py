"""Augmentation of batches on their device, drawn anew at every use, and network inputs with sensor noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from objectflow.dataset.batches import Batch
from objectflow.dataset.transforms import crop, flip, recolor, rescale, swap, turn
from objectflow.errors import DatasetError
from objectflow.geometry.torch_pinhole import back_project, depth_factor
from objectflow.sensors.sensor import SENSORS, ColorSensor, observe_color, observe_depth, scaled


@dataclass(frozen=True)
class AugmentSettings:
    """Random variations of pairs. With everything at 0 (zoom and scale 1, sensors off), batches stay unchanged.

    Raises:
        DatasetError: a share outside 0..1, a zoom below 1, or a negative amount.
    """

    flip: float = 0.5
    """Share of pairs that are mirrored left to right, 0..1."""
    turn: float = 0.5
    """Share of batches that are rotated by one, two or three quarter turns, 0..1; all pairs of a batch alike, so that
    it stays rectangular."""
    swap: float = 0.5
    """Share of pairs whose frames are swapped and motions inverted, 0..1."""
    zoom: float = 1.3
    """Maximum zoom factor; each pair gets a factor between 1 and this and a crop at a random position."""
    brightness: float = 0.2
    """Maximum relative change of brightness; the same for contrast and saturation."""
    contrast: float = 0.2
    saturation: float = 0.3
    hue: float = 0.1
    """Radians: maximum rotation of hue."""
    frame_jitter: float = 0.15
    """Colour change of each frame alone, relative to the change that both frames of a pair share."""
    scale: tuple[float, float] = (0.7, 1.4)
    """Range of the scale of each pair, uniform in its logarithm; used where depth is normalised before a network."""
    depth_sensor: float = 0.9
    """Share of the groups of pairs whose depth passes through a sensor model, 0..1; the others keep exact depth."""
    kinds: tuple[str, ...] = ("structured-light", "time-of-flight", "stereo")
    """Names of the depth sensors to draw from. "passive-stereo" is excluded: it misses most untextured surfaces."""
    color_sensor: float = 0.9
    """Share of the groups of pairs whose colour has a camera's exposure, white balance, blur and noise, 0..1."""
    strength: tuple[float, float] = (0.5, 1.5)
    """Range of the noise of depth sensors, relative to the published figures."""
    sensors: int = 2
    """Number of groups in a batch; each group has its own sensors."""

    def __post_init__(self) -> None:
        for name in ("flip", "turn", "swap", "depth_sensor", "color_sensor"):
            if not 0 <= getattr(self, name) <= 1:
                raise DatasetError(f"augmentation setting {name} must lie in 0..1, not {getattr(self, name)}")
        for name in ("brightness", "contrast", "saturation", "hue", "frame_jitter"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise DatasetError(f"augmentation setting {name} must be finite and >= 0, not {getattr(self, name)}")
        if not 1 <= self.zoom < float("inf") or self.sensors < 1:
            raise DatasetError(f"augmentation needs zoom >= 1 and sensors >= 1, not {self.zoom} and {self.sensors}")
        if not self.kinds or not set(self.kinds) <= set(SENSORS):
            raise DatasetError(
                f"augmentation setting kinds must name depth sensors of {', '.join(SENSORS)}, not {self.kinds}"
            )
        if not 0 < self.scale[0] <= self.scale[1] < float("inf"):
            raise DatasetError(f"augmentation setting scale must be a range above 0, not {self.scale}")
        if not 0 <= self.strength[0] <= self.strength[1] < float("inf"):
            raise DatasetError(f"augmentation setting strength must be a range from 0 up, not {self.strength}")

    @classmethod
    def nothing(cls) -> AugmentSettings:
        """No variation and exact frames, as for validation."""
        return cls(
            flip=0, turn=0, swap=0, zoom=1, brightness=0, contrast=0, saturation=0, hue=0, frame_jitter=0,
            scale=(1, 1), depth_sensor=0, color_sensor=0,
        )  # fmt: skip


class Inputs(NamedTuple):
    """The inputs of a network, in the order of its arguments, and the exact current points for targets and losses.

    Attributes:
        prev_color, curr_color: (B, 3, H, W) float32, RGB in 0..1.
        prev_points, curr_points: (B, 3, H, W) metres as measured by the sensor, NaN where it has no depth.
        exact_points: (B, 3, H, W) metres, NaN where the stored depth is missing.
    """

    prev_color: Tensor
    prev_points: Tensor
    curr_color: Tensor
    curr_points: Tensor
    exact_points: Tensor


def augment(batch: Batch, settings: AugmentSettings, generator: torch.Generator) -> Batch:
    """Vary every pair of a batch independently; quarter turns are common to the batch.

    Args:
        batch: exact frames, on the generator's device.
        settings: kinds and ranges of the variations.
        generator: the only source of randomness.
    """
    count = len(batch)

    def draw(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator, device=generator.device)

    # All numbers are always drawn, so that one setting does not change the random numbers of another.
    mirrored, swapped, unit, place, colors = draw(), draw(), draw(), draw(2), draw(3, 4)
    turned = torch.rand(2, generator=generator, device=generator.device).tolist()
    if turned[0] < settings.turn:
        batch = turn(batch, 1 + int(3 * turned[1]))
    if settings.swap > 0:
        batch = swap(batch, swapped < settings.swap)
    if settings.flip > 0:
        batch = flip(batch, mirrored < settings.flip)
    if settings.zoom > 1:
        batch = crop(batch, 1 + (settings.zoom - 1) * unit, place)
    amounts = (settings.brightness, settings.contrast, settings.saturation, settings.hue)
    if max(amounts) > 0:
        shared, own = 2 * colors[:, :1] - 1, settings.frame_jitter * (2 * colors[:, 1:] - 1)
        batch = recolor(batch, (shared + own) * torch.tensor(amounts, device=colors.device))
    return batch


def network_inputs(batch: Batch, settings: AugmentSettings, generator: torch.Generator | None) -> Inputs:
    """Network inputs of a batch: colours in 0..1, points of noisy depth.

    Targets and the flow loss come from the exact points. Pixels without measured depth keep their targets: the network
    must predict them from their surroundings. X is predicted from the measured points.

    Args:
        batch: exact frames.
        settings: the sensors.
        generator: on the batch's device; None keeps colour and depth exact.
    """
    count = len(batch)
    # The two frames of a pair are adjacent, so that they can share the state of a camera.
    color = torch.stack([batch.prev_color, batch.curr_color], 1).flatten(0, 1).float() / 255
    depth = torch.stack([batch.prev_depth, batch.curr_depth], 1).flatten(0, 1)
    intrinsics = batch.intrinsics.repeat_interleave(2, 0)
    if generator is not None:
        size = 2 * -(-count // settings.sensors)
        groups = [slice(first, first + size) for first in range(0, 2 * count, size)]
        seen = [_observed(color[g], depth[g], intrinsics[g], settings, generator) for g in groups]
        color, depth = torch.cat([one[0] for one in seen]), torch.cat([one[1] for one in seen])
    points = _points(depth, intrinsics)
    prev_color, curr_color, prev_points, curr_points = color[::2], color[1::2], points[::2], points[1::2]
    exact_points = curr_points if generator is None else _points(batch.curr_depth, batch.intrinsics)
    return Inputs(prev_color, prev_points, curr_color, curr_points, exact_points)


def normalize_depth(
    batch: Batch, inputs: Inputs, median: float, settings: AugmentSettings, generator: torch.Generator | None
) -> tuple[Batch, Inputs, Tensor]:
    """Bring each pair's median depth to `median` metres, and then to a scale drawn around it.

    Sensors measure true depth, so this comes after `network_inputs`.

    Args:
        batch: exact frames.
        inputs: made from them.
        median: metres; 0 leaves depth as it is.
        settings: range of the drawn scale.
        generator: on the batch's device; None draws no scale.

    Returns:
        Batch and inputs with lengths multiplied by each pair's factor, and the factors (B,).
    """
    if median == 0:
        return batch, inputs, inputs.curr_points.new_ones(len(batch))
    factor = depth_factor(inputs.curr_points, median)
    if generator is not None:
        low, high = (math.log(one) for one in settings.scale)
        unit = torch.rand(len(batch), generator=generator, device=generator.device)
        factor = factor * (low + (high - low) * unit).exp()
    wide = factor[:, None, None, None]
    points = {name: wide * getattr(inputs, name) for name in ("prev_points", "curr_points", "exact_points")}
    return rescale(batch, factor), inputs._replace(**points), factor


def _observed(
    color: Tensor, depth: Tensor, intrinsics: Tensor, settings: AugmentSettings, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Colour and depth of adjacent frames of pairs, as observed by one randomly drawn camera."""
    has_depth, has_color, kind, unit = torch.rand(4, generator=generator, device=generator.device).tolist()
    if has_depth < settings.depth_sensor:
        low, high = settings.strength
        sensor = scaled(SENSORS[settings.kinds[int(kind * len(settings.kinds))]], low + (high - low) * unit)
        depth = observe_depth(depth, color, intrinsics, sensor, generator)
    if has_color < settings.color_sensor:
        color = observe_color(color, ColorSensor(), generator, images_each=2)
    return color, depth


def _points(depth: Tensor, intrinsics: Tensor) -> Tensor:
    points = back_project(depth[:, None], intrinsics)
    return torch.where(depth[:, None] > 0, points, torch.nan)
