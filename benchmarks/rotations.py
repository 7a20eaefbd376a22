"""How much rotation the correlation of the paper's network holds: `python benchmarks/rotations.py DATA WEIGHTS ...`.

The hourglass receives each cell's expected displacement under the softmax of the correlation. For each object, a rigid
motion is fitted to these displacements on the cells of its true mask. Its error shows how much of the rotation reaches
the heads; objects with symmetries, whose rotation is ambiguous, are left out. The last columns are the errors of the
local motions of the object's cells, by the settings of the weights or, if they have none, in windows of 7x7 cells.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor
from tyro.conf import Positional

from objectflow import geometry
from objectflow.evaluation.data.sources import open_set
from objectflow.evaluation.data.truth import PairTruth
from objectflow.frame import RgbdFrame
from objectflow.geometry.resample import resize_nearest
from objectflow.methods.network_io import to_tensors
from objectflow.networks import SceneFlowNet
from objectflow.networks.sceneflownet.local_motion import local_motion
from objectflow.networks.sceneflownet.network import expected_displacement
from objectflow.networks.weights import load_network
from objectflow.typing import Float64Array, LabelImage

STRIDE = 8
"""Pixels per cell of the correlation."""
LOCAL_WINDOW = 3
"""Cells in each direction of the neighbourhoods of local motions, for weights that have none."""
NEAR = 0.02
"""Metres: largest error of a match that counts as near."""
BINS = ((3, 6), (6, 12), (12, 30), (30, 10_000))
"""Numbers of cells of an object: at least, and less than."""


@dataclasses.dataclass
class Settings:
    """Prints errors of rotation by the number of cells of an object."""

    data: Positional[Path]
    """Generated set."""
    weights: Positional[tuple[Path, ...]]
    """Weights of networks with correlation."""
    split: str = "val"
    """Split of the set."""
    pairs: int = 30
    """Number of pairs."""
    size: tuple[int, int] = (216, 288)
    """Height and width of the network's input."""
    window: int | None = None
    """Window of the expected displacement, cells; 0 is the whole patch, None the weights' own setting."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One object: its number of cells, angles in degrees, lengths in centimetres, and the share of near matches."""

    cells: int
    angle: float
    error: float
    motion: float
    match_error: float
    near: float
    local_error: float
    local_flow_error: float


def cells_of(frame: RgbdFrame) -> Tensor:
    """(1, 4, h, w): the points of a frame's cells in metres, and 1 where there is a point."""
    points = torch.from_numpy(geometry.back_project(frame.depth, frame.camera)[::STRIDE, ::STRIDE]).permute(2, 0, 1)
    valid = torch.isfinite(points).all(0, keepdim=True)
    return torch.cat([torch.where(valid, points, 0.0), valid.float()])[None]


def angle_between(a: Float64Array, b: Float64Array) -> float:
    """Angle of the rotation between two rotations, degrees."""
    return float(np.degrees(geometry.rotation_angle(a.T @ b)))


def rows_of(
    network: SceneFlowNet, prev: RgbdFrame, curr: RgbdFrame, truth: PairTruth, labels: LabelImage, window: int | None
) -> list[Row]:
    """The objects of a pair whose rotation is known and unambiguous."""
    device = torch.device("cpu")
    (prev_color, prev_points), (curr_color, curr_points) = to_tensors([prev], device), to_tensors([curr], device)
    with torch.inference_mode():
        _, correlation = network.predict(prev_color, prev_points, curr_color, curr_points)
        if correlation is None:
            raise SystemExit("a network without correlation")
        settings = network.settings
        window = settings.displacement_window if window is None else window
        displacement = expected_displacement(
            correlation, cells_of(prev), cells_of(curr), settings.reach, window=window
        )
        local = local_motion(
            displacement,
            cells_of(curr),
            window=settings.local_motion_window or LOCAL_WINDOW,
            scale=settings.local_motion_scale,
            tolerance=settings.local_motion_tolerance,
        )[0].numpy()
        found = displacement[0].numpy()
    cells, rows = cells_of(curr)[0].numpy(), []
    for obj in truth.objects:
        mask = (labels[::STRIDE, ::STRIDE] == obj.label) & (cells[3] > 0) & (found[3] > 0)
        if not obj.in_both or not obj.rotation_known or obj.orders or mask.sum() < BINS[0][0]:
            continue
        points = cells[:3, mask].T.astype(np.float64)
        matched, moved = points + found[:3, mask].T, geometry.transform(obj.prev_T_curr, points)
        distance = np.linalg.norm(matched - moved, axis=1)
        rotation, fitted = obj.prev_T_curr[:3, :3], geometry.kabsch(points, matched)[0]
        vectors, offsets = local[:3, mask].T.astype(np.float64), local[3:6, mask].T
        rows.append(
            Row(
                int(mask.sum()),
                angle_between(np.eye(3), rotation),
                angle_between(fitted[:3, :3], rotation),
                100 * float(np.linalg.norm(moved - points, axis=1).mean()),
                100 * float(distance.mean()),
                100 * float((distance < NEAR).mean()),
                float(np.median([angle_between(geometry.so3_exp(vector), rotation) for vector in vectors])),
                100 * float(np.linalg.norm(points + offsets - moved, axis=1).mean()),
            )
        )
    return rows


def main(settings: Settings) -> None:
    """Evaluate every network and print a table for each."""
    pairs = open_set(str(settings.data), split=settings.split)
    height, width = settings.size
    for path in settings.weights:
        network, _ = load_network(path)
        if not isinstance(network, SceneFlowNet):
            raise SystemExit(f"{path}: not the paper's network")
        rows: list[Row] = []
        for key in pairs.keys[: settings.pairs]:
            pair = pairs.pair(key)
            labels = resize_nearest(pair.truth.labels, settings.size)
            prev, curr = (frame.resized(width, height) for frame in (pair.prev, pair.curr))
            rows += rows_of(network.eval(), prev, curr, pair.truth, labels, settings.window)
        names = (
            "rotation, deg",
            "error, deg",
            "motion, cm",
            "error of matches, cm",
            "matches within 2 cm, %",
            "local error, deg",
            "local error, cm",
        )
        table = Table("cells", "objects", *names, title=str(path))
        for low, high in BINS:
            chosen = [dataclasses.astuple(row) for row in rows if low <= row.cells < high]
            if chosen:
                middle = np.median(chosen, axis=0)
                name = f"{low}-{high - 1}" if high < BINS[-1][1] else f"{low} or more"
                table.add_row(name, str(len(chosen)), *(f"{value:.1f}" for value in middle[1:]))
        Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
