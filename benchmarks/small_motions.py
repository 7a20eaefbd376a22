"""Flow methods on small smooth motions, compared with zero flow: `python benchmarks/small_motions.py`.

Uses the analytic scenes of the tests with 2-4 objects that move by 3-8 mm and rotate by up to 3 degrees, at 320x240.
Options of a method follow its name: `sr-flow:alpha=10`.
"""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import analytic
from objectflow.evaluation.methods import parse_method


@dataclasses.dataclass
class Settings:
    """Scores methods on small motions."""

    methods: tuple[str, ...] = ("zero", "sr-flow", "sr-flow:alpha=10")
    """Methods, optionally with options."""
    scenes: int = 4
    """Number of scenes, with seeds from 0."""


def main(settings: Settings) -> None:
    pairs = [
        analytic.make_scene(seed, objects=(2, 4), motion=(0.003, 0.008), max_angle_deg=3)
        for seed in range(settings.scenes)
    ]
    table = Table(title=f"{settings.scenes} scenes, visible pixels")
    for name in ("method", "EPE on moving objects, mm", "of zero flow's", "EPE on all pixels, mm", "CPU s", "s"):
        table.add_column(name, justify="left" if name == "method" else "right")
    for text in settings.methods:
        estimator = parse_method(text).make()
        moving, all_pixels, zero = [], [], []
        start, cpu = time.perf_counter(), time.process_time()
        flows = [estimator(pair.prev, pair.curr).scene_flow for pair in pairs]
        cpu, start = time.process_time() - cpu, time.perf_counter() - start
        for pair, flow in zip(pairs, flows, strict=True):
            visible = pair.visible & pair.curr.valid
            mask = visible & np.isin(pair.labels, list(pair.moving))
            error = np.linalg.norm(flow - pair.scene_flow, axis=-1) * 1000
            moving.append(error[mask].mean())
            all_pixels.append(error[visible].mean())
            zero.append(np.linalg.norm(pair.scene_flow[mask], axis=-1).mean() * 1000)
        share = np.mean(moving) / np.mean(zero)
        table.add_row(
            text,
            f"{np.mean(moving):.2f}",
            f"{share:.0%}",
            f"{np.mean(all_pixels):.3f}",
            f"{cpu / len(pairs):.1f}",
            f"{start / len(pairs):.1f}",
        )
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
