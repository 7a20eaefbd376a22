"""All checks of a pair: each frame alone, registration, identical or swapped images, exposure, amount of motion."""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow import geometry
from objectflow.alignment import matching
from objectflow.alignment.appearance import to_gray
from objectflow.alignment.camera_estimate import CameraEstimate, estimate_camera
from objectflow.alignment.frame_pair import FramePair
from objectflow.alignment.light_change import LightChange
from objectflow.diagnosis import depth as depth_checks
from objectflow.diagnosis.finding import Finding
from objectflow.diagnosis.registration import edge_alignment, estimate_offset
from objectflow.diagnosis.settings import DiagnosisSettings, RegistrationCheckSettings
from objectflow.errors import FrameError
from objectflow.frame import RgbdFrame, check_pair
from objectflow.geometry.depth_noise import STRUCTURED_LIGHT
from objectflow.methods import moving_camera
from objectflow.typing import BoolMask, Float64Array

DEFAULTS = DiagnosisSettings()


def examine(
    prev: RgbdFrame, curr: RgbdFrame, *, seed: int = 0, settings: DiagnosisSettings = DEFAULTS
) -> list[Finding]:
    """Check two frames for common input errors.

    Args:
        prev, curr: the frames.
        seed: of the random samples.
        settings: see there.

    Returns:
        One finding per check, in a fixed order; suspicious findings state a remedy.

    Raises:
        FrameError: the frames differ in size or intrinsics.
    """
    check_pair(prev, curr)
    scale = max(1.0, prev.camera.width / settings.width)
    prev, curr = prev.downscaled_to_width(settings.width), curr.downscaled_to_width(settings.width)
    rng = np.random.default_rng(seed)
    findings = [depth_checks.check_field_of_view(curr.camera)]
    for frame, name in ((prev, "previous"), (curr, "current")):
        findings += [
            depth_checks.check_range(frame, name, settings.depth),
            depth_checks.check_holes(frame, name, settings.depth),
            depth_checks.check_steps(frame, name, settings.depth),
            depth_checks.check_planar(frame, name, rng),
        ]
    findings.append(check_registration(prev, curr, scale, settings.registration))
    identical = check_identical(prev, curr)
    findings.append(identical)
    if identical.level == "fine":
        camera = estimate_camera(FramePair(prev, curr), seed=seed)
        findings.append(_exposure(prev, curr, camera.light))
        if camera.state == "unknown":
            text = "no motion of the camera explains most of the image: take frames closer in time"
            return [*findings, Finding("camera motion", "suspicious", text)]
        findings.append(_noise(camera))
        if camera.prev_T_curr is None:
            findings.append(_swapped(prev, curr))
        findings += _motion(prev, curr, camera.prev_T_curr)
    return findings


def check_registration(prev: RgbdFrame, curr: RgbdFrame, scale: float, settings: RegistrationCheckSettings) -> Finding:
    """Check that depth is registered to colour; both frames must agree, as texture may mislead a single frame.

    Args:
        prev, curr: the frames.
        scale: original pixels per pixel of the frames, for the message.
        settings: thresholds.
    """
    offsets = [estimate_offset(frame, settings) for frame in (prev, curr)]
    if offsets[0] is None or offsets[1] is None:
        return Finding("registration", "note", "too few depth edges to tell whether depth is registered to colour")
    a, b = offsets[0], offsets[1]
    agree = abs(a.du - b.du) <= 2 and abs(a.dv - b.dv) <= 2
    clear = min(a.gain, b.gain) > settings.min_gain and min(a.prominence, b.prominence) > settings.min_prominence
    du, dv = scale * (a.du + b.du) / 2, scale * (a.dv + b.dv) / 2
    if agree and clear and np.hypot(du, dv) >= 2 * scale:
        text = (
            f"depth matches colour better when shifted by ({du:+.0f}, {dv:+.0f}) pixels: "
            "register depth to colour (align_depth in a camera's driver)"
        )
        return Finding("registration", "suspicious", text)
    return Finding("registration", "fine", "depth edges coincide with colour edges")


def check_identical(prev: RgbdFrame, curr: RgbdFrame) -> Finding:
    """Check that no image of the previous frame is repeated in the current one."""
    for attribute, name in (("color", "colour"), ("depth", "depth")):
        if np.array_equal(getattr(prev, attribute), getattr(curr, attribute)):
            return Finding("two frames", "suspicious", f"the {name} images of the two frames are identical")
    return Finding("two frames", "fine", "the frames differ")


def _swapped(prev: RgbdFrame, curr: RgbdFrame) -> Finding:
    """Check whether each colour image matches the other frame's depth better than its own.

    Only pixels whose depth changed are compared. The check requires a static camera: a moving one changes the depth
    of nearly all pixels.
    """
    changed = (prev.depth > 0) & (curr.depth > 0) & (np.abs(prev.depth - curr.depth) > 0.02 * curr.depth + 0.01)
    if changed.sum() < 200:
        text = "too little motion to tell whether colour and depth were taken at the same time"
        return Finding("swapped", "note", text)
    own = _alignment_within(prev, prev, changed) + _alignment_within(curr, curr, changed)
    swapped = _alignment_within(prev, curr, changed) + _alignment_within(curr, prev, changed)
    if np.isfinite(own) and np.isfinite(swapped) and swapped > 1.25 * own:
        text = (
            "colour matches the other frame's depth better than its own: are the two colour or the two depth images "
            "swapped, or does depth lag behind colour?"
        )
        return Finding("swapped", "suspicious", text)
    return Finding("swapped", "fine", "colour matches its own depth")


def _alignment_within(color_of: RgbdFrame, depth_of: RgbdFrame, changed: BoolMask) -> float:
    kept = np.where(changed, depth_of.depth, 0).astype(np.float32)
    try:
        return edge_alignment(dataclasses.replace(color_of, depth=kept))
    except FrameError:
        return float("nan")


def _noise(camera: CameraEstimate) -> Finding:
    """Report the noise of the depth, measured where the colour did not change, at the median depth."""
    depth = camera.pair.curr.frame.depth
    z = float(np.median(depth[depth > 0]))
    sigma = 1000 * float(camera.pair.noise.sigma(z))
    return Finding("depth noise", "fine", f"standard deviation {sigma:.1f} mm at {z:.2f} m")


def _exposure(prev: RgbdFrame, curr: RgbdFrame, light: LightChange | None) -> Finding:
    means = [float(frame.color.mean()) for frame in (prev, curr)]
    ratio = (means[1] + 1) / (means[0] + 1)
    text = f"mean intensity {means[0]:.0f}, then {means[1]:.0f}"
    if not 0.75 < ratio < 1.33:
        return Finding("exposure", "suspicious", f"{text}: fix exposure, gain and white balance")
    if min(means) < 3 or max(means) > 250:
        return Finding("exposure", "suspicious", f"{text}: too dark or too bright for matching")
    if light is not None:
        return Finding("exposure", "note", f"{text}: {light.words()}; methods match the colours")
    return Finding("exposure", "fine", text)


def _motion(prev: RgbdFrame, curr: RgbdFrame, prev_T_curr: Float64Array | None) -> list[Finding]:
    """Report the camera's motion and the amount of remaining motion."""
    findings = []
    stabilised: RgbdFrame | None = prev
    if prev_T_curr is None:
        findings.append(Finding("camera motion", "fine", "the camera is static, or its motion is below the noise"))
    else:
        shift = 100 * float(np.linalg.norm(prev_T_curr[:3, 3]))
        angle = float(np.degrees(geometry.rotation_angle(prev_T_curr[:3, :3])))
        text = f"the camera moved by {shift:.1f} cm and {angle:.1f} degrees: --camera auto compensates for it"
        findings.append(Finding("camera motion", "note", text))
        stabilised = moving_camera.as_seen_from(prev, prev_T_curr, curr.camera)
    if stabilised is None:
        text = "the frames do not overlap: take frames closer in time"
        return [*findings, Finding("amount of motion", "suspicious", text)]
    both = (stabilised.depth > 0) & (curr.depth > 0)
    sigma = STRUCTURED_LIGHT.sigma(curr.depth)
    changed = both & (np.abs(stabilised.depth - curr.depth) > 4 * sigma + 0.004)
    share = float(changed.sum()) / max(1, int(both.sum()))
    _, consistent = matching.dense_flow(to_gray(stabilised.color), to_gray(curr.color))
    matched = float(consistent[both].mean()) if both.any() else 0.0
    text = f"depth changed on {share:.1%} of the pixels; optical flow is consistent on {matched:.0%}"
    if matched < 0.4:
        return [*findings, Finding("amount of motion", "suspicious", f"{text}: take frames closer in time")]
    if share < 0.001:
        text += ": nothing moved by more than the noise; take frames further apart (--every)"
        return [*findings, Finding("amount of motion", "note", text)]
    return [*findings, Finding("amount of motion", "fine", text)]
