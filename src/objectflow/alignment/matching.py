"""Matches between two frames: dense optical flow and features, lifted to 3D by depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, IndexArray, UInt8Array

_MIN_SIDE = 12
"""Pixels: smallest image side that DIS optical flow accepts."""


@dataclass(frozen=True)
class MatchSettings(Settings):
    """Which matches between the frames are accepted."""

    stride: int = setting(8, minimum=1)
    """Pixels between matches by optical flow."""
    narrow_width: int = setting(400, minimum=0)
    """Pixels: images up to this width use `narrow_stride`."""
    narrow_stride: int = setting(4, minimum=1)
    """Pixels between matches by optical flow in narrow images."""
    flow_error_ratio: float = setting(0.01, minimum=0)
    """Largest squared difference of forward and backward flow, relative to the sum of their squared lengths."""
    flow_error: float = setting(0.5, minimum=0)
    """Square pixels, added to that difference."""
    feature_width: int = setting(640, minimum=16)
    """Pixels: wider frames are downscaled to it before features are detected."""
    max_features: int = setting(1500, minimum=1)
    """Maximum number of SIFT features per frame."""
    min_contrast: float = setting(0.02, minimum=0)
    """SIFT's contrast threshold. It is low, since tables and packaging have little contrast, and the ratio test of
    matching removes what is ambiguous."""
    max_descriptor_ratio: float = setting(0.85, above=0, maximum=1)
    """Largest distance of a feature to its match, relative to that of the second nearest feature."""
    sufficient_flow_share: float = setting(1.0, minimum=0, maximum=1)
    """Share of the pixels with consistent optical flow above which no features are matched; 1 always matches them.
    Optical flow fails nearly everywhere where a camera moves too far for it."""
    surface_step_ratio: float = setting(0.02, minimum=0)
    """Largest difference of depth between the four pixels around a match, relative to depth."""
    surface_step: float = setting(0.005, minimum=0)
    """Metres, added to that difference."""


DEFAULTS = MatchSettings()


@dataclass(frozen=True, eq=False)
class PixelMatches:
    """Matched 3D points; indexing with a mask or an index array selects some of them.

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


class FlowMatches(NamedTuple):
    """Matches by optical flow.

    Attributes:
        matches: on a grid, where flow is consistent.
        share: 0..1, of the pixels with consistent flow.
    """

    matches: PixelMatches
    share: float


def match_by_flow(prev: PreparedFrame, curr: PreparedFrame, settings: MatchSettings = DEFAULTS) -> FlowMatches:
    """Optical flow on a grid, for small displacements everywhere."""
    flow, consistent = dense_flow(prev.gray, curr.gray, settings)
    narrow = curr.frame.camera.width <= settings.narrow_width
    stride = settings.narrow_stride if narrow else settings.stride
    matches = flow_matches(flow, consistent, prev.frame, curr.frame, stride=stride, settings=settings)
    return FlowMatches(matches, float(consistent.mean()))


def match_frames(
    prev: PreparedFrame, curr: PreparedFrame, settings: MatchSettings = DEFAULTS, flow: FlowMatches | None = None
) -> PixelMatches:
    """Matches by optical flow and, unless flow suffices, of features, for large displacements of textured surfaces.

    Args:
        prev, curr: the frames.
        settings: `sufficient_flow_share` decides about features.
        flow: of the same frames, where it is known already.
    """
    flow = match_by_flow(prev, curr, settings) if flow is None else flow
    if flow.share > settings.sufficient_flow_share:
        return flow.matches
    return flow.matches + feature_matches(prev, curr, settings)


def dense_flow(
    prev_gray: UInt8Array, curr_gray: UInt8Array, settings: MatchSettings = DEFAULTS
) -> tuple[Float32Array, BoolMask]:
    """DIS optical flow (Kroeger et al., ECCV 2016) from the current to the previous image.

    Args:
        prev_gray, curr_gray: (H, W) uint8.
        settings: `flow_error_ratio` and `flow_error` apply.

    Returns:
        (H, W, 2) float32 flow in pixels, and (H, W) bool: whether forward and backward flow agree. Images with a side
        below `_MIN_SIDE` pixels get zero flow that is nowhere consistent.
    """
    if min(curr_gray.shape) < _MIN_SIDE:
        return np.zeros((*curr_gray.shape, 2), np.float32), np.zeros(curr_gray.shape, bool)
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(1)
    curr_to_prev = np.asarray(dis.calc(curr_gray, prev_gray, None), dtype=np.float32)  # type: ignore[call-overload]
    prev_to_curr = np.asarray(dis.calc(prev_gray, curr_gray, None), dtype=np.float32)  # type: ignore[call-overload]
    u, v = _targets(curr_to_prev)
    back = cv2.remap(prev_to_curr, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e6, 1e6))
    # The tolerance grows with the length of the flow (Sundaram et al., ECCV 2010, equation 5).
    error = ((curr_to_prev + back) ** 2).sum(-1)
    length = (curr_to_prev**2).sum(-1) + (back**2).sum(-1)
    return curr_to_prev, error < settings.flow_error_ratio * length + settings.flow_error


def lift(
    pixels: Float32Array,
    prev_pixels: Float32Array,
    prev: RgbdFrame,
    curr: RgbdFrame,
    settings: MatchSettings = DEFAULTS,
) -> tuple[PixelMatches, BoolMask]:
    """Lift matched pixels (N, 2) to 3D points.

    Returns:
        The matches with depth on one surface at both ends, and (N,) bool: which of the given ones they are.
    """
    curr_depth, curr_ok = sample_depth(curr.depth, pixels, settings)
    prev_depth, prev_ok = sample_depth(prev.depth, prev_pixels, settings)
    keep = curr_ok & prev_ok
    curr_points = geometry.back_project_pixels(pixels[keep], curr_depth[keep], curr.camera)
    prev_points = geometry.back_project_pixels(prev_pixels[keep], prev_depth[keep], prev.camera)
    return PixelMatches(pixels[keep], curr_points, prev_points), keep


def sample_depth(
    depth: Float32Array, pixels: Float32Array, settings: MatchSettings = DEFAULTS
) -> tuple[Float32Array, BoolMask]:
    """Depth at fractional pixels: bilinear where the four neighbours lie on one surface.

    Args:
        depth: (H, W) metres.
        pixels: (N, 2) as (u, v).
        settings: `surface_step_ratio` and `surface_step` apply.

    Returns:
        (N,) metres, and (N,) bool: False outside the image, on holes and across depth edges.
    """
    height, width = depth.shape
    with np.errstate(invalid="ignore"):
        inside = (pixels[:, 0] >= 0) & (pixels[:, 1] >= 0) & (pixels[:, 0] <= width - 1) & (pixels[:, 1] <= height - 1)
    u, v = np.where(inside, pixels[:, 0], 0), np.where(inside, pixels[:, 1], 0)
    u0, v0 = np.minimum(u.astype(np.int32), max(0, width - 2)), np.minimum(v.astype(np.int32), max(0, height - 2))
    right, below = min(1, width - 1), width * min(1, height - 1)  # images may be one pixel wide
    du, dv = (u - u0).astype(np.float32), (v - v0).astype(np.float32)
    first, values = v0 * width + u0, np.ascontiguousarray(depth).ravel()
    a, b, c, d = (values.take(first + step) for step in (0, right, below, below + right))
    low, high = np.minimum(np.minimum(a, b), np.minimum(c, d)), np.maximum(np.maximum(a, b), np.maximum(c, d))
    step = settings.surface_step_ratio * high + settings.surface_step
    ok = inside & (low > 0) & (high - low < step)
    top, bottom = a + (b - a) * du, c + (d - c) * du
    return (top + (bottom - top) * dv).astype(np.float32), ok


def flow_matches(
    flow: Float32Array,
    consistent: BoolMask,
    prev: RgbdFrame,
    curr: RgbdFrame,
    *,
    stride: int,
    settings: MatchSettings = DEFAULTS,
) -> PixelMatches:
    """Consistent optical flow, sampled every `stride` pixels and lifted to 3D."""
    v, u = np.mgrid[stride // 2 : flow.shape[0] : stride, stride // 2 : flow.shape[1] : stride]
    keep = consistent[v, u]
    pixels = np.stack([u[keep], v[keep]], axis=1).astype(np.float32)
    return lift(pixels, pixels + flow[v[keep], u[keep]], prev, curr, settings)[0]


def feature_matches(
    prev: RgbdFrame | PreparedFrame, curr: RgbdFrame | PreparedFrame, settings: MatchSettings = DEFAULTS
) -> PixelMatches:
    """Mutual SIFT matches that pass the ratio test; they span displacements too large for optical flow."""
    prev, curr = PreparedFrame.of(prev), PreparedFrame.of(curr)
    width = settings.feature_width
    here, there = (
        frame.at_width(width).keypoints(settings.max_features, settings.min_contrast) for frame in (curr, prev)
    )
    if len(here.pixels) < 2 or len(there.pixels) < 2:
        empty = np.zeros((0, 2), np.float32)
        return lift(empty, empty, prev.frame, curr.frame)[0]
    curr_index, prev_index = match_descriptors(here.descriptors, there.descriptors, settings.max_descriptor_ratio)
    # Pixel centres of the downscaled frame, on the pixels of the frame itself.
    scale = curr.frame.camera.width / curr.at_width(width).frame.camera.width
    curr_pixels, prev_pixels = (
        (pixels + np.float32(0.5)) * np.float32(scale) - np.float32(0.5)
        for pixels in (here.pixels[curr_index], there.pixels[prev_index])
    )
    return lift(curr_pixels, prev_pixels, prev.frame, curr.frame, settings)[0]


def match_descriptors(curr: Float32Array, prev: Float32Array, ratio: float) -> tuple[IndexArray, IndexArray]:
    """Mutual nearest neighbours among unit descriptors.

    Args:
        curr, prev: (N, D) and (M, D), at least two each.
        ratio: largest distance of a match, relative to that of the second nearest descriptor of `prev`.

    Returns:
        The indices of the matches in `curr` and in `prev`.
    """
    similarity = curr @ prev.T
    best = similarity.argmax(1)
    mutual = similarity.argmax(0)[best] == np.arange(len(curr))
    top = np.partition(similarity, -2, axis=1)[:, -2:]
    distance = np.sqrt(np.maximum(2 - 2 * top, 0))
    keep = np.flatnonzero(mutual & (distance[:, 1] < ratio * distance[:, 0]))
    return keep, best[keep]


def _targets(flow: Float32Array) -> tuple[Float32Array, Float32Array]:
    v, u = np.mgrid[0 : flow.shape[0], 0 : flow.shape[1]].astype(np.float32)
    return u + flow[..., 0], v + flow[..., 1]


def inside(mask: BoolMask, matches: PixelMatches, camera: Camera) -> BoolMask:
    """(N,) bool: whether each match, whose pixels refer to `camera`, lies in a mask of any size."""
    height, width = mask.shape
    column = np.clip((matches.pixels[:, 0] + 0.5) * width / camera.width, 0, width - 1).astype(int)
    row = np.clip((matches.pixels[:, 1] + 0.5) * height / camera.height, 0, height - 1).astype(int)
    return np.asarray(mask[row, column])
