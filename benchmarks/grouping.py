"""Milliseconds to group 320x240 maps with 30 objects, on one core and on CUDA: `python benchmarks/grouping.py`.

The pixels of each object predict its trajectory with noise; some pixels predict random values, as those at edges do.
The averages of +Rig are timed on the same maps, and the last column compares with a loop over all pixels.
"""

from __future__ import annotations

import dataclasses
import functools
import platform
import statistics
from collections.abc import Callable

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor

from objectflow.methods.sceneflownet.averaging import average_motions
from objectflow.methods.sceneflownet.grouping import GroupingSettings, group, trajectory_feature
from timing import time_each


@dataclasses.dataclass
class Settings:
    """Times the grouping."""

    objects: int = 30
    """Objects in the image."""
    width: int = 320
    """Pixels; the height is three quarters of it."""
    foreground: float = 0.7
    """Share of the image that the objects cover."""
    noise: float = 0.004
    """Metres: standard deviation of each component of the trajectory feature."""
    outliers: tuple[float, ...] = (0.0, 0.002, 0.02)
    """Shares of the foreground that predict random values, one row each."""
    repeats: int = 15
    """Number of runs, of which the median is reported."""
    threads: int = 1
    """Threads of torch on the CPU."""
    seed: int = 0
    """Seed of the maps."""


def make_maps(settings: Settings, outliers: float, generator: torch.Generator) -> dict[str, Tensor]:
    width, height = settings.width, settings.width * 3 // 4
    pixels = width * height
    band = torch.arange(pixels) % height  # Objects are stripes, since their shape does not affect the time.
    owner = (
        (band * settings.objects // max(1, round(height * settings.foreground))).reshape(width, height).T.contiguous()
    )
    foreground = owner < settings.objects
    owner = owner.clamp_max(settings.objects - 1)

    def noisy(truth: Tensor, sigma: float) -> Tensor:
        clean = truth[owner].permute(2, 0, 1)
        return clean + sigma * torch.randn(clean.shape, generator=generator)

    center = noisy(torch.rand(settings.objects, 3, generator=generator), settings.noise)
    translation = noisy(0.2 * torch.rand(settings.objects, 3, generator=generator), settings.noise)
    rotation = noisy(torch.rand(settings.objects, 3, generator=generator), 0.02)
    wrong = torch.rand(owner.shape, generator=generator) < outliers
    center = torch.where(wrong, torch.rand(center.shape, generator=generator), center)
    return {
        "center": center,
        "translation": translation,
        "rotation": rotation,
        "foreground": foreground,
        "centrality": torch.rand(owner.shape, generator=generator),
        "radius": torch.full(owner.shape, 0.05),
    }


def group_by_loop(feature: Tensor, foreground: Tensor, centrality: Tensor, radius: Tensor) -> Tensor:
    """The rule by a plain loop: every sphere visits every pixel; small groups stay separate."""
    left, labels, label = foreground.clone(), torch.zeros(foreground.shape, dtype=torch.int32), 0
    while bool(left.any()):
        seed = int(torch.where(left, centrality, -torch.inf).argmax())
        distance = (feature - feature.flatten(1)[:, seed, None, None]).norm(dim=0)
        inside = left & (distance < radius.flatten()[seed])
        inside.view(-1)[seed] = True
        label += 1
        labels[inside] = label
        left &= ~inside
    return labels


def milliseconds(work: Callable[[], object], repeats: int, device: str) -> float:
    return 1000 * statistics.median(time_each(lambda _: work(), range(repeats + 1), device))


def main(settings: Settings) -> None:
    torch.set_num_threads(settings.threads)
    table = Table(
        title=f"{settings.objects} objects, {settings.width}x{settings.width * 3 // 4}, {platform.machine()}"
    )
    for column in ("device", "outliers", "found", "group ms", "with rotation ms", "averages ms", "loop / group"):
        table.add_column(column, justify="right")
    for device in ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",):
        for outliers in settings.outliers:
            generator = torch.Generator().manual_seed(settings.seed)
            maps = {name: x.to(device) for name, x in make_maps(settings, outliers, generator).items()}
            rest = maps["foreground"], maps["centrality"], maps["radius"]
            times, labels = [], torch.empty(0)
            for weight in (0.0, 0.05):
                feature = trajectory_feature(maps["center"], maps["translation"], maps["rotation"], weight)
                grouping = GroupingSettings(rotation_weight=weight)
                times.append(
                    milliseconds(functools.partial(group, feature, *rest, grouping), settings.repeats, device)
                )
            feature = trajectory_feature(maps["center"], maps["translation"], maps["rotation"])
            labels = group(feature, *rest)
            ids = labels.cpu().numpy()
            arrays = [maps[name].permute(1, 2, 0).cpu().numpy() for name in ("rotation", "translation", "center")]
            average = milliseconds(
                functools.partial(average_motions, ids, *arrays, confidence=np.ones(ids.shape)),
                settings.repeats,
                "cpu",
            )
            ratio = "-"
            if device == "cpu":
                ratio = f"{milliseconds(functools.partial(group_by_loop, feature, *rest), 1, device) / times[0]:.1f}"
            figures = [f"{value:.1f}" for value in (*times, average)]
            table.add_row(device, f"{outliers:.1%}", str(int(labels.max())), *figures, ratio)
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
