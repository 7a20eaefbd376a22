"""What the authors' VO-SF program returned for real pairs, where it lies beside the checkout, and how to read it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared"
DATA, PROGRAM = SHARED / "data", SHARED / "reference" / "vosf"
sys.path.insert(0, str(ROOT / "benchmarks"))

import vo_sf_program as vo_sf_program  # noqa: E402, PLC0414

needs_program = pytest.mark.skipif(
    not PROGRAM.is_dir() or not DATA.is_dir(), reason=f"no real pairs and program output in {SHARED}"
)
