"""Paths of the checkout and of the recordings beside it."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The checkout."""
SHARED = ROOT.parent / "shared"
"""Recordings and references outside the repository; tests that need them are skipped where they are missing."""
HELPERS_ON_PATH = {"PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT / "tests"), os.environ.get("PYTHONPATH"))))}
"""Environment variables for a process that imports `helpers`."""
