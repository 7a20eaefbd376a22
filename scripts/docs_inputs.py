"""Write the inputs of the documented commands: faulty copies of the demo pair, and a sequence.

    python scripts/docs_inputs.py FOLDER           # a few minutes, since the sequence is ray-cast
    python scripts/docs_outputs.py FOLDER          # then runs the commands of docs/*.md there

Each pair has one fault, see `faults`. `recording` is a TUM folder with five frames of the demo's scene at 2 Hz, in
which the same three objects continue their motion. The noise has a fixed seed.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import render_demo

DEMO = Path(__file__).resolve().parents[1] / "src" / "objectflow" / "demo" / "pair"
STEPS = (0.0, 0.5, 1.0, 1.5, 2.0)
"""Times of the sequence's frames; 0 is the demo's previous frame and 1 its current frame."""
SECONDS = 0.5
"""Time between two frames of the sequence, seconds."""
LAG = 0.3
"""Lag of depth behind colour, as a share of the time between the frames."""
GAP = 0.02
"""Share of the time between the frames in which all displacements are below 1 mm."""
EYE = render_demo.look_at(render_demo.EYE, render_demo.TARGET)

Array = NDArray[Any]


@dataclasses.dataclass
class Pair:
    """A pair folder in memory: colours in BGR, depth in integer units."""

    color: list[Array]
    depth: list[Array]
    camera: dict[str, Any]

    @classmethod
    def read(cls) -> Pair:
        """Read the demo pair."""
        color = [np.asarray(cv2.imread(str(DEMO / f"color{i}.jpg"))) for i in (0, 1)]
        depth = [np.asarray(cv2.imread(str(DEMO / f"depth{i}.png"), cv2.IMREAD_UNCHANGED)) for i in (0, 1)]
        return cls(color, depth, json.loads((DEMO / "camera.json").read_text()))

    def write(self, folder: Path) -> None:
        """Write the pair folder."""
        folder.mkdir(parents=True)
        for i in (0, 1):
            cv2.imwrite(str(folder / f"color{i}.jpg"), self.color[i], [cv2.IMWRITE_JPEG_QUALITY, 95])
            cv2.imwrite(str(folder / f"depth{i}.png"), self.depth[i])
        (folder / "camera.json").write_text(json.dumps(self.camera) + "\n")


def tenths_of_a_millimetre(pair: Pair) -> None:
    """Depth in tenths of a millimetre, while the camera file states millimetres."""
    pair.depth = [10 * depth for depth in pair.depth]


def other_resolution(pair: Pair) -> None:
    """Intrinsics of the same camera at 320x240."""
    pair.camera |= {name: pair.camera[name] / 2 for name in ("fx", "fy", "cx", "cy")}


def unregistered(pair: Pair) -> None:
    """Depth of the unaligned depth sensor, shifted by 14 pixels relative to colour."""
    pair.depth = [np.roll(depth, -14, axis=1) for depth in pair.depth]


def ray_length(pair: Pair) -> None:
    """Ray length instead of planar z."""
    v, u = np.mgrid[: pair.camera["height"], : pair.camera["width"]]
    x = (u - pair.camera["cx"]) / pair.camera["fx"]
    y = (v - pair.camera["cy"]) / pair.camera["fy"]
    length = np.sqrt(1 + x**2 + y**2)
    pair.depth = [np.rint(depth * length).astype(np.uint16) for depth in pair.depth]


def holes(pair: Pair) -> None:
    """Missing depth in patches, as on dark and shiny surfaces."""
    rng = np.random.default_rng(0)
    for depth in pair.depth:
        blobs = cv2.GaussianBlur(rng.normal(size=depth.shape), (0, 0), 12)
        depth[blobs > np.quantile(blobs, 0.55)] = 0


def picture_of_depth(pair: Pair) -> None:
    """Depth that was saved as an 8-bit image and scaled up again."""
    top = max(int(depth.max()) for depth in pair.depth) / 63
    pair.depth = [np.rint(np.rint(depth / top) * top).astype(np.uint16) for depth in pair.depth]


def exposure(pair: Pair) -> None:
    """An exposure that increased between the frames."""
    pair.color[1] = np.clip(pair.color[1].astype(float) * 1.5, 0, 255).astype(np.uint8)


def swapped(pair: Pair) -> None:
    """Swapped depth images."""
    pair.depth.reverse()


def same_twice(pair: Pair) -> None:
    """The same depth image twice, as from a stalled driver."""
    pair.depth[1] = pair.depth[0]


def lag(pair: Pair) -> None:
    """Depth that lags behind colour."""
    for i in (0, 1):
        true = render_demo.cast(render_demo.EYE, render_demo.pixel_rays(0.0, 0.0) @ EYE[:3, :3].T, poses(i - LAG))[0]
        pair.depth[i] = render_demo.measure(true.reshape(pair.depth[i].shape), np.random.default_rng(i))


def too_soon(pair: Pair) -> None:
    """Two consecutive frames of a fast camera."""
    pair.color[1], pair.depth[1] = frame(GAP, np.random.default_rng(2))


def moving_camera(pair: Pair) -> None:
    """A camera that moved 3 cm to the right in a static scene."""
    pair.color[1], pair.depth[1] = frame(0.0, np.random.default_rng(3), aside=0.03)


faults: dict[str, Callable[[Pair], None]] = {
    "tenths": tenths_of_a_millimetre,
    "half_size": other_resolution,
    "unregistered": unregistered,
    "ray_length": ray_length,
    "holes": holes,
    "picture": picture_of_depth,
    "exposure": exposure,
    "swapped": swapped,
    "same": same_twice,
    "lag": lag,
    "too_soon": too_soon,
    "carried": moving_camera,
}


def poses(time: float) -> list[Array]:
    """world_T_object of the demo's objects at a time: 0 = previous frame, 1 = current frame, extrapolated beyond."""
    out = []
    for obj in render_demo.OBJECTS:
        remaining = 1 - time
        displacement = (remaining * obj.displacement[0], remaining * obj.displacement[1])
        partial = dataclasses.replace(obj, displacement=displacement, rotation_deg=remaining * obj.rotation_deg)
        # The rolling axis is undefined for a displacement of 0.
        out.append(partial.pose(current=obj.rolls and remaining == 0))
    return out


def frame(time: float, rng: np.random.Generator, *, aside: float = 0.0) -> tuple[Array, Array]:
    """Colour (BGR) and measured depth at a time, from the demo's camera shifted to the right by `aside` metres."""
    world_T_camera = EYE.copy()
    origin = render_demo.EYE
    try:
        render_demo.EYE = origin + aside * EYE[:3, 0]
        world_T_camera[:3, 3] = render_demo.EYE
        color, depth, _ = render_demo.render(world_T_camera, poses(time), rng)
    finally:
        render_demo.EYE = origin
    return color[..., ::-1], render_demo.measure(depth, rng)


def write_recording(folder: Path) -> None:
    """Write the sequence as a TUM folder: rgb.txt, depth.txt, 5000 units per metre, and camera.json."""
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    for index, time in enumerate(STEPS):
        color, depth = frame(time, np.random.default_rng(10 + index))
        for kind, image, offset in (("rgb", color, 0.0), ("depth", depth * 5, 0.012)):
            stamp = f"{100 + SECONDS * index + offset:.6f}"  # Depth is slightly later, as for real cameras.
            (folder / kind).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / kind / f"{stamp}.png"), image)
            lists[kind].append(f"{stamp} {kind}/{stamp}.png")
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(["# timestamp filename", *lines]) + "\n")
    camera = json.loads((DEMO / "camera.json").read_text()) | {"depth_scale": 5000}
    (folder / "camera.json").write_text(json.dumps(camera) + "\n")


def main() -> None:
    """Write all inputs into a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", help="names of faults, or recording")
    arguments = parser.parse_args()
    folder: Path = arguments.folder
    shutil.copytree(DEMO, folder / "good", dirs_exist_ok=True)
    for name, apply_fault in faults.items():
        if arguments.only is None or name in arguments.only:
            pair = Pair.read()
            apply_fault(pair)
            pair.write(folder / name)
    if arguments.only is None or "recording" in arguments.only:
        write_recording(folder / "recording")


if __name__ == "__main__":
    main()
