"""Textured cards that face the camera, before a wall: scenes in which every mask and motion is known in pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from objectflow import geometry
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.motion import ObjectMotion
from objectflow.typing import BoolMask, Float64Array, UInt8Array

CAMERA = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
WALL = 1.0
"""Metres: depth of the wall."""


def texture(seed: int, height: int, width: int, low: int = 30, high: int = 220) -> UInt8Array:
    """(height, width, 3) smooth random colours."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(low, high, (height // 4 + 1, width // 4 + 1, 3)).astype(np.uint8)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC))


@dataclass(frozen=True)
class Card:
    """A card: the seed of its texture, left, top, width and height in pixels, and depth in metres."""

    seed: int
    left: int
    top: int
    width: int
    height: int
    depth: float

    @property
    def mask(self) -> BoolMask:
        """(H, W) bool: its pixels, if nothing hides it."""
        out = np.zeros((CAMERA.height, CAMERA.width), np.bool_)
        out[self.top : self.top + self.height, self.left : self.left + self.width] = True
        return out

    def motion(self, columns: int, rows: int = 0) -> Float64Array:
        """`prev_T_curr` of a card that moved by some pixels: to the right and down."""
        metres = self.depth / CAMERA.fx
        return geometry.make_transform(np.eye(3), [-columns * metres, -rows * metres, 0.0])


def draw(*cards: Card, wall: UInt8Array | None = None) -> RgbdFrame:
    """A frame of cards, those behind drawn first, before a textured or a given wall."""
    color = (texture(99, CAMERA.height, CAMERA.width, 90, 150) if wall is None else wall).copy()
    depth = np.full(color.shape[:2], WALL, np.float32)
    for card in cards:
        area = slice(card.top, card.top + card.height), slice(card.left, card.left + card.width)
        color[area] = texture(card.seed, card.height, card.width)
        depth[area] = card.depth
    return RgbdFrame(color, depth, CAMERA)


def object_of(number: int, mask: BoolMask, frame: RgbdFrame, motion: Float64Array, score: float = 0.8) -> ObjectMotion:
    """A moving object of a mask."""
    points = geometry.back_project(frame.depth, CAMERA)[mask]
    center = np.asarray(points.mean(axis=0), dtype=np.float64)
    return ObjectMotion(number, int(mask.sum()), score, True, center, motion)
