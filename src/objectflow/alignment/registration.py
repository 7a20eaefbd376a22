"""Registration of an object to the previous frame: point-to-plane ICP with a colour term, and how well it fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from objectflow import geometry
from objectflow.alignment.matching import PixelMatches
from objectflow.alignment.prepared_frame import PreparedFrame
from objectflow.alignment.robust import median, tukey_weights
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT, DepthNoise
from objectflow.settings import Settings, setting
from objectflow.typing import BoolMask, Float32Array, Float64Array, IndexArray

TUKEY = 4.685
"""Default constant of Tukey's biweight: 95% efficiency under Gaussian noise."""


@dataclass(frozen=True)
class RegistrationSettings(Settings):
    """Convergence and weights of `refine`, and what counts as an inlier."""

    iterations: int = setting(12, minimum=1)
    """Maximum number of Gauss-Newton steps for each blur of the grey images."""
    color_weight: float = setting(0.5, minimum=0)
    """Weight of a grey residual relative to a depth residual; neighbouring grey levels are correlated."""
    first_gate: float = setting(0.03, above=0)
    """Metres: largest depth difference of a correspondence at the start, beside the noise."""
    gate_decay: float = setting(0.7, above=0, maximum=1)
    """Factor on the gate at every step."""
    last_gate: float = setting(0.008, above=0)
    """Metres: the gate never becomes smaller."""
    inlier_sigmas: float = setting(3.0, above=0)
    """Standard deviations of depth: added to the gate, and largest distance of an inlier to the surface."""
    hidden_margin: float = setting(0.01, minimum=0)
    """Metres, added to `inlier_sigmas`: a point farther behind the surface is hidden."""
    min_gray_noise: float = setting(4.0, above=0)
    """Grey levels: smallest standard deviation of grey residuals; it is otherwise measured."""
    min_step: float = setting(3e-5, minimum=0)
    """Metres and radians: the iterations end at a smaller step, which is far below a depth camera's resolution."""
    tukey: float = setting(TUKEY, above=0)
    """Standard deviations from which a residual has no weight (Tukey's biweight)."""


DEFAULTS = RegistrationSettings()


class RegistrationTarget:
    """The previous frame as the target of registration: points, normals, grey levels and their gradient.

    Attributes:
        camera: the frame's camera.
        noise: of its depth.
        points, normals: (H, W, 3) float32; NaN where there is no depth or no surface.
        surface: (H W, 6) float32: points and normals side by side, so that one gather fetches both.
        shades: (H, W, 3) float32 for each blur: grey levels and their gradient per pixel along u and v.
    """

    def __init__(self, prev: RgbdFrame | PreparedFrame, noise: DepthNoise = STRUCTURED_LIGHT) -> None:
        prev = PreparedFrame.of(prev)
        self.camera, self.noise = prev.frame.camera, noise
        self.points, self.normals = prev.points, prev.normals
        self.surface, self.shades = prev.surface, prev.shades


class RegistrationSource(NamedTuple):
    """Points of one object in the current frame.

    Attributes:
        points: (N, 3) float32 metres.
        grays: (N,) float32 grey levels for each blur.
    """

    points: Float32Array
    grays: tuple[Float32Array, ...]


@dataclass(frozen=True)
class RegistrationResult:
    """A registered motion and how well it fits.

    Attributes:
        prev_T_curr: (4, 4).
        fitness: share of the visible points that lie on the surface of `prev` to within `inlier_sigmas`.
        visible: share of the points that `prev` shows: inside the image, with depth there, and not hidden.
        inlier_rmse: metres: root mean square distance of the inliers to the surface.
    """

    prev_T_curr: Float64Array
    fitness: float
    visible: float
    inlier_rmse: float


class RegistrationSources:
    """The current frame, from which registration takes the points of an object."""

    def __init__(self, curr: RgbdFrame | PreparedFrame) -> None:
        curr = PreparedFrame.of(curr)
        self.valid, self.points, self.grays = curr.valid, curr.points, curr.blurred

    def take(self, mask: BoolMask, *, limit: int = 4000) -> RegistrationSource:
        """The points of a mask.

        Args:
            mask: (H, W) bool; pixels without depth are left out.
            limit: maximum number of points, sampled evenly; more do not make registration more exact.
        """
        rows, columns = np.nonzero(mask & self.valid)
        if len(rows) > limit:
            pick = np.linspace(0, len(rows) - 1, limit).astype(int)
            rows, columns = rows[pick], columns[pick]
        return RegistrationSource(self.points[rows, columns], tuple(image[rows, columns] for image in self.grays))


def refine(
    target: RegistrationTarget,
    source: RegistrationSource,
    prev_T_curr: Float64Array,
    *,
    matches: PixelMatches | None = None,
    settings: RegistrationSettings = DEFAULTS,
) -> RegistrationResult:
    """Projective point-to-plane ICP with terms for colour and matches, by robust Gauss-Newton.

    It minimises over a twist `x`, applied on the left: `sum w (n.(p - q) / s)^2 + c sum w ((I_prev - I_curr) / g)^2 +
    sum w |p - m|^2 / d^2`, where p is a point carried to `prev`, q the surface point there, n its normal, m its match
    (Chen and Medioni 1992; the colour term as Steinbrucker et al. 2011).

    Args:
        target: the previous frame.
        source: the object's points in the current one.
        prev_T_curr: (4, 4) initial motion; the basin of convergence is a few centimetres and a few pixels.
        matches: of this object, or None. They constrain the directions that a flat surface without texture leaves
            free.
        settings: convergence and weights; `color_weight` is c.
    """
    T = np.array(prev_T_curr, dtype=np.float64)
    if len(source.points) < 6:
        return RegistrationResult(T, 0.0, 0.0, float("inf"))
    points = np.ascontiguousarray(source.points.T, dtype=np.float32)
    for level, grays in enumerate(source.grays):
        for iteration in range(settings.iterations):
            gate = max(settings.first_gate * settings.gate_decay ** (iteration + 4 * level), settings.last_gate)
            H, b = _normal_equations(target, target.shades[level], points, grays, T, gate, settings)
            if matches is not None and len(matches.curr) >= 3:
                H_m, b_m = _match_equations(matches, T, target, settings.tukey)
                H, b = H + H_m, b + b_m
            # Levenberg's damping, relative to the curvature of each axis; unconstrained directions stay unchanged.
            damping = 1e-4 * np.diag(H) + 1e-6 * np.trace(H) / 6 + 1e-9
            step = np.linalg.solve(H + np.diag(damping), -b)
            # To first order the exponential of the twist, at a tenth of its time.
            T = geometry.make_transform(cv2.Rodrigues(step[3:])[0], step[:3]) @ T
            if np.abs(step).max() < settings.min_step:
                break
    return evaluate_registration(target, source, T, settings)


def _normal_equations(
    target: RegistrationTarget,
    shades: Float32Array,
    source: Float32Array,
    grays: Float32Array,
    T: Float64Array,
    gate: float,
    settings: RegistrationSettings,
) -> tuple[Float64Array, Float64Array]:
    """The 6x6 system of the depth and the colour terms at T.

    Args:
        target: the previous frame.
        shades: one of its `shades`.
        source: (3, N) the points of the object; coordinates come first, so that arithmetic runs along long rows.
        grays: (N,) their grey levels, equally blurred.
        T: (4, 4) `prev_T_curr`.
        gate: metres: a larger depth difference, beyond the noise, belongs to another surface or a hidden point.
        settings: weights and noise.
    """
    camera = target.camera
    points = T[:3, :3].astype(np.float32) @ source + T[:3, 3, None].astype(np.float32)
    pixels, index, cell = _pixels_on_image(points, camera)
    found = target.surface.take(cell, axis=0).T
    points = points[:, index]
    offset = points - found[:3]
    sigma = target.noise.sigma(points[2])
    along = (offset * found[3:]).sum(axis=0)
    used = np.flatnonzero((np.abs(offset[2]) < gate + settings.inlier_sigmas * sigma) & np.isfinite(along))
    count, sigma = len(used), sigma[used]
    colored = settings.color_weight > 0 and count > 6
    # Both terms side by side, filled in place: the solver spends much of its time here.
    J, r = np.empty((6, (1 + colored) * count)), np.empty((1 + colored) * count)
    p = points[:, used].astype(np.float64)
    np.divide(found[3:, used].astype(np.float64), sigma, out=J[:3, :count])
    r[:count] = along[used] / sigma
    if colored:
        u, v = pixels[:, index[used]]
        shade = cv2.remap(shades, u[None], v[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        there, g_u, g_v = shade[0].T.astype(np.float64)
        difference = there - grays[index[used]]
        difference -= median(difference)  # exposure may have changed between the frames
        noise = max(settings.min_gray_noise, 1.4826 * median(np.abs(difference)))
        a, b = g_u * (camera.fx / noise) / p[2], g_v * (camera.fy / noise) / p[2]
        J[0, count:], J[1, count:], J[2, count:] = a, b, -(a * p[0] + b * p[1]) / p[2]
        np.divide(difference, noise, out=r[count:])
    for start in range(0, len(r), max(1, count)):
        term = slice(start, start + count)
        _cross(p, J[:3, term], out=J[3:, term])
    weight = tukey_weights(r, settings.tukey)
    weight[count:] *= settings.color_weight
    weighted = J * weight
    return weighted @ J.T, weighted @ r


def _pixels_on_image(points: Float32Array, camera: Camera) -> tuple[Float32Array, IndexArray, IndexArray]:
    """(2, N) pixels of points (3, N), indices of the points inside the image, and the flat indices of their pixels."""
    x, y, z = points
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        pixels = np.stack([x / z * np.float32(camera.fx), y / z * np.float32(camera.fy)])
        pixels += np.array([[camera.cx], [camera.cy]], np.float32)
        column, row = np.rint(pixels)
        inside = (z > 1e-6) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    index = np.flatnonzero(inside)
    return pixels, index, row[index].astype(np.intp) * camera.width + column[index].astype(np.intp)


def _match_equations(
    matches: PixelMatches, T: Float64Array, target: RegistrationTarget, tukey: float
) -> tuple[Float64Array, Float64Array]:
    """The 6x6 system of the distances between matches at T."""
    p = geometry.transform(T, matches.curr.astype(np.float64))
    sigma = target.noise.match_sigma(matches.curr[:, 2], target.camera).astype(np.float64)
    r = (p - matches.prev) / sigma[:, None]
    weight = tukey_weights(np.linalg.norm(r, axis=1), tukey)
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(p), 3, 3)), -geometry.hat(p)], axis=2) / sigma[:, None, None]
    J, weight = J.reshape(-1, 6), np.repeat(weight, 3)
    weighted = (weight[:, None] * J).T
    return weighted @ J, weighted @ r.ravel()


def evaluate_registration(
    target: RegistrationTarget,
    source: RegistrationSource,
    T: Float64Array,
    settings: RegistrationSettings = DEFAULTS,
) -> RegistrationResult:
    """How well a motion fits the points that the previous frame shows; see `RegistrationResult`."""
    points = geometry.transform(T, source.points)
    _, index, cell = _pixels_on_image(points.T, target.camera)
    found, points = target.surface.take(cell, axis=0), points[index]
    offset = points - found[:, :3]
    sigma = target.noise.sigma(points[:, 2])
    seen = np.isfinite(offset[:, 2]) & (offset[:, 2] < settings.inlier_sigmas * sigma + settings.hidden_margin)
    distance = np.abs((offset * found[:, 3:]).sum(-1))
    distance = np.where(np.isfinite(distance), distance, np.abs(offset[:, 2]))
    good = seen & (distance < settings.inlier_sigmas * sigma)
    if not good.any():
        return RegistrationResult(T, 0.0, float(seen.sum()) / len(source.points), float("inf"))
    return RegistrationResult(
        prev_T_curr=T,
        fitness=float(good.sum()) / float(seen.sum()),
        visible=float(seen.sum()) / len(source.points),
        inlier_rmse=float(np.sqrt(np.mean(distance[good] ** 2))),
    )


def _cross(a: Float64Array, b: Float64Array, out: Float64Array) -> None:
    """(3, N) x (3, N): three times as fast as np.cross."""
    (x, y, z), (u, v, w) = a, b
    np.subtract(y * w, z * v, out=out[0])
    np.subtract(z * u, x * w, out=out[1])
    np.subtract(x * v, y * u, out=out[2])
