"""A result as HTML: its label image and a table of its objects."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence

import cv2
import numpy as np

from objectflow.motion.object_motion import ObjectMotion
from objectflow.motion.palette import object_color
from objectflow.motion.words import motion_texts
from objectflow.storage.images import encode_png
from objectflow.typing import LabelImage, UInt8Array

_BACKGROUND = (233, 236, 239)
_WIDTH = 320
"""Pixels: wider label images are downscaled."""


def draw_labels(labels: LabelImage, objects: Sequence[ObjectMotion]) -> UInt8Array:
    """(H, W, 3) uint8 RGB: each object in its colour, static ones pale, the background grey."""
    image = np.empty((*labels.shape, 3), np.uint8)
    image[:] = _BACKGROUND
    for obj in objects:
        color = np.array(object_color(obj.id), np.float64)
        image[labels == obj.id] = color if obj.moving else 0.35 * color + 0.65 * np.array(_BACKGROUND)
    return image


def to_html(title: str, labels: LabelImage, objects: Sequence[ObjectMotion]) -> str:
    """The label image and a table of the objects, self-contained."""
    picture = draw_labels(labels, objects)
    if picture.shape[1] > _WIDTH:
        height = max(1, round(picture.shape[0] * _WIDTH / picture.shape[1]))
        picture = np.asarray(cv2.resize(picture, (_WIDTH, height), interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
    data = base64.b64encode(encode_png(picture)).decode("ascii")
    rows = "".join(
        f"<tr><td>{obj.id}</td><td>{'moving' if obj.moving else 'static'}</td>"
        + "".join(f"<td>{text}</td>" for text in motion_texts(obj))
        + f"<td>{obj.score:.2f}</td><td>{obj.pixels}</td></tr>"
        for obj in objects
    )
    header = (
        "<tr><th>id</th><th></th><th>displacement, cm</th><th>rotation, deg</th><th>score</th><th>pixels</th></tr>"
    )
    return (
        f"<div><p>{html.escape(title)}</p><img alt='labels' src='data:image/png;base64,{data}'/>"
        f"<table>{header}{rows}</table></div>"
    )
