"""The cheap part of the checks, for every run: units, registration, repeated images."""

from __future__ import annotations

import numpy as np

from objectflow.diagnosis import depth as depth_checks
from objectflow.diagnosis.finding import Finding
from objectflow.diagnosis.pair import MAX_WIDTH, MIN_GAIN, check_identical, check_registration
from objectflow.diagnosis.registration import estimate_offset
from objectflow.frame import RgbdFrame

SCREENING_WIDTH = 320
"""Width at which an offset of depth is looked for first, pixels."""
MIN_SCREENED_OFFSET = 2.0
"""Offset at that width above which the full check of the registration runs, pixels."""


def examine_quickly(prev: RgbdFrame, curr: RgbdFrame) -> list[Finding]:
    """Check units, registration and repeated images, in a fraction of the time of `examine`.

    Args:
        prev, curr: the frames.

    Returns:
        The suspicious findings alone.
    """
    findings = [depth_checks.check_range(curr, "current"), check_identical(prev, curr)]
    if _may_be_shifted(prev) and _may_be_shifted(curr):
        scale = max(1.0, prev.camera.width / MAX_WIDTH)
        small = prev.downscaled_to_width(MAX_WIDTH), curr.downscaled_to_width(MAX_WIDTH)
        findings.append(check_registration(*small, scale))
    return [finding for finding in findings if finding.level == "suspicious"]


def _may_be_shifted(frame: RgbdFrame) -> bool:
    offset = estimate_offset(frame.downscaled_to_width(SCREENING_WIDTH))
    return offset is not None and np.hypot(offset.du, offset.dv) >= MIN_SCREENED_OFFSET and offset.gain > MIN_GAIN
