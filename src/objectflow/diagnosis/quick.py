"""The cheap part of the checks, for every run: units, registration, repeated images."""

from __future__ import annotations

import numpy as np

from objectflow.diagnosis import depth as depth_checks
from objectflow.diagnosis.finding import Finding
from objectflow.diagnosis.pair import check_identical, check_registration
from objectflow.diagnosis.registration import estimate_offset
from objectflow.diagnosis.settings import DiagnosisSettings
from objectflow.frame import RgbdFrame

DEFAULTS = DiagnosisSettings()


def examine_quickly(prev: RgbdFrame, curr: RgbdFrame, *, settings: DiagnosisSettings = DEFAULTS) -> list[Finding]:
    """Check units, registration and repeated images, in a fraction of the time of `examine`.

    Args:
        prev, curr: the frames.
        settings: see there.

    Returns:
        The suspicious findings alone.
    """
    findings = [depth_checks.check_range(curr, "current", settings.depth), check_identical(prev, curr)]
    if _may_be_shifted(prev, settings) and _may_be_shifted(curr, settings):
        scale = max(1.0, prev.camera.width / settings.width)
        small = prev.downscaled_to_width(settings.width), curr.downscaled_to_width(settings.width)
        findings.append(check_registration(*small, scale, settings.registration))
    return [finding for finding in findings if finding.level == "suspicious"]


def _may_be_shifted(frame: RgbdFrame, settings: DiagnosisSettings) -> bool:
    offset = estimate_offset(frame.downscaled_to_width(settings.quick.width), settings.registration)
    if offset is None or offset.gain <= settings.registration.min_gain:
        return False
    return bool(np.hypot(offset.du, offset.dv) >= settings.quick.min_offset)
