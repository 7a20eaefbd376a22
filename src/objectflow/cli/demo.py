"""`objectflow demo`: the packaged pair, compared with its ground truth."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import Console
from rich.table import Table

from objectflow import geometry
from objectflow.cli.arguments import ViewArguments, location, option
from objectflow.cli.demo_truth import DemoTruth, flow_errors, match_object
from objectflow.cli.output import check_not_below_a_file, new_result, print_objects, print_written, write_result
from objectflow.frame import RgbdFrame
from objectflow.methods.registry import DEFAULT_METHOD, check_name, load
from objectflow.motion import SceneMotion
from objectflow.readers import open_pair
from objectflow.storage import files

EXAMPLES = """\
  objectflow demo
  objectflow demo --view
  objectflow demo --method consensus --out result
  objectflow demo --pair pair
"""


@dataclass(frozen=True, kw_only=True)
class Demo(ViewArguments):
    """Estimate the motion of the packaged pair of frames and compare the result with its ground truth.

    The frames are ray-cast with depth-camera noise and show six objects on a table, three of which moved.
    """

    method: Annotated[str, option("NAME", DEFAULT_METHOD)] = DEFAULT_METHOD
    """The method; `objectflow methods` lists the choices."""

    out: Annotated[Path | None, option("DIR", "a folder under objectflow_out")] = None
    """Output folder, new or empty."""

    pair: Annotated[Path | None, option("DIR", "none")] = None
    """Write the pair folder itself here instead of estimating: a new folder to try the other commands on."""

    def run(self) -> None:
        """Estimate, write, compare, print."""
        if self.pair is not None:
            write_pair(self.pair)
            return
        check_name(self.method)
        with resources.as_file(resources.files("objectflow") / "demo" / "pair") as pair:
            frames = open_pair(pair)
            prev, curr = frames
            truth = DemoTruth.read(pair / "truth.npz")
        # Imported here, since other uses of this module need no viewer.
        from objectflow.view.viewer_frames import pair_frames

        estimator = load(self.method)
        with self.viewer("demo") as viewer, new_result(self.out) as (folder, path):
            motion = dataclasses.replace(estimator(prev, curr), frames=location(frames))
            write_result(folder, curr, motion)
            viewer.show(partial(pair_frames, prev, curr, motion))
        print_objects(motion)
        print()
        print_comparison(truth, curr, motion)
        print_written(path, f": look at {path / 'overlay.png'}")


def write_pair(folder: Path) -> None:
    """Copy the packaged pair, without its ground truth, into a new folder.

    Raises:
        ResultError: the folder is not empty.
    """
    check_not_below_a_file(folder)
    with files.new_folder(folder) as temporary:
        for entry in (resources.files("objectflow") / "demo" / "pair").iterdir():
            if entry.name != "truth.npz":
                (temporary / entry.name).write_bytes(entry.read_bytes())
    print(f"written to {folder}: try `objectflow estimate {folder}`")


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
