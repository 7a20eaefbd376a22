"""Checks of a single frame's depth and camera: units, holes, resolution, ray length, field of view."""

from __future__ import annotations

import numpy as np

from objectflow import geometry
from objectflow.diagnosis.finding import Finding
from objectflow.diagnosis.settings import DepthCheckSettings
from objectflow.frame import RgbdFrame
from objectflow.geometry.camera import Camera
from objectflow.typing import Float64Array


def check_range(frame: RgbdFrame, name: str, settings: DepthCheckSettings) -> Finding:
    """Check the depth scale by the median depth."""
    median = float(np.median(frame.depth[frame.valid]))
    text = f"{name}: the median depth is {median:.3g} m"
    if median < settings.min_median_depth:
        return Finding("depth units", "suspicious", f"{text}: is the depth scale too large?")
    if median > settings.max_median_depth:
        return Finding("depth units", "suspicious", f"{text}: is the depth scale too small (5000 for TUM recordings)?")
    return Finding("depth units", "fine", text)


def check_holes(frame: RgbdFrame, name: str, settings: DepthCheckSettings) -> Finding:
    """Check the share of pixels without depth."""
    share = 1 - float(frame.valid.mean())
    text = f"{name}: {share:.0%} of the pixels have no depth"
    if share > settings.max_missing_share:
        return Finding("holes", "suspicious", f"{text}: stay within the camera's range and avoid shiny surfaces")
    return Finding("holes", "fine", text)


def check_steps(frame: RgbdFrame, name: str, settings: DepthCheckSettings) -> Finding:
    """Check the resolution of depth by the number of distinct values."""
    count = len(np.unique(frame.depth[frame.valid]))
    text = f"{name}: {count} distinct depths"
    if count < settings.min_distinct_depths and np.ptp(frame.depth[frame.valid]) > 0.05:
        return Finding("depth steps", "suspicious", f"{text}: store depth as a 16-bit PNG, not as an 8-bit picture")
    return Finding("depth steps", "fine", text)


def check_field_of_view(camera: Camera) -> Finding:
    """Check that the field of view is typical of a depth camera and the principal point is near the centre."""
    angle = float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx)))
    offset = max(
        abs(camera.cx - (camera.width - 1) / 2) / camera.width,
        abs(camera.cy - (camera.height - 1) / 2) / camera.height,
    )
    text = f"{angle:.0f} degrees wide, principal point {offset:.0%} of the image size off the centre"
    if not 35 <= angle <= 110 or offset > 0.1:
        return Finding("camera", "suspicious", f"{text}: do the intrinsics belong to this camera and resolution?")
    ratio = camera.fx / camera.fy
    if abs(ratio - 1) > 0.05:
        text += f", but fx / fy = {ratio:.2f}: was the image stretched along one axis?"
        return Finding("camera", "suspicious", text)
    return Finding("camera", "fine", text)


def check_planar(frame: RgbdFrame, name: str, rng: np.random.Generator) -> Finding:
    """Check that depth is planar z and not ray length; the wrong interpretation makes planes bulge.

    The largest plane is fitted under both interpretations; the correct one is flatter.
    """
    points = geometry.back_project(frame.depth, frame.camera)[frame.valid].astype(np.float64)
    points = points[rng.permutation(len(points))[:4000]]
    rays = points / points[:, 2:]
    if len(points) < 200:
        return Finding("ray length", "note", f"{name}: too little depth to fit a plane")
    as_z, share = _plane_error(points, rng)
    if share < 0.25:
        return Finding("ray length", "note", f"{name}: no plane is large enough to tell planar z from ray length")
    # If the values were lengths along rays, planar z would be shorter by the length of (x/z, y/z, 1).
    as_length, length_share = _plane_error(points / np.linalg.norm(rays, axis=1, keepdims=True), rng)
    flatness = f"{1000 * as_z:.1f} mm as planar z, {1000 * as_length:.1f} mm as ray length"
    text = f"{name}: the largest plane is flat to {flatness}"
    if length_share > 0.25 and as_length < 0.6 * as_z and as_z - as_length > 0.0005 and length_share > 0.9 * share:
        return Finding("ray length", "suspicious", f"{text}: convert ray length to planar z")
    return Finding("ray length", "fine", text)


def _plane_error(points: Float64Array, rng: np.random.Generator) -> tuple[float, float]:
    """Median point-to-plane distance of the largest plane in metres, and its share of all points."""
    triplets = points[rng.integers(0, len(points), (200, 3))]
    normals = np.cross(triplets[:, 1] - triplets[:, 0], triplets[:, 2] - triplets[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(length, 1e-12)
    offsets = (normals * triplets[:, 0]).sum(1)
    # The inlier threshold admits bulging planes; flatness is measured afterwards.
    threshold = 0.03 * float(np.median(points[:, 2]))
    inside = np.abs(normals @ points.T - offsets[:, None]) < threshold
    inliers = inside[(inside.sum(1) * (length[:, 0] > 1e-9)).argmax()]
    for _ in range(3):
        center = points[inliers].mean(0)
        normal = np.linalg.svd(points[inliers] - center, full_matrices=False)[2][2]
        distance = np.abs((points - center) @ normal)
        inliers = distance < threshold
    return float(np.median(distance[inliers])), float(inliers.mean())
