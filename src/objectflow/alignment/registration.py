"""The rigid motion of one object: robust fit to matches, then refinement against the other frame's depth, colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from objectflow import geometry
from objectflow.alignment.matching import PixelMatches, gray
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import depth_sigma, match_sigma
from objectflow.geometry.normals import surface_normals
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray

TUKEY = 4.685
"""Tukey's biweight constant for 95% efficiency under Gaussian noise."""


class RegistrationTarget:
    """The previous frame, made ready to be aligned with: points, normals, colour and its gradient.

    Attributes:
        camera: the frame's camera.
        points, normals: (H, W, 3) float32; NaN where there is no depth or no surface.
        surface: (H W, 6) float32: points and normals once more, as rows that are fetched whole.
        shades: (H, W, 3) float32 for each of `GRAY_BLURS`: grey levels, and their slopes du and dv a pixel.
    """

    def __init__(self, prev: RgbdFrame) -> None:
        self.camera = prev.camera
        self.points = geometry.back_project(prev.depth, prev.camera)
        self.normals = surface_normals(prev.depth, prev.camera)
        self.surface = np.concatenate([self.points, self.normals], axis=-1).reshape(-1, 6)
        self.shades = [_with_slopes(image) for image in blurred(prev)]


GRAY_BLURS = (3.0, 1.0)
"""Pixels of blur, coarse to fine: colour then pulls over several pixels first and is exact at the end."""


class RegistrationSource(NamedTuple):
    """Points of one object in the current frame.

    Attributes:
        points: (N, 3) float32 metres.
        grays: one (N,) float32 for each of `GRAY_BLURS`.
    """

    points: Float32Array
    grays: tuple[Float32Array, ...]


@dataclass(frozen=True)
class RegistrationResult:
    """What `refine` returns.

    Attributes:
        prev_T_curr: (4, 4).
        fitness: share of the points seen in `prev` that lie on its surface to within three sigma.
        visible: share of the points that `prev` sees (not hidden, not outside, depth there).
        inlier_rmse: root mean square distance to the surface of the explained points, metres.
    """

    prev_T_curr: Float64Array
    fitness: float
    visible: float
    inlier_rmse: float


class RegistrationSources:
    """The current frame, made ready to hand out the points of one object after the other."""

    def __init__(self, curr: RgbdFrame) -> None:
        self.valid = curr.valid
        self.points = geometry.back_project(curr.depth, curr.camera)
        self.grays = blurred(curr)

    def take(self, mask: BoolMask, *, limit: int = 4000) -> RegistrationSource:
        """The points of a mask, thinned evenly to at most `limit`.

        Args:
            mask: (H, W) bool; pixels without depth are left out.
            limit: refinement needs no more points than this to be as exact as the sensor.
        """
        rows, columns = np.nonzero(mask & self.valid)
        if len(rows) > limit:
            pick = np.linspace(0, len(rows) - 1, limit).astype(int)
            rows, columns = rows[pick], columns[pick]
        return RegistrationSource(self.points[rows, columns], tuple(image[rows, columns] for image in self.grays))


def make_source(curr: RgbdFrame, mask: BoolMask, *, limit: int = 4000) -> RegistrationSource:
    """`RegistrationSources(curr).take(mask)`, where one object is all that is wanted."""
    return RegistrationSources(curr).take(mask, limit=limit)


def blurred(frame: RgbdFrame) -> list[Float32Array]:
    """(H, W) float32 grey images, one for each of `GRAY_BLURS`."""
    base = gray(frame.color).astype(np.float32)
    return [np.asarray(cv2.GaussianBlur(base, (0, 0), sigma), dtype=np.float32) for sigma in GRAY_BLURS]


def _with_slopes(image: Float32Array) -> Float32Array:
    """(H, W) -> (H, W, 3): itself, and its slopes along u and v."""
    slopes = (cv2.Sobel(image, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1)))
    return np.asarray(cv2.merge([image, *slopes]), dtype=np.float32)


def refine(
    target: RegistrationTarget,
    source: RegistrationSource,
    prev_T_curr: Float64Array,
    *,
    matches: PixelMatches | None = None,
    iterations: int = 12,
    color_weight: float = 0.5,
) -> RegistrationResult:
    """Projective point-to-plane ICP with a colour term, and matches as a third, by robust Gauss-Newton.

    Minimises over a twist `x`, applied on the left: `sum w (n.(p - q) / s)^2 + c sum w ((I_prev - I_curr) / g)^2 +
    sum w |p - m|^2 / d^2`, where p is a point carried to `prev`, q the surface point there, n its normal, m its match
    (Chen and Medioni 1992; the colour term as Steinbrucker et al. 2011).

    Args:
        target: the previous frame.
        source: the object's points in the current one.
        prev_T_curr: where to start; the basin is a few centimetres and a few pixels.
        matches: of this object, or None. They hold what a flat, dull surface leaves free.
        iterations: for each of the two blurs.
        color_weight: c; neighbouring pixels are alike, so one grey residual counts less than a depth one.
    """
    T = np.array(prev_T_curr, dtype=np.float64)
    if len(source.points) < 6:
        return RegistrationResult(T, 0.0, 0.0, float("inf"))
    places = np.ascontiguousarray(source.points.T, dtype=np.float32)
    for level, grays in enumerate(source.grays):
        for iteration in range(iterations):
            gate = max(0.03 * 0.7 ** (iteration + 4 * level), 0.008)
            H, b = _normal_equations(target, target.shades[level], places, grays, T, gate, color_weight)
            if matches is not None and len(matches.curr) >= 3:
                H_m, b_m = _match_equations(matches, T, target.camera)
                H, b = H + H_m, b + b_m
            # Levenberg's damping relative to each axis' own curvature; directions that nothing sees stay put.
            damping = 1e-4 * np.diag(H) + 1e-6 * np.trace(H) / 6 + 1e-9
            step = np.linalg.solve(H + np.diag(damping), -b)
            T = geometry.se3_exp(step) @ T
            if np.abs(step).max() < 3e-5:  # 0.03 mm: far below what a depth camera resolves
                break
    return evaluate_registration(target, source, T)


def _normal_equations(
    target: RegistrationTarget,
    shades: Float32Array,
    places: Float32Array,
    grays: Float32Array,
    T: Float64Array,
    gate: float,
    color_weight: float,
) -> tuple[Float64Array, Float64Array]:
    """The 6x6 system of the depth and the colour terms at T.

    Args:
        target: the previous frame.
        shades: one of its `shades`.
        places: (3, N) the object's points; coordinates come first here, so that all arithmetic is on long rows.
        grays: (N,) theirs, as blurred as the shades.
        T: (4, 4) `prev_T_curr`.
        gate: metres, beside the sensor's noise; farther away in depth lies another surface, or the object is hidden.
        color_weight: of the colour term.
    """
    camera = target.camera
    points = T[:3, :3].astype(np.float32) @ places + T[:3, 3, None].astype(np.float32)
    pixels, index, cell = _pixels_on_image(points, camera)
    found = target.surface.take(cell, axis=0).T
    points = points[:, index]
    offset = points - found[:3]
    sigma = depth_sigma(points[2])
    along = (offset * found[3:]).sum(axis=0)
    used = np.flatnonzero((np.abs(offset[2]) < gate + 3 * sigma) & np.isfinite(along))
    p, n, sigma = points[:, used].astype(np.float64), found[3:, used].astype(np.float64), sigma[used]
    r, direction, weight = along[used] / sigma, n / sigma, np.ones(1)
    if color_weight > 0 and len(used) > 6:
        u, v = pixels[:, index[used]]
        shade = cv2.remap(shades, u[None], v[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        there, g_u, g_v = shade[0].T.astype(np.float64)
        difference = there - grays[index[used]]
        difference -= np.median(difference)  # exposure may have changed between the frames
        noise = max(4.0, 1.4826 * float(np.median(np.abs(difference))))
        a, b = g_u * (camera.fx / noise) / p[2], g_v * (camera.fy / noise) / p[2]
        toward = np.stack([a, b, -(a * p[0] + b * p[1]) / p[2]])
        r, direction = np.concatenate([r, difference / noise]), np.concatenate([direction, toward], axis=1)
        p, weight = np.concatenate([p, p], axis=1), np.repeat([1.0, color_weight], len(used))
    J = np.concatenate([direction, _cross(p, direction)])
    weighted = J * (weight * _tukey(r))
    return weighted @ J.T, weighted @ r


def _pixels_on_image(points: Float32Array, camera: Camera) -> tuple[Float32Array, IndexArray, IndexArray]:
    """(2, N) where points (3, N) fall, which of them lie on the image, and the numbers of those ones' pixels."""
    x, y, z = points
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        pixels = np.stack([x / z * np.float32(camera.fx), y / z * np.float32(camera.fy)])
        pixels += np.array([[camera.cx], [camera.cy]], np.float32)
        column, row = np.rint(pixels)
        inside = (z > 1e-6) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    index = np.flatnonzero(inside)
    return pixels, index, row[index].astype(np.intp) * camera.width + column[index].astype(np.intp)


def _match_equations(matches: PixelMatches, T: Float64Array, camera: Camera) -> tuple[Float64Array, Float64Array]:
    """The 6x6 system of the matches' own distances at T."""
    p = geometry.transform(T, matches.curr.astype(np.float64))
    sigma = match_sigma(matches.curr[:, 2], camera).astype(np.float64)
    r = (p - matches.prev) / sigma[:, None]
    weight = _tukey(np.linalg.norm(r, axis=1))
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(p), 3, 3)), -geometry.hat(p)], axis=2) / sigma[:, None, None]
    J, weight = J.reshape(-1, 6), np.repeat(weight, 3)
    weighted = (weight[:, None] * J).T
    return weighted @ J, weighted @ r.ravel()


def evaluate_registration(
    target: RegistrationTarget, source: RegistrationSource, T: Float64Array
) -> RegistrationResult:
    """How well a motion explains the points that the previous frame sees; see `RegistrationResult`."""
    points = geometry.transform(T, source.points)
    _, index, cell = _pixels_on_image(points.T, target.camera)
    found, points = target.surface.take(cell, axis=0), points[index]
    offset = points - found[:, :3]
    sigma = depth_sigma(points[:, 2])
    seen = np.isfinite(offset[:, 2]) & (offset[:, 2] < 3 * sigma + 0.01)
    distance = np.abs((offset * found[:, 3:]).sum(-1))
    distance = np.where(np.isfinite(distance), distance, np.abs(offset[:, 2]))
    good = seen & (distance < 3 * sigma)
    if not good.any():
        return RegistrationResult(T, 0.0, float(seen.sum()) / len(source.points), float("inf"))
    return RegistrationResult(
        prev_T_curr=T,
        fitness=float(good.sum()) / float(seen.sum()),
        visible=float(seen.sum()) / len(source.points),
        inlier_rmse=float(np.sqrt(np.mean(distance[good] ** 2))),
    )


def _cross(a: Float64Array, b: Float64Array) -> Float64Array:
    """(3, N) x (3, N): np.cross in a third of the time, for a loop that lives on it."""
    (x, y, z), (u, v, w) = a, b
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u])


def _tukey(r: NDArray[np.floating]) -> Float64Array:
    scaled = np.asarray(r, dtype=np.float64) / TUKEY
    return np.where(np.abs(scaled) < 1, (1 - scaled**2) ** 2, 0.0)
