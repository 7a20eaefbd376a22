"""What the authors' VO-SF program returned for real pairs, where it lies beside the checkout, and how to read it."""

from __future__ import annotations

import pytest

import vo_sf_program as vo_sf_program  # noqa: PLC0414
from helpers.paths import SHARED

DATA, PROGRAM = SHARED / "data", SHARED / "reference" / "vosf"

needs_program = pytest.mark.skipif(
    not PROGRAM.is_dir() or not DATA.is_dir(), reason=f"no real pairs and program output in {SHARED}"
)
