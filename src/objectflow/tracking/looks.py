"""The looks of an object: features on its surface, by which it is found again anywhere in a frame."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np

from objectflow import geometry
from objectflow.alignment.fitting import FitSettings, fit_matches
from objectflow.alignment.matching import MatchSettings, PixelMatches, match_descriptors, sample_depth
from objectflow.alignment.prepared_frame import Keypoints, PreparedFrame
from objectflow.geometry.depth_noise import DepthNoise
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, Float64Array, UInt8Array

_LEVELS = 255
"""Levels of a stored descriptor's entries, which lie in 0..1."""


@dataclass(frozen=True)
class LooksSettings(Settings):
    """Which features are kept, and when they find an object again."""

    matching: MatchSettings = MatchSettings()
    """Detection and matching of the features; those of pairs with the same settings are used again."""
    max_features: int = setting(300, minimum=3)
    """Maximum number of features per object; the latest ones are kept."""
    max_similarity: float = setting(0.9, minimum=0, maximum=1)
    """Scalar product of two unit descriptors from which a feature is known already."""
    fit: FitSettings = FitSettings(trials=100)
    """The fit of a pose to the matches."""
    min_inliers: int = setting(6, minimum=3)
    """Minimum number of matches that agree on a pose."""


class Looks:
    """RootSIFT features on the surface of an object. It can be pickled, and its size is bounded."""

    def __init__(self) -> None:
        self._points: Float32Array = np.zeros((0, 3), np.float32)
        self._words: UInt8Array = np.zeros((0, 128), np.uint8)

    def __len__(self) -> int:
        """The number of features."""
        return len(self._points)

    def add(
        self, frame: PreparedFrame, mask: BoolMask, camera_T_object: Float64Array, settings: LooksSettings
    ) -> None:
        """Add the features in a mask that are not known yet.

        Args:
            frame: colour and depth.
            mask: (H, W) bool, of the size of the frame.
            camera_T_object: (4, 4) the object's pose.
            settings: see there.
        """
        pixels, words = _features(frame, settings)
        depth, valid = sample_depth(frame.frame.depth, pixels, settings.matching)
        column, row = np.rint(pixels).astype(np.int64).T
        valid &= mask[np.clip(row, 0, mask.shape[0] - 1), np.clip(column, 0, mask.shape[1] - 1)]
        if not valid.any():
            return
        points = geometry.back_project_pixels(pixels[valid], depth[valid], frame.frame.camera)
        words = words[valid]
        if len(self):
            new = (words @ self._descriptors().T).max(axis=1) < settings.max_similarity
            points, words = points[new], words[new]
        own = geometry.transform(geometry.inverse(camera_T_object), points.astype(np.float64)).astype(np.float32)
        quantised = np.rint(words * _LEVELS).astype(np.uint8)
        self._points = np.concatenate([self._points, own])[-settings.max_features :]
        self._words = np.concatenate([self._words, quantised])[-settings.max_features :]

    def add_all(self, other: Looks, own_T_other: Float64Array, max_features: int) -> None:
        """Add the features of another object that belongs to this one.

        Args:
            other: its features.
            own_T_other: (4, 4) from its frame to that of this object.
            max_features: maximum number of features, of which the latest are kept.
        """
        points = geometry.transform(own_T_other, other._points.astype(np.float64)).astype(np.float32)
        self._points = np.concatenate([self._points, points])[-max_features:]
        self._words = np.concatenate([self._words, other._words])[-max_features:]

    def find(
        self, frame: PreparedFrame, noise: DepthNoise, settings: LooksSettings, mask: BoolMask | None = None
    ) -> Float64Array | None:
        """Search the object in a frame.

        Args:
            frame: colour and depth.
            noise: of the depth.
            settings: see there.
            mask: (H, W) bool of the pixels that are searched; None for all.

        Returns:
            (4, 4) `camera_T_object`, or None where too few features agree.
        """
        pixels, words = _features(frame, settings)
        if mask is not None and len(pixels):
            column, row = np.rint(pixels).astype(np.int64).T
            inside = mask[np.clip(row, 0, mask.shape[0] - 1), np.clip(column, 0, mask.shape[1] - 1)]
            pixels, words = pixels[inside], words[inside]
        if len(pixels) < settings.min_inliers or len(self) < settings.min_inliers:
            return None
        here, known = match_descriptors(words, self._descriptors(), settings.matching.max_descriptor_ratio)
        depth, valid = sample_depth(frame.frame.depth, pixels[here], settings.matching)
        here, known, depth = here[valid], known[valid], depth[valid]
        if len(here) < settings.min_inliers:
            return None
        points = geometry.back_project_pixels(pixels[here], depth, frame.frame.camera)
        matches = PixelMatches(pixels[here], points, self._points[known])
        object_T_camera, inliers = fit_matches(matches, frame.frame.camera, noise=noise, settings=settings.fit)
        return geometry.inverse(object_T_camera) if inliers.sum() >= settings.min_inliers else None

    def _descriptors(self) -> Float32Array:
        """(N, 128) float32 of unit length."""
        words = self._words.astype(np.float32)
        return np.asarray(words / (np.linalg.norm(words, axis=1, keepdims=True) + 1e-7))


def start_features(frame: PreparedFrame, settings: LooksSettings, after: Sequence[Future[Any]] = ()) -> None:
    """Start to detect the features of a frame in a side thread; see `PreparedFrame.start_keypoints`."""
    matching = settings.matching
    frame.at_width(matching.feature_width).start_keypoints(matching.max_features, matching.min_contrast, after)


def _features(frame: PreparedFrame, settings: LooksSettings) -> Keypoints:
    """The features of a frame, with pixels of the frame's own size."""
    matching = settings.matching
    small = frame.at_width(matching.feature_width)
    found = small.keypoints(matching.max_features, matching.min_contrast)
    scale = np.float32(frame.frame.camera.width / small.frame.camera.width)
    return Keypoints((found.pixels + np.float32(0.5)) * scale - np.float32(0.5), found.descriptors)
