"""Inputs that every baseline must bear: images of a few pixels, frames with holes, frames all but without depth."""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow import Camera, RgbdFrame

TINY_SIZES = [(1, 1), (2, 3), (8, 6), (50, 17)]


def random_pair(size: tuple[int, int]) -> tuple[RgbdFrame, RgbdFrame]:
    """Two frames of noise, (width, height)."""
    width, height = size
    rng = np.random.default_rng(0)
    camera = Camera(width, height, float(width), float(height), (width - 1) / 2, (height - 1) / 2)
    prev, curr = (
        RgbdFrame(
            rng.integers(0, 256, (height, width, 3), dtype=np.uint8),
            rng.uniform(0.5, 2, (height, width)).astype(np.float32),
            camera,
        )
        for _ in range(2)
    )
    return prev, curr


def with_holes(prev: RgbdFrame, curr: RgbdFrame) -> tuple[RgbdFrame, RgbdFrame]:
    """The same pair without depth on the right and at scattered pixels, elsewhere in either frame."""
    depth = curr.depth.copy()
    depth[:, 200:] = 0
    depth[::7, ::5] = 0
    return dataclasses.replace(prev, depth=np.roll(depth, 3, 0)), dataclasses.replace(curr, depth=depth)


def nearly_without_depth() -> RgbdFrame:
    """640x480 with one measured pixel, not the one that is kept of its block at half the size."""
    camera, depth = Camera(640, 480, 528.0, 528.0, 319.5, 239.5), np.zeros((480, 640), np.float32)
    depth[0, 0] = 1
    return RgbdFrame(np.zeros((480, 640, 3), np.uint8), depth, camera)
