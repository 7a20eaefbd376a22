"""Draw the figures of docs/conventions.md as SVG, with rotations computed by `objectflow.geometry`.

python scripts/draw_conventions.py             # writes docs/images/*.svg
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from objectflow import geometry

OUT = Path(__file__).resolve().parents[1] / "docs" / "images"
INK, GREY, FAINT = "#24292f", "#8c959f", "#d0d7de"
RED, GREEN, BLUE, ORANGE, PURPLE = "#c62828", "#2e7d32", "#1565c0", "#e07a00", "#7b1fa2"

Array = NDArray[Any]


class Drawing:
    """A white sheet with lines, shapes and text."""

    def __init__(self, width: int, height: int) -> None:
        self.size = (width, height)
        self.parts: list[str] = []

    def line(self, a: ArrayLike, b: ArrayLike, color: str, width: float = 2, dash: str = "") -> None:
        """Draw a straight line; `dash` holds the lengths of dash and gap."""
        (x0, y0), (x1, y1) = np.asarray(a, float), np.asarray(b, float)
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self.parts.append(
            f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{color}" '
            f'stroke-width="{width:g}" stroke-linecap="round"{dashed}/>'
        )

    def arrow(self, a: ArrayLike, b: ArrayLike, color: str, width: float = 2.5) -> None:
        """Draw a line with an arrow head at `b`."""
        start, tip = np.asarray(a, float), np.asarray(b, float)
        direction = (tip - start) / np.linalg.norm(tip - start)
        side = np.array([-direction[1], direction[0]])
        self.line(start, tip - 7 * direction, color, width)
        self.polygon([tip, tip - 11 * direction + 5 * side, tip - 11 * direction - 5 * side], color, color, 1, 1)

    def polygon(self, points: ArrayLike, stroke: str, fill: str, opacity: float, width: float = 2) -> None:
        """Draw a closed polygon."""
        listed = " ".join(f"{x:.1f},{y:.1f}" for x, y in np.asarray(points, float))
        self.parts.append(
            f'<polygon points="{listed}" stroke="{stroke}" stroke-width="{width:g}" stroke-linejoin="round" '
            f'fill="{fill}" fill-opacity="{opacity:g}"/>'
        )

    def dot(self, at: ArrayLike, color: str, radius: float = 4) -> None:
        """Draw a filled circle."""
        x, y = np.asarray(at, float)
        self.parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{color}"/>')

    def text(self, at: ArrayLike, text: str, color: str = INK, size: int = 15, anchor: str = "start") -> None:
        """Draw a line of text at its baseline."""
        x, y = np.asarray(at, float)
        self.parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" fill="{color}" font-size="{size}" text-anchor="{anchor}">{text}</text>'
        )

    def write(self, name: str) -> None:
        """Write the sheet to docs/images."""
        w, h = self.size
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {w} {h}" width="{w}" height="{h}" '
            'font-family="Helvetica, Arial, sans-serif">'
        )
        sheet = f'<rect width="{w}" height="{h}" rx="8" fill="#ffffff"/>'
        (OUT / name).write_text("\n".join([head, sheet, *self.parts, "</svg>"]) + "\n")


def camera_frame() -> None:
    """Draw the axes, the image, a point, its planar depth and its ray length."""
    d = Drawing(760, 330)
    eye, middle, right, down = (
        np.array([90.0, 170]),
        np.array([250.0, 170]),
        np.array([34.0, -28]),
        np.array([0, 62.0]),
    )
    corners = [middle - right - down, middle + right - down, middle + right + down, middle - right + down]
    for corner in corners:
        d.line(eye, corner, FAINT, 1.2)
    d.polygon(corners, INK, "#e8f0fe", 0.9)
    d.line(eye, (640, 170), GREY, 1.2, "5 5")
    d.arrow(eye, (180, 170), BLUE)
    d.text((112, 197), "z forward", BLUE)
    d.arrow(eye, eye + 1.5 * right, RED)
    d.text(eye + 1.5 * right + [-62, -4], "x right", RED)
    d.arrow(eye, eye + 1.15 * down, GREEN)
    d.text(eye + 1.15 * down + [-14, 20], "y down", GREEN)
    # The first pixel and the image axes.
    d.dot(corners[0], ORANGE)
    d.text(corners[0] + [6, -40], "pixel (0, 0)", ORANGE, anchor="end")
    d.arrow(corners[0], corners[0] + 1.3 * right, ORANGE, 2)
    d.text(corners[0] + 1.3 * right + [6, -2], "u", ORANGE)
    d.arrow(corners[0], corners[0] + 0.8 * down, ORANGE, 2)
    d.text(corners[0] + 0.8 * down + [-14, 4], "v", ORANGE)
    point = np.array([600.0, 62.0])
    d.line(eye, point, GREY, 1.5)
    foot = np.array([600.0, 170.0])
    d.line(point, foot, GREY, 1.2, "5 5")
    d.dot(point, PURPLE, 5)
    d.text(np.add(point, [10, 2]), "P = (X, Y, Z)", PURPLE)
    d.text((400, 142), "ray length: not depth", GREY, 14)
    d.arrow((eye[0], 296), (600, 296), BLUE)
    d.line((eye[0], 286), (eye[0], 306), BLUE)
    d.line(foot, (600, 306), FAINT, 1.2, "3 5")
    d.text((345, 288), "depth of P: Z, in metres (planar)", BLUE, 15, "middle")
    d.write("convention_camera.svg")


BOX = np.array([[-46.0, -30], [46, -30], [46, 30], [-46, 30]])


def rotate(points: Array, degrees: float) -> Array:
    """Rotate points (N, 2) of the page about its origin, about the z axis, which points into the page."""
    R = geometry.so3_exp([0, 0, np.radians(degrees)])
    return np.asarray((np.pad(points, ((0, 0), (0, 1))) @ R.T)[:, :2])


def backward_flow() -> None:
    """Draw two frames; the flow lies on the current frame and points back in time."""
    d = Drawing(760, 300)
    before, now = np.array([120.0, 165]), np.array([205.0, 140])
    for left, title in ((20, "previous frame"), (400, "current frame: all results lie on its pixels")):
        d.polygon([[left, 50], [left + 340, 50], [left + 340, 270], [left, 270]], GREY, "#f6f8fa", 1, 1.5)
        d.text((left, 38), title)
    d.polygon(before + rotate(BOX, -12), GREEN, GREEN, 0.25)
    shift = np.array([380.0, 0])
    d.polygon(shift + before + rotate(BOX, -12), GREY, GREY, 0.10, 1.2)
    d.polygon(shift + now + rotate(BOX, 10), GREEN, GREEN, 0.25)
    marks = np.array([[-38.0, -20], [34, -18], [0, 0], [-34, 22], [38, 22]])
    for mark in marks:
        old, new = (before + rotate(mark[None], -12)[0], now + rotate(mark[None], 10)[0])
        d.dot(old, PURPLE, 3.5)
        d.arrow(shift + new, shift + old, PURPLE, 2)
        d.dot(shift + new, PURPLE, 3.5)
    d.text((728, 84), "S = P_prev − P_curr", PURPLE, 15, "end")
    d.text((412, 258), "background: S = 0 under a static camera", GREY, 14)
    d.polygon([[690, 200], [728, 206], [722, 238], [694, 234]], GREY, INK, 0.75, 1)
    d.text((686, 222), "no depth: NaN", GREY, 14, "end")
    d.text((32, 258), "the same points in the previous frame", GREY, 14)
    d.write("convention_flow.svg")


def about_the_centre() -> None:
    """Draw one motion about the object's centre X, and as a transform about the camera."""
    d = Drawing(760, 350)
    camera, X, degrees = np.array([70.0, 285]), np.array([560.0, 190]), -16.0
    T = np.array([-190.0, 30])
    d.polygon(np.add(camera, [[-14, 0], [-24, 26], [24, 26], [14, 0]]), INK, "#e8f0fe", 1, 1.5)
    d.text(np.add(camera, [32, 22]), "camera", GREY, 14)
    now, before = X + BOX, X + T + rotate(BOX, degrees)
    d.polygon(now, GREEN, GREEN, 0.28)
    d.polygon(before, GREY, GREY, 0.15)
    # The box after the rotation R about X.
    d.polygon(X + rotate(BOX, degrees), ORANGE, "none", 0, 1.5)
    d.arrow(X, X + T, BLUE)
    d.dot(X, INK)
    d.dot(X + T, INK)
    d.text(np.add(X, [52, 0]), "current", GREEN, anchor="start")
    d.text(np.add(X, [4, 20]), "X", INK, 16)
    d.text(X + T + [-6, 24], "X + T", INK, 16, "middle")
    d.text(X + 0.5 * T + [0, -10], "T", BLUE, 16, "middle")
    d.text(X + T + [-70, 62], "previous", GREY)
    d.text(np.add(X, [48, -36]), "R: about X", ORANGE)
    d.text((400, 306), "P_prev = R (P_curr − X) + X + T", PURPLE, 17)
    d.text((400, 332), "prev_T_curr = [R, t] with t = X + T − R X", PURPLE, 15)
    # The same rotation about the camera displaces the box, which t compensates.
    about_camera = camera + rotate((X - camera)[None], degrees)[0]
    d.line(camera, X, FAINT, 1.5, "4 4")
    d.line(camera, about_camera, FAINT, 1.5, "4 4")
    d.dot(about_camera, GREY, 3)
    d.text(np.add(about_camera, [10, 4]), "R X", GREY)
    d.arrow(about_camera, X + T, GREY, 1.8)
    d.text((about_camera + X + T) / 2 + [-8, -6], "t", GREY, 16, "end")
    d.write("convention_motion.svg")


def main() -> None:
    """Write the three figures."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    camera_frame()
    backward_flow()
    about_the_centre()


if __name__ == "__main__":
    main()
