"""One frame with everything that alignment needs of it, each part computed when it is first used, and once."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, wait
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment.appearance import AppearanceFeatures, to_gray
from objectflow.frame import RgbdFrame
from objectflow.geometry.normals import surface_normals
from objectflow.runtime.side_threads import has_side_threads, start_beside
from objectflow.typing import BoolMask, Float32Array, UInt8Array

GRAY_BLURS = (3.0, 1.0)
"""Standard deviations in pixels of the blurred grey images, coarse to fine: a coarse image has a wide basin of
convergence, a fine one is exact."""


class Keypoints(NamedTuple):
    """SIFT features (Lowe, IJCV 2004) with RootSIFT descriptors (Arandjelovic and Zisserman, CVPR 2012).

    Attributes:
        pixels: (N, 2) float32 (u, v).
        descriptors: (N, 128) float32 of unit length.
    """

    pixels: Float32Array
    descriptors: Float32Array


class PreparedFrame:
    """A frame, its downscaled versions, and what is derived from its images.

    Attributes:
        frame: the frame itself.
        memo: what methods compute of the frame once, by their own keys.
    """

    def __init__(self, frame: RgbdFrame) -> None:
        self.frame = frame
        self.memo: dict[object, Any] = {}
        self._resized: dict[tuple[int, int], PreparedFrame] = {}
        self._keypoints: dict[tuple[int, float], Keypoints | Future[Keypoints]] = {}

    @classmethod
    def of(cls, frame: RgbdFrame | PreparedFrame) -> PreparedFrame:
        """The frame prepared; a prepared one as it is."""
        return frame if isinstance(frame, PreparedFrame) else cls(frame)

    def at_width(self, width: int) -> PreparedFrame:
        """The frame downscaled to a width in pixels; itself where it is no wider."""
        camera = self.frame.camera
        if camera.width <= width:
            return self
        return self.resized(width, max(1, round(camera.height * width / camera.width)))

    def resized(self, width: int, height: int) -> PreparedFrame:
        """The frame at another size, in pixels."""
        if (height, width) == self.frame.depth.shape:
            return self
        if (width, height) not in self._resized:
            self._resized[width, height] = PreparedFrame(self.frame.resized(width, height))
        return self._resized[width, height]

    @property
    def valid(self) -> BoolMask:
        """(H, W) bool: pixels with depth."""
        return self.frame.valid

    @cached_property
    def points(self) -> Float32Array:
        """(H, W, 3) metres in the camera frame; NaN where depth is missing."""
        return geometry.back_project(self.frame.depth, self.frame.camera)

    @cached_property
    def normals(self) -> Float32Array:
        """(H, W, 3) unit normals toward the camera; NaN on holes and across depth edges."""
        return surface_normals(self.frame.depth, self.frame.camera)

    @cached_property
    def gray(self) -> UInt8Array:
        """(H, W) grey levels."""
        return to_gray(self.frame.color)

    @cached_property
    def blurred(self) -> tuple[Float32Array, ...]:
        """(H, W) grey levels, blurred by each of `GRAY_BLURS`."""
        base = self.gray.astype(np.float32)
        return tuple(np.asarray(cv2.GaussianBlur(base, (0, 0), sigma), dtype=np.float32) for sigma in GRAY_BLURS)

    @cached_property
    def surface(self) -> Float32Array:
        """(H W, 6) float32: points and normals side by side, so that one gather fetches both."""
        return np.concatenate([self.points, self.normals], axis=-1).reshape(-1, 6)

    @cached_property
    def shades(self) -> tuple[Float32Array, ...]:
        """(H, W, 3) for each blur: grey levels and their gradient per pixel along u and v."""
        return tuple(_with_gradient(image) for image in self.blurred)

    @cached_property
    def appearance(self) -> AppearanceFeatures:
        """Colour in channels that change little with the light."""
        return AppearanceFeatures(self.frame.color)

    def keypoints(self, max_features: int, min_contrast: float) -> Keypoints:
        """SIFT features of the grey image.

        Args:
            max_features: number of features, of the strongest, that are kept.
            min_contrast: SIFT's contrast threshold.
        """
        key = max_features, min_contrast
        found = self._keypoints.get(key)
        if found is None:
            found = _detect(self.gray, max_features, min_contrast)
        elif isinstance(found, Future):
            found = found.result()
        self._keypoints[key] = found
        return found

    def start_keypoints(self, max_features: int, min_contrast: float, after: Sequence[Future[Any]] = ()) -> None:
        """Start to detect the features of `keypoints` in a side thread, where there are any.

        Args:
            max_features, min_contrast: see `keypoints`.
            after: works that are more urgent; detection waits for them.
        """
        key = max_features, min_contrast
        if key in self._keypoints or not has_side_threads():
            return
        gray = self.gray

        def detect() -> Keypoints:
            wait(after)
            return _detect(gray, max_features, min_contrast)

        self._keypoints[key] = start_beside(detect)


def _with_gradient(image: Float32Array) -> Float32Array:
    """(H, W) -> (H, W, 3): the image and its gradient along u and v."""
    gradient = (cv2.Sobel(image, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1)))
    return np.asarray(cv2.merge([image, *gradient]), dtype=np.float32)


def _detect(gray: UInt8Array, max_features: int, min_contrast: float) -> Keypoints:
    sift = cv2.SIFT.create(nfeatures=max_features, contrastThreshold=min_contrast)
    found, words = sift.detectAndCompute(gray, None)
    if not len(found):
        return Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    root = np.sqrt(words / (words.sum(1, keepdims=True) + 1e-7))
    return Keypoints(np.array([key.pt for key in found], np.float32), np.asarray(root, dtype=np.float32))
