"""Sensor noise for training time: exact frames in, frames as a real camera would give them out; batched torch.

The stored data are exact, as in the paper: sensors differ, so noise is drawn anew whenever a pair is used.
"""

from __future__ import annotations

from dataclasses import fields, replace

import torch
from torch import Tensor

from objectflow.errors import DatasetError
from objectflow.sensors.color import ColorSensor, luminance, observe_color
from objectflow.sensors.depth import (
    DepthSensor,
    Stereo,
    StructuredLight,
    TimeOfFlight,
    stereo,
    structured_light,
    time_of_flight,
)

__all__ = [
    "SENSORS",
    "ColorSensor",
    "DepthSensor",
    "Stereo",
    "StructuredLight",
    "TimeOfFlight",
    "draw_sensor",
    "observe",
    "observe_color",
    "observe_depth",
]

SENSORS: dict[str, DepthSensor] = {
    "structured-light": StructuredLight(),
    "time-of-flight": TimeOfFlight(),
    "stereo": Stereo(),
    "passive-stereo": Stereo(active=False, edge_loss=0.4, disparity_sigma=0.12),
}
"""Depth sensors by name, as their published figures have them."""

_AMOUNTS = {"disparity_sigma", "lateral_sigma", "sigma", "wiggle", "stray", "wobble", "edge_loss", "dark", "texture"}
"""Fields that say how bad a sensor is, and not what it is."""


def observe_depth(
    depth: Tensor, color: Tensor, intrinsics: Tensor, sensor: DepthSensor, generator: torch.Generator
) -> Tensor:
    """Depth with one sensor's errors.

    Args:
        depth: (B, H, W) float, planar z in metres, 0 = missing.
        color: (B, 3, H, W) float, 0..1: how much light surfaces return.
        intrinsics: (B, 4): fx, fy, cx, cy in pixels.
        sensor: which one; `SENSORS` has them by name.
        generator: on the tensors' device; the only source of randomness.

    Returns:
        (B, H, W) float, metres, 0 = missing. What was missing stays so.

    Raises:
        DatasetError: shapes that do not fit together.
    """
    batch, height, width = depth.shape
    if color.shape != (batch, 3, height, width) or intrinsics.shape != (batch, 4):
        raise DatasetError(
            f"sensor: depth {tuple(depth.shape)} needs colour {(batch, 3, height, width)} and intrinsics "
            f"{(batch, 4)}, not {tuple(color.shape)} and {tuple(intrinsics.shape)}"
        )
    light = luminance(color)
    if isinstance(sensor, StructuredLight):
        return structured_light(depth, light, intrinsics, sensor, generator)
    if isinstance(sensor, TimeOfFlight):
        return time_of_flight(depth, light, intrinsics, sensor, generator)
    return stereo(depth, light, intrinsics, sensor, generator)


def observe(
    color: Tensor,
    depth: Tensor,
    intrinsics: Tensor,
    generator: torch.Generator,
    *,
    depth_sensor: DepthSensor | None = None,
    color_sensor: ColorSensor | None = None,
    images_each: int = 1,
) -> tuple[Tensor, Tensor]:
    """Colour (B, 3, H, W) in 0..1 and depth (B, H, W) in metres with a camera's errors; None leaves one exact.

    `images_each` consecutive images share the colour camera's state, as the frames of a pair do.
    """
    # Depth first: what a surface returns has nothing to do with the colour camera's exposure.
    noisy = depth if depth_sensor is None else observe_depth(depth, color, intrinsics, depth_sensor, generator)
    if color_sensor is not None:
        color = observe_color(color, color_sensor, generator, images_each)
    return color, noisy


def draw_sensor(generator: torch.Generator, strength: tuple[float, float] = (0.5, 1.5)) -> DepthSensor:
    """Draw one of `SENSORS` and scale how bad it is: no sensor of one kind is like the next."""
    device = generator.device
    names = sorted(SENSORS)
    sensor = SENSORS[names[int(torch.randint(len(names), (1,), generator=generator, device=device))]]
    unit = float(torch.rand(1, generator=generator, device=device))
    factor = strength[0] + (strength[1] - strength[0]) * unit
    return scaled(sensor, factor)


def scaled(sensor: DepthSensor, factor: float) -> DepthSensor:
    """The sensor with its errors made larger or smaller by a factor; 0 leaves quantisation, range and shadow."""
    changes = {field.name: getattr(sensor, field.name) * factor for field in fields(sensor) if field.name in _AMOUNTS}
    return replace(sensor, **changes)
