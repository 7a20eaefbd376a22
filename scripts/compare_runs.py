"""Curves of several training runs in one picture: `python scripts/compare_runs.py OUT runs/s runs/c`.

Each run is named after its folder.
"""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import cv2
import numpy as np
import tyro
from tyro.conf import Positional

from objectflow.training.curves import Series, panel, points_of, smoothed
from objectflow.training.run_folder import read_metrics

COLORS = ((31, 90, 180), (200, 50, 40), (30, 140, 80), (150, 80, 170), (210, 140, 20), (90, 90, 90))


@dataclasses.dataclass
class Settings:
    """Draws loss, end-point error and extracted objects of several runs over their steps."""

    out: Positional[Path]
    """Picture to write."""
    runs: Positional[tuple[Path, ...]]
    """Folders of `objectflow train`."""
    term: str = "total"
    """Term of the training loss."""


def main(settings: Settings) -> None:
    """Read the runs and draw their curves side by side."""
    loss, error, extracted = [], [], []
    for run, color in zip(settings.runs, itertools.cycle(COLORS), strict=False):
        lines = read_metrics(run)
        train = [line for line in lines if line["kind"] == "train"]
        validation = [line for line in lines if line["kind"] == "validation"]
        loss.append(Series(run.name, color, smoothed(points_of(train, "losses", settings.term))))
        error.append(Series(run.name, color, points_of(validation, "epe_cm")))
        extracted.append(Series(run.name, color, points_of(validation, "extracted_share")))
    panels = [
        panel(loss, f"training loss: {settings.term}", logarithmic=True),
        panel(error, "masked end-point error, cm"),
        panel(extracted, "share of extracted objects"),
    ]
    cv2.imwrite(str(settings.out), np.concatenate(panels, axis=1)[..., ::-1])


if __name__ == "__main__":
    main(tyro.cli(Settings))
