"""`objectflow demo`: the packaged pair, compared with its truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from objectflow import geometry
from objectflow.cli.arguments import option
from objectflow.cli.output import new_result, print_objects, write_result
from objectflow.errors import ReaderError
from objectflow.frame import RgbdFrame
from objectflow.methods.registry import DEFAULT_METHOD, load
from objectflow.motion import SceneMotion
from objectflow.readers import open_pair
from objectflow.typing import BoolMask, Float64Array, LabelImage

EXAMPLES = """\
  objectflow demo
  objectflow demo --method dense-flow --out result
"""

FOUND_IOU = 0.5


@dataclass(frozen=True)
class Demo:
    """Estimate the pair of frames that comes with the package and compare the result with its truth.

    Six things lie on a table, drawn by ray casting with the noise of a depth camera; three of them moved.
    """

    method: Annotated[str, option("NAME", DEFAULT_METHOD)] = DEFAULT_METHOD
    """How to estimate; `objectflow methods` lists the choices."""

    out: Annotated[Path | None, option("DIR", "a folder under objectflow_out")] = None
    """Output folder, new or empty."""

    def run(self) -> None:
        """Estimate, write, compare, print."""
        estimator = load(self.method)
        with resources.as_file(resources.files("objectflow") / "demo" / "pair") as pair:
            prev, curr = open_pair(pair)
            truth = DemoTruth.read(pair / "truth.npz")
        with new_result(self.out) as (folder, path):
            motion = estimator(prev, curr)
            write_result(folder, curr, motion)
        print_objects(motion)
        print()
        print_comparison(truth, curr, motion)
        print(f"written to {path}: look at {path / 'overlay.png'}")


class DemoTruth(NamedTuple):
    """What is true about the pair: K objects, labels 1..K on the current pixels, and their motions."""

    names: list[str]
    moving: BoolMask
    labels: LabelImage
    prev_T_curr: Float64Array
    centers: Float64Array

    @classmethod
    def read(cls, path: Path) -> DemoTruth:
        """Read `truth.npz`.

        Raises:
            ReaderError: the package's own file is missing or broken.
        """
        try:
            with np.load(path, allow_pickle=False) as data:
                return cls(
                    names=[str(name) for name in data["names"]],
                    moving=data["moving"],
                    labels=data["labels1"].astype(np.int32),
                    prev_T_curr=data["prev_T_curr"],
                    centers=data["centers"],
                )
        except (OSError, ValueError, KeyError) as error:
            raise ReaderError(f"{path}: cannot be read: {error}: install objectflow again") from error


class DemoMatch(NamedTuple):
    """How well a result explains one true object; id 0 and NaN errors if it was not found."""

    id: int
    iou: float
    translation_mm: float
    rotation_deg: float


def match_object(mask: BoolMask, center: Float64Array, prev_T_curr: Float64Array, motion: SceneMotion) -> DemoMatch:
    """Find the object of a result that covers a true mask best, and the errors of its motion at the true centre."""
    best = DemoMatch(0, 0.0, math.nan, math.nan)
    for obj in motion.objects:
        mine = motion.labels == obj.id
        iou = float((mine & mask).sum() / max(1, (mine | mask).sum()))
        if iou <= max(best.iou, FOUND_IOU):
            continue
        off = geometry.transform(obj.prev_T_curr, center) - geometry.transform(prev_T_curr, center)
        turn = geometry.rotation_angle(obj.prev_T_curr[:3, :3].T @ prev_T_curr[:3, :3])
        best = DemoMatch(obj.id, iou, 1000 * float(np.linalg.norm(off)), math.degrees(float(turn)))
    return best


def print_comparison(truth: DemoTruth, curr: RgbdFrame, motion: SceneMotion) -> None:
    """Print one line a thing that moved, what else was found, and the errors of the flow."""
    console = Console(highlight=False)
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("what moved")
    for name in ("true cm", "true deg", "found as", "IoU", "off by mm", "off by deg"):
        table.add_column(name, justify="right")
    matched = set()
    for index in np.flatnonzero(truth.moving):
        prev_T_curr, center = truth.prev_T_curr[index], truth.centers[index]
        match = match_object(truth.labels == index + 1, center, prev_T_curr, motion)
        matched.add(match.id)
        shift = float(np.linalg.norm(geometry.transform(prev_T_curr, center) - center))
        turn = math.degrees(float(geometry.rotation_angle(prev_T_curr[:3, :3])))
        errors = (f"{match.iou:.2f}", f"{match.translation_mm:.1f}", f"{match.rotation_deg:.1f}")
        table.add_row(
            truth.names[index],
            f"{100 * shift:.1f}",
            f"{turn:.1f}",
            *((str(match.id), *errors) if match.id else ("missed", "", "", "")),
        )
    console.print(table)
    extra = [str(obj.id) for obj in motion.objects if obj.moving and obj.id not in matched]
    if extra:
        console.print(f"reported as moving, but nothing there moved: {', '.join(extra)}")
    moving, still = flow_errors(truth, curr, motion)
    console.print(f"mean flow error: {1000 * moving:.1f} mm on what moved, {1000 * still:.2f} mm on all else")


def flow_errors(truth: DemoTruth, curr: RgbdFrame, motion: SceneMotion) -> tuple[float, float]:
    """Mean distance in metres between estimated and true scene flow: on the moving objects, and everywhere else."""
    motions = {index + 1: truth.prev_T_curr[index] for index in range(len(truth.names))}
    points = geometry.back_project(curr.depth, curr.camera)
    error = np.linalg.norm(motion.scene_flow - geometry.flow_from_motions(points, truth.labels, motions), axis=-1)
    moved = np.isin(truth.labels, np.flatnonzero(truth.moving) + 1)
    known = np.isfinite(error)
    return float(error[known & moved].mean()), float(error[known & ~moved].mean())
