"""Where a pixel of the current frame was in the previous one: dense flow and feature matches, lifted by depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.typing import BoolMask, Float32Array, IndexArray, UInt8Array

_SMALLEST = 12
"""Pixels a side that DIS needs."""


@dataclass(frozen=True, eq=False)
class PixelMatches:
    """Matched 3D points; indexing with a mask or an index array picks some of them.

    Attributes:
        pixels: (N, 2) float32 (u, v) on the current frame.
        curr, prev: (N, 3) float32 metres, each in its own camera frame.
    """

    pixels: Float32Array
    curr: Float32Array
    prev: Float32Array

    def __getitem__(self, index: BoolMask | IndexArray) -> PixelMatches:
        return PixelMatches(self.pixels[index], self.curr[index], self.prev[index])

    def __add__(self, other: PixelMatches) -> PixelMatches:
        return PixelMatches(
            np.concatenate([self.pixels, other.pixels]),
            np.concatenate([self.curr, other.curr]),
            np.concatenate([self.prev, other.prev]),
        )


def find_matches(prev: RgbdFrame, curr: RgbdFrame) -> PixelMatches:
    """Flow on a grid and features together: small motions everywhere, large ones where there is something to see."""
    flow, consistent = dense_flow(gray(prev.color), gray(curr.color))
    stride = 4 if curr.camera.width <= 400 else 8
    return flow_matches(flow, consistent, prev, curr, stride=stride) + feature_matches(prev, curr)


def gray(color: UInt8Array) -> UInt8Array:
    """(H, W, 3) RGB -> (H, W) uint8."""
    return np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def dense_flow(prev_gray: UInt8Array, curr_gray: UInt8Array) -> tuple[Float32Array, BoolMask]:
    """DIS optical flow (Kroeger et al., ECCV 2016) from the current to the previous image.

    Images with a side below `_SMALLEST` pixels are too small for it: no pixel of theirs is consistent.

    Returns:
        (H, W, 2) float32 flow in pixels, and (H, W) bool: forward and backward flow agree.
    """
    if min(curr_gray.shape) < _SMALLEST:
        return np.zeros((*curr_gray.shape, 2), np.float32), np.zeros(curr_gray.shape, bool)
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(1)
    curr_to_prev = np.asarray(dis.calc(curr_gray, prev_gray, None), dtype=np.float32)  # type: ignore[call-overload]
    prev_to_curr = np.asarray(dis.calc(prev_gray, curr_gray, None), dtype=np.float32)  # type: ignore[call-overload]
    u, v = _where_to(curr_to_prev)
    back = cv2.remap(prev_to_curr, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e6, 1e6))
    # The tolerance of Sundaram et al., ECCV 2010 (equation 5): longer flow may disagree more.
    error = ((curr_to_prev + back) ** 2).sum(-1)
    length = (curr_to_prev**2).sum(-1) + (back**2).sum(-1)
    return curr_to_prev, error < 0.01 * length + 0.5


def lift(
    pixels: Float32Array, prev_pixels: Float32Array, prev: RgbdFrame, curr: RgbdFrame
) -> tuple[PixelMatches, BoolMask]:
    """Give matched pixels (N, 2) their 3D points.

    Returns:
        The matches whose two ends have depth on one surface, and (N,) bool: which they are.
    """
    curr_depth, curr_ok = sample_depth(curr.depth, pixels)
    prev_depth, prev_ok = sample_depth(prev.depth, prev_pixels)
    keep = curr_ok & prev_ok
    curr_points = _points(pixels[keep], curr_depth[keep], curr.camera)
    prev_points = _points(prev_pixels[keep], prev_depth[keep], prev.camera)
    return PixelMatches(pixels[keep], curr_points, prev_points), keep


def sample_depth(depth: Float32Array, pixels: Float32Array) -> tuple[Float32Array, BoolMask]:
    """Depth between pixels, bilinear only where the four neighbours lie on one surface.

    Args:
        depth: (H, W) metres.
        pixels: (N, 2) as (u, v).

    Returns:
        (N,) metres, and (N,) bool: False outside the image, on holes and across depth edges.
    """
    height, width = depth.shape
    with np.errstate(invalid="ignore"):
        inside = (pixels[:, 0] >= 0) & (pixels[:, 1] >= 0) & (pixels[:, 0] <= width - 1) & (pixels[:, 1] <= height - 1)
    u, v = np.where(inside, pixels[:, 0], 0), np.where(inside, pixels[:, 1], 0)
    u0, v0 = np.minimum(u.astype(np.int32), max(0, width - 2)), np.minimum(v.astype(np.int32), max(0, height - 2))
    right, below = min(1, width - 1), width * min(1, height - 1)  # an image may be a single pixel wide
    du, dv = (u - u0).astype(np.float32), (v - v0).astype(np.float32)
    first, values = v0 * width + u0, np.ascontiguousarray(depth).ravel()
    a, b, c, d = (values.take(first + step) for step in (0, right, below, below + right))
    low, high = np.minimum(np.minimum(a, b), np.minimum(c, d)), np.maximum(np.maximum(a, b), np.maximum(c, d))
    ok = inside & (low > 0) & (high - low < 0.02 * high + 0.005)
    top, bottom = a + (b - a) * du, c + (d - c) * du
    return (top + (bottom - top) * dv).astype(np.float32), ok


def flow_matches(
    flow: Float32Array, consistent: BoolMask, prev: RgbdFrame, curr: RgbdFrame, *, stride: int
) -> PixelMatches:
    """Dense flow sampled every `stride` pixels and lifted, where it is consistent."""
    v, u = np.mgrid[stride // 2 : flow.shape[0] : stride, stride // 2 : flow.shape[1] : stride]
    keep = consistent[v, u]
    pixels = np.stack([u[keep], v[keep]], axis=1).astype(np.float32)
    return lift(pixels, pixels + flow[v[keep], u[keep]], prev, curr)[0]


def feature_matches(prev: RgbdFrame, curr: RgbdFrame, *, limit: int = 1500) -> PixelMatches:
    """SIFT matches (Lowe, IJCV 2004), mutual and with the ratio test: they reach where flow's small steps do not."""
    # A low contrast threshold: tables and packaging are dull, and the ratio test removes what is ambiguous.
    sift = cv2.SIFT.create(nfeatures=limit, contrastThreshold=0.02)
    curr_keys, curr_words = sift.detectAndCompute(gray(curr.color), None)
    prev_keys, prev_words = sift.detectAndCompute(gray(prev.color), None)
    empty = np.zeros((0, 2), np.float32)
    if len(curr_keys) < 2 or len(prev_keys) < 2:
        return lift(empty, empty, prev, curr)[0]
    curr_index, prev_index = _match_words(_root(curr_words), _root(prev_words))
    pixels = np.array([key.pt for key in curr_keys], np.float32)[curr_index]
    prev_pixels = np.array([key.pt for key in prev_keys], np.float32)[prev_index]
    return lift(pixels, prev_pixels, prev, curr)[0]


def _root(words: NDArray[Any]) -> Float32Array:
    """RootSIFT (Arandjelovic and Zisserman, CVPR 2012): a dot product then compares histograms as it should."""
    return np.asarray(np.sqrt(words / (words.sum(1, keepdims=True) + 1e-7)), dtype=np.float32)


def _match_words(curr: Float32Array, prev: Float32Array, ratio: float = 0.85) -> tuple[IndexArray, IndexArray]:
    """Mutual nearest neighbours of unit descriptors that beat the second nearest by `ratio` in distance."""
    similarity = curr @ prev.T
    best = similarity.argmax(1)
    mutual = similarity.argmax(0)[best] == np.arange(len(curr))
    top = np.partition(similarity, -2, axis=1)[:, -2:]
    distance = np.sqrt(np.maximum(2 - 2 * top, 0))
    keep = np.flatnonzero(mutual & (distance[:, 1] < ratio * distance[:, 0]))
    return keep, best[keep]


def _where_to(flow: Float32Array) -> tuple[Float32Array, Float32Array]:
    v, u = np.mgrid[0 : flow.shape[0], 0 : flow.shape[1]].astype(np.float32)
    return u + flow[..., 0], v + flow[..., 1]


def _points(pixels: Float32Array, depth: Float32Array, camera: Camera) -> Float32Array:
    x = (pixels[:, 0] - camera.cx) / camera.fx * depth
    y = (pixels[:, 1] - camera.cy) / camera.fy * depth
    return np.stack([x, y, depth], axis=1).astype(np.float32)


def inside(mask: BoolMask, matches: PixelMatches, camera: Camera) -> BoolMask:
    """(N,) bool: matches whose pixel, given on `camera`'s image, lies in a mask of any size."""
    height, width = mask.shape
    column = np.clip((matches.pixels[:, 0] + 0.5) * width / camera.width, 0, width - 1).astype(int)
    row = np.clip((matches.pixels[:, 1] + 0.5) * height / camera.height, 0, height - 1).astype(int)
    return np.asarray(mask[row, column])
