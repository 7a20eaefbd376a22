"""`objectflow demo`: the packaged pair, compared with its ground truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import Console
from rich.table import Table

from objectflow import geometry
from objectflow.cli.arguments import option
from objectflow.cli.demo_truth import DemoTruth, flow_errors, match_object
from objectflow.cli.output import new_result, print_objects, write_result
from objectflow.frame import RgbdFrame
from objectflow.methods.registry import DEFAULT_METHOD, load
from objectflow.motion import SceneMotion
from objectflow.readers import open_pair

EXAMPLES = """\
  objectflow demo
  objectflow demo --method dense-flow --out result
"""


@dataclass(frozen=True)
class Demo:
    """Estimate the motion of the packaged pair of frames and compare the result with its ground truth.

    The frames are ray-cast with depth-camera noise and show six objects on a table, three of which moved.
    """

    method: Annotated[str, option("NAME", DEFAULT_METHOD)] = DEFAULT_METHOD
    """The method; `objectflow methods` lists the choices."""

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


def print_comparison(truth: DemoTruth, curr: RgbdFrame, motion: SceneMotion) -> None:
    """Print one line per moving object, the false positives, and the flow errors."""
    console = Console(highlight=False)
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("moved")
    for name in ("true cm", "true deg", "found as", "IoU", "error mm", "error deg"):
        table.add_column(name, justify="right")
    matched = set()
    centers = geometry.surface_centers(geometry.back_project(curr.depth, curr.camera), truth.labels)
    for index in np.flatnonzero(truth.moving):
        # The centre of the visible surface, as that of an object in a result.
        prev_T_curr, center = truth.prev_T_curr[index], centers[int(index) + 1]
        match = match_object(truth.labels == index + 1, center, prev_T_curr, motion)
        matched.add(match.id)
        displacement = float(np.linalg.norm(geometry.transform(prev_T_curr, center) - center))
        angle = math.degrees(float(geometry.rotation_angle(prev_T_curr[:3, :3])))
        errors = (f"{match.iou:.2f}", f"{match.translation_mm:.1f}", f"{match.rotation_deg:.1f}")
        table.add_row(
            truth.names[index],
            f"{100 * displacement:.1f}",
            f"{angle:.1f}",
            *((str(match.id), *errors) if match.id else ("missed", "", "", "")),
        )
    console.print(table)
    false_positives = [str(obj.id) for obj in motion.objects if obj.moving and obj.id not in matched]
    if false_positives:
        console.print(f"reported as moving although static: {', '.join(false_positives)}")
    moving, static = flow_errors(truth, curr, motion)
    console.print(f"mean flow error: {1000 * moving:.1f} mm on moving objects, {1000 * static:.2f} mm elsewhere")
