"""`objectflow estimate`: one pair of frames."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from objectflow.cli.arguments import MethodArguments, ResultArguments, ViewArguments, location, open_two, option
from objectflow.cli.output import new_result, print_objects, print_written, write_result
from objectflow.frame import check_pair
from objectflow.runtime.quiet import silence_stderr

EXAMPLES = """\
  objectflow estimate PAIR_DIR
  objectflow estimate PAIR_DIR --camera moving --out result
  objectflow estimate PAIR_DIR --view
  objectflow estimate PAIR_DIR --export coco --export ply --no-pictures
  objectflow estimate PAIR_DIR --set postprocess.merge.max_loss=0.1 --explain
  objectflow estimate color0.png depth0.png color1.png depth1.png --intrinsics 615,615,320,240
  objectflow estimate color0.png depth0.png color1.png depth1.png --camera-file camera.json --depth-scale 5000
  objectflow estimate PAIR_DIR --method sceneflownet-c-vl --weights FILE --rigid average
"""


@dataclass(frozen=True)
class Estimate(ViewArguments, ResultArguments, MethodArguments):
    """Estimate the moving objects, their motions and the scene flow between two RGB-D frames.

    Writes labels.png, scene_flow.npy, objects.json, overlay.png and flow.png.
    """

    paths: Annotated[Positional[tuple[Path, ...]], option("PAIR_DIR | COLOR0 DEPTH0 COLOR1 DEPTH1")]
    """A pair folder (color0, depth0, color1, depth1, camera.json) or four files; 0 = previous, 1 = current."""

    explain: bool = False
    """Print what each step after the network changed (rigidmatch)."""

    def method_options(self) -> dict[str, Any]:
        """See `MethodArguments`; `--explain` is a setting of the method."""
        return super().method_options() | ({"explain": True} if self.explain else {})

    def run(self) -> None:
        """Read, estimate, write, print."""
        self.check_method()
        with silence_stderr():
            frames = open_two(self.paths, self.camera_options())
            prev, curr = frames
        check_pair(prev, curr)
        for note in frames.notes:
            print(f"note: {note}")
        # Frames are read first: a wrong path is reported before anything that is slow to import.
        from objectflow.cli.findings import warn_of
        from objectflow.view.viewer_frames import pair_frames

        warn_of(prev, curr)
        estimator = self.estimator()
        with self.viewer(self.paths[0].stem) as viewer, new_result(self.out) as (folder, path):
            motion = dataclasses.replace(estimator(prev, curr), frames=location(frames))
            write_result(folder, curr, motion, pictures=self.pictures, exports=self.export)
            viewer.show(partial(pair_frames, prev, curr, motion))
        for note in motion.notes:
            print(f"note: {note}")
        for change in motion.changes:
            print(change)
        print_objects(motion)
        print_written(path)
