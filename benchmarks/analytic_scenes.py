"""Methods on analytic scenes with known motion, compared with `zero` and `dense-flow`.

    python benchmarks/analytic_scenes.py

The scenes are those of the tests: 1-6 textured boxes, spheres and cylinders on a textured plane, moved by 2-6 cm and
rotated by up to 30 degrees, ray-cast by code that is independent of the methods.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.optimize import linear_sum_assignment

import analytic
import objectflow

REFERENCES = ("zero", "dense-flow")


@dataclasses.dataclass
class Settings:
    """Scores methods on analytic scenes."""

    methods: tuple[str, ...] = ("consensus",)
    """Names of methods; `zero` and `dense-flow` are always included."""
    scenes: int = 60
    """Number of scenes."""
    first_seed: int = 0
    """Seed of the first scene."""
    depth_noise: float = 0.0
    """Standard deviation of the depth noise at 1 m, metres."""


@dataclasses.dataclass
class Score:
    """Sums over the scenes of one method."""

    epe: list[float] = dataclasses.field(default_factory=list)
    objects: int = 0
    extracted: int = 0
    surplus: int = 0
    background_static: bool = True


def main(settings: Settings) -> None:
    names = tuple(dict.fromkeys((*REFERENCES, *settings.methods)))
    estimators = {name: objectflow.load(name) for name in names}
    scores = {name: Score() for name in names}
    for seed in range(settings.first_seed, settings.first_seed + settings.scenes):
        pair = analytic.make_scene(seed, depth_noise=settings.depth_noise)
        for name in names:
            add(scores[name], pair, estimators[name](pair.prev, pair.curr))
    table = Table(title=f"{settings.scenes} analytic scenes, 320x240")
    for column in ("method", "masked EPE cm", "times dense-flow", "extracted (F >= 0.75)", "surplus", "background 0"):
        table.add_column(column, justify="left" if column == "method" else "right")
    reference = np.mean(scores["dense-flow"].epe)
    for name in names:
        s = scores[name]
        share = f"{s.extracted}/{s.objects} ({100 * s.extracted / s.objects:.0f}%)"
        epe = np.mean(s.epe)
        table.add_row(
            name,
            f"{100 * epe:.2f}",
            f"{epe / reference:.2f}",
            share,
            str(s.surplus),
            "yes" if s.background_static else "no",
        )
    Console(width=120).print(table)


def add(score: Score, pair: analytic.AnalyticPair, motion: objectflow.SceneMotion) -> None:
    """Add one scene: error on objects visible in both frames, and objects matched by maximum total F."""
    in_both = [label for label in pair.prev_T_curr if (pair.prev_labels == label).any()]
    mask = np.isin(pair.labels, in_both) & np.isfinite(pair.scene_flow[..., 2])
    score.epe.append(float(np.linalg.norm((motion.scene_flow - pair.scene_flow)[mask], axis=-1).mean()))
    true = [pair.labels == label for label in sorted(pair.moving) if (pair.labels == label).any()]
    found = [motion.labels == obj.id for obj in motion.objects]
    f = np.array([[2 * (a & b).sum() / (a.sum() + b.sum()) for b in found] for a in true]).reshape(
        len(true), len(found)
    )
    rows, columns = linear_sum_assignment(-f)
    score.objects += len(true)
    score.extracted += int((f[rows, columns] >= 0.75).sum())
    score.surplus += len(found) - len(columns)
    background = (motion.labels == 0) & pair.curr.valid
    score.background_static &= not motion.scene_flow[background].any()


if __name__ == "__main__":
    main(tyro.cli(Settings))
