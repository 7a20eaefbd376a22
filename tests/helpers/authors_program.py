"""Outputs of the VO-SF authors' program for real pairs, where they lie beside the checkout."""

from __future__ import annotations

import pytest

import vo_sf_program as vo_sf_program  # noqa: PLC0414
from helpers.paths import SHARED

DATA, PROGRAM = SHARED / "data", SHARED / "reference" / "vosf"

needs_program = pytest.mark.skipif(
    not PROGRAM.is_dir() or not DATA.is_dir(), reason=f"no real pairs and program output in {SHARED}"
)
