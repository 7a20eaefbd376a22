"""Draw docs/images/demo.jpg, the README's picture: both frames of the demo, masks with arrows, and the flow in 3D.

python scripts/readme_picture.py
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

import objectflow as of
from objectflow import geometry
from objectflow.readers import open_pair
from objectflow.typing import Float64Array, UInt8Array
from objectflow.view import canvas, draw_flow, draw_overlay
from objectflow.view.colors import INK, wheel

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
PAIR = Path(of.__file__).parent / "demo" / "pair"
WIDTH, HEIGHT, TITLE, GAP = 760, 570, 40, 12
YAW, PITCH = -24, 16
"""Degrees: rotation of the 3D view about the middle of the table."""


def flow_in_3d(curr: of.RgbdFrame, motion: of.SceneMotion) -> UInt8Array:
    """The points of the current frame from another side, with a line from where each moving point was."""
    points = geometry.back_project(curr.depth, curr.camera).astype(np.float64)
    own = motion.own_flow(curr).astype(np.float64)
    moving = np.isin(motion.labels, [obj.id for obj in motion.moving]) & curr.valid
    grey = cv2.cvtColor(curr.color, cv2.COLOR_RGB2GRAY)[..., None].repeat(3, axis=2).astype(np.float64)
    pale = 150 + 0.38 * grey
    full = 0.06
    hue = wheel(-own[..., 0] / full, -own[..., 1] / full).astype(np.float64) * (0.45 + 0.55 * grey / 255)
    color = np.where(moving[..., None], hue, pale)
    image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    pixels, depth = _view(points[curr.valid], curr)
    # The farthest points are drawn first.
    order = np.argsort(-depth)
    shades = color[curr.valid][order]
    for (u, v), shade in zip(np.rint(pixels[order]).astype(int).tolist(), shades.tolist(), strict=True):
        if 0 <= u < WIDTH - 1 and 0 <= v < HEIGHT - 1:
            image[v : v + 2, u : u + 2] = shade
    rows, columns = np.nonzero(moving)
    for row, column in list(zip(rows.tolist(), columns.tolist(), strict=True))[::61]:
        ends, _ = _view(np.stack([points[row, column] + own[row, column], points[row, column]]), curr)
        shade = tuple(int(0.62 * value) for value in wheel(*(-own[row, column, :2] / full)).tolist())
        canvas.line(image, [(float(u), float(v)) for u, v in ends], (shade[0], shade[1], shade[2]), 1)
    for obj in motion.moving:
        ends, _ = _view(np.stack([obj.prev_center, obj.center]), curr)
        start, end = ((float(u), float(v)) for u, v in ends)
        canvas.arrow(image, start, end, (255, 255, 255), 7, INK)
    return image


def _view(points: Float64Array, curr: of.RgbdFrame) -> tuple[Float64Array, Float64Array]:
    """Pixels (N, 2) and depth (N,) of points in the turned view."""
    middle = np.array([0.0, 0.02, 0.78])
    x, y, _ = np.eye(3)
    yaw, pitch = geometry.so3_exp(np.radians(YAW) * y), geometry.so3_exp(np.radians(PITCH) * x)
    turned = (points - middle) @ (pitch @ yaw).T + middle + [0, 0, 0.02]
    scale = WIDTH / curr.camera.width
    pixels = turned[:, :2] / turned[:, 2:] * curr.camera.fx * scale + [WIDTH / 2, HEIGHT / 2]
    return pixels, turned[:, 2]


def main() -> None:
    """Estimate, draw, tile."""
    prev, curr = open_pair(PAIR)
    motion = of.load("rigidmatch")(prev, curr)
    panels = [
        ("Before", prev.color),
        ("After", curr.color),
        ("Objects, displacements, rotations", draw_overlay(curr, motion)),
        ("Scene flow in 3D", flow_in_3d(curr, motion)),
    ]
    sheet = np.full((2 * (HEIGHT + TITLE) + GAP, 2 * WIDTH + 3 * GAP, 3), 255, np.uint8)
    for index, (title, picture) in enumerate(panels):
        left, top = GAP + (index % 2) * (WIDTH + GAP), (index // 2) * (HEIGHT + TITLE)
        canvas.write(sheet, title, left, top + TITLE - 12, 24, INK, bold=True)
        mode = cv2.INTER_AREA if picture.shape[1] > WIDTH else cv2.INTER_CUBIC
        sheet[top + TITLE : top + TITLE + HEIGHT, left : left + WIDTH] = cv2.resize(
            picture, (WIDTH, HEIGHT), interpolation=mode
        )
    quality = [cv2.IMWRITE_JPEG_QUALITY, 88]
    for name, picture in (
        ("demo.jpg", sheet),
        ("demo_overlay.jpg", draw_overlay(curr, motion)),
        ("demo_flow.jpg", draw_flow(curr, motion)),
    ):
        cv2.imwrite(str(IMAGES / name), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), quality)
        print(f"written to {IMAGES / name}")


if __name__ == "__main__":
    main()
