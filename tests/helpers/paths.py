"""Where the checkout lies, and real recordings beside it."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The checkout."""
SHARED = ROOT.parent / "shared"
"""Recordings and references that are no part of the project; tests that want them say so where they are missing."""
HELPERS_ON_PATH = {"PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT / "tests"), os.environ.get("PYTHONPATH"))))}
"""Part of the environment of a process that imports `helpers`."""
