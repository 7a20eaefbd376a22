"""The two pictures of a result, as PNG files."""

from __future__ import annotations

from pathlib import Path

from objectflow.errors import ResultError
from objectflow.frame import RgbdFrame
from objectflow.motion import SceneMotion
from objectflow.storage.images import encode_png
from objectflow.view.flow import draw_flow
from objectflow.view.overlay import TrackMarks, draw_overlay


def write_pictures(folder: Path, curr: RgbdFrame, motion: SceneMotion, tracks: TrackMarks | None = None) -> None:
    """Write `overlay.png` and `flow.png` into an existing folder.

    Args:
        folder: must exist.
        curr: the current frame.
        motion: its result.
        tracks: numbers and trails of the overlay's objects.

    Raises:
        ResultError: the result and the frame differ in size.
    """
    if motion.labels.shape != curr.depth.shape:
        raise ResultError(f"{folder}: the result is {motion.labels.shape}, the frame {curr.depth.shape}")
    (folder / "overlay.png").write_bytes(encode_png(draw_overlay(curr, motion, tracks)))
    (folder / "flow.png").write_bytes(encode_png(draw_flow(curr, motion)))
