"""Where the checkout lies, and real recordings beside it."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The checkout."""
SHARED = ROOT.parent / "shared"
"""Recordings and references that are no part of the project; tests that want them say so where they are missing."""
