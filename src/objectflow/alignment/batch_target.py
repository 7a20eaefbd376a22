"""Both frames of a pair as the registration of many motions at once takes them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from objectflow.alignment.frame_pair import FramePair
from objectflow.geometry.camera import Camera
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray


class BatchTarget:
    """The previous frame, one contiguous array per quantity, from which gathers are fast.

    Attributes:
        camera, noise: of the frame.
        depth: (H W) float32 metres; -inf where it is missing.
        surface: x, y, z of the points and of the normals, each (H W) float32; NaN where there is no surface.
        shades: for each blur, grey levels and their gradients along u and v, each (H W) float32.
        appearance: the channels of `AppearanceFeatures`, each (H W) float32.
    """

    def __init__(self, pair: FramePair) -> None:
        prev = pair.prev
        self.camera, self.noise = prev.frame.camera, pair.noise
        depth = prev.frame.depth.ravel()
        self.depth: Float32Array = np.where(depth > 0, depth, np.float32(-np.inf))
        self.surface = tuple(np.ascontiguousarray(prev.surface[:, k]) for k in range(6))
        self.shades = tuple(
            tuple(np.ascontiguousarray(image.reshape(-1, 3)[:, k]) for k in range(3)) for image in prev.shades
        )
        self.appearance = tuple(np.ascontiguousarray(channel.ravel()) for channel in prev.appearance.channels)

    @classmethod
    def of(cls, pair: FramePair) -> BatchTarget:
        """The target of a pair, which all steps share."""
        if cls not in pair.memo:
            pair.memo[cls] = cls(pair)
        found: BatchTarget = pair.memo[cls]
        return found


class BatchSource(NamedTuple):
    """Points of one object in the current frame, relative to a centre about which hypotheses rotate them.

    Attributes:
        points: (3, N) float32 metres from the centre; coordinates come first, so that arithmetic runs along long rows.
        grays: (N,) float32 grey levels for each blur.
        appearance, contrast: (N,) float32 for each channel of `AppearanceFeatures`.
    """

    points: Float32Array
    grays: tuple[Float32Array, ...]
    appearance: tuple[Float32Array, ...]
    contrast: tuple[Float32Array, ...]

    @classmethod
    def take(cls, pair: FramePair, rows: IndexArray, columns: IndexArray, center: Float64Array) -> BatchSource:
        """The points of some pixels, which have depth.

        Args:
            pair: the frames.
            rows, columns: (N,) of the pixels.
            center: (3,) metres.
        """
        curr = pair.curr
        points = curr.points[rows, columns] - np.asarray(center, dtype=np.float32)
        channels, contrast = curr.appearance.channels, curr.appearance.contrast
        return cls(
            np.ascontiguousarray(points.T),
            tuple(image[rows, columns] for image in curr.blurred),
            tuple(channel[rows, columns] for channel in channels),
            tuple(channel[rows, columns] for channel in contrast),
        )

    def first(self, count: int) -> BatchSource:
        """The first points."""
        return BatchSource(
            np.ascontiguousarray(self.points[:, :count]),
            *(tuple(values[:count] for values in part) for part in (self.grays, self.appearance, self.contrast)),
        )


class BatchPixels(NamedTuple):
    """Where points fall in the previous image under many motions, all (K, N).

    Attributes:
        u, v: float32 pixels; 0 where the point falls outside.
        inside: bool: whether the point has neighbouring pixels on all sides.
    """

    u: Float32Array
    v: Float32Array
    inside: BoolMask

    @classmethod
    def of(cls, points: Float32Array, inverse_depth: Float32Array, camera: Camera) -> BatchPixels:
        """The pixels of (K, 3, N) points."""
        u = points[:, 0] * inverse_depth * np.float32(camera.fx) + np.float32(camera.cx)
        v = points[:, 1] * inverse_depth * np.float32(camera.fy) + np.float32(camera.cy)
        inside = (u > 0) & (v > 0) & (u < camera.width - 1) & (v < camera.height - 1)
        u[~inside], v[~inside] = 0, 0
        return cls(u, v, inside)


def inverse_depth(points: Float32Array) -> Float32Array:
    """(K, N) reciprocal of the depth of (K, 3, N) points; that of 5 cm for nearer points and those behind."""
    return np.asarray(np.float32(1) / np.maximum(points[:, 2], np.float32(0.05)))
