"""Both pictures of a result, as PNG files."""

from __future__ import annotations

from pathlib import Path

import cv2

from objectflow.errors import ResultError
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.typing import UInt8Array
from objectflow.view.flow import draw_flow
from objectflow.view.overlay import draw_overlay


def write_pictures(folder: Path, curr: RgbdFrame, motion: SceneMotion) -> None:
    """Write `overlay.png` and `flow.png` into a folder that exists.

    Raises:
        ResultError: the result has other pixels than the frame.
    """
    if motion.labels.shape != curr.depth.shape:
        raise ResultError(f"{folder}: the result is {motion.labels.shape}, the frame {curr.depth.shape}")
    (folder / "overlay.png").write_bytes(encode_png(draw_overlay(curr, motion)))
    (folder / "flow.png").write_bytes(encode_png(draw_flow(curr, motion)))


def encode_png(image: UInt8Array) -> bytes:
    """(H, W, 3) uint8 RGB -> the bytes of a PNG file.

    Raises:
        ResultError: the picture cannot be encoded.
    """
    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise ResultError(f"a {image.shape[1]}x{image.shape[0]} picture cannot be encoded as PNG")
    return bytes(data.tobytes())
