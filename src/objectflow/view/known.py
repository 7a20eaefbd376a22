"""`segmentation.png`: the masks of all known objects over a frame."""

from __future__ import annotations

import cv2
import numpy as np

from objectflow.frame import RgbdFrame
from objectflow.typing import LabelImage, UInt8Array
from objectflow.view import canvas
from objectflow.view.colors import PAPER, object_color


def draw_known(frame: RgbdFrame, known: LabelImage) -> UInt8Array:
    """Draw the masks of known objects in the colours of their tracks.

    Args:
        frame: (H, W).
        known: (H, W) int32 track ids, 0 beside the objects.

    Returns:
        (H, W, 3) uint8 RGB: the frame in grey, and each mask filled and outlined in the colour of its track.
    """
    grey = cv2.cvtColor(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    image = np.asarray(cv2.addWeighted(frame.color, 0.2, grey, 0.5, 70), dtype=np.uint8)
    for number in np.unique(known[known > 0]).tolist():
        mask = known == number
        image[mask] = frame.color[mask]
        image = canvas.blend(image, object_color(number), 0.5 * mask)
        outline = mask & (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
        image[outline] = object_color(number)
        row, column = np.argwhere(mask).mean(axis=0)
        canvas.write(image, str(number), column - 4, row + 5, 16.0, PAPER, bold=True)
    return image
