"""Plates before a wall as a recording of numbered frames, and a method that misses some of their steps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from helpers.plate_scenes import Place, PlateScene
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion

PLATE_PATH: list[dict[int, Place]] = [{1: (-0.25 + 0.02 * max(0, k - 1), 0.0, 1.0)} for k in range(7)]
"""A plate that rests in two frames and then slides by 2 cm a frame."""


def write_plates(folder: Path, places: list[dict[int, Place]]) -> PlateScene:
    """Write `color` and `depth` in millimetres; the first pixel of each image holds the number of its frame."""
    scene = PlateScene()
    for kind in ("color", "depth"):
        (folder / kind).mkdir(parents=True)
    for number, here in enumerate(places):
        frame = scene.frame(number, here)
        color = frame.color[..., ::-1].copy()
        color[0, 0] = number
        cv2.imwrite(str(folder / "color" / f"{number}.png"), color)
        cv2.imwrite(str(folder / "depth" / f"{number}.png"), np.rint(1000 * frame.depth).astype(np.uint16))
    return scene


def missing_steps(
    scene: PlateScene, first: int = 0, gap: int = 1, calls: list[tuple[int, int]] | None = None
) -> Callable[[RgbdFrame, RgbdFrame], SceneMotion]:
    """A method that sees the true motions between some frames.

    Args:
        scene: with all frames.
        first: number of the first frame that it sees.
        gap: number of frames between two, at which it sees what moved; it sees nothing between others.
        calls: the numbers of the frames of each estimate are appended to it.
    """

    def estimate(prev: RgbdFrame, curr: RgbdFrame) -> SceneMotion:
        numbers = int(prev.color[0, 0, 0]), int(curr.color[0, 0, 0])
        if calls is not None:
            calls.append(numbers)
        found = scene.motion(numbers[1], since=numbers[0])
        seen = numbers[0] >= first and numbers[1] - numbers[0] == gap
        return found if seen else SceneMotion(np.zeros_like(found.labels), found.scene_flow)

    return estimate
