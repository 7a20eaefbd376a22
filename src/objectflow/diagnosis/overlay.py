"""A picture of depth edges over colour, which shows whether depth is registered to colour."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow.diagnosis.registration import find_depth_edges
from objectflow.frame import RgbdFrame
from objectflow.typing import UInt8Array

EDGE_COLOR = (255, 40, 40)
"""RGB of depth edges."""
MISSING_COLOR = (40, 80, 255)
"""RGB of the tint of pixels without depth."""


def draw_depth_edges(frame: RgbdFrame) -> UInt8Array:
    """Draw depth edges in red over dimmed colour, with a blue tint where depth is missing.

    Returns:
        (H, W, 3) uint8 RGB. Where depth is registered, the red lines follow the outlines of the objects.
    """
    picture = (0.7 * frame.color.astype(np.float32)).astype(np.uint8)
    tinted = 0.5 * picture[~frame.valid] + 0.5 * np.array(MISSING_COLOR)
    picture[~frame.valid] = tinted.astype(np.uint8)
    along_x, along_y = find_depth_edges(frame.depth)
    width = 1 + frame.camera.width // 640
    edges = cv2.dilate((along_x | along_y).astype(np.uint8), np.ones((width, width), np.uint8)) > 0
    picture[edges] = EDGE_COLOR
    return picture
