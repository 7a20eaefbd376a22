"""Lens distortion: the models of OpenCV, ROS and RealSense, between normalised rectified and distorted coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from objectflow.errors import CameraError
from objectflow.typing import Float64Array

_OPENCV = ("plumb_bob", "rational_polynomial", "brown_conrady", "opencv", "radtan", "radial-tangential")
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4", "opencv_fisheye")
_INVERSE = "inverse_brown_conrady"
_MODIFIED = "modified_brown_conrady"
_FTHETA = ("ftheta", "f-theta")
_NONE = ("", "none", "unknown")
_OPENCV_LENGTHS = (4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV's model may have."""
MAX_COEFFICIENT = 1e6
"""Largest distortion coefficient: those of real lenses are below a thousand, and damaged ones overflow."""
_ITERATIONS = 50
"""Number of fixed-point steps that invert a model without a closed form."""


@dataclass(frozen=True)
class Lens:
    """Distortion of a lens.

    Coordinates are normalised: x = (u - cx) / fx and y = (v - cy) / fy, where a rectified point is (X / Z, Y / Z).

    Attributes:
        model: "opencv" (k1 k2 p1 p2 k3 ..., OpenCV's `projectPoints`), "fisheye" (k1 .. k4, OpenCV's `fisheye`),
            "inverse_brown_conrady" and "modified_brown_conrady" (k1 k2 p1 p2 k3) or "ftheta" (one coefficient), the
            last three as librealsense defines them in `rs_util.h`.
        coefficients: of the model.
    """

    model: str
    coefficients: tuple[float, ...]

    def distort(self, points: Float64Array) -> Float64Array:
        """Rectified points (N, 2) -> the points (N, 2) at which the lens images them."""
        if self.model == "opencv":
            rays = np.column_stack([points, np.ones(len(points))])
            moved, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(self.coefficients))
            return np.asarray(moved, dtype=np.float64).reshape(-1, 2)
        if self.model == "fisheye":
            found = cv2.fisheye.distortPoints(points[:, None], np.eye(3), np.array(self.coefficients))
            return np.asarray(found, dtype=np.float64).reshape(-1, 2)
        if self.model == "inverse_brown_conrady":
            return self._invert(points)
        return _modified_brown_conrady(points, self.coefficients) if self.model == _MODIFIED else self._ftheta(points)

    def _invert(self, points: Float64Array) -> Float64Array:
        """Points whose image under OpenCV's model is `points`: the inverse model is OpenCV's from image to ray."""
        forward = Lens("opencv", self.coefficients)
        found = points.copy()
        for _ in range(_ITERATIONS):
            found += points - forward.distort(found)
        return found

    def _ftheta(self, points: Float64Array) -> Float64Array:
        radius = np.linalg.norm(points, axis=1, keepdims=True)
        omega = self.coefficients[0]
        distorted = np.arctan(2 * radius * np.tan(omega / 2)) / omega
        return np.asarray(points * np.divide(distorted, radius, out=np.ones_like(radius), where=radius > 0))

    def largest_radius(self, limit: float) -> float:
        """Radius up to which larger rectified radii are imaged at larger radii, at most `limit`.

        Polynomials fold back beyond the angle for which they were fitted.
        """
        radii = np.linspace(0, limit, 1000)
        points = np.column_stack([radii, np.zeros_like(radii)])
        imaged = np.linalg.norm(self.distort(points), axis=1)
        back = np.flatnonzero(~(np.diff(imaged) > 0))
        return float(radii[back[0]]) if len(back) else limit


def make_lens(model: str, coefficients: tuple[float, ...]) -> Lens | None:
    """The lens of a distortion model by its name in `sensor_msgs/CameraInfo` or in a camera file; None for a pinhole.

    Args:
        model: such as "plumb_bob", "rational_polynomial" or "equidistant".
        coefficients: of the model.

    Raises:
        CameraError: an unknown model, or coefficients that do not fit it.
    """
    # librealsense's Python binding prints `distortion.brown_conrady`.
    name = model.strip().lower().replace(" ", "_").removeprefix("distortion.")
    values = tuple(float(value) for value in coefficients)
    if not np.isfinite(values).all():
        raise CameraError(f"distortion coefficients must be finite, not {values}")
    if max(map(abs, values), default=0.0) > MAX_COEFFICIENT:
        raise CameraError(f"distortion coefficients must be at most {MAX_COEFFICIENT:g}, not {values}")
    is_fisheye = name in _FISHEYE
    if not values or (not any(values) and not is_fisheye):
        return None
    if name in _NONE:
        name = "plumb_bob"
    if is_fisheye and len(values) >= 4:
        return Lens("fisheye", values[:4])
    if name in _OPENCV:
        length = next((length for length in _OPENCV_LENGTHS if length >= len(values)), None)
        if length is not None:
            return Lens("opencv", values + (0.0,) * (length - len(values)))
    if name in (_INVERSE, _MODIFIED) and len(values) >= 5:
        return Lens(name, values[:5])
    if name in _FTHETA:
        return Lens("ftheta", values[:1])
    raise CameraError(
        f"the distortion model {model!r} with {len(values)} coefficients is not known: rectify the images first "
        "(image_proc)"
    )


def _modified_brown_conrady(points: Float64Array, coefficients: tuple[float, ...]) -> Float64Array:
    """The tangential terms of this model are computed after the radial ones."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = np.sum(points**2, axis=1)
    x, y = points.T * (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3)
    return np.column_stack([x + 2 * p1 * x * y + p2 * (r2 + 2 * x**2), y + 2 * p2 * x * y + p1 * (r2 + 2 * y**2)])
