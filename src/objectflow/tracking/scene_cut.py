"""Cuts: pairs whose frames show different scenes before a camera that did not move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.motion import SceneMotion
from objectflow.settings import Settings, setting


@dataclass(frozen=True)
class CutSettings(Settings):
    """When two frames show different scenes.

    The shares are those of the pixels with depth in both frames. In generated sequences of falling piles, 18% of the
    pixels at least keep their depth and 14% their depth and colour from one frame to the next; between frames of
    different scenes the medians are 1% and 0%.
    """

    width: int = setting(320, minimum=16)
    """Pixels: width at which the frames are compared."""
    min_pixels: float = setting(0.05, minimum=0, maximum=1)
    """Share of the image with depth in both frames, below which no cut is recognised."""
    max_depth_change: float = setting(0.05, above=0)
    """Relative difference up to which a pixel keeps its depth."""
    max_color_change: float = setting(8.0, above=0)
    """Grey levels: largest difference in any channel up to which a pixel keeps its colour."""
    max_same_depth: float = setting(0.15, minimum=0, maximum=1)
    """Share of pixels that keep their depth, from which the frames show the same scene, in whatever light."""
    max_same: float = setting(0.02, minimum=0, maximum=1)
    """Share of pixels that keep depth and colour, from which the frames show the same scene."""


def is_cut(pair: FramePair, motion: SceneMotion, settings: CutSettings) -> bool:
    """Whether the frames of a pair show different scenes, although the estimate assumes a camera that stood still.

    Args:
        pair: the frames.
        motion: its estimate. A motion of the camera was found in the images, which a cut does not allow.
        settings: see there.
    """
    if motion.camera_motion is not None or not motion.camera_known:
        return False
    pair = pair.at_width(settings.width)
    prev, curr = pair.prev.frame, pair.curr.frame
    both = prev.valid & curr.valid
    if both.mean() < settings.min_pixels:
        return False
    before, after = prev.depth[both], curr.depth[both]
    depth = np.abs(after - before) < settings.max_depth_change * after
    change = np.abs(curr.color[both].astype(np.int16) - prev.color[both]).max(axis=-1)
    same = depth & (change <= settings.max_color_change)
    return bool(depth.mean() < settings.max_same_depth and same.mean() < settings.max_same)
