"""What two frames say together: identical, crossed, exposed differently, unregistered, how much moved."""

from __future__ import annotations

import dataclasses

import numpy as np

from objectflow import geometry
from objectflow.alignment import matching
from objectflow.alignment.frame_pair import FramePair
from objectflow.diagnosis import depth as depth_checks
from objectflow.diagnosis.finding import Finding
from objectflow.diagnosis.registration import alignment, estimate_offset
from objectflow.errors import FrameError
from objectflow.frame import RgbdFrame, check_pair
from objectflow.geometry.depth_noise import depth_sigma
from objectflow.methods import moving_camera
from objectflow.typing import BoolMask, Float64Array

WIDTH = 640
"""Pixels; wider frames are looked at in this width, and shifts told in the frames' own pixels."""
GAIN, PROMINENCE = 1.12, 4.0
"""From when on a shift of depth is believed; see `registration.Offset`."""


def examine(prev: RgbdFrame, curr: RgbdFrame, *, seed: int = 0) -> list[Finding]:
    """Look at two frames and say what is suspicious.

    Args:
        prev, curr: the frames.
        seed: of the random samples.

    Returns:
        One finding a check, in a fixed order; suspicious ones say what to do.

    Raises:
        FrameError: the frames differ in size or intrinsics.
    """
    check_pair(prev, curr)
    scale = max(1.0, prev.camera.width / WIDTH)
    prev, curr = prev.downscaled_to_width(WIDTH), curr.downscaled_to_width(WIDTH)
    rng = np.random.default_rng(seed)
    findings = [depth_checks.check_field_of_view(curr.camera)]
    for frame, name in ((prev, "previous"), (curr, "current")):
        findings += [
            depth_checks.check_range(frame, name),
            depth_checks.check_holes(frame, name),
            depth_checks.check_steps(frame, name),
            depth_checks.check_planar(frame, name, rng),
        ]
    findings.append(_registration(prev, curr, scale))
    same = _identical(prev, curr)
    findings.append(same)
    if same.level == "fine":
        prev_T_curr = moving_camera.find_camera_motion(FramePair(prev, curr), seed=seed)
        findings.append(_exposure(prev, curr))
        if prev_T_curr is None:
            findings.append(_crossed(prev, curr))
        findings += _motion(prev, curr, prev_T_curr)
    return findings


def _registration(prev: RgbdFrame, curr: RgbdFrame, scale: float) -> Finding:
    """Both frames must agree: an object's print may fool one of them."""
    offsets = [estimate_offset(frame) for frame in (prev, curr)]
    if offsets[0] is None or offsets[1] is None:
        return Finding("registration", "note", "too few depth edges to tell whether depth is registered to colour")
    a, b = offsets[0], offsets[1]
    agree = abs(a.du - b.du) <= 2 and abs(a.dv - b.dv) <= 2
    clear = min(a.gain, b.gain) > GAIN and min(a.prominence, b.prominence) > PROMINENCE
    du, dv = scale * (a.du + b.du) / 2, scale * (a.dv + b.dv) / 2
    if agree and clear and np.hypot(du, dv) >= 2 * scale:
        text = (
            f"depth fits the colour better when shifted by ({du:+.0f}, {dv:+.0f}) pixels: "
            "register depth to colour (align_depth in a camera's driver)"
        )
        return Finding("registration", "suspicious", text)
    return Finding("registration", "fine", "depth edges lie on colour edges, as far as there are any")


def _identical(prev: RgbdFrame, curr: RgbdFrame) -> Finding:
    for one, name in (("color", "colour"), ("depth", "depth")):
        if np.array_equal(getattr(prev, one), getattr(curr, one)):
            return Finding("two frames", "suspicious", f"the {name} of both frames is one and the same image")
    return Finding("two frames", "fine", "the frames differ")


def _crossed(prev: RgbdFrame, curr: RgbdFrame) -> Finding:
    """Colour of one moment with depth of the other: then each colour fits the other frame's depth better.

    Only where depth differs does it matter which of the two is taken. For a still camera only: before a moving one
    nearly all of it differs.
    """
    changed = (prev.depth > 0) & (curr.depth > 0) & (np.abs(prev.depth - curr.depth) > 0.02 * curr.depth + 0.01)
    if changed.sum() < 200:
        return Finding("crossed", "note", "too little moved to tell whether colour and depth are of the same moment")
    straight = _alignment_within(prev, prev, changed) + _alignment_within(curr, curr, changed)
    crossed = _alignment_within(prev, curr, changed) + _alignment_within(curr, prev, changed)
    if np.isfinite(straight) and np.isfinite(crossed) and crossed > 1.25 * straight:
        text = (
            "colour fits the other frame's depth better than its own: are color0 and color1, or the depths, swapped, "
            "or does depth lag behind colour?"
        )
        return Finding("crossed", "suspicious", text)
    return Finding("crossed", "fine", "colour fits its own depth")


def _alignment_within(color_of: RgbdFrame, depth_of: RgbdFrame, changed: BoolMask) -> float:
    kept = np.where(changed, depth_of.depth, 0).astype(np.float32)
    try:
        return alignment(dataclasses.replace(color_of, depth=kept))
    except FrameError:
        return float("nan")


def _exposure(prev: RgbdFrame, curr: RgbdFrame) -> Finding:
    means = [float(frame.color.mean()) for frame in (prev, curr)]
    ratio = (means[1] + 1) / (means[0] + 1)
    text = f"mean grey {means[0]:.0f}, then {means[1]:.0f}"
    if not 0.75 < ratio < 1.33:
        return Finding("exposure", "suspicious", f"{text}: fix exposure, gain and white balance")
    if min(means) < 3 or max(means) > 250:
        return Finding("exposure", "suspicious", f"{text}: too dark or too bright to match anything")
    return Finding("exposure", "fine", text)


def _motion(prev: RgbdFrame, curr: RgbdFrame, prev_T_curr: Float64Array | None) -> list[Finding]:
    """The camera's motion, and how much of the rest moved."""
    findings = []
    seen: RgbdFrame | None = prev
    if prev_T_curr is None:
        findings.append(Finding("camera motion", "fine", "the camera stood still, or by less than the noise"))
    else:
        shift = 100 * float(np.linalg.norm(prev_T_curr[:3, 3]))
        turn = float(np.degrees(geometry.rotation_angle(prev_T_curr[:3, :3])))
        text = f"the camera moved, by {shift:.1f} cm and {turn:.1f} degrees: methods take it out (--camera auto)"
        findings.append(Finding("camera motion", "note", text))
        seen = moving_camera.as_seen_from(prev, prev_T_curr, curr.camera)
    if seen is None:
        text = "the frames have nothing in common: take frames closer in time"
        return [*findings, Finding("amount of motion", "suspicious", text)]
    both = (seen.depth > 0) & (curr.depth > 0)
    sigma = depth_sigma(curr.depth)
    changed = both & (np.abs(seen.depth - curr.depth) > 4 * sigma + 0.004)
    share = float(changed.sum()) / max(1, int(both.sum()))
    _, consistent = matching.dense_flow(matching.gray(seen.color), matching.gray(curr.color))
    followed = float(consistent[both].mean()) if both.any() else 0.0
    text = f"depth changed on {share:.1%} of the pixels; optical flow follows {followed:.0%} of them"
    if followed < 0.4:
        return [*findings, Finding("amount of motion", "suspicious", f"{text}: take frames closer in time")]
    if share < 0.001:
        text += ": nothing moved by more than the noise; take frames further apart (--every)"
        return [*findings, Finding("amount of motion", "note", text)]
    return [*findings, Finding("amount of motion", "fine", text)]
