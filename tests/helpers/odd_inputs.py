"""Edge-case inputs for the baselines: tiny images, frames with holes, frames almost without depth."""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow import Camera, RgbdFrame

TINY_SIZES = [(1, 1), (2, 3), (8, 6), (50, 17)]


def random_pair(size: tuple[int, int]) -> tuple[RgbdFrame, RgbdFrame]:
    """Two frames of noise with size (width, height)."""
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
    """Remove depth on the right and at scattered pixels, at different rows in the two frames."""
    depth = curr.depth.copy()
    depth[:, 200:] = 0
    depth[::7, ::5] = 0
    return dataclasses.replace(prev, depth=np.roll(depth, 3, 0)), dataclasses.replace(curr, depth=depth)


def nearly_without_depth() -> RgbdFrame:
    """A 640x480 frame with one valid pixel, which downsampling by 2 does not keep."""
    camera, depth = Camera(640, 480, 528.0, 528.0, 319.5, 239.5), np.zeros((480, 640), np.float32)
    depth[0, 0] = 1
    return RgbdFrame(np.zeros((480, 640, 3), np.uint8), depth, camera)
